"""What the small networks mean: inverse and forward dynamics, barriers, on features in physical units."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.nets.mlp import MLP
from ringfence.normalise import Normaliser
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


def foresee(forward: MLP, norm: Normaliser, before: Array, action: Array, joint: bool = False) -> Array:
    """g_φi: features (..., N, D) and actions (..., N, A) -> features after one step. `joint`: the agents move one body,
    so everybody's action matters, not the own one alone."""
    if joint:
        n, a = action.shape[-2:]
        order = (np.arange(n)[:, None] + np.arange(n)) % n  # the own action first
        action = action[..., order, :].reshape(*action.shape[:-1], n * a)
    step = forward(jnp.concatenate([norm.state(before), action], -1))
    return before + step * norm.step_scale[0] + norm.step_mean[0]
