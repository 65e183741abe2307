"""Policies of this package in MPE2's own `simple_spread_v3`, which nobody here wrote and whose bodies move by other
rules than the data's; and logs recorded there, learned and guarded like anybody's own.

    pip install mpe2
    python benchmarks/other_spread.py        # writes results/mpe2.csv; resumable

A quarter of an hour on one core. Rows that are there already are not made again.
"""

from __future__ import annotations

import logging
import tempfile
import warnings

import numpy as np
from common import RESULTS, append, read

import ringfence
from ringfence.deploy import zoo
from ringfence.envs import SimpleSpread
from ringfence.envs.mpe2 import Spread
from ringfence.envs.pettingzoo import SimpleSpreadParallel

OUT = RESULTS / "mpe2.csv"
EPISODES, LOGGED = 200, 2000
NAMES = SimpleSpread().feature_map("decentralized").names
OWN = "bc, learned of logs recorded there"
PLACES = {
    "mpe2": Spread,
    "ours, its rules": lambda: SimpleSpreadParallel(integrator="position_first", reward="pettingzoo"),
    "ours, the data's rules": lambda: SimpleSpreadParallel(reward="pettingzoo"),
}


def main() -> None:
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as there:
        for name in ("simple_spread-expert/bc", "simple_spread-expert/icbf"):
            run = zoo.pretrained(name, there)
            for place, make in PLACES.items():
                for how in ({}, {"guard": "shield"}):
                    if missing(name, place, how):
                        result = ringfence.play(run, make, episodes=EPISODES, num_envs=100, **how)
                        keep(name, "OMAR's rules", place, result)
        pilot = ringfence.Controller(zoo.pretrained("simple_spread-expert/bc", there))
        rng = np.random.default_rng(0)
        unsure = lambda seen, state: np.clip(pilot.act(seen, state) + 0.5 * rng.normal(size=(3, 2)), -1, 1)  # noqa: E731
        card = {"task": "mpe2-spread", "observation_names": [*NAMES, *(f"silence{k}" for k in range(4))]}
        store = ringfence.collect(Spread, unsure, episodes=LOGGED, card=card)
        world = ringfence.fit(store)
        run = ringfence.train("bc", store, out=there, quiet=True)[0]
        for how in ({}, {"guard": "shield", "world": world}):
            if missing(OWN, "mpe2", how):
                result = ringfence.play(run, Spread, episodes=EPISODES, num_envs=100, **how)
                keep(OWN, "mpe2", "mpe2", result)


def missing(policy: str, place: str, how: dict) -> bool:
    """Whether the table has no such row yet."""
    wanted = (policy, place, how.get("guard", "none"))
    return wanted not in {(r["policy"], r["place"], r["guard"]) for r in read(OUT)}


def keep(policy: str, logs: str, place: str, result: dict) -> None:
    """A row more."""
    found = {
        "policy": policy,
        "logs": logs,
        "place": place,
        "guard": result["guard"],
        "episodes": result["episodes"],
        "return": round(result["return_mean"], 3),
        "low": round(result["return_interval"][0], 3),
        "high": round(result["return_interval"][1], 3),
        "cost": round(result["cost_mean"], 4),
        "cost_safe_start": round(result["cost_safe_start"], 4),
        "violation_rate": round(result["violation_rate"], 4),
        "infeasible_rate": round(result.get("infeasible_rate", 0.0), 4),
    }
    append(OUT, found, tuple(found))


if __name__ == "__main__":
    main()
