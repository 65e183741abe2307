"""More systems in one seed, drawn when the proving ground's sixteen were fixed: what is left to learn of danger.

    python benchmarks/others.py results/proving/others [--systems x1 x5] [--episodes 100] [--rows "bc none" ...]

Rows as `benchmarks/proving.py` has them. Three of the systems have chosen something: `x1` that nothing has its margin
out of distribution and that nobody is predicted to go backwards, `x2` that names are looked for in logs, `x5` that
every agent has a way out of its own. The others have chosen nothing.
"""

import argparse
from pathlib import Path

import proving

from ringfence.envs import System

SYSTEMS = {
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


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    reader.add_argument("out", type=Path)
    reader.add_argument("--systems", nargs="*", default=list(SYSTEMS), choices=list(SYSTEMS))
    reader.add_argument("--episodes", type=int, default=100)
    reader.add_argument("--rows", nargs="*", default=proving.USUAL, choices=proving.NAMES)
    reader.add_argument("--runs", type=Path, default=Path("runs"))
    given = reader.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.systems:
        task = proving.task_of(SYSTEMS[name], f"proving-other-{name}")
        proving.tell(proving.system(task, given.runs, given.episodes, given.rows, given.out / f"{name}.json"))


if __name__ == "__main__":
    main()
