"""Figures of the leaderboard: intervals over all tasks, probabilities of improvement, profiles, time and size.

Every method has a name or a marker and a line style beside its colour, so that no figure needs colours to be read.
"""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

from ringfence.report.board import Method
from ringfence.report.figures import FAR, INK, MARKERS, STYLE, Ticks, figure, to_svg
from ringfence.report.standings import Aggregate, Standing

DASHES = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)), (0, (3, 1, 1, 1, 1, 1)))
WIDTH = 9.2  # inches of a wide figure
LABEL = 0.075  # inches that a letter of a method's name takes

Style = tuple[int, int]


def _ink(style: Style) -> str:
    return f"#0102{16 + style[0]:02x}"


def _marker(style: Style) -> str:
    return MARKERS[style[1] % len(MARKERS)]


def _whiskers(ax, rows: list[tuple[float, tuple[float, float] | None]], styles: list[Style], digits: int) -> None:
    """A point with its interval, if it has one, per row, the first on top, and the number at the right edge, clear of
    the points."""
    for y, ((value, interval), style) in enumerate(zip(rows, styles)):
        if interval:
            ax.plot(interval, (y, y), color=_ink(style), linewidth=2.2, alpha=0.55, solid_capstyle="butt")
        ax.plot(value, y, _marker(style), color=_ink(style), markersize=7)
        where = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "center"}
        ax.annotate(f"{value:.{digits}f}", (0.99, y), **where, fontsize=8.5, color=INK)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.grid(axis="y", visible=False)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    left, right = ax.get_xlim()
    ax.set_xlim(left, right + 0.16 * (right - left))


def overall(told: Aggregate, styles: dict[Method, Style], name: str) -> str:
    """IQM of normalised return and of normalised cost over all tasks, the best return on top."""
    methods = sorted(told.methods, key=lambda m: -told.iqm_returns[m][0])
    with matplotlib.rc_context(STYLE):
        made = figure(WIDTH, 1.2 + 0.32 * len(methods))
        axes = made.subplots(1, 2, sharey=True)
        inks = [styles[m] for m in methods]
        axes[1].axvline(1.0, color=INK, linewidth=1.0, linestyle=(0, (3, 3)))  # first, so that it is in view
        _whiskers(axes[0], [told.iqm_returns[m] for m in methods], inks, 2)
        _whiskers(axes[1], [told.iqm_costs[m] for m in methods], inks, 2)
        axes[0].set_yticks(range(len(methods)), [m.label for m in methods])
        axes[0].set_xlabel("normalised return, IQM (more is better)")
        axes[1].set_xlabel("normalised cost, IQM (less is better)")
        axes[1].annotate(
            "limit", (1.0, 1.0), (3, 2), xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=8.5
        )
        said = "; ".join(
            f"{m.label}: return {told.iqm_returns[m][0]:.2f}, cost {told.iqm_costs[m][0]:.2f}" for m in methods
        )
        return to_svg(made, f"Interquartile means over all tasks. {said}", name)


def duels(matrix: np.ndarray, methods: list[Method], what: str, name: str) -> str:
    """Heat map of the probability that the row beats the column, with every probability printed."""
    n = len(methods)
    longest = max(len(m.label) for m in methods)
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        made = figure(1.4 + LABEL * longest + 0.5 * n, 1.2 + 0.36 * n)
        ax = made.add_subplot()
        for i in range(n):
            for j in range(n):
                if i == j:
                    continue
                p = float(matrix[i, j])
                fill, ink = _shade(p)
                ax.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, facecolor=fill, edgecolor="none"))
                ax.text(j, i, f"{p:.2f}", ha="center", va="center", color=ink, fontsize=9)
        ax.set(xlim=(-0.5, n - 0.5), ylim=(n - 0.5, -0.5))
        ax.set_yticks(range(n), [f"{k + 1}. {m.label}" for k, m in enumerate(methods)])
        ax.set_xticks(range(n), [str(k + 1) for k in range(n)])
        ax.xaxis.tick_top()
        ax.tick_params(length=0)
        for side in ax.spines.values():
            side.set_visible(False)
        ax.set_xlabel("compared with the method of this number")
        label = f"Probability that the row's method {what} than the column's; rows are " + ", ".join(
            f"{k + 1} {m.label}" for k, m in enumerate(methods)
        )
        return to_svg(made, label, name)


