"""The proving ground in one seed and few episodes: is danger learned from a cost column alone, and kept?

    python benchmarks/proving.py results/proving [--tasks proving-hall ...] [--episodes 100] [--beside]

For every system: the World's verdict, what it found danger to be caused by, and the share of episodes with a violation
of a clone and of the naive driver: alone, under `shield` by what was learned, and by the oracle, which knows dynamics
and distances. With `--beside` also what differs in one thing: networks on all entries in the place of causes
(`causes=False`), and other horizons. Rows that a file holds already are not played again. Other tasks have the rows
that they can have, e.g. `--tasks crossing-hasty`. `ringfence bench proving-ground` plays all with 500 episodes.
"""

import argparse
import json
import time
from pathlib import Path

from _common import machine

import ringfence
from ringfence.datasets.make import make
from ringfence.datasets.registry import TASKS
from ringfence.envs import System
from ringfence.envs.proving.suite import TEST
from ringfence.errors import UserError
from ringfence.evaluation.evaluate import evaluate
from ringfence.training import worlds

COLUMNS = ("return_mean", "violation_rate", "cost_mean", "infeasible_rate")
LEARNED = {"guard": "shield", "anyway": True}
# What a clone and the naive driver are played by.
ROWS = {
    "none": {},
    "shield learned": LEARNED,
    "shield oracle": {"guard": "shield", "barrier": "oracle"},
}
# What differs in one thing; the World of `all` is fitted without a search for causes.
BESIDE = {"shield learned, networks on all entries": LEARNED | {"world": "all"}}
HORIZONS = {f"shield learned, {rows} rows": LEARNED | {"horizon": rows} for rows in (3, 15, 30)}


def played(run, options: dict, episodes: int) -> dict:
    begun = time.perf_counter()
    found = evaluate(run, episodes=episodes, **options)
    kept = {name: found[name] for name in COLUMNS if name in found}
    return kept | {"seconds": round(time.perf_counter() - begun, 1)}


def described(card) -> dict:
    """What a World says of itself."""
    return {
        "verdict": card.verdict.word,
        "reasons": list(card.verdict.reasons),
        "causes": [cause.name for found in card.causes.values() for cause in found.causes],
        "recall": card.barrier.recall,
        "auroc": card.barrier.auroc,
        "margin_kept": card.barrier.margin_kept,
        "probed": card.barrier.probed,
        "horizon": card.barrier.avoidable.rows if card.barrier.avoidable else None,
    }


def system(task: str, runs: Path, episodes: int, beside: bool, file: Path) -> dict:
    begun = time.perf_counter()
    store, _ = make(TASKS[task])
    drivers = {"bc": ROWS | (BESIDE | HORIZONS if beside else {})}
    if isinstance(TASKS[task].env, System):
        drivers["naive"] = ROWS | (BESIDE if beside else {})
    trained = {name: ringfence.train(name, store, out=str(runs), quiet=True)[0] for name in drivers}
    fitted = time.perf_counter()
    card = worlds.fit(store, seed=0).card
    seconds = {"made and trained": fitted - begun, "fitted": time.perf_counter() - fitted}
    found = {
        "task": task,
        "episodes": episodes,
        "logs": {
            "return_mean": float(store.returns.mean()),
            "violation_rate": float((store.episode_costs > 0).mean()),
            "unsafe_share": card.barrier.unsafe_share,
        },
        **described(card),
        "seconds": {name: round(value, 1) for name, value in seconds.items()},
        "machine": machine(),
        "rows": rows_of(file, card, episodes),
    }
    every = worlds.fit(store, seed=0, causes=False) if beside else None
    if every is not None:
        found["networks on all entries"] = described(every.card)
    wanted = [(label, name) for name, rows in drivers.items() for label in rows]
    order = list(ROWS | BESIDE | HORIZONS)
    for label, name in sorted(wanted, key=lambda row: order.index(row[0])):  # what takes longest comes last
        if f"{name} {label}" in found["rows"]:
            continue
        options = drivers[name][label]
        given = options | {"world": every} if "world" in options else options
        try:
            found["rows"][f"{name} {label}"] = played(trained[name], given, episodes)
        except UserError as error:
            found["rows"][f"{name} {label}"] = {"refused": str(error)}
        file.write_text(json.dumps(found, indent=1) + "\n")
    return found


def rows_of(file: Path, card, episodes: int) -> dict:
    """What a file holds of the same World and as many episodes."""
    if not file.exists():
        return {}
    kept = json.loads(file.read_text())
    told = json.loads(json.dumps(described(card)))
    same = kept.get("episodes") == episodes and all(kept.get(name) == value for name, value in told.items())
    return kept["rows"] if same else {}


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__)
    reader.add_argument("out", type=Path)
    reader.add_argument("--tasks", nargs="*", default=[f"proving-{name}" for name in TEST], choices=sorted(TASKS))
    reader.add_argument("--episodes", type=int, default=100)
    reader.add_argument("--beside", action="store_true")
    reader.add_argument("--runs", type=Path, default=Path("runs"))
    given = reader.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for task in given.tasks:
        found = system(task, given.runs, given.episodes, given.beside, given.out / f"{task}.json")
        print(task, found["verdict"], found["causes"], f"recall {found['recall']:.3f}", flush=True)
        for label, row in found["rows"].items():
            print("   ", label, {name: round(value, 3) for name, value in row.items() if isinstance(value, float)})


if __name__ == "__main__":
    main()
