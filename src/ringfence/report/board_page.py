"""The leaderboard of a results folder on one page that needs nothing but itself.

Every method has a name or a marker and a line style beside its colour, so that no figure needs colours to be read.
Results of others stand there as they were printed, for reading beside ours: they are not measured here and never ranked
with our rows.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

from ringfence.algos import ALGORITHMS
from ringfence.datasets import registry
from ringfence.evaluation.statistics import Interval
from ringfence.report import html
from ringfence.report.board import (
    DRAWS,
    Aggregate,
    Board,
    aggregates,
    contests,
    rankings,
    read,
    short,
)
from ringfence.report.figures import FAR, INK, Ticks, colour, figure, figure_with_legend, marker, style, to_svg
from ringfence.report.page import TEMPLATE, of_section
from ringfence.report.provenance import environments
from ringfence.report.table import Line, Method, Style

DASHES = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)), (0, (3, 1, 1, 1, 1, 1)))
WIDTH = 9.2  # inches of a wide figure
LIMIT = (0, (3, 3))  # line style
LABEL = 0.075  # inches that a letter of a method's name takes
NOTE = "Published, on the public data files; ours are on regenerated data."


def build_board(folder: str | Path, out: str | Path, title: str | None = None) -> Path:
    """Write the leaderboard of a results folder as one self-contained HTML page and return its path.

    `out` is the page, or a folder that gets `report.html`. `UserError` where the folder holds no finished cell or
    numbers that must not be compared.
    """
    board = read(folder)
    out = html.page_file(out)
    lines = [line for some in board.lines.values() for line in some]
    any_line = {line.method: line for line in reversed(lines) if line.method}
    # (task, method, seeds) trained by an older revision of their algorithm than this package has.
    found = []
    for where, of_task in board.lines.items():
        for one in of_task:
            known = ALGORITHMS.get(one.method.algorithm) if one.method else None
            revision = known.revision if known else 1
            if seeds := [row.seed for row in one.rows if row.config.get("revision", 1) < revision]:
                found.append((where, one.label, seeds))
    # (task, job, why, seeds) of cells without a result; seeds that lack it for the same reason share a line.
    groups: dict[tuple[str, str, str], list[int]] = {}
    for lacking in board.missing:
        groups.setdefault((lacking.task, lacking.job, lacking.why), []).append(lacking.seed)
    context = {
        "title": title or f"Leaderboard: {board.suite.replace('_', ' ')}",
        "js": "",
        "board": board,
        "draws": DRAWS,
        "rankings": rankings(board),
        "seeds": _seeds(lines),
        "older": found,
        "sections": [_section(board, task, k, out) for k, task in enumerate(board.tasks)],
        "aggregates": [_aggregate(board, a, k, any_line) for k, a in enumerate(aggregates(board))],
        "expenses": expenses([any_line[m] for m in board.methods], "expenses"),
        "published": published(board),
        "note": NOTE,
        "missing": [(*job, seeds) for job, seeds in groups.items()],
        "environments": environments([run for each in board.sections.values() for run in each.runs]),
    }
    return html.write(out, html.render(TEMPLATE, context))


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
        lines = {m: [board.line(t, m) for t in tasks] for m in ours}
        percent = [Ours(m.label, [100 * x.returns_norm if x else None for x in row]) for m, row in lines.items()]
        rows.append(PublishedRow(entry.name, entry.source, numbers, percent))
    return PublishedTable([short(t, board.suite) for t in tasks], rows)


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
        earns = duels(aggregate.improves[pairs], best_first, "earns more", f"earns{k}")
        costs = duels(aggregate.cheaper[pairs], best_first, "costs less", f"costs{k}")
    seeds = aggregate.seeds
    styles = {m: line.style for m, line in lines.items()}
    return {
        "protocol": aggregate.protocol,
        "tasks": len(aggregate.tasks),
        "overall": overall(aggregate, styles, f"overall{k}"),
        "rows": rows,
        "alone": any(len(some) == 1 for some in seeds.values()),
        "earns": earns,
        "costs": costs,
        "profiles": profiles(aggregate, styles, f"profiles{k}"),
        "left_out": [(m.label, [short(t, board.suite) for t in at]) for m, at in aggregate.left_out.items()],
        "fewer": [(m.label, seeds[m]) for m in aggregate.methods if len(seeds[m]) < len(board.seeds)],
    }


def _whiskers(ax: Axes, rows: list[tuple[float, Interval | None]], styles: list[Style], digits: int) -> None:
    """A point with its interval, if it has one, per row, the first on top, and the number at the right edge, clear of
    the points."""
    where = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "center"}
    for y, ((value, interval), of) in enumerate(zip(rows, styles)):
        if interval:
            ax.plot(interval, (y, y), color=colour(of), linewidth=2.2, alpha=0.55, solid_capstyle="butt")
        ax.plot(value, y, marker(of), color=colour(of), markersize=7)
        ax.annotate(f"{value:.{digits}f}", (0.99, y), **where, fontsize=8.5, color=INK)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.grid(axis="y", visible=False)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    left, right = ax.get_xlim()
    ax.set_xlim(left, right + 0.16 * (right - left))


def overall(aggregate: Aggregate, styles: dict[Method, Style], name: str) -> Markup:
    """IQM of normalised return and of normalised cost over all tasks, the best return on top."""
    methods = sorted(aggregate.methods, key=lambda m: -aggregate.iqm_returns[m][0])
    with style():
        made = figure(WIDTH, 1.2 + 0.32 * len(methods))
        left, right = made.subplots(1, 2, sharey=True)
        inks = [styles[m] for m in methods]
        right.axvline(1.0, color=INK, linewidth=1.0, linestyle=LIMIT)  # first, so that it is in view
        _whiskers(left, [aggregate.iqm_returns[m] for m in methods], inks, 2)
        _whiskers(right, [aggregate.iqm_costs[m] for m in methods], inks, 2)
        left.set_yticks(range(len(methods)), [m.label for m in methods])
        left.set_xlabel("normalised return, IQM (more is better)")
        right.set_xlabel("normalised cost, IQM (less is better)")
        place = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
        right.annotate("limit", (1.0, 1.0), (3, 2), **place, fontsize=8.5)
        each = [
            f"{m.label}: return {aggregate.iqm_returns[m][0]:.2f}, cost {aggregate.iqm_costs[m][0]:.2f}"
            for m in methods
        ]
        return to_svg(made, f"Interquartile means over all tasks. {'; '.join(each)}", name)


def duels(matrix: np.ndarray, methods: list[Method], what: str, name: str) -> Markup:
    """Heat map of the probability that the row beats the column, with every probability printed."""
    n = len(methods)
    longest = max(len(m.label) for m in methods)
    numbered = [(k + 1, m.label) for k, m in enumerate(methods)]
    with style(axes_grid=False):
        made = figure(1.4 + LABEL * longest + 0.5 * n, 1.2 + 0.36 * n)
        ax = made.add_subplot()
        for row in range(n):
            for column in range(n):
                if row != column:
                    p = float(matrix[row, column])
                    # (fill, ink) of a probability: orange below one half, blue above, the further the stronger.
                    far = min(1.0, abs(2 * p - 1))
                    end = np.array([33, 102, 172] if p >= 0.5 else [191, 91, 23])
                    rgb = np.round(247 + (end - 247) * far).astype(int)
                    light = float(rgb @ [0.299, 0.587, 0.114]) > 140
                    fill, ink = "#{:02x}{:02x}{:02x}".format(*rgb), "#101010" if light else "#fafafa"
                    ax.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=fill, edgecolor="none"))
                    ax.text(column, row, f"{p:.2f}", ha="center", va="center", color=ink, fontsize=9)
        ax.set(xlim=(-0.5, n - 0.5), ylim=(n - 0.5, -0.5))
        ax.set_yticks(range(n), [f"{k}. {label}" for k, label in numbered])
        ax.set_xticks(range(n), [str(k) for k, _ in numbered])
        ax.xaxis.tick_top()
        ax.tick_params(length=0)
        for side in ax.spines.values():
            side.set_visible(False)
        ax.set_xlabel("compared with the method of this number")
        rows = ", ".join(f"{k} {label}" for k, label in numbered)
        return to_svg(made, f"Probability that the row's method {what} than the column's; rows are {rows}", name)


def profiles(aggregate: Aggregate, styles: dict[Method, Style], name: str) -> Markup:
    """Share of runs above a return and share of episodes within a cost, against the threshold."""
    methods = aggregate.methods
    with style():
        made, columns = figure_with_legend(WIDTH, 4.2, [m.label for m in methods])
        left, right = made.subplots(1, 2)
        for k, method in enumerate(methods):
            _profile(
                left, aggregate.return_thresholds, aggregate.return_profiles[k], aggregate.return_bands[k], method, k,
                styles[method],
            )  # fmt: skip
            _profile(
                right, aggregate.cost_thresholds, aggregate.cost_profiles[k], aggregate.cost_bands[k], method, k,
                styles[method],
            )  # fmt: skip
        left.set(xlabel="normalised return τ", ylabel="share of runs with return > τ", ylim=(-0.03, 1.03))
        right.set(xlabel="normalised cost τ (1: the limit)", ylabel="episodes with cost ≤ τ", ylim=(-0.03, 1.03))
        right.axvline(1.0, color=INK, linewidth=1.0, linestyle=LIMIT)
        if aggregate.cost_thresholds[-1] > FAR:
            right.set_xscale("symlog", linthresh=1.0)
            right.xaxis.set_major_formatter(Ticks())
            right.set_xlim(-0.05, aggregate.cost_thresholds[-1])
        handles, labels = left.get_legend_handles_labels()
        where = {"loc": "outside lower center", "ncols": columns, "frameon": False}
        made.legend(handles, labels, **where, fontsize=9, handlelength=3.2)
        label = "Profiles. Left: share of runs above a normalised return. Right: share of episodes within a cost."
        return to_svg(made, label, name)


def _profile(
    ax: Axes,
    thresholds: np.ndarray,
    shares: np.ndarray,
    band: np.ndarray | None,
    method: Method,
    k: int,
    of: Style,
) -> None:
    """The line of the k-th method with its band, if it has one."""
    if band is not None:
        low, high = band
        ax.fill_between(thresholds, low, high, color=colour(of), alpha=0.12, linewidth=0, step="post")
    ax.plot(
        thresholds,
        shares,
        color=colour(of),
        linestyle=DASHES[k % len(DASHES)],
        linewidth=1.6,
        marker=marker(of),
        markersize=5,
        markevery=(0.02 * (k % 8), 0.16),  # apart, so that markers of lines that coincide can be seen
        drawstyle="steps-post",
        label=method.label,
    )


def _brief(x: float) -> str:
    """30, 3 k, 1 M: a tick that leaves room for its neighbours."""
    for size, letter in ((1e6, " M"), (1e3, " k")):
        if x >= size:
            return f"{x / size:g}{letter}"
    return f"{x:g}"


def expenses(rows: list[Line], name: str) -> Markup:
    """Training seconds, parameters and time to act of each method, on logarithmic scales; None is said in words."""
    panels = (
        ("training, s of one seed", [r.train_seconds for r in rows], "{:,.0f}"),
        ("parameters", [r.parameters for r in rows], "{:,.0f}"),
        ("one joint action, ms", [r.plan_ms for r in rows], "{:.2g}"),
    )
    with style():
        made = figure(WIDTH, 1.2 + 0.32 * len(rows))
        axes = made.subplots(1, len(panels), sharey=True)
        for ax, (title, values, form) in zip(axes, panels):
            # A bar and a number per row, the first on top.
            measured = [v for v in values if v] or [1.0, 10.0]
            low = min(measured)
            high = max(measured)
            left = low / 1.6
            ax.set_xscale("log")
            ax.set_xlim(left, high * max(4.0, (high / low) ** 0.55))
            for y, (row, value) in enumerate(zip(rows, values)):
                if value:
                    ax.plot((left, value), (y, y), color=colour(row.style), linewidth=1.2, alpha=0.5)
                    ax.plot(value, y, marker(row.style), color=colour(row.style), markersize=6)
                text = form.format(value) if value else "not measured"
                where = (value or left, y)
                ax.annotate(text, where, (7, 0), textcoords="offset points", va="center", fontsize=8.5, color=INK)
            ax.set_ylim(len(rows) - 0.5, -0.5)
            ax.grid(axis="y", visible=False)
            ax.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 100 * low else (1.0, 3.0)))
            ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: _brief(x)))
            ax.minorticks_off()
            ax.set_xlabel(title)
        axes[0].set_yticks(range(len(rows)), [r.label for r in rows])
        return to_svg(made, "Training time, parameters and time to act of each method", name)


@dataclass(frozen=True)
class Published:
    """A method's printed values by task: normalised return times 100."""

    name: str
    source: str
    algorithms: tuple[str, ...]  # what the method is called here, without hyphens
    values: dict[str, float]


