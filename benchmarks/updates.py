"""Whether actor-critics on robots earn less than was published for want of updates: one run, looked at as it goes on.

    python benchmarks/updates.py            # writes results/tuning/updates.csv; an hour on one core
    python benchmarks/updates.py --table    # only prints its rows as a table

Rates are constant, so a run looked at after 10 000 updates is the run that ends there. Seed 100, which trains no row,
20 validation resets. *Value* is what the critics say of the policy's own actions in logged states; *heard* the
discounted sum of logged rewards that the policy of the logs went on to get there, which a value of a policy as good
should reach.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from _rows import append, read

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.loading.resolve import load
from ringfence.logs.windows import returns_to_go
from ringfence.training import loop
from ringfence.training.runs import Run

OUT = Path(__file__).resolve().parent.parent / "results" / "tuning" / "updates.csv"
FIELDS = ("task", "algorithm", "seed", "updates", "train_seconds", "return", "return_norm", "cost", "falls", "value")
FIELDS += ("heard",)
# By algorithm and task, after how many updates; the first number is the preset's.
RUNS = {
    ("ma-td3bc", "ant_2x4-good"): (10_000, 20_000, 40_000, 80_000, 160_000),
    ("ma-td3bc", "halfcheetah_2x3-good"): (10_000, 40_000, 160_000),
    ("omar", "halfcheetah_2x3-good"): (6_000, 12_000, 24_000, 48_000),
}
SEED, EPISODES = 100, 20
DISCOUNT = 0.99  # of the presets


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--of", nargs="+", default=[f"{a}:{t}" for a, t in RUNS], help="ALGORITHM:TASK")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--table", action="store_true", help="only print the rows as a table")
    a = parser.parse_args()
    for algorithm, name in (tuple(x.split(":")) for x in a.of if not a.table):
        there = {int(r["updates"]) for r in read(a.out) if (r["algorithm"], r["task"]) == (algorithm, name)}
        if there < set(RUNS[algorithm, name]):
            measure(algorithm, name, there, a.out)
    print(table(read(a.out)))


def measure(algorithm: str, name: str, there: set[int], out: Path) -> None:
    """Rows as the run passes each number of updates."""
    task, wanted = registry.get(name), RUNS[algorithm, name]
    store, chunk = make(task)[0], wanted[0] // 2
    heard = returns_to_go(store.rewards, store.lengths, DISCOUNT).mean()
    with tempfile.TemporaryDirectory() as folder:
        run = Run(Path(folder) / "run")

        def look(updates: int) -> None:
            if updates not in wanted or updates in there:
                return
            found, _ = evaluate_policy(load(run, checkpoint=updates)[1], task, EPISODES, "validation", 0)
            logged = [r for r in run.metrics if r["step"] <= updates]
            row = dict(zip(FIELDS, (name, algorithm, SEED, updates, round(sum(r["seconds"] for r in logged)))))
            row |= {k: f"{found[v]:.5g}" for k, v in (("return", "return_mean"), ("return_norm", "return_norm"))}
            row |= {"cost": f"{found['cost_mean']:.4g}", "falls": f"{found['termination_rate']:.3g}"}
            row |= {"value": f"{logged[-1].get('value', float('nan')):.4g}", "heard": f"{heard:.4g}"}
            print(", ".join(f"{k} {v}" for k, v in row.items()), flush=True)
            append(out, row, FIELDS)

        loop.train(
            algorithm,
            store,
            seeds=(SEED,),
            quiet=True,
            changes={"num_updates": wanted[-1]},
            chunk=chunk,
            checkpoint_every=wanted[0],
            on_chunk=lambda step, _: look(step - chunk),  # what was saved after the chunk before
            folder=lambda seed: run.path,
        )
        look(wanted[-1])


def table(rows: list[dict]) -> str:
    """A line per number of updates."""
    out = ["| algorithm | task | updates | return | steps above the limit | fell | value | heard |", "|---" * 8 + "|"]
    for r in rows:
        part = [f"`{r['algorithm']}`", f"`{r['task']}`", f"{int(r['updates']):,}", f"{float(r['return']):.0f}"]
        part += [f"{float(r['cost']):.0f}", f"{100 * float(r['falls']):.0f} %"]
        out.append("| " + " | ".join([*part, f"{float(r['value']):.0f}", f"{float(r['heard']):.0f}"]) + " |")
    return "\n".join(out)


if __name__ == "__main__":
    main()
