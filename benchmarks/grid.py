"""What the grid runner costs beside the work itself, and what it loses when it is killed.

    python benchmarks/grid.py        # writes results/performance/grid.json

Overhead: wall-clock time of `ringfence bench` on one worker, from its start to its end, beyond the seconds that its
cells spent in training and evaluation. Kills: the runner gets SIGKILL at a random moment ten times; a finished cell is
lost if its results change or it is made again.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from _common import record

from ringfence.bench import make_grid, unpack

ROOT = Path(__file__).resolve().parent.parent / "results"
WORK = {"tasks": ["simple_spread-expert"], "algorithms": ["bc", "ma-td3bc"], "seeds": 3, "episodes": 200}
BRIEF = {"tasks": ["simple_spread-medium-replay"], "algorithms": ["bc", "bc-safe"], "seeds": 6, "episodes": 200}


def grid_of(out: Path, tasks, algorithms, seeds, episodes, steps=None):
    return make_grid(
        "simple_spread", out, seeds=seeds, episodes=episodes, only_tasks=tasks, only=algorithms, num_updates=steps
    )


def command(out: Path, tasks, algorithms, seeds, episodes, steps=None) -> list[str]:
    chosen = ["--tasks", *tasks, "--algorithms", *algorithms, "--seeds", str(seeds), "--episodes", str(episodes)]
    chosen += [] if steps is None else ["--num-updates", str(steps)]
    start = [sys.executable, "-c", "from ringfence.cli.app import main; main()", "bench", "simple_spread"]
    return [*start, *chosen, "--workers", "1", "--out", str(out)]


def prepared(folder: str, **what):
    """A grid in a folder whose reference rows exist, so that all that is left is cells."""
    grid = grid_of(Path(folder) / "grid", **what)
    grid.open()
    unpack(ROOT / "simple_spread")
    shutil.copytree(ROOT / "simple_spread" / "reference", grid.out / "reference")
    return grid


def overhead() -> list[dict]:
    with tempfile.TemporaryDirectory() as folder:
        grid = prepared(folder, **WORK)
        begun = time.perf_counter()
        subprocess.run(command(grid.out, **WORK), check=True, capture_output=True)
        wall = time.perf_counter() - begun
        statuses = [c.status(grid.out) for c in grid.cells]
        work = sum(s["train_seconds"] + s["eval_seconds"] for s in statuses)
    return [
        {"name": "grid of 6 cells on one worker, wall clock", "value": wall, "unit": "s"},
        {"name": "in training and evaluation", "value": work, "unit": "s"},
        {"name": "overhead", "value": 100 * (wall - work) / work, "unit": "% of the work"},
    ]


def digest(cell, out: Path) -> str:
    return hashlib.sha256((cell.folder(out) / "results.json").read_bytes()).hexdigest()


def kills(number: int, steps: int = 1500) -> list[dict]:
    rng = random.Random(0)
    lost, found, seen = 0, 0, {}
    with tempfile.TemporaryDirectory() as folder:
        grid = prepared(folder, **BRIEF, steps=steps)
        out = grid.out
        for _ in range(number):
            runner = subprocess.Popen(command(out, **BRIEF, steps=steps), stdout=subprocess.DEVNULL)
            time.sleep(rng.uniform(2.0, 20.0))
            os.kill(runner.pid, signal.SIGKILL)
            runner.wait()
            time.sleep(1.0)  # its worker notices by itself
            done = {c: digest(c, out) for c in grid.cells if c.state(out, grid.episodes) == "done"}
            lost += sum(done.get(c) != d for c, d in seen.items())
            seen, found = done, len(done)
            print(f"killed; {found} of {len(grid.cells)} cells are done", flush=True)
        subprocess.run(command(out, **BRIEF, steps=steps), check=True, capture_output=True)
        lost += sum(digest(c, out) != d or c.status(out)["attempts"] != 1 for c, d in seen.items())
        left = grid.count()
    return [
        {"name": "kills of the runner at random moments", "value": number, "unit": "kills"},
        {"name": "cells finished before the last kill", "value": found, "unit": f"of {len(grid.cells)}"},
        {"name": "finished cells lost or made again", "value": lost, "unit": "cells"},
        {"name": "cells done after one more run", "value": left["done"], "unit": f"of {len(grid.cells)}"},
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--out", type=Path, default=ROOT / "performance" / "grid.json")
    a = parser.parse_args()
    record(a.out, overhead() + kills(a.kills))


if __name__ == "__main__":
    main()
