"""What was tried on validation resets, as a table: one row per evaluation of the given run folders.

    ringfence train icbf halfcheetah_2x3-good --out runs/trials --set barrier_weight=3
    ringfence eval runs/trials --split validation --episodes 10 --planner low_temperature --guard adapt
    python benchmarks/trials.py runs/trials/*/*/*          # writes results/tuning/mujoco.csv

`changes` are the config fields that differ from the algorithm's defaults, `planner` the options that do.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

from _rows import write

from ringfence import algos
from ringfence.guards import GuardOptions
from ringfence.proposals.options import PlanOptions
from ringfence.training.runs import Run

OUT = Path(__file__).resolve().parent.parent / "results" / "tuning" / "mujoco.csv"


def differing(values: dict, defaults) -> str:
    plain = json.loads(json.dumps(dataclasses.asdict(defaults)))
    return json.dumps({k: v for k, v in values.items() if v != plain.get(k)})


def rows_of(run: Run) -> list[dict]:
    """Evaluations of a run on validation resets."""
    settings, found = run.config, []
    config = differing(settings["config"], algos.get(settings["algorithm"]).Config())
    for r in run.results.values():
        if r["split"] == "validation":
            found.append(
                {
                    "task": r["task"],
                    "transitions": settings["data"].get("transitions"),
                    "algorithm": r["algorithm"],
                    "revision": settings.get("revision", 1),
                    "seed": r["seed"],
                    "changes": config,
                    "planner": differing(r["options"], PlanOptions()),
                    "guard": f"{r['guard']}-{r['barrier']} " + differing(r["guard_options"], GuardOptions()),
                    "episodes": r["episodes"],
                    "return": round(r["return_mean"], 1),
                    "cost": round(r["cost_mean"], 2),
                    "cost_cvar10": round(r["cost_cvar10"], 1),
                    "seconds": round(r["train_seconds"], 1),
                }
            )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    rows = [r for path in sorted(a.runs) if (path / "results.json").exists() for r in rows_of(Run(path))]
    rows.sort(key=lambda r: (r["task"], r["algorithm"], r["changes"]))
    if not rows:
        raise SystemExit("None of these folders has an evaluation on validation resets; add --split validation.")
    write(a.out, rows)
    print(f"{len(rows)} evaluations: {a.out}")


if __name__ == "__main__":
    main()
