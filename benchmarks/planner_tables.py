"""The planner's tables of docs/results.md, and README.md's table at a glance (tables.py writes the pages)."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
from common import RESULTS, markdown
from evidence import evaluations, variant

from ringfence.bench import paper
from ringfence.datasets.registry import TASKS
from ringfence.evaluation.statistics import mean_of_runs

PAGE = "docs/results.md"
SPREAD = ("expert", "medium-replay", "medium", "random")
PROVING = ("proving-hall", "proving-discs")
Rows = list[dict[str, Any]]


def rows_of(group: str, task: str) -> Rows:
    """Every run of a group on a task; none where it was not made."""
    file = RESULTS / "planner" / f"{group}-{task}.json"
    return json.loads(file.read_text())["rows"] if file.exists() else []


def played(rows: Rows, name: str, way: str) -> Rows:
    """What runs of a row earned in a way of playing, each with what it is of."""
    return [{**r, **r["plays"][way]} for r in rows if r["name"] == name and way in r["plays"]]


def episodes(found: Rows, what: str) -> np.ndarray:
    """(seeds, episodes)."""
    return np.array([r["per_episode"][what] for r in found], float)


def brief(found: Rows) -> str:
    """Return / cost of safe starts, and how many seeds."""
    if not found:
        return "–"
    reward, cost = (np.mean([r[key] for r in found]) for key in ("return_norm", "cost_safe_start"))
    return f"{reward:.2f} / {cost:.2f} [{len(found)}]"


def paired(found: Rows, others: Rows) -> tuple[np.ndarray, np.ndarray]:
    """(seeds, episodes) returns of runs, and those of others, of the seeds that both have, on the same resets."""
    of, of_others = ({r["seed"]: r for r in rows} for rows in (found, others))
    seeds = sorted(of.keys() & of_others.keys())
    return episodes([of[s] for s in seeds], "return"), episodes([of_others[s] for s in seeds], "return")


def less(found: Rows, others: Rows, task: str) -> str:
    """Return of runs less that of others, by the same seeds on the same resets; bold beyond chance."""
    both = paired(found, others)
    if not len(both[0]):
        return "–"
    x = np.subtract(*(TASKS[task].normalised_return(each) for each in both))
    low, high = mean_of_runs(x)
    text = f"{x.mean():+.3f} [{low:+.3f}, {high:+.3f}]"
    return f"**{text}**" if low > 0 or high < 0 else text


# Ways of playing the same runs. `icbf` without guidance is `madiff`.
WAYS = {
    "alone": "nothing guides (`madiff`)",
    "danger alone": "danger alone guides",
    "as it is": "`icbf`: values guide, too",
    "under shield": "the same under `shield`",
}


def spread() -> str:
    """A line for each task, a column for each way of playing the same runs."""
    lines = []
    for task in (*(f"simple_spread-{tier}{pool}" for pool in ("", "-pooled") for tier in SPREAD), *PROVING):
        rows = rows_of("rows", task)
        if rows:
            logs = json.loads((RESULTS / "planner" / f"rows-{task}.json").read_text())["logs"]
            cells = [brief(played(rows, "icbf", way)) for way in WAYS]
            lines.append((task.removeprefix("simple_spread-"), f"{logs:.2f}", *cells))
    return markdown(("logs", "they earn", *WAYS.values()), lines)


LEARNED = ("simple_spread-expert", "simple_spread-expert-pooled")


def changes() -> str:
    """A line for each change of the planner that differs beyond chance: return less that of *as it is*, by the same
    seeds on the same resets."""
    found = {task: rows_of("ablations", task) for task in LEARNED}
    lines = []
    for name in dict.fromkeys(r["name"] for rows in found.values() for r in rows):
        cells = []
        for task, rows in found.items():
            mine, usual = (played(rows, one, "alone") for one in (name, "as it is"))
            cells.append(brief(mine) if name == "as it is" else less(mine, usual, task) if mine else "–")
        if name == "as it is" or any("**" in cell for cell in cells):
            lines.append((name, *cells))
    return markdown(("`madiff`", *(task.removeprefix("simple_spread-") for task in LEARNED)), lines)


def algorithm1() -> str:
    """Algorithm 1 as printed, by λ: normalised return / cost of safe starts."""
    found = {task: rows_of("algorithm1", task) for task in LEARNED}
    names = dict.fromkeys(r["name"] for rows in found.values() for r in rows)
    lines = [(name, *(brief(played(rows, name, "as it is")) for rows in found.values())) for name in names]
    return markdown(("Algorithm 1", *(task.removeprefix("simple_spread-") for task in LEARNED)), lines)


def sums_of(name: str, task: str, row: tuple[str, str]) -> str:
    """Normalised return / cost of a grid's row: of safe starts on Simple Spread, in limits on robots."""
    found = list(evaluations(name).get((task, *variant(task, row)), {}).values())
    if not found:
        return "–"
    key = "cost_safe_start" if task.startswith("simple") else "cost_norm"
    several = f" [{len(found)}]" if row[1] != "reference" else ""
    return f"{np.mean([r['return_norm'] for r in found]):.2f} / {np.mean([r[key] for r in found]):.2f}{several}"


