"""How often an action is proved in the model, and how long a guarded, proved joint action takes.

python benchmarks/proof.py                    # writes results/stress/proof.json, a row when it is played
python benchmarks/proof.py --epsilons 0.02 --episodes 50
python benchmarks/proof.py --time             # adds milliseconds; on a machine that has nothing else to do
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from crossing import acting

from ringfence.deploy import zoo
from ringfence.evaluation.stress import stress

OUT = Path(__file__).resolve().parent.parent / "results" / "stress" / "proof.json"
KEPT = ("return_mean", "violation_rate", "violation_upper", "infeasible_rate", "proved_rate", "agent_proved_rate")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--epsilons", type=float, nargs="*", default=[0.005, 0.02, 0.05])
    parser.add_argument("--backup", choices=("yes", "no", "both"), default="both")
    parser.add_argument("--time", action="store_true")
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    rows: dict[str, Any] = json.loads(a.out.read_text()) if a.out.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        run = zoo.pretrained("crossing-hasty/bc", folder)
        if a.time:
            rows["milliseconds"] = {"cores": os.cpu_count(), **timed(run)}
        for epsilon in [] if a.time else a.epsilons:
            for backup in {"yes": [True], "no": [False], "both": [True, False]}[a.backup]:
                name = f"epsilon {epsilon:g}, {'with' if backup else 'without'} backup"
                if name in rows:
                    continue
                found = stress(run, {}, episodes=a.episodes, guard="shield", proof=epsilon, proof_backup=backup)
                rows[name] = {"episodes": a.episodes, **{k: round(found[k], 4) for k in KEPT}}
                print(name, rows[name], flush=True)
                a.out.write_text(json.dumps(rows, indent=1) + "\n")
    a.out.parent.mkdir(parents=True, exist_ok=True)
    a.out.write_text(json.dumps(rows, indent=1) + "\n")
    print(json.dumps(rows, indent=1))


def timed(run: Any) -> dict[str, float]:
    """Milliseconds of a joint action of eight agents, and of all that is said of it, along episodes; with and without
    a proof."""
    found = {}
    for name, options in (("shield", {}), ("shield and proof", {"proof": 0.02})):
        took = acting(run, None, 8, {"guard": "shield", **options})
        found |= {f"{name}, p{q}": round(float(np.percentile(took, q)), 2) for q in (50, 99)}
    return found


if __name__ == "__main__":
    main()
