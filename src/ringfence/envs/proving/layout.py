"""What a system of the proving ground consists of: a body, its dangers, who pays, what is named, who drove, and how
large everything is. And where agents begin and what they head for: drawn from numbers in the state, so that a state
says what comes next. And what they observe: themselves, their goal, others and the moving obstacle relative to them."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.proving.bodies import BODIES, Body, Motion, Plant, length
from ringfence.envs.proving.dangers import BY_PLACE, FAR, OF_PLACE, STANDING, Danger, Place
from ringfence.errors import UserError, unknown
from ringfence.problem.partners import approaches, others, seen_first
from ringfence.types import Array, Key

Kind = Literal["integrator", "unicycle", "car", "quadrotor", "platoon", "arm", "motor"]
Drivers = Literal["careless", "mixed", "careful"]
PLANAR = ("integrator", "unicycle", "car", "quadrotor")
DRAWS = 2**24  # whole numbers that a float32 tells apart
TRIES = 8  # goals of which the first that is free and far enough is taken
FREE = 0.15  # m or rad of room around a goal
REACHED = 0.2  # m or rad
SLOT = 0.6  # m between the places of a formation
GAP = 1.2  # m between cars of a platoon
AHEAD = (2.0, 6.0)  # m to the next goal of a platoon
ARMS = ((0.4, -1.8), (2.7, 1.8))  # rad, goals
RAISED = ((1.3, -0.4), (1.8, 0.4))  # rad, where arms begin
SIGHT = 3.0  # m; who is farther away is not seen, where not all are observed
SOON = 1.0  # s in which who comes nearest is observed
SHAFTS = 5.0  # rad to either side, goals of motors


class SystemState(NamedTuple):
    config: Array  # (..., N, C) m or rad
    rate: Array  # (..., N, C)
    pose: Array  # (..., N, X) rad
    applied: Array  # (..., N, A) physical actions as they reach the body
    charge: Array  # (..., N) share of a battery
    goal: Array  # (..., N, C)
    draw: Array  # (..., N) what the next goal is drawn by
    phase: Array  # (...,) rad, of the moving obstacle

    @property
    def motion(self) -> Motion:
        return Motion(self.config, self.rate, self.pose)


@dataclass(frozen=True)
class Layout:
    """Sizes of what is no danger in a system are read by nothing."""

    body: Kind = "integrator"
    danger: tuple[Danger, ...] = ("pairs",)
    n_agents: int = 4
    costs: Literal["team", "each"] = "team"
    names: Literal["all", "none"] = "all"
    drivers: Drivers = "mixed"
    goals: Literal["own", "team"] = "own"  # team: a formation goes from place to place
    mass: float = 1.0
    uneven: float = 0.0  # share by which the first agent is lighter and the last heavier
    drag: float = 0.1  # 1/s
    lag: float = 0.0  # s in which the body follows an action
    dt: float = 0.1  # s
    episode_length: int = 80
    radius: float = 0.15  # m, of what touches
    side: float = 4.0  # m, of the room
    posts: tuple[tuple[float, float, float], ...] = ((0.9, 0.3, 0.3), (-0.9, -0.3, 0.3))  # place and radius, m
    mover: tuple[float, float, float] = (0.3, 1.0, 12.0)  # m of radius, m of its path, s of a round
    corridor: tuple[float, float, float] = (0.7, 0.6, 0.6)  # m half a width, m to the sides, m of a bend
    joint_limit: float = 1.2  # rad to either side
    apart_limit: float = 1.2  # m or rad between partners
    speed_limit: float = 0.8
    neighbours: int = 6  # that are observed at most
    homogeneous: bool = False
    rebound: float = 0.0  # share of its rate at which a body that touches is thrown back; 0: it passes
    actions: Literal["unit", "physical"] = "unit"  # in [−1, 1], or in the body's own bounds

    def __post_init__(self):
        object.__setattr__(self, "danger", tuple(self.danger))
        object.__setattr__(self, "posts", tuple(tuple(post) for post in self.posts))
        for field, options in (("body", get_args(Kind)), ("drivers", get_args(Drivers))):
            if getattr(self, field) not in options:
                raise unknown(field, str(getattr(self, field)), options)
        if not self.danger:
            raise UserError("A System without danger costs nothing; name one of " + ", ".join(get_args(Danger)) + ".")
        for name in self.danger:
            if name not in get_args(Danger):
                raise unknown("danger", name, get_args(Danger))
        misfits = {"mover": PLANAR, "corridor": PLANAR, "walls": PLANAR, "posts": (*PLANAR, "arm")}
        misfits |= {"pairs": (*PLANAR, "platoon", "arm"), "joints": ("arm", "motor")}
        for name in self.danger:
            if self.body not in misfits.get(name, get_args(Kind)):
                raise UserError(f"danger='{name}' is no danger to a body that is a {self.body}; leave it out.")
        if not 0 <= self.rebound < 1 or (self.rebound and not self.planar):
            raise UserError(
                f"rebound={self.rebound:g} is a share from 0 to below 1 of the rate of a body that drives in a plane; "
                "give another, or leave it out."
            )
        if self.n_agents < (2 if {"pairs", "apart"} & set(self.danger) else 1):
            raise UserError(f"n_agents={self.n_agents} is too few for {', '.join(self.danger)}; give more.")

    @property
    def made_of(self) -> Body:
        return BODIES[self.body]

    @property
    def plant(self) -> Plant:
        share = np.linspace(-1.0, 1.0, self.n_agents) if self.n_agents > 1 else np.zeros(1)
        mass = self.mass * (1.0 + self.uneven * share)
        pace = 1.0 - np.clip(self.uneven * share, 0.0, 0.8)  # the heavier half is slower, too
        return Plant(mass[:, None].astype(np.float32), pace[:, None].astype(np.float32), self.drag, self.dt)

    @property
    def place(self) -> Place:
        radius, _, _ = self.mover
        return Place(
            self.made_of,
            self.radius,
            self.side,
            self.posts,
            radius,
            self.corridor,
            self.joint_limit,
            self.apart_limit,
        )

    @property
    def planar(self) -> bool:
        return self.body in PLANAR

    @property
    def action_dim(self) -> int:
        return len(self.made_of.low)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(A,) twice: the least and the greatest physical action of each entry."""
        return np.array(self.made_of.low, np.float32), np.array(self.made_of.high, np.float32)

    @property
    def action_low(self) -> tuple[float, ...]:
        """Bounds of what `step` takes."""
        return (-1.0,) * self.action_dim if self.actions == "unit" else self.made_of.low

    @property
    def action_high(self) -> tuple[float, ...]:
        return (1.0,) * self.action_dim if self.actions == "unit" else self.made_of.high

    @property
    def state_names(self) -> tuple[str, ...]:
        body = self.made_of
        fields = [*body.axes, *body.rates, *(f"pose{k}" for k in range(body.pose_size))]
        fields += [f"applied{k}" for k in range(self.action_dim)] + ["charge"]
        fields += [f"goal_{axis}" for axis in body.axes] + ["draw"]
        return (*(f"agent{i}.{field}" for i in range(self.n_agents) for field in fields), "obstacle.phase")

    def physical(self, action: Array) -> Array:
        """Actions as `step` takes them in physical units, within bounds."""
        low, high = self.bounds
        if self.actions == "physical":
            return jnp.clip(action, low, high)
        return (jnp.clip(action, -1.0, 1.0) + 1.0) / 2 * (high - low) + low

    def unit(self, push: Array) -> Array:
        """Physical actions in [−1, 1]."""
        low, high = self.bounds
        return jnp.clip(2 * (push - low) / (high - low) - 1.0, -1.0, 1.0)

    def given(self, push: Array) -> Array:
        """Physical actions as `step` takes them, within bounds."""
        return self.unit(push) if self.actions == "unit" else jnp.clip(push, *self.bounds)

    def of_place(self, own: Array, others: Array, mover: Array) -> dict[str, Array]:
        """(..., N, M) signed distances of each danger of place."""
        found = {name: OF_PLACE[name] for name in self.danger if name in OF_PLACE}
        return {name: distance(self.place, own, others, mover) for name, distance in found.items()}

    def mover_at(self, phase: Array) -> Array:
        """(..., 2) m, where the moving obstacle is."""
        _, path, _ = self.mover
        return path * jnp.stack([jnp.cos(phase), 0.7 * jnp.sin(phase)], -1)

    def mover_rate(self, phase: Array) -> Array:
        """(..., 2) m/s"""
        _, _, period = self.mover
        later = self.mover_at(phase + 2 * jnp.pi * self.dt / period)
        return (later - self.mover_at(phase)) / self.dt


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
    spot = ("x", "y", "vx", "vy") if system.body == "arm" else (*body.axes, *body.rates)
    for j in range(observed(system)):
        found += [f"other{j}.{name}" for name in (*(f"d{name}" for name in spot), *seen)]
    if "mover" in system.danger:
        found += [f"obstacle0.{name}" for name in ("dx", "dy", "dvx", "dvy")]
    return tuple(found)


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
    if nearest_only(system):
        offset, relative, squared = approaches(spot, speed, SIGHT, SOON)
        parts.append(seen_first(squared, system.neighbours, system.n_agents - 1, SIGHT, offset, relative))
    else:
        both = jnp.concatenate([spot, speed], -1)
        rows = both[..., others(system.n_agents), :] - both[..., :, None, :]  # in the order of the team
        parts.append(rows.reshape(*spot.shape[:-1], -1))
    if "mover" in system.danger:
        there = system.mover_at(state.phase)[..., None, :] - state.config
        parts += [there, system.mover_rate(state.phase)[..., None, :] - state.rate]
    return jnp.concatenate(parts, -1)


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
