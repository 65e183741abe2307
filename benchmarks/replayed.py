"""Logs of pedestrians, of traffic or of a swarm, replayed: one of them driven, the others as logged.

python benchmarks/replayed.py telemetry.csv --layout syndrone --radius 2 --name a-den    # results/replay/a-den.json
python benchmarks/replayed.py fcd.xml --layout sumo --radius 2.5 --name town
python benchmarks/replayed.py citr.h5 citr-rest.h5 --radius 0.8 --name citr
python benchmarks/replayed.py FOLDER --name zara02              # four minutes on one core; or zara01, seq_hotel, …
python benchmarks/replayed.py FOLDER --name zara02 --faults     # results/stress/pedestrians.csv and its certificates

FILE is a table in one of the layouts of `ringfence data import-table`: telemetry.csv of github.com/MehmetUnall/
SynDrone-Swarm (`sample/A-DEN`, `sample/B-DEN`), or what SUMO (`pip install eclipse-sumo`) writes of a town whose
drivers often ignore who has the right of way:

    netgenerate --grid --grid.number=3 --grid.length=80 --default.lanenumber 1 --default.speed 10 \\
        -j right_before_left -o town.net.xml
    echo '<additional><vType id="hasty" sigma="0.8" tau="0.6" speedDev="0.3" minGap="1.0" jmIgnoreFoeProb="0.5" \\
        jmIgnoreFoeSpeed="10" jmIgnoreJunctionFoeProb="0.3" impatience="1" collisionMinGapFactor="0"/></additional>' \\
        > types.add.xml
    python $SUMO_HOME/tools/randomTrips.py -n town.net.xml -o trips.xml -e 1200 -p 1.2 --seed 1 \\
        --trip-attributes 'type="hasty"' --additional-files types.add.xml --fringe-factor 5
    sumo -n town.net.xml -a types.add.xml -r trips.xml --step-length 0.5 --fcd-output fcd.xml --collision.action none \\
        --seed 1 --end 1400

citr.h5 and citr-rest.h5 are of OpenTraj's `datasets/CITR`:

    ringfence data import-table *_traj_ped_filtered.csv --time frame --time-unit 0.03336667 --dt 0.2 --agent id \\
        --state x y vx vy --rename x_est=x y_est=y vx_est=vx vy_est=vy --neighbours 6 --separation 0.8 \\
        --max-episode-steps 40 --split 0.7 --task citr --out citr.h5

A table is split by time: the first 70 % to learn by, the rest to replay. Two files are the parts that
`import-table --split` wrote. FOLDER holds `obsmat` files of ETH and UCY (github.com/crowdbotp/OpenTraj,
`datasets/UCY/zara02/obsmat.txt`, …). A step costs 1 where two centres come closer than the radius, and the World reads
nothing but that column. Settings are the defaults. What the replay of zara02 showed has chosen how a guard's correction
is begun again. With `--faults` the driven agent has them, as in stress.py, and its guard knows of them or not; a step
takes 0.4 s. Certificates are made of the same windows, of which the first half calibrates the margin.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import jax
from common import RESULTS, append, read
from stress import MIDDLE, each_alone, name_of

import ringfence
from ringfence.evaluation.certify import certify
from ringfence.evaluation.compensation import known_to_guards
from ringfence.evaluation.replay import ReplayResult
from ringfence.faults import Faults
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.training.runs import write_json

LEARN = 0.7  # share of the time
NEIGHBOURS = 6
RADIUS = 0.5  # m: in zara02's first 70 % there are 33 entries below 0.4 m, 98 below 0.5 and 151 below 0.6
LONGEST = 40  # steps of an episode: a longer track is several, or few episodes would hold out much of the danger
PAIRED = {"without restarts": {"correction_restarts": 0}, "beyond the logs": {"within_logs": False}}
STRESSED = RESULTS / "stress" / "pedestrians.csv"
FIELDS = ("recording", "faults", "policy", "guard", "windows", "alone", "contacts", "prevented", "caused", "infeasible")
# Three strengths of what a step of 0.4 s leaves something of, and all at once.
_STRENGTHS = {"delay": (1, 2, 3), "drop": (0.3, 0.6, 0.8), "asynchrony": (0.5, 0.667, 0.75)}
_STRENGTHS |= {"noise": (0.02, 0.05, 0.1), "gain": (0.8, 0.6, 0.4)}  # noise in m, m/s
FAULTS = each_alone(_STRENGTHS, MIDDLE | {"delay": 1})
CERTIFIED: tuple[dict[str, Any], ...] = ({}, {"delay": 1}, {"drop": 0.3})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", type=Path, nargs="+", help="a table, two stores (to learn by, to replay), or a folder")
    parser.add_argument("--layout", help="of a table")
    parser.add_argument("--radius", type=float, default=RADIUS, help="m between centres")
    parser.add_argument("--name", required=True, help="of the logs, and of the result")
    parser.add_argument("--seconds", type=float, help="of a window: 5, of a recording in a folder 4")
    parser.add_argument("--windows", type=int, help="300, of a recording in a folder 1000")
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--out", type=Path, help="default: results/replay/NAME.json")
    a = parser.parse_args()
    walked = a.files[0].is_dir()
    if len(a.files) == 2:
        learn, judge = without_formula(*map(EpisodeStore.load, a.files))
    else:
        file = obsmat(a.files[0], a.name) if walked else a.files[0]
        how = {"layout": "obsmat"} if walked else {"layout": a.layout, "max_episode_steps": LONGEST}
        danger = constraints.Separation(a.radius, a.radius / 4)
        parts = EpisodeStore.split_table(
            file, LEARN, danger=danger, card={"task": a.name}, neighbours=NEIGHBOURS, **how
        )
        learn, judge = without_formula(*parts)
    steps = max(1, round((a.seconds or (4.0 if walked else 5.0)) / learn.card.dt))
    replays = {"radius": a.radius, "steps": steps, "windows": a.windows or (1000 if walked else 300)}
    if a.faults:
        behind_faults(learn, judge, a.name, replays, a.out or STRESSED)
    else:
        found = replayed(learn, judge, **replays)
        save(a.out or RESULTS / "replay" / f"{a.name}.json", found)


def obsmat(folder: Path, recording: str) -> Path:
    """The file of a recording in a folder, whatever it is called there."""
    found = sorted(path for path in folder.rglob("*obsmat.txt") if recording in str(path.relative_to(folder)))
    if not found:
        raise SystemExit(f"'{folder}' holds no obsmat.txt of {recording}; get it from github.com/crowdbotp/OpenTraj.")
    return found[0]


def without_formula(*parts: EpisodeStore) -> tuple[EpisodeStore, EpisodeStore]:
    """Logs to learn by and to judge by, whose costs are all that is known of danger."""
    hazard = constraints.to_dict(constraints.CostColumn())
    learn, judge = (dataclasses.replace(part, card=part.card.updated(hazard=hazard)) for part in parts)
    return learn, judge


def replayed(learn: EpisodeStore, judge: EpisodeStore, **how: Any) -> dict[str, Any]:
    """A clone and bad drivers among the logged others, and under the guard also without what PAIRED leaves out; `how`
    as for `ringfence.replay`."""
    world = ringfence.fit(learn)
    print(world.card, flush=True)
    with tempfile.TemporaryDirectory() as runs:
        (run,) = ringfence.train("bc", learn, seeds=(0,), out=runs)
        result = ringfence.replay(run, judge, world=world, anyway=True, **how)
        print(*result.summary(), sep="\n", flush=True)
        paired = {}
        for name, without in PAIRED.items():
            beside = ringfence.replay(run, judge, world=world, anyway=True, baselines=False, **without, **how)
            print(f"{name}:", *beside.summary(), sep="\n", flush=True)
            paired[name] = beside.to_json()["rows"]
    logs = {"episodes": learn.episodes, "steps": learn.steps, "unsafe": int((learn.costs > 0).sum())}
    card = world.card.to_json()
    barrier = {k: v for k, v in card["barrier"].items() if k not in ("calibration", "maps")}
    told = {"verdict": card["verdict"], "barrier": barrier, "foresight": card["prediction_error"].get("read", [])}
    return result.to_json() | paired | {"logs": logs, "world": told}


def behind_faults(learn: Any, judge: Any, recording: str, replays: dict[str, Any], out: Path) -> None:
    """A row for every driver without guard, under the shield, and under one that knows of the faults."""
    world = ringfence.fit(learn)
    with tempfile.TemporaryDirectory() as runs:
        (run,) = ringfence.train("bc", learn, seeds=(0,), out=runs)
        done = {(row["recording"], row["faults"]) for row in read(out)}
        for faults in FAULTS:
            if (recording, name_of(faults)) in done:
                continue
            how = {"world": world, "anyway": True, "baselines": False, "faults": faults, **replays}
            found = {"shield": ringfence.replay(run, judge, **how)}
            if known_to_guards(Faults.of(faults)):
                found["shield, compensated"] = ringfence.replay(run, judge, compensate=True, **how)
            for guard, result in found.items():
                stressed(result, guard, {"recording": recording, "faults": name_of(faults)}, out)
            jax.clear_caches()  # programs of each fault are many, and Linux bounds what one process may map
        promised = []
        for faults in CERTIFIED:
            made = certify(run, faults, logs=judge, world=world, anyway=True, episodes=1000, **without_windows(replays))
            print(*made.summary(), sep="\n", flush=True)
            promised.append(dataclasses.asdict(made))
            jax.clear_caches()
        save(out.with_suffix(".json"), {"recording": recording, "certificates": promised})


def without_windows(replays: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in replays.items() if k != "windows"}


def stressed(result: ReplayResult, guard: str, about: dict[str, str], out: Path) -> None:
    """Rows of a replay; windows without a guard are the same under each, and are kept once."""
    for row in result.rows:
        if row.filter != "none" or guard == "shield":
            kept = {name: getattr(row, name) for name in FIELDS if name not in (*about, "guard")}
            append(out, about | kept | {"guard": "none" if row.filter == "none" else guard}, FIELDS)


def save(out: Path, found: dict[str, Any]) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, found)


if __name__ == "__main__":
    main()
