"""Pedestrians who were filmed, replayed: one of them driven, the others as they walked.

python benchmarks/pedestrians.py FOLDER    # writes results/replay/zara02.json; three minutes on one core

FOLDER holds the `obsmat` file of UCY's zara02 (github.com/crowdbotp/OpenTraj, `datasets/UCY/zara02/obsmat.txt`). It is
split by time: the first 70 % to learn by, the rest to replay. A step costs 1 where two centres come closer than RADIUS,
and the World is told nothing but that column.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import ringfence
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.training.runs import write_json

OUT = Path(__file__).resolve().parent.parent / "results" / "replay" / "zara02.json"
RADIUS = 0.5  # m: in the first 70 % there are 33 entries below 0.4 m, 98 below 0.5 and 151 below 0.6
NEIGHBOURS = 6
STEPS = 10  # of a window: 4 s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--radius", type=float, default=RADIUS)
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    learn, judge = by_cost(obsmat(a.folder), a.radius)
    world = ringfence.fit(learn)
    print(world.card)
    with tempfile.TemporaryDirectory() as runs:
        (run,) = ringfence.train("bc", learn, seeds=(0,), out=runs)
        result = ringfence.replay(run, judge, world=world, radius=a.radius, steps=STEPS, windows=1000, anyway=True)
    print(*result.summary(), sep="\n")
    a.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(a.out, result.to_json() | {"world": told(world)})


def obsmat(folder: Path) -> Path:
    """The file of zara02 in a folder, whatever it is called there."""
    found = sorted(path for path in folder.rglob("*obsmat.txt") if "zara02" in str(path))
    if not found:
        raise SystemExit(f"'{folder}' holds no obsmat.txt of zara02; get it from github.com/crowdbotp/OpenTraj.")
    return found[0]


def by_cost(file: Path, radius: float) -> tuple[EpisodeStore, EpisodeStore]:
    """Logs to learn by and to judge by, whose costs are all that is known of danger."""
    how = {"neighbours": NEIGHBOURS, "danger": constraints.Separation(radius, radius / 4)}
    parts = EpisodeStore.split_table(file, 0.7, layout="obsmat", card={"task": "zara02"}, **how)
    hazard = constraints.to_dict(constraints.CostColumn())
    learn, judge = (dataclasses.replace(part, card=part.card.updated(hazard=hazard)) for part in parts)
    return learn, judge


def told(world: Any) -> dict[str, Any]:
    """What the World's card says of itself."""
    card = world.card.to_json()
    return {"verdict": card["verdict"], "barrier": {k: v for k, v in card["barrier"].items() if k != "calibration"}}


if __name__ == "__main__":
    main()
