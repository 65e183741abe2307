"""Pictures of a learned barrier: h of an agent as another one is moved around it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.patches import Circle

from ringfence.errors import UserError
from ringfence.report.figures import Drawn, figure, style, to_svg
from ringfence.training.runs import Run

AGENT = 0
OTHER = 1  # who is moved around the agent
SPEED = 1.0  # m/s at which it approaches
GRID_SIDE = np.linspace(-1.0, 1.0, 81)  # m


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
    about = "; ".join(_agreement(case, h, radius) for case, h in fields.items())
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
            _draw_field(ax, h, scale, radius, near)
            ax.set(title=f"other agent {case}", xlabel="other agent's x − own x (m)", xlim=(-1, 1), ylim=(-1, 1))
        axes[0].set_ylabel("other agent's y − own y (m)")
        bar = made.colorbar(axes[-1].images[0], ax=list(axes), shrink=0.85)
        bar.set_label("h  (negative: judged unsafe)")
        return to_svg(made, label, name)


def _draw_field(ax: Axes, h: np.ndarray, scale: TwoSlopeNorm, radius: float, near: np.ndarray) -> None:
    extent = (-1.0125, 1.0125, -1.0125, 1.0125)
    ax.imshow(h, origin="lower", extent=extent, cmap="RdBu", norm=scale, interpolation="bilinear")
    if h.min() < 0 < h.max():
        ax.contour(GRID_SIDE, GRID_SIDE, h, [0.0], colors="black", linewidths=1.8)
    ax.add_patch(Circle((0, 0), radius, fill=False, linestyle="--", edgecolor="black", linewidth=1.2))
    ax.plot(0, 0, "+", color="black")
    if len(near):
        ax.plot(near[:, 0], near[:, 1], "o", mfc="none", color="black", markersize=9)


def _agreement(case: str, h: np.ndarray, radius: float) -> str:
    """How well the sign of h tells contact, in words."""
    dx, dy = np.meshgrid(GRID_SIDE, GRID_SIDE)
    contact = np.maximum(np.hypot(dx, dy), 1e-6) < radius
    inside = 100 * float((h[contact] < 0).mean())
    outside = 100 * float((h[~contact] < 0).mean())
    return f"{case}, h < 0 on {inside:.0f} % of the area in contact and on {outside:.0f} % of the rest"


def lonely_state(states: np.ndarray, n: int) -> np.ndarray:
    """Of recorded states (R, L+1, S), the one in which agent 0 is farthest from the agents 2, 3, ...: they must not
    decide its barrier."""
    flat = states.reshape(-1, states.shape[-1])
    position = flat[:, : 2 * n].reshape(-1, n, 2)
    if n < 3:
        return flat[0]
    return flat[np.linalg.norm(position[:, 2:] - position[:, :1], axis=-1).min(1).argmax()]
