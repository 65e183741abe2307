"""What stands beside a controller: a log of what it did and why, a watch over its certificate, ages of what it sees.

The log shows whether it was changed (`utils/chained.py`).
"""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import ringfence
from ringfence.errors import UserError, known, of_kind
from ringfence.evaluation.certificate import Certificate, Monitor, digest
from ringfence.guards.wrap import Callback, guarded_of, with_guarded
from ringfence.problem.homogeneous import agent_policy
from ringfence.types import Spec
from ringfence.utils.chained import ChainedLog
from ringfence.utils.functions import of_both
from ringfence.utils.given import given_as
from ringfence.utils.pytrees import digest_of

SEEN = ("observations", "state")
SAME = 1e-6  # an executed action that differs by less from the requested one is that
ON_ALARM = ("report", "stop", "widen", "hand_over")
WIDER = 1.5  # times the margin

Fallback = Callable[[np.ndarray, np.ndarray | None], Any]  # observations (N, O), state (S,) or None -> actions (N, A)
SLACK = 1e-3  # s by which a stamp may be ahead of the clock: clocks of two machines differ
LATELY = 20  # decisions whose time is remembered
ENOUGH = 3  # of them, before which nothing is added: the first one compiles


class Evidence:
    """Records of one controller: `begin` says of which policy, World, guard and certificate; then `reset` where an
    episode begins, `step`, and `refused` where nothing was done; `end` when it is closed."""

    def __init__(self, path: str | Path, policy: Any, agents: int, certificate: Certificate | None):
        guarded = guarded_of(policy)
        self._parts = () if guarded is None else guarded.guard.barrier.part_names
        self._log = ChainedLog(path)
        try:
            proposal = agent_policy(policy) if guarded is None else guarded.proposal
            found: dict[str, Any] = {
                "kind": "begin",
                "t": _now(),
                "ringfence": ringfence.__version__,
                "agents": agents,
                "policy": None if isinstance(policy, Callback) else digest(proposal),
                "world": None,
                "guard": None,
                "certificate": None if certificate is None else certificate.digest,
            }
            if guarded is not None:
                guard = guarded.guard
                found |= {
                    "world": digest(guard.world),
                    "barrier": guard.barrier.source,
                    "guard": dataclasses.asdict(guard.options),
                }
            self._log.add(found)
        except BaseException:
            self._log.close()
            raise

    @property
    def last(self) -> str:
        """Digest of the last record; keep it elsewhere, and `ringfence log verify --last` tells a log that was cut."""
        return self._log.last

    def reset(self) -> None:
        """An episode begins."""
        self._log.add({"kind": "reset", "t": _now()})

    def finished(self, violated: bool, alarm: bool) -> None:
        """An episode has ended."""
        self._log.add({"kind": "finished", "t": _now(), "violated": violated, "alarm": alarm})

    def step(
        self,
        seen: tuple[np.ndarray, np.ndarray | None],
        age: Any,
        action: np.ndarray,
        info: Mapping[str, np.ndarray],
        ms: float,
    ) -> None:
        """An action (N, A) that is about to be executed, and what is known of it."""
        record: dict[str, Any] = {
            "kind": "step",
            "t": _now(),
            "ms": round(ms, 3),
            "observed": digest_of((name, x) for name, x in zip(SEEN, seen) if x is not None),
            "age": None if age is None else np.asarray(age).tolist(),
            "executed": _numbers(action),
        }
        if "agent_requested" in info:
            # Of each agent whose action is another than it requested: that one, and the worst along its plan.
            requested = info["agent_requested"]
            found = []
            for agent in np.flatnonzero((np.abs(requested - action) > SAME).any(-1)).tolist():
                constraint, thing = self._parts[int(info["agent_reason"][agent])]
                found.append(
                    {
                        "agent": agent,
                        "requested": _numbers(requested[agent]),
                        "constraint": constraint,
                        "thing": thing,
                        "row": int(info["agent_reason_row"][agent]),
                        "score": _numbers(info["agent_reason_score"][agent]),
                    }
                )
            record["corrected"] = found
        if "agent_clearance" in info:
            record["clearance"] = _numbers(info["agent_clearance"])
            record["infeasible"] = np.flatnonzero(info["agent_infeasible"]).tolist()
            record["ood"] = np.flatnonzero(info["agent_ood"]).tolist()
        for name in ("covered", "proved", "alarm"):
            if name in info:
                record[name] = bool(np.all(info[name]))
        self._log.add(record)

    def refused(self, why: str) -> None:
        """Nothing was done."""
        self._log.add({"kind": "refused", "t": _now(), "why": why})

    def close(self) -> None:
        """End the log; what stopped without it was killed."""
        try:
            self._log.add({"kind": "end", "t": _now()})
        finally:  # on a full disk, too
            self._log.close()


def explaining(policy: Any) -> Any:
    """The policy, whose guard says what was requested and what was amiss with it."""
    guarded = guarded_of(policy)
    if guarded is None:
        return policy
    return with_guarded(policy, dataclasses.replace(guarded, explains=True))


def _numbers(x: np.ndarray) -> Any:
    """Single-precision numbers as the shortest decimals that give them back; what is no number is None."""
    array = np.asarray(x, np.float32)
    if array.ndim:
        return [_numbers(one) for one in array]
    return float(str(array)) if np.isfinite(array) else None


