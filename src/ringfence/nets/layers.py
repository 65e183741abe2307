"""Layers: perceptrons, shared by all agents or one per agent, a residual network for whole teams, embeddings of
conditions, windows as vectors, and what the small networks mean, on features in physical units."""

from __future__ import annotations

import functools
import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.problem.normalise import Normaliser
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
    shapes = [(groups, *of_layer) for of_layer in itertools.pairwise(sizes)]
    counts = [math.prod(shape) for shape in shapes]
    # All layers' normal numbers at once, as `jax.random.normal` draws each layer's: a draw takes long to compile.
    above = np.nextafter(np.float32(-1), np.float32(0))
    drawn = jax.vmap(lambda k: jax.random.uniform(k, (max(counts),), minval=above))(jax.random.split(key, len(shapes)))
    drawn = jax.lax.erf_inv(drawn)
    weights = []
    for layer, (shape, count) in enumerate(zip(shapes, counts)):
        last = layer == len(shapes) - 1
        gain = (1.0 / shape[1]) ** 0.5 * final_scale if last else (2.0 / shape[1]) ** 0.5
        weights.append(drawn[layer, :count].reshape(shape) * np.float32(2**0.5) * gain)
    return weights, [jnp.zeros((groups, fan_out)) for fan_out in sizes[1:]]


class ResidualMLP(eqx.Module):
    """(..., F) -> (..., outputs): a SiLU layer, then normalised residual ones, a linear outlet. It learns a few agents
    whose behaviour differs, everybody's entries in one vector, much faster than attention (results/failed.md)."""

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
