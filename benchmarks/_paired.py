"""A naive driver and a clone of a small system's logs, alone and under shields of two Worlds that differ in a thing."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from _rows import append, read
from _system import System
from readme import put

import ringfence
from ringfence.evaluation.statistics import upper_bound

LOGGED, EPISODES = 600, 100
HEAD = ("system", "seed", "driver", "causes", "verdict", "found", "guard")
HEAD += ("episodes", "return", "violated", "bound", "infeasible_rate")


@dataclass(frozen=True)
class Pair:
    """What two Worlds are called that differ in one thing, which `lacking` takes away while it is entered."""

    out: Path
    whole: str
    less: str
    lacking: Callable[[], AbstractContextManager[object]]

    def main(self, doc: str, systems: Mapping[str, type[System]], seed: int, marks: tuple[str, str]) -> None:
        """The command: rows of some systems or all; or what is dangerous, and all rows, between marks of a page."""
        parser = argparse.ArgumentParser(description=doc.splitlines()[0])
        parser.add_argument("systems", nargs="*", help=", ".join(systems))
        parser.add_argument("--seed", type=int, default=seed, help="of the logs")
        parser.add_argument("--table", action="store_true", help="make no rows")
        given = parser.parse_args()
        warnings.simplefilter("ignore")
        if given.table:
            for mark, text in zip(marks, (in_words(systems.values()), self.table(systems))):
                put("docs/proving-ground.md", mark, text)
            return
        for name in given.systems or systems:
            self.made(name, systems[name], given.seed)

    def made(self, name: str, system: type[System], seed: int) -> None:
        """The rows of a system, by logs of this seed, that are not there."""
        each = ((self.whole, "none"), (self.less, "shield"), (self.whole, "shield"))
        wanted = [(driver, world, guard) for driver in ("naive", "clone") for world, guard in each]
        rows = [r for r in read(self.out) if (r["system"], r["seed"]) == (name, str(seed))]
        done = {(r["driver"], r["causes"], r["guard"]) for r in rows}
        wanted = [one for one in wanted if one not in done]
        if not wanted:
            return
        store = system.recorded(LOGGED, seed)
        clone = ringfence.train("bc", store, out=self.out.parent.parent / "runs" / f"paired-{seed}", quiet=True)[0]
        worlds = {self.whole: ringfence.fit(store)}
        with self.lacking():
            worlds[self.less] = ringfence.fit(store, cached=False)
        for driver, which, guard in wanted:
            world = worlds[which]
            how = {} if guard == "none" else {"guard": guard, "world": world, "anyway": True}
            act = clone
            if driver == "naive":
                act, how = ringfence.guard(system.naive, world, guard=guard, anyway=True), {}
            r = ringfence.play(act, system, episodes=EPISODES, num_envs=100, **how)
            bound = upper_bound(round(r["violation_rate"] * EPISODES), EPISODES)
            found = "; ".join(c.name for c in world.card.causes[""].causes) or "networks on all entries"
            row = [name, seed, driver, which, world.card.verdict.word, found, guard, EPISODES]
            row += [r["return_mean"], r["violation_rate"], bound, r.get("infeasible_rate", 0.0)]
            row = [f"{v:.5g}" if isinstance(v, float) else v for v in row]
            append(self.out, dict(zip(HEAD, row)), HEAD)
            print(row, flush=True)

    def table(self, names: Iterable[str]) -> str:
        """A row per logs and driver, in the order of `names`."""
        order = list(names)
        rows = {(r["system"], r["seed"], r["driver"], r["causes"], r["guard"]): r for r in read(self.out)}
        lines = [f"| logs | who acts | no guard | shield, {self.less} | shield |", "|---|---|---|---|---|"]
        for name, seed in sorted({key[:2] for key in rows}, key=lambda of: (order.index(of[0]), int(of[1]))):
            for driver in ("naive", "clone"):
                of = ((self.whole, "none"), (self.less, "shield"), (self.whole, "shield"))
                each = [rows.get((name, seed, driver, *one)) for one in of]
                if all(each):
                    shown = " | ".join(_short(r) for r in each)
                    lines.append(f"| {name} {seed} | {driver} | {shown} |")
        return "\n".join(lines)


def in_words(systems: Iterable[type[System]]) -> str:
    """What is dangerous, as each says."""
    said = {cls: " ".join((cls.__doc__ or "").split()).rstrip(".") for cls in systems}
    lines = [f"| `{cls.__name__.lower()}` | {words} |" for cls, words in said.items()]
    return "\n".join(["| system | what is dangerous |", "|---|---|", *lines])


def _short(r: dict[str, str]) -> str:
    """Percentage of episodes with a violation, return, and where a World guards its verdict."""
    found = f"{100 * float(r['violated']):.3g}, {float(r['return']):.3g}"
    return found if r["guard"] == "none" else f"{found}, *{r['verdict']}*"
