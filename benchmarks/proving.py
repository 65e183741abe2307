"""The proving ground: is danger learned from a cost column alone, and kept?

    python benchmarks/proving.py results/proving [--tasks proving-hall ...] [--episodes 60] [--rows "bc none" ...]
                                                 [--seed 1]

For every system: the World's verdict, what it found danger to be caused by, and the share of episodes with a violation
of a clone and of the naive driver: alone, under guards by what was learned, and by the oracle, which knows dynamics
and distances. `--rows` names some of them (`ROWS`, `BESIDE`, `HORIZONS` and `FILTERED` below, of `bc` or `naive`); by
default all of `ROWS` are played. Rows of the same World that a file holds already, of as many episodes or more, are not
played again. Clone and World are of the same logs and of seed 0; those of another seed have files of their own, in
`seed-1` and so on. Other tasks have the rows that they can have, e.g. `--tasks crossing-hasty`. `ringfence bench
proving-ground` plays everything with 500 episodes.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

from _cbf import CbfQp, filtered
from _common import machine

import ringfence
from ringfence.datasets.make import make
from ringfence.datasets.registry import TASKS
from ringfence.envs import System
from ringfence.envs.proving.suite import TEST
from ringfence.errors import UserError
from ringfence.evaluation.evaluate import evaluate
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.loading.resolve import resolve
from ringfence.loading.spec import PolicySpec
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
ALL = "shield learned, networks on all entries"
BESIDE = {
    "shield learned, beyond the logs": LEARNED | {"within_logs": False},
    "shield learned, margin 2": LEARNED | {"margin": 2.0},
    "adapt learned": LEARNED | {"guard": "adapt"},
    "full learned": LEARNED | {"guard": "full"},
    ALL: LEARNED | {"world": "all"},
}
HORIZONS = {f"shield learned, {rows} rows": LEARNED | {"horizon": rows} for rows in (3, 15, 30)}
# A classical filter that knows distances and dynamics (_cbf.py), where there is one.
FILTERED = {"cbf-qp": {}}
OPTIONS = ROWS | BESIDE | HORIZONS | FILTERED
NAMES = [f"{driver} {row}" for row in OPTIONS for driver in ("bc", "naive")]  # in the order in which they are played
OF_NO_WORLD = ("none", "shield oracle", "cbf-qp")  # rows that read none
USUAL = [f"{driver} {row}" for row in ROWS for driver in ("bc", "naive")]


def task_of(system: System, name: str) -> str:
    """The name of a task that nobody registered, from now on known as one of the proving ground."""
    room = TASKS["proving-dev-room"]
    TASKS[name] = dataclasses.replace(room, name=name, env=system, homogeneous=system.homogeneous)
    return name


def played(run, row: str, options: dict, episodes: int) -> dict:
    begun = time.perf_counter()
    if row in FILTERED:
        resolved = resolve(PolicySpec.of(run))
        task = resolved.job.task
        policy = CbfQp(resolved.team, task.env)
        found, _ = evaluate_policy(policy, task, episodes, "test", run.config["seed"])
    else:
        found = evaluate(run, episodes=episodes, **options)
    kept = {"episodes": episodes} | {name: found[name] for name in COLUMNS if name in found}
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


def system(task: str, runs: Path, episodes: int, names: list[str], file: Path, seed: int = 0) -> dict:
    begun = time.perf_counter()
    store, _ = make(TASKS[task])
    drivers = ["bc", "naive"] if isinstance(TASKS[task].env, System) else ["bc"]
    trained = {name: ringfence.train(name, store, out=str(runs), seeds=(seed,), quiet=True)[0] for name in drivers}
    fitted = time.perf_counter()
    card = worlds.fit(store, seed=seed).card
    seconds = {"made and trained": fitted - begun, "fitted": time.perf_counter() - fitted}
    found = {
        "task": task,
        "logs": {
            "return_mean": float(store.returns.mean()),
            "violation_rate": float((store.episode_costs > 0).mean()),
            "unsafe_share": card.barrier.unsafe_share,
        },
        **described(card),
        "seconds": {name: round(value, 1) for name, value in seconds.items()},
        "machine": machine(),
        "rows": rows_of(file, card),
    }
    every = None
    if any(name.endswith(ALL) for name in names):
        every = worlds.fit(store, seed=seed, causes=False)
        found["networks on all entries"] = described(every.card)
    for name in names:
        driver, _, row = name.partition(" ")
        if row in FILTERED and not filtered(TASKS[task].env):
            continue
        if driver not in drivers or found["rows"].get(name, {}).get("episodes", 0) >= episodes:
            continue
        options = OPTIONS[row]
        given = options | {"world": every} if "world" in options else options
        try:
            found["rows"][name] = played(trained[driver], row, given, episodes)
        except UserError as error:
            found["rows"][name] = {"episodes": episodes, "refused": str(error)}
        file.write_text(json.dumps(found, indent=1) + "\n")
    return found


def rows_of(file: Path, card) -> dict:
    """What a file holds: of the same World, or of none."""
    if not file.exists():
        return {}
    kept = json.loads(file.read_text())
    # as text, since what is not known is NaN, which equals nothing
    same = all(json.dumps(kept.get(name)) == json.dumps(value) for name, value in described(card).items())
    return {name: row for name, row in kept["rows"].items() if same or name.partition(" ")[2] in OF_NO_WORLD}


def tell(found: dict) -> None:
    """What was found of a system, on the terminal."""
    print(found["task"], found["verdict"], found["causes"], f"recall {found['recall']:.3f}", flush=True)
    for label, row in found["rows"].items():
        print("   ", label, {name: round(value, 3) for name, value in row.items() if isinstance(value, float)})


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    reader.add_argument("out", type=Path)
    reader.add_argument("--tasks", nargs="*", default=[f"proving-{name}" for name in TEST], choices=sorted(TASKS))
    reader.add_argument("--episodes", type=int, default=60)
    reader.add_argument("--rows", nargs="*", default=USUAL, choices=NAMES)
    reader.add_argument("--runs", type=Path, default=Path("runs"))
    reader.add_argument("--seed", type=int, default=0)
    given = reader.parse_args()
    out = given.out / f"seed-{given.seed}" if given.seed else given.out
    out.mkdir(parents=True, exist_ok=True)
    for task in given.tasks:
        tell(system(task, given.runs, given.episodes, given.rows, out / f"{task}.json", given.seed))


if __name__ == "__main__":
    main()
