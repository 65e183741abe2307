"""What was promised of a guarded run: for whom, behind which faults, and by which episodes.

A file is believed where it says nothing that its own counts do not say, and its digest is of all of it. A digest is no
signature: whoever makes a file anew can promise what they like in it.

`Monitor` tests whether the promise is still kept, and may be looked at after every episode. Wealth starts at 1 and bets
that violations come more often than was promised. While the promise holds it is a supermartingale, so the chance that
it ever reaches 1/δ is at most δ (Ville 1939), however often one looks. Bets of several sizes are held side by side,
since nobody knows how much worse things have become.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np
from msgspec import Meta

from ringfence.errors import UserError
from ringfence.evaluation.statistics import upper_bound
from ringfence.faults import Faults
from ringfence.guards.options import GuardOptions
from ringfence.loading.spec import SOURCES
from ringfence.utils import schemas
from ringfence.utils.config import build_config, fields_of
from ringfence.utils.files import place, whole
from ringfence.utils.pytrees import digest_of, named_arrays

FORMAT = 2
LARGEST = 2**20  # bytes of a file; those that are written have some thousand
CLOSE = 1e-9  # by which a bound may differ from the one that its counts give: libraries round differently
BETS = 0.5 ** np.arange(1, 7)  # shares of the largest bet, at which one episode without violation would lose all

Level = Annotated[float, Meta(gt=0, lt=1)]
NotNegative = Annotated[float, Meta(ge=0)]


class Round(TypedDict):
    """A batch that the margin was calibrated on."""

    margin: NotNegative
    quantile: float  # of the batch's shortfalls
    episodes: schemas.Positive


class Replayed(TypedDict):
    """Windows of logs that were episodes."""

    logs: str  # digest
    windows: Annotated[list[schemas.Positive], Meta(min_length=2, max_length=2)]  # calibrated on, tested on
    seconds: NotNegative
    kinematics: str
    radius: NotNegative


@dataclass(frozen=True)
class Certificate:
    """Of exchangeable episodes at most `bound` violate, with the given confidence: episodes of this policy, World,
    guard and task, behind these faults."""

    policy: str  # digest
    world: str  # digest
    task: str
    agents: schemas.Few
    guard: dict[str, Any]  # all its options; the margin is the calibrated one
    barrier: str
    faults: dict[str, Any]
    confidence: Level
    bound: schemas.Share
    episodes: schemas.Positive  # that it was tested on
    violations: schemas.Count  # among them
    rounds: Annotated[tuple[Round, ...], Meta(min_length=1, max_length=100)]  # of calibration, until it agreed
    agreed: bool  # whether the last quantile was below the margin in use
    held: schemas.Share  # share of tested episodes whose shortfall was within the margin
    infeasible_rate: schemas.Share
    replayed: Replayed | None = None  # None: episodes were played
    simulator: str = ""  # of one's own
    format: int = FORMAT

    def summary(self) -> tuple[str, ...]:
        """What it says, a sentence each."""
        given = Faults.of(self.faults).given
        behind = ", ".join(f"{name} {value}" for name, value in given.items()) or "no faults"
        again = "the same windows" if self.replayed else "a fresh batch"
        agreed = f"{again} agreed with it" if self.agreed else f"{again} did not agree with it"
        what = "windows" if self.replayed else "episodes"
        replay = []
        if self.replayed:
            replay.append(
                f"Logs were replayed in windows of {self.replayed['seconds']:.3g} s: one agent is driven "
                f"({self.replayed['kinematics']}), the others do what they did and do not react, and a violation is to "
                f"come nearer than {self.replayed['radius']:.3g} m. Windows of one log are no independent draws."
            )
        return (
            f"With confidence {self.confidence:g} at most {100 * self.bound:.2f} % of {what} violate: "
            f"{self.violations} of {self.episodes} fresh ones did.",
            f"Behind {behind}; {self.task}, {self.agents} agent{'s' * (self.agents != 1)}, barrier {self.barrier}"
            + (f"; in {self.simulator}." if self.simulator else "."),
            f"The margin is {self.guard['margin']:.3g} after {len(self.rounds)} batch{'es' * (len(self.rounds) > 1)}; "
            f"{agreed}.",
            f"In {100 * self.held:.1f} % of the fresh {what} no state scored below its prediction by more than that.",
            *replay,
            f"It holds for {what} drawn as these were, not for each state, another simulator or an adversary.",
        )

    def save(self, path: str | Path) -> Path:
        """As JSON, whole or not at all."""
        with whole(path) as temporary:
            temporary.write_text(json.dumps(self._content | {"digest": self.digest}, indent=1, allow_nan=False) + "\n")
        return Path(path)

    @property
    def digest(self) -> str:
        """Of all that its file says."""
        return _digest_of_words(self._content)

    @property
    def _content(self) -> dict[str, Any]:
        return dataclasses.asdict(self) | {"says": list(self.summary())}

    @classmethod
    def load(cls, path: str | Path) -> Certificate:
        """What `save` wrote; anything else is refused, and so is what its own counts contradict."""
        path = place(path)
        try:
            stored = schemas.decode(schemas.content(path, LARGEST), dict[str, Any])
            if stored.get("format") != FORMAT:
                raise ValueError(f"it has format {str(stored.get('format'))[:20]}, and this version reads {FORMAT}")
            if stored.pop("digest", None) != _digest_of_words(stored):
                raise ValueError("it is not what was written: its digest is of other contents")
            found = schemas.check({name: value for name, value in stored.items() if name != "says"}, cls)
            # `ValueError` where it promises what its counts do not tell, or is of a guard that there is not.
            if found.violations > found.episodes:
                raise ValueError(f"{found.violations} of {found.episodes} episodes violated")
            bound = upper_bound(found.violations, found.episodes, found.confidence)
            if abs(bound - found.bound) > CLOSE:
                raise ValueError(
                    f"{found.violations} of {found.episodes} violations are a bound of {bound:.4g} with confidence "
                    f"{found.confidence:g}, not {found.bound:.4g}"
                )
            if found.barrier not in SOURCES:
                raise ValueError(f"it is of barrier='{found.barrier}', which there is not")
            for kind, options in ((GuardOptions, found.guard), (Faults, found.faults)):
                lacking = fields_of(kind).keys() - options.keys()
                if lacking:
                    raise ValueError(f"it does not say {sorted(lacking)[0]}")
                if dataclasses.asdict(build_config(kind, options, "the certificate")) != options:
                    raise ValueError("its options are of other types")
            last = found.rounds[-1]
            if found.guard["margin"] != last["margin"] or found.agreed != (last["quantile"] <= last["margin"]):
                raise ValueError(f"margin={found.guard['margin']} is not the one that its last batch was played with")
            if unread := stored.keys() - {"says"} - fields_of(cls).keys():
                raise ValueError(f"it holds {sorted(unread)[0]}, which no certificate has")
            if stored.get("says") != list(found.summary()):
                raise ValueError("it says another thing than its own counts")
        except (ValueError, OSError) as error:
            raise UserError(
                f"'{path}' is no certificate ({str(error).rstrip('.')}); make one with `ringfence certify`."
            ) from None
        return found

    def require(self, policy: Any, world: Any, agents: int, guard: Mapping[str, Any], barrier: str) -> None:
        """Refuse who it is not of."""
        for what, own, given in (("run", self.policy, digest(policy)), ("World", self.world, digest(world))):
            if own != given:
                raise UserError(f"This certificate is of another {what} ({own}, not {given}); certify this one.")
        if agents != self.agents:
            raise UserError(f"This certificate is of {self.agents} agents, and {agents} play; certify these.")
        if barrier != self.barrier:
            raise UserError(f"This certificate is of barrier='{self.barrier}', not '{barrier}'; certify this one.")
        for name, own in self.guard.items():
            if guard.get(name) != own:
                raise UserError(
                    f"This certificate is of a guard with {name}={own}, and this one has {guard.get(name)}; give "
                    f"{name}={own}, or certify this one."
                )


def digest(tree: Any) -> str:
    """Of all numbers in a policy or a World."""
    return digest_of(sorted(named_arrays(tree).items()))


def _digest_of_words(content: Mapping[str, Any]) -> str:
    """Of everything that a file says."""
    return hashlib.blake2b(json.dumps(content, sort_keys=True).encode(), digest_size=16).hexdigest()


class Monitor:
    """Watches episodes against a promised rate of violations.

    monitor = Monitor(rate=0.03)               # the bound of a certificate
    alarm = monitor.observe(violated=False)    # after every episode
    """

    def __init__(self, rate: float, false_alarms: float = 0.01):
        for name, value in (("rate", rate), ("false_alarms", false_alarms)):
            if not isinstance(value, Real) or not 0 < value < 1:
                raise UserError(f"{name}={value!r:.60} must lie between 0 and 1.")
        self.rate = rate
        self.false_alarms = false_alarms
        self.episodes = 0
        self.alarm = False  # once raised it stays
        self._log_wealth = np.zeros(len(BETS))

    @property
    def wealth(self) -> float:
        """Evidence against the promise; at most `false_alarms` of kept promises ever see it at 1 / `false_alarms`."""
        return float(np.exp(self._log_wealth).mean())

    def observe(self, violated: bool) -> bool:
        """Whether the alarm is raised, with this episode."""
        if not isinstance(violated, bool | np.bool_):
            raise UserError(f"violated={violated!r} must be true or false; say whether the episode violated.")
        self._log_wealth += np.log1p(BETS / self.rate * (bool(violated) - self.rate))
        self.episodes += 1
        self.alarm = self.alarm or self.wealth >= 1 / self.false_alarms
        return self.alarm
