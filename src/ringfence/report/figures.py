"""Figures as inline SVG. Ink, grid and series are drawn in placeholder colours that become CSS variables, so that the
same drawing serves light and dark pages."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup, escape
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import LogFormatter, MaxNLocator

from ringfence.errors import UserError
from ringfence.report.table import COLOURS, Line, Section, Style
from ringfence.training.runs import Run

MARKERS = "osD^vPX*"
FAR = 8.0  # times the limit: axes of cost that reach further are not linear
INK, GRID = "#010203", "#010204"
AGENT = 0
OTHER = 1  # who is moved around the agent
SPEED = 1.0  # m/s at which it approaches
GRID_SIDE = np.linspace(-1.0, 1.0, 81)  # m


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
            ink = INK if line.reference else colour(line.style)
            x = line.cost_safe_start
            y = line.returns
            ax.plot(line.cost_safe_start_interval, (y, y), color=ink, linewidth=1.4, alpha=0.55)
            ax.plot((x, x), line.returns_interval, color=ink, linewidth=1.4, alpha=0.55)
            look = {
                "color": ink,
                "mfc": "none" if line.reference else ink,
                "markersize": 7,
                "zorder": 3,
                "linestyle": "none",
            }
            ax.plot(x, y, marker=marker(line.style), label=line.label, **look)
        ax.margins(0.08, 0.1)
        several = any(line.limits for line in points)  # one line is no limit of theirs
        # The limit as a line, and costs by their square roots where they reach far beyond it.
        limit = section.constants["cost_limit"] if section.constants and not several else 0.0
        low, high = ax.get_xlim()
        if limit > 0:  # beside the points, where it is in view
            ax.axvline(limit, color=INK, linewidth=1.0, linestyle=(0, (3, 3)), zorder=1)
        if limit > 0 and high > FAR * limit:  # or all that keeps the limit would lie at the edge
            ax.set_xscale(
                "function", functions=(lambda x: np.sign(x) * np.sqrt(np.abs(x)), lambda x: np.sign(x) * x**2)
            )
            ax.set_xticks([limit * k for k in (0, 1, 4, 10, 20, 40, 100) if limit * k < high])
            ax.set_xlim(-0.002 * high, 1.1 * high)
        else:
            ax.set_xlim(min(low, -0.02 * high), high + 0.05 * (high - low))
        ax.set_xlabel(f"{x_label}, safe starts")
        ax.set_ylabel("return per episode")
        made.legend(loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
        each = [f"{r.label}: return {r.returns:.1f}, cost of safe starts {r.cost_safe_start:.3f}" for r in points]
        return to_svg(made, f"Return against the cost of safe starts on {section.task}. {'; '.join(each)}", name)


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


@dataclass(frozen=True)
class Around:
    """States in which one agent is moved over a grid around another."""

    base: np.ndarray  # (N, D) features of the state that the others stay in
    position: np.ndarray  # (N, 2)
    velocity: np.ndarray  # (N, 2)
    names: Sequence[str]  # of features

    @property
    def relative(self) -> bool:
        """Whether features say where others are, seen from the agent; else they say where everybody is."""
        return "other0.dx" in self.names

    @property
    def tells(self) -> bool:
        """Whether features say where the other agent is."""
        return self.relative or f"agent{OTHER}.x" in self.names

    @property
    def has_velocity(self) -> bool:
        return ("other0.dvx" if self.relative else f"agent{OTHER}.vx") in self.names

    @property
    def rest(self) -> np.ndarray:
        """(N − 2, 2) where the remaining agents are, seen from the agent."""
        others = [j for j in range(len(self.position)) if j not in (AGENT, OTHER)]
        return (self.position[others] - self.position[AGENT]).reshape(-1, 2)

    def states(self, approach: float) -> np.ndarray:
        """(81², N, D) features, the other agent approaching at this speed."""
        dx, dy = np.meshgrid(GRID_SIDE, GRID_SIDE)
        distance = np.maximum(np.hypot(dx, dy), 1e-6)
        x = np.broadcast_to(self.base, (dx.size, *self.base.shape)).copy()
        for c, (axis, away) in enumerate(zip("xy", (dx, dy))):
            speed = approach * (-away / distance).ravel()
            if self.relative:
                x[:, AGENT, self.names.index(f"other0.d{axis}")] = away.ravel()
                if self.has_velocity:
                    x[:, AGENT, self.names.index(f"other0.dv{axis}")] = speed
                continue
            x[:, :, self.names.index(f"agent{OTHER}.{axis}")] = (self.position[AGENT, c] + away.ravel())[:, None]
            if self.has_velocity:
                x[:, :, self.names.index(f"agent{OTHER}.v{axis}")] = (self.velocity[AGENT, c] + speed)[:, None]
        return x


def field(run: Run, state: np.ndarray | None, name: str) -> Drawn | None:
    """h of one agent around it, one other agent moved over a grid; None where there is no barrier or the features do
    not say where others are. `state` (S,) is a real state; None takes a reset."""
    found = _barrier_around(run, state)
    if found is None:
        return None
    around, barrier, radius = found
    cases = {"at rest relative to the agent": 0.0}
    if around.has_velocity:
        cases[f"approaching at {SPEED:g} m/s"] = SPEED
    shape = (len(GRID_SIDE), len(GRID_SIDE))
    fields = {case: barrier(around.states(speed))[:, AGENT].reshape(shape) for case, speed in cases.items()}
    dx, dy = np.meshgrid(GRID_SIDE, GRID_SIDE)
    contact = np.maximum(np.hypot(dx, dy), 1e-6) < radius
    told = []
    for case, h in fields.items():
        inside, outside = (100 * float((h[part] < 0).mean()) for part in (contact, ~contact))
        told.append(f"{case}, h < 0 on {inside:.0f} % of the area in contact and on {outside:.0f} % of the rest")
    about = "; ".join(told)
    label = f"Learned barrier of agent {AGENT} around it. With the other agent {about}."
    rest = around.rest
    rings = ("", "Rings: the remaining agent, where in view. ", "Rings: the remaining agents, where in view. ")
    said = (
        f"h of one agent (+) as one other agent is moved around it in a {'reset' if state is None else 'recorded'} "
        f"state. Solid: where h = 0. Dashed: true contact, at {radius:.2f} m. {rings[min(len(rest), 2)]}With the other "
        f"agent {about}."
    )
    return Drawn(label, _draw_fields(fields, radius, rest, label, name), said)


Barrier = Callable[[np.ndarray], np.ndarray]  # of features (B, N, D), for each agent (B, N)


def _barrier_around(run: Run, state: np.ndarray | None) -> tuple[Around, Barrier, float] | None:
    """What a run knows danger by, where from, and the radius of contact."""
    import jax
    import jax.numpy as jnp

    from ringfence.loading.resolve import load
    from ringfence.nets.layers import barrier_on
    from ringfence.training import worlds

    if not run.checkpoints():
        raise UserError(f"'{run.path}' holds no checkpoint.")
    job, loaded = load(run)
    policy: Any = loaded  # whatever planner it is
    networks = getattr(policy, "networks", {})
    learned = worlds.of_run(run).barrier if "barrier" not in networks and job.reads_world else None
    radius = getattr(job.hazard.hazard, "radius", None)
    n = job.spec.n_agents
    if ("barrier" not in networks and learned is None) or radius is None or job.task.env is None or n < 2:
        return None
    env: Any = job.task.env
    reset = env.reset(jax.random.key(1), 1) if state is None else env.from_global_state(jnp.asarray(state)[None])
    base = np.array(policy.feature_map(env.observe(reset), env.global_state(reset)))[0]
    flat = np.asarray(env.global_state(reset))[0]
    position = flat[: 2 * n].reshape(n, 2)
    velocity = flat[2 * n : 4 * n].reshape(n, 2)
    around = Around(base, position, velocity, job.spec.feature_names)

    def barrier(features: np.ndarray) -> np.ndarray:
        x = jnp.asarray(features)
        h = barrier_on(networks["barrier"], policy.normaliser, x) if learned is None else learned.of_steps(x, x)
        return np.asarray(h)

    return (around, barrier, radius) if around.tells else None


def _draw_fields(fields: dict[str, np.ndarray], radius: float, rest: np.ndarray, label: str, name: str) -> Markup:
    most = max(np.abs(h).max() for h in fields.values()) or 1.0
    near = rest[np.abs(rest).max(1) < 1] if len(rest) else rest
    scale = TwoSlopeNorm(0.0, -most, most)
    with style(axes_grid=False):
        made = figure(4.1 * len(fields) + 0.7, 4.0)
        axes = made.subplots(1, len(fields), squeeze=False, sharey=True)[0]
        for ax, (case, h) in zip(axes, fields.items()):
            extent = (-1.0125, 1.0125, -1.0125, 1.0125)
            ax.imshow(h, origin="lower", extent=extent, cmap="RdBu", norm=scale, interpolation="bilinear")
            if h.min() < 0 < h.max():
                ax.contour(GRID_SIDE, GRID_SIDE, h, [0.0], colors="black", linewidths=1.8)
            ax.add_patch(Circle((0, 0), radius, fill=False, linestyle="--", edgecolor="black", linewidth=1.2))
            ax.plot(0, 0, "+", color="black")
            if len(near):
                ax.plot(near[:, 0], near[:, 1], "o", mfc="none", color="black", markersize=9)
            ax.set(title=f"other agent {case}", xlabel="other agent's x − own x (m)", xlim=(-1, 1), ylim=(-1, 1))
        axes[0].set_ylabel("other agent's y − own y (m)")
        bar = made.colorbar(axes[-1].images[0], ax=list(axes), shrink=0.85)
        bar.set_label("h  (negative: judged unsafe)")
        return to_svg(made, label, name)
