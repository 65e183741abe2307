"""What a system of the proving ground consists of: a body, its dangers, who pays, what is named, who drove, and how
large everything is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import jax.numpy as jnp
import numpy as np

from ringfence.envs.proving.bodies import BODIES, Body, Motion, Plant
from ringfence.envs.proving.dangers import OF_PLACE, Danger, Place
from ringfence.errors import UserError, unknown
from ringfence.types import Array

Kind = Literal["integrator", "unicycle", "car", "quadrotor", "platoon", "arm", "motor"]
Drivers = Literal["careless", "mixed", "careful"]
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
        _check(self)

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


def _check(system: Layout) -> None:
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
    if not 0 <= system.rebound < 1 or (system.rebound and not system.planar):
        raise UserError(
            f"rebound={system.rebound:g} is a share from 0 to below 1 of the rate of a body that drives in a plane; "
            "give another, or leave it out."
        )
    if system.n_agents < (2 if {"pairs", "apart"} & set(system.danger) else 1):
        raise UserError(f"n_agents={system.n_agents} is too few for {', '.join(system.danger)}; give more.")