def _shade(p: float) -> tuple[str, str]:
    """(fill, ink) of a probability: orange below one half, blue above, the further the stronger."""
    far = min(1.0, abs(2 * p - 1))
    end = np.array([33, 102, 172] if p >= 0.5 else [191, 91, 23])
    rgb = np.round(247 + (end - 247) * far).astype(int)
    light = float(rgb @ [0.299, 0.587, 0.114]) > 140
    return "#{:02x}{:02x}{:02x}".format(*rgb), "#101010" if light else "#fafafa"


def profiles(told: Aggregate, styles: dict[Method, Style], name: str) -> str:
    """Share of runs above a return and share of episodes within a cost, against the threshold."""
    methods = told.methods
    columns = 2 if max(len(m.label) for m in methods) > 24 else 3
    rows = -(-len(methods) // columns)
    with matplotlib.rc_context(STYLE):
        made = figure(WIDTH, 4.2 + 0.24 * rows)
        axes = made.subplots(1, 2)
        panels = (
            (
                told.return_thresholds,
                told.return_profiles,
                told.return_bands,
                "normalised return τ",
                "share of runs with return > τ",
            ),
            (
                told.cost_thresholds,
                told.cost_profiles,
                told.cost_bands,
                "normalised cost τ (1: the limit)",
                "episodes with cost ≤ τ",
            ),
        )
        for ax, (thresholds, shares, bands, x, y) in zip(axes, panels):
            for k, (m, share, band) in enumerate(zip(methods, shares, bands)):
                style = styles[m]
                if band is not None:
                    ax.fill_between(thresholds, *band, color=_ink(style), alpha=0.12, linewidth=0, step="post")
                ax.plot(
                    thresholds,
                    share,
                    color=_ink(style),
                    linestyle=DASHES[k % len(DASHES)],
                    linewidth=1.6,
                    marker=_marker(style),
                    markersize=5,
                    markevery=(0.02 * (k % 8), 0.16),  # apart, so that markers of lines that coincide can be seen
                    drawstyle="steps-post",
                    label=m.label,
                )
            ax.set(xlabel=x, ylabel=y, ylim=(-0.03, 1.03))
        axes[1].axvline(1.0, color=INK, linewidth=1.0, linestyle=(0, (3, 3)))
        if told.cost_thresholds[-1] > FAR:
            axes[1].set_xscale("symlog", linthresh=1.0)
            axes[1].xaxis.set_major_formatter(Ticks())
            axes[1].set_xlim(-0.05, told.cost_thresholds[-1])
        handles, labels = axes[0].get_legend_handles_labels()
        made.legend(
            handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9, handlelength=3.2
        )
        label = "Profiles. Left: share of runs above a normalised return. Right: share of episodes within a cost."
        return to_svg(made, label, name)


def _brief(x: float) -> str:
    """30, 3 k, 1 M: a tick that leaves room for its neighbours."""
    for size, letter in ((1e6, " M"), (1e3, " k")):
        if x >= size:
            return f"{x / size:g}{letter}"
    return f"{x:g}"


def expenses(rows: list[Standing], name: str) -> str:
    """Training seconds, parameters and time to act of each method, on logarithmic scales; None is said in words."""
    panels = (
        ("training, s of one seed", [r.train_seconds for r in rows], "{:,.0f}"),
        ("parameters", [r.parameters for r in rows], "{:,.0f}"),
        ("one joint action, ms", [r.plan_ms for r in rows], "{:.2g}"),
    )
    with matplotlib.rc_context(STYLE):
        made = figure(WIDTH, 1.2 + 0.32 * len(rows))
        axes = made.subplots(1, len(panels), sharey=True)
        for ax, (title, values, form) in zip(axes, panels):
            there = [v for v in values if v]
            low, high = (min(there), max(there)) if there else (1.0, 10.0)
            ax.set_xscale("log")
            ax.set_xlim(low / 1.6, high * max(4.0, (high / low) ** 0.55))
            for y, (row, value) in enumerate(zip(rows, values)):
                if value:
                    ax.plot((low / 1.6, value), (y, y), color=_ink(row.style), linewidth=1.2, alpha=0.5)
                    ax.plot(value, y, _marker(row.style), color=_ink(row.style), markersize=6)
                ax.annotate(
                    form.format(value) if value else "not measured",
                    (value or low / 1.6, y),
                    (7, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=8.5,
                    color=INK,
                )
            ax.set_ylim(len(rows) - 0.5, -0.5)
            ax.grid(axis="y", visible=False)
            ax.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 100 * low else (1.0, 3.0)))
            ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: _brief(x)))
            ax.minorticks_off()
            ax.set_xlabel(title)
        axes[0].set_yticks(range(len(rows)), [r.label for r in rows])
        return to_svg(made, "Training time, parameters and time to act of each method", name)
