"""Logs of traffic or of a swarm, replayed: one of them driven, the others as logged.

python benchmarks/replayed.py telemetry.csv --layout syndrone --radius 2 --name a-den    # results/replay/a-den.json
python benchmarks/replayed.py fcd.xml --layout sumo --radius 2.5 --name town
python benchmarks/replayed.py citr.h5 citr-rest.h5 --radius 0.8 --name citr

FILE is a table in one of the layouts of `ringfence data import-table`; docs/replay-results.md says where to get some.
It is split by time: the first 70 % to learn by, the rest to replay. Two files are the parts that `import-table --split`
wrote. A step costs 1 where two centres come closer than the radius, and the World reads nothing but that column.
Settings are the defaults.
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
LEARN = 0.7  # share of the time
NEIGHBOURS = 6
PAIRED = {"without restarts": {"correction_restarts": 0}, "beyond the logs": {"within_logs": False}}
LONGEST = 40  # steps of an episode: a longer track is several, or few episodes would hold out much of the danger


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", type=Path, nargs="+", help="a table, or two stores: to learn by, and to replay")
    parser.add_argument("--layout", help="of a table")
    parser.add_argument("--radius", type=float, required=True, help="m between centres")
    parser.add_argument("--name", required=True, help="of the logs, and of the result")
    parser.add_argument("--seconds", type=float, default=5.0, help="of a window")
    parser.add_argument("--windows", type=int, default=300)
    parser.add_argument("--out", type=Path, help="default: results/replay/NAME.json")
    a = parser.parse_args()
    if len(a.files) == 2:
        learn, judge = without_formula(*map(EpisodeStore.load, a.files))
    else:
        how = {"layout": a.layout, "neighbours": NEIGHBOURS, "max_episode_steps": LONGEST}
        learn, judge = by_cost(a.files[0], a.radius, a.name, **how)
    steps = max(1, round(a.seconds / learn.card.dt))
    found = replayed(learn, judge, radius=a.radius, steps=steps, windows=a.windows)
    write(a.out or OUT / f"{a.name}.json", found)


def by_cost(file: Path, radius: float, name: str, **how: Any) -> tuple[EpisodeStore, EpisodeStore]:
    """Logs to learn by and to judge by, whose costs are all that is known of danger."""
    danger = constraints.Separation(radius, radius / 4)
    return without_formula(*EpisodeStore.split_table(file, LEARN, danger=danger, card={"task": name}, **how))


def without_formula(*parts: EpisodeStore) -> tuple[EpisodeStore, EpisodeStore]:
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
    return result.to_json() | paired | {"logs": logs, "world": told(world)}


def told(world: Any) -> dict[str, Any]:
    """What the World's card says of itself."""
    card = world.card.to_json()
    barrier = {k: v for k, v in card["barrier"].items() if k not in ("calibration", "maps")}
    read = card["prediction_error"].get("read", [])
    return {"verdict": card["verdict"], "barrier": barrier, "foresight": read}


def write(out: Path, found: dict[str, Any]) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, found)


if __name__ == "__main__":
    main()
