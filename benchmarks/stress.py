"""A guarded run behind faults, as the guard is and with what it can be told of them.

python benchmarks/stress.py               # writes results/stress/crossing-hasty.csv; two minutes a row, on one core
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import _rows

from ringfence.deploy import zoo
from ringfence.errors import UserError
from ringfence.evaluation.stress import stress

OUT = Path(__file__).resolve().parent.parent / "results" / "stress" / "crossing-hasty.csv"
FIELDS = ("faults", "guard", "told", "episodes", "return", "violation_rate", "violation_upper", "infeasible_rate")
DELAYS = [{}, {"delay": 1}, {"delay": 2}, {"delay": 3}]
FARTHER = {"margin": 1.5, "horizon": 5}  # chosen on 50 validation episodes with three late steps
OTHERS = [
    {"drop": 0.3},
    {"drop": 0.6},
    {"asynchrony": 0.667},
    {"noise": 0.005},
    {"noise": 0.02},
    {"gain": 0.8},
    {"gain": 0.6},
    {"delay": 2, "drop": 0.3, "noise": 0.005, "gain": 0.8, "asynchrony": 0.5},
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--delays", action="store_true", help="late actions alone")
    a = parser.parse_args()
    done = {(row["faults"], row["guard"], row["told"]) for row in _rows.read(a.out)}
    with tempfile.TemporaryDirectory() as folder:
        run = zoo.pretrained("crossing-hasty/bc", folder)
        for faults in DELAYS if a.delays else DELAYS + OTHERS:
            told = bool(faults.keys() & {"delay", "drop"})
            trials = [
                (False, {}),
                *([(True, {})] if told else []),
                *([(True, FARTHER)] if faults == {"delay": 3} else []),
            ]
            for how, options in trials:
                row = _row(run, faults, how, options, a.episodes, done)
                if row is not None:
                    print(row, flush=True)
                    _rows.append(a.out, row, FIELDS)


def _row(
    run: Any, faults: dict[str, Any], told: bool, options: dict[str, Any], episodes: int, done: set
) -> dict[str, Any] | None:
    name = "+".join(f"{k}{v}" for k, v in faults.items()) or "none"
    guard = ", ".join(["shield", *(f"{k} {v}" for k, v in options.items())])
    if (name, guard, str(told)) in done:
        return None
    try:
        result = stress(run, faults, episodes=episodes, guard="shield", compensate=told, **options)
    except UserError as error:  # more late steps than the World's predictions are known for
        print(f"{name}, {guard}, told {told}: {error}", flush=True)
        return None
    return {
        "faults": name,
        "guard": guard,
        "told": told,
        "episodes": episodes,
        "return": round(result["return_mean"], 3),
        **{field: round(result[field], 4) for field in FIELDS[5:]},
    }


if __name__ == "__main__":
    main()
