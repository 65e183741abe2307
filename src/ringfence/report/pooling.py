"""Runs of one method on one task, played on the same resets, as one row of numbers; both kinds of page rest on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringfence.errors import UserError
from ringfence.evaluation import statistics

Interval = tuple[float, float]


@dataclass(kw_only=True)
class Numbers:
    """Per episode, over all runs of a row. Intervals are 95 %."""

    episodes: int  # over all runs
    returns: float
    returns_interval: Interval
    returns_norm: float
    cost: float
    cost_interval: Interval
    cost_norm: float
    cost_safe_start: float
    cost_safe_start_interval: Interval
    violations: int
    violation_upper: float  # exact, one-sided, of the resets on which any run has one
    unsafe_starts: int
    cvar: float  # mean of the tenth of episodes with the highest cost
    safe: bool  # the upper end of the cost's interval is within the limit

    @property
    def violation_rate(self) -> float:
        return self.violations / self.episodes


def pool(results: list[dict], who: str = "the runs of a row") -> dict:
    """Fields of `Numbers` from the summaries of a row's runs. `UserError` if they played different numbers of resets.

    The interval of one run speaks of its episodes alone, that of several also of what another seed would have trained.
    """
    first = results[0]
    if len(results) == 1:  # which may be of logged data, whose episodes are not kept one by one
        told = {
            "returns": first["return_mean"],
            "returns_interval": tuple(first["return_interval"]),
            "cost": first["cost_mean"],
            "cost_interval": tuple(first["cost_interval"]),
            "cost_safe_start": first["cost_safe_start"],
            "cost_safe_start_interval": tuple(first["cost_safe_start_interval"]),
            "unsafe_starts": first["unsafe_starts"],
            "cvar": first["cost_cvar10"],
            "violation_upper": statistics.upper_bound(_violations(first), first["episodes"]),
        }
    else:
        played = [r["episodes"] for r in results]
        if len(set(played)) > 1:
            raise UserError(
                f"{who} were played for {min(played)} and for {max(played)} episodes, which are not the same resets; "
                "evaluate all of them with the same --episodes."
            )
        returns, cost, unsafe = (
            np.array([r["per_episode"][k] for r in results], float) for k in ("return", "cost", "unsafe_start")
        )
        fine = unsafe == 0 if not unsafe.all() else np.ones_like(unsafe, bool)
        avoidable = cost * (not unsafe.all())
        told = {
            "returns": float(returns.mean()),
            "returns_interval": statistics.mean_of_runs(returns),
            "cost": float(cost.mean()),
            "cost_interval": statistics.mean_of_runs(cost, least=0.0),
            "cost_safe_start": float(avoidable[fine].mean()),
            "cost_safe_start_interval": statistics.mean_of_runs(avoidable, fine, least=0.0),
            "unsafe_starts": int(unsafe.sum()),
            "cvar": statistics.cvar(cost.ravel()),
            # Runs share their resets, which alone are independent; a mean over runs is at most this share of them.
            "violation_upper": statistics.upper_bound(int((cost > 0).any(0).sum()), cost.shape[1]),
        }
    episodes, c = sum(r["episodes"] for r in results), first["constants"]
    violations = sum(map(_violations, results))
    return told | {
        "episodes": episodes,
        "violations": violations,
        "returns_norm": normal_return(told["returns"], c),
        "cost_norm": normal_cost(told["cost"], c),
        "safe": told["cost_interval"][1] <= c["cost_limit"],
    }


def _violations(result: dict) -> int:
    return round(result["violation_rate"] * result["episodes"])


def normal_return(x, c: dict[str, float]):
    """0 at return_min, 1 at return_max."""
    return (x - c["return_min"]) / (c["return_max"] - c["return_min"])


def normal_cost(x, c: dict[str, float]):
    """1 at the limit."""
    return (x + c["cost_offset"]) / (c["cost_limit"] + c["cost_offset"])


def mean_of(results: list[dict], key: str) -> float | None:
    """Mean of what the summaries say under `key`; None where none says it."""
    values = [r[key] for r in results if r.get(key) is not None]
    return float(np.mean(values)) if values else None
