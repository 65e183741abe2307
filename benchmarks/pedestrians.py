"""Pedestrians who were filmed, replayed: one of them driven, the others as they walked.

python benchmarks/pedestrians.py FOLDER                        # results/replay/zara02.json; four minutes on one core
python benchmarks/pedestrians.py FOLDER --recording zara01     # or seq_hotel, seq_eth, students03
python benchmarks/pedestrians.py FOLDER --faults               # results/stress/pedestrians.csv, certificates beside it
python benchmarks/pedestrians.py FOLDER --table                # writes their table of docs/stress-results.md

FOLDER holds `obsmat` files of ETH and UCY (github.com/crowdbotp/OpenTraj, e.g. `datasets/UCY/zara02/obsmat.txt`). A
recording is split by time: the first 70 % to learn by, the rest to replay. A step costs 1 where two centres come closer
than RADIUS, and the World is told nothing but that column. What the replay of zara02 showed has chosen how a guard's
correction is begun again; the other recordings have chosen nothing. With `--faults` the driven agent has them, as in
benchmarks/stress.py, and its guard knows of them or not; a step takes 0.4 s. Certificates are made of the same windows,
of which the first half calibrates the margin.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import _rows
import jax
from replayed import NEIGHBOURS, OUT, by_cost, replayed, write
from stress import MIDDLE, in_words, name_of

import ringfence
from ringfence.evaluation.certify import certify
from ringfence.evaluation.replay import ReplayResult
from ringfence.evaluation.stress import known_to_guards
from ringfence.faults import Faults

RADIUS = 0.5  # m: in the first 70 % there are 33 entries below 0.4 m, 98 below 0.5 and 151 below 0.6
STEPS = 10  # of a window: 4 s
STRESSED = OUT.parent / "stress" / "pedestrians.csv"
FIELDS = ("recording", "faults", "policy", "guard", "windows", "alone", "contacts", "prevented", "caused", "infeasible")
# Three strengths of what a step of 0.4 s leaves something of, and all at once.
FAULTS: tuple[dict[str, Any], ...] = (
    {},
    *({"delay": k} for k in (1, 2, 3)),
    *({"drop": p} for p in (0.3, 0.6, 0.8)),
    *({"asynchrony": p} for p in (0.5, 0.667, 0.75)),
    *({"noise": sd} for sd in (0.02, 0.05, 0.1)),  # m, m/s
    *({"gain": k} for k in (0.8, 0.6, 0.4)),
    {**MIDDLE, "delay": 1},
)
CERTIFIED: tuple[dict[str, Any], ...] = ({}, {"delay": 1}, {"drop": 0.3})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recording", default="zara02")
    parser.add_argument("--radius", type=float, default=RADIUS)
    parser.add_argument("--out", type=Path, help="default: results/replay/RECORDING.json")
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--table", action="store_true")
    a = parser.parse_args()
    if a.table:
        write_table(a.out or STRESSED)
        return
    how = {"layout": "obsmat", "neighbours": NEIGHBOURS}
    learn, judge = by_cost(obsmat(a.folder, a.recording), a.radius, a.recording, **how)
    replays = {"radius": a.radius, "steps": STEPS}
    if a.faults:
        behind_faults(learn, judge, a.recording, replays, a.out or STRESSED)
    else:
        write(a.out or OUT / f"{a.recording}.json", replayed(learn, judge, windows=1000, **replays))


def behind_faults(learn: Any, judge: Any, recording: str, replays: dict[str, Any], out: Path) -> None:
    """A row for every driver without guard, under the shield, and under one that knows of the faults."""
    world = ringfence.fit(learn)
    with tempfile.TemporaryDirectory() as runs:
        (run,) = ringfence.train("bc", learn, seeds=(0,), out=runs)
        done = {(row["recording"], row["faults"]) for row in _rows.read(out)}
        for faults in FAULTS:
            if (recording, name_of(faults)) in done:
                continue
            how = {"world": world, "anyway": True, "baselines": False, "windows": 1000, "faults": faults, **replays}
            found = {"shield": ringfence.replay(run, judge, **how)}
            if known_to_guards(Faults.of(faults)):
                found["shield, compensated"] = ringfence.replay(run, judge, compensate=True, **how)
            for row in _stressed(found):
                _rows.append(out, {"recording": recording, "faults": name_of(faults), **row}, FIELDS)
            jax.clear_caches()  # programs of each fault are many, and Linux bounds what one process may map
        promised = []
        for faults in CERTIFIED:
            made = certify(run, faults, logs=judge, world=world, anyway=True, episodes=1000, **replays)
            print(*made.summary(), sep="\n", flush=True)
            promised.append(dataclasses.asdict(made))
            jax.clear_caches()
        write(out.with_suffix(".json"), {"recording": recording, "certificates": promised})


def _stressed(found: dict[str, ReplayResult]) -> list[dict[str, Any]]:
    made = []
    for guard, result in found.items():
        for row in result.rows:
            if row.filter == "none" and guard != "shield":
                continue  # the same windows again
            kept = {name: getattr(row, name) for name in FIELDS if name not in ("recording", "faults", "guard")}
            made.append(kept | {"guard": "none" if row.filter == "none" else guard})
            print(made[-1], flush=True)
    return made


def write_table(out: Path) -> None:
    """Contacts of all drivers together, between the markers of docs/stress-results.md."""
    from readme import put

    head = ("faults", "of 1000 windows with contact: no guard", "shield", "caused", "compensated", "caused")
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    rows = _rows.read(out)
    for name in dict.fromkeys(row["faults"] for row in rows):
        cells = [in_words(name)]
        for guard in ("none", "shield", "shield, compensated"):
            own = [row for row in rows if (row["faults"], row["guard"]) == (name, guard)]
            counted = ("contacts", "caused") if guard != "none" else ("contacts",)
            cells += [str(sum(int(row[c]) for row in own)) if own else "–" for c in counted]
        lines.append(f"| {' | '.join(cells)} |")
    put("docs/stress-results.md", "pedestrians", "\n".join(lines))


def obsmat(folder: Path, recording: str = "zara02") -> Path:
    """The file of a recording in a folder, whatever it is called there."""
    found = sorted(path for path in folder.rglob("*obsmat.txt") if recording in str(path.relative_to(folder)))
    if not found:
        raise SystemExit(f"'{folder}' holds no obsmat.txt of {recording}; get it from github.com/crowdbotp/OpenTraj.")
    return found[0]


if __name__ == "__main__":
    main()
