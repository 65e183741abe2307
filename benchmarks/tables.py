"""Writes the measured tables into README.md and docs/, between their markers, from results/ alone.

    python benchmarks/tables.py                          # all of them
    python benchmarks/tables.py docs/yard.md yard ...    # some, by page or marker

`TABLES` has them by page and marker; those of guards, of the planner and of single studies are in files of their own.
"""

from __future__ import annotations

import json
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import guards_tables
import numpy as np
import planner_tables
import study_tables
from common import RESULTS, markdown, of_json, put, read
from evidence import proven

from ringfence import algos
from ringfence.bench import paper, unpack
from ringfence.datasets import registry
from ringfence.report import board
from ringfence.utils.config import build_config

SEEDS = 5  # fewer are said in the cell
TIERS = ("expert", "medium", "medium-replay", "random")
ANY = ""  # the one plain variant of an algorithm, whose preset may be named after the tier
ROWS = {
    "behaviour data": ("behaviour data", "reference"),
    "its episodes within the limit": ("data within the limit", "reference"),
    "do nothing": ("do-nothing", "reference"),
    "BC": ("bc", ANY),
    "BC on episodes without a collision": ("bc-safe", ANY),
    "MA-TD3+BC": ("ma-td3bc", ANY),
    "MA-CQL": ("ma-cql", ANY),
    "OMAR": ("omar", ANY),
    "MA-TD3+BC, Lagrange": ("ma-td3bc-lag", ANY),
    "FISOR per agent": ("fisor", ANY),
}
# Columns of the robots' table.
SHORT = {
    "data": ("behaviour data", "reference"),
    "BC": ("bc", "mujoco"),
    "MA-TD3+BC, Lagrange": ("ma-td3bc-lag", "mujoco"),
}
# Pan et al. 2022, means as tabulated in MADIFF's repository; on the public files.
PUBLISHED = {
    "published: MA-TD3+BC, public data": (1.083, 0.293, 0.154, 0.098),
    "published: OMAR, public data": (1.149, 0.479, 0.379, 0.344),
}
# Measurements that the page of speeds leaves out: parts of others, and what only a script's reader asks for.
UNSHOWN = re.compile(
    r"parameters|milliseconds|compile|mean return|size of|imports|all entries|PyTorch|random actions|"
    r"per agent|training update|ant_4x2|grid|overhead|two cores|batch=16|batch=1024|N=24|against first|in training|"
    r"\b6 agents|kill|cells|given actions|wall clock|64 wide|by ℓ|collect|good, peak|"
    r"none, one joint|none, \d|full, 64|shield, 64|mpe2|warmed up, first|first action of a loaded controller,|"
    r"full: first|3 agents, batch|simulated|guard select|ant_2x4|halfcheetah_2x3-medium: fitting"
)


def main() -> None:
    wanted = set(sys.argv[1:])
    for (page, mark), make in TABLES.items():
        if not wanted or {page, mark} & wanted:
            put(page, mark, make())


def speeds() -> str:
    """One line per measurement, a median and its 99th percentile in one."""
    rows = [r for file in sorted((RESULTS / "performance").glob("*.json")) for r in json.loads(file.read_text())]
    late = {r["name"].removesuffix(", p99"): r["value"] for r in rows if r["name"].endswith(", p99")}
    lines = []
    for r in rows:
        name = r["name"].removesuffix(", p50")
        if UNSHOWN.search(name) or name.endswith(", p99"):
            continue
        text = f"{r['value']:.4g} {r['unit']}" + (f" (p99 {late[name]:.3g})" if r["name"].endswith("p50") else "")
        name = name.replace("one joint action", "an action").replace("a loaded controller", "a controller")
        lines.append((name, text))
    return markdown(("what", "measured"), lines)


def front() -> str:
    """The README's few rows, in words that need no footnote."""
    heads = ("who acts", "what is known of danger", "episodes with a violation", "return")
    return markdown(heads, (*_front_crossing(), *_front_proving(), _front_replay()))


LOGGED = "a logged cost column"


def _front_crossing() -> Iterator[tuple[str, str, str, str]]:
    """One seed, by benchmarks/proving.py, as the rows below."""
    found = of_json("proving/crossing-hasty.json")["rows"]
    for words, danger, way in (
        ("Eight discs cross a room: a clone of the logs", "no guard", "none"),
        ("the same clone under a guard", LOGGED, "shield learned"),
    ):
        row = found[f"bc {way}"]
        violated = f"{100 * row['violation_rate']:.3g} % of {row['episodes']:,}"
        yield words, danger, violated, f"{row['return_mean']:.2f} m of progress"


