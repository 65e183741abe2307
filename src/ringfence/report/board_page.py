"""The leaderboard of a results folder on one page that needs nothing but itself."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from ringfence.algos import ALGORITHMS
from ringfence.evaluation import statistics
from ringfence.evaluation.statistics import Interval
from ringfence.logs.provenance import regenerated
from ringfence.report import board_figures, figures, html
from ringfence.report.board import Board, Method, read
from ringfence.report.board_figures import Style
from ringfence.report.headline import danger, headline, words_of
from ringfence.report.made import environments, facts
from ringfence.report.published import NOTE, PUBLISHED, matches
from ringfence.report.standings import (
    DRAWS,
    Aggregate,
    Standing,
    aggregates,
    by_protocol,
    contests,
    references,
    standings,
)
from ringfence.report.table import Section
from ringfence.training.runs import Run


def build_board(folder: str | Path, out: str | Path, title: str | None = None) -> Path:
    """Write the leaderboard of a results folder as one self-contained HTML page and return its path.

    `out` is the page, or a folder that gets `report.html`. `UserError` where the folder holds no finished cell or
    numbers that must not be compared.
    """
    board = read(folder)
    out = html.page_file(out)
    return html.write(out, html.render("board.html.j2", _context(board, out, title)))


def _context(board: Board, out: Path, title: str | None) -> dict[str, Any]:
    tables = standings(board)
    rows_to_beat = references(board)
    styles = {r.method: r.style for rows in tables.values() for r in rows if r.method}
    return {
        "title": title or f"Leaderboard: {board.suite.replace('_', ' ')}",
        "board": board,
        "draws": DRAWS,
        "rankings": rankings(board, tables),
        "seeds": _seeds(tables),
        "older": _older(tables),
        "sections": [_section(board, t, k, tables[t], rows_to_beat[t], out) for k, t in enumerate(board.tasks)],
        "aggregates": [_aggregate(board, a, k, styles) for k, a in enumerate(aggregates(board))],
        "expenses": Markup(board_figures.expenses(_typical(board, tables), "expenses")),
        "published": published(board, tables),
        "note": NOTE,
        "missing": _missing(board),
        "environments": environments(board.runs),
    }


def short(task: str, suite: str) -> str:
    """`simple_spread-expert` -> `expert` on a board of simple_spread."""
    return task.removeprefix(f"{suite}-") or task


# --- ranking ---


@dataclass(frozen=True)
class RankingRow:
    """A method over the tasks of a ranking."""

    method: Method
    style: Style
    cells: list[Standing | None]  # per task
    mean: float | None  # of its ranks; None where a task is missing
    reference: bool = False

    @property
    def name(self) -> str:
        return self.method.name

    @property
    def variant(self) -> str:
        return self.method.shown

    @property
    def within(self) -> int:
        """Tasks on which it keeps the limit."""
        return sum(cell.safe for cell in self.cells if cell)

    @property
    def measured(self) -> int:
        """Tasks on which it was measured."""
        return sum(cell is not None for cell in self.cells)


@dataclass(frozen=True)
class Ranking:
    """Methods by their mean rank over the tasks that follow one protocol."""

    protocol: str  # empty where a board has one kind of tasks
    tasks: list[str]
    rows: list[RankingRow]


def rankings(board: Board, tables: dict[str, list[Standing]]) -> list[Ranking]:
    """One per protocol: tasks that share data and policies under two limits are not two tasks."""
    return [Ranking(p, tasks, _ranks(board, tasks, tables)) for p, tasks in by_protocol(board).items()]


def _ranks(board: Board, tasks: list[str], tables: dict[str, list[Standing]]) -> list[RankingRow]:
    """Mean ranks are counted among the methods that were measured on every task; the others come last, since they have
    none."""
    cells = {m: [next((r for r in tables[t] if r.method == m), None) for t in tasks] for m in board.methods}
    means = _mean_ranks(board, tasks, cells)
    rows = []
    for method, row in cells.items():
        measured = [cell for cell in row if cell]
        if measured:
            rows.append(RankingRow(method, measured[0].style, row, means.get(method)))
    return sorted(rows, key=lambda r: (r.mean is None, r.mean or 0.0))


def _mean_ranks(board: Board, tasks: list[str], cells: dict[Method, list[Standing | None]]) -> dict[Method, float]:
    """Of the methods that were measured on every task, among themselves."""
    complete = {m: [cell for cell in row if cell] for m, row in cells.items() if all(row)}
    places: list[np.ndarray] = []
    for k, task in enumerate(tasks):
        rows = [row[k] for row in complete.values()]
        limit = board.constants.get(task, {}).get("cost_limit", 0.0)  # a task may have no result yet
        places.append(statistics.places([r.returns for r in rows], [r.cost_interval[1] for r in rows], limit))
    return {m: float(np.mean([place[k] for place in places])) for k, m in enumerate(complete)}


# --- sections ---


def _seeds(tables: dict[str, list[Standing]]) -> str:
    """How many seeds the rows have, in words."""
    counts = [len(r.seeds) for rows in tables.values() for r in rows]
    low = min(counts)
    high = max(counts)
    if low == high:
        return f"{high} seeds" if high > 1 else f"{high} seed"
    most = max(set(counts), key=counts.count)
    return f"{low} to {high} seeds, {counts.count(most)} of {len(counts)} rows with {most}"


def _older(tables: dict[str, list[Standing]]) -> list[tuple[str, str, list[int]]]:
    """(task, method, seeds) trained by an older revision of their algorithm than this package has."""
    found = []
    for task, rows in tables.items():
        for row in rows:
            known = ALGORITHMS.get(row.method.algorithm) if row.method else None
            revision = known.revision if known else 1
            if seeds := [e.seed for e in row.entries if e.revision < revision]:
                found.append((task, row.label, seeds))
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


def published(board: Board, tables: dict[str, list[Standing]]) -> PublishedTable | None:
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
        rows.append(PublishedRow(entry.name, entry.source, numbers, [_ours(m, tasks, tables) for m in ours]))
    return PublishedTable([short(t, board.suite) for t in tasks], rows)


def _ours(method: Method, tasks: list[str], tables: dict[str, list[Standing]]) -> Ours:
    cells = [next((r for r in tables[t] if r.method == method), None) for t in tasks]
    return Ours(method.label, [None if cell is None else 100 * cell.returns_norm for cell in cells])


def _section(
    board: Board, task: str, k: int, rows: list[Standing], rows_to_beat: list[Standing], out: Path
) -> dict[str, Any]:
    """What the template shows of a task."""
    config = Run(rows[0].entries[0].path).config if rows else {}
    card = config.get("data") or {}
    section = Section(
        task=task,
        hazard=config.get("hazard") or {},
        card=card,
        constants=board.constants.get(task, {}),
        protocol=board.protocol,
        runs=[],
        tables={board.split: rows},
        references=rows_to_beat,
    )
    unit, _ = words_of(section.hazard)
    drawn = figures.scatter(section, rows, f"{unit} per episode", f"s{k}") if rows else None
    return {
        "id": f"task{k}",
        "task": task,
        "short": short(task, board.suite),
        "unit": unit,
        "headline": headline(section) if rows else ["No method has been measured on this task yet."],
        "rows": rows,
        "references": rows_to_beat,
        "absent": _absent(board, rows),
        "contests": contests(rows),
        "constants": section.constants,
        "ceiling": card.get("return_ceiling"),
        "danger": danger(section.hazard),
        "ends": any(r.ended for r in (*rows, *rows_to_beat)),
        "scatter": Markup(drawn) if drawn else None,
        "files": [(r.label, e.seed, *_link(e.path / "config.json", out)) for r in rows for e in r.entries],
        "card": facts(card),
        "regenerated": regenerated(card),
    }


def _absent(board: Board, rows: list[Standing]) -> list[Method]:
    """Methods of the board that this task has no result of: they get a row that says so."""
    there = {r.method for r in rows}
    return [m for m in board.methods if m not in there]


def _link(file: Path, out: Path) -> tuple[str, str]:
    """(text, href): the path from the page's folder."""
    relative = Path(os.path.relpath(file.resolve(), out.resolve().parent)).as_posix()
    return relative, quote(relative)


