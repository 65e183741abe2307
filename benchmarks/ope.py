"""How well logs alone tell what a simulator would: every policy of a suite, evaluated by logs that it was not trained
on, beside what it did in the simulator.

    ringfence bench guards --out DIR         # policies with their checkpoints
    python benchmarks/ope.py DIR             # writes results/judging.csv and docs/ope.md; 30 s a policy and guard
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
from readme import put
from scipy.stats import spearmanr

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.evaluation.ope import OPEResult, ope
from ringfence.training import worlds
from ringfence.training.runs import Run
from ringfence.utils import stored
from ringfence.utils.files import whole

OUT = Path(__file__).resolve().parent.parent / "results" / "judging.csv"
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
# What each number is to tell, and whether more of it is to mean more of that.
TELLS = {
    "played_return": ("true_return", "return, played in the World of the logs"),
    "played_danger": ("true_cost", "dangerous steps, played in the World of the logs"),
    "predicted_violation_rate": ("true_cost", "share of states from which danger is predicted"),
    "margin_violation_rate": ("true_cost", "share of states whose predicted margin is below the calibrated one"),
    "cost": ("true_cost", "fitted Q evaluation of cost"),
    "return": ("true_return", "fitted Q evaluation of return"),
    "ood_rate": ("true_cost", "share of states where the World does not know"),
    "action_rmse": ("true_cost", "distance from the logged actions"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--tasks", nargs="*")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--without", default="", help="variants that hold this word, e.g. full, which takes minutes")
    args = parser.parse_args()
    rows = stored.table(OUT) if OUT.exists() else []
    done = {tuple(r[k] for k in HEAD[:4]) for r in rows}
    for cell in sorted((args.folder / "cells").glob("*/*/seed-*")) if args.folder else []:
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
            rows.append(dict(zip(HEAD, [*key, *(f"{v:.5g}" for v in numbers)])))
            print(*rows[-1].values(), flush=True)
            with whole(OUT) as temporary, temporary.open("w") as f:
                writer = csv.DictWriter(f, HEAD, lineterminator="\n")
                writer.writeheader()
                writer.writerows(rows)
    put("docs/ope.md", "ranks", ranks(rows))


def _numbers(result: OPEResult) -> list[float]:
    return [of(result) for of in NUMBERS.values()]


def ranks(rows: list[dict]) -> str:
    """A line per number, a column per task: Spearman's correlation with what the simulator says."""
    names = list(dict.fromkeys(r["task"] for r in rows))
    heads = [f"{name} ({sum(r['task'] == name for r in rows)} rows)" for name in names]
    lines = ["| number | is to rank | " + " | ".join(heads) + " |", "|---" * (2 + len(names)) + "|"]
    for number, (truth, words) in TELLS.items():
        cells = []
        for name in names:
            x, y = (np.array([float(r[k]) for r in rows if r["task"] == name]) for k in (number, truth))
            rank = spearmanr(x, y).statistic
            cells.append("–" if np.isnan(rank) else f"{rank:.2f}")
        lines.append(f"| {words} | {'cost' if truth == 'true_cost' else 'return'} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
