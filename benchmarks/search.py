"""The same budget of search for every algorithm: four settings each, one seed, the medium tier, validation resets.

    python benchmarks/search.py              # appends to results/tuning/search.csv what is missing there
    python benchmarks/search.py --summary    # ranks of what is there

Setting 0 is the algorithm's preset. It was the published one where there is one, until another did clearly better:
omar's and ma-cql's, whose study's setting is then the first of the others. All were written down before the first run,
but for what keeps omar's and ma-cql's actors from saturating. Seed 100 trains no row of any table, and evaluation on
test resets never sees validation resets. Learners that know no cost are ranked by return; safe ones by the rule of the
leaderboard: those whose mean cost is within the limit first, by return, then the others, by lower cost.
"""

from __future__ import annotations

import argparse
import csv
import json
import multiprocessing
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

OUT = Path(__file__).resolve().parent.parent / "results" / "tuning" / "search.csv"
TIERS = ("medium",)
SEED, EPISODES, LIMIT = 100, 100, 1.0
FIELDS = (
    "algorithm",
    "preset",
    "setting",
    "changes",
    "task",
    "seed",
    "split",
    "episodes",
    "return",
    "return_norm",
    "cost",
    "avoidable_cost",
    "train_seconds",
)
# OMAR's coefficients are per tier, in its study too; so what keeps its actors alive was tried on every tier.
FURTHER = {"omar": ("expert", "medium-replay", "random")}
SAFE = ("bc-safe", "ma-td3bc-lag", "fisor", "icbf")

# Algorithm and preset ("": the tier's) -> changes of settings 1 to 3.
SETTINGS: dict[tuple[str, str], list[dict]] = {
    ("bc", ""): [{"width": 256}, {"steps": 8_000}, {"lr": 3e-4, "steps": 8_000}],
    ("bc-safe", ""): [{"cost_limit": 0.5}, {"cost_limit": 2.0}, {"steps": 8_000}],
    ("ma-td3bc", ""): [{"alpha": 1.0}, {"alpha": 5.0}, {"centralised_critic": True}],
    ("ma-td3bc-lag", ""): [{"multiplier_rate": 0.1}, {"alpha": 10.0}, {"alpha": 10.0, "multiplier_rate": 0.1}],
    ("fisor", ""): [{"temperature_reward": 1.0}, {"expectile_danger": 0.7}, {"discount": 0.95}],
    ("ma-cql", ""): [  # the study's learning rate first: its actors saturate, which is why the preset is another
        {"lr": 0.01, "logit_penalty": 0.0},
        {"lr": 0.01, "logit_penalty": 0.0, "cql_weight": 1.0},
        {"lr": 0.01, "logit_penalty": 0.0, "cql_weight": 20.0},
        {"logit_penalty": 0.0},
    ],
    ("omar", ""): [  # without the penalty first: some agent of most runs saturates at the study's rate
        {"logit_penalty": 0.0},
        {"logit_penalty": 0.0, "cql_weight": 1.0},
        {"logit_penalty": 0.0, "coefficient": 0.7},
        {"logit_penalty": 0.0, "lr": 3e-3},
    ],
    ("madiff", "default"): [{"lr": 1e-3}, {"discount": 0.95}, {"diffusion_steps": 50}],
    ("icbf", "split"): [{"lr": 1e-3}, {"discount": 0.95}, {"barrier_weight": 10.0}],
}


def one(job: tuple) -> dict:
    """Train and play one setting; a row of the file."""
    algorithm, preset, number, changes, tier = job
    from ringfence import evaluate, tasks, training
    from ringfence.data.make import make

    task = tasks.get(f"simple_spread-{tier}")
    store, _ = make(task)
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        (run,) = training.train(
            algorithm, store, preset=preset or None, seeds=(SEED,), changes=changes, out=folder, quiet=True
        )
        seconds = time.perf_counter() - begun
        r = evaluate.evaluate(run, episodes=EPISODES, split="validation")
    return {
        "algorithm": algorithm,
        "preset": preset,
        "setting": number,
        "changes": json.dumps(changes),
        "task": task.name,
        "seed": SEED,
        "split": r["split"],
        "episodes": r["episodes"],
        "return": round(r["return_mean"], 2),
        "return_norm": round(r["return_norm"], 4),
        "cost": round(r["cost_mean"], 4),
        "avoidable_cost": round(r["avoidable_cost"], 4),
        "train_seconds": round(seconds, 1),
    }


def pin(cores) -> None:
    """Give a worker one core of its own: small networks gain nothing from more."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {cores.get()})


def rows_of(file: Path) -> list[dict]:
    return list(csv.DictReader(file.open())) if file.exists() else []


def ranks(rows: list[dict]) -> dict[tuple, list[tuple[float, dict]]]:
    """(algorithm, preset) -> [(sum of ranks over tiers, {tier: row})] of complete settings, best first."""
    found: dict[tuple, dict] = {}
    for r in rows:
        found.setdefault((r["algorithm"], r["preset"]), {}).setdefault(int(r["setting"]), {})[r["task"]] = r
    out = {}
    for key, settings in found.items():
        whole = {k: v for k, v in settings.items() if all(f"simple_spread-{t}" in v for t in TIERS)}

        def merit(row: dict, safe: bool = key[0] in SAFE) -> tuple:
            gain, cost = float(row["return"]), float(row["cost"])
            return ((cost > LIMIT, cost if cost > LIMIT else -gain)) if safe else (False, -gain)

        total = dict.fromkeys(whole, 0)
        for tier in TIERS:
            name = f"simple_spread-{tier}"
            for place, k in enumerate(sorted(whole, key=lambda k: merit(whole[k][name]))):
                total[k] += place
        out[key] = [(total[k], whole[k]) for k in sorted(whole, key=lambda k: (total[k], k))]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--algorithms", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--summary", action="store_true")
    a = parser.parse_args()
    done = {(r["algorithm"], r["preset"], int(r["setting"]), r["task"]) for r in rows_of(a.out)}
    if not a.summary:
        jobs = [
            (name, preset, number, changes, tier)
            for (name, preset), others in SETTINGS.items()
            if not a.algorithms or name in a.algorithms
            for number, changes in enumerate([{}, *others])
            for tier in (*TIERS, *(FURTHER.get(name, ()) if number in (0, 1, 4) else ()))
            if (name, preset, number, f"simple_spread-{tier}") not in done
        ]
        spawn = multiprocessing.get_context("spawn")
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count()))
        queue = spawn.Queue()
        for core in cores:
            queue.put(core)
        a.out.parent.mkdir(parents=True, exist_ok=True)
        with ProcessPoolExecutor(len(cores), spawn, pin, (queue,)) as pool:
            for future in as_completed([pool.submit(one, job) for job in jobs]):
                row = future.result()
                fresh = not a.out.exists()
                with a.out.open("a", newline="") as file:
                    writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
                    if fresh:
                        writer.writeheader()
                    writer.writerow(row)
                print(*(f"{k}={row[k]}" for k in FIELDS[:4] + FIELDS[4:5] + FIELDS[8:]), flush=True)
    for (name, preset), places in ranks(rows_of(a.out)).items():
        print(f"\n{name} {preset}")
        for total, rows in places:
            told = next(iter(rows.values()))
            values = ", ".join(f"{t}: {r['return']} / {r['cost']}" for t, r in sorted(rows.items()))
            print(f"  {total}  setting {told['setting']} {told['changes']}  return / cost {values}")


if __name__ == "__main__":
    main()
