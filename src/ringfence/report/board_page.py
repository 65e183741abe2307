"""The leaderboard of a results folder on one page that needs nothing but itself."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from ringfence.algos import ALGORITHMS
from ringfence.evaluation import statistics
from ringfence.evaluation.statistics import Interval
from ringfence.report import board_figures, html
from ringfence.report.board import Board, read
from ringfence.report.page import TEMPLATE, of_section
from ringfence.report.provenance import environments
from ringfence.report.published import NOTE, PUBLISHED, matches
from ringfence.report.standings import DRAWS, Aggregate, aggregates, by_protocol, contests
from ringfence.report.table import Line, Method


def build_board(folder: str | Path, out: str | Path, title: str | None = None) -> Path:
    """Write the leaderboard of a results folder as one self-contained HTML page and return its path.

    `out` is the page, or a folder that gets `report.html`. `UserError` where the folder holds no finished cell or
    numbers that must not be compared.
    """
    board = read(folder)
    out = html.page_file(out)
    return html.write(out, html.render(TEMPLATE, _context(board, out, title)))


def _context(board: Board, out: Path, title: str | None) -> dict[str, Any]:
    lines = [line for some in board.lines.values() for line in some]
    any_line = {line.method: line for line in reversed(lines) if line.method}
    return {
        "title": title or f"Leaderboard: {board.suite.replace('_', ' ')}",
        "js": "",
        "board": board,
        "draws": DRAWS,
        "rankings": rankings(board),
        "seeds": _seeds(lines),
        "older": _older(board),
        "sections": [_section(board, task, k, out) for k, task in enumerate(board.tasks)],
        "aggregates": [_aggregate(board, a, k, any_line) for k, a in enumerate(aggregates(board))],
        "expenses": board_figures.expenses([any_line[m] for m in board.methods], "expenses"),
        "published": published(board),
        "note": NOTE,
        "missing": _missing(board),
        "environments": environments([run for each in board.sections.values() for run in each.runs]),
    }


def short(task: str, suite: str) -> str:
    """`simple_spread-expert` -> `expert` on a board of simple_spread."""
    return task.removeprefix(f"{suite}-") or task


# --- ranking ---


@dataclass(frozen=True)
class RankingRow:
    """A method over the tasks of a ranking."""

    line: Line  # of the first task on which it was measured
    cells: list[Line | None]  # per task
    mean: float | None  # of its ranks; None where a task is missing


@dataclass(frozen=True)
class Ranking:
    """Methods by their mean rank over the tasks that follow one protocol."""

    protocol: str  # empty where a board has one kind of tasks
    tasks: list[str]
    rows: list[RankingRow]


def rankings(board: Board) -> list[Ranking]:
    """One per protocol: tasks that share data and policies under two limits are not two tasks."""
    return [Ranking(p, tasks, _ranks(board, tasks)) for p, tasks in by_protocol(board).items()]


def _ranks(board: Board, tasks: list[str]) -> list[RankingRow]:
    """Mean ranks are counted among the methods that were measured on every task; the others come last, since they have
    none."""
    cells = {m: [board.line(t, m) for t in tasks] for m in board.methods}
    means = _mean_ranks(board, tasks, cells)
    rows = [
        RankingRow(first, row, means.get(method))
        for method, row in cells.items()
        if (first := next((cell for cell in row if cell), None))
    ]
    return sorted(rows, key=lambda r: (r.mean is None, r.mean or 0.0))


def _mean_ranks(board: Board, tasks: list[str], cells: dict[Method, list[Line | None]]) -> dict[Method, float]:
    """Of the methods that were measured on every task, among themselves."""
    complete = {m: [cell for cell in row if cell] for m, row in cells.items() if all(row)}
    places: list[np.ndarray] = []
    for k, task in enumerate(tasks):
        rows = [row[k] for row in complete.values()]
        limit = board.sections[task].constants.get("cost_limit", 0.0)  # a task may have no result yet
        places.append(statistics.places([r.returns for r in rows], [r.cost_interval[1] for r in rows], limit))
    return {m: float(np.mean([place[k] for place in places])) for k, m in enumerate(complete)}


# --- sections ---


def _seeds(lines: list[Line]) -> str:
    """How many seeds the lines have, in words."""
    counts = [len(line.seeds) for line in lines]
    low = min(counts)
    high = max(counts)
    if low == high:
        return f"{high} seeds" if high > 1 else f"{high} seed"
    most = max(set(counts), key=counts.count)
    return f"{low} to {high} seeds, {counts.count(most)} of {len(counts)} rows with {most}"


def _older(board: Board) -> list[tuple[str, str, list[int]]]:
    """(task, method, seeds) trained by an older revision of their algorithm than this package has."""
    found = []
    for task, lines in board.lines.items():
        for line in lines:
            known = ALGORITHMS.get(line.method.algorithm) if line.method else None
            revision = known.revision if known else 1
            if seeds := [row.seed for row in line.rows if row.config.get("revision", 1) < revision]:
                found.append((task, line.label, seeds))
    return found


@dataclass(frozen=True)
class Ours:
    """What a method of ours earned on the tasks; None where it was not measured."""

    label: str
    numbers: list[float | None]


@dataclass(frozen=True)
class PublishedRow:
    """A published method's values on the tasks, and ours of the same kind."""

    name: str
    source: str
    numbers: list[float | None]
    ours: list[Ours]


