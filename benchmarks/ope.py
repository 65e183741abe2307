"""How well logs alone tell what a simulator would: every policy of a suite, evaluated by logs that it was not trained
on, beside what it did in the simulator.

    ringfence bench guards --out DIR         # policies with their checkpoints
    python benchmarks/ope.py DIR             # writes results/judging.csv; 30 s a policy and guard
"""

from __future__ import annotations

import argparse
from pathlib import Path

from common import RESULTS, append, read

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.evaluation.ope import OPEResult, ope
from ringfence.training import worlds
from ringfence.training.runs import Run

OUT = RESULTS / "judging.csv"
EPISODES, LOGS_SEED = 2000, 7  # of the logs that evaluate
NUMBERS = {
    "played_return": lambda result: result.rollout.returns.mean,
    "played_danger": lambda result: result.rollout.unsafe_steps.mean,
    "predicted_violation_rate": lambda result: result.safety.predicted_violation_rate,
    "margin_violation_rate": lambda result: result.safety.margin_violation_rate,
    "return": lambda result: result.values.returns.mean,
    "cost": lambda result: result.values.costs.mean,
    "ood_rate": lambda result: result.behaviour.ood_rate,
    "action_rmse": lambda result: result.behaviour.action_rmse,
}
HEAD = ("task", "algorithm", "variant", "seed", "true_return", "true_cost", *NUMBERS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tasks", nargs="*")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--without", default="", help="variants that hold this word, e.g. full, which takes minutes")
    args = parser.parse_args()
    done = {tuple(r[k] for k in HEAD[:4]) for r in read(OUT)}
    for cell in sorted((args.folder / "cells").glob("*/*/seed-*")):
        run = Run(cell)
        config = run.config
        if (args.tasks and config["task"] not in args.tasks) or config["seed"] >= args.seeds or not run.checkpoints():
            continue
        task = registry.get(config["task"])
        store = make(task, EPISODES * task.env.episode_length, LOGS_SEED)[0]
        world = worlds.fit(store, seed=1)
        for variant, result in run.results.items():
            key = (config["task"], config["algorithm"], variant, str(config["seed"]))
            if args.without and args.without in variant:
                continue
            if key in done or (result.get("execution") == "decentralized" and not task.homogeneous):
                continue
            how = {"planner": result["planner"]}
            if result["guard"] != "none":
                how |= {"guard": result["guard"], "barrier": result["barrier"], **result["guard_options"]}
            found = ope(run, store, evaluation_world=world, compare=False, **how)
            numbers = [result["return_mean"], result["cost_safe_start"], *_numbers(found)]
            append(OUT, dict(zip(HEAD, [*key, *(f"{v:.5g}" for v in numbers)])))


def _numbers(result: OPEResult) -> list[float]:
    return [of(result) for of in NUMBERS.values()]


if __name__ == "__main__":
    main()
