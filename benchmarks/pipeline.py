"""Draws the pipeline of README.md and docs/README.md, to be read on a light and on a dark page.

python benchmarks/pipeline.py    # docs/images/pipeline.svg
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.patches import FancyBboxPatch  # noqa: E402

OUT = Path(__file__).resolve().parent.parent / "docs" / "images" / "pipeline.svg"
INK, LINE = "#1b2733", "#7d8894"  # of words in boxes; of what lies on the page itself, light or dark
Box = tuple[float, float, float, float]  # left, bottom, width, height
LOGS: Box = (0.0, 0.9, 1.5, 1.2)
WORLD: Box = (2.2, 1.75, 2.6, 1.05)
POLICY: Box = (2.2, 0.2, 2.6, 1.05)
GUARD: Box = (6.1, 0.9, 1.6, 1.2)


def main() -> None:
    plt.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "pipeline", "font.family": "sans-serif"}
    figure, axes = plt.subplots(figsize=(7.0, 2.5))
    axes.set(xlim=(-0.1, 8.9), ylim=(-0.1, 3.15), aspect="equal")
    axes.axis("off")
    box(axes, LOGS, "logs", "agents, costs", "#dfe5ea")
    box(axes, WORLD, "World", "dynamics, values, danger", "#cfe3f5")
    box(axes, POLICY, "policy", "cloned, learned, or yours", "#e4dcf3")
    box(axes, GUARD, "guard", "corrects it", "#cdebd6")
    arrow(axes, (1.5, 1.75), (2.2, 2.2), "")
    arrow(axes, (1.5, 1.25), (2.2, 0.8), "")
    arrow(axes, (4.8, 2.2), (6.1, 1.75), "predicts")
    arrow(axes, (4.8, 0.8), (6.1, 1.25), "proposes", below=True)
    arrow(axes, (7.7, 1.5), (8.8, 1.5), "action")
    figure.subplots_adjust(0, 0, 1, 1)
    figure.savefig(OUT, transparent=True, metadata={"Date": None})
    print(OUT)


def box(axes: Axes, at: Box, name: str, words: str, colour: str) -> None:
    left, bottom, width, height = at
    style = "round,pad=0,rounding_size=0.15"
    shape = FancyBboxPatch((left, bottom), width, height, boxstyle=style)
    shape.set(facecolor=colour, edgecolor=LINE)
    axes.add_patch(shape)
    middle = left + width / 2
    axes.text(middle, bottom + 0.64 * height, name, ha="center", va="center", color=INK, fontsize=13, weight="bold")
    axes.text(middle, bottom + 0.3 * height, words, ha="center", va="center", color=INK, fontsize=9.5)


def arrow(axes: Axes, begin: tuple[float, float], end: tuple[float, float], word: str, below: bool = False) -> None:
    style = {"arrowstyle": "-|>", "color": LINE, "lw": 1.6, "mutation_scale": 14, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, begin, arrowprops=style)
    x, y = (begin[0] + end[0]) / 2, (begin[1] + end[1]) / 2
    axes.text(x + 0.05, y + (-0.35 if below else 0.32), word, ha="center", va="center", color=LINE, fontsize=10)


if __name__ == "__main__":
    main()
