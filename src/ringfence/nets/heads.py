"""What the small networks mean: inverse dynamics and barriers, on features in physical units."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ringfence.nets.mlp import MLP
from ringfence.problem.normalise import Normaliser
from ringfence.types import Array, Key


def barrier_on(net: MLP, norm: Normaliser, x: Array) -> Array:
    """h_i (..., N) on features (..., N, D)."""
    return net(norm.state(x))[..., 0]


def infer_action(
    inverse: MLP, norm: Normaliser, before: Array, after: Array, key: Key | None = None, noise: float = 0.0
) -> Array:
    """f_φi: features now and next, (..., N, D) each -> action (..., N, A)."""
    step = norm.step(before, after)
    if key is not None and noise > 0:
        step = step + noise * jax.random.normal(key, step.shape)
    return inverse(jnp.concatenate([norm.state(before), step], -1))
