"""Figures as inline SVG. Ink, grid and series are drawn in placeholder colours that become CSS variables, so that the
same drawing serves light and dark pages."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, MaxNLocator

from ringfence.report.table import COLOURS, Line, Section, Style

MARKERS = "osD^vPX*"
FAR = 8.0  # times the limit: axes of cost that reach further are not linear
INK, GRID = "#010203", "#010204"


class Ticks(LogFormatter):
    """Numbers as they are read, on a logarithmic axis: no mathematics. Which are shown is matplotlib's choice."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


STYLE = {
    "text.parse_math": False,  # a name with $ is a name
    "svg.fonttype": "none",
    "svg.hashsalt": "ringfence",
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": INK,
    "ytick.color": INK,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}

# (title, y axis, logarithmic, [(metric, line style, what it is on)])
PANELS = (
    ("Denoising loss", "loss", True, [("loss/denoising", "-", "")]),
    ("BC loss", "loss", True, [("loss/cloning", "-", "")]),
    ("Barrier loss (h learns)", "loss", False, [("loss/barrier", "-", "")]),
    ("Shaping loss (the planner learns)", "loss", False, [("loss/shaping", "-", "")]),
    (
        "h is right on safe states",
        "share with h ≥ 0",
        False,
        [("barrier/data_accuracy_safe", "-", "data"), ("barrier/made_accuracy_safe", "--", "generated")],
    ),
    (
        "h is right on unsafe states",
        "share with h < 0",
        False,
        [("barrier/data_accuracy_unsafe", "-", "data"), ("barrier/made_accuracy_unsafe", "--", "generated")],
    ),
    (
        "h is retained along transitions",
        "share",
        False,
        [("barrier/data_accuracy_retention", "-", "data"), ("barrier/made_accuracy_retention", "--", "generated")],
    ),
    (
        "Steps that violate the true hazard",
        "share",
        False,
        [("barrier/data_share_unsafe", "-", "data"), ("barrier/made_share_unsafe", "--", "generated")],
    ),
    ("Pull of the barrier on the planner", "gradient ratio", False, [("gradient/ratio", "-", "")]),
    ("Weight of the barrier", "λ", False, [("barrier/weight", "-", "")]),
)


@dataclass(frozen=True)
class Drawn:
    """A figure with a title, and what is said below it."""

    title: str
    svg: Markup
    said: str = ""


def colour(of: Style) -> str:
    """The placeholder of a series colour."""
    return f"#0102{16 + of[0] % COLOURS:02x}"


def marker(of: Style) -> str:
    return MARKERS[of[1] % len(MARKERS)]


@contextmanager
def style(**changes: Any) -> Iterator[None]:
    """Figures of this package's look inside; `changes` have _ for the dots of matplotlib's names."""
    more = {name.replace("_", "."): value for name, value in changes.items()}
    parameters: Any = STYLE | more  # matplotlib names its keys by a type of its own
    with matplotlib.rc_context(parameters):
        yield