@dataclass(frozen=True)
class MissingSeeds:
    """Cells without a result; seeds of one job that lack it for the same reason share a line."""

    task: str
    job: str
    why: str
    seeds: list[int]


def _missing(board: Board) -> list[MissingSeeds]:
    groups: dict[tuple[str, str, str], list[int]] = {}
    for m in board.missing:
        groups.setdefault((m.task, m.job, m.why), []).append(m.seed)
    return [MissingSeeds(*job, seeds) for job, seeds in groups.items()]


@dataclass(frozen=True)
class AggregateRow:
    """A method over all tasks of a protocol."""

    name: str
    variant: str
    style: Style
    returns: tuple[float, Interval | None]
    costs: tuple[float, Interval | None]
    seeds: int
    reference: bool = False


def _aggregate(board: Board, aggregate: Aggregate, k: int, styles: dict[Method, Style]) -> dict[str, Any]:
    """What the template shows of a protocol's tasks together."""
    best_first = sorted(aggregate.methods, key=lambda m: -aggregate.iqm_returns[m][0])
    rows = [
        AggregateRow(
            name=m.name,
            variant=m.shown,
            style=styles[m],
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
        earns = Markup(board_figures.duels(aggregate.improves[pairs], best_first, "earns more", f"earns{k}"))
        costs = Markup(board_figures.duels(aggregate.cheaper[pairs], best_first, "costs less", f"costs{k}"))
    seeds = aggregate.seeds
    return {
        "protocol": aggregate.protocol,
        "tasks": len(aggregate.tasks),
        "overall": Markup(board_figures.overall(aggregate, styles, f"overall{k}")),
        "rows": rows,
        "alone": any(len(some) == 1 for some in seeds.values()),
        "earns": earns,
        "costs": costs,
        "profiles": Markup(board_figures.profiles(aggregate, styles, f"profiles{k}")),
        "left_out": [(m.label, [short(t, board.suite) for t in at]) for m, at in aggregate.left_out.items()],
        "fewer": [(m.label, seeds[m]) for m in aggregate.methods if len(seeds[m]) < len(board.seeds)],
    }


def _typical(board: Board, tables: dict[str, list[Standing]]) -> list[Standing]:
    """One row per method for the figure of time and size: that of the first task it was measured on."""
    rows = {r.method: r for t in reversed(board.tasks) for r in tables[t]}
    return [rows[m] for m in board.methods]
