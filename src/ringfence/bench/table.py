"""The flat table of a results folder: one row per evaluation and reference, traceable to its run folder.

Ranks, intervals and comparisons are made by `report/board.py` and its neighbours.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ringfence.bench.cells import read_about
from ringfence.errors import UserError
from ringfence.evaluation import reference
from ringfence.evaluation.protocol import of_last_step
from ringfence.training.runs import Run
from ringfence.utils import csvs

NEEDED = ("split", "protocol", "episodes", "task", "algorithm", "seed", "variant", "constants")  # of every evaluation
COLUMNS = (
    "task, algorithm, variant, guard, barrier, execution, agents, seed, episodes, return_mean, return_std, "
    "return_norm, cost_mean, cost_norm, cost_safe_start, violation_rate, violation_upper, agent_violation_rate, "
    "unsafe_starts, cost_cvar10, cost_rate, steps_mean, termination_rate, infeasible_rate, ood_rate, train_seconds, "
    "eval_seconds, plan_ms_p50, plan_ms_p99, parameters, run"
).split(", ")
UNGUARDED = {"guard": "none", "barrier": "none", "execution": "centralized"}  # where a result does not say

Row = dict[str, Any]


def rows(out: str | Path, may_be_empty: bool = False) -> list[Row]:
    """Every evaluation of every cell, and the reference rows; mixed protocols are refused, naming the files."""
    out = Path(out)
    about = read_about(out)
    references = list(_references(out))
    evaluations = list(_evaluations(out, about))
    if not may_be_empty and not evaluations:
        raise UserError(f"'{out}' holds no finished cell yet; run `ringfence bench`.")
    return references + evaluations


def _references(out: Path) -> Iterator[Row]:
    for file in sorted((out / "reference").glob("*/reference.json")):
        where = {"variant": "reference", "seed": 0, "run": str(file.relative_to(out))}
        for name, result in reference.read(file).items():
            yield {**UNGUARDED, **result, "algorithm": name, **where}


def _evaluations(out: Path, about: Row) -> Iterator[Row]:
    constants: dict[str, tuple[Path, dict]] = {}  # by task: the first file, and what it was normalised with
    seen: dict[tuple, Path] = {}
    for file in sorted((out / "cells").glob("*/*/[!.]*/results.json")):
        run = Run(file.parent)
        config = run.config
        for variant, result in run.results.items():
            if lacking := [name for name in NEEDED if name not in result]:
                raise UserError(f"'{file}' tells no {lacking[0]} of {variant}; evaluate that run again.")
            if result["split"] != about["split"] or not of_last_step(result, config["config"]):
                continue  # settings were chosen there, or training went on; no table is made of it
            _check_protocol(file, result, about, out)
            _check_run(file, result, config)
            first, others = constants.setdefault(result["task"], (file, result["constants"]))
            if others != result["constants"]:
                raise UserError(f"'{file}' and '{first}' normalise {result['task']} differently; evaluate one again.")
            _check_once(file.parent, result, seen)
            yield {**UNGUARDED, **result, "run": str(file.parent.relative_to(out))}


def _check_protocol(file: Path, result: Row, about: Row, out: Path) -> None:
    for name in ("protocol", "episodes"):
        if result[name] != about[name]:
            raise UserError(
                f"'{file}' has {name}={result[name]}, '{out / 'bench.json'}' {about[name]}; one table takes one "
                "protocol: evaluate that run again or move it away."
            )


def _check_run(file: Path, result: Row, config: Row) -> None:
    for name in ("task", "algorithm", "seed"):
        if result[name] != config[name]:
            raise UserError(f"'{file}' is of {name} {result[name]!r}, its run of {config[name]!r}; evaluate it again.")


def _check_once(folder: Path, result: Row, seen: dict[tuple, Path]) -> None:
    key = (result["task"], result["algorithm"], result["variant"], result["seed"])
    other = seen.setdefault(key, folder)
    if other != folder:
        raise UserError(
            f"'{folder}' and '{other}' are both {' '.join(map(str, key[:3]))} seed {key[3]}, with other "
            "settings; delete the one that is not meant."
        )


def write_csv(out: str | Path) -> Path:
    """DIR/table.csv, one line per row of `rows`."""
    return csvs.write_csv(Path(out) / "table.csv", COLUMNS, rows(out))
