"""Return against cost as the limit moves: what is trained anew for every limit, and one model whose guard is told it.

    python benchmarks/frontiers.py            # writes results/frontiers.csv; resumable, an hour on one core

Seed 0, test resets. On robots the limit is a number of steps per episode of 1000, which an adapting guard is told as
the rate at which its margin settles, half the limit as its default is of 25. Where episodes are short there is no time
to adapt: the guard's margin takes the limit's place, in calibrated ones of the World.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from common import RESULTS, append, read

from ringfence import algos
from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.loading.resolve import load
from ringfence.training import loop, worlds

OUT = RESULTS / "frontiers.csv"
FIELDS = ("task", "method", "knob", "value", "episodes", "return", "cost", "cost_safe_start", "train_seconds")
MARGINS = (-1.0, 0.0, 0.25, 0.5, 1.0)
# By task, the limits on an episode's cost.
LIMITS = {
    "simple_spread-expert": (0.25, 0.5, 1, 2, 4),
    "simple_spread-medium-replay": (0.25, 0.5, 1, 2, 4),
    "crossing-hasty": (0.1, 0.3, 1, 3, 10),
    "halfcheetah_2x3-good": (5, 12.5, 25, 50, 100),
    "halfcheetah_2x3-medium": (5, 12.5, 25, 50, 100),
    "ant_2x4-medium": (5, 12.5, 25, 50, 100),
}
TRAINED = {"ma-td3bc-lag": "MA-TD3+BC, Lagrange", "bc-safe": "BC on episodes within the limit"}
GUARDED = {"bc": "BC, guarded"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(LIMITS))
    parser.add_argument("--of", nargs="+", default=[*GUARDED, *TRAINED], help="algorithms")
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    for name in a.of:
        for task in a.tasks:
            (guarded if name in GUARDED else trained)(task, name, a.out)


def trained(name: str, algorithm: str, out: Path) -> None:
    """A run for every limit."""
    task, missing = registry.get(name), _missing(name, TRAINED[algorithm], LIMITS[name], out)
    store = make(task)[0] if missing else None
    for limit in missing:
        with tempfile.TemporaryDirectory() as folder:
            changes = {algos.get(algorithm).limit: float(limit)}
            (run,) = loop.train(algorithm, store, seeds=(0,), out=folder, quiet=True, changes=changes)
            _play(name, TRAINED[algorithm], "limit", limit, run, out)


def guarded(name: str, algorithm: str, out: Path) -> None:
    """One run, whose guard is told the limit or the margin, and the run alone."""
    task = registry.get(name)
    values = ("alone", *(LIMITS[name] if task.protocol else MARGINS))
    missing = _missing(name, GUARDED[algorithm], values, out)
    if not missing:
        return
    store, _ = make(task)
    with tempfile.TemporaryDirectory() as folder:
        (run,) = loop.train(algorithm, store, seeds=(0,), out=folder, quiet=True)
        for value in missing:
            if value == "alone":
                _play(name, GUARDED[algorithm], "none", value, run, out)
                continue
            guard = {"guard": "adapt", "rate": value / 2000} if task.protocol else {"guard": "shield", "margin": value}
            guard |= {"barrier": "learned", "world": worlds.fit(store)}
            _play(name, GUARDED[algorithm], "limit" if task.protocol else "margin", value, run, out, **guard)


def _missing(name: str, method: str, values: tuple, out: Path) -> list:
    there = {r["value"] for r in read(out) if (r["task"], r["method"]) == (name, method)}
    return [v for v in values if str(v) not in there]


def _play(name: str, method: str, knob: str, value, run, out: Path, **how) -> None:
    task = registry.get(name)
    episodes = 20 if task.protocol else 200
    found = evaluate_policy(load(run, **how)[1], task, episodes, "test", 0)[0]
    row = dict(zip(FIELDS, (name, method, knob, value, episodes)))
    row |= {k: f"{found[k + '_mean']:.5g}" for k in ("return", "cost")}
    row |= {"cost_safe_start": f"{found['cost_safe_start']:.4g}"}
    row |= {"train_seconds": f"{sum(r['seconds'] for r in run.metrics):.0f}"}
    append(out, row, FIELDS)


if __name__ == "__main__":
    main()
