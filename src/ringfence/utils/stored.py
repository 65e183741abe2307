"""What older versions wrote, under today's names.

Files keep the names of the version that wrote them. Whoever reads a stored result goes through `result`, whoever reads
a table through `table`, and sees one set of names. What is under today's names already stays as it is.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

COLUMNS = {
    "avoidable_cost": "cost_safe_start",
    "avoidable_interval": "cost_safe_start_interval",
    "avoidable_violation_upper": "violation_upper_safe_start",
    "infeasible": "infeasible_rate",
    "strange": "ood_rate",
    "danger": "barrier",
    "sight": "execution",
}
CONSTRAINTS = {"within": "limit_satisfied_rate"}
PLANNER_OPTIONS = {
    "steps": "sampling_steps",
    "guidance": "cfg_scale",
    "target": "target_return",
    "ascent": "value_guidance",
}
GUARD_OPTIONS = {
    "plans": "num_samples",
    "starts": "num_restarts",
    "refine": "optimizer_steps",
    "reach": "trust_radius",
    "care": "safety_weight",
    "shield": "correction_steps",
    "bound": "max_correction",
    "rows": "horizon",
    "future": "terminal_value",
}
OPTIONS = GUARD_OPTIONS | PLANNER_OPTIONS  # of those who play
CONFIG = {"steps": "num_updates", "target": "target_return"}  # of algorithms
# Fields that configs got later, at what was meant before.
LATER_CONFIG = {
    "drivers": 0,
    "distinguish_agents": False,
    "around": "nothing",
    "noisy_input": "unit",
    "guided": False,
    "error": "output",
    "clone_width": 384,
    "clone_depth": 3,
}
WORLD_SETTINGS = {
    "sight": "execution",
    "members": "num_ensemble",
    "both_ends": "use_transition",
    "missed": "miscoverage",
    "foreseen": "predicted_share",
}
# Parts of a World's card, what is said of its barriers, and the arrays of its file.
WORLD_CARD = {"foresight": "prediction_error", "strange": "ood"}
BARRIER_SCORES = {
    "foreseen_false_safe": "predicted_false_safe",
    "unsafe_foreseen_above": "unsafe_predicted_above",
    "missed": "miscoverage",
}
WORLD_ARRAYS = {"strange": "ood_threshold"}
SPEC = {"alike": "homogeneous"}
CARD = {"alike": "homogeneous", "sight": "sensing_radius"}
BARRIERS = {"formula": "analytic"}
EXECUTIONS = {"all": "centralized", "own": "decentralized"}
GUARD = {"danger": "barrier", "sight": "execution"}  # beside its options
PLANNERS = {"plain": "default", "climbing": "value_guided", "steady": "low_temperature"}
_GUARDED = (", `shield`, learned", ", `shield`, formula", ", `adapt`, learned", ", `full`, learned")
_PARTLY_NAIVE = ("logs of IR-SIM, two of eight",)
METHODS = {
    "cloning": "BC",
    "cloning, guarded": "BC, guarded",
    "cloning, episodes within": "BC on episodes within the limit",
    "blind": "naive controller",
}
POLICIES = {f"cloning{guard}": f"BC{guard}" for guard in ("", *_GUARDED)}
SOURCES = {f"{name} blind{more}": f"{name} naive{more}" for name in _PARTLY_NAIVE for more in ("", " themselves")}
VALUES = {
    "method": METHODS,
    "policy": POLICIES,
    "learned from": SOURCES,
    "barrier": BARRIERS,
    "execution": EXECUTIONS,
    "planner": PLANNERS,
}  # by today's name of the column

# Heads of tables in results/ that no result has.
HEADS = {
    "who": "method",
    "unknown": "ood_rate",
    "apart": "action_rmse",
    "not_surely_safe": "margin_violation_rate",
    "foreseen_unsafe": "predicted_violation_rate",
    "foreseen_false_safe": "predicted_false_safe",
}

# What planners that checked their own actions by the formula did, before guards were apart from them.
_BEFORE_GUARDS = {"guarded": "shield", "shielded": "shield", "adaptive": "adapt"}
# Names that only their results have.
PLANNERS_BEFORE_GUARDS = tuple(_BEFORE_GUARDS)
OPTIONS_BEFORE_GUARDS = (
    "plans",
    "repair",
    "select",
    "margin",
    "prefix",
    "foresight",
    "share",
    "shield",
    "adapt",
    "rate",
)


def result(stored: Mapping[str, Any]) -> dict[str, Any]:
    """An evaluation, or a reference row, as today's version would have written it."""
    found: dict[str, Any] = {**_before_guards(stored), **named(stored, COLUMNS)}
    for column, rename in (
        ("options", planner_options),
        ("guard_options", guard_options),
        ("world_settings", world_settings),
        ("constraints", _constraints),
    ):
        if column in found:
            found[column] = rename(found[column])
    if isinstance(found.get("variant"), str):
        found["variant"] = variant(found["variant"])
    return found


