"""Draws return against violations for every method, alone and under its guards, from results/ alone.

python benchmarks/return_violations.py    # docs/images/return-violations.png
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
from evidence import mean, tasks_of, variant

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.lines import Line2D  # noqa: E402

PICTURE = Path(__file__).resolve().parent.parent / "docs" / "images" / "return-violations.png"
# Methods: their words, algorithm, preset on Simple Spread and on Crossing, mark and a colour that the colour-blind see.
METHODS = {
    "BC": ("bc", "default", "default", "o", "#0072B2"),
    "10 % BC": ("bc-best", "default", "default", "^", "#0072B2"),
    "BC, safe episodes": ("bc-safe", "default", "default", "v", "#0072B2"),
    "return-conditioned BC": ("bc-return", "default", "default", "s", "#56B4E9"),
    "MA-TD3+BC": ("ma-td3bc", "default", "default", "o", "#D55E00"),
    "MA-TD3+BC, Lagrange": ("ma-td3bc-lag", "default", "default", "^", "#D55E00"),
    "OMAR": ("omar", "default", "default", "s", "#E69F00"),
}
GUARDS = {"": "alone", "+shield-learned": "under a shield", "+full-learned": "under full"}
LEAST = 0.01  # steps: the scale is linear below


def main() -> None:
    figure, axes = plt.subplots(2, 3, figsize=(12, 7), layout="constrained")
    panels = list(axes.ravel())
    for axis, task in zip(panels, tasks_of("guards")):
        drawn(axis, "guards", task, "return_norm", 1)
        axis.set_ylabel("normalised return")
    drawn(panels[4], "crossing-guards", "crossing-hasty", "return_mean", 2)
    panels[4].set_ylabel("return, m")
    legend(panels[5])
    figure.savefig(PICTURE, dpi=110)
    print(PICTURE)


def drawn(axis: Axes, suite: str, task: str, earned: str, preset: int) -> None:
    """A panel: alone a hollow mark, guarded a full one, and a line from one to the other."""
    for algorithm, *presets, mark, colour in METHODS.values():
        points = {}
        for ending in GUARDS:
            row = variant(task, (algorithm, presets[preset - 1] + ending))
            point = mean(suite, task, row, "cost_safe_start"), mean(suite, task, row, earned)
            if None not in point:
                points[ending] = point
        axis.plot(*zip(*list(points.values())[:2]), color=colour, lw=0.8, alpha=0.6, zorder=1)
        for ending, (x, y) in points.items():
            star = ending.startswith("+full")
            face = "white" if not ending else colour
            axis.plot(x, y, "*" if star else mark, color=colour, mfc=face, ms=13 if star else 7, clip_on=False)
    axis.set_xscale("symlog", linthresh=LEAST)
    axis.set(title=task, xlim=(0, 60), xlabel="steps with a violation per episode that starts safe")
    axis.grid(alpha=0.25)


def legend(axis: Axes) -> None:
    axis.axis("off")
    kinds = [
        Line2D([], [], color="0.3", marker="o", mfc="white", ls="", label="alone"),
        Line2D([], [], color="0.3", marker="o", ls="", label="under a shield, danger learned"),
        Line2D([], [], color="0.3", marker="*", ms=13, ls="", label="under full: it also climbs values"),
    ]
    names = [Line2D([], [], color=c, marker=m, ls="", label=words) for words, (*_, m, c) in METHODS.items()]
    axis.add_artist(axis.legend(handles=kinds, loc="upper left", frameon=False))
    axis.legend(handles=names, loc="lower left", frameon=False)


if __name__ == "__main__":
    main()
