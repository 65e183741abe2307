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
from pathlib import Path

from replayed import NEIGHBOURS, OUT, by_cost, replayed, write

RADIUS = 0.5  # m: in the first 70 % there are 33 entries below 0.4 m, 98 below 0.5 and 151 below 0.6
STEPS = 10  # of a window: 4 s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recording", default="zara02")
    parser.add_argument("--radius", type=float, default=RADIUS)
    parser.add_argument("--out", type=Path, help="default: results/replay/RECORDING.json")
    a = parser.parse_args()
    out = a.out or OUT / f"{a.recording}.json"
    how = {"layout": "obsmat", "neighbours": NEIGHBOURS}
    learn, judge = by_cost(obsmat(a.folder, a.recording), a.radius, a.recording, **how)
    write(out, replayed(learn, judge, radius=a.radius, steps=STEPS, windows=1000))


def obsmat(folder: Path, recording: str = "zara02") -> Path:
    """The file of a recording in a folder, whatever it is called there."""
    found = sorted(path for path in folder.rglob("*obsmat.txt") if recording in str(path.relative_to(folder)))
    if not found:
        raise SystemExit(f"'{folder}' holds no obsmat.txt of {recording}; get it from github.com/crowdbotp/OpenTraj.")
    return found[0]


if __name__ == "__main__":
    main()
