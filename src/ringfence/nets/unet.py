"""MADIFF's denoiser (Zhu et al. 2024): a temporal U-Net that all agents share, with attention across agents.

Convolutions run along time on every agent alone; agents meet in the attention after the middle blocks and on the skip
connections, where an agent's token is its whole row of time steps. No weight depends on the number of agents or rows.

Differences from MADIFF's code, on purpose:

* dead weights are left out: attention on the full-resolution skip, whose result was never read (74 113 at width 128;
  the skip itself stays unused, as there), and of the attention's keys the bias and the condition (165 120), which are
  the same for all agents and so cancel in the softmax;
* plans whose rows do not halve evenly are padded by repeating the last row, and cropped, instead of being refused;
* a dropped return is dropped for all agents of a plan, as the sampler needs it; theirs drops it per agent;
* layer sizes that 8 groups or 4 heads do not divide use the largest common divisor, so that any width works.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.errors import UserError
from ringfence.nets.layers import sinusoidal
from ringfence.types import Array, Key

MULTIPLIERS = (1, 4, 8)  # channels of a resolution, in units of width
KERNEL = 5  # rows that a convolution sees
GROUPS = 8  # of the group norms
HEADS = 4
Params = dict[str, Array]


def check_sizes(rows: int, width: int, depth: int) -> None:
    """Refuse sizes that the network cannot have."""
    if not 1 <= depth <= len(MULTIPLIERS):
        raise UserError(f"depth={depth} of the temporal U-Net must be 1, 2 or 3, its number of resolutions; try 3.")
    if width < 4 or rows < 1:
        raise UserError(f"width={width} and horizon={rows} are too small for the temporal U-Net; use width 32 up.")


class TemporalUNet(eqx.Module):
    """F(x_k, k, y) as `AgentAttention`; `depth` (1 to 3) counts resolutions, each half as long as the one before.

    At width 128, depth 3 and 18 features it has 64 103 317 parameters: MADIFF's 64 342 550 less the dead ones.
    """

    step: list[Params]
    target: list[Params]
    down: list[dict]  # per resolution: two residual blocks, then a halving except in the last
    middle: list[dict]
    meet: list[dict]  # attention: after the middle, then on the skips from the deepest up
    up: list[dict]  # two residual blocks and a doubling per stage
    outlet: dict

    def __init__(self, key: Key, rows: int, features: int, width: int = 128, depth: int = 3):
        check_sizes(rows, width, depth)
        keys = iter(jax.random.split(key, 64))
        channels = [features] + [width * m for m in MULTIPLIERS[:depth]]
        condition = 2 * width  # the embeddings of step and return, side by side
        self.step = [_linear(next(keys), a, b) for a, b in ((_waves(width), 4 * width), (4 * width, width))]
        self.target = [_linear(next(keys), a, b) for a, b in ((1, width), (width, 4 * width), (4 * width, width))]
        self.down = []
        for level, (a, b) in enumerate(zip(channels[:-1], channels[1:])):
            stage = {"first": _residual(next(keys), a, b, condition), "second": _residual(next(keys), b, b, condition)}
            if level < depth - 1:
                stage["halve"] = _linear(next(keys), 3 * b, b)
            self.down.append(stage)
        deepest = channels[-1]
        self.middle = [_residual(next(keys), deepest, deepest, condition) for _ in range(2)]
        skips = channels[:1:-1]  # from the deepest up; the full resolution's is not used
        self.meet = [_attention(next(keys), c, condition) for c in (deepest, *skips)]
        self.up = []
        for a, b in zip(skips, channels[-2:0:-1]):
            blocks = {
                "first": _residual(next(keys), 2 * a, b, condition),
                "second": _residual(next(keys), b, b, condition),
            }
            # A transposed convolution of kernel 4 and stride 2: even rows see (t-1, t), odd rows (t, t+1).
            self.up.append({**blocks, "even": _weight(next(keys), 2 * b, b), "odd": _linear(next(keys), 2 * b, b)})
        self.outlet = {
            "block": _convolution(next(keys), width, width),
            "last": _linear(next(keys), width, features, 0.1),
        }

    def __call__(self, x: Array, k: Array, y: Array, keep: Array) -> Array:
        """x (B, H, N, D) noisy plan, k (B,) diffusion step, y (B,) return score, keep (B,) bool -> (B, H, N, D)."""
        b, rows, n, d = x.shape
        condition = _mish(self._condition(k, y, keep))  # every use of it begins with this activation
        condition = jnp.repeat(condition, n, axis=0)
        z = jnp.moveaxis(x, 1, 2).reshape(b * n, rows, d)
        unit = 2 ** (len(self.down) - 1)
        z = jnp.pad(z, ((0, 0), (0, -rows % unit), (0, 0)), mode="edge")
        skips = []
        for stage in self.down:
            z = _apply_residual(stage["second"], _apply_residual(stage["first"], z, condition), condition)
            skips.append(z)
            if "halve" in stage:
                z = _apply(stage["halve"], _neighbours(z, 1, 1, stride=2))
        for block in self.middle:
            z = _apply_residual(block, z, condition)
        z = _meet(self.meet[0], z, condition, n)
        for meet, stage in zip(self.meet[1:], self.up):
            z = jnp.concatenate([z, _meet(meet, skips.pop(), condition, n)], -1)
            z = _apply_residual(stage["second"], _apply_residual(stage["first"], z, condition), condition)
            z = _double(stage, z)
        z = _apply(self.outlet["last"], _apply_convolution(self.outlet["block"], z))[:, :rows]
        return jnp.moveaxis(z.reshape(b, n, rows, d), 2, 1)

    def _condition(self, k: Array, y: Array, keep: Array) -> Array:
        """(B, 2 W): what diffusion step and return say; a dropped return is zeros."""
        first, last = self.step
        step = _apply(last, _mish(_apply(first, sinusoidal(k, first["weight"].shape[0]))))
        target = y[:, None]
        for layer in self.target[:-1]:
            target = _mish(_apply(layer, target))
        target = _apply(self.target[-1], target)
        return jnp.concatenate([step, jnp.where(keep[:, None], target, 0.0)], -1)


def _waves(width: int) -> int:
    """Entries of the sinusoidal embedding: `width`, but even and enough for two frequencies."""
    return max(4, width - width % 2)


# Convolutions are matrix products on shifted copies of (M, T, C): fast forwards and backwards on a CPU, and still
# matrix products when several seeds are trained in one program, where XLA would make grouped convolutions of them.


def _neighbours(z: Array, before: int, after: int, stride: int = 1) -> Array:
    """(M, T, C) -> (M, T / stride, (before + 1 + after) C): every stride-th row with those around it, zeros outside."""
    t = z.shape[1]
    padded = jax.lax.pad(z, jnp.zeros((), z.dtype), ((0, 0, 0), (before, after, 0), (0, 0, 0)))
    return jnp.concatenate([padded[:, s : s + t : stride] for s in range(before + 1 + after)], -1)


def _double(stage: dict, z: Array) -> Array:
    m, t, c = z.shape
    even = _neighbours(z, 1, 0) @ stage["even"] + stage["odd"]["bias"]
    odd = _apply(stage["odd"], _neighbours(z, 0, 1))
    return jnp.stack([even, odd], 2).reshape(m, 2 * t, c)


def _mish(z: Array) -> Array:
    """z tanh(softplus(z)), written with a single exponential."""
    e = jnp.exp(jnp.minimum(z, 20.0))
    e = e * (e + 2.0)
    return z * (e / (e + 2.0))


def _residual(key: Key, a: int, b: int, condition: int) -> dict:
    k = jax.random.split(key, 4)
    block = {"enter": _convolution(k[0], a, b), "tell": _linear(k[1], condition, b), "leave": _convolution(k[2], b, b)}
    return block if a == b else {**block, "pass": _linear(k[3], a, b)}


def _apply_residual(p: dict, z: Array, condition: Array) -> Array:
    inner = _apply_convolution(p["enter"], z) + _apply(p["tell"], condition)[:, None]
    return _apply_convolution(p["leave"], inner) + (_apply(p["pass"], z) if "pass" in p else z)


def _convolution(key: Key, a: int, b: int) -> Params:
    return {**_linear(key, KERNEL * a, b), "norm_scale": jnp.ones(b), "norm_bias": jnp.zeros(b)}


def _apply_convolution(p: Params, z: Array) -> Array:
    """Convolution, group norm, Mish."""
    m, t, _ = z.shape
    z = _apply(p, _neighbours(z, KERNEL // 2, KERNEL // 2))
    grouped = z.reshape(m, t, math.gcd(GROUPS, z.shape[-1]), -1)
    grouped = grouped - grouped.mean((1, 3), keepdims=True)
    grouped = grouped * jax.lax.rsqrt((grouped**2).mean((1, 3), keepdims=True) + 1e-5)
    return _mish(grouped.reshape(z.shape) * p["norm_scale"] + p["norm_bias"])


def _attention(key: Key, c: int, condition: int) -> dict:
    heads = math.gcd(HEADS, c)
    narrow = heads * max(1, c // (4 * heads))  # queries and keys; values keep all channels
    k = jax.random.split(key, 5)
    return {
        "query": _linear(k[0], c, narrow),
        "query_told": _linear(k[1], condition, narrow),
        "key": {"weight": _weight(k[2], c, narrow)},
        "value": _linear(k[3], c, c),
        "value_told": _linear(k[4], condition, c),
        "gamma": jnp.zeros(1),  # training starts without a word between agents
    }


def _meet(p: dict, z: Array, condition: Array, n: int) -> Array:
    """Attention over the n agents of each plan, all time steps at once; z (B·n, T, C)."""
    m, t, c = z.shape
    heads = math.gcd(HEADS, c)

    query = _apply(p["query"], z) + _apply(p["query_told"], condition)[:, None]
    value = _apply(p["value"], z) + _apply(p["value_told"], condition)[:, None]
    parts = query, z @ p["key"]["weight"], value
    query, key, value = (part.reshape(m // n, n, t, heads, -1) for part in parts)
    logits = jnp.einsum("bithd,bjthd->bhij", query, key) / (t * query.shape[-1]) ** 0.5
    mixed = jnp.einsum("bhij,bjthd->bithd", jax.nn.softmax(logits, -1), value)
    return z + p["gamma"] * mixed.reshape(m, t, c)


def _weight(key: Key, a: int, b: int, gain: float = 1.0) -> Array:
    return jax.random.normal(key, (a, b)) * (gain / a**0.5)


def _linear(key: Key, a: int, b: int, gain: float = 1.0) -> Params:
    return {"weight": _weight(key, a, b, gain), "bias": jnp.zeros(b)}


def _apply(p: Params, z: Array) -> Array:
    return z @ p["weight"] + p["bias"]