def _front_proving() -> Iterator[tuple[str, str, str, str]]:
    """The mean over the systems whose Worlds are not refused; returns as shares of what the clone alone earns."""
    found = proven()
    systems = [one["rows"] for one in found if "unfit" not in one["verdicts"]]
    refused = ("none", "one", "two", "three")[len(found) - len(systems)]
    clones = f"{len(systems)} of {len(found)} other systems, {refused} being refused: a clone of the logs"
    for words, danger, way in (
        (clones, "no guard", "none"),
        ("the same clones under a guard", LOGGED, "shield learned"),
        ("the same clones under a guard", "the true formula and motion", "shield oracle"),
    ):
        rows = [rows[f"bc {way}"] for rows in systems]
        violated = np.mean([row["violation_rate"] for row in rows])
        earned = np.mean([row["return_mean"] / own["bc none"]["return_mean"] for row, own in zip(rows, systems)])
        yield words, danger, f"{100 * violated:.2g} % in the mean", f"{100 * earned:.0f} % of the clone's"


def _front_replay() -> tuple[str, str, str, str]:
    """Recordings of pedestrians, all drivers of each together."""
    shares = {"none": [], "shield": []}
    for name in RECORDINGS:
        for way, found in shares.items():
            mine = [r for r in of_json(f"replay/{name}.json")["rows"] if r["filter"] == way]
            found.append(100 * sum(r["contacts"] for r in mine) / sum(r["windows"] for r in mine))
    alone, guarded = (f"{min(found):.2g} to {max(found):.2g} %" for found in shares.values())
    words = f"Filmed pedestrians, {len(RECORDINGS)} recordings: five drivers put among them"
    return words, "a cost column made of distances", f"{alone} alone, {guarded} under a guard", "–"


# Filters of a replay: their words, and where their rows are.
FILTERS = {
    "shield, learned danger": ("rows", "shield"),
    "the same beyond the logs": ("beyond the logs", "shield"),
    "the same without restarts": ("without restarts", "shield"),
    "formula, 2 s": ("rows", "formula"),
    "constant-velocity brake": ("rows", "brake"),
}
MACHINES = ("a-den", "b-den", "town")
RECORDINGS = ("zara02", "seq_hotel", "zara01", "seq_eth", "students03", "citr")
DRIVERS = {"bc": "clone (`bc`)", "straight": "", "accelerate": "", "hasty": "", "seek": ""}


def replayed_drivers() -> str:
    """Contacts prevented and caused in zara02, by driver."""
    found = of_json("replay/zara02.json")
    lines = [(words or f"`{driver}`", *_filtered(found, {driver})) for driver, words in DRIVERS.items()]
    return markdown(("driver", "contacts", *FILTERS), [*lines, ("all", *_filtered(found, set(DRIVERS)))])


def replayed_recordings(names: Sequence[str]) -> str:
    """The same of all drivers together, by recording."""
    lines = []
    for name in names:
        found = of_json(f"replay/{name}.json")
        lines.append((f"`{name}`", found["verdict"], found["windows"], *_filtered(found, set(DRIVERS))))
    return markdown(("recording", "verdict", "windows", "contacts", *FILTERS), lines)


def _filtered(found: dict, drivers: set[str]) -> list[str]:
    """Contacts alone, and what each filter makes of them; nothing where a file does not have it."""
    if "beyond the logs" not in found:  # an older file, of a guard that went there
        guarded = [r for r in found["rows"] if r["filter"] == "shield"]
        rest = [r for r in found["rows"] if r["filter"] != "shield"]
        found = {"rows": rest, "beyond the logs": guarded}
    alone = sum(r["contacts"] for r in found["rows"] if r["filter"] == "none" and r["policy"] in drivers)
    cells = [str(alone)]
    for where, name in FILTERS.values():
        rows = [r for r in found.get(where, ()) if r["filter"] == name and r["policy"] in drivers]
        prevented, caused = (sum(r[what] for r in rows) for what in ("prevented", "caused"))
        cells.append(f"{prevented} ({100 * prevented / alone:.0f} %), {caused}" if rows else "")
    return cells


# Rows of the summary: their words, and suites with a method's variant on Simple Spread, robots and Crossing.
LAGRANGE = "MA-TD3+BC with a Lagrange multiplier"
SUMMARY = {
    "BC": ("simple_spread bc", "mujoco bc", "crossing bc default"),
    LAGRANGE: ("simple_spread ma-td3bc-lag", "mujoco ma-td3bc-lag", "crossing-guards ma-td3bc-lag default"),
    "BC + guard, *analytic*": ("guards bc default+shield-analytic", "guards-mujoco bc +adapt-analytic", ""),
    "**BC + guard**": (
        "guards bc default+shield-learned",
        "guards-mujoco bc +adapt-learned",
        "crossing bc default+shield-learned",
    ),
    "**BC + guard that also climbs values** (`full`)": (
        "guards bc default+full-learned",
        "guards-mujoco bc +full-learned",
        "crossing-guards bc default+full-learned",
    ),
}


