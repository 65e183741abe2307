"""How long forward dynamics has to be fitted: its error in the own velocity one step ahead, with logged actions, for
several budgets. The fit sees 95 % of the episodes, the error is of the others.

    python benchmarks/dynamics.py                     # adds rows to results/tuning/dynamics.csv
    python benchmarks/dynamics.py --tasks ant_2x4-good
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax
import numpy as np
from _rows import append, read

from ringfence import tasks
from ringfence.data.make import make
from ringfence.dynamics import fit_dynamics, foresee
from ringfence.windows import WindowData

OUT = Path(__file__).resolve().parent.parent / "results" / "tuning" / "dynamics.csv"
FIELDS = ("task", "width", "updates", "entry", "deviation", "rms", "error_0.9", "error_0.99", "seconds")
TASKS = ("simple_spread-medium", "halfcheetah_2x3-poor", "ant_2x4-medium")
BUDGETS = ((128, 2_000), (128, 8_000), (128, 40_000), (256, 40_000))
STEPS = 50_000


def rows_of(name: str, budgets: list[tuple[int, int]]):
    """A row of the file for every budget: errors in units of the entry, and what it deviates by."""
    task = tasks.get(name)
    store, _ = make(task)
    view = task.feature_map("pruned", store)
    kept = np.arange(store.episodes) % 20 > 0
    seen, others = (WindowData(store.select(pick), view, 0.9).arrays for pick in (kept, ~kept))
    entry = next(i for i, n in enumerate(view.names) if n in ("own.vx", "torso.vx"))
    step = np.random.default_rng(0).integers(0, len(others["row"]), STEPS)
    before, after = (others["features"][others["row"][step] + k] for k in (0, 1))
    for width, updates in budgets:
        begun = time.perf_counter()
        fitted = fit_dynamics(
            seen["features"], seen["actions"], seen["row"], jax.random.key(0), updates, width, view.joint
        )
        jax.block_until_ready(fitted)
        seconds = time.perf_counter() - begun
        error = np.abs(np.asarray(foresee(fitted, before, others["actions"][step], view.joint) - after))[..., entry]
        yield {
            "task": name,
            "width": width,
            "updates": updates,
            "entry": view.names[entry],
            "deviation": round(float(np.asarray(after)[..., entry].std()), 4),
            "rms": round(float(np.sqrt((error**2).mean())), 5),
            "error_0.9": round(float(np.quantile(error, 0.9)), 5),
            "error_0.99": round(float(np.quantile(error, 0.99)), 5),
            "seconds": round(seconds, 1),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="*", default=list(TASKS))
    a = parser.parse_args()
    done = {(r["task"], int(r["width"]), int(r["updates"])) for r in read(OUT)}
    for name in a.tasks:
        left = [b for b in BUDGETS if (name, *b) not in done]
        for row in rows_of(name, left) if left else ():
            append(OUT, row, FIELDS)
            print(*(f"{k}={row[k]}" for k in FIELDS), flush=True)


if __name__ == "__main__":
    main()
