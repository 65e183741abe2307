"""Makes the trained policies that come with the package (zoo/) of benchmark cells, and plays both beside each other.

ringfence bench guards --tasks simple_spread-expert --out A       # likewise guards-mujoco, crossing-guards
python benchmarks/zoo.py --pack A B C     # writes src/ringfence/zoo/TASK
python benchmarks/zoo.py --fit crossing-hasty    # has a World that is fitted by this version guard the task's policies
python benchmarks/zoo.py                  # plays them; writes results/zoo.csv
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

from common import RESULTS, read, write

from ringfence.deploy import zoo
from ringfence.evaluation.evaluate import evaluate
from ringfence.training import worlds
from ringfence.training.runs import Run

OUT = RESULTS / "zoo.csv"
CELLS = {
    "simple_spread-expert/bc": "bc",
    "simple_spread-expert/icbf": "icbf",
    "halfcheetah_2x3-good/bc": "bc-mujoco",
    "halfcheetah_2x3-good/icbf": "icbf-mujoco",
    "crossing-hasty/bc": "bc",
    "crossing-hasty/icbf": "icbf",
}
READERS = [name for name in CELLS if name.endswith("/icbf")]  # whose training read a World
EPISODES = {"simple_spread-expert": 200, "halfcheetah_2x3-good": 20, "crossing-hasty": 200}
GUARDS = {"simple_spread-expert": "shield", "halfcheetah_2x3-good": "adapt", "crossing-hasty": "shield"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pack", type=Path, nargs="*", default=[])
    parser.add_argument("--fit", nargs="*", default=[], help="tasks whose guards' Worlds are fitted anew")
    given = parser.parse_args()
    folders = given.pack
    before: dict = {(r["policy"], r["guard"]): r for r in read(OUT)}
    for name, cell in CELLS.items():
        task = name.split("/")[0]
        for run in (Run(p) for f in folders for p in (f / "cells" / task / cell).glob("seed-0-*")):
            own = worlds.of_run(run) if (run.path / worlds.WORLD).exists() else None
            print(*zoo.put(run, name, own, worlds.fit_run(run)))
            for guard in ("none", GUARDS[task]):
                found = [r for r in run.results.values() if _is(r, guard)]
                before[name, guard] = {
                    "return_before": f"{found[0]['return_mean']:.5g}" if found else "",
                    "cost_before": f"{found[0]['cost_mean']:.4g}" if found else "",
                }
    rows = []
    with tempfile.TemporaryDirectory() as there:
        for task in given.fit:
            run = zoo.pretrained(f"{task}/bc", there)
            for there_already in (worlds.GUARD, worlds.WORLD):
                (run.path / there_already).unlink(missing_ok=True)
            guards = worlds.fit_run(run)
            print(zoo.renew(task, guards, [name.split("/")[1] for name in READERS if name.startswith(task)]))
            for name in CELLS:  # what was played before was under another guard
                before.pop((name, GUARDS[task]), None)
            shutil.rmtree(run.path)
        for name in zoo.names():
            task, run = name.split("/")[0], zoo.pretrained(name, there)
            planner = "low_temperature" if (task, name[-4:]) == ("halfcheetah_2x3-good", "icbf") else "default"
            for guard in ("none", GUARDS[task]):
                result = evaluate(run, episodes=EPISODES[task], guard=guard, planner=planner)
                files = [zoo.FOLDER / f"{name}.safetensors", zoo.FOLDER / f"{name}-world.safetensors"]
                old = before.get((name, guard), {})
                rows.append(
                    {
                        "policy": name,
                        "guard": guard,
                        "episodes": EPISODES[task],
                        "return": f"{result['return_mean']:.5g}",
                        "cost": f"{result['cost_mean']:.4g}",
                        "violation_rate": f"{result['violation_rate']:.4g}",
                        "return_before": old.get("return_before", ""),
                        "cost_before": old.get("cost_before", ""),
                        "kib": round(sum(f.stat().st_size for f in files if f.exists()) / 1024),
                    }
                )
                print(rows[-1], flush=True)
    write(OUT, rows)


def _is(result: dict, guard: str) -> bool:
    """Whether a cell's result is of this guard, as the zoo plays it."""
    return result["guard"] == guard and result["barrier"] in ("none", "learned")


if __name__ == "__main__":
    main()
