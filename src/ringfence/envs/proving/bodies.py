"""Bodies of the proving ground: how pushes move them, and how a wanted rate of change is steered.

A body has a config (places in m, or angles in rad) of C axes, the rate of its change, and a pose: what else tells how
it goes on. Arrays have any leading axes, then agents N.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import jax.numpy as jnp
import numpy as np

from ringfence.types import Array

GRAVITY = 9.81  # m/s²
SETTLED = 2.5  # steps in which a driver closes a gap between the wanted rate and its own


class Motion(NamedTuple):
    config: Array  # (..., N, C) m or rad
    rate: Array  # (..., N, C) of its change, in a second
    pose: Array  # (..., N, X) heading, steering angle, pitch, ... in rad


class Plant(NamedTuple):
    """What differs from one system to the next."""

    mass: np.ndarray  # (N, 1) of each agent; 1 is usual
    pace: np.ndarray  # (N, 1) share of the body's top rate that each agent reaches
    drag: float  # 1/s
    dt: float  # s


class Body(Protocol):
    """What a kind of body is."""

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the config's entries."""
        ...

    @property
    def rates(self) -> tuple[str, ...]:
        """Names of the rate's entries."""
        ...

    @property
    def posed(self) -> tuple[str, ...]:
        """Names of what is shown of the pose."""
        ...

    @property
    def pose_size(self) -> int: ...

    @property
    def low(self) -> tuple[float, ...]:
        """Least physical action, of each entry."""
        ...

    @property
    def high(self) -> tuple[float, ...]: ...

    @property
    def top(self) -> float:
        """Greatest norm of the rate."""
        ...

    @property
    def brake(self) -> float:
        """How fast the rate can fall at a mass of 1, in a second."""
        ...

    def move(self, now: Motion, push: Array, plant: Plant) -> Motion:
        """The motion after a step under physical actions (..., N, A)."""
        ...

    def steer(self, now: Motion, want: Array, cap: Array, plant: Plant) -> Array:
        """Physical actions that bring the rate to `want` (..., N, C); `cap` (..., N) bounds the speed along the heading
        of what has one."""
        ...

    def show(self, pose: Array) -> Array:
        """The pose as agents observe it, under the names `posed`."""
        ...

    def read(self, shown: Array) -> Array:
        """Inverse of `show`."""
        ...

    def ahead(self, pose: Array) -> Array | None:
        """(..., N, 2) where it heads for, of what moves along its heading alone."""
        ...

    def joints(self, config: Array) -> Array:
        """(..., N, J, 2) m, the line that it is drawn by; its last points may touch others."""
        ...


class AsItIs:
    """What most bodies are: observed as they are, without a heading, drawn as a point."""

    def show(self, pose: Array) -> Array:
        return pose

    def read(self, shown: Array) -> Array:
        return shown

    def ahead(self, pose: Array) -> Array | None:
        return None

    def joints(self, config: Array) -> Array:
        return config[..., None, :]


@dataclass(frozen=True)
class Point(AsItIs):
    """A double integrator: pushed along every axis. In the plane, or (`line`) a car of a platoon."""

    line: bool = False
    pose_size: int = 0
    posed: tuple[str, ...] = ()
    top: float = 1.2
    brake: float = 1.5

    @property
    def axes(self) -> tuple[str, ...]:
        return ("x",) if self.line else ("x", "y")

    @property
    def rates(self) -> tuple[str, ...]:
        return tuple(f"v{axis}" for axis in self.axes)

    @property
    def low(self) -> tuple[float, ...]:
        """A car brakes harder than it speeds up."""
        return (-2.5,) if self.line else (-1.5, -1.5)

    @property
    def high(self) -> tuple[float, ...]:
        return (1.5,) if self.line else (1.5, 1.5)

    def move(self, now: Motion, push: Array, plant: Plant) -> Motion:
        rate = now.rate + plant.dt * (push / plant.mass - plant.drag * now.rate)
        rate = jnp.clip(rate, 0.0, self.top * plant.pace) if self.line else bounded(rate, self.top * plant.pace[:, 0])
        return Motion(now.config + plant.dt * rate, rate, now.pose)

    def steer(self, now: Motion, want: Array, cap: Array, plant: Plant) -> Array:
        return ((want - now.rate) / (SETTLED * plant.dt) + plant.drag * now.rate) * plant.mass

    def joints(self, config: Array) -> Array:
        if self.line:
            config = jnp.concatenate([config, jnp.zeros_like(config)], -1)
        return config[..., None, :]