def robot(found: Rows, task: str) -> str:
    """Normalised return / normalised cost, as the paper has them, and how many seeds."""
    if not found:
        return "–"
    cost = TASKS[task].normalised_cost(np.mean([r["cost"] for r in found]))
    return f"{np.mean([r['return_norm'] for r in found]):.2f} / {cost:.2f} [{len(found)}]"


def glance() -> str:
    """The paper's thirteen tasks, and the pooled ones of Simple Spread."""
    heads = (
        "task",
        "*the paper prints*",
        "Algorithm 1 as printed",
        "ICBF as it is",
        "ICBF, shield",
        "ICBF, `full`",
        "BC, shield",
        "the logs",
    )
    tasks = list(paper.PRINTED)
    tasks += [f"{task}-pooled" for task in tasks if task.startswith("simple")]
    lines = []
    for task in tasks:
        printed = paper.PRINTED.get(task.removesuffix("-pooled"))
        assert printed is not None
        reward, _, cost, _ = printed[1][2]
        cells = [task, f"*{reward:.2f} / {cost:.2f}*"]
        if task.startswith("simple"):
            algorithm1 = [
                r for w in ("1", "0.1", "10") for r in played(rows_of("algorithm1", task), f"λ = {w}", "as it is")
            ]
            best = max({r["name"] for r in algorithm1}, key=lambda n: _mean(algorithm1, n), default=None)
            rows = rows_of("rows", task)
            cells.append(brief([r for r in algorithm1 if r["name"] == best]))
            cells += [brief(played(rows, "icbf", way)) for way in ("as it is", "under shield")]
            cells.append(brief(played(rows_of("guards", task), "icbf", "under full")))
            clones = sums_of("guards", task, ("bc", "default+shield-learned"))
            cells.append(clones if clones != "–" else pooled_row(task, "bc, 20,000 updates, under shield"))
            logs = sums_of("simple_spread", task, ("behaviour data", "reference"))
            cells.append(logs if logs != "–" else pooled_logs(task))
        else:
            rows = rows_of("robots", task)
            cells.append(robot(played(rows_of("algorithm1", task), "λ = 1", "cool"), task))
            cells += [robot(played(rows, "icbf", way), task) for way in ("cool", "cool, under adapt")] + ["–"]
            cells.append(sums_of("guards-mujoco", task, ("bc", "default+adapt-learned")))
            cells.append(sums_of("mujoco", task, ("behaviour data", "reference")))
        lines.append(cells)
    return markdown(heads, lines)


def _mean(rows: Rows, name: str) -> float:
    return float(np.mean([r["return_norm"] for r in rows if r["name"] == name]))


def _pooled(task: str) -> dict[str, Any]:
    file = RESULTS / "pooled" / f"{task}.json"
    return json.loads(file.read_text()) if file.exists() else {"rows": {}}


def pooled_row(task: str, name: str) -> str:
    r = _pooled(task)["rows"].get(name)
    return "–" if r is None else f"{r['return_norm']:.2f} / {r['cost_safe_start']:.2f} [{len(r['seeds'])}]"


def pooled_logs(task: str) -> str:
    data = _pooled(task).get("data")
    return "–" if data is None else f"{data['return_norm']:.2f} / –"


def of_paper() -> str:
    """Normalised return / normalised cost of the paper's rivals, printed and ours; its own method is in `glance`."""
    measured, lines = paper.lines(RESULTS / name for name in paper.FOLDERS), []
    for task in paper.PRINTED:
        cells = []
        for line in measured:
            if line.task == task and line.method != "ICBF":
                reward, _, cost, _ = line.printed
                cells += [f"*{reward:.2f} / {cost:.2f}*", paper.brief(line)]
        lines.append((task, *cells))
    heads = ("*MA-TD3+BC, paper*", "MA-TD3+BC, ours", "*OMAR, paper*", "OMAR, ours")
    return markdown(("task", *heads), lines)


TABLES: dict[tuple[str, str], Callable[[], str]] = {
    ("README.md", "glance"): glance,
    (PAGE, "paper"): of_paper,
    (PAGE, "planner-rows"): spread,
    (PAGE, "planner-ablations"): changes,
    (PAGE, "planner-algorithm1"): algorithm1,
}
