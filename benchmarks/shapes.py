"""A naive driver and a clone of small systems' logs (systems.py), alone and under a shield by a World of these logs.

    python benchmarks/shapes.py                    # of all; ten minutes a system
    python benchmarks/shapes.py docks --seed 11    # of some, by other logs
    python benchmarks/shapes.py --families open    # of systems that the search had not seen (families.py)

Systems whose danger is no distance alone go to results/shapes.csv, those that log places to results/on_map.csv, the
one that logs a list of who is near to results/proving/trackers.json, and families, of 60 episodes a row, to
results/families.csv. Rows that are there are not made again.
Rows whose `causes` says `rules` are of Worlds as they are fitted now. The others are of before: `more shapes` and
`no rules` of commit 82554daf, what lacks something of revision cac628af, which patched the library for them.
"""

from __future__ import annotations

import argparse
import warnings
from typing import Any

from common import RESULTS, append, brief, keep, of_json, read
from families import FAMILIES
from systems import MAPPED, SHAPED, TRACKED, Kind

import ringfence
from ringfence.evaluation.statistics import upper_bound

LOGGED, EPISODES = 600, 100
HEAD = ("system", "seed", "driver", "causes", "verdict", "found", "guard")
HEAD += ("episodes", "return", "violated", "bound", "infeasible_rate")
GROUPS = (("shapes.csv", SHAPED, "rules", 10), ("on_map.csv", MAPPED, "how far away", 13))
OF_FAMILY = (*HEAD, "family", "kept")
WAYS = [(driver, guard) for driver in ("naive", "clone") for guard in ("none", "shield")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("systems", nargs="*", help="all by default")
    parser.add_argument("--seed", type=int, help="of the logs")
    parser.add_argument("--families", choices=("open", "kept"), help="systems that anybody may look at, or the others")
    parser.add_argument("--causes", default="rules", help="what to call this version in rows")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if given.families:
        for family in FAMILIES:
            for kind in getattr(family, given.families):
                if kind.name in (given.systems or [kind.name]):
                    of = {"family": family.name, "kept": int(given.families == "kept")}
                    seed = 12 if given.seed is None else given.seed
                    rows_of(kind, "families.csv", given.causes, seed, 60, of)
        return
    for file, kinds, whole, seed in GROUPS:
        for kind in kinds:
            if kind.name in (given.systems or [kind.name]):
                rows_of(kind, file, whole, seed if given.seed is None else given.seed)
    found = of_json("proving/trackers.json")
    if TRACKED.name in (given.systems or [TRACKED.name]) and "today" not in found:
        keep(RESULTS / "proving" / "trackers.json", found | {"today": tracked()})


def played(kind: Kind, world: Any, clone: Any, driver: str, guard: str, episodes: int = EPISODES) -> dict[str, Any]:
    """Who drives, alone (the guard looks on) or guarded."""
    if driver == "naive":
        act, how = ringfence.guard(kind.naive, world, guard=guard, anyway=True), {}
    else:
        act, how = clone, {} if guard == "none" else {"guard": guard, "world": world, "anyway": True}
    return ringfence.play(act, kind.env, episodes=episodes, num_envs=episodes, **how)


def rows_of(
    kind: Kind, file: str, whole: str, seed: int, episodes: int = EPISODES, of: dict[str, Any] | None = None
) -> None:
    """The rows of a system, by logs of this seed, that are not there; `of` says what family it is of."""
    rows = [r for r in read(file) if (r["system"], r["seed"], r["causes"]) == (kind.name, str(seed), whole)]
    wanted = [way for way in WAYS if way not in {(r["driver"], r["guard"]) for r in rows}]
    if not wanted:
        return
    store = kind.recorded(LOGGED, seed)
    clone = ringfence.train("bc", store, out=RESULTS.parent / "runs" / f"paired-{seed}", quiet=True)[0]
    world = ringfence.fit(store)
    found = "; ".join(c.name for c in world.card.causes[""].causes) or "networks on all entries"
    for driver, guard in wanted:
        r = played(kind, world, clone, driver, guard, episodes)
        bound = upper_bound(round(r["violation_rate"] * episodes), episodes)
        row = [kind.name, seed, driver, whole, world.card.verdict.word, found, guard, episodes]
        row += [r["return_mean"], r["violation_rate"], bound, r.get("infeasible_rate", 0.0)]
        append(RESULTS / file, brief(dict(zip(HEAD, row)) | (of or {})), OF_FAMILY if of else HEAD)


def tracked() -> dict[str, Any]:
    """The World's verdict and errors on the list of who is near, and what drivers do without and with its guard."""
    store = TRACKED.recorded(LOGGED, 11)
    world = ringfence.fit(store, quiet=False)
    clone = ringfence.train("bc", store, out=RESULTS.parent / "runs" / "tracked", quiet=True)[0]
    error = world.card.prediction_error
    found: dict[str, Any] = {"verdict": world.card.verdict.word, "error of change": error.error_of_change}
    found |= {"read": {one.name: dict(zip(one.seconds, one.error)) for one in error.read}, "episodes": EPISODES}
    for driver, guard in reversed(WAYS):
        r = played(TRACKED, world, clone, driver, guard)
        row = {k: round(float(r[k]), 4) for k in ("return_mean", "violation_rate")}
        found[driver if guard == "none" else f"{driver}, {guard}"] = row
        print(driver, guard, row, flush=True)
    return found


if __name__ == "__main__":
    main()