@dataclass(frozen=True)
class Unicycle(AsItIs):
    """Pushed along its heading, and turned. It does not back up."""

    axes: tuple[str, ...] = ("x", "y")
    rates: tuple[str, ...] = ("vx", "vy")
    posed: tuple[str, ...] = ("cos", "sin")
    pose_size: int = 1  # heading
    low: tuple[float, ...] = (-1.5, -2.5)  # m/s², rad/s
    high: tuple[float, ...] = (1.0, 2.5)
    top: float = 1.0
    brake: float = 1.5

    def move(self, now: Motion, push: Array, plant: Plant) -> Motion:
        heading = wrapped(now.pose + plant.dt * push[..., 1:])
        speed = (now.rate * along(now.pose)).sum(-1, keepdims=True)
        speed = speed + plant.dt * (push[..., :1] / plant.mass - plant.drag * speed)
        rate = jnp.clip(speed, 0.0, self.top * plant.pace) * along(heading)
        return Motion(now.config + plant.dt * rate, rate, heading)

    def steer(self, now: Motion, want: Array, cap: Array, plant: Plant) -> Array:
        speed, wanted, error = headed(now, want, cap)
        push = plant.mass[:, 0] * ((wanted - speed) / (SETTLED * plant.dt) + plant.drag * speed)
        return jnp.stack([push, 2.5 * error], -1)

    def show(self, pose: Array) -> Array:
        return along(pose)

    def read(self, shown: Array) -> Array:
        return jnp.arctan2(shown[..., 1:], shown[..., :1])

    def ahead(self, pose: Array) -> Array | None:
        return along(pose)


@dataclass(frozen=True)
class Car(AsItIs):
    """A kinematic bicycle: it turns as it rolls, by a steering angle that follows what is asked for."""

    axes: tuple[str, ...] = ("x", "y")
    rates: tuple[str, ...] = ("vx", "vy")
    posed: tuple[str, ...] = ("cos", "sin", "steering")
    pose_size: int = 2  # heading, steering angle
    low: tuple[float, ...] = (-2.5, -0.6)  # m/s², rad
    high: tuple[float, ...] = (1.2, 0.6)
    top: float = 1.5
    brake: float = 2.5
    base: float = 0.3  # m from axle to axle
    follows: float = 0.15  # s in which the steering angle follows

    def move(self, now: Motion, push: Array, plant: Plant) -> Motion:
        heading = now.pose[..., :1]
        angle = now.pose[..., 1:]
        speed = (now.rate * along(heading)).sum(-1, keepdims=True)
        speed = speed + plant.dt * (push[..., :1] / plant.mass - plant.drag * speed)
        speed = jnp.clip(speed, 0.0, self.top * plant.pace)
        angle = angle + plant.dt / (self.follows + plant.dt) * (push[..., 1:] - angle)
        heading = wrapped(heading + plant.dt * speed / self.base * jnp.tan(angle))
        rate = speed * along(heading)
        return Motion(now.config + plant.dt * rate, rate, jnp.concatenate([heading, angle], -1))

    def steer(self, now: Motion, want: Array, cap: Array, plant: Plant) -> Array:
        now = now._replace(pose=now.pose[..., :1])
        speed, wanted, error = headed(now, want, cap, slowest=0.3)
        push = plant.mass[:, 0] * ((wanted - speed) / (SETTLED * plant.dt) + plant.drag * speed)
        return jnp.stack([push, jnp.clip(1.2 * error, -0.6, 0.6)], -1)

    def show(self, pose: Array) -> Array:
        return jnp.concatenate([along(pose[..., :1]), pose[..., 1:]], -1)

    def read(self, shown: Array) -> Array:
        return jnp.concatenate([jnp.arctan2(shown[..., 1:2], shown[..., :1]), shown[..., 2:]], -1)

    def ahead(self, pose: Array) -> Array | None:
        return along(pose[..., :1])


