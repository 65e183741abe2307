"""The robots: environment steps per second, and wall time and memory of collecting a data set.

    python benchmarks/robots.py              # writes results/performance/robots.json

One env-step is 0.05 s of one robot, five substeps of MuJoCo. Steps are those of a running batch under uniform actions
drawn beforehand, resets of fallen robots included; values are medians over repeats. Collection is what
`ringfence data make` does, in a process of its own, compilation and the file included.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
from _common import record

from ringfence.envs import SafeMuJoCo
from ringfence.envs.mujoco import FRAME_SKIP

OUT = Path(__file__).resolve().parent.parent / "results" / "performance" / "robots.json"
COLLECT = """
import json, resource, sys, time
begun = time.perf_counter()
from ringfence.datasets import registry as tasks
from ringfence.datasets.make import make
store, _ = make(tasks.get(sys.argv[1]), int(sys.argv[2]), out=sys.argv[3], fresh=True)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(json.dumps([time.perf_counter() - begun, peak, store.steps]))
"""


def rate(parts: str, batch: int, repeats: int) -> float:
    """Median env-steps/s."""
    env = SafeMuJoCo(parts)
    sim, rng = env.simulate(batch), np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (50, batch, env.n_agents, env.action_dim))
    sim.reset(range(batch))
    rates, fresh = [], batch
    for _ in range(repeats):
        begun, done = time.perf_counter(), 0
        for action in actions:
            done += int(sim.running.sum())
            out = sim.step(action)
            fallen = np.flatnonzero(out.terminated)
            if len(fallen):
                sim.reset(range(fresh, fresh + len(fallen)), fallen)
                fresh += len(fallen)
        rates.append(done / (time.perf_counter() - begun))
    return median(rates)


def alone(parts: str, repeats: int, steps: int = 1000) -> float:
    """Median env-steps per second of one thread that calls MuJoCo's own `mj_step` and nothing else."""
    import mujoco

    model = SafeMuJoCo(parts).model()
    data, controls = mujoco.MjData(model), np.random.default_rng(0).uniform(-1, 1, (steps, model.nu))
    rates = []
    for _ in range(repeats):
        mujoco.mj_resetData(model, data)
        begun = time.perf_counter()
        for control in controls:
            data.ctrl[:] = control
            mujoco.mj_step(model, data, FRAME_SKIP)
        rates.append(steps / (time.perf_counter() - begun))
    return median(rates)


def collected(task: str, transitions: int) -> tuple[float, float, int]:
    """(seconds, peak GiB, steps)"""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", COLLECT, task, str(transitions), f"{folder}/data.h5"]
        return tuple(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--transitions", type=int, default=1_000_000)
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    rows = []
    for parts in ("2x3", "2x4", "4x2"):
        name = f"{SafeMuJoCo(parts).name} mj_step alone, one thread"
        rows.append({"name": name, "value": alone(parts, a.repeats), "unit": "env-steps/s"})
        for batch in (16, 256):
            name = f"{SafeMuJoCo(parts).name} batch={batch}"
            rows.append({"name": name, "value": rate(parts, batch, a.repeats), "unit": "env-steps/s"})
    for task in ("halfcheetah_2x3-good", "ant_2x4-good"):
        seconds, peak, steps = collected(task, a.transitions)
        rows += [
            {"name": f"data make {task}, {steps:,} transitions", "value": seconds, "unit": "s"},
            {"name": f"data make {task}, peak memory", "value": peak, "unit": "GiB"},
        ]
    record(a.out, rows)


if __name__ == "__main__":
    main()
