"""Embeddings of the diffusion step and of the return condition, as every denoiser takes them."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.nets.mlp import MLP
from ringfence.types import Array, Key


def sinusoidal(k: Array, width: int) -> Array:
    """(B,) numbers -> (B, width) sines and cosines of geometrically spaced frequencies (Vaswani et al. 2017)."""
    half = width // 2
    frequency = jnp.exp(-math.log(10000.0) / (half - 1) * jnp.arange(half))
    angle = k.astype(jnp.float32)[:, None] * frequency
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)


class Condition(eqx.Module):
    """c(k, y): one vector per sample; a dropped return condition (∅) is a learned vector."""

    step: MLP
    target: MLP
    null: Array  # (width,)
    drivers: Array | None  # (C, width), where the log holds several

    def __init__(self, key: Key, width: int, drivers: int = 0):
        k1, k2, k3 = jax.random.split(key, 3)
        self.drivers = jax.random.normal(jax.random.fold_in(key, 1), (drivers, width)) if drivers else None
        self.step = MLP(k1, (64, width, width))
        self.target = MLP(k2, (16, width, width))
        self.null = 0.02 * jax.random.normal(k3, (width,))

    def __call__(self, k: Array, y: Array, keep: Array, driver: Array | None = None) -> Array:
        """Diffusion step k (B,), return score y (B,), keep (B,) bool: false drops the condition; driver (B,)."""
        # Scores live in about [-4, 4]; the sine features resolve them, the raw value lets them be extrapolated.
        features = jnp.concatenate([y[:, None], sinusoidal(y * 100.0, 15 + 1)[:, :15]], -1)
        target = jnp.where(keep[:, None], self.target(features), self.null)
        embedded = self.step(sinusoidal(k, 64)) + target
        if self.drivers is not None:
            embedded = embedded + self.drivers[driver]
        return jax.nn.silu(embedded)
