"""Systems drawn at random, which nobody has looked at: is danger learned from a cost column alone, and kept?

    python benchmarks/drawn.py results/proving/drawn [--seed 1] [--systems 10] [--episodes 60] [--rows "bc none" ...]

Bodies, dangers, who pays, names, numbers and sizes are drawn from what the proving ground can make. A draw is left out
if less than 0.3 % or more than a third of its logged steps cost, or if no agent has room. Rows as
`benchmarks/proving.py` has them; a file tells the draw. Another seed draws others.
"""

import argparse
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import proving

from ringfence.datasets.make import make
from ringfence.datasets.registry import TASKS
from ringfence.envs import System
from ringfence.envs.proving.layout import PLANAR
from ringfence.errors import UserError

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


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    reader.add_argument("out", type=Path)
    reader.add_argument("--seed", type=int, default=1)
    reader.add_argument("--systems", type=int, default=10)
    reader.add_argument("--episodes", type=int, default=60)
    reader.add_argument("--rows", nargs="*", default=proving.USUAL, choices=proving.NAMES)
    reader.add_argument("--runs", type=Path, default=Path("runs"))
    given = reader.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    kept = 0
    for k, system in enumerate(drawn(given.seed)):
        task = proving.task_of(system, f"proving-drawn-{given.seed}-{k}")
        share = logged_danger(task)
        if share is None or not SHARE[0] <= share <= SHARE[1]:
            print(task, "left out:", "no room" if share is None else f"{100 * share:.2f} % of steps cost", flush=True)
            continue
        print(task, system, flush=True)
        file = given.out / f"{given.seed}-{k}.json"
        found = proving.system(task, given.runs, given.episodes, given.rows, file)
        file.write_text(json.dumps(found | {"system": dataclasses.asdict(system)}, indent=1) + "\n")
        proving.tell(found)
        kept += 1
        if kept == given.systems:
            return


if __name__ == "__main__":
    main()
