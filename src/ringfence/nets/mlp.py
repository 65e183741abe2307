"""Multi-layer perceptrons, shared by all agents or one per agent."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.types import Array, Key, Spec


class MLP(eqx.Module):
    """ReLU network with linear output on (..., N, F); `groups` = N gives every agent weights of its own, 1 shares."""

    weights: list[Array]  # (G, F_in, F_out)
    biases: list[Array]  # (G, F_out)
    linear: Array | None  # (G, F_in, F_out) added to the output: what is linear need not be learned by ReLUs
    spec: Spec | None = eqx.field(static=True)  # of networks whose outputs are actions

    def __init__(
        self,
        key: Key,
        sizes: tuple[int, ...],
        groups: int = 1,
        final_scale: float = 1.0,
        linear: bool = False,
        acts: Spec | None = None,
    ):
        """`sizes` = (in, hidden, ..., out); He initialisation, the last layer scaled by `final_scale`. Outputs that
        are entries of actions of `acts` are 0 where an agent has none."""
        self.spec = None if acts is None or acts.action_sizes is None else acts
        self.linear = jnp.zeros((groups, sizes[0], sizes[-1])) if linear else None
        self.weights, self.biases = _initial(key, tuple(sizes), groups, final_scale)

    def __call__(self, x: Array) -> Array:
        """(..., N, F_out)"""
        out = self._applied(x)
        return out if self.spec is None else self.spec.own(out)

    def _applied(self, x: Array) -> Array:
        shape = x.shape
        groups = self.weights[0].shape[0]
        if groups == 1:
            x = first = x.reshape(-1, shape[-1])
            for n, (w, b) in enumerate(zip(self.weights, self.biases)):
                x = x @ w[0] + b[0]
                x = jax.nn.relu(x) if n < len(self.weights) - 1 else x
            x = x if self.linear is None else x + first @ self.linear[0]
            return x.reshape(*shape[:-1], x.shape[-1])
        x = first = jnp.moveaxis(x.reshape(-1, groups, shape[-1]), 1, 0)  # (N, M, F): one matrix product per agent
        for n, (w, b) in enumerate(zip(self.weights, self.biases)):
            x = jax.lax.batch_matmul(x, w) + b[:, None]
            x = jax.nn.relu(x) if n < len(self.weights) - 1 else x
        x = x if self.linear is None else x + jax.lax.batch_matmul(first, self.linear)
        return jnp.moveaxis(x, 0, 1).reshape(*shape[:-1], x.shape[-1])


@functools.partial(jax.jit, static_argnums=(1, 2, 3))  # operation by operation takes a program each
def _initial(key: Key, sizes: tuple[int, ...], groups: int, final_scale: float) -> tuple[list[Array], list[Array]]:
    """Weights (G, F_in, F_out) and biases (G, F_out) of each layer."""
    weights = []
    keys = jax.random.split(key, len(sizes) - 1)
    for layer, (k, fan_in, fan_out) in enumerate(zip(keys, sizes[:-1], sizes[1:])):
        last = layer == len(sizes) - 2
        gain = (1.0 / fan_in) ** 0.5 * final_scale if last else (2.0 / fan_in) ** 0.5
        weights.append(jax.random.normal(k, (groups, fan_in, fan_out)) * gain)
    return weights, [jnp.zeros((groups, fan_out)) for fan_out in sizes[1:]]
