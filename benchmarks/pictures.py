"""Pictures of docs/images/, from results/ alone but for `crossing-barrier`, which fits a World if need be.

python benchmarks/pictures.py [NAME ...]    # of PICTURES below; all by default
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import matplotlib
import numpy as np
from certificates import SETTINGS, by_setting
from common import ROOT
from evidence import mean, tasks_of, variant
from stress import in_words, name_of

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.lines import Line2D  # noqa: E402
from matplotlib.patches import FancyBboxPatch  # noqa: E402

from ringfence.datasets import registry  # noqa: E402

IMAGES = ROOT / "docs" / "images"


def main() -> None:
    for name in sys.argv[1:] or PICTURES:
        save(name, *PICTURES[name]())


def save(name: str, figure: Figure, how: dict) -> None:
    IMAGES.mkdir(exist_ok=True)
    figure.savefig(IMAGES / name, **how)
    plt.close(figure)
    print(IMAGES / name)


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


def return_violations() -> tuple[Figure, dict]:
    """Return against violations for every method, alone and under its guards."""
    figure, axes = plt.subplots(2, 3, figsize=(12, 7), layout="constrained")
    panels = list(axes.ravel())
    for axis, task in zip(panels, tasks_of("guards")):
        drawn(axis, "guards", task, "return_norm", 1)
        axis.set_ylabel("normalised return")
    drawn(panels[4], "crossing-guards", "crossing-hasty", "return_mean", 2)
    panels[4].set_ylabel("return, m")
    legend(panels[5])
    return figure, {"dpi": 110}


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


SPEEDS = (0.0, 0.5, 1.0)
REACH, FINE = 1.2, 121


def crossing_barrier() -> tuple[Figure, dict]:
    """What a barrier is: danger now and danger to come around an agent of Crossing, at rest and at full speed."""
    import jax.numpy as jnp

    from ringfence.datasets.make import make
    from ringfence.envs.crossing import PUSH, RADIUS, SIGHT
    from ringfence.training import worlds

    world = worlds.fit(make(registry.get("crossing-hasty"))[0], quiet=False)
    names, line = list(world.map.names), np.linspace(-REACH, REACH, FINE)
    x, y = np.meshgrid(line, line)
    figure, rows = plt.subplots(2, len(SPEEDS), figsize=(9, 6.2), sharex=True, sharey=True, layout="constrained")
    words = ("ℓ: touching now", "V: will touch, whatever one does")
    for axes, score, what in zip(rows, (lambda s: world.barrier.of_steps(s, s), world.barrier.ahead), words):
        for axis, speed in zip(axes, SPEEDS):
            seen = np.zeros((x.size, 1, len(names)), np.float32)
            for name, value in {
                **{f"other{j}.dx": SIGHT for j in range(6)},
                "other0.dx": x.ravel(),
                "other0.dy": y.ravel(),
                "other0.dvx": -speed,
                "other0.seen": 1.0,
                "own.vx": speed,
                "goal.dx": 2.0,
            }.items():
                seen[:, 0, names.index(name)] = value
            h = np.asarray(score(jnp.asarray(seen))).reshape(x.shape)
            picture = axis.pcolormesh(x, y, h, cmap="RdBu", vmin=-15, vmax=15, rasterized=True)
            axis.contour(x, y, h, [0.0], colors="black", linewidths=1.5)
            axis.add_patch(plt.Circle((0, 0), 2 * RADIUS, fill=False, ls="--", ec="white"))
            axis.plot(2 * RADIUS + speed**2 / (2 * PUSH), 0, "k|", ms=14, mew=2)
            axis.set(title=f"{what}\nat {speed:g} m/s to the right" if speed == SPEEDS[0] else f"at {speed:g} m/s")
            axis.set_aspect("equal")
            ahead = line[(h[FINE // 2] < 0)]
            print(f"{what}, {speed:g} m/s: unsafe up to {ahead.max() if len(ahead) else 0:.2f} m ahead")
    figure.colorbar(picture, ax=rows, label="log-odds of safe", shrink=0.7)
    figure.supxlabel("the other, at rest, m ahead")
    return figure, {"dpi": 80}


INK, LINE = "#1b2733", "#7d8894"  # of words in boxes; of what lies on the page itself, light or dark
Box = tuple[float, float, float, float]  # left, bottom, width, height
LOGS: Box = (0.0, 0.9, 1.5, 1.2)
WORLD: Box = (2.2, 1.75, 2.6, 1.05)
POLICY: Box = (2.2, 0.2, 2.6, 1.05)
GUARD: Box = (6.1, 0.9, 1.6, 1.2)


def pipeline() -> tuple[Figure, dict]:
    """The pipeline of README.md, to be read on a light and on a dark page."""
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
    return figure, {"transparent": True, "metadata": {"Date": None}}


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


def certificate() -> tuple[Figure, dict]:
    """What certificates allow beside what all episodes of their setting did."""
    found = by_setting()
    figure, axis = plt.subplots(figsize=(7.2, 0.55 * len(found) + 1.6), layout="constrained")
    for y, rows in enumerate(found.values()):
        bounds = 100 * np.array([float(row["bound"]) for row in rows])
        rate = 100 * float(rows[0]["pool_rate"])
        spread = y + 0.22 * np.linspace(-1, 1, len(bounds))
        axis.barh(y, rate, height=0.62, color="#f2b8a0", label="violated, of all episodes" if y == 0 else None)
        axis.scatter(bounds, spread, s=18, color="#1f5fa8", zorder=3, label="allowed, a certificate each" * (y == 0))
    axis.set_yticks(range(len(found)), [in_words(name_of(SETTINGS[setting])) for setting in found])
    axis.invert_yaxis()
    axis.set_xlim(left=0)
    axis.set_xlabel("episodes with a violation, %")
    figure.legend(loc="outside upper right", ncols=2, frameon=False)
    axis.spines[["top", "right"]].set_visible(False)
    return figure, {"dpi": 110}


PICTURES: dict[str, Callable[[], tuple[Figure, dict]]] = {
    "return-violations.png": return_violations,
    "certificate.png": certificate,
    "pipeline.svg": pipeline,
    "crossing-barrier.png": crossing_barrier,
}

if __name__ == "__main__":
    main()