def results(stored: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Results by variant, or reference rows by name."""
    return {variant(name): result(one) for name, one in stored.items()}


_OLD_OPTION = re.compile(rf"({'|'.join(OPTIONS)})(-?\d.*|(?:True|False).*)")
_OLD_GUARD = re.compile(r"([a-z]+)-(learned|formula|analytic|both)(-own)?(@.*)?")
_OLD_PLANNER = re.compile(rf"({'|'.join(PLANNERS)})(@.*)?")


def variant(name: str) -> str:
    """A result's name under today's names of planners and options, e.g. `default+shield-learned+horizon7`."""
    preset, *parts = name.split("+")
    return "+".join([preset, *map(choice, parts)])


def choice(part: str) -> str:
    """A part of such a name."""
    if found := _OLD_OPTION.fullmatch(part):
        return OPTIONS[found[1]] + found[2]
    if found := _OLD_PLANNER.fullmatch(part):
        return PLANNERS[found[1]] + (found[2] or "")
    if found := _OLD_GUARD.fullmatch(part):
        alone = "-decentralized" if found[3] else ""
        return f"{found[1]}-{BARRIERS.get(found[2], found[2])}{alone}{found[4] or ''}"
    return part


def planner_options(stored: Mapping[str, Any]) -> dict[str, Any]:
    return named(stored, PLANNER_OPTIONS)


def guard_options(stored: Mapping[str, Any]) -> dict[str, Any]:
    return named(stored, GUARD_OPTIONS)


def world_settings(stored: Mapping[str, Any]) -> dict[str, Any]:
    return named(stored, WORLD_SETTINGS)


def world_card(stored: Mapping[str, Any]) -> dict[str, Any]:
    """What a World's file says of it, but for the settings."""
    found = named(stored, WORLD_CARD)
    if found.get("barrier"):
        found["barrier"] = _scores(found["barrier"])
    if found.get("constraints"):
        found["constraints"] = {name: _scores(scores) for name, scores in found["constraints"].items()}
    return found


def _scores(stored: Mapping[str, Any]) -> dict[str, Any]:
    """How well a barrier does."""
    found = named(stored, BARRIER_SCORES)
    if "calibration" in found:
        found["calibration"] = [named(row, BARRIER_SCORES) for row in found["calibration"]]
    return found


def world_arrays(stored: Mapping[str, T]) -> dict[str, T]:
    """Arrays of a World's file by their paths, e.g. `values/critic/layers/0`."""
    return {"/".join(WORLD_ARRAYS.get(part, part) for part in name.split("/")): x for name, x in stored.items()}


def config(stored: Mapping[str, Any]) -> dict[str, Any]:
    """config.json of a run."""
    found = dict(stored)
    for part, rename in (("spec", spec), ("config", settings), ("world", world_settings)):
        if found.get(part) is not None:
            found[part] = rename(found[part])
    return found


def settings(stored: Mapping[str, Any]) -> dict[str, Any]:
    """An algorithm's config."""
    return {CONFIG.get(name, name): value for name, value in stored.items()}


def spec(stored: Mapping[str, Any]) -> dict[str, Any]:
    """What a run, a checkpoint or a World knows of its task."""
    return {SPEC.get(name, name): value for name, value in stored.items()}


def card(stored: Mapping[str, Any]) -> dict[str, Any]:
    """What a store says of itself."""
    return {CARD.get(name, name): value for name, value in stored.items()}


def named(stored: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """The same values under today's names, and what they are called today where they are names themselves."""
    return {names.get(name, name): _value(names.get(name, name), value) for name, value in stored.items()}


def table(file: str | Path) -> list[dict[str, str]]:
    """The rows of a CSV file, in order."""
    with open(file, newline="", encoding="utf-8") as opened:
        return rows(csv.DictReader(opened))


def rows(stored: Iterable[Mapping[str, str]]) -> list[dict[str, str]]:
    """Rows of a table. Their `options` are written as `name=value name=value`."""
    found = []
    for line in stored:
        names = dict(COLUMNS) if "barrier" not in line else {k: v for k, v in COLUMNS.items() if v != "barrier"}
        row = named(line, names | HEADS)
        if "variant" in row:
            row["variant"] = variant(row["variant"])
        if "options" in row:
            row["options"] = re.sub(r"\b(\w+)=", lambda m: f"{OPTIONS.get(m[1], m[1])}=", row["options"])
        found.append(row)
    return found


def _constraints(stored: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    return {name: named(constraint, CONSTRAINTS) for name, constraint in stored.items()}


def _value(column: str, value: Any) -> Any:
    known = VALUES.get(column, {})
    return known.get(value, value) if isinstance(value, str) else value


def _before_guards(stored: Mapping[str, Any]) -> dict[str, str]:
    """Guard, barrier and execution of an evaluation that is older than guards; nothing of any other."""
    if "guard" in stored or "planner" not in stored:
        return {}
    guard = _BEFORE_GUARDS.get(stored["planner"], "none")
    if guard == "none" and (stored.get("options") or {}).get("plans", 1) > 1:
        guard = "select"
    barrier = "none" if guard == "none" else "analytic"
    return {"guard": guard, "barrier": barrier, "execution": "centralized"}
