"""Writes the measured tables into README.md and docs/, between their markers, from results/ alone.

    python benchmarks/tables.py                          # all of them
    python benchmarks/tables.py docs/start.md zoo ...    # some, by page or marker

`TABLES` has them by page and marker; those of guards, of the planner and of single studies are in files of their own.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator

import evidence
import guards_tables
import numpy as np
import planner_tables
import study_tables
from common import RESULTS, markdown, of_json, put
from evidence import proven

# What the page of speeds shows of the measurements, and its words.
SHOWN = {
    "simple_spread-expert: cloning, guard shield, one joint action": "Simple Spread: an action under `shield`",
    "simple_spread-expert: cloning, guard full, one joint action": "Simple Spread: under `full`",
    "halfcheetah_2x3-medium: cloning, guard shield, one joint action": "HalfCheetah: under `shield`",
    "halfcheetah_2x3-medium: cloning, guard full, one joint action": "HalfCheetah: under `full`",
    "Crossing: one joint action, guard shield, 8 agents": "Crossing, 8 agents: under `shield`",
    "Crossing: one joint action, guard shield, 256 agents": "Crossing, 256 agents: under `shield`",
    "simple_spread-expert: fitting a World": "Simple Spread: a World",
    "Crossing: fitting a World": "Crossing: a World",
    "peak memory of this benchmark": "memory of the largest",
    "ma-td3bc, over the loop, one core": "`ma-td3bc` beside a PyTorch loop",
    "omar, over the loop, one core": "`omar` beside a PyTorch loop",
}


def main() -> None:
    wanted = set(sys.argv[1:])
    for (page, mark), make in TABLES.items():
        if not wanted or {page, mark} & wanted:
            put(page, mark, make())


def speeds() -> str:
    """One line per measurement, a median and its 99th percentile in one."""
    rows: dict[str, tuple[float, str]] = {}
    for file in sorted((RESULTS / "performance").glob("*.json")):
        for r in json.loads(file.read_text()):
            rows.setdefault(r["name"], (r["value"], r["unit"]))
    lines = []
    for name, words in SHOWN.items():
        value, unit = rows[name] if name in rows else rows[f"{name}, p50"]
        late = f" (p99 {rows[f'{name}, p99'][0]:.3g})" if f"{name}, p99" in rows else ""
        lines.append((words, f"{value:.3g} {unit}{late}"))
    return markdown(("what", "measured"), lines)


def front() -> str:
    """The README's few rows, in words that need no footnote."""
    heads = ("who acts", "what is known of danger", "episodes with a violation", "return", "seeds")
    return markdown(heads, (*_front_crossing(), *_front_proving(), _front_replay()))


LOGGED = "a logged cost column"


def _front_crossing() -> Iterator[tuple[str, ...]]:
    for words, danger, variant in (
        ("Eight discs cross a room: a clone of the logs", "no guard", "default"),
        ("the same clone under a guard", LOGGED, f"default{guards_tables.SHIELD}"),
    ):
        found = evidence.of("crossing-guards", "crossing-hasty", ("bc", variant)).values()
        violated, earned = (np.mean([r[key] for r in found]) for key in ("violation_rate", "return_mean"))
        yield words, danger, f"{100 * violated:.3g} %", f"{earned:.2f} m of progress", str(len(found))


def _front_proving() -> Iterator[tuple[str, ...]]:
    """The mean over all systems, and the most of one by any seed; returns as shares of what the driver alone earns.
    Who is guarded is so by Worlds of today."""
    found = proven()
    today = {one["task"]: one["rows"] for one in proven("proving/again")}
    found = [one | {"rows": one["rows"] | today[one["task"]]} for one in found]
    for words, danger, driver, way in (
        (f"{len(found)} other systems: a clone of the logs", "no guard", "bc", "none"),
        ("the same clones under a guard", LOGGED, "bc", "shield learned"),
        ("naive drivers, who head for their goals", "no guard", "naive", "none"),
        ("the same drivers under a guard", LOGGED, "naive", "shield learned"),
    ):
        rows = [one["rows"] for one in found]
        violated = 100 * np.mean([row[f"{driver} {way}"]["violation_rate"] for row in rows])
        most, where = max((row[f"{driver} {way}"]["most"], one["task"]) for row, one in zip(rows, found))
        of = f", {100 * most:.0f} % at most (`{where.removeprefix('proving-')}`)" if way == "shield learned" else ""
        earned = np.mean([row[f"{driver} {way}"]["return_mean"] / row[f"{driver} none"]["return_mean"] for row in rows])
        seeds = min(row[f"{driver} {way}"]["seeds"] for row in rows)
        yield words, danger, f"{violated:.2g} % in the mean{of}", f"{100 * earned:.0f} %", str(seeds)


def _front_replay() -> tuple[str, ...]:
    """Recordings of pedestrians, all drivers of each together."""
    shares: dict[str, list[float]] = {"none": [], "shield": []}
    for name in study_tables.PEDESTRIANS:
        for way, found in shares.items():
            mine = [r for r in of_json(f"replay/{name}.json")["rows"] if r["filter"] == way]
            found.append(100 * sum(r["contacts"] for r in mine) / sum(r["windows"] for r in mine))
    alone, guarded = (f"{min(found):.2g} to {max(found):.2g} %" for found in shares.values())
    words = f"Filmed pedestrians, {len(study_tables.PEDESTRIANS)} recordings: five drivers put among them"
    return words, "a cost column made of distances", f"{alone} alone, {guarded} under a guard", "–", "1"


TABLES: dict[tuple[str, str], Callable[[], str]] = {
    ("README.md", "front"): front,
    ("docs/performance.md", "performance"): speeds,
    **guards_tables.TABLES,
    **planner_tables.TABLES,
    **study_tables.TABLES,
}

if __name__ == "__main__":
    main()
