"""What agents of the proving ground observe: themselves, their goal, others and the moving obstacle relative to
them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.proving.bodies import Motion
from ringfence.envs.proving.dangers import BY_PLACE
from ringfence.envs.proving.layout import Layout, SystemState
from ringfence.problem.partners import approaches
from ringfence.types import Array

SIGHT = 3.0  # m; who is farther away is not seen, where not all are observed
SOON = 1.0  # s in which who comes nearest is observed


def placed(system: Layout) -> bool:
    """Whether agents know where they are."""
    return not system.planar and system.body != "platoon" or any(name in BY_PLACE for name in system.danger)


def nearest_only(system: Layout) -> bool:
    """Whether not all others are observed, but those who come nearest."""
    return system.homogeneous or system.n_agents - 1 > system.neighbours


def observed(system: Layout) -> int:
    """How many others have entries."""
    return system.neighbours if nearest_only(system) else system.n_agents - 1


def names(system: Layout) -> tuple[str, ...]:
    """Entries of an observation."""
    body = system.made_of
    own = [*body.rates, *body.posed]
    if placed(system):
        own += list(body.axes)
    if system.body == "arm":
        own += ["x", "y"]
    if system.lag:
        own += [f"applied{k}" for k in range(system.action_dim)]
    if "battery" in system.danger:
        own.append("charge")
    found = [f"own.{name}" for name in own] + [f"goal.d{axis}" for axis in body.axes]
    seen = ["seen"] if nearest_only(system) else []
    for j in range(observed(system)):
        found += [f"other{j}.{name}" for name in (*_relative(system), *seen)]
    if "mover" in system.danger:
        found += [f"obstacle0.{name}" for name in ("dx", "dy", "dvx", "dvy")]
    return tuple(found)


def _relative(system: Layout) -> tuple[str, ...]:
    """What is observed of another: where it is, and how that changes."""
    if system.body == "arm":
        return ("dx", "dy", "dvx", "dvy")
    body = system.made_of
    return tuple(f"d{name}" for name in (*body.axes, *body.rates))


def spots(system: Layout, state: SystemState) -> tuple[Array, Array]:
    """(..., N, G) twice: where others see an agent, and how fast that moves: of an arm its hand."""
    if system.body != "arm":
        return state.config, state.rate
    return jax.jvp(lambda config: system.made_of.joints(config)[..., -1, :], (state.config,), (state.rate,))


def observe(system: Layout, state: SystemState) -> Array:
    """(..., N, O) as `names` says."""
    spot, speed = spots(system, state)
    parts = [state.rate, system.made_of.show(state.pose)]
    if placed(system):
        parts.append(state.config)
    if system.body == "arm":
        parts.append(spot)
    if system.lag:
        parts.append(state.applied)
    if "battery" in system.danger:
        parts.append(state.charge[..., None])
    parts.append(state.goal - state.config)
    parts.append(_nearest(system, spot, speed) if nearest_only(system) else _everybody(spot, speed))
    if "mover" in system.danger:
        there = system.mover_at(state.phase)[..., None, :] - state.config
        parts += [there, system.mover_rate(state.phase)[..., None, :] - state.rate]
    return jnp.concatenate(parts, -1)


def _everybody(spot: Array, speed: Array) -> Array:
    """(..., N, (N − 1) 2G): the others in the order of the team."""
    n = spot.shape[-2]
    who = np.array([[j for j in range(n) if j != i] for i in range(n)], int).reshape(n, n - 1)
    both = jnp.concatenate([spot, speed], -1)
    rows = both[..., who, :] - both[..., :, None, :]
    return rows.reshape(*spot.shape[:-1], -1)


def _nearest(system: Layout, spot: Array, speed: Array) -> Array:
    """(..., N, k (2G + 1)): those who come nearest, first; who is not seen stands at the end of sight."""
    k = system.neighbours
    count = min(k, system.n_agents - 1)
    unseen = np.zeros(2 * spot.shape[-1] + 1, np.float32)
    unseen[0] = SIGHT
    rows = jnp.zeros((*spot.shape[:-1], 0, len(unseen)))
    if count:
        offset, relative, squared = approaches(spot, speed, SIGHT, SOON)
        _, who = jax.lax.top_k(-squared, count)
        offset = jnp.take_along_axis(offset, who[..., None], -2)
        relative = jnp.take_along_axis(relative, who[..., None], -2)
        seen = (offset**2).sum(-1, keepdims=True) < SIGHT**2
        rows = jnp.concatenate([offset, relative, jnp.ones_like(offset[..., :1])], -1)
        rows = jnp.where(seen, rows, unseen)
    missing = jnp.broadcast_to(unseen, (*spot.shape[:-1], k - count, len(unseen)))
    return jnp.concatenate([rows, missing], -2).reshape(*spot.shape[:-1], -1)


def read(system: Layout, observation: Array) -> tuple[Motion, Array]:
    """(its motion, the way to its goal (..., N, C)) of what an agent observes; where it is stays 0 where it does not
    know."""
    body = system.made_of
    at = {name: d for d, name in enumerate(names(system))}

    def entries(*wanted: str) -> Array:
        return observation[..., np.array([at[name] for name in wanted], int)]

    rate = entries(*(f"own.{name}" for name in body.rates))
    pose = body.read(entries(*(f"own.{name}" for name in body.posed)))
    config = entries(*(f"own.{name}" for name in body.axes)) if placed(system) else jnp.zeros_like(rate)
    return Motion(config, rate, pose), entries(*(f"goal.d{axis}" for axis in body.axes))
