"""A system of the proving ground as a value: a body, its dangers, who pays, what is named, and who drove.

Every agent heads for goals; a new one is given as soon as one is reached. Danger costs 0 or 1 a step and changes
nothing else. Nothing that an agent observes says what costs: the distances here are for oracles and tests alone.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.base import Defaults
from ringfence.envs.proving import film, goals, observations
from ringfence.envs.proving.bodies import BODIES, Body, Motion, Plant, length
from ringfence.envs.proving.dangers import LOW_CHARGE, MARGIN, METRES, OF_PLACE, Danger, Place
from ringfence.errors import UserError, unknown
from ringfence.problem.features import FeatureMap
from ringfence.types import Array, Key, Transition

if TYPE_CHECKING:
    from PIL.Image import Image

Kind = Literal["integrator", "unicycle", "car", "quadrotor", "platoon", "arm", "motor"]
Drivers = Literal["careless", "mixed", "careful"]
EFFORT = 0.003  # m of progress that a step of full pushes costs
DRAIN = 0.2  # of a charge in a second at full speed
REFILL = 0.1  # at rest
PLANAR = ("integrator", "unicycle", "car", "quadrotor")


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
class System(Defaults):
    """See the module's docstring. Sizes of what is no danger here are read by nothing."""

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
    actions: Literal["unit", "physical"] = "unit"  # in [−1, 1], or in the body's own bounds
    film_shows: ClassVar[str] = "Lines lead to goals, red pays."
    opengl: ClassVar[bool] = False

    def __post_init__(self):
        object.__setattr__(self, "danger", tuple(self.danger))
        object.__setattr__(self, "posts", tuple(tuple(post) for post in self.posts))
        _check(self)

    # --- what it is ---
    @property
    def made_of(self) -> Body:
        return BODIES[self.body]

    @property
    def plant(self) -> Plant:
        share = np.linspace(-1.0, 1.0, self.n_agents) if self.n_agents > 1 else np.zeros(1)
        mass = self.mass * (1.0 + self.uneven * share)
        return Plant(mass[:, None].astype(np.float32), self.drag, self.dt)

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
    def observation_names(self) -> tuple[str, ...]:
        """What observations hold, by names or, where the system has none, by number."""
        true = observations.names(self)
        return true if self.names == "all" else tuple(f"obs{d}" for d in range(len(true)))

    @property
    def observation_dim(self) -> int:
        return len(self.observation_names)

    @property
    def state_names(self) -> tuple[str, ...]:
        body = self.made_of
        fields = [*body.axes, *body.rates, *(f"pose{k}" for k in range(body.pose_size))]
        fields += [f"applied{k}" for k in range(self.action_dim)] + ["charge"]
        fields += [f"goal_{axis}" for axis in body.axes] + ["draw"]
        return (*(f"agent{i}.{field}" for i in range(self.n_agents) for field in fields), "obstacle.phase")

    def feature_map(self, view: str) -> FeatureMap:
        """s̃_i as it is made of anybody's data: of what drivers would log here, and of observations alone."""
        from ringfence.envs.proving.drivers import logged_map

        return logged_map(self, view)

    def frames(self, states: np.ndarray, moments: list[tuple[int, bool]]) -> Iterator[Image]:
        """Pictures of an episode (film.py)."""
        return film.frames(self, states, moments)

    # --- what happens ---
    def reset(self, key: Key, batch: int) -> SystemState:
        """At rest, free of danger."""
        key_place, key_pose, key_draw, key_phase = jax.random.split(key, 4)
        n = self.n_agents
        body = self.made_of
        config = goals.starts(self, key_place, batch)
        pose = jnp.zeros((batch, n, body.pose_size))
        if body.ahead(pose) is not None:
            turned = jax.random.uniform(key_pose, (batch, n), minval=-jnp.pi, maxval=jnp.pi)
            pose = pose.at[..., 0].set(turned)
        shape = (batch, 1 if self.goals == "team" else n)
        draw = jax.random.randint(key_draw, shape, 0, goals.DRAWS).astype(jnp.float32)
        draw = jnp.broadcast_to(draw, (batch, n))
        goal, draw = goals.following(self, config, config, draw)
        return SystemState(
            config=config,
            rate=jnp.zeros_like(config),
            pose=pose,
            applied=jnp.zeros((batch, n, self.action_dim)),
            charge=jnp.ones((batch, n)),
            goal=goal,
            draw=draw,
            phase=self._free_phase(key_phase, config),
        )

    def step(self, state: SystemState, action: Array) -> tuple[SystemState, Transition]:
        """One step of `dt`; actions (..., N, A) are clipped to their bounds. Costs are 0 or 1."""
        push = self.physical(action)
        applied = state.applied + self.dt / (self.lag + self.dt) * (push - state.applied)
        motion = self.made_of.move(state.motion, applied, self.plant)
        pace = jnp.minimum(length(motion.rate) / self.made_of.top, 1.0)
        charge = state.charge + self.dt * (REFILL * (1.0 - pace) - DRAIN * pace**2)
        before = length(state.config - state.goal)
        after = length(motion.config - state.goal)
        reached = after < goals.reach(self)
        if self.goals == "team":
            reached = jnp.broadcast_to((after < 2 * goals.reach(self)).all(-1, keepdims=True), reached.shape)
        goal, draw = goals.following(self, motion.config, state.goal, state.draw)
        now = SystemState(
            *motion,
            applied=applied,
            charge=jnp.clip(charge, 0.0, 1.0),
            goal=jnp.where(reached[..., None], goal, state.goal),
            draw=jnp.where(reached, draw, state.draw),
            phase=state.phase + 2 * jnp.pi * self.dt / self.mover[2],
        )
        effort = (self.unit(push) ** 2).mean(-1)
        unsafe = (self.clearance(now) < 0).astype(jnp.float32)
        cost = unsafe if self.costs == "each" else unsafe.max(-1)
        over = jnp.zeros(state.phase.shape, bool)
        return now, Transition(before - after - EFFORT * effort, cost, over)

    def physical(self, action: Array) -> Array:
        """Actions as `step` takes them in physical units, within bounds."""
        low, high = self.bounds
        if self.actions == "physical":
            return jnp.clip(action, low, high)
        return low + (jnp.clip(action, -1.0, 1.0) + 1.0) / 2 * (high - low)

    def unit(self, push: Array) -> Array:
        """Physical actions in [−1, 1]."""
        low, high = self.bounds
        return jnp.clip(2 * (push - low) / (high - low) - 1.0, -1.0, 1.0)

    def given(self, push: Array) -> Array:
        """Physical actions as `step` takes them, within bounds."""
        return self.unit(push) if self.actions == "unit" else jnp.clip(push, *self.bounds)

    # --- what is true of danger ---
    def of_place(self, own: Array, others: Array, mover: Array) -> dict[str, Array]:
        """(..., N, M) signed distances of each danger of place."""
        found = {name: OF_PLACE[name] for name in self.danger if name in OF_PLACE}
        return {name: distance(self.place, own, others, mover) for name, distance in found.items()}

    def distances(self, state: SystemState) -> dict[str, Array]:
        """(..., N) the true signed distance of every danger: m, rad, m/s, share of a charge."""
        items = self.of_place(state.config, state.config, self.mover_at(state.phase))
        found = {name: distance.min(-1) for name, distance in items.items()}
        if "speed" in self.danger:
            found["speed"] = self.speed_limit - length(state.rate)
        if "battery" in self.danger:
            found["battery"] = state.charge - LOW_CHARGE
        return found

    def clearance(self, state: SystemState) -> Array:
        """(..., N) the least of them, each as if it were m (`MARGIN` of it as 0.1 m); negative where it costs."""
        scaled = [METRES / MARGIN.get(name, METRES) * d for name, d in self.distances(state).items()]
        return functools.reduce(jnp.minimum, scaled)

    def mover_at(self, phase: Array) -> Array:
        """(..., 2) m, where the moving obstacle is."""
        _, path, _ = self.mover
        return path * jnp.stack([jnp.cos(phase), 0.7 * jnp.sin(phase)], -1)

    def mover_rate(self, phase: Array) -> Array:
        """(..., 2) m/s"""
        _, _, period = self.mover
        later = self.mover_at(phase + 2 * jnp.pi * self.dt / period)
        return (later - self.mover_at(phase)) / self.dt

    # --- what agents and planners see ---
    def observe(self, state: SystemState) -> Array:
        """(..., N, O) as `observation_names` says."""
        return observations.observe(self, state)

    def global_state(self, state: SystemState) -> Array:
        """(..., S) as `state_names` says."""
        agents = [state.config, state.rate, state.pose, state.applied, state.charge[..., None]]
        agents += [state.goal, state.draw[..., None]]
        flat = jnp.concatenate(agents, -1)
        return jnp.concatenate([flat.reshape(*flat.shape[:-2], -1), state.phase[..., None]], -1)

    def from_global_state(self, flat: Array) -> SystemState:
        """Inverse of `global_state`."""
        axes = len(self.made_of.axes)
        sizes = (axes, axes, self.made_of.pose_size, self.action_dim, 1, axes, 1)
        agents = flat[..., :-1].reshape(*flat.shape[:-1], self.n_agents, sum(sizes))
        config, rate, pose, applied, charge, goal, draw = jnp.split(agents, np.cumsum(sizes)[:-1], -1)
        return SystemState(config, rate, pose, applied, charge[..., 0], goal, draw[..., 0], flat[..., -1])

    def _free_phase(self, key: Key, config: Array) -> Array:
        """(B,) of some phases the one that keeps the moving obstacle farthest from everybody."""
        tried = jax.random.uniform(key, (8, len(config)), maxval=2 * jnp.pi)
        if "mover" not in self.danger:
            return tried[0]
        gap = jax.vmap(lambda phase: OF_PLACE["mover"](self.place, config, config, self.mover_at(phase)))(tried)
        best = gap.min((-1, -2)).argmax(0)
        return jnp.take_along_axis(tried, best[None], 0)[0]


def _check(system: System) -> None:
    """Refuse what is no system."""
    for field, options in (("body", get_args(Kind)), ("drivers", get_args(Drivers))):
        if getattr(system, field) not in options:
            raise unknown(field, str(getattr(system, field)), options)
    if not system.danger:
        raise UserError("A System without danger costs nothing; name one of " + ", ".join(get_args(Danger)) + ".")
    for name in system.danger:
        if name not in get_args(Danger):
            raise unknown("danger", name, get_args(Danger))
    misfits = {"mover": PLANAR, "corridor": PLANAR, "walls": PLANAR, "posts": (*PLANAR, "arm")}
    misfits |= {"pairs": (*PLANAR, "platoon", "arm"), "joints": ("arm", "motor")}
    for name in system.danger:
        if system.body not in misfits.get(name, get_args(Kind)):
            raise UserError(f"danger='{name}' is no danger to a body that is a {system.body}; leave it out.")
    if system.n_agents < (2 if {"pairs", "apart"} & set(system.danger) else 1):
        raise UserError(f"n_agents={system.n_agents} is too few for {', '.join(system.danger)}; give more.")
