"""The proving ground: is danger learned from a cost column alone, and kept?

    python benchmarks/proving.py results/proving [--tasks proving-hall ...] [--episodes 60] [--rows "bc none" ...]
                                                 [--seed 1]

For every system: the World's verdict, what it found danger to be caused by, and the share of episodes with a violation
of a clone and of the naive driver: alone, under guards by what was learned, and by the oracle, which knows dynamics
and distances. `--rows` names some of them (`ROWS`, `BESIDE`, `HORIZONS` and `FILTERED` below, of `bc` or `naive`); by
default all of `ROWS` are played. Rows of the same World that a file holds already, of as many episodes or more, are not
played again. Clone and World are of the same logs and of seed 0; those of another seed have files of their own, in
`seed-1` and so on. Other tasks have the rows that they can have, e.g. `--tasks crossing-hasty`. `ringfence bench
proving-ground` plays everything with 500 episodes. `--tasks x1 x5` are of `OTHERS`; `drawn-1-3` are three systems that
seed 1 draws at random from what the proving ground can make, whose files tell the draw. A draw is left out if less than
0.3 % or more than a third of its logged steps cost, or if no agent has room.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from common import keep, machine, of_json
from filters import CbfQp, filtered

import ringfence
from ringfence.datasets.make import make
from ringfence.datasets.registry import TASKS, get
from ringfence.envs import System
from ringfence.envs.proving.layout import PLANAR
from ringfence.envs.proving.system import TEST
from ringfence.errors import UserError
from ringfence.evaluation.evaluate import evaluate
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.loading.resolve import resolve
from ringfence.loading.spec import PolicySpec
from ringfence.training import worlds

COLUMNS = ("return_mean", "violation_rate", "cost_mean", "infeasible_rate")
LEARNED = {"guard": "shield", "anyway": True}
# What a clone and the naive driver are played by.
ROWS = {"none": {}, "shield learned": LEARNED, "shield oracle": {"guard": "shield", "barrier": "oracle"}}
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
# A classical filter that knows distances and dynamics (filters.py), where there is one.
FILTERED = {"cbf-qp": {}}
OPTIONS = ROWS | BESIDE | HORIZONS | FILTERED
NAMES = [f"{driver} {row}" for row in OPTIONS for driver in ("bc", "naive")]  # in the order in which they are played
OF_NO_WORLD = ("none", "shield oracle", "cbf-qp")  # rows that read none
USUAL = [f"{driver} {row}" for row in ROWS for driver in ("bc", "naive")]

# Drawn when the sixteen were fixed. Three have chosen something: `x1` that nothing has its margin out of distribution
# and that nobody is predicted to go backwards, `x2` that names are looked for in logs, `x5` that every agent has a way
# out of its own. The others have chosen nothing.
OTHERS = {
    "x1": System("unicycle", ("mover", "walls", "pairs"), 3, drivers="careful", side=5.0, episode_length=100),
    "x2": System("integrator", ("posts", "pairs"), 2, drivers="careful", mass=2.0, names="none"),
    "x3": System(
        "quadrotor", ("corridor", "pairs"), 2, side=7.0, dt=0.05, corridor=(1.0, 0.5, 0.8), episode_length=100
    ),
    "x4": System("car", ("walls", "pairs"), 4, costs="each", drivers="careless", side=6.0, episode_length=100),
    "x5": System("platoon", ("pairs", "speed"), 5, drivers="careful", speed_limit=1.4),
    "x6": System("motor", ("apart", "speed"), 3, lag=0.2, goals="team", apart_limit=0.6, speed_limit=1.2),
    "x7": System("integrator", ("battery", "mover"), 2, costs="each", drag=0.2, episode_length=120),
    "x8": System("unicycle", ("pairs",), 8, homogeneous=True, costs="each", side=6.0),
    # What is touched throws a body back, so that nobody is ever logged within danger.
    "x9": System("integrator", ("posts", "walls", "pairs"), 3, side=4.5, rebound=0.4),
    "x10": System("unicycle", ("walls", "posts"), 4, side=6.0, names="none", rebound=0.3, episode_length=100),
}


PLACES = ("pairs", "walls", "posts", "mover", "corridor", "apart", "speed", "battery")
DANGERS = {
    **dict.fromkeys(PLANAR, PLACES),
    "platoon": ("pairs", "apart", "speed"),
    "arm": ("posts", "joints", "speed"),  # arms that touch one another are a known fault (docs/proving-ground.md)
    "motor": ("apart", "speed", "joints"),
}
SHARE = 0.003, 0.33  # of logged steps that cost


def drawn(seed: int) -> Iterator[System]:
    """One after the other, without end."""
    rng = np.random.default_rng(seed)
    while True:
        try:
            yield System(**draw(rng))
        except UserError:  # a danger that needs more agents
            continue


def draw(rng: np.random.Generator) -> dict[str, Any]:
    """Fields of a system, from what is usual for its body to twice or half of it."""
    body = str(rng.choice(list(DANGERS)))
    danger = tuple(str(one) for one in rng.choice(DANGERS[body], rng.integers(1, 4), replace=False))
    fast = body in ("quadrotor", "arm")
    agents = int(rng.integers(1, 9))
    formation = "apart" in danger and body != "platoon"
    side = 3.2 + 0.45 * agents if body in PLANAR else 4.0
    return {
        "body": body,
        "danger": danger,
        "n_agents": min(agents, 3) if body == "arm" else agents,
        "costs": str(rng.choice(["team", "each"])),
        "names": str(rng.choice(["all", "all", "none"])),
        "drivers": str(rng.choice(["careless", "mixed", "careful"])),
        "goals": "team" if formation else "own",
        "mass": round(float(rng.uniform(0.7, 1.6)), 2),
        "uneven": round(float(rng.choice([0.0, 0.0, 0.3, 0.5])), 2),
        "drag": round(float(rng.uniform(0.0, 0.4)), 2),
        "lag": round(float(rng.choice([0.0, 0.0, 0.15, 0.3])), 2),
        "dt": round(float(rng.choice([0.05, 0.08] if fast else [0.08, 0.1, 0.15])), 3),
        "episode_length": int(rng.choice([80, 100, 120])),
        "radius": round(float(rng.uniform(0.08, 0.1) if body == "arm" else rng.uniform(0.12, 0.22)), 3),
        "side": round(float(side * rng.uniform(1.0, 1.4)), 2),
        "posts": posts(rng, body, side),
        "mover": (round(float(rng.uniform(0.2, 0.4)), 2), 1.0, float(rng.choice([8.0, 12.0, 18.0]))),
        "corridor": (round(float(rng.uniform(0.8, 1.4)), 2), 0.6, round(float(rng.uniform(0.7, 1.4)), 2)),
        "joint_limit": round(float(rng.uniform(1.0, 1.6)), 2),
        "apart_limit": round(float(rng.uniform(0.5, 0.8) if body == "motor" else rng.uniform(1.2, 2.0)), 2),
        "speed_limit": round(float(rng.uniform(0.6, 1.2) if body in PLANAR else rng.uniform(1.2, 1.8)), 2),
    }


def posts(rng: np.random.Generator, body: str, side: float) -> tuple[tuple[float, float, float], ...]:
    if body == "arm":
        return tuple((round(float(rng.uniform(-0.5, 0.5)), 2), 0.6, 0.1) for _ in range(2))
    places = rng.uniform(-0.3 * side, 0.3 * side, (int(rng.integers(1, 4)), 2))
    return tuple((round(float(x), 2), round(float(y), 2), round(float(rng.uniform(0.2, 0.4)), 2)) for x, y in places)


def logged_danger(task: str) -> float | None:
    """Share of logged steps that cost; nothing where agents find no room."""
    try:
        store, _ = make(TASKS[task])
    except UserError:
        return None
    return float((store.costs > 0).mean())


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
        found = worlds.with_world(evaluate, run, episodes=episodes, **options)
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
        keep(file, found)
    return found


def rows_of(file: Path, card) -> dict:
    """What a file holds: of the same World, or of none."""
    kept = of_json(file.resolve())
    if not kept:
        return {}
    # as text, since what is not known is NaN, which equals nothing
    same = all(json.dumps(kept.get(name)) == json.dumps(value) for name, value in described(card).items())
    return {name: row for name, row in kept["rows"].items() if same or name.partition(" ")[2] in OF_NO_WORLD}


def tell(found: dict) -> None:
    """What was found of a system, on the terminal."""
    print(found["task"], found["verdict"], found["causes"], f"recall {found['recall']:.3f}", flush=True)
    for label, row in found["rows"].items():
        print("   ", label, {name: round(value, 3) for name, value in row.items() if isinstance(value, float)})


def registered(task: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Names of tasks that an argument stands for, and what their files say besides: a task of the library, `x1` and so
    on, or `drawn-SEED-COUNT`, so many draws of a seed."""
    if task in OTHERS:
        yield task_of(OTHERS[task], f"proving-other-{task}"), {}
    elif not task.startswith("drawn-"):
        yield get(task).name, {}
    else:
        seed, kept = (int(x) for x in task.split("-")[1:])
        for k, one in enumerate(drawn(seed)):
            name = task_of(one, f"proving-drawn-{seed}-{k}")
            share = logged_danger(name)
            if share is None or not SHARE[0] <= share <= SHARE[1]:
                why = "no room" if share is None else f"{100 * share:.2f} % of steps cost"
                print(name, "left out:", why, flush=True)
                continue
            yield name, {"system": dataclasses.asdict(one)}
            kept -= 1
            if not kept:
                return


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    reader.add_argument("out", type=Path)
    reader.add_argument("--tasks", nargs="*", default=[f"proving-{name}" for name in TEST])
    reader.add_argument("--episodes", type=int, default=60)
    reader.add_argument("--rows", nargs="*", default=USUAL, choices=NAMES)
    reader.add_argument("--runs", type=Path, default=Path("runs"))
    reader.add_argument("--seed", type=int, default=0)
    given = reader.parse_args()
    out = given.out / f"seed-{given.seed}" if given.seed else given.out
    out.mkdir(parents=True, exist_ok=True)
    for task, more in (each for name in given.tasks for each in registered(name)):
        name = task.removeprefix("proving-other-").removeprefix("proving-drawn-")
        file = out / f"{name}.json"
        found = system(task, given.runs, given.episodes, given.rows, file, given.seed) | more
        keep(file, found)
        tell(found)


if __name__ == "__main__":
    main()
