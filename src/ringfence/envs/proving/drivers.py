"""Who drives in the proving ground: straight to the goal (naive), or held back by velocity barriers, well or badly.

A driver wants to move towards its goal. Of every danger of place, at a distance d with slope n, it asks

    n · ċ + ḋ_others ≥ −γ (d − room)

of the rate ċ that it wants, and takes the nearest one that it finds. γ is what brakes allow, times `haste`: above 1
nobody can brake that late. Of two agents each answers for half.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.proving.bodies import Motion, length
from ringfence.envs.proving.dangers import FAR, LOW_CHARGE
from ringfence.envs.proving.layout import Drivers, Layout, SystemState, read
from ringfence.types import Array, Key

ROUNDS = 6  # in each of which the barrier that is missed most is met
NEAR = 0.6  # m or rad at which a driver begins to give way to the right
STEERING = {"car": 0.6}  # s until a body heads elsewhere
GIVE_WAY = 0.35  # of the top rate
BURST = 8  # steps that a driver who does not look does not look


class Habit(NamedTuple):
    """How somebody drives; each (..., N) or a number."""

    pace: Array | float  # share of the top rate, towards the goal
    haste: Array | float  # γ over what brakes allow
    room: Array | float  # m or rad that it keeps
    over: Array | float  # of a speed limit that it drives at, and how empty a battery it drives on
    lapse: Array | float  # share of the time in which it does not look
    unsteady: Array | float  # deviation of its hand, in actions of [−1, 1]


CAREFUL = Habit(0.85, 0.7, 0.1, 0.85, 0.0, 0.03)
CARELESS = Habit(1.0, 2.2, -0.02, 1.06, 0.1, 0.12)
EXPERT = Habit(1.0, 0.85, 0.06, 0.87, 0.0, 0.0)
FEW = 0.15  # of mostly careful drivers, who are careless


def habits(drivers: Drivers, key: Key, shape: tuple[int, ...]) -> Habit:
    """Habits (B, N) of an episode's drivers."""
    key_share, key_who = jax.random.split(key)
    share = jax.random.uniform(key_share, shape)
    if drivers == "careless":
        share = 0.6 + 0.6 * share
    elif drivers == "careful":
        share = jnp.where(jax.random.uniform(key_who, shape) < FEW, 0.7 + 0.3 * share, 0.2 * share)
    return Habit(*(a + share * (b - a) for a, b in zip(CAREFUL, CARELESS)))


def drive(system: Layout, state: SystemState, habit: Habit, key: Key, looks: Array | bool = True) -> Array:
    """Actions (..., N, A) of drivers; `looks` (..., N): who does not goes on as if there were no danger."""
    want = towards(system, state.goal - state.config, habit.pace)
    want = _within_limits(system, state, want, habit)
    distance, slope, drift, shared = _barriers(system, state)
    body = system.made_of
    rate = habit.haste * brake_rate(system)
    left = distance - jnp.asarray(habit.room)[..., None]
    bound = -jnp.asarray(rate)[..., None] * left
    bound = jnp.where(shared, jnp.maximum(0.5 * bound, bound - drift), bound - drift)
    kept = _kept(_aside(want, distance, slope, body.top), slope, bound)
    cap = jnp.full(left.shape[:-1], jnp.inf)
    ahead = body.ahead(state.pose)
    if ahead is not None:  # what heads for a danger slows down, wherever it wants to go
        closing = -(slope * ahead[..., None, :]).sum(-1)
        slowest = jnp.where(closing > 0.05, jnp.maximum(-bound, 0.0) / jnp.maximum(closing, 0.05), jnp.inf)
        cap = jnp.maximum(slowest.min(-1), 0.02)
    seeing = jnp.broadcast_to(looks, cap.shape)
    kept = jnp.where(seeing[..., None], kept, want)
    cap = jnp.where(seeing, cap, jnp.inf)
    action = system.unit(body.steer(state.motion, kept, cap, system.plant))
    hand = jnp.asarray(habit.unsteady)[..., None] * jax.random.normal(key, action.shape)
    return _as_taken(system, action + hand)


def naive(system: Layout, observation: Array) -> Array:
    """Actions (..., N, A) of who heads straight for its goal at full speed, from what it observes."""
    motion, ahead = read(system, observation)
    want = towards(system, ahead, 1.0)
    free = jnp.full(want.shape[:-1], jnp.inf)
    n = observation.shape[-2]  # one, of homogeneous agents who are each by themselves
    plant = system.plant._replace(mass=system.plant.mass[:n], pace=system.plant.pace[:n])
    return system.given(system.made_of.steer(Motion(*motion), want, free, plant))


def towards(system: Layout, ahead: Array, pace: Array | float) -> Array:
    """(..., N, C) the rate that leads to a goal, so far ahead (..., N, C), and stops there."""
    body = system.made_of
    far = length(ahead)
    slowing = 0.6 * brake_rate(system) * far
    speed = jnp.minimum(jnp.asarray(pace) * body.top, jnp.maximum(slowing, 0.1 * body.top))
    return ahead / jnp.maximum(far, 1e-3)[..., None] * jnp.minimum(speed, 4 * far)[..., None]


