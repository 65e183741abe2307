"""Results of one method on one task, played on the same resets, as one line of numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from ringfence.errors import UserError
from ringfence.evaluation import statistics
from ringfence.evaluation.statistics import Interval
from ringfence.evaluation.table import Result

Number = TypeVar("Number", float, np.ndarray)


@dataclass(kw_only=True)
class Numbers:
    """Per episode, over all runs of a line. Intervals are 95 %."""

    episodes: int  # over all runs
    returns: float
    returns_interval: Interval
    returns_norm: float
    cost: float
    cost_interval: Interval
    cost_norm: float
    cost_safe_start: float
    cost_safe_start_interval: Interval
    returns_sd: float | None  # between runs; None of one
    cost_sd: float | None
    violations: int
    violation_upper: float  # exact, one-sided, of the resets on which any run has one
    unsafe_starts: int
    cvar: float  # mean of the tenth of episodes with the highest cost
    safe: bool  # the upper end of the cost's interval is within the limit, and so it is of every named constraint
    limits: dict[str, float] = field(default_factory=dict)  # per episode, of the constraints that are named

    @property
    def violation_rate(self) -> float:
        return self.violations / self.episodes


def pool(results: list[Result], name: str = "the runs of a line") -> Numbers:
    """The summaries of a line's runs as one. `UserError` if they played different numbers of resets.

    The interval of one run speaks of its episodes alone, that of several also of what another seed would have trained.
    """
    measured = _of_one(results[0]) if len(results) == 1 else _of_several(results, name)
    constants = results[0]["constants"]
    limits = limits_of(results)
    kept = all(_keeps(result, limits) for result in results)
    return Numbers(
        **measured,
        episodes=sum(r["episodes"] for r in results),
        returns_sd=_deviation(results, "return_mean"),
        cost_sd=_deviation(results, "cost_mean"),
        violations=sum(map(_violations, results)),
        returns_norm=normal_return(measured["returns"], constants),
        cost_norm=_worst_share(results, limits) if limits else normal_cost(measured["cost"], constants),
        safe=kept and measured["cost_interval"][1] <= constants["cost_limit"],
        limits=limits,
    )


def _deviation(results: list[Result], key: str) -> float | None:
    return float(np.std([r[key] for r in results], ddof=1)) if len(results) > 1 else None


def limits_of(results: Iterable[Result]) -> dict[str, float]:
    """The limit of every constraint that a result names. Their sum is no limit: what one leaves, another must not
    use up."""
    limits: dict[str, float] = {}
    for result in results:
        for name, constraint in result.get("constraints", {}).items():
            if constraint.get("limit") is not None:
                limits[name] = min(constraint["limit"], limits.get(name, constraint["limit"]))
    return limits


def _keeps(result: Result, limits: Mapping[str, float]) -> bool:
    """Whether a run keeps every limit, by the upper ends of the costs' intervals; what was not measured is not kept."""
    for name, limit in limits.items():
        measured = result.get("constraints", {}).get(name)
        if measured is None or measured.get("cost_interval", (0.0, measured["cost_mean"]))[1] > limit:
            return False
    return True


def _worst_share(results: Iterable[Result], limits: Mapping[str, float]) -> float:
    """Of the constraints' mean costs the largest as a share of its own limit: 1 at the limit."""
    shares = [0.0]
    for result in results:
        for name, limit in limits.items():
            cost = result.get("constraints", {}).get(name, {}).get("cost_mean", np.inf)
            shares.append(cost / limit if limit > 0 else np.inf if cost > 0 else 0.0)
    return float(max(shares))


def _of_one(result: Result) -> dict[str, Any]:
    """Its own numbers: it may be of logged data, whose episodes are not kept one by one."""
    return {
        "returns": result["return_mean"],
        "returns_interval": tuple(result["return_interval"]),
        "cost": result["cost_mean"],
        "cost_interval": tuple(result["cost_interval"]),
        "cost_safe_start": result["cost_safe_start"],
        "cost_safe_start_interval": tuple(result["cost_safe_start_interval"]),
        "unsafe_starts": result["unsafe_starts"],
        "cvar": result["cost_cvar10"],
        "violation_upper": statistics.upper_bound(_violations(result), result["episodes"]),
    }


def _of_several(results: list[Result], name: str) -> dict[str, Any]:
    """From the episodes (runs, resets) of all."""
    played = [r["episodes"] for r in results]
    if len(set(played)) > 1:
        raise UserError(
            f"{name} were played for {min(played)} and for {max(played)} episodes, which are not the same resets; "
            "evaluate all of them with the same --episodes."
        )
    returns = _episodes(results, "return")
    cost = _episodes(results, "cost")
    unsafe = _episodes(results, "unsafe_start")
    if unsafe.all():  # nothing is known of safe starts: no cost
        safe_start = np.ones_like(unsafe, bool)
        cost_safe_start = np.zeros_like(cost)
    else:
        safe_start = unsafe == 0
        cost_safe_start = cost
    return {
        "returns": float(returns.mean()),
        "returns_interval": statistics.mean_of_runs(returns),
        "cost": float(cost.mean()),
        "cost_interval": statistics.mean_of_runs(cost, least=0.0),
        "cost_safe_start": float(cost_safe_start[safe_start].mean()),
        "cost_safe_start_interval": statistics.mean_of_runs(cost_safe_start, safe_start, least=0.0),
        "unsafe_starts": int(unsafe.sum()),
        "cvar": statistics.cvar(cost.ravel()),
        # Runs share their resets, which alone are independent; a mean over runs is at most this share of them.
        "violation_upper": statistics.upper_bound(int((cost > 0).any(0).sum()), cost.shape[1]),
    }


def _episodes(results: list[Result], what: str) -> np.ndarray:
    return np.array([r["per_episode"][what] for r in results], float)


def _violations(result: Result) -> int:
    return round(result["violation_rate"] * result["episodes"])


def normal_return(x: Number, constants: dict[str, float]) -> Number:
    """0 at return_min, 1 at return_max."""
    return (x - constants["return_min"]) / return_span(constants)


def normal_cost(x: Number, constants: dict[str, float]) -> Number:
    """1 at the limit."""
    return (x + constants["cost_offset"]) / _span(constants["cost_limit"] + constants["cost_offset"])


def return_span(constants: dict[str, float]) -> float:
    """What lies between normalised returns of 0 and 1."""
    return _span(constants["return_max"] - constants["return_min"])


def _span(size: float) -> float:
    if not size:
        raise UserError("A result's constants say that 0 and 1 are the same return or cost; evaluate its run again.")
    return size


def mean_of(results: Iterable[Mapping[str, Any]], key: str) -> float | None:
    """Mean of what the summaries say under `key`; None where none says it."""
    values = [r[key] for r in results if r.get(key) is not None]
    return float(np.mean(values)) if values else None
