"""The table of a results folder: its rows, which must all be of the protocol that bench.json declares, and as CSV.

Ranks, intervals and comparisons are made by `report/board.py` and its neighbours.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ringfence.bench.cells import read_about
from ringfence.errors import UserError
from ringfence.evaluation.table import Row, check, of_references, of_run
from ringfence.training.runs import Run
from ringfence.utils import text

COLUMNS = (
    "task, algorithm, variant, guard, barrier, execution, agents, seed, episodes, return_mean, return_std, "
    "return_norm, cost_mean, cost_norm, cost_safe_start, violation_rate, violation_upper, agent_violation_rate, "
    "unsafe_starts, cost_cvar10, cost_rate, steps_mean, termination_rate, infeasible_rate, ood_rate, train_seconds, "
    "eval_seconds, plan_ms_p50, plan_ms_p99, parameters, run"
).split(", ")
UNGUARDED = {"guard": "none", "barrier": "none", "execution": "centralized"}  # where a result does not say


CELL = re.compile(r"seed-(\d+)(?:-(.+))?")


@dataclass(frozen=True)
class Place:
    """A cell's folder, whether results are there or not."""

    path: Path
    task: str
    job: str  # algorithm[-preset]
    seed: int


def places(out: str | Path) -> list[Place]:
    """The folders of a grid's cells."""
    found = []
    for path in sorted((Path(out) / "cells").glob("*/*/*/")):
        if match := CELL.fullmatch(path.name):
            found.append(Place(path, path.parent.parent.name, path.parent.name, int(match[1])))
    return found


def read(out: str | Path) -> list[Row]:
    """Every evaluation of every cell on the declared resets and at its run's last step, after the reference rows."""
    out = Path(out)
    about = read_about(out)
    files = sorted((out / "reference").glob("*/reference.json"))
    references = [row for file in files for row in of_references(file, file.parent.name)]
    evaluations = [row for place in places(out) for row in _of_cell(place, about["split"])]
    check([*evaluations, *references], about, f"'{out / 'bench.json'}'")
    return references + evaluations


def _of_cell(place: Place, split: str) -> list[Row]:
    """A cell's rows. Settings were chosen on other resets, and of an earlier step training went on: no table is made of
    either."""
    found = of_run(Run(place.path))
    for row in found[:1]:
        for name, here, there in (("task", row.task, place.task), ("seed", row.seed, place.seed)):
            if here != there:
                raise UserError(
                    f"'{place.path / 'config.json'}' names {name} {here}, its folder {there}; a cell was moved: put it "
                    "back or delete it."
                )
    return [row for row in found if row.last and ("@" not in row.name or row.result.get("split") == split)]


def rows(out: str | Path) -> list[dict[str, Any]]:
    """The same as flat rows: a result's fields, and `run`, the folder or file it is from. Of one method and seed there
    may be one."""
    out = Path(out)
    found = read(out)
    if all(row.run is None for row in found):
        raise UserError(f"'{out}' holds no finished cell yet; run `ringfence bench`.")
    seen: dict[tuple[str, str, str, int], Row] = {}
    for one in (row for row in found if row.run is not None):
        key = (one.task, one.algorithm, one.variant, one.seed)
        other = seen.setdefault(key, one)
        if other is not one:
            raise UserError(
                f"'{one.file.parent}' and '{other.file.parent}' are both {' '.join(map(str, key[:3]))} seed {key[3]}, "
                "with other settings; delete the one that is not meant."
            )
    return [_flat(row, out) for row in found]


def _flat(row: Row, out: Path) -> dict[str, Any]:
    of_row = {"algorithm": row.algorithm, "variant": row.variant, "seed": row.seed}
    place = row.file if row.run is None else row.run.path
    return {**UNGUARDED, **row.result, **of_row, "run": str(place.relative_to(out))}


def write_csv(out: str | Path) -> Path:
    """DIR/table.csv, one line per row of `rows`."""
    return text.write_csv(Path(out) / "table.csv", COLUMNS, rows(out))
