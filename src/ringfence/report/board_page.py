"""The leaderboard of a results folder on one page that needs nothing but itself."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from ringfence.algos import ALGORITHMS
from ringfence.evaluation import statistics
from ringfence.logs.provenance import regenerated
from ringfence.report import board_figures, figures
from ringfence.report.board import Board, Method, read
from ringfence.report.page import WORDS, danger, environments, facts, headline, render
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
from ringfence.utils.files import whole


def build_board(folder: str | Path, out: str | Path, title: str | None = None) -> Path:
    """Write the leaderboard of a results folder as one self-contained HTML page and return its path.

    `out` is the page, or a folder that gets `report.html`. `UserError` where the folder holds no finished cell or
    numbers that must not be compared.
    """
    board = read(folder)
    out = Path(out)
    out = out / "report.html" if out.is_dir() else out
    text = render("board.html.j2", _context(board, out, title))
    with whole(out) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return out


def _context(board: Board, out: Path, title: str | None) -> dict:
    tables, rows_to_beat = standings(board), references(board)
    styles = {r.method: r.style for rows in tables.values() for r in rows}
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


@dataclass(frozen=True)
class Ranking:
    """Methods by their mean rank over the tasks that follow one protocol."""

    protocol: str  # empty where a board has one kind of tasks
    tasks: list[str]
    rows: list[dict]  # name, variant, style, cells (a Standing or None per task), mean, within, measured


def rankings(board: Board, tables: dict[str, list[Standing]]) -> list[Ranking]:
    """One per protocol: tasks that share data and policies under two limits are not two tasks."""
    return [Ranking(p, tasks, _ranks(board, tasks, tables)) for p, tasks in by_protocol(board).items()]


def _ranks(board: Board, tasks: list[str], tables: dict[str, list[Standing]]) -> list[dict]:
    """Mean ranks are counted among the methods that were measured on every task; the others come last, since they have
    none."""
    rows = []
    cells = {m: [next((r for r in tables[t] if r.method == m), None) for t in tasks] for m in board.methods}
    complete = [m for m in board.methods if all(cells[m])]
    among = {m: [] for m in complete}
    for k, task in enumerate(tasks):
        told = [cells[m][k] for m in complete]
        limit = board.constants.get(task, {}).get("cost_limit", 0.0)  # a task may have no result yet
        places = statistics.places([r.returns for r in told], [r.cost_interval[1] for r in told], limit)
        for m, place in zip(complete, places):
            among[m].append(place)
    for m, row in cells.items():
        if any(row):
            mean = float(np.mean(among[m])) if m in among else None
            style = next(c.style for c in row if c)
            rows.append({"name": m.name, "variant": m.shown, "style": style, "reference": False, "cells": row})
            rows[-1] |= {"mean": mean, "within": sum(c.safe for c in row if c), "measured": sum(map(bool, row))}
    return sorted(rows, key=lambda r: (r["mean"] is None, r["mean"] or 0.0))


def _seeds(tables: dict[str, list[Standing]]) -> str:
    """How many seeds the rows have, in words."""
    counts = [len(r.seeds) for rows in tables.values() for r in rows]
    low, high = min(counts), max(counts)
    if low == high:
        return f"{high} seed{'s' * (high > 1)}"
    most = max(set(counts), key=counts.count)
    return f"{low} to {high} seeds, {counts.count(most)} of {len(counts)} rows with {most}"


def _older(tables: dict[str, list[Standing]]) -> list[tuple[str, str, list[int]]]:
    """(task, method, seeds) trained by an older revision of their algorithm than this package has."""
    found = []
    for task, rows in tables.items():
        for r in rows:
            now = ALGORITHMS[r.method.algorithm].revision if r.method.algorithm in ALGORITHMS else 1
            if seeds := [e.seed for e in r.entries if e.revision < now]:
                found.append((task, r.label, seeds))
    return found


def published(board: Board, tables: dict[str, list[Standing]]) -> dict | None:
    """Printed values with ours below them, for the tasks of this board; None where nothing was printed."""
    tasks = [t for t in board.tasks if any(t in p.values for p in PUBLISHED)]
    if not tasks:
        return None
    rows, printed = [], [p for p in PUBLISHED if any(t in p.values for t in tasks)]
    for k, p in enumerate(printed):
        ours = []
        again = any(p.algorithms == later.algorithms for later in printed[k + 1 :])  # ours follow the last of them
        for m in (m for m in board.methods if matches(p, m.algorithm) and not again):
            cells = [next((r for r in tables[t] if r.method == m), None) for t in tasks]
            ours.append({"label": m.label, "numbers": [c and 100 * c.returns_norm for c in cells]})
        rows.append({"name": p.name, "source": p.source, "numbers": [p.values.get(t) for t in tasks], "ours": ours})
    return {"tasks": [short(t, board.suite) for t in tasks], "rows": rows}


def _section(board: Board, task: str, k: int, rows: list[Standing], rows_to_beat: list[Standing], out: Path) -> dict:
    told = rows[0].entries[0].path if rows else None
    config = Run(told).config if told else {}
    hazard = config.get("hazard") or {}
    card = config.get("data") or {}
    unit, event = WORDS.get(hazard.get("kind"), ("cost", "a violation"))
    constants = board.constants.get(task)
    section = Section(task, hazard, card, constants, board.protocol, [], {board.split: rows}, rows_to_beat)
    drawn = figures.scatter(section, rows, f"{unit} per episode", f"s{k}") if rows else None
    return {
        "id": f"task{k}",
        "task": task,
        "short": short(task, board.suite),
        "unit": unit,
        "headline": _headline(section, board),
        "rows": rows,
        "references": rows_to_beat,
        "absent": _absent(board, rows),
        "contests": contests(rows),
        "constants": constants,
        "ceiling": card.get("return_ceiling"),
        "danger": danger(hazard),
        "ends": any(r.ended for r in (*rows, *rows_to_beat)),
        "scatter": Markup(drawn) if drawn else None,
        "files": [(r.label, e.seed, *_link(e.path / "config.json", out)) for r in rows for e in r.entries],
        "card": facts(card),
        "regenerated": regenerated(card),
    }


def _headline(section: Section, board: Board) -> list[str]:
    if not section.tables[board.split]:
        return ["No method has been measured on this task yet."]
    return headline(section)


def _absent(board: Board, rows: list[Standing]) -> list[Method]:
    """Methods of the board that this task has no result of: they get a row that says so."""
    there = {r.method for r in rows}
    return [m for m in board.methods if m not in there]


def _missing(board: Board) -> list[dict]:
    """Cells without a result; seeds of one job that lack it for the same reason share a line."""
    groups: dict[tuple, list[int]] = {}
    for m in board.missing:
        groups.setdefault((m.task, m.job, m.why), []).append(m.seed)
    return [{"task": task, "job": job, "why": why, "seeds": seeds} for (task, job, why), seeds in groups.items()]


def _link(file: Path, out: Path) -> tuple[str, str]:
    """(text, href): the path from the page's folder."""
    relative = Path(os.path.relpath(file.resolve(), out.resolve().parent)).as_posix()
    return relative, quote(relative)


