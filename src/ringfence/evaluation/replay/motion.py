"""How the driven agent moves: by a World's dynamics, or by kinematics that are named."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError, known
from ringfence.evaluation.replay.scene import Motion
from ringfence.logs.store import EpisodeStore
from ringfence.problem import normalise
from ringfence.problem.entries import LANE, SPACE, Entries, axes_of
from ringfence.world import World

KINEMATICS = ("double_integrator", "holonomic", "unicycle", "bicycle", "world")
TURNING = ("unicycle", "bicycle")  # that have a heading
LINEAR = ("double_integrator", "holonomic")  # whose next velocity is a sum of this one and the action
EXPLAINED = 0.5  # of what velocities change by: kinematics that explain less are refused
WELL = 0.9  # the same of kinematics that nobody asked for
SLOW = 0.05  # m/s below which a velocity tells no heading


@dataclass(frozen=True, eq=False)
class Kinematics:
    """`name` of KINEMATICS. A double integrator's velocity becomes (1 − drag) v + gain a, a holonomic body's gain a;
    the actions of a unicycle are m/s² and rad/s, those of a bicycle m/s² and the steering angle."""

    name: str
    dt: float  # s
    low: np.ndarray  # (A,) bounds of actions
    high: np.ndarray
    max_speed: float  # m/s: the fastest of the logs
    late: float  # share of a step that is gone with the next velocity
    gain: float = 1.0
    drag: float = 0.0
    explained: float = float("nan")  # share of the logged changes of velocity
    wheelbase: float = 2.7  # m
    world: World | None = field(default=None, repr=False)

    def moved(
        self, place: np.ndarray, velocity: np.ndarray, heading: np.ndarray, action: np.ndarray, predicted: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(place, velocity, heading) after actions (W, A); `predicted` is the next velocity by the World, if asked."""
        if self.name == "world":
            after = predicted
        elif self.name in LINEAR:
            after = (1 - self.drag) * velocity + self.gain * action
        else:
            heading, after = self._turned(velocity, heading, action)
        speed = np.linalg.norm(after, axis=-1, keepdims=True)
        after = after * np.minimum(1.0, self.max_speed / np.maximum(speed, 1e-9))
        if self.name in ("world", *LINEAR):
            heading = np.where(speed[:, 0] > SLOW, np.arctan2(after[:, 1], after[:, 0]), heading)
        return place + ((1 - self.late) * velocity + self.late * after) * self.dt, after, heading

    def _turned(self, velocity, heading, action) -> tuple[np.ndarray, np.ndarray]:
        speed = (velocity * _unit(heading)).sum(-1)
        rate = action[:, 1] if self.name == "unicycle" else speed / self.wheelbase * np.tan(action[:, 1])
        heading = heading + rate * self.dt
        return heading, (speed + action[:, 0] * self.dt)[:, None] * _unit(heading)

    def toward(self, wanted: np.ndarray, velocity: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """(W, A) the action within bounds that leads to a velocity (W, X) soonest."""
        if self.name in ("world", *LINEAR):
            if len(self.low) != wanted.shape[1]:
                raise UserError(
                    f"Who drives badly on purpose needs an action for each of {wanted.shape[1]} axes, and these logs "
                    f"have {len(self.low)}; replay a run with drivers=()."
                )
            action = (wanted - (1 - self.drag) * velocity) / self.gain
            return np.clip(action, self.low, self.high)
        speed = (velocity * _unit(heading)).sum(-1)
        want = np.linalg.norm(wanted, axis=-1)
        error = np.arctan2(wanted[:, 1], wanted[:, 0]) - heading
        error = np.where(want > SLOW, (error + np.pi) % (2 * np.pi) - np.pi, 0.0)
        rate = error / self.dt
        if self.name == "bicycle":
            rate = np.arctan(rate * self.wheelbase / np.maximum(np.abs(speed), 0.1))
        push = (want * np.maximum(np.cos(error), 0.0) - speed) / self.dt
        return np.clip(np.stack([push, rate], -1), self.low, self.high)

    @property
    def brakes(self) -> float:
        """m/s² that it brakes by."""
        gain = 1.0 if self.name in TURNING else self.gain / self.dt
        return float(max(abs(gain) * min(abs(self.low[0]), abs(self.high[0])), 1e-3))


def foreseen_velocity(world: World) -> Any:
    """A compiled function (features (B, N, D), actions (B, N, A) in [−1, 1]) -> change of velocities (B, N, X)."""
    own = Entries.of(world.spec.feature_names).own
    at = np.array([own[f"v{axis}"] for axis in axes_of(own, "v{}")])

    @jax.jit
    def change(world: World, before: Any, action: Any) -> Any:
        after, _ = world.dynamics.step(before, action)
        return (after - before)[..., at]

    return lambda before, action: np.asarray(change(world, before, action), np.float64)


def kinematics_of(
    name: str | None, store: EpisodeStore, motion: Motion, world: World | None, dt: float, wheelbase: float
) -> Kinematics:
    """The kinematics that are named; by default a double integrator where that explains the logs, else the World's."""
    if name is not None:
        known("kinematics", name, KINEMATICS)
    size = store.actions.shape[2]
    axes = motion.offset.shape[-1]
    if name in TURNING and axes > 2:
        raise UserError(f"kinematics='{name}' moves in a plane, and these logs are of space; name another.")
    if name is not None and name != "world" and size != axes:
        raise UserError(f"kinematics='{name}' takes {axes} actions an agent, the logs have {size}.")
    low, high = _bounds(store)
    speeds = np.zeros(1) if motion.velocity is None else np.linalg.norm(motion.velocity, axis=-1)
    fastest = float(np.quantile(speeds, 0.999)) or 1.0
    made = Kinematics(name or KINEMATICS[0], dt, low, high, fastest, motion.late, wheelbase=wheelbase, world=world)
    if name in TURNING:
        return made
    fitted = _fitted(made, store, motion) if size == axes else made
    lane = world is not None and Entries.of(world.spec.feature_names).axes == LANE
    needed = [f"own.v{axis}" for axis in (LANE if lane else SPACE)[:axes]]
    world_can = world is not None and set(needed) <= set(world.spec.feature_names)
    if name == "world" or (name is None and not fitted.explained >= WELL and world_can):
        if not world_can:
            raise UserError(f"kinematics='world' needs a World whose view holds {' and '.join(needed)}; name another.")
        return replace(fitted, name="world")
    if not fitted.explained >= EXPLAINED:
        raise UserError(
            f"Actions of '{store.card.task}' explain {100 * np.nan_to_num(fitted.explained):.0f} % of the changes of "
            f"velocity as kinematics='{fitted.name}' would; name another: {', '.join(KINEMATICS)}."
        )
    return fitted


def _bounds(store: EpisodeStore) -> tuple[np.ndarray, np.ndarray]:
    """(A,) what every agent can do."""
    size = store.actions.shape[2]
    bounds = store.card.bounds
    low = np.broadcast_to(np.asarray(bounds.low, np.float64), (store.n_agents, size))
    high = np.broadcast_to(np.asarray(bounds.high, np.float64), (store.n_agents, size))
    return low.max(0), high.min(0)


def _fitted(made: Kinematics, store: EpisodeStore, motion: Motion) -> Kinematics:
    """Gain and drag by least squares of the logged steps."""
    if motion.velocity is None:
        return made
    row = np.arange(store.steps) + store.episode_of_step
    before = motion.velocity[row].ravel()
    change = motion.velocity[row + 1].ravel() - before
    actions = np.asarray(store.actions, np.float64).ravel()
    if made.name == "holonomic":
        gain = float(actions @ (change + before) / max(actions @ actions, 1e-12))
        drag = 1.0
    else:
        columns = np.stack([actions, -before], 1)
        gain, drag = (float(x) for x in np.linalg.lstsq(columns, change, rcond=None)[0])
    left = change - gain * actions + drag * before
    explained = 1 - (left**2).mean() / max(change.var(), 1e-12)
    gain = gain if abs(gain) > 1e-6 else 1e-6
    return replace(made, gain=gain, drag=drag, explained=float(explained))


def in_unit(action: np.ndarray, world: World) -> Any:
    """Actions in [−1, 1], as a World takes them."""
    unit = normalise.to_unit(jnp.asarray(action, jnp.float32), world.spec.action_low, world.spec.action_high)
    return jnp.clip(unit, -1.0, 1.0)


def _unit(heading: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(heading), np.sin(heading)], -1)
