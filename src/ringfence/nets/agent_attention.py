"""A denoiser of agents: one token per agent holds its whole window, attention runs across agents.

The number of agents appears in no weight unless they are distinguished. It learns joint policies more slowly than one
network of the team (docs/results.md), which homogeneous agents, who are teams of one each, need no more either.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.nets.layers import Condition, entries, flattened, restored
from ringfence.types import Array, Key

HEADS = 4
SMALL_TEAM = 8  # up to here attention is sums of products over pairs; above, matrix products


class AgentAttention(eqx.Module):
    """F(x_k, k, y): pre-norm residual blocks of attention over agents and a SiLU layer; the condition enters the
    layer's hidden units. Tokens stay a flat (B·N, W) matrix throughout, the shape XLA multiplies fastest on a CPU.
    """

    condition: Condition
    inlet: Array  # (carried entries, W)
    outlet: Array  # (W, carried entries)
    blocks: list[dict[str, Array]]
    which: Array | None  # (N, W), where agents are distinguished
    carried: tuple[int, ...] = eqx.field(static=True)  # entries of a flattened window (H·D) that are read and written

    def __init__(
        self,
        key: Key,
        rows: int,
        features: int,
        width: int = 128,
        depth: int = 3,
        carried: tuple[int, ...] | None = None,
        agents: int = 0,
        drivers: int = 0,
    ):
        """`agents`: their number if they are to be distinguished, as limbs of one body are; 0: they are homogeneous.
        `drivers`: how many it may plan as."""
        keys = jax.random.split(key, depth + 3)
        self.carried = entries(rows, features, carried)
        flat = len(self.carried)
        self.condition = Condition(keys[0], width, drivers)
        self.inlet = _normal(keys[1], flat, width)
        self.outlet = _normal(keys[2], width, flat, 0.1)
        self.blocks = [_block(k, width) for k in keys[3:]]
        self.which = jnp.zeros((agents, width)) if agents else None

    def __call__(self, x: Array, k: Array, y: Array, keep: Array, driver: Array | None = None) -> Array:
        """x (B, H, N, D) noisy plan, k (B,) diffusion step, y (B,) return score, keep (B,) bool, driver (B,) of
        those it plans as -> (B, H, N, D)."""
        b, _, n, _ = x.shape
        c = self.condition(k, y, keep, driver)
        token = flattened(x, self.carried) @ self.inlet
        if self.which is not None:
            token = token + jnp.tile(self.which, (b, 1))
        for p in self.blocks:
            token = token + _attend(_norm(token), p, n)
            condition = jnp.repeat(c @ p["tell"] + p["bias"], n, axis=0)
            token = token + jax.nn.silu(_norm(token) @ p["up"] + condition) @ p["down"]
        return restored(_norm(token) @ self.outlet, x.shape, self.carried)


def _attend(z: Array, p: dict[str, Array], n: int) -> Array:
    """Multi-head attention over the n agents of each plan; z (B·n, W)."""
    q, k = jnp.split(z @ p["query_key"], 2, -1)
    v = z @ p["value"]
    b = z.shape[0] // n
    w = v.shape[-1]
    q, k = (t.reshape(b, n, HEADS, -1) for t in (q, k))
    v = v.reshape(b, n, HEADS, -1)
    if n <= SMALL_TEAM:
        logits = (q[:, :, None] * k[:, None]).sum(-1) / q.shape[-1] ** 0.5
        mixed = (jax.nn.softmax(logits, axis=2)[..., None] * v[:, None]).sum(2)
    else:
        logits = jnp.einsum("bihd,bjhd->bhij", q, k) / q.shape[-1] ** 0.5
        mixed = jnp.einsum("bhij,bjhd->bihd", jax.nn.softmax(logits, axis=-1), v)
    return mixed.reshape(b * n, w) @ p["mix"]


def _block(key: Key, width: int) -> dict[str, Array]:
    k = jax.random.split(key, 6)
    return {
        "query_key": _normal(k[0], width, 2 * (width // 4)),
        "value": _normal(k[1], width, width // 2),
        "mix": _normal(k[2], width // 2, width, 0.3),
        "tell": _normal(k[3], width, 2 * width),
        "bias": jnp.zeros(2 * width),
        "up": _normal(k[4], width, 2 * width),
        "down": _normal(k[5], 2 * width, width, 0.3),
    }


def _normal(key: Key, rows: int, columns: int, gain: float = 1.0) -> Array:
    return jax.random.normal(key, (rows, columns)) * (gain / rows**0.5)


def _norm(x: Array) -> Array:
    x = x - x.mean(-1, keepdims=True)
    return x * jax.lax.rsqrt((x**2).mean(-1, keepdims=True) + 1e-6)