def summary() -> str:
    """One line per method: all tiers, all robots and Crossing in a cell each."""
    data = {s: grouped(s) for s in ("simple_spread", "guards", "crossing", "crossing-guards")}
    logs = [data["simple_spread"][f"simple_spread-{t}", "behaviour data", "reference"][0] for t in TIERS]
    logged = [data["crossing"]["crossing-hasty", "behaviour data", "reference"][0]]
    lines = [("*the logs*", _spread_cell(logs), "", _crossing_cell(logged))]
    for words, places in SUMMARY.items():
        cells = []
        for place, kind in zip(places, ("spread", "robots", "crossing")):
            suite, algorithm, variant = (place.split() + ["", "", ""])[:3]
            if not place:
                cells.append("–")
            elif kind == "robots":
                cells.append(_robots_cell(suite, algorithm, variant))
            elif kind == "spread":
                cells.append(_spread_cell([r for tier in TIERS for r in of(data[suite], tier, algorithm, variant)]))
            else:
                cells.append(_crossing_cell(data[suite].get(("crossing-hasty", algorithm, variant), [])))
        lines.append((words, *cells))
    return markdown(("method", "Simple Spread", "robots", "Crossing"), lines).replace("|  |", "| |")


def _spread_cell(rows: list[dict]) -> str:
    """The mean of the tiers' means, however many seeds each has."""
    by_tier = [[r for r in rows if r["task"] == f"simple_spread-{tier}"] for tier in TIERS]
    seeds = 0 if rows[0]["variant"] == "reference" else min(len(tier) for tier in by_tier)
    earned, cost = (np.mean([mean(tier, key) for tier in by_tier]) for key in ("return_norm", "cost_safe_start"))
    return f"{earned:.2f} / {cost:.3f}" + _seeds(seeds)


def _robots_cell(suite: str, algorithm: str, variant: str) -> str:
    wanted = algorithm, f"default{variant}" if variant.startswith("+") else variant or "default"
    shown = board.read(RESULTS / suite).lines.values()
    found = [r for rows in shown for r in rows if (r.method.algorithm, r.method.variant) == wanted]
    kept, seeds = sum(r.safe for r in found), min(len(r.seeds) for r in found)
    return f"{kept} of {len(found)}, {np.mean([r.returns_norm for r in found]):.2f}" + _seeds(seeds)


def _crossing_cell(rows: list[dict]) -> str:
    if not rows:
        return "–"
    seeds = len({r["seed"] for r in rows if r["variant"] != "reference"})
    return f"{mean(rows, 'return_mean'):.2f} m / {100 * mean(rows, 'violation_rate'):.3g} %" + _seeds(seeds)


def _seeds(count: int) -> str:
    return f" [{count}]" if 0 < count < SEEDS else ""


def grouped(suite: str) -> dict:
    """Rows of a suite's table by (task, algorithm, variant)."""
    groups = defaultdict(list)
    for row in read(f"{suite}/table.csv"):
        if row["task"]:
            groups[row["task"], row["algorithm"], row["variant"]].append(row)
    return groups


def robots_short(ending: str) -> str:
    """One line per task, one column per method: return / cost, and how many seeds they are of where that is not the
    usual number."""
    groups = grouped("mujoco")
    robots, levels = ("halfcheetah_2x3", "ant_2x4", "ant_4x2"), ("good", "medium", "poor")
    names = [f"{robot}-{level}{ending}" for robot in robots for level in levels]
    found = {(n, *way): groups.get((n, *way), []) for n in names for way in SHORT.values()}
    counts = [len(rows) for (_, _, variant), rows in found.items() if rows and variant != "reference"]
    usual = max(set(counts), key=counts.count)
    lines = []
    for name in names:
        cells = []
        for way in SHORT.values():
            rows = found[name, *way]
            text = f"{mean(rows, 'return_mean'):.0f} / {mean(rows, 'cost_mean'):.1f}" if rows else "–"
            unusual = rows and way[1] != "reference" and len(rows) != usual
            cells.append(text + fallen(rows) + f" [{len(rows)}]" * bool(unusual))
        lines.append((name, *cells))
    others = " [n]: of n." if len(set(counts)) > 1 else ""
    table = markdown(("", *SHORT), lines).replace("|  |", "| |", 1)
    return f"{table}\n\nMethods' cells are of {usual} seed{'s' * (usual > 1)}.{others}"


