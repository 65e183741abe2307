"""Danger that is no distance alone: a naive driver and a clone of the logs, alone and under a shield, by a World whose
causes may read more than that, and by one whose may not. Systems are those of _shaped.py,
_shaped_more.py and _shaped_last.py.

    python benchmarks/shapes.py                    # of all; fifteen minutes a system
    python benchmarks/shapes.py docks --seed 11    # of some, by other logs
    python benchmarks/shapes.py --table            # of results/shapes.csv, into docs/proving-ground.md

Rows that are in results/shapes.csv already are not made again.
"""

from __future__ import annotations

import argparse
import warnings
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

from _rows import append, read
from _shaped import Docks, Meeting, Sector, Sprayers
from _shaped_last import Downwash, Pickers, Swarm
from _shaped_more import Bikes, Boats, Crowd, Depot, Junction, Persons
from _system import System
from readme import put

import ringfence
from ringfence.evaluation.statistics import upper_bound
from ringfence.world import cause_search

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "results" / "shapes.csv"
LOGGED, EPISODES, SEED = 600, 100, 10
HEAD = ("system", "seed", "driver", "causes", "verdict", "found", "guard")
HEAD += ("episodes", "return", "violated", "bound", "infeasible")
LED = (Sector, Meeting, Docks, Sprayers, Persons, Crowd, Boats, Bikes, Depot, Junction)
SYSTEMS: tuple[type[System], ...] = (*LED, Downwash, Pickers, Swarm)
NAMED = {cls.__name__.lower(): cls for cls in SYSTEMS}
WITH, WITHOUT = "more shapes", "no more shapes"


@contextmanager
def without_more_shapes():
    """The search for causes as it would be without those that read more of how near things are."""
    with mock.patch.object(cause_search, "_with_more_shapes", lambda steps, chosen, names: chosen):
        yield


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("systems", nargs="*", help=", ".join(NAMED))
    parser.add_argument("--seed", type=int, default=SEED, help="of the logs")
    parser.add_argument("--table", action="store_true", help="make no rows")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if given.table:
        put("docs/proving-ground.md", "shaped", systems())
        put("docs/proving-ground.md", "shapes", table())
        return
    for name in given.systems or NAMED:
        made(name, NAMED[name], given.seed)


def made(name: str, system: type[System], seed: int) -> None:
    """The rows of a system, by logs of this seed, that are not there."""
    wanted = [(d, c, g) for d in ("naive", "clone") for c, g in ((WITH, "none"), (WITHOUT, "shield"), (WITH, "shield"))]
    done = {(r["driver"], r["causes"], r["guard"]) for r in read(OUT) if (r["system"], r["seed"]) == (name, str(seed))}
    wanted = [one for one in wanted if one not in done]
    if not wanted:
        return
    store = system.recorded(LOGGED, seed)
    clone = ringfence.train("bc", store, out=ROOT / "runs" / f"shapes-{seed}", quiet=True)[0]
    worlds = {WITH: ringfence.fit(store)}
    with without_more_shapes():
        worlds[WITHOUT] = ringfence.fit(store, cached=False)
    for driver, causes, guard in wanted:
        world = worlds[causes]
        how = {} if guard == "none" else {"guard": guard, "world": world, "anyway": True}
        act = clone
        if driver == "naive":
            act, how = ringfence.guard(system.naive, world, guard=guard, anyway=True), {}
        r = ringfence.play(act, system, episodes=EPISODES, num_envs=100, **how)
        bound = upper_bound(round(r["violation_rate"] * EPISODES), EPISODES)
        found = "; ".join(c.name for c in world.card.causes[""].causes) or "networks on all entries"
        row = [name, seed, driver, causes, world.card.verdict.word, found, guard, EPISODES]
        row += [r["return_mean"], r["violation_rate"], bound, r.get("infeasible_rate", 0.0)]
        row = [f"{v:.5g}" if isinstance(v, float) else v for v in row]
        append(OUT, dict(zip(HEAD, row)), HEAD)
        print(row, flush=True)


def systems() -> str:
    """What is dangerous, as each says."""
    said = {cls: " ".join((cls.__doc__ or "").split()).rstrip(".") for cls in SYSTEMS}
    lines = [f"| `{cls.__name__.lower()}` | {said[cls]} |" for cls in SYSTEMS]
    return "\n".join(["| system | what is dangerous |", "|---|---|", *lines])


def table() -> str:
    rows = {(r["system"], r["seed"], r["driver"], r["causes"], r["guard"]): r for r in read(OUT)}
    lines = [
        "| logs | who acts | no guard | shield, without more shapes | shield |",
        "|---|---|---|---|---|",
    ]
    for name, seed in sorted({key[:2] for key in rows}, key=lambda of: (list(NAMED).index(of[0]), int(of[1]))):
        for driver in ("naive", "clone"):
            of = ((WITH, "none"), (WITHOUT, "shield"), (WITH, "shield"))
            each = [rows.get((name, seed, driver, *one)) for one in of]
            if all(each):
                shown = " | ".join(short(r) for r in each)
                lines.append(f"| {name} {seed} | {driver} | {shown} |")
    return "\n".join(lines)


def short(r: dict[str, str]) -> str:
    """Percentage of episodes with a violation, return, and where a World guards its verdict."""
    found = f"{100 * float(r['violated']):.3g}, {float(r['return']):.3g}"
    return found if r["guard"] == "none" else f"{found}, *{r['verdict']}*"


if __name__ == "__main__":
    main()
