"""The Simple Spread table: tiers × algorithms × seeds, resumable; rows go to results/simple_spread/table.csv.

    python benchmarks/table.py --tiers expert medium medium-replay random

Runs are trained into runs/ (kept out of the repository); what is committed is one JSON per evaluation, the reference
rows and the table made of them. A finished evaluation is never repeated. Two shares of the tiers may run side by side
with `--threads 1`, one per core; training seconds are then those of one core.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "results" / "simple_spread"
TIERS = ("expert", "medium", "medium-replay", "random")
GUARDED = "guarded"
# (algorithm, preset, evaluations): an evaluation is a named set of planner options
ENTRIES = (
    ("bc", "default", ("plain",)),
    ("bc-safe", "default", ("plain",)),
    ("icbf", "split", ("plain", "plans8", GUARDED)),
    ("icbf", "long", ("plain", GUARDED)),
    ("madiff", "default", ("plain", GUARDED)),
    ("icbf", "paper", ("plain",)),
)
COLUMNS = (
    "task, algorithm, variant, seed, episodes, return_mean, return_std, return_norm, cost_mean, cost_norm, "
    "avoidable_cost, violation_rate, violation_upper, unsafe_starts, cost_cvar10, train_seconds, plan_ms_p50, "
    "plan_ms_p99, parameters"
).split(", ")


def run(tiers: list[str], seeds: int, episodes: int) -> None:
    from ringfence import evaluate, reference, tasks, training
    from ringfence.data.make import make

    for tier in tiers:
        task = tasks.get(f"simple_spread-{tier}")
        store, _ = make(task)
        rows = reference.make(task, store, ROOT / "runs", episodes)
        write(OUT / task.name / "reference.json", rows)
        for algorithm, preset, evaluations in ENTRIES:
            labels = [preset if name == "plain" else f"{preset}+{name}" for name in evaluations]
            files = [OUT / task.name / f"{algorithm}-{v}-seed{k}.json" for v in labels for k in range(seeds)]
            if all(f.exists() for f in files):
                continue  # nothing to measure, so nothing to train
            trained = training.train(
                algorithm, store, preset=preset, seeds=tuple(range(seeds)), out=ROOT / "runs", quiet=False
            )
            for done in trained:
                seed = done.config["seed"]
                for name in evaluations:
                    label = preset if name == "plain" else f"{preset}+{name}"
                    file = OUT / task.name / f"{algorithm}-{label}-seed{seed}.json"
                    if file.exists():
                        continue
                    record = 4 if seed == 0 else 0
                    chosen = {"plans": 8} if name == "plans8" else {"planner": name}
                    result = evaluate.evaluate(done, episodes=episodes, record=record, **chosen)
                    result |= {"config": done.config["config"], "preset": preset}
                    result["command"] = "python benchmarks/table.py"
                    write(file, result)
                    print(
                        f"{task.name} {algorithm} {label} seed {seed}: return {result['return_mean']:.1f} "
                        f"({result['return_norm']:.3f}), cost {result['cost_mean']:.3f}, avoidable "
                        f"{result['avoidable_cost']:.4f}, {result['eval_seconds']:.0f} s",
                        flush=True,
                    )
        table()


def write(file: Path, data: dict) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(".part")
    part.write_text(json.dumps(data))
    part.replace(file)


def table() -> Path:
    """results/simple_spread/table.csv from all JSON files there; one row per evaluation and reference row."""
    rows = []
    for folder in sorted(OUT.glob("simple_spread-*")):
        for file in sorted(folder.glob("*.json")):
            data = json.loads(file.read_text())
            if file.name == "reference.json":
                rows += [{**r, "algorithm": name, "variant": "reference", "seed": 0} for name, r in data.items()]
            else:
                rows.append(data)
    path = OUT / "table.csv"
    part = path.with_suffix(f".{os.getpid()}.part")
    with open(part, "w", newline="") as f:
        writer = csv.DictWriter(f, COLUMNS, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        for r in rows:
            writer.writerow({k: f"{v:.6g}" if isinstance(v := r.get(k, ""), float) else v for k in COLUMNS})
    part.replace(path)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tiers", nargs="+", default=list(TIERS), choices=TIERS)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--threads", type=int, default=0, help="threads of XLA; 0: all cores")
    parser.add_argument("--only-table", action="store_true", help="make table.csv from the results that are there")
    a = parser.parse_args()
    if a.threads and "RINGFENCE_THREADS_SET" not in os.environ:
        flags = f"--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads={a.threads}"
        environment = {**os.environ, "XLA_FLAGS": flags, "RINGFENCE_THREADS_SET": "1"}
        sys.exit(subprocess.run([sys.executable, *sys.argv], env=environment).returncode)
    if not a.only_table:
        run(a.tiers, a.seeds, a.episodes)
    print(table())


if __name__ == "__main__":
    main()
