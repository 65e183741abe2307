"""Windows of agents as vectors, one for each agent, of the entries that a plan carries."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ringfence.types import Array


def entries(rows: int, features: int, carried: tuple[int, ...] | None) -> tuple[int, ...]:
    """The entries of a flattened window (H·D) that are read and written; all of them unless some are named."""
    return tuple(range(rows * features)) if carried is None else carried


def flattened(x: Array, carried: tuple[int, ...]) -> Array:
    """(B·N, C) the carried entries of windows (B, H, N, D)."""
    b, h, n, d = x.shape
    return jnp.moveaxis(x, 1, 2).reshape(b * n, h * d)[:, np.array(carried)]


def restored(flat: Array, shape: tuple[int, ...], carried: tuple[int, ...]) -> Array:
    """Windows of that shape (B, H, N, D) of carried entries (B·N, C); 0 elsewhere."""
    b, h, n, d = shape
    out = jnp.zeros((b * n, h * d)).at[:, np.array(carried)].set(flat)
    return jnp.moveaxis(out.reshape(b, n, h, d), 2, 1)
