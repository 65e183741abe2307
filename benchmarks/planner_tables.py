"""Writes docs/planner-results.md's tables, and the table at a glance in README.md and docs/benchmark.md, from results/
alone.

    python benchmarks/planner_tables.py
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from common import RESULTS, markdown, put
from evidence import evaluations, variant

from ringfence.bench import paper
from ringfence.datasets.registry import TASKS
from ringfence.evaluation.statistics import mean_of_runs

PAGE = "docs/planner-results.md"
SPREAD = ("expert", "medium-replay", "medium", "random")
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


def earned(found: Rows, task: str) -> str:
    """Mean of the normalised return, with its interval over resets and, of several, over seeds."""
    x = TASKS[task].normalised_return(episodes(found, "return"))
    low, high = mean_of_runs(x)
    return f"{x.mean():.3f} [{low:.3f}, {high:.3f}]"


def paid(found: Rows) -> str:
    """Mean cost of episodes that start safe, and its interval."""
    cost = episodes(found, "cost")
    safe = 1.0 - episodes(found, "unsafe_start")
    low, high = mean_of_runs(cost, safe, least=0.0)
    return f"{(cost * safe).sum() / safe.sum():.2f} [{low:.2f}, {high:.2f}]"


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


WAYS = {
    "as it is": "`icbf`, as it is",
    "alone": "without guidance (`madiff`)",
    "best of 8": "the best of 8",
    "best of 64": "the best of 64",
    "best of 64, spread 1": "the best of 64, drawn no wider apart than single plans",
    "best of 64, spread 5": "the best of 64, drawn wider still (`spread=5`)",
}


def spread() -> str:
    """A line for each way of playing the same runs, by task."""
    lines = []
    for task in (f"simple_spread-{tier}{pool}" for pool in ("", "-pooled") for tier in SPREAD):
        rows = rows_of("rows", task)
        if not rows:
            continue
        file = json.loads((RESULTS / "planner" / f"rows-{task}.json").read_text())
        lines.append((f"*{task}*: the logs", "", f"{file['logs']:.3f}", "", "", ""))
        for way, words in WAYS.items():
            found = played(rows, "icbf", way)
            if found:
                passes = f"{np.mean([r['passes'] for r in found]):.2f}"
                seconds = f"{np.mean([r['seconds'] for r in found]):.0f}"
                lines.append((words, str(len(found)), earned(found, task), paid(found), passes, seconds))
    return markdown(("", "seeds", "return, normalised", "cost of safe starts", "passes", "seconds"), lines)


def changes(group: str, way: str, tasks: Sequence[str], paired: str | None = None) -> str:
    """A line for each row of a group: return / cost, passes and seconds on each task."""
    heads = [""]
    for task in tasks:
        heads += [task.removeprefix("simple_spread-"), "less *as it is*" if paired else "", "passes", "seconds"]
    names = list(dict.fromkeys(r["name"] for task in tasks for r in rows_of(group, task)))
    lines = []
    for name in names:
        line = [name]
        for task in tasks:
            rows = rows_of(group, task)
            found = played(rows, name, way)
            apart = less(found, played(rows, paired, way), task) if paired and found and name != paired else ""
            some = [f"{found[0]['passes']:.2f}", f"{np.mean([r['seconds'] for r in found]):.0f}"] if found else ["", ""]
            line += [brief(found), apart, *some]
        lines.append(line)
    keep = [i for i, head in enumerate(heads) if head or i == 0]
    return markdown([heads[i] for i in keep], [[line[i] for i in keep] for line in lines])


def full() -> str:
    """What the guard `full` earns from plans and from clones, of the same seeds and on the same resets."""
    lines = []
    for task in (f"simple_spread-{tier}" for tier in SPREAD):
        plans, clones = (played(rows_of("guards", task), name, "under full") for name in ("icbf", "bc"))
        lines.append((task.removeprefix("simple_spread-"), brief(plans), brief(clones), less(plans, clones, task)))
    return markdown(("logs", "`full` from plans", "`full` from clones", "difference"), lines)


LEARNED = ("simple_spread-expert", "simple_spread-expert-pooled")


def frontier() -> str:
    """λ of the barrier in training, with guidance inside sampling and without."""
    task = LEARNED[0]
    rows = rows_of("frontier", task)
    names = list(dict.fromkeys(r["name"] for r in rows))
    lines = []
    usual = rows_of("rows", task)
    seeds = {r["seed"] for r in rows}
    zero = [r for r in usual if r["seed"] in seeds]
    for name, some in [("λ = 0", zero), *((name, rows) for name in names)]:
        row = "icbf" if name == "λ = 0" else name
        cells = [played(some, row, way) for way in ("alone", "as it is")]
        lines.append((name, *(brief(cell) for cell in cells)))
    return markdown(("", "without guidance", "guided"), lines)


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
            guarded = rows_of("guards", task)
            cells.append(brief([r for r in algorithm1 if r["name"] == best]))
            cells.append(brief(played(rows_of("rows", task), "icbf", "as it is")))
            cells += [brief(played(guarded, "icbf", f"under {guard}")) for guard in ("shield", "full")]
            clones = sums_of("guards", task, ("bc", "default+shield-learned"))
            cells.append(clones if clones != "–" else pooled_row(task, "bc, 20,000 updates, under shield"))
            logs = sums_of("simple_spread", task, ("behaviour data", "reference"))
            cells.append(logs if logs != "–" else pooled_logs(task))
        else:
            rows = rows_of("robots", task)
            cells += ["–", robot(played(rows, "icbf", "cool"), task)]
            cells += [robot(played(rows, "icbf", "cool, under adapt"), task), "–"]
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


def others() -> str:
    """Robots and Crossing: the same defaults on systems that chose nothing."""
    lines = []
    for task in (*(t for t in paper.PRINTED if not t.startswith("simple")), "crossing-hasty"):
        for group in ("robots", "crossing"):
            rows = rows_of(group, task)
            for name, way in dict.fromkeys((r["name"], way) for r in rows for way in r["plays"]):
                if (name, way) == ("bc", "alone"):  # nothing guides a clone
                    continue
                found = played(rows, name, way)
                plays = f"{np.mean([r['return_mean'] for r in found]):.4g}"
                lines.append(
                    (task, f"`{name}`, {way}", str(len(found)), plays, f"{np.mean([r['cost'] for r in found]):.2f}")
                )
    return markdown(("task", "who", "seeds", "return", "cost"), lines)


TABLES: dict[tuple[str, str], Callable[[], str]] = {
    (PAGE, "planner-rows"): spread,
    (PAGE, "planner-ablations"): lambda: changes("ablations", "alone", LEARNED, "as it is"),
    (PAGE, "planner-frontier"): frontier,
    (PAGE, "planner-algorithm1"): lambda: changes("algorithm1", "as it is", LEARNED),
    (PAGE, "planner-full"): full,
    (PAGE, "planner-others"): others,
    ("README.md", "glance"): glance,
    ("docs/benchmark.md", "glance"): glance,
}


def write_tables() -> None:
    for (page, mark), make in TABLES.items():
        put(page, mark, make())


if __name__ == "__main__":
    write_tables()
