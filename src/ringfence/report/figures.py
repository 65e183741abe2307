"""Figures as inline SVG. Ink, grid and series are drawn in placeholder colours that become CSS variables, so that the
same drawing serves light and dark pages."""

from __future__ import annotations

import io
import re

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import LogFormatter, MaxNLocator

from ringfence.errors import UserError
from ringfence.report.table import Row, Section
from ringfence.training.runs import Run

COLOURS = 10  # series colours in style.css
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
    ("Cloning loss", "loss", True, [("loss/cloning", "-", "")]),
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


def colour(row: Row) -> str:
    return f"#0102{16 + row.style[0] % COLOURS:02x}"


def marker(row: Row) -> str:
    return MARKERS[row.style[1] % len(MARKERS)]


def figure(width: float, height: float) -> Figure:
    made = Figure((width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made


def to_svg(made: Figure, label: str, name: str) -> str:
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
    head = f'<svg role="img" aria-label="{_escape(label)}"'
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    return re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1).replace("<svg", head, 1)


def _escape(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")


def scatter(section: Section, rows: list[Row], x_label: str, name: str) -> str:
    """Return against avoidable cost with 95 % intervals, every point labelled in place."""
    with matplotlib.rc_context(STYLE):
        made = figure(8.2, 4.8)
        ax = made.add_subplot()
        points = [*rows, *section.references]
        for row in points:
            ink = INK if row.reference else colour(row)
            x, y = row.cost_safe_start, row.returns
            ax.plot(row.cost_safe_start_interval, (y, y), color=ink, linewidth=1.4, alpha=0.55)
            ax.plot((x, x), row.returns_interval, color=ink, linewidth=1.4, alpha=0.55)
            face = "none" if row.reference else ink
            ax.plot(x, y, marker="o" if row.reference else marker(row), color=ink, mfc=face, markersize=7, zorder=3)
        ax.margins(0.08, 0.1)
        low, high = ax.get_xlim()
        limit = section.constants["cost_limit"] if section.constants else 0.0
        if limit > 0:  # beside the points, where it is in view
            ax.axvline(limit, color=INK, linewidth=1.0, linestyle=(0, (3, 3)), zorder=1)
        if limit > 0 and high > FAR * limit:  # or all that keeps the limit would lie at the edge
            root = lambda x: np.sign(x) * np.sqrt(np.abs(x))  # noqa: E731
            ax.set_xscale("function", functions=(root, lambda y: np.sign(y) * y**2))
            ax.set_xticks([limit * k for k in (0, 1, 4, 10, 20, 40, 100) if limit * k < high])
            ax.set_xlim(-0.002 * high, 1.1 * high)
        else:
            ax.set_xlim(min(low, -0.02 * high), high + 0.05 * (high - low))
        ax.set_xlabel(f"avoidable {x_label}")
        ax.set_ylabel("return per episode")
        made.canvas.draw()
        _label(ax, points)
        said = "; ".join(f"{r.label}: return {r.returns:.1f}, avoidable cost {r.cost_safe_start:.3f}" for r in points)
        return to_svg(made, f"Return against avoidable cost on {section.task}. {said}", name)


def _label(ax, points: list[Row]) -> None:
    """Put every name beside its point where it hides nothing, else where it hides least."""
    renderer = ax.figure.canvas.get_renderer()
    dots = [ax.transData.transform((r.cost_safe_start, r.returns)) for r in points]
    bars = [
        (ax.transData.transform(a), ax.transData.transform(b))
        for r in points
        for a, b in (
            ((r.cost_safe_start_interval[0], r.returns), (r.cost_safe_start_interval[1], r.returns)),
            ((r.cost_safe_start, r.returns_interval[0]), (r.cost_safe_start, r.returns_interval[1])),
        )
    ]
    frame, taken = ax.get_window_extent(), []
    around = [
        (sign_x * x, sign_y * y, {1: "left", -1: "right", 0: "center"}[sign_x])
        for far in (0, 1, 2, 3, 4, 5)
        for sign_x, x in ((1, 8 + 12 * far), (-1, 8 + 12 * far), (0, 0))
        for sign_y, y in ((1, 8 + 14 * far), (-1, 8 + 14 * far))
    ]
    leaders = []
    for row, dot in zip(points, dots):
        options = []
        for dx, dy, side in around:
            text = ax.annotate(
                row.label,
                (row.cost_safe_start, row.returns),
                (dx, dy),
                textcoords="offset points",
                ha=side,
                va="center",
                fontsize=9,
                color=INK,
            )
            box = text.get_window_extent(renderer).padded(3)
            text.remove()
            penalty = sum(2000 + _overlap(box, other) for other in taken if _overlap(box, other))
            penalty += 400 * sum(box.contains(*d) for d in dots)
            penalty += 120 * sum(_crosses(box, a, b) for a, b in bars)
            lead = np.linspace(dot, ((box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2), 20)
            penalty += 1000 * sum(other.contains(*p) for other in taken for p in lead[::2])
            penalty += 1000 * sum(box.contains(*p) for p in leaders)
            outside = box.x0 < frame.x0 or box.x1 > frame.x1 or box.y0 < frame.y0 or box.y1 > frame.y1
            options.append((penalty + 10_000 * outside + abs(dx) + abs(dy), dx, dy, side, box, lead))
        _, dx, dy, side, box, lead = min(options, key=lambda o: o[0])
        far = abs(dx) + abs(dy) > 30
        ax.annotate(
            row.label,
            (row.cost_safe_start, row.returns),
            (dx, dy),
            textcoords="offset points",
            ha=side,
            va="center",
            fontsize=9,
            color=INK,
            arrowprops={"arrowstyle": "-", "color": INK, "lw": 0.6, "alpha": 0.6, "shrinkB": 5} if far else None,
        ).set_in_layout(False)
        taken.append(box)
        leaders += [*lead] if far else []


def _overlap(a, b) -> float:
    width, height = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
    return width * height if width > 0 and height > 0 else 0.0


def _crosses(box, a, b) -> bool:
    """Whether a level or upright segment passes through the box."""
    (x0, x1), (y0, y1) = sorted((a[0], b[0])), sorted((a[1], b[1]))
    return x0 < box.x1 and x1 > box.x0 and y0 < box.y1 and y1 > box.y0


def training_curves(rows: list[Row], name: str) -> list[dict]:
    """One small panel per quantity that any run logged: {title, svg, keys}; seeds are thin lines."""
    runs: dict = {}
    for row in rows:
        for run, _ in row.members:
            runs.setdefault(run.path, (row, run.metrics))
    panels = []
    for k, (title, y, logarithmic, lines) in enumerate(PANELS):
        present = [
            (row, style, [(m["step"], m[key]) for m in log if key in m])
            for row, log in runs.values()
            for key, style, _ in lines
            if any(key in m for m in log)
        ]
        if not present:
            continue
        with matplotlib.rc_context(STYLE | {"font.size": 9}):
            made = figure(3.5, 2.3)
            ax = made.add_subplot()
            for row, style, points in present:
                points = points[:: -(-len(points) // 300)]  # at most 300 points a line
                ax.plot(*zip(*points), style, color=colour(row), linewidth=1.1)
            if logarithmic and all(v > 0 for _, _, points in present for _, v in points):
                ax.set_yscale("log")
                ax.yaxis.set_major_formatter(Ticks())
                ax.yaxis.set_minor_formatter(Ticks())
            if "share" in y:
                ax.set_ylim(-0.03, 1.03 if "true hazard" not in title else None)
            ax.xaxis.set_major_locator(MaxNLocator(5))
            ax.set_ylabel(y)
            ax.set_xlabel("update")
            panels.append(
                {
                    "title": title,
                    "svg": to_svg(made, f"{title} during training, one thin line per seed", f"{name}-{k}"),
                    "dashed": len(lines) > 1,
                }
            )
    return panels


def barrier_field(run: Run, state: np.ndarray | None, name: str) -> dict | None:
    """h of one agent around it, one other agent moved over a grid: {svg, about}; None where there is no barrier or
    the features do not say where others are. `state` (S,) is a real state; None takes a reset."""
    import jax
    import jax.numpy as jnp

    from ringfence.loading import run_worlds
    from ringfence.loading.resolve import load
    from ringfence.nets.heads import barrier_on

    if not run.checkpoints():
        raise UserError(f"'{run.path}' holds no checkpoint.")
    job, policy = load(run)
    networks, names = getattr(policy, "networks", {}), job.spec.feature_names
    n, radius = job.spec.n_agents, getattr(job.hazard.hazard, "radius", None)
    learned = run_worlds.of_run(run).barrier if "barrier" not in networks and job.reads_world else None
    if ("barrier" not in networks and learned is None) or radius is None or job.task.env is None or n < 2:
        return None
    agent, other = 0, 1
    env = job.task.env
    reset = env.from_global_state(jnp.asarray(state)[None]) if state is not None else env.reset(jax.random.key(1), 1)
    base = np.array(policy.feature_map(env.observe(reset), env.global_state(reset)))[0]  # (N, D)
    flat = np.asarray(env.global_state(reset))[0]
    position, velocity = flat[: 2 * n].reshape(n, 2), flat[2 * n : 4 * n].reshape(n, 2)
    relative = "other0.dx" in names
    if not relative and f"agent{other}.x" not in names:
        return None
    has_velocity = ("other0.dvx" if relative else f"agent{other}.vx") in names
    side = np.linspace(-1.0, 1.0, 81)
    dx, dy = np.meshgrid(side, side)
    speed, distance = 1.0, np.maximum(np.hypot(dx, dy), 1e-6)

    def field(approach: float) -> np.ndarray:
        x = np.broadcast_to(base, (dx.size, *base.shape)).copy()
        for c, (d, towards) in enumerate(((dx, -dx / distance), (dy, -dy / distance))):
            axis = "xy"[c]
            if relative:
                x[:, agent, names.index(f"other0.d{axis}")] = d.ravel()
                if has_velocity:
                    x[:, agent, names.index(f"other0.dv{axis}")] = approach * towards.ravel()
            else:
                x[:, :, names.index(f"agent{other}.{axis}")] = (position[agent, c] + d.ravel())[:, None]
                if has_velocity:
                    v = velocity[agent, c] + approach * towards.ravel()
                    x[:, :, names.index(f"agent{other}.v{axis}")] = v[:, None]
        x = jnp.asarray(x)
        h = barrier_on(networks["barrier"], policy.normaliser, x) if learned is None else learned.of_steps(x, x)
        return np.asarray(h)[:, agent].reshape(dx.shape)

    cases = [("at rest relative to the agent", 0.0)]
    if has_velocity:
        cases.append((f"approaching at {speed:g} m/s", speed))
    fields = [field(v) for _, v in cases]
    most = max(np.abs(f).max() for f in fields) or 1.0
    rest = np.array([position[j] - position[agent] for j in range(n) if j not in (agent, other)]).reshape(-1, 2)
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        made = figure(4.1 * len(fields) + 0.7, 4.0)
        axes = made.subplots(1, len(fields), squeeze=False, sharey=True)[0]
        for ax, h, (case, _) in zip(axes, fields, cases):
            shown = ax.imshow(
                h,
                origin="lower",
                extent=(-1.0125, 1.0125, -1.0125, 1.0125),
                cmap="RdBu",
                norm=TwoSlopeNorm(0.0, -most, most),
                interpolation="bilinear",
            )
            if h.min() < 0 < h.max():
                ax.contour(dx, dy, h, [0.0], colors="black", linewidths=1.8)
            ax.add_patch(Circle((0, 0), radius, fill=False, linestyle="--", edgecolor="black", linewidth=1.2))
            ax.plot(0, 0, "+", color="black")
            near = rest[np.abs(rest).max(1) < 1] if len(rest) else rest
            if len(near):
                ax.plot(*near.T, "o", mfc="none", color="black", markersize=9)
            ax.set(title=f"other agent {case}", xlabel="other agent's x − own x (m)", xlim=(-1, 1), ylim=(-1, 1))
        axes[0].set_ylabel("other agent's y − own y (m)")
        bar = made.colorbar(shown, ax=axes, shrink=0.85)
        bar.set_label("h  (negative: judged unsafe)")
        share = [_agreement(h, distance < radius) for h in fields]
        about = "; ".join(
            f"{case}, h < 0 on {100 * inside:.0f} % of the area in contact and on {100 * outside:.0f} % of the rest"
            for (case, _), (inside, outside) in zip(cases, share)
        )
        label = f"Learned barrier of agent {agent} around it. With the other agent {about}."
        return {"svg": to_svg(made, label, name), "about": about, "others": len(rest), "radius": radius}


def _agreement(h: np.ndarray, contact: np.ndarray) -> tuple[float, float]:
    return float((h[contact] < 0).mean()), float((h[~contact] < 0).mean())


def lonely_state(states: np.ndarray, n: int) -> np.ndarray:
    """Of recorded states (R, L+1, S), the one in which agent 0 is farthest from the agents 2, 3, ...: they must not
    decide its barrier."""
    flat = states.reshape(-1, states.shape[-1])
    position = flat[:, : 2 * n].reshape(-1, n, 2)
    if n < 3:
        return flat[0]
    return flat[np.linalg.norm(position[:, 2:] - position[:, :1], axis=-1).min(1).argmax()]
