"""Dangers of the proving ground: signed distances, negative where it costs.

Dangers of place are functions of an agent's own config, with everybody's and the moving obstacle beside it, so that a
driver can ask how its own motion changes them. Each gives (..., N, M): M things to keep away from, or within.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
import numpy as np

from ringfence.envs.proving.bodies import Body, length
from ringfence.types import Array

Danger = Literal["pairs", "walls", "posts", "mover", "corridor", "joints", "apart", "speed", "battery"]
FAR = 1e3  # m, of what is no danger
LOW_CHARGE = 0.1  # share of a battery below which it costs
# What of each danger is as much as 0.1 m of another: m, rad, m/s, share of a charge.
MARGIN = {"joints": 0.1, "speed": 0.1, "battery": 0.05}
METRES = 0.1


@dataclass(frozen=True)
class Place:
    """Where dangers of place are."""

    body: Body
    radius: float  # m, of what an agent touches others with
    side: float  # m, of a walled room
    posts: tuple[tuple[float, float, float], ...]  # place and radius, m
    mover: float  # m, radius of the moving obstacle
    corridor: tuple[float, float, float]  # m half a width, m to the sides, m of a bend
    joints: float  # rad to either side
    apart: float  # m or rad, from a partner

    def points(self, config: Array) -> Array:
        """(..., N, P, 2) what of an agent may touch."""
        joints = self.body.joints(config)
        return joints if joints.shape[-2] == 1 else joints[..., 1:, :]


PlaceDanger = Callable[[Place, Array, Array, Array], Array]  # (place, own config, everybody's, moving obstacle)


def pairs(place: Place, own: Array, others: Array, mover: Array) -> Array:
    """From everybody else (M = N; oneself is far)."""
    mine = place.points(own)[..., :, None, :, None, :]
    theirs = place.points(others)[..., None, :, None, :, :]
    distance = length(mine - theirs).min((-1, -2)) - 2 * place.radius
    return distance + FAR * np.eye(own.shape[-2])


def walls(place: Place, own: Array, others: Array, mover: Array) -> Array:
    """Within a square room."""
    return (place.side / 2 - jnp.abs(place.points(own)) - place.radius).min(-2)


def posts(place: Place, own: Array, others: Array, mover: Array) -> Array:
    """From discs that stand still, and that nobody observes."""
    at = np.array(place.posts)
    points = place.points(own)[..., None, :]
    return (length(points - at[:, :2]) - at[:, 2] - place.radius).min(-2)


def moving(place: Place, own: Array, others: Array, mover: Array) -> Array:
    """From a disc that goes its own way."""
    distance = length(place.points(own) - mover[..., None, None, :]) - place.mover - place.radius
    return distance.min(-1, keepdims=True)


def corridor(place: Place, own: Array, others: Array, mover: Array) -> Array:
    """Within a bent corridor."""
    half, swing, bend = place.corridor
    x = own[..., 0]
    middle = swing * jnp.sin(x / bend)
    slope = swing / bend * jnp.cos(x / bend)
    off = jnp.abs(own[..., 1] - middle) / jnp.sqrt(1 + slope**2)
    return (half - off - place.radius)[..., None]


def joints(place: Place, own: Array, others: Array, mover: Array) -> Array:
    """Within what joints may turn."""
    return place.joints - jnp.abs(own)


def apart(place: Place, own: Array, others: Array, mover: Array) -> Array:
    """Near enough to the agents before and after oneself; others do not count."""
    gap = length(own[..., :, None, :] - others[..., None, :, :])
    n = own.shape[-2]
    partner = np.abs(np.arange(n)[:, None] - np.arange(n)) == 1
    return jnp.where(partner, place.apart - gap, FAR)


OF_PLACE: dict[str, PlaceDanger] = {
    "pairs": pairs,
    "walls": walls,
    "posts": posts,
    "mover": moving,
    "corridor": corridor,
    "joints": joints,
    "apart": apart,
}
STANDING = ("walls", "posts", "corridor", "joints")  # that are where they are whoever does what
SOLID = ("pairs", "walls", "posts", "mover", "corridor")  # that stop a body
BY_PLACE = ("walls", "posts", "corridor")  # that follow from where one is
