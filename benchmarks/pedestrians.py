"""Pedestrians who were filmed, replayed: one of them driven, the others as they walked.

python benchmarks/pedestrians.py FOLDER                        # results/replay/zara02.json; four minutes on one core
python benchmarks/pedestrians.py FOLDER --recording zara01     # or seq_hotel, seq_eth, students03

FOLDER holds `obsmat` files of ETH and UCY (github.com/crowdbotp/OpenTraj, e.g. `datasets/UCY/zara02/obsmat.txt`). A
recording is split by time: the first 70 % to learn by, the rest to replay. A step costs 1 where two centres come closer
than RADIUS, and the World is told nothing but that column. What the replay of zara02 showed has chosen how a guard's
correction is begun again; the other recordings have chosen nothing.
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

OUT = Path(__file__).resolve().parent.parent / "results" / "replay"
RADIUS = 0.5  # m: in the first 70 % there are 33 entries below 0.4 m, 98 below 0.5 and 151 below 0.6
NEIGHBOURS = 6
STEPS = 10  # of a window: 4 s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recording", default="zara02")
    parser.add_argument("--radius", type=float, default=RADIUS)
    parser.add_argument("--out", type=Path, help="default: results/replay/RECORDING.json")
    a = parser.parse_args()
    out = a.out or OUT / f"{a.recording}.json"
    learn, judge = by_cost(obsmat(a.folder, a.recording), a.radius, a.recording)
    world = ringfence.fit(learn)
    print(world.card)
    with tempfile.TemporaryDirectory() as runs:
        (run,) = ringfence.train("bc", learn, seeds=(0,), out=runs)
        how = {"world": world, "radius": a.radius, "steps": STEPS, "windows": 1000, "anyway": True}
        result = ringfence.replay(run, judge, **how)
        beside = ringfence.replay(run, judge, **how, baselines=False, correction_restarts=0)
    print(*result.summary(), "Without restarts of the correction:", *beside.summary(), sep="\n")
    out.parent.mkdir(parents=True, exist_ok=True)
    paired = {"without restarts": beside.to_json()["rows"]}
    write_json(out, result.to_json() | paired | {"world": told(world)})


def obsmat(folder: Path, recording: str = "zara02") -> Path:
    """The file of a recording in a folder, whatever it is called there."""
    found = sorted(path for path in folder.rglob("*obsmat.txt") if recording in str(path.relative_to(folder)))
    if not found:
        raise SystemExit(f"'{folder}' holds no obsmat.txt of {recording}; get it from github.com/crowdbotp/OpenTraj.")
    return found[0]


def by_cost(file: Path, radius: float, name: str = "zara02") -> tuple[EpisodeStore, EpisodeStore]:
    """Logs to learn by and to judge by, whose costs are all that is known of danger."""
    how = {"neighbours": NEIGHBOURS, "danger": constraints.Separation(radius, radius / 4)}
    parts = EpisodeStore.split_table(file, 0.7, layout="obsmat", card={"task": name}, **how)
    hazard = constraints.to_dict(constraints.CostColumn())
    learn, judge = (dataclasses.replace(part, card=part.card.updated(hazard=hazard)) for part in parts)
    return learn, judge


def told(world: Any) -> dict[str, Any]:
    """What the World's card says of itself."""
    card = world.card.to_json()
    return {"verdict": card["verdict"], "barrier": {k: v for k, v in card["barrier"].items() if k != "calibration"}}


if __name__ == "__main__":
    main()