@dataclass(frozen=True)
class Quadrotor(AsItIs):
    """A quadrotor in a vertical plane: thrust along its own axis, and a pitch rate that follows what is asked for."""

    axes: tuple[str, ...] = ("x", "y")  # y is up
    rates: tuple[str, ...] = ("vx", "vy")
    posed: tuple[str, ...] = ("pitch", "pitch_rate")
    pose_size: int = 2
    low: tuple[float, ...] = (0.0, -5.0)  # N/kg, rad/s
    high: tuple[float, ...] = (2 * GRAVITY, 5.0)
    top: float = 1.5
    brake: float = 1.8
    follows: float = 0.05  # s in which the pitch rate follows

    def move(self, now: Motion, push: Array, plant: Plant) -> Motion:
        turning = now.pose[..., 1:] + plant.dt / (self.follows + plant.dt) * (push[..., 1:] - now.pose[..., 1:])
        pitch = wrapped(now.pose[..., :1] + plant.dt * turning)
        lift = push[..., :1] / plant.mass * jnp.concatenate([jnp.sin(pitch), jnp.cos(pitch)], -1)
        rate = now.rate + plant.dt * (lift - np.array([0.0, GRAVITY]) - plant.drag * now.rate)
        rate = bounded(rate, 2 * self.top)
        return Motion(now.config + plant.dt * rate, rate, jnp.concatenate([pitch, turning], -1))

    def steer(self, now: Motion, want: Array, cap: Array, plant: Plant) -> Array:
        asked = bounded((want - now.rate) / 0.35, 3.5) + plant.drag * now.rate + np.array([0.0, GRAVITY])
        pitch = now.pose[..., 0]
        wanted = jnp.clip(jnp.arctan2(asked[..., 0], asked[..., 1]), -0.6, 0.6)
        thrust = plant.mass[:, 0] * asked[..., 1] / jnp.maximum(jnp.cos(pitch), 0.5)
        return jnp.stack([thrust, 7.0 * (wanted - pitch) - 0.4 * now.pose[..., 1]], -1)


@dataclass(frozen=True)
class Arm(AsItIs):
    """An arm of two links in the plane, without gravity, moved by torques; arms stand in a row."""

    axes: tuple[str, ...] = ("q1", "q2")
    rates: tuple[str, ...] = ("w1", "w2")
    posed: tuple[str, ...] = ()
    pose_size: int = 0
    low: tuple[float, ...] = (-1.0, -0.4)  # N m
    high: tuple[float, ...] = (1.0, 0.4)
    top: float = 1.6
    brake: float = 1.2
    links: tuple[float, float] = (0.5, 0.4)  # m
    spacing: float = 0.8  # m from arm to arm
    inertia: tuple[float, float, float] = (0.32, 0.08, 0.09)  # kg m²: of both links, of their coupling, of the second

    def _inertia(self, config: Array) -> tuple[Array, Array, float]:
        both, coupling, second = self.inertia
        bend = jnp.cos(config[..., 1])
        return both + 2 * coupling * bend, second + coupling * bend, second

    def _whirl(self, config: Array, rate: Array) -> Array:
        """(..., N, 2) N m by which turning joints act upon each other."""
        twist = self.inertia[1] * jnp.sin(config[..., 1])
        first = -twist * rate[..., 1] * (2 * rate[..., 0] + rate[..., 1])
        return jnp.stack([first, twist * rate[..., 0] ** 2], -1)

    def move(self, now: Motion, push: Array, plant: Plant) -> Motion:
        a, b, c = self._inertia(now.config)
        left = (push - self._whirl(now.config, now.rate)) / plant.mass
        turned = jnp.stack([c * left[..., 0] - b * left[..., 1], a * left[..., 1] - b * left[..., 0]], -1)
        speedup = turned / (a * c - b * b)[..., None] - plant.drag * now.rate
        rate = bounded(now.rate + plant.dt * speedup, 2 * self.top)
        return Motion(now.config + plant.dt * rate, rate, now.pose)

    def steer(self, now: Motion, want: Array, cap: Array, plant: Plant) -> Array:
        a, b, c = self._inertia(now.config)
        asked = bounded((want - now.rate) / (4 * plant.dt), 6.0) + plant.drag * now.rate
        torque = jnp.stack([a * asked[..., 0] + b * asked[..., 1], b * asked[..., 0] + c * asked[..., 1]], -1)
        return torque * plant.mass + self._whirl(now.config, now.rate)

    def joints(self, config: Array) -> Array:
        n = config.shape[-2]
        foot = jnp.broadcast_to(in_a_row(n, self.spacing), (*config.shape[:-1], 2))
        elbow = foot + self.links[0] * along(config[..., :1])
        hand = elbow + self.links[1] * along(config.sum(-1, keepdims=True))
        return jnp.stack([foot, elbow, hand], -2)


