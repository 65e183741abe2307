"""The planner on robots: wall time and memory of training one seed, and of playing 20 episodes of 1000 steps.

    python benchmarks/robot_planner.py            # writes results/performance/robot_planner.json; a quarter of an hour

Training is what `ringfence train icbf TASK` does with the task's preset, reading the data, the critic and compilation
included; playing is `ringfence eval --planner low_temperature --guard adapt --episodes 20`. Each in a process of its
own, on all cores.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from _common import record

from ringfence.datasets import registry
from ringfence.datasets.make import make

OUT = Path(__file__).resolve().parent.parent / "results" / "performance" / "robot_planner.json"
MEASURED = """
import json, resource, sys, time
from pathlib import Path
begun = time.perf_counter()
from ringfence.datasets import registry as tasks
from ringfence.evaluation.evaluate import evaluate
from ringfence.training import loop as training
from ringfence.datasets.make import make
from ringfence.training.runs import Run
what, task, folder, steps = sys.argv[1], tasks.get(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4])
if what == "train":
    changes = {"num_updates": steps} if steps else {}
    training.train("icbf", make(task)[0], folder=lambda seed: folder, changes=changes, quiet=True)
else:
    guard = {"guard": what} if what != "none" else {}
    evaluate(Run(folder), episodes=20, split="validation", planner="low_temperature", **guard)
print(json.dumps([time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20]))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=["halfcheetah_2x3-medium", "ant_4x2-medium"])
    parser.add_argument("--steps", type=int, default=0, help="updates; 0: the preset's")
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    rows = []
    for task in a.tasks:
        make(registry.get(task))
        with tempfile.TemporaryDirectory() as folder:
            for what, name in (
                ("train", "icbf, training one seed"),
                ("none", "icbf, 20 episodes, low_temperature"),
                ("adapt", "icbf, 20 episodes, shield that adapts"),
            ):
                command = [sys.executable, "-c", MEASURED, what, task, f"{folder}/run", str(a.steps)]
                done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
                seconds, peak = json.loads(done.stdout.splitlines()[-1])
                rows += [
                    {"name": f"{task}: {name}", "value": seconds, "unit": "s"},
                    {"name": f"{task}: {name}, peak memory", "value": peak, "unit": "GiB"},
                ]
                print(f"{task}: {name}: {seconds:.1f} s, {peak:.2f} GiB", flush=True)
    record(a.out, rows)


if __name__ == "__main__":
    main()
