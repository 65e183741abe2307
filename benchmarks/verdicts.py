"""What is predicted of drivers under guard, inside Worlds, beside what was counted outside of them.

    python benchmarks/verdicts.py                    # of all; two minutes a system
    python benchmarks/verdicts.py hall 3-0 rays-13   # of some: of the proving ground, others, drawn, or of systems.py
    python benchmarks/verdicts.py --anew             # whatever is there already

Worlds are fitted by fewer updates than usual (SHORT), but where a file is given by `--worlds`. What was counted is read
from results/proving, results/shapes.csv and results/on_map.csv. It goes to results/verdict_played.json, with what
leaving each system out of the choice of thresholds says of it.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import time
import warnings
from pathlib import Path
from typing import Any

import msgspec
from common import RESULTS, keep, of_json, read
from proving import OTHERS, drawn, task_of
from systems import MAPPED, SHAPED, TRACKED

import ringfence
from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.datasets.registry import TASKS
from ringfence.guards.played import played
from ringfence.logs.store import EpisodeStore
from ringfence.world import World, impacts, load, verdict
from ringfence.world.card import Played
from ringfence.world.judging import JUDGING
from ringfence.world.logged import Logged, held_out, labels_of, unsafe_of

FILE = "verdict_played.json"
SHORT = {"value_updates": 2000, "future_updates": 600, "dynamics_updates": 8000, "barrier_updates": 3000}
NAMES = ["arms", "3-0", "lane", "hall", "x6", "x9", "x10", "tracked-11", "gears", "bench", "rays-13", "train"]
NAMES += ["listed-13", "drones", "1-1", "2-4", "shafts", "x5", "pickers-12", "junction-12", "flock", "1-6"]
KINDS = {kind.name: kind for kind in (*SHAPED, *MAPPED, TRACKED)}
HELPS = 0.5  # of what was counted alone, that is left at most under a guard that helps
FEW = 0.02  # episodes with a violation, alone, of drivers that are no test
GRID = {
    "TRUSTED": (0.85, 0.9, 0.95),
    "RISKS": (0.01, 0.02, 0.05),
    "STRANGE": (0.5, 0.6, 0.75, 0.9),
    "LEAVES": (0.3, 0.5, 0.7),
}


def store_of(name: str) -> EpisodeStore:
    """The logs of a system."""
    kind, _, seed = name.rpartition("-")
    if kind in KINDS:
        return KINDS[kind].recorded(600, int(seed))
    if name in OTHERS:
        return make(TASKS[task_of(OTHERS[name], f"proving-other-{name}")])[0]
    if kind:
        one = next(itertools.islice(drawn(int(kind)), int(seed), None))
        return make(TASKS[task_of(one, f"proving-drawn-{name}")])[0]
    return make(TASKS[f"proving-{name}"])[0]


def counted(name: str) -> dict[str, tuple[float, float]]:
    """Share of episodes with a violation, alone and under shield, by driver."""
    kind, _, seed = name.rpartition("-")
    if name == "tracked-11":
        rows = of_json("proving/trackers.json")["as it is"]
        return {d: tuple(rows[d + g]["violation_rate"] for g in ("", ", shield")) for d in ("clone", "naive")}
    if kind in KINDS:
        rows = [r for file in ("shapes.csv", "on_map.csv") for r in read(file)]
        rows = [
            r
            for r in rows
            if (r["system"], r["seed"]) == (kind, seed) and r["causes"] in ("more shapes", "how far away")
        ]
        share = {(r["driver"], r["guard"]): float(r["violated"]) for r in rows}
        return {d: (share[d, "none"], share[d, "shield"]) for d in ("clone", "naive")}
    files = (f"proving/proving-{name}.json", f"proving/others/{name}.json", f"proving/drawn/{name}.json")
    rows = next(found for file in files if (found := of_json(file)))["rows"]
    both = {"clone": "bc", "naive": "naive"}
    return {d: tuple(rows[f"{b} {g}"]["violation_rate"] for g in ("none", "shield learned")) for d, b in both.items()}


def row_of(name: str, worlds: Path | None) -> dict[str, Any]:
    """What is predicted, and what was counted, of a system."""
    file = None if worlds is None else worlds / f"{name}.safetensors"
    given = file is not None and file.exists()
    store = store_of(name)
    world = load(file) if given else ringfence.fit(store, **SHORT)
    begun = time.process_time()
    card = msgspec.structs.replace(world.card, played=played_of(world, store))
    return {
        "world": "given" if given else "of fewer updates",
        "cpu seconds of playing": round(time.process_time() - begun, 1),
        "before": verdict.judge(msgspec.structs.replace(card, played=())).word,
        "error of change": card.prediction_error.error_of_change[0],
        "played": msgspec.to_builtins(card.played),
        "counted": counted(name),
    }


def played_of(world: World, store: EpisodeStore) -> tuple[Played, ...]:
    """What its logs say of a World's guard."""
    logs = registry.from_store(store).logs(store)
    labels = labels_of(logs, world.map, world.card.settings, None)
    logged = Logged.of(logs, world.map, held_out(logs, world.card.seed, unsafe_of(labels)), labels)
    if world.card.data.impacts:
        logged = impacts.landed(logged, dataclasses.replace(world.dynamics, ahead=None))
    return played(world, logged, JUDGING)


