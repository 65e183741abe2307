"""Sixteen systems that make the suite, and four that settings may be chosen on."""

from __future__ import annotations

from ringfence.envs.proving.system import System

# Settings of the library are chosen elsewhere, but for these: `drones` told how fast scores fall out of distribution
# where a guard stays within the logs (guards/barrier.py), `drones`, `couriers` and `convoy` which rows of a plan are to
# stay within them (guards/shown.py), `convoy` and `crowd` how much near rows count (guards/correction.py), and `gears`
# had names looked for in logs (problem/inferred_names.py).
TEST: dict[str, System] = {
    "discs": System("integrator", ("mover", "pairs"), 3, mover=(0.35, 1.0, 16.0)),
    "posts": System("integrator", ("pairs", "posts"), 4, drag=0.3),
    "flock": System(
        "integrator", ("apart", "pairs"), 4, goals="team", lag=0.2, uneven=0.5, side=7.0, episode_length=100
    ),
    "hall": System(
        "unicycle",
        ("pairs", "walls", "posts"),
        4,
        costs="each",
        side=5.0,
        posts=((1.2, 0.8, 0.3), (-1.2, 0.6, 0.4), (0.1, -1.2, 0.25)),
        episode_length=100,
    ),
    "crowd": System("unicycle", ("pairs",), 12, costs="each", drivers="careless", homogeneous=True, side=7.0, drag=0.2),
    "couriers": System("unicycle", ("battery", "pairs"), 5, costs="each", side=5.0, episode_length=100),
    "street": System("car", ("pairs",), 3, side=6.0, dt=0.08, mass=1.2, episode_length=100),
    "lane": System(
        "car", ("corridor",), 2, names="none", drivers="careful", side=8.0, corridor=(1.3, 0.6, 1.4), drag=0.3
    ),
    "drones": System("quadrotor", ("pairs", "walls"), 3, drivers="careless", side=3.4, dt=0.05, episode_length=100),
    "pillar": System(
        "quadrotor", ("posts",), 1, names="none", dt=0.05, mass=1.2, posts=((0.0, 0.0, 0.5),), episode_length=100
    ),
    "convoy": System("platoon", ("pairs",), 6, costs="each", drivers="careless", lag=0.2, drag=0.05),
    "train": System("platoon", ("apart", "pairs"), 8, goals="team", apart_limit=1.8, uneven=0.6, drivers="careless"),
    "arms": System("arm", ("pairs",), 2, drivers="careless", dt=0.05, radius=0.1, episode_length=100),
    "bench": System(
        "arm",
        ("joints", "posts"),
        3,
        costs="each",
        names="none",
        drivers="careful",
        dt=0.05,
        radius=0.08,
        joint_limit=1.3,
        posts=((-0.4, 0.6, 0.1), (0.5, 0.6, 0.1)),
        episode_length=100,
    ),
    "shafts": System("motor", ("speed",), 4, drivers="careful", lag=0.3, speed_limit=1.5),
    "gears": System(
        "motor", ("apart",), 6, names="none", goals="team", lag=0.3, drivers="careless", uneven=0.5, apart_limit=0.5
    ),
}

# For choosing settings.
DEVELOPMENT: dict[str, System] = {
    "room": System("integrator", ("pairs", "walls"), 3, costs="each", drivers="careless", side=3.4, mass=1.4),
    "path": System("unicycle", ("corridor", "pairs"), 2, drivers="careful", side=6.0, corridor=(0.9, 0.7, 0.8)),
    "swing": System(
        "arm",
        ("posts",),
        2,
        drivers="careless",
        radius=0.08,
        posts=((0.0, 0.59, 0.1),),
        dt=0.05,
        episode_length=100,
        uneven=0.3,
    ),
    "file": System("platoon", ("pairs", "speed"), 4, names="none", speed_limit=1.6),
}