def figure(width: float, height: float) -> Figure:
    made = Figure((width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made


def figure_with_legend(width: float, height: float, labels: Sequence[str]) -> tuple[Figure, int]:
    """(a figure that has room below for a legend of these labels, the legend's columns)."""
    columns = 2 if max(len(label) for label in labels) > 24 else 3
    return figure(width, height + 0.24 * -(-len(labels) // columns)), columns


def to_svg(made: Figure, label: str, name: str) -> Markup:
    """The figure as an accessible inline element without any address in it; `name` keeps ids apart on the page."""
    file = io.BytesIO()
    made.savefig(file, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = file.getvalue().decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    text = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'href="#', f'href="#{name}-', text)
    text = text.replace("url(#", f"url(#{name}-")
    text = re.sub(r"font: ([\d.]+px)[^;\"]*", r"font-size: \1", text)
    text = re.sub(r"font-family: [^;\"]*;?", "", text)
    text = text.replace(INK, "var(--ink)").replace(GRID, "var(--rule)")
    text = re.sub(r"#0102(1[0-9a-f])", lambda m: f"var(--c{int(m[1], 16) - 16})", text)
    head = f'<svg role="img" aria-label="{escape(label)}"'
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    return Markup(re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1).replace("<svg", head, 1))


def scatter(section: Section, lines: Sequence[Line], x_label: str, name: str) -> Markup:
    """Return against the cost of safe starts with 95 % intervals, in the colours and markers of the table."""
    points = [*lines, *section.references]
    with style():
        made, columns = figure_with_legend(8.2, 4.4, [line.label for line in points])
        ax = made.add_subplot()
        for line in points:
            _point(ax, line)
        ax.margins(0.08, 0.1)
        several = any(line.limits for line in points)  # one line is no limit of theirs
        _cost_axis(ax, section.constants["cost_limit"] if section.constants and not several else 0.0)
        ax.set_xlabel(f"{x_label}, safe starts")
        ax.set_ylabel("return per episode")
        made.legend(loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
        each = [f"{r.label}: return {r.returns:.1f}, cost of safe starts {r.cost_safe_start:.3f}" for r in points]
        return to_svg(made, f"Return against the cost of safe starts on {section.task}. {'; '.join(each)}", name)


def _point(ax: Axes, line: Line) -> None:
    ink = INK if line.reference else colour(line.style)
    x = line.cost_safe_start
    y = line.returns
    ax.plot(line.cost_safe_start_interval, (y, y), color=ink, linewidth=1.4, alpha=0.55)
    ax.plot((x, x), line.returns_interval, color=ink, linewidth=1.4, alpha=0.55)
    look = {"color": ink, "mfc": "none" if line.reference else ink, "markersize": 7, "zorder": 3, "linestyle": "none"}
    ax.plot(x, y, marker=marker(line.style), label=line.label, **look)


def _cost_axis(ax: Axes, limit: float) -> None:
    """The limit as a line, and costs by their square roots where they reach far beyond it."""
    low, high = ax.get_xlim()
    if limit > 0:  # beside the points, where it is in view
        ax.axvline(limit, color=INK, linewidth=1.0, linestyle=(0, (3, 3)), zorder=1)
    if limit > 0 and high > FAR * limit:  # or all that keeps the limit would lie at the edge
        ax.set_xscale("function", functions=(_root, _square))
        ax.set_xticks([limit * k for k in (0, 1, 4, 10, 20, 40, 100) if limit * k < high])
        ax.set_xlim(-0.002 * high, 1.1 * high)
    else:
        ax.set_xlim(min(low, -0.02 * high), high + 0.05 * (high - low))


def _root(x: np.ndarray) -> np.ndarray:
    return np.sign(x) * np.sqrt(np.abs(x))


def _square(x: np.ndarray) -> np.ndarray:
    return np.sign(x) * x**2


# --- training ---


Curve = tuple[Line, str, list[tuple[int, float]]]  # whose, line style, (step, value)


def training_curves(lines: Sequence[Line], name: str) -> list[Drawn]:
    """One small panel per quantity that any run logged; seeds are thin lines."""
    runs: dict[Path, tuple[Line, list[dict[str, Any]]]] = {}
    for line in lines:
        for row in line.rows:
            if row.run is not None and row.run.path not in runs:
                runs[row.run.path] = (line, row.run.metrics)
    panels = []
    for k, (title, y_label, logarithmic, metrics) in enumerate(PANELS):
        curves: list[Curve] = [
            (line, line_style, points)
            for line, log in runs.values()
            for key, line_style, _ in metrics
            if (points := [(entry["step"], entry[key]) for entry in log if key in entry])
        ]
        if curves:
            panels.append(Drawn(title, _curves(title, y_label, logarithmic, curves, f"{name}-{k}")))
    return panels


def _curves(title: str, y_label: str, logarithmic: bool, curves: list[Curve], name: str) -> Markup:
    with style(font_size=9):
        made = figure(3.5, 2.3)
        ax = made.add_subplot()
        for line, line_style, points in curves:
            points = points[:: -(-len(points) // 300)]  # at most 300 points a line
            steps, values = zip(*points)
            ax.plot(steps, values, line_style, color=colour(line.style), linewidth=1.1)
        if logarithmic and all(value > 0 for _, _, points in curves for _, value in points):
            ax.set_yscale("log")
            ax.yaxis.set_major_formatter(Ticks())
            ax.yaxis.set_minor_formatter(Ticks())
        if "share" in y_label:
            ax.set_ylim(-0.03, 1.03 if "true hazard" not in title else None)
        ax.xaxis.set_major_locator(MaxNLocator(5))
        ax.set_ylabel(y_label)
        ax.set_xlabel("update")
        return to_svg(made, f"{title} during training, one thin line per seed", name)
