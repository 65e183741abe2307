"""What was promised of a guarded run: for whom, behind which faults, and by which episodes."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ringfence.errors import UserError
from ringfence.faults.faults import Faults
from ringfence.utils.files import regular, whole
from ringfence.utils.pytrees import digest_of, named_arrays

FORMAT = 1


@dataclass(frozen=True)
class Certificate:
    """Of exchangeable episodes at most `bound` violate, with the given confidence: episodes of this policy, World,
    guard and task, behind these faults."""

    policy: str  # digest
    world: str  # digest
    task: str
    agents: int
    guard: dict[str, Any]  # all its options; the margin is the calibrated one
    barrier: str
    faults: dict[str, Any]
    confidence: float
    bound: float
    episodes: int  # that it was tested on
    violations: int  # among them
    rounds: tuple[dict[str, float], ...]  # of calibration: margin, quantile, episodes
    agreed: bool  # whether the last quantile was below the margin in use
    held: float  # share of tested episodes whose shortfall was within the margin
    infeasible_rate: float
    # where windows of logs were replayed: digest of the logs, windows (calibrated, tested), seconds, kinematics, radius
    replayed: dict[str, Any] = dataclasses.field(default_factory=dict)
    simulator: str = ""  # of one's own
    format: int = FORMAT

    def summary(self) -> tuple[str, ...]:
        """What it says, a sentence each."""
        given = Faults.of(self.faults).given
        behind = ", ".join(f"{name} {value}" for name, value in given.items()) or "no faults"
        again = "the same windows" if self.replayed else "a fresh batch"
        agreed = f"{again} agreed with it" if self.agreed else f"{again} did not agree with it"
        what = "windows" if self.replayed else "episodes"
        return (
            f"With confidence {self.confidence:g} at most {100 * self.bound:.2f} % of {what} violate: "
            f"{self.violations} of {self.episodes} fresh ones did.",
            f"Behind {behind}; {self.task}, {self.agents} agent{'s' * (self.agents != 1)}, barrier {self.barrier}"
            + (f"; in {self.simulator}." if self.simulator else "."),
            f"The margin is {self.guard['margin']:.3g} after {len(self.rounds)} batch{'es' * (len(self.rounds) > 1)}; "
            f"{agreed}.",
            f"In {100 * self.held:.1f} % of the fresh {what} no state scored below its prediction by more than that.",
            *self._replay(),
            f"It holds for {what} drawn as these were, not for each state, another simulator or an adversary.",
        )

    def _replay(self) -> tuple[str, ...]:
        if not self.replayed:
            return ()
        return (
            f"Logs were replayed in windows of {self.replayed['seconds']:.3g} s: one agent is driven "
            f"({self.replayed['kinematics']}), the others do what they did and do not react, and a violation is to "
            f"come nearer than {self.replayed['radius']:.3g} m. Windows of one log are no independent draws.",
        )

    def save(self, path: str | Path) -> Path:
        """As JSON, whole or not at all."""
        with whole(path) as temporary:
            temporary.write_text(json.dumps(dataclasses.asdict(self) | {"says": self.summary()}, indent=1) + "\n")
        return Path(path)

    @classmethod
    def load(cls, path: str | Path) -> Certificate:
        """What `save` wrote; anything else is refused."""
        try:
            stored = json.loads(regular(path).read_text())
            stored.pop("says", None)
            found = cls(**{**stored, "rounds": tuple(stored["rounds"])})
        except (ValueError, TypeError, KeyError, AttributeError, OSError) as error:
            raise UserError(f"'{path}' is no certificate ({error}); make one with `ringfence certify`.") from error
        if found.format != FORMAT:
            raise UserError(f"'{path}' has format {found.format}, this version reads {FORMAT}; certify again.")
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
