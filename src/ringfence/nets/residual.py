"""A residual network for whole teams: everybody's entries in one vector.

With a few agents whose behaviour differs it learns much faster than attention or a network for each
(results/failed.md)."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.types import Array, Key


class ResidualMLP(eqx.Module):
    """(..., F) -> (..., outputs): a SiLU layer, then normalised residual ones, a linear outlet."""

    inlet: dict[str, Array]
    blocks: list[dict[str, Array]]
    outlet: dict[str, Array]

    def __init__(self, key: Key, inputs: int, outputs: int, width: int, depth: int, final_scale: float = 1.0):
        """`depth` hidden layers of `width` units; the outlet's first weights are scaled by `final_scale`."""
        keys = jax.random.split(key, depth + 1)
        self.inlet = _layer(keys[0], inputs, width)
        self.blocks = [_layer(k, width, width) for k in keys[1:-1]]
        self.outlet = _layer(keys[-1], width, outputs, final_scale)

    def __call__(self, x: Array) -> Array:
        h = jax.nn.silu(_apply(self.inlet, x))
        for block in self.blocks:
            h = h + jax.nn.silu(_apply(block, _norm(h)))
        return _apply(self.outlet, h)


def _layer(key: Key, inputs: int, outputs: int, gain: float = 1.0) -> dict[str, Array]:
    weight = jax.random.normal(key, (inputs, outputs)) * (gain / inputs**0.5)
    return {"weight": weight, "bias": jnp.zeros(outputs)}


def _apply(layer: dict[str, Array], x: Array) -> Array:
    return x @ layer["weight"] + layer["bias"]


def _norm(x: Array) -> Array:
    x = x - x.mean(-1, keepdims=True)
    return x * jax.lax.rsqrt((x**2).mean(-1, keepdims=True) + 1e-6)