def brake_rate(system: Layout) -> float:
    """γ, 1/s: how fast a distance may shrink, as a share of it, that brakes can keep up with."""
    body = system.made_of
    heaviest = float(system.plant.mass.max())
    delay = system.lag + 2 * system.dt + STEERING.get(system.body, 0.0)
    return 1.0 / (body.top * heaviest / body.brake + delay)


def looks(habit: Habit, key: Key, step: Array, shape: tuple[int, ...]) -> Array:
    """(B, N) who looks in a step of an episode."""
    drawn = jax.random.uniform(jax.random.fold_in(key, step // BURST), shape)
    return drawn >= habit.lapse


def _within_limits(system: Layout, state: SystemState, want: Array, habit: Habit) -> Array:
    """What is wanted, less than a speed limit, and slower the emptier the battery."""
    over = jnp.asarray(habit.over)
    if "speed" in system.danger:
        most = system.speed_limit * over
        want = want * (most / jnp.maximum(length(want), most))[..., None]
    if "battery" in system.danger:
        reserve = jnp.maximum(2.0 - 1.9 * over, 0.02)  # 0.4 of a charge, or hardly any
        left = (state.charge - LOW_CHARGE - 0.02) / reserve
        want = want * jnp.clip(left, 0.0, 1.0)[..., None]
    return want


def _barriers(system: Layout, state: SystemState) -> tuple[Array, Array, Array, np.ndarray]:
    """Of every danger of place: distances (..., N, M), their slopes (..., N, M, C) by the own config, how they change
    by what others do (..., N, M), and whether two answer for it (M,). One that is far is always among them."""
    mover = system.mover_at(state.phase)
    found = system.of_place(state.config, state.config, mover)
    n = state.config.shape[-2]
    shared = [np.full(d.shape[-1], name in ("pairs", "apart")) for name, d in found.items()]

    def joined(own: Array, others: Array, mover: Array) -> Array:
        items = list(system.of_place(own, others, mover).values())
        return jnp.concatenate([*items, jnp.full((*own.shape[:-1], 1), FAR)], -1)

    axes = len(system.made_of.axes)
    rest = (jnp.zeros_like(state.config), jnp.zeros_like(mover))
    slopes = []
    for axis in range(axes):
        push = jnp.zeros_like(state.config).at[..., axis].set(1.0)
        slopes.append(jax.jvp(joined, (state.config, state.config, mover), (push, *rest))[1])
    pushed = (jnp.zeros_like(state.config), state.rate, system.mover_rate(state.phase))
    distance, drift = jax.jvp(joined, (state.config, state.config, mover), pushed)
    assert distance.shape[-2] == n
    return distance, jnp.stack(slopes, -1), drift, np.concatenate([*shared, np.zeros(1, bool)])


def _aside(want: Array, distance: Array, slope: Array, top: float) -> Array:
    """What is wanted, and to the right of the nearest thing that is in the way."""
    if want.shape[-1] != 2:
        return want
    nearest = distance.argmin(-1)
    away = jnp.take_along_axis(slope, nearest[..., None, None], -2)[..., 0, :]
    away = away / jnp.maximum(length(away), 1e-3)[..., None]
    heading = want / jnp.maximum(length(want), 1e-3)[..., None]
    blocked = jnp.maximum(-(heading * away).sum(-1), 0.0)
    close = jnp.clip(1.0 - distance.min(-1) / NEAR, 0.0, 1.0)
    right = jnp.stack([-away[..., 1], away[..., 0]], -1)
    return want + (GIVE_WAY * top * blocked * close)[..., None] * right


def _kept(want: Array, slope: Array, bound: Array) -> Array:
    """The rate (..., N, C) near `want` of which slope · rate ≥ bound (..., N, M), as far as some rounds find it."""
    size = (slope**2).sum(-1)

    def one(rate: Array, _: None) -> tuple[Array, None]:
        missing = jnp.where(size > 1e-4, bound - (slope * rate[..., None, :]).sum(-1), -jnp.inf)
        scaled = missing / jnp.sqrt(jnp.maximum(size, 1e-4))
        worst = scaled.argmax(-1)[..., None]
        away = jnp.take_along_axis(slope, worst[..., None], -2)[..., 0, :]
        length_ = jnp.take_along_axis(size, worst, -1)
        lack = jnp.maximum(jnp.take_along_axis(missing, worst, -1), 0.0)
        return rate + jnp.where(lack > 0, lack / jnp.maximum(length_, 1e-4), 0.0) * away, None

    return jax.lax.scan(one, want, None, length=ROUNDS)[0]


def _as_taken(system: Layout, action: Array) -> Array:
    """Actions of [−1, 1] as `step` takes them."""
    action = jnp.clip(action, -1.0, 1.0)
    if system.actions == "unit":
        return action
    low, high = system.bounds
    return (action + 1.0) / 2 * (high - low) + low
