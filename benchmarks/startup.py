"""How long until a command is done and a controller acts, with programs kept from an earlier process and without.

    python benchmarks/startup.py             # writes results/performance/startup.json; three minutes

Every measurement is a process of its own; the first of each begins with an empty folder. The policy and its World come
with the package. To be run on a quiet machine.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from _common import Rows, record

from ringfence.deploy import zoo

OUT = Path(__file__).resolve().parent.parent / "results" / "performance" / "startup.json"
POLICY = "crossing-hasty/bc"
EVALUATE = "eval {run} --guard shield --agents 8 --episodes 20"
ACT = """
import sys, time
import numpy as np
from ringfence import Controller
controller = Controller(sys.argv[1], guard=sys.argv[2], agents=8)
observations = np.zeros((8, controller.job.widths[0]), np.float32)
begun = time.perf_counter()
if "warm" in sys.argv:
    controller.warm_up(observations)
    begun = time.perf_counter()
controller.act(observations)
print(time.perf_counter() - begun)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    rows = Rows()
    with tempfile.TemporaryDirectory() as folder:
        run = zoo.pretrained(POLICY, Path(folder) / "runs").path
        command = EVALUATE.format(run=run)
        measure(rows, f"ringfence {EVALUATE.format(run=POLICY)}", arguments.repeats, lambda: evaluated(command))
        for guard in ("shield", "full"):
            for how, words in ((), ""), (("warm",), " that has warmed up"):
                name = f"{POLICY}, 8 agents, {guard}: first action of a loaded controller{words}"
                measure(rows, name, arguments.repeats, lambda guard=guard, how=how: acted(run, guard, *how))
    record(arguments.out, rows)


def measure(rows: Rows, name: str, repeats: int, once) -> None:
    """Medians of the first process with an empty folder, and of the second with what the first has kept."""
    seconds: dict[str, list[float]] = {"first": [], "second": []}
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as programs:
            os.environ["RINGFENCE_COMPILATION_CACHE"] = programs
            for which in seconds:
                seconds[which].append(once())
    first, second = (statistics.median(taken) for taken in seconds.values())
    rows(f"{name}, first process", first, "s")
    rows(f"{name}, second process", second, "s")
    rows(f"{name}, second against first", second / first, "")


def evaluated(command: str) -> float:
    """Seconds of a command, from its process's beginning to its end."""
    begun = time.perf_counter()
    run_python("-m", "ringfence", *command.split())
    return time.perf_counter() - begun


def acted(run: Path, guard: str, *how: str) -> float:
    """Seconds of the first action, in a process that has loaded the policy, and has warmed up where asked."""
    return float(run_python("-c", ACT, str(run), guard, *how))


def run_python(*words: str) -> str:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_") or k == "JAX_PLATFORMS"}
    done = subprocess.run([sys.executable, *words], env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return done.stdout


if __name__ == "__main__":
    main()