def _aggregate(board: Board, told: Aggregate, k: int, styles: dict) -> dict:
    best_first = sorted(told.methods, key=lambda m: -told.iqm_returns[m][0])
    order = [told.methods.index(m) for m in best_first]
    pick = np.ix_(order, order)
    several = len(told.methods) > 1
    earns, costs = told.improves[pick], told.cheaper[pick]
    return {
        "protocol": told.protocol,
        "tasks": len(told.tasks),
        "overall": Markup(board_figures.overall(told, styles, f"overall{k}")),
        "rows": [
            {
                "name": m.name,
                "variant": m.shown,
                "style": styles[m],
                "reference": False,
                "returns": told.iqm_returns[m],
                "costs": told.iqm_costs[m],
                "seeds": len(told.seeds[m]),
            }
            for m in best_first
        ],
        "alone": any(len(seeds) == 1 for seeds in told.seeds.values()),
        "earns": Markup(board_figures.duels(earns, best_first, "earns more", f"earns{k}")) if several else "",
        "costs": Markup(board_figures.duels(costs, best_first, "costs less", f"costs{k}")) if several else "",
        "profiles": Markup(board_figures.profiles(told, styles, f"profiles{k}")),
        "left_out": [(m.label, [short(t, board.suite) for t in at]) for m, at in told.left_out.items()],
        "fewer": [(m.label, told.seeds[m]) for m in told.methods if len(told.seeds[m]) < len(board.seeds)],
    }


def _typical(board: Board, tables: dict[str, list[Standing]]) -> list[Standing]:
    """One row per method for the figure of time and size: that of the first task it was measured on."""
    rows = {r.method: r for t in reversed(board.tasks) for r in tables[t]}
    return [rows[m] for m in board.methods]
