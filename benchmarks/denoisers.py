"""Which denoiser learns most per minute of CPU: agent attention beside MADIFF's temporal U-Net, same data, same time.

    python benchmarks/denoisers.py           # writes results/performance/denoisers.json

Each network trains as `madiff` on simple_spread-medium until the wall-clock budget is spent (compilation apart), then
plays 100 validation episodes with one plan per step.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from _common import record

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.loading.resolve import make_policy
from ringfence.training import loop, worlds
from ringfence.training.job import make_job

OUT = Path(__file__).resolve().parent.parent / "results" / "performance" / "denoisers.json"
ENTRIES = (
    ("agent attention, 128 wide, own entries", {}),
    ("agent attention, 128 wide, all entries", {"carry": "all"}),
    ("temporal U-Net, 32 wide, 2 resolutions", {"net": "unet", "width": 32, "depth": 2, "carry": "all"}),
    ("temporal U-Net, 64 wide, 2 resolutions", {"net": "unet", "width": 64, "depth": 2, "carry": "all"}),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=45.0)
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    task = registry.get("simple_spread-medium")
    store, _ = make(task)
    rows = []
    for name, changes in ENTRIES:
        # The learning rate falls over `steps`, so the number of updates that fit is found first.
        ms = trial(store, task, {**changes, "num_updates": 1000}, 20)[1]
        steps = max(20, int(a.seconds / ms * 1e3))
        (job, state), took = trial(store, task, {**changes, "num_updates": steps}, steps)
        result, _ = evaluate_policy(make_policy(job, state, {}), task, 100, "validation")
        size = sum(np.size(x) for x in jax.tree.leaves(state["params"]["denoiser"]))
        for what, value, unit in (
            ("parameters", size, ""),
            ("updates", steps, f"in {a.seconds:g} s"),
            ("milliseconds per update", took, "ms"),
            ("validation return", result["return_mean"], ""),
        ):
            rows.append({"name": f"{name}: {what}", "value": float(value), "unit": unit})
            print(rows[-1], flush=True)
    record(a.out, rows)


def trial(store, task, changes: dict, updates: int):
    """((job, state), ms per update) after `updates`, the first ten not timed."""
    job = make_job("madiff", task, None, changes, store)
    c = job.config
    world = worlds.fit(store, **job.world)
    data = loop.windows_of(job, store, world)
    state = job.algorithm.init(jax.random.key(0), job.spec, c, data, job.feature_map, job.hazard, world)
    scores = data.arrays["scores"][None]
    advance, _ = loop.make_program(job)
    roots = jax.vmap(jax.random.key)(jnp.arange(1))
    state = jax.tree.map(lambda x: x[None], state)
    state, metrics = advance(state, roots, data.arrays, scores, 10)
    jax.block_until_ready(metrics)
    begun = time.perf_counter()
    state, metrics = advance(state, roots, data.arrays, scores, updates - 10)
    jax.block_until_ready(metrics)
    ms = (time.perf_counter() - begun) / (updates - 10) * 1e3
    return (job, jax.tree.map(lambda x: x[0], state)), ms


if __name__ == "__main__":
    main()
