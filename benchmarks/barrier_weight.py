"""How strong the barrier should be under the robots' quantile limits, where every tier's data is as often safe, and how
much of the limit the shield should keep in hand: λ and planners on several tiers, on validation resets.

    python benchmarks/barrier_weight.py                      # adds rows to results/tuning/barrier_weight.csv
    python benchmarks/barrier_weight.py --tasks halfcheetah_2x3-medium-quantile --seeds 100
    python benchmarks/barrier_weight.py --summary            # what is in the file, by task and planner

λ = 0 is MADIFF. What is in the file is not made again. A run is trained once and played by each planner.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from pathlib import Path

from _pool import finished
from _rows import append, measured, read

OUT = Path(__file__).resolve().parent.parent / "results" / "tuning" / "barrier_weight.csv"
FIELDS = (
    "task",
    "weight",
    "seed",
    "planner",
    "split",
    "episodes",
    "return",
    "return_norm",
    "cost",
    "avoidable_cost",
    "train_seconds",
)
TASKS = tuple(
    f"{task}-quantile"
    for task in (
        "halfcheetah_2x3-medium",
        "halfcheetah_2x3-good",
        "halfcheetah_2x3-poor",
        "ant_2x4-medium",
        "ant_4x2-poor",
    )
)
WEIGHTS = (1.0, 0.3, 3.0, 0.0)
SEEDS = (100,)
PLANNERS: dict[str, dict] = {
    "shielded": {"planner": "shielded"},
    "shielded, share=1.0": {"planner": "shielded", "share": 1.0},
    "adaptive": {"planner": "adaptive"},
}
LIMIT = 25.0
EPISODES = 10


def one(job: tuple[str, float, int, list[str]]) -> list[dict]:
    """Train one run and play it with the planners that are not in the file; its rows."""
    name, weight, seed, planners = job
    from ringfence import evaluate, tasks, training
    from ringfence.data.make import make

    store, _ = make(tasks.get(name))
    begun = time.perf_counter()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        algorithm, changes = ("icbf", {"barrier_weight": weight}) if weight else ("madiff", {})
        (run,) = training.train(
            algorithm, store, preset="mujoco", seeds=(seed,), changes=changes, out=folder, quiet=True
        )
        seconds = time.perf_counter() - begun
        for planner in planners:
            r = evaluate.evaluate(run, episodes=EPISODES, split="validation", **PLANNERS[planner])
            rows.append(
                {
                    "task": name,
                    "weight": weight,
                    "seed": seed,
                    "planner": planner,
                    "split": r["split"],
                    "episodes": r["episodes"],
                    **measured(r),
                    "train_seconds": round(seconds, 1),
                }
            )
    return rows


def summary(rows: list[dict]) -> None:
    """Every task's rows by planner and λ, all seeds beside each other."""
    found: dict[tuple, list[dict]] = {}
    for r in rows:
        found.setdefault((r["task"], r["planner"], float(r["weight"])), []).append(r)
    for (name, planner, weight), mine in sorted(found.items()):
        told = ", ".join(
            f"{float(r['return']):.0f} at {float(r['cost']):.1f}" for r in sorted(mine, key=lambda r: r["seed"])
        )
        over = "  over" if max(float(r["cost"]) for r in mine) > LIMIT else ""
        print(f"{name}  {planner}  λ {weight}: {told}{over}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="*", default=list(TASKS))
    parser.add_argument("--weights", nargs="*", type=float, default=list(WEIGHTS))
    parser.add_argument("--seeds", nargs="*", type=int, default=list(SEEDS))
    parser.add_argument("--summary", action="store_true")
    a = parser.parse_args()
    if not a.summary:
        done = {(r["task"], float(r["weight"]), int(r["seed"]), r["planner"]) for r in read(OUT)}
        jobs = []
        for t, w, s in itertools.product(a.tasks, a.weights, a.seeds):
            if left := [planner for planner in PLANNERS if (t, w, s, planner) not in done]:
                jobs.append((t, w, s, left))
        for rows in finished(one, jobs):
            for row in rows:
                append(OUT, row, FIELDS)
                print(*(f"{k}={row[k]}" for k in FIELDS), flush=True)
    summary(read(OUT))


if __name__ == "__main__":
    main()
