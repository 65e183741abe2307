"""Who comes nearest, of agents that see those around them."""

from __future__ import annotations

import jax.numpy as jnp

from ringfence.types import Array


def approaches(position: Array, velocity: Array, sight: float, soon: float) -> tuple[Array, Array, Array]:
    """Offsets and relative velocities (B, N, N, 2) of everybody to everybody, and the squared distance (B, N, N) of
    their nearest approach within `soon` s if all go on as now: beyond all others for who is out of `sight` m, and
    beyond these for oneself."""
    offset = position[..., None, :, :] - position[..., :, None, :]
    speed = velocity[..., None, :, :] - velocity[..., :, None, :]
    when = jnp.clip(-(offset * speed).sum(-1) / ((speed**2).sum(-1) + 1e-9), 0.0, soon)
    squared = ((offset + when[..., None] * speed) ** 2).sum(-1)
    in_sight = (offset**2).sum(-1) < sight**2
    squared = jnp.where(in_sight, squared, 1e6) + 1e9 * jnp.eye(position.shape[-2])
    return offset, speed, squared
