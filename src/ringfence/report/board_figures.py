"""Figures of the leaderboard: intervals over all tasks, probabilities of improvement, profiles, time and size.

Every method has a name or a marker and a line style beside its colour, so that no figure needs colours to be read.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

from ringfence.evaluation.statistics import Interval
from ringfence.report.figures import FAR, INK, Ticks, colour, figure, figure_with_legend, marker, style, to_svg
from ringfence.report.standings import Aggregate
from ringfence.report.table import Line, Method, Style

DASHES = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)), (0, (3, 1, 1, 1, 1, 1)))
WIDTH = 9.2  # inches of a wide figure
LIMIT = (0, (3, 3))  # line style
LABEL = 0.075  # inches that a letter of a method's name takes


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
                    _duel(ax, row, column, float(matrix[row, column]))
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


def _duel(ax: Axes, row: int, column: int, p: float) -> None:
    fill, ink = _shade(p)
    ax.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=fill, edgecolor="none"))
    ax.text(column, row, f"{p:.2f}", ha="center", va="center", color=ink, fontsize=9)


def _shade(p: float) -> tuple[str, str]:
    """(fill, ink) of a probability: orange below one half, blue above, the further the stronger."""
    far = min(1.0, abs(2 * p - 1))
    end = np.array([33, 102, 172] if p >= 0.5 else [191, 91, 23])
    rgb = np.round(247 + (end - 247) * far).astype(int)
    light = float(rgb @ [0.299, 0.587, 0.114]) > 140
    return "#{:02x}{:02x}{:02x}".format(*rgb), "#101010" if light else "#fafafa"


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
            _expense(ax, rows, values, form)
            ax.set_xlabel(title)
        axes[0].set_yticks(range(len(rows)), [r.label for r in rows])
        return to_svg(made, "Training time, parameters and time to act of each method", name)


def _expense(ax: Axes, rows: list[Line], values: Sequence[float | None], form: str) -> None:
    """A bar and a number per row, the first on top."""
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
