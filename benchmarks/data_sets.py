"""What is in every data set of the tasks, the numbers of docs/data.md.

python benchmarks/data_sets.py            # writes results/data.csv; tasks that are named are added or made anew
"""

from __future__ import annotations

import argparse
from pathlib import Path

from common import read, write

from ringfence.datasets import registry
from ringfence.datasets.audit import disagreement
from ringfence.datasets.make import make

OUT = Path(__file__).resolve().parent.parent / "results" / "data.csv"


def row(name: str) -> dict:
    """Returns, costs and limits of a task's whole data set."""
    task = registry.get(name)
    store, _ = make(task)
    returns, costs, lengths = store.returns, store.episode_costs, store.lengths
    return {
        "task": name,
        "transitions": store.steps,
        "episodes": store.episodes,
        "steps_mean": round(float(lengths.mean()), 1),
        "return_mean": round(float(returns.mean()), 2),
        "return_std": round(float(returns.std()), 2),
        "return_min": round(float(returns.min()), 2),
        "return_max": round(float(returns.max()), 2),
        "cost_mean": round(float(costs.mean()), 3),
        "unsafe": round(float((costs > 0).mean()), 4),  # share of episodes with any cost
        "terminated": round(float(store.episode_terminated.mean()), 4),
        "disagreement": round(disagreement(store, task), 4),  # share of steps whose cost is not what the hazard says
        "speed_limit": store.card.extra.get("speed_limit", ""),
        "return_ceiling": round(store.card.extra["return_ceiling"], 1) if "return_ceiling" in store.card.extra else "",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tasks", nargs="*", help="all by default")
    wanted = parser.parse_args().tasks or list(registry.TASKS)
    found = {r["task"]: r for r in read(OUT)}
    for name in wanted:
        found[name] = row(name)
        print(*(f"{k}={v}" for k, v in found[name].items()), flush=True)
        write(OUT, [found[name] for name in registry.TASKS if name in found])


if __name__ == "__main__":
    main()