def harmful(row: dict[str, Any]) -> bool:
    """Whether a guard was counted not to help some drivers."""
    return any(alone > FEW and guarded > HELPS * alone for alone, guarded in row["counted"].values())


def refused(row: dict[str, Any]) -> str:
    """The worst that is said of what was played: nothing, weak or unfit."""
    words = [word for word, _, _ in verdict.of_played(msgspec.convert(row["played"], tuple[Played, ...]))]
    return "unfit" if "unfit" in words else "weak" if words else ""


def wrong(row: dict[str, Any], limits: dict[str, float]) -> bool:
    """Whether anything is said against a helpful guard, or nothing against a harmful one."""
    for name, value in limits.items():
        setattr(verdict, name, value)
    said = refused(row)
    return harmful(row) == (said == "")


def left_out(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """By system: whether thresholds that the others chose err about it."""
    usual = {name: getattr(verdict, name) for name in GRID}
    every = [dict(zip(GRID, values)) for values in itertools.product(*GRID.values())]
    found = {}
    for name, row in rows.items():
        others = [other for key, other in rows.items() if key != name]
        best = min(every, key=lambda limits: sum(wrong(other, limits) for other in others))
        found[name] = {"harmful": harmful(row), "wrong": wrong(row, best), "limits": best}
    for name, value in usual.items():
        setattr(verdict, name, value)
    return found


def tell(name: str, rows: dict[str, dict[str, Any]]) -> None:
    """Write all rows with what today's thresholds make of them, and print one."""
    words = ("", "fit", "weak", "unfit")
    for row in rows.values():
        row["by play"] = refused(row) or "nothing"
        row["after"] = max(row["before"], refused(row), key=words.index)
    print(name, rows[name]["before"], "->", rows[name]["after"], rows[name]["counted"], flush=True)
    keep(RESULTS / FILE, {"systems": rows, "left out": left_out(rows)})


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    reader.add_argument("names", nargs="*", default=NAMES)
    reader.add_argument("--worlds", type=Path, help="folder of Worlds NAME.safetensors")
    reader.add_argument("--anew", action="store_true")
    given = reader.parse_args()
    warnings.simplefilter("ignore")
    rows = of_json(FILE).get("systems", {})
    for name in given.names or list(rows):
        if name not in rows or given.anew:
            rows[name] = row_of(name, given.worlds)
            tell(name, rows)
    tell(next(iter(rows)), rows)


if __name__ == "__main__":
    main()