OMAR = "Pan et al. 2022 (OMAR), as tabulated in MADIFF's README"
MADIFF = "Zhu et al. 2024 (MADIFF), README"
COFLOW = "Guowei-Zou/coflow-release, raw returns of its table of MPE, normalised here"


def _spread(expert: float, replay: float, medium: float, random: float, pool: str = "") -> dict[str, float]:
    """OMAR and those before it learn one learner's logs a run; MADIFF and CoFlow learn five learners' at once, which
    are our tasks of the name's ending `pool`."""
    return {
        f"simple_spread-expert{pool}": expert,
        f"simple_spread-medium-replay{pool}": replay,
        f"simple_spread-medium{pool}": medium,
        f"simple_spread-random{pool}": random,
    }


def _robots(**raw: tuple[float, float, float]) -> dict[str, float]:
    """Raw returns of good, medium and poor by robot; no speed limit was known there, so both protocols show them."""
    found = {}
    for robot, returns in raw.items():
        for tier, value in zip(("good", "medium", "poor"), returns):
            for name in (f"{robot}-{tier}", f"{robot}-{tier}-quantile"):
                found[name] = round(100 * registry.get(name).normalised_return(value), 1)
    return found


PUBLISHED = (
    Published("BC", OMAR, ("bc",), _spread(35.0, 10.0, 31.6, -0.5)),
    Published(
        "BC",
        MADIFF,
        ("bc",),
        _robots(halfcheetah_2x3=(6846, 1627, 465), ant_2x4=(2697, 1145, 954), ant_4x2=(2802, 1617, 1033)),
    ),
    Published(
        "MA-TD3+BC",
        MADIFF,
        ("matd3bc",),
        _robots(halfcheetah_2x3=(7025, 2561, 736), ant_2x4=(2922, 744, 1256), ant_4x2=(2628, 1843, 1075)),
    ),
    Published(
        "OMAR",
        MADIFF,
        ("omar",),
        _robots(halfcheetah_2x3=(1434, 1892, 384), ant_2x4=(464, 799, 857), ant_4x2=(344, 929, 518)),
    ),
    Published(
        "MADiff-D (each agent plans for itself)",
        MADIFF,
        ("madiff",),
        _robots(halfcheetah_2x3=(8246, 2207, 759), ant_2x4=(2946, 1211, 946), ant_4x2=(3080, 1649, 1295)),
    ),
    Published("MA-ICQ", OMAR, ("maicq",), _spread(104.0, 13.6, 29.3, 6.3)),
    Published("MA-TD3+BC", OMAR, ("matd3bc",), _spread(108.3, 15.4, 29.3, 9.8)),
    Published("MA-CQL", OMAR, ("macql",), _spread(98.2, 20.0, 34.1, 24.0)),
    Published("OMAR", OMAR, ("omar",), _spread(114.9, 37.9, 47.9, 34.4)),
    Published("MADiff-D (each agent plans for itself)", MADIFF, ("madiff",), _spread(95.0, 30.3, 64.9, 6.9, "-pooled")),
    Published("MADiff-C (one joint plan)", MADIFF, ("madiff",), _spread(116.7, 42.2, 58.2, 4.3, "-pooled")),
    Published("CoFlow-C (one joint flow)", COFLOW, ("flow",), _spread(119.4, 47.6, 59.9, 53.9, "-pooled")),
)


def matches(entry: Published, algorithm: str) -> bool:
    """Whether an algorithm of ours is meant, however its name is hyphenated."""
    return "".join(c for c in algorithm.lower() if c.isalnum()) in entry.algorithms
