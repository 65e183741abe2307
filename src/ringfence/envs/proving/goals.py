"""Where agents of the proving ground begin, and what they head for: drawn from numbers in the state, so that a state
says what comes next."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.proving.bodies import length
from ringfence.envs.proving.dangers import FAR, OF_PLACE, STANDING
from ringfence.envs.proving.layout import Layout
from ringfence.errors import UserError
from ringfence.types import Array, Key

DRAWS = 2**24  # whole numbers that a float32 tells apart
TRIES = 8  # goals of which the first that is free and far enough is taken
FREE = 0.15  # m or rad of room around a goal
REACHED = 0.2  # m or rad
SLOT = 0.6  # m between the places of a formation
GAP = 1.2  # m between cars of a platoon
AHEAD = (2.0, 6.0)  # m to the next goal of a platoon
ARMS = ((0.4, -1.8), (2.7, 1.8))  # rad, goals
RAISED = ((1.3, -0.4), (1.8, 0.4))  # rad, where arms begin
SHAFTS = 5.0  # rad to either side, goals of motors


def reach(system: Layout) -> float:
    """m or rad from a goal at which the next one is given."""
    return REACHED


def slots(system: Layout) -> np.ndarray:
    """(N, C) where an agent of a formation stands in it."""
    n = np.arange(system.n_agents)
    if system.body == "platoon":
        return -GAP * n[:, None].astype(np.float32)
    if not system.planar:
        return np.zeros((system.n_agents, len(system.made_of.axes)), np.float32)
    zigzag = np.stack([SLOT * 0.8 * (n - n.mean()), SLOT * 0.6 * (n % 2 - 0.5)], -1)
    return zigzag.astype(np.float32)


def region(system: Layout) -> tuple[np.ndarray, np.ndarray]:
    """(C,) twice: between what bounds goals are drawn."""
    if system.body == "platoon":
        return np.array(AHEAD[:1]), np.array(AHEAD[1:])
    if system.body == "arm":
        low, high = np.array(ARMS[0]), np.array(ARMS[1])
    elif system.body == "motor":
        low, high = np.array([-SHAFTS]), np.array([SHAFTS])
    else:
        end = system.side / 2 - system.radius - 0.1
        if system.goals == "team":
            end = max(end - float(np.abs(slots(system)).max()), 0.3)
        low, high = np.full(2, -end), np.full(2, end)
    if "joints" in system.danger:
        most = system.joint_limit - FREE
        low, high = np.clip(low, -most, most), np.clip(high, -most, most)
    return low, high


def room(system: Layout, config: Array) -> Array:
    """(..., N) from what stands still and is dangerous."""
    found = [OF_PLACE[name] for name in STANDING if name in system.danger]
    least = jnp.full(config.shape[:-1], FAR)
    for distance in found:
        least = jnp.minimum(least, distance(system.place, config, config, jnp.zeros(2)).min(-1))
    return least


def starts(system: Layout, key: Key, batch: int) -> Array:
    """(B, N, C) places to begin in."""
    key_cell, key_jitter = jax.random.split(key)
    shape = (batch, system.n_agents, len(system.made_of.axes))
    jitter = jax.random.uniform(key_jitter, shape, minval=-1.0, maxval=1.0)
    if system.body == "arm":
        low, high = np.array(RAISED[0]), np.array(RAISED[1])
        if "joints" in system.danger:
            low, high = np.full(2, -0.15), np.full(2, 0.15)
        return (jitter + 1) / 2 * (high - low) + low
    if system.body == "motor":
        return 0.1 * jitter if system.goals == "team" else 0.5 * jitter
    if system.body == "platoon":
        return 0.2 * jitter + slots(system)
    cells, size = _cells(system)
    if system.goals == "team":
        index = jax.random.randint(key_cell, (batch,), 0, len(cells))
        return jnp.asarray(cells)[index][:, None] + slots(system) + 0.05 * jitter
    every = jnp.tile(jnp.arange(len(cells)), (batch, 1))
    index = jax.random.permutation(key_cell, every, axis=1, independent=True)[:, : system.n_agents]
    return jnp.asarray(cells)[index] + max(size / 2 - system.radius - 0.05, 0.0) * jitter


@functools.lru_cache(64)
def _cells(system: Layout) -> tuple[np.ndarray, float]:
    """(M, 2) middles of cells that are free all over, of an agent or of a whole formation, and their size."""
    slot = slots(system) if system.goals == "team" else np.zeros((1, 2), np.float32)
    end = system.side / 2 - system.radius - 0.1
    for size in (0.8, 0.7, 0.6, 0.5, 0.45):
        count = max(2, int(2 * end / size))
        grid = (np.arange(count) - (count - 1) / 2) * size
        cells = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 1, 2)
        half = max(size / 2 - system.radius - 0.05, 0.05)
        corners = half * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
        with jax.ensure_compile_time_eval():
            spots = (cells[:, :, None] + corners).reshape(len(cells), -1, 1, 2) + slot
            free = np.asarray(room(system, jnp.asarray(spots, jnp.float32)).min((-1, -2)) > 0.05)
        within = np.abs(spots).max((-1, -2, -3)) <= end + half + 1e-6
        cells = cells[free & within, 0].astype(np.float32)
        if len(cells) >= (4 if system.goals == "team" else 1.3 * system.n_agents):
            return cells, size
    raise UserError(f"{system.n_agents} agents find no free place in a room of {system.side:g} m; give a larger side.")


def following(system: Layout, config: Array, goal: Array, draw: Array) -> tuple[Array, Array]:
    """(goals (..., N, C), what the ones after are drawn by): of some that are drawn, the first that is free and far
    enough from here, else the freest."""
    axes = len(system.made_of.axes)
    low, high = region(system)
    count = TRIES * axes
    number = draw.astype(jnp.uint32)[..., None] * jnp.uint32(count) + jnp.arange(count, dtype=jnp.uint32)
    unit = (_mixed(number).astype(jnp.float32) / DRAWS).reshape(*draw.shape, TRIES, axes)
    drawn = low + unit * (high - low)
    if "corridor" in system.danger:
        half, swing, bend = system.corridor
        x = drawn[..., 0]
        off = (2 * unit[..., 1] - 1) * max(half - system.radius - FREE, 0.0)
        drawn = jnp.stack([x, swing * jnp.sin(x / bend) + 0.8 * off], -1)
    if system.body == "platoon":  # from the goal before, or of the whole formation from its own
        drawn = goal[..., None, :] + drawn
    elif system.goals == "team":
        drawn = drawn + slots(system)[:, None, :]
    by_try = jnp.moveaxis(drawn, -2, 0)  # (tries, ..., N, C)
    free = room(system, by_try)
    away = length(by_try - config)
    least = 0.35 * float(np.linalg.norm(high - low)) if system.body != "platoon" else 0.0
    if system.goals == "team":
        free = jnp.broadcast_to(free.min(-1, keepdims=True), free.shape)
        away = jnp.broadcast_to(away.min(-1, keepdims=True), away.shape)
    score = jnp.minimum(free, FREE) / FREE + 0.5 * (away > least)
    which = score.argmax(0)
    chosen = jnp.take_along_axis(by_try, which[None, ..., None], 0)[0]
    return chosen, _mixed(number[..., 0] + jnp.uint32(77)).astype(jnp.float32)


def _mixed(x: Array) -> Array:
    """A hash of uint32 to 24 bits: `lowbias32` (C. Wellons, public domain)."""
    x = (x ^ (x >> 16)) * jnp.uint32(0x7FEB352D)
    x = (x ^ (x >> 15)) * jnp.uint32(0x846CA68B)
    return (x ^ (x >> 16)) >> 8
