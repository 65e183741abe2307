"""The flat table of a results folder: one row per evaluation and reference, traceable to its run folder.

Ranks, intervals and comparisons are made by `report/board.py` and its neighbours.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

from ringfence.bench.cells import read_about
from ringfence.errors import UserError
from ringfence.evaluation.protocol import of_last_step
from ringfence.training.runs import Run
from ringfence.utils import schemas
from ringfence.utils.escape import spreadsheet
from ringfence.utils.files import whole

TOLD = ("split", "protocol", "episodes", "task", "algorithm", "seed", "variant", "constants")  # by every evaluation
COLUMNS = (
    "task, algorithm, variant, guard, danger, sight, agents, seed, episodes, return_mean, return_std, return_norm, "
    "cost_mean, cost_norm, avoidable_cost, violation_rate, violation_upper, agent_violation_rate, unsafe_starts, "
    "cost_cvar10, cost_rate, steps_mean, termination_rate, infeasible, strange, train_seconds, eval_seconds, "
    "plan_ms_p50, plan_ms_p99, parameters, run"
).split(", ")


def rows(out: str | Path, may_be_empty: bool = False) -> list[dict]:
    """Every evaluation of every cell, and the reference rows; mixed protocols are refused, naming the files."""
    out = Path(out)
    about = read_about(out)
    found, constants, seen = [], {}, {}
    for file in sorted((out / "reference").glob("*/reference.json")):
        for name, r in schemas.read(file, schemas.References, "has damaged reference rows; delete that file").items():
            found.append(
                {
                    **guard_of({}),
                    **r,
                    "algorithm": name,
                    "variant": "reference",
                    "seed": 0,
                    "run": str(file.relative_to(out)),
                }
            )
    for file in sorted((out / "cells").glob("*/*/[!.]*/results.json")):
        run = Run(file.parent)
        for variant, r in run.results.items():
            if lacking := [name for name in TOLD if name not in r]:
                raise UserError(f"'{file}' tells no {lacking[0]} of {variant}; evaluate that run again.")
            if r["split"] != about["split"] or not of_last_step(r, run.config["config"]):
                continue  # settings were chosen there, or training went on; no table is made of it
            for name in ("protocol", "episodes"):
                if r[name] != about[name]:
                    raise UserError(
                        f"'{file}' has {name}={r[name]}, '{out / 'bench.json'}' {about[name]}; one table takes one "
                        "protocol: evaluate that run again or move it away."
                    )
            told = run.config
            for name in ("task", "algorithm", "seed"):
                if r[name] != told[name]:
                    raise UserError(f"'{file}' is of {name} {r[name]!r}, its run of {told[name]!r}; evaluate it again.")
            first = constants.setdefault(r["task"], (file, r["constants"]))
            if first[1] != r["constants"]:
                raise UserError(f"'{file}' and '{first[0]}' normalise {r['task']} differently; evaluate one again.")
            key = r["task"], r["algorithm"], r["variant"], r["seed"]
            other = seen.setdefault(key, file.parent)
            if other != file.parent:
                raise UserError(
                    f"'{file.parent}' and '{other}' are both {' '.join(map(str, key[:3]))} seed {key[3]}, with other "
                    "settings; delete the one that is not meant."
                )
            found.append({**guard_of(r), **r, "run": str(file.parent.relative_to(out))})
    if not may_be_empty and not any(r["variant"] != "reference" for r in found):
        raise UserError(f"'{out}' holds no finished cell yet; run `ringfence bench`.")
    return found


# What planners that checked their own actions by the formula did, before guards were apart from them.
_OLD = {"guarded": "shield", "shielded": "shield", "adaptive": "adapt"}


def guard_of(result: dict) -> dict[str, str]:
    """Guard, danger and sight of a result that is older than guards."""
    options, guard = result.get("options") or {}, _OLD.get(result.get("planner", ""), "none")
    if guard == "none" and options.get("plans", 1) > 1:
        guard = "select"
    return {"guard": guard, "danger": "none" if guard == "none" else "formula", "sight": "all"}


def write_csv(out: str | Path) -> Path:
    """DIR/table.csv, one line per row of `rows`."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for r in rows(out):
        told = {k: f"{v:.6g}" if isinstance(v := r.get(k, ""), float) else spreadsheet(v) for k in COLUMNS}
        writer.writerow(told)
    path = Path(out) / "table.csv"
    with whole(path) as temporary:
        temporary.write_text(buffer.getvalue())
    return path