@dataclass(frozen=True)
class Motor(AsItIs):
    """A shaft that a torque turns; motors stand in a row."""

    axes: tuple[str, ...] = ("angle",)
    rates: tuple[str, ...] = ("speed",)
    posed: tuple[str, ...] = ()
    pose_size: int = 0
    low: tuple[float, ...] = (-3.0,)  # N m
    high: tuple[float, ...] = (3.0,)
    top: float = 2.5
    brake: float = 3.0
    spacing: float = 1.2  # m from shaft to shaft, in pictures
    pointer: float = 0.4  # m

    def move(self, now: Motion, push: Array, plant: Plant) -> Motion:
        rate = now.rate + plant.dt * (push / plant.mass - plant.drag * now.rate)
        rate = bounded(rate, self.top * plant.pace[:, 0])
        return Motion(now.config + plant.dt * rate, rate, now.pose)

    def steer(self, now: Motion, want: Array, cap: Array, plant: Plant) -> Array:
        return (1.6 * (want - now.rate) + plant.drag * now.rate) * plant.mass

    def joints(self, config: Array) -> Array:
        foot = jnp.broadcast_to(in_a_row(config.shape[-2], self.spacing), (*config.shape[:-1], 2))
        return jnp.stack([foot, foot + self.pointer * along(config)], -2)


BODIES: dict[str, Body] = {
    "integrator": Point(),
    "unicycle": Unicycle(),
    "car": Car(),
    "quadrotor": Quadrotor(),
    "platoon": Point(line=True, top=2.0, brake=2.5),
    "arm": Arm(),
    "motor": Motor(),
}


def length(x: Array) -> Array:
    """Euclidean, with a slope at 0."""
    return jnp.sqrt((x**2).sum(-1) + 1e-12)


def bounded(x: Array, most: float | np.ndarray) -> Array:
    """x with a norm of at most that, or of each agent's own."""
    return x * (most / jnp.maximum(length(x), most))[..., None]


def along(angle: Array) -> Array:
    """(..., 2) the direction of an angle (..., 1)."""
    return jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], -1)


def wrapped(angle: Array) -> Array:
    """The same angle between −π and π."""
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi


def in_a_row(n: int, spacing: float) -> np.ndarray:
    """(N, 2) m"""
    return np.stack([spacing * (np.arange(n) - (n - 1) / 2), np.zeros(n)], -1)


def headed(now: Motion, want: Array, cap: Array, slowest: float = 0.0) -> tuple[Array, Array, Array]:
    """(speed, wanted speed, error of the heading), each (..., N), of what moves along its heading: the speed that is
    wanted, less the farther it looks elsewhere, but at least `slowest`, within its cap."""
    ahead = along(now.pose)
    speed = (now.rate * ahead).sum(-1)
    dot = (want * ahead).sum(-1)
    cross = ahead[..., 0] * want[..., 1] - ahead[..., 1] * want[..., 0]
    error = jnp.arctan2(cross, dot)
    wanted = jnp.minimum(jnp.maximum(dot, slowest), cap)
    return speed, wanted, error