def costs() -> str:
    """One line per algorithm: the mean seconds of training and playing a cell, from the quickest of its presets to the
    slowest."""
    took = {suite: spent(RESULTS / suite) for suite in ("simple_spread", "mujoco")}
    lines = ["| algorithm | Simple Spread, s | robots, s |", "|---|---:|---:|"]
    for name in dict.fromkeys(name for found in took.values() for name, _ in found):
        cells = []
        for found in took.values():
            means = sorted({round(np.mean(v)) for (algorithm, _), v in found.items() if algorithm == name})
            cells.append(" to ".join(f"{m}" for m in dict.fromkeys((means[0], means[-1]))) if means else "–")
        lines.append(f"| `{name}` | " + " | ".join(cells) + " |")
    for suite, found in took.items():
        hours = sum(map(sum, found.values())) / 3600
        lines.append(f"\n`{suite}`: {sum(map(len, found.values()))} cells, {hours:.1f} hours of one core.")
    return "\n".join(lines)


def spent(folder: Path) -> dict[tuple[str, str], list[float]]:
    """Seconds of training and playing each cell, by algorithm and preset; without cells that took over what another had
    learned from the same data."""
    seconds = defaultdict(list)
    unpack(folder)
    for file in sorted((folder / "cells").glob("*/*/*/status.json")):
        status, name = json.loads(file.read_text()), file.parent.parent.name
        if status["state"] != "done":
            continue
        algorithm = max((a for a in algos.ALGORITHMS if f"{name}-".startswith(f"{a}-")), key=len)
        if "adopted" in status or (registry.paired(file.parts[-4]) and not _reads_danger(file.parent)):
            continue
        results = json.loads((file.parent / "results.json").read_text())
        trained = max([status.get("train_seconds", 0.0), *(r["train_seconds"] for r in results.values())])
        seconds[algorithm, name].append(trained + status.get("eval_seconds", 0.0))
    return seconds


def _reads_danger(cell: Path) -> bool:
    config = json.loads((cell / "config.json").read_text())
    algorithm = algos.get(config["algorithm"])
    known = {k: v for k, v in config["config"].items() if hasattr(algorithm.Config, k)}  # cells outlive fields
    return algorithm.cost_source(build_config(algorithm.Config, known, config["algorithm"])) != "nothing"


def of(groups: dict, tier: str, algorithm: str, variant: str) -> list[dict]:
    """Rows of a method on a tier, one per seed."""
    task = f"simple_spread-{tier}"
    if variant != ANY:
        return groups.get((task, algorithm, variant), [])
    return next((rows for (t, a, v), rows in groups.items() if (t, a) == (task, algorithm) and "+" not in v), [])


def spread() -> str:
    """One line per method, one column per tier: return (normalised) / cost of safe starts."""
    groups, lines = grouped("simple_spread"), []
    for name, way in ROWS.items():
        found = [of(groups, tier, *way) for tier in TIERS]
        if any(found):
            lines.append((name, *(cell(rows) if rows else "–" for rows in found)))
    lines += [(f"*{name}*", *(f"*({v:.2f})*" for v in values)) for name, values in PUBLISHED.items()]
    return markdown(("", *TIERS), lines).replace("|  |", "| |", 1)


def mean(rows: list[dict], key: str) -> float:
    return float(np.mean([float(r[key]) for r in rows]))


def cell(rows: list[dict]) -> str:
    seeds = _seeds(sum(r["variant"] != "reference" for r in rows))
    text = f"{mean(rows, 'return_mean'):.0f}{seeds} ({mean(rows, 'return_norm'):.2f})"
    return f"{text} / {mean(rows, 'cost_safe_start'):.3f}{fallen(rows)}"


def fallen(rows: list[dict]) -> str:
    """How many episodes ended before the time limit, where any did: an early end costs little."""
    ended = [float(r["termination_rate"]) for r in rows if r.get("termination_rate")]
    share = 100 * float(np.mean(ended)) if ended else 0.0
    return f" ({max(share, 1):.0f} %)" if share else ""


TABLES: dict[tuple[str, str], Callable[[], str]] = {
    ("README.md", "front"): front,
    ("docs/replay-results.md", "drivers"): replayed_drivers,
    ("docs/replay-results.md", "recordings"): lambda: replayed_recordings(RECORDINGS),
    ("docs/replay-results.md", "machines"): lambda: replayed_recordings(MACHINES),
    ("docs/tables.md", "summary"): summary,
    ("docs/tables.md", "table"): spread,
    ("docs/tables.md", "robots-native"): lambda: robots_short(""),
    ("docs/tables.md", "robots-quantile"): lambda: robots_short("-quantile"),
    ("docs/benchmark.md", "cost"): costs,
    ("docs/benchmark.md", "paper"): lambda: paper.markdown(paper.lines(RESULTS / name for name in paper.FOLDERS)),
    ("docs/performance.md", "performance"): speeds,
    **guards_tables.TABLES,
    **planner_tables.TABLES,
    **study_tables.TABLES,
}

if __name__ == "__main__":
    main()
