"""What a section's table says, in plain sentences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ringfence.evaluation import reference, statistics
from ringfence.evaluation.statistics import Interval
from ringfence.report.html import share
from ringfence.report.table import Line, Section

WORDS = {  # constraint -> (what the cost counts, what a violation is)
    "Separation": ("collision steps", "a collision"),
    "SpeedLimit": ("steps above the speed limit", "a step above the speed limit"),
}


def words_of(hazard: dict[str, Any]) -> tuple[str, str]:
    """(what the cost counts, what a violation is)."""
    return WORDS.get(hazard.get("kind", ""), ("cost", "a violation"))


def danger(hazard: dict[str, Any]) -> str:
    """What a cost is charged for, in words; empty where there is no formula."""
    if hazard.get("kind") == "SpeedLimit":
        return f"a speed above {hazard['limit']:g} m/s"
    return f"a distance below {hazard['radius']:g} m" if hazard.get("kind") == "Separation" else ""


def headline(section: Section, split: str = "test") -> list[str]:
    """The outcome in plain sentences, from the numbers of a split."""
    rows = section.tables.get(split, [])
    if not rows:
        return ["Only validation results exist: settings can be chosen from them, but no result can be claimed."]
    unit, event = words_of(section.hazard)
    cost_limit = section.constants["cost_limit"]
    counted = unit.replace("steps", "step") if cost_limit == 1 else unit
    limit = f"the limit of {cost_limit:g} {counted} per episode"
    limits = {name: limit for row in rows for name, limit in row.limits.items()}
    if limits:
        each = ", ".join(f"{name} {own:g}" for name, own in limits.items())
        limit = f"the limit of each constraint ({each} per episode)"
    safe = [row for row in rows if row.safe]
    sentences = _best(rows, safe, section.references, limit, unit, event) if safe else _nearest(rows, limit)
    for row in section.references:
        if row.name == reference.LOGS:
            sentences.append(
                f"The data itself has a return of {row.returns:.1f} and {row.cost:.3f} {unit} per episode, and {event} "
                f"in {share(row.violation_rate)} of all."
            )
            sentences += _worse(rows, row, event)
    return sentences


def _worse(rows: Sequence[Line], logs: Line, event: str) -> list[str]:
    """Of the method with most violations, where it has clearly more than its logs."""
    most = max(rows, key=lambda row: row.violation_rate)
    low, _ = statistics.clopper_pearson(most.violations, most.episodes)
    if low <= 1.5 * logs.violation_rate or low - logs.violation_rate < 0.05:
        return []
    return [f"{most.label} has {event} in {share(most.violation_rate)} of its episodes, more than the data has."]


def _nearest(rows: Sequence[Line], limit: str) -> list[str]:
    """Where nobody keeps the limit."""
    if any(row.limits for row in rows):
        least = min(rows, key=lambda row: row.cost_norm)
        return [
            f"No method keeps its costs within {limit}. {least.label} comes nearest, with {least.cost_norm:.3g} times "
            f"the limit of its worst constraint, at a return of {least.returns:.1f}."
        ]
    least = min(rows, key=lambda row: row.cost)
    return [
        f"No method keeps its cost within {limit}. {least.label} comes nearest, with {least.cost:.3f} "
        f"(95 % interval {_range(least.cost_interval, 3)}) at a return of {least.returns:.1f}."
    ]


def _best(
    rows: Sequence[Line], safe: Sequence[Line], references: Sequence[Line], limit: str, unit: str, event: str
) -> list[str]:
    """Of the method that earns most within the limit, and of those near it."""
    best = max(safe, key=lambda row: row.returns)
    seeds = f"{len(best.seeds)} {'seed' if len(best.seeds) == 1 else 'seeds'}"
    sentences = [
        f"{_lead(best, len(rows), len(safe), limit)} {best.returns:.1f} per episode (95 % interval "
        f"{_range(best.returns_interval, 1)}), with {event} in {share(best.violation_rate)} of {best.episodes:,} "
        f"episodes ({seeds}), at most {share(best.violation_upper)} with 95 % confidence."
    ]
    ahead = [row for row in references if row.safe and row.returns > best.returns]
    if ahead:
        named = _and([f"{row.name} ({row.returns:.1f})" for row in ahead])
        sentences.append(f"References within the limit that earn more: {named}.")
    near = [row for row in safe if row is not best and row.returns_interval[1] >= best.returns_interval[0]]
    if near:
        overlap = "interval of {} overlaps" if len(near) == 1 else "intervals of {} overlap"
        sentences.append(f"The {overlap.format(_and([row.label for row in near]))} with its own.")
    least = min(rows, key=lambda row: (row.cost_safe_start, -row.returns))
    if least is not best:
        sentences.append(
            f"Fewest {unit} in episodes that start safe: {least.label}, {least.cost_safe_start:.3f} against "
            f"{best.cost_safe_start:.3f}, at a return of {least.returns:.1f}."
        )
    return sentences


def _lead(best: Line, methods: int, safe: int, limit: str) -> str:
    """How a sentence on the best of `safe` among `methods` begins; its return follows."""
    if methods == 1:
        return f"{best.label} keeps its cost within {limit} and earns a return of"
    if safe == 1:
        return f"{best.label} is the only one of {methods} methods that stays within {limit}, at a return of"
    some = f"{methods} methods, all" if safe == methods else f"{safe} of {methods} methods that stay"
    return f"{best.label} earns the highest return of the {some} within {limit}:"


def _and(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def _range(interval: Interval, digits: int) -> str:
    return f"{interval[0]:.{digits}f} to {interval[1]:.{digits}f}"
