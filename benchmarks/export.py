"""Exported policies against `Controller`: how far their actions are apart, and how long one takes.

    ringfence bench guards --tasks simple_spread-expert --out DIR   # policies with their checkpoints
    python benchmarks/export.py DIR          # writes results/export.csv; ten minutes

500 test resets and 500 logged states of another tier, noise alike, one thread of onnxruntime.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import zipfile
from pathlib import Path

import jax
import numpy as np
import onnxruntime
from common import RESULTS, write

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.deploy import export
from ringfence.evaluation import protocol
from ringfence.loading.resolve import load
from ringfence.training import worlds
from ringfence.types import act_with

OUT = RESULTS / "export.csv"
TASK, OTHER, STATES, CLOSE = "simple_spread-expert", "simple_spread-medium-replay", 500, 1e-5
POLICIES = (
    ("BC", "bc", {}),
    ("BC, `shield`, learned", "bc", {"guard": "shield"}),
    ("BC, `shield`, formula", "bc", {"guard": "shield", "barrier": "analytic"}),
    ("BC, `adapt`, learned", "bc", {"guard": "adapt"}),
    ("BC, `full`, learned", "bc", {"guard": "full"}),
    ("`madiff`", "madiff", {}),
    ("`icbf`", "icbf", {}),
    ("`icbf`, `shield`, learned", "icbf", {"guard": "shield"}),
)
FORMATS = {"stablehlo": "StableHLO", "onnx": "ONNX"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    cells = parser.parse_args().folder / "cells" / TASK
    env = registry.get(TASK).env
    state = env.reset(jax.random.fold_in(jax.random.key(protocol.RESETS["test"]), 0), STATES)
    store = make(registry.get(OTHER))[0]
    some = np.random.default_rng(0).choice(len(store.observations), STATES, replace=False)
    seen = np.concatenate([env.observe(state), store.observations[some]])
    whole_states = np.concatenate([env.global_state(state), store.state[some]])
    rows = []
    for name, cell, options in POLICIES:
        run = next((cells / cell).glob("seed-0-*"))
        rows.append({"policy": name} | compared(run, options, seen, whole_states))
        print(rows[-1], flush=True)
        write(OUT, rows)


def compared(run: Path, options: dict, seen: np.ndarray, whole_states: np.ndarray) -> dict:
    """One policy in both formats, beside the controller."""
    job, policy = worlds.with_world(load, run, **options)
    made = export.step_of(job, policy)
    play, row = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        for form in FORMATS:
            begun = time.perf_counter()
            file = export.export(run, Path(folder) / form, form, **options)
            row |= {f"{form}_s": time.perf_counter() - begun, f"{form}_kib": file.stat().st_size / 1024}
            play[form] = _player(file, form)
    act, carry = jax.jit(act_with), policy.initial_state(1)
    gaps, took = {f: [] for f in play}, {f: [] for f in ["controller", *play]}
    for k in range(len(seen)):
        key = jax.random.key(k)
        noise = made.draw(key)
        given = {"observations": seen[k], "state": whole_states[k], "cost": np.array(np.nan), **made.initial}
        given |= {f"noise.{i}": np.asarray(x) for i, x in enumerate(noise)}
        given = {e.name: np.asarray(given[e.name], e.dtype) for e in made.inputs}
        begun = time.perf_counter()
        action = np.asarray(act(policy, carry, seen[k][None], whole_states[k][None], key)[1].action[0])
        took["controller"].append(time.perf_counter() - begun)
        for form, call in play.items():
            begun = time.perf_counter()
            gaps[form].append(np.abs(call(given)["action"] - action).max())
            took[form].append(time.perf_counter() - begun)
    for form in play:
        gap = np.array(gaps[form])
        row |= {f"{form}_largest": gap.max(), f"{form}_apart": int((gap > CLOSE).sum())}
    row |= {f"{form}_ms": 1e3 * np.median(t) for form, t in took.items()}
    return {k: v if isinstance(v, int) else f"{v:.3g}" for k, v in row.items()}


def _player(file: Path, form: str):
    """What plays a file: arrays by name in, arrays by name out."""
    if form == "onnx":
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        session = onnxruntime.InferenceSession(file, options)
        names = [x.name for x in session.get_outputs()]
        return lambda given: dict(zip(names, session.run(names, given)))
    with zipfile.ZipFile(file) as packed:
        names = [x["name"] for x in json.loads(packed.read("metadata.json"))["outputs"]]
        call = jax.jit(jax.export.deserialize(bytearray(packed.read("policy.jax"))).call)
    return lambda given: {k: np.asarray(v) for k, v in zip(names, call(*given.values()))}


if __name__ == "__main__":
    main()
