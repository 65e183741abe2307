"""How strongly the critic that steers plans should read velocities, on Simple Spread's validation resets.

    python benchmarks/critic.py                  # every tier, to results/tuning/critic.csv; about 15 minutes

MADIFF (seed 100, which trains no row of any table) is trained once per tier; as it is conditioned on the return, its
plans do not depend on the critic. Then a critic is fitted for every weight of the velocities and the guarded planner
is steered by it. What is in the file is not made again.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path

from _rows import append, measured, read

from ringfence import evaluate, tasks, training
from ringfence.data.make import make
from ringfence.windows import WindowData

OUT = Path(__file__).resolve().parent.parent / "results" / "tuning" / "critic.csv"
FIELDS = ("task", "algorithm", "seed", "weight", "planner", "split", "episodes", "return", "return_norm", "cost")
FIELDS += ("avoidable_cost",)
TIERS = ("expert", "medium", "medium-replay", "random")
WEIGHTS = (1.0, 0.5, 0.25, 0.125, 0.0)
SEED, EPISODES = 100, 200


def rows_of(tier: str, weights: list[float]):
    """A row of the file for every weight."""
    task = tasks.get(f"simple_spread-{tier}")
    store, _ = make(task)
    with tempfile.TemporaryDirectory() as folder:
        (run,) = training.train("madiff", store, seeds=(SEED,), out=folder, quiet=True)
        job, policy = evaluate.load(run, planner="guarded")
    c, view = job.config, job.feature_map
    slow = [w < 1 for w in view.critic_weight]
    for weight in weights:
        told = tuple(weight if s else 1.0 for s in slow)
        data = WindowData(store, view, c.discount, c.condition, c.horizon, c.critic_updates, critic_weight=told)
        steered = dataclasses.replace(policy, critic=data.critic)
        r, _ = evaluate.evaluate_policy(steered, task, EPISODES, "validation", SEED)
        yield {
            "task": task.name,
            "algorithm": "madiff",
            "seed": SEED,
            "weight": weight,
            "planner": "guarded",
            "split": "validation",
            "episodes": EPISODES,
            **measured(r),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tiers", nargs="*", choices=TIERS, default=list(TIERS))
    a = parser.parse_args()
    done = {(r["task"], float(r["weight"])) for r in read(OUT)}
    for tier in a.tiers:
        left = [w for w in WEIGHTS if (f"simple_spread-{tier}", w) not in done]
        for row in rows_of(tier, left) if left else ():
            append(OUT, row, FIELDS)
            print(*(f"{k}={row[k]}" for k in ("task", "weight", "return", "return_norm", "cost")), flush=True)


if __name__ == "__main__":
    main()
