"""Fills the column "plan ms" of a board: one joint action in one environment, seed 0 of every method on the first task.

    python benchmarks/latency.py             # adds plan_ms_p50 and plan_ms_p99 to results.json of those cells

To be run on a quiet machine, after the grid, where the cells' checkpoints are.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ringfence.datasets import registry
from ringfence.evaluation import latency
from ringfence.loading.resolve import load
from ringfence.training.runs import Run

RESULTS = Path(__file__).resolve().parent.parent / "results" / "simple_spread"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--task", default="simple_spread-expert")
    a = parser.parse_args()
    for folder in sorted((a.results / "cells" / a.task).glob("*/seed-0-*")):
        run = Run(folder)
        if not run.checkpoints():
            print(f"{folder}: no checkpoint here, left as it is")
            continue
        for variant, result in run.results.items():
            guard = {k: result[k] for k in ("guard", "barrier", "execution")} | result["guard_options"]
            guard = guard if result.get("guard", "none") != "none" else {}
            _, policy = load(run, **result["options"], **guard)
            took = latency.plan_latency(policy, registry.get(a.task))
            run.add_result(variant, result | took)
            print(f"{folder.parent.name} {variant}: {took['plan_ms_p50']:.2f} ms, p99 {took['plan_ms_p99']:.2f}")


if __name__ == "__main__":
    main()
