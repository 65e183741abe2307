"""What a controller did and why, step by step, in a log that shows whether it was changed (`utils/chained.py`)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import ringfence
from ringfence.evaluation.certificate import Certificate, digest
from ringfence.guards.policy import Guarded
from ringfence.guards.wrap import Callback, guarded_of, with_guarded
from ringfence.problem.homogeneous import agent_policy
from ringfence.utils.chained import ChainedLog
from ringfence.utils.pytrees import digest_of

SEEN = ("observations", "state")
FEW = 1e-6  # an executed action that differs by less from the requested one is that


class Evidence:
    """Records of one controller: `begin` says of which policy, World, guard and certificate; then `reset` where an
    episode begins, `step`, and `refused` where nothing was done; `end` when it is closed."""

    def __init__(self, path: str | Path, policy: Any, agents: int, certificate: Certificate | None):
        guarded = guarded_of(policy)
        self._parts = () if guarded is None else guarded.guard.barrier.part_names
        self._log = ChainedLog(path)
        try:
            self._log.add(_begun(policy, guarded, agents, certificate))
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
            record["corrected"] = self._corrected(action, info)
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

    def _corrected(self, action: np.ndarray, info: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
        """Of each agent whose action is another than it requested: that one, and the worst along its plan."""
        requested = info["agent_requested"]
        found = []
        for agent in np.flatnonzero((np.abs(requested - action) > FEW).any(-1)).tolist():
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
        return found


def explaining(policy: Any) -> Any:
    """The policy, whose guard says what was requested and what was amiss with it."""
    guarded = guarded_of(policy)
    if guarded is None:
        return policy
    return with_guarded(policy, dataclasses.replace(guarded, explains=True))


def _begun(policy: Any, guarded: Guarded | None, agents: int, certificate: Certificate | None) -> dict[str, Any]:
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
    return found


def _numbers(x: np.ndarray) -> Any:
    """Single-precision numbers as the shortest decimals that give them back; what is no number is None."""
    array = np.asarray(x, np.float32)
    if array.ndim:
        return [_numbers(one) for one in array]
    return float(str(array)) if np.isfinite(array) else None


def _now() -> float:
    """s since 1970, to the microsecond."""
    return round(time.time(), 6)
