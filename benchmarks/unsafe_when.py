"""When robots are unsafe under a guard that misses their limit, and whether it knew.

    python benchmarks/unsafe_when.py      # writes results/unsafe_when.csv; ten minutes

Cloning, seed 0, 20 test episodes. `first_10` and `first_100` are the unsafe steps of an episode among its first ten and
hundred; `known` is the share of the unsafe steps for which the guard had said that no action keeps its margin.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from common import write

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.loading.resolve import load
from ringfence.training import loop, worlds

OUT = Path(__file__).resolve().parent.parent / "results" / "unsafe_when.csv"
TASKS = ("halfcheetah_2x3-poor-quantile", "ant_2x4-poor-quantile")
EPISODES = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT)
    write(parser.parse_args().out, [row for name in TASKS for row in rows(name)])


def rows(name: str) -> list[dict]:
    task = registry.get(name)
    store, _ = make(task)
    world = worlds.fit(store)
    made = []
    with tempfile.TemporaryDirectory() as folder:
        (run,) = loop.train("bc", store, seeds=(0,), out=folder, quiet=True)
        for guard, barrier in (("none", ""), ("adapt", "analytic"), ("adapt", "learned"), ("full", "learned")):
            how = {} if guard == "none" else {"guard": guard, "barrier": barrier, "world": world}
            played = evaluate_policy(load(run, **how)[1], task, EPISODES)[1]
            unsafe = played["costs"] > 0
            row = {"task": name, "guard": guard, "barrier": barrier, "episodes": EPISODES}
            for key, steps in (("cost", unsafe), ("first_10", unsafe[:, :10]), ("first_100", unsafe[:, :100])):
                row[key] = f"{steps.sum(1).mean():.4g}"
            row["known"] = f"{played['infeasible'][unsafe].mean():.3g}" if guard != "none" else ""
            row["verdict"] = f"{world.card.verdict.word}: {'; '.join(world.card.verdict.reasons)}"
            print(", ".join(f"{k} {v}" for k, v in row.items()), flush=True)
            made.append(row)
    return made


if __name__ == "__main__":
    main()