def _now() -> float:
    """s since 1970, to the microsecond."""
    return round(time.time(), 6)


class Watch:
    """A monitor of the certificate's bound, and what is done on its alarm."""

    def __init__(self, certificate: Certificate | None, on_alarm: str, fallback: Fallback | None):
        known("on_alarm", on_alarm, ON_ALARM)
        of_kind("fallback", fallback, Callable | None, "give a function of observations and state")
        if certificate is None and on_alarm != "report":
            raise UserError(f"on_alarm='{on_alarm}' is read by nothing without a certificate; give certificate=.")
        if (on_alarm == "hand_over") != (fallback is not None):
            raise UserError("on_alarm='hand_over' and fallback=, who then acts, go together; give both or none.")
        self.on_alarm = on_alarm
        self.fallback = None if fallback is None else of_both(fallback)
        self._monitor = None
        if certificate is not None and certificate.bound < 1:
            self._monitor = Monitor(certificate.bound)

    @property
    def alarm(self) -> bool:
        """Whether the promise is known not to be kept."""
        return self._monitor is not None and self._monitor.alarm

    def finished(self, violated: bool) -> bool:
        """An episode has ended; whether the alarm is raised."""
        if self._monitor is None:
            raise UserError(
                "Nothing was promised that an episode could break; give a certificate with a bound below 1."
            )
        return self._monitor.observe(violated)

    def check(self) -> None:
        """Refuse to act, where that is what an alarm asks for."""
        if self.alarm and self.on_alarm == "stop":
            assert self._monitor is not None, "it raised the alarm"
            raise UserError(
                f"More episodes violate than the certificate allows ({self._monitor.rate:.3g} of them, after "
                f"{self._monitor.episodes}); find out what has changed, and certify again."
            )

    @property
    def hands_over(self) -> bool:
        """Whether the fallback acts now."""
        return self.fallback is not None and self.alarm

    def taken_over(self, observations: np.ndarray, state: np.ndarray | None, spec: Spec, agents: int) -> np.ndarray:
        """(N, A) the fallback's actions, within bounds; they are not guarded."""
        assert self.fallback is not None, "it acts now"
        wanted = self.fallback(observations.copy(), None if state is None else state.copy())
        shape = (agents, spec.action_dim)
        action = given_as("the fallback's result", wanted, shape, "the task", "return one action for each agent")
        low, high = (np.asarray(bound, np.float32) for bound in (spec.action_low, spec.action_high))
        return np.clip(action, low, high)


def widened(policy: Any) -> Any:
    """The policy, whose guard keeps a wider margin."""
    guarded = guarded_of(policy)
    assert guarded is not None, "a certificate is of a guard"
    options = dataclasses.replace(guarded.guard.options, margin=WIDER * guarded.guard.options.margin)
    guard = dataclasses.replace(guarded.guard, options=options)
    return with_guarded(policy, dataclasses.replace(guarded, guard=guard))


class Stamps:
    """Turns the times at which observations were made into ages in steps, and refuses clocks that run backwards."""

    def __init__(self, clock: Callable[[], float]):
        of_kind("clock", clock, Callable, "give a function that tells the time in seconds")
        self._clock = clock
        self._last: np.ndarray | float = -np.inf
        self._now = -np.inf
        self._took: deque[float] = deque(maxlen=LATELY)

    def reset(self) -> None:
        """An episode begins; a simulation's clock may begin anew."""
        self._last = self._now = -np.inf

    def ages(self, observed_at: Any, agents: int, dt: float | None) -> np.ndarray:
        """() or (N,) whole steps of `dt` seconds from `observed_at`, in seconds by this clock, until what is decided
        now is given: deciding takes as long as it did lately."""
        if dt is None:
            raise UserError(
                "observed_at needs a guard whose World knows how long a step is (dt of its logs); give age= in steps."
            )
        stamps = np.asarray(observed_at)
        if stamps.dtype.kind not in "iuf" or stamps.shape not in ((), (agents,)) or not np.isfinite(stamps).all():
            raise UserError(f"observed_at={str(observed_at)[:60]} must be a time in seconds, or one of each agent.")
        stamps = stamps.astype(np.float64)
        now = float(self._clock())
        if now < self._now or (stamps > now + SLACK).any():
            before = max(self._now, float(stamps.max()))
            raise UserError(
                f"The clock runs backwards: it is {now:.3f} s, after {before:.3f} s; give clock=, the one that stamps "
                "observations."
            )
        if (stamps < self._last).any():
            raise UserError(
                f"observed_at={stamps.tolist()} is before {np.asarray(self._last).tolist()} of the step before; the "
                "clock of an observer runs backwards, or messages overtook one another: keep the newest."
            )
        self._now, self._last = now, stamps
        lately = float(np.median(self._took)) if len(self._took) >= ENOUGH else 0.0
        return np.floor(np.maximum(now + lately - stamps, 0.0) / dt + 0.5).astype(np.int64)

    def acted(self) -> None:
        """What was asked for by `ages` is decided."""
        self._took.append(max(float(self._clock()) - self._now, 0.0))