@dataclass(frozen=True)
class PublishedTable:
    """Printed values with ours below them."""

    tasks: list[str]
    rows: list[PublishedRow]


def published(board: Board) -> PublishedTable | None:
    """For the tasks of this board; None where nothing was printed."""
    tasks = [t for t in board.tasks if any(t in p.values for p in PUBLISHED)]
    if not tasks:
        return None
    printed = [p for p in PUBLISHED if any(t in p.values for t in tasks)]
    rows = []
    for k, entry in enumerate(printed):
        again = any(entry.algorithms == later.algorithms for later in printed[k + 1 :])  # ours follow the last of them
        ours = [] if again else [m for m in board.methods if matches(entry, m.algorithm)]
        numbers = [entry.values.get(t) for t in tasks]
        rows.append(PublishedRow(entry.name, entry.source, numbers, [_ours(board, m, tasks) for m in ours]))
    return PublishedTable([short(t, board.suite) for t in tasks], rows)


def _ours(board: Board, method: Method, tasks: list[str]) -> Ours:
    cells = [board.line(t, method) for t in tasks]
    return Ours(method.label, [None if cell is None else 100 * cell.returns_norm for cell in cells])


def _section(board: Board, task: str, k: int, out: Path) -> dict[str, Any]:
    """What the template shows of a task."""
    section = board.sections[task]
    lines = board.lines[task]
    there = {line.method for line in lines}
    more = {
        "short": short(task, board.suite),
        "absent": [m for m in board.methods if m not in there],  # they get a row that says so
        "contests": contests(lines),
        "files": [
            (line.label, row.seed, *_link(row.file.with_name("config.json"), out))
            for line in lines
            for row in line.rows
        ],
    }
    if not lines:
        more["headline"] = ["No method has been measured on this task yet."]
    return of_section(section, k) | more


def _link(file: Path, out: Path) -> tuple[str, str]:
    """(text, href): the path from the page's folder."""
    relative = Path(os.path.relpath(file.resolve(), out.resolve().parent)).as_posix()
    return relative, quote(relative)


def _missing(board: Board) -> list[tuple[str, str, str, list[int]]]:
    """(task, job, why, seeds) of cells without a result; seeds that lack it for the same reason share a line."""
    groups: dict[tuple[str, str, str], list[int]] = {}
    for m in board.missing:
        groups.setdefault((m.task, m.job, m.why), []).append(m.seed)
    return [(*job, seeds) for job, seeds in groups.items()]


@dataclass(frozen=True)
class AggregateRow:
    """A method over all tasks of a protocol."""

    line: Line  # of one of the tasks
    returns: tuple[float, Interval | None]
    costs: tuple[float, Interval | None]
    seeds: int


def _aggregate(board: Board, aggregate: Aggregate, k: int, lines: dict[Method, Line]) -> dict[str, Any]:
    """What the template shows of a protocol's tasks together."""
    best_first = sorted(aggregate.methods, key=lambda m: -aggregate.iqm_returns[m][0])
    rows = [
        AggregateRow(
            line=lines[m],
            returns=aggregate.iqm_returns[m],
            costs=aggregate.iqm_costs[m],
            seeds=len(aggregate.seeds[m]),
        )
        for m in best_first
    ]
    earns = ""
    costs = ""
    if len(best_first) > 1:
        order = [aggregate.methods.index(m) for m in best_first]
        pairs = np.ix_(order, order)
        earns = board_figures.duels(aggregate.improves[pairs], best_first, "earns more", f"earns{k}")
        costs = board_figures.duels(aggregate.cheaper[pairs], best_first, "costs less", f"costs{k}")
    seeds = aggregate.seeds
    styles = {m: line.style for m, line in lines.items()}
    return {
        "protocol": aggregate.protocol,
        "tasks": len(aggregate.tasks),
        "overall": board_figures.overall(aggregate, styles, f"overall{k}"),
        "rows": rows,
        "alone": any(len(some) == 1 for some in seeds.values()),
        "earns": earns,
        "costs": costs,
        "profiles": board_figures.profiles(aggregate, styles, f"profiles{k}"),
        "left_out": [(m.label, [short(t, board.suite) for t in at]) for m, at in aggregate.left_out.items()],
        "fewer": [(m.label, seeds[m]) for m in aggregate.methods if len(seeds[m]) < len(board.seeds)],
    }
