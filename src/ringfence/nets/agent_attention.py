"""The default denoiser: one token per agent holds its whole window, attention runs across agents.

Flattening the window into the token turns the work into a few wide matrix products, which is what a CPU is good at;
`docs/method.md` has the measurements beside MADIFF's temporal U-Net. The number of agents appears in no weight.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.nets.embedding import Condition
from ringfence.types import Array, Key


class AgentAttention(eqx.Module):
    """F(x_k, k, y): pre-norm residual blocks with adaptive scale and shift from the condition (Peebles & Xie 2023)."""

    condition: Condition
    inlet: Array  # (H·D, W)
    outlet: Array  # (W, H·D)
    blocks: list[dict[str, Array]]
    heads: int = eqx.field(static=True)

    def __init__(self, key: Key, horizon: int, features: int, width: int = 256, depth: int = 3, heads: int = 4):
        keys = jax.random.split(key, depth + 3)
        flat = horizon * features
        self.condition = Condition(keys[0], width)
        self.inlet = jax.random.normal(keys[1], (flat, width)) / flat**0.5
        self.outlet = jax.random.normal(keys[2], (width, flat)) * (0.1 / width**0.5)
        self.heads = heads
        self.blocks = [_block(k, width) for k in keys[3:]]

    def __call__(self, x: Array, k: Array, y: Array, keep: Array) -> Array:
        """x (B, H, N, D) noisy plan, k (B,) diffusion step, y (B,) return score, keep (B,) bool -> (B, H, N, D)."""
        b, h, n, d = x.shape
        c = self.condition(k, y, keep)
        token = jnp.moveaxis(x, 1, 2).reshape(b, n, h * d) @ self.inlet
        for p in self.blocks:
            scale1, shift1, scale2, shift2 = jnp.split((c @ p["modulate"])[:, None], 4, -1)
            token = token + self._attend(_norm(token) * (1 + scale1) + shift1, p)
            z = _norm(token) * (1 + scale2) + shift2
            token = token + jax.nn.silu(z @ p["up"] + p["bias"]) @ p["down"]
        out = _norm(token) @ self.outlet
        return jnp.moveaxis(out.reshape(b, n, h, d), 2, 1)

    def _attend(self, z: Array, p: dict[str, Array]) -> Array:
        """Attention over agents, a handful of them: sums of products, which fuse, instead of tiny matrix products."""
        b, n, w = z.shape
        q, k, v = jnp.split((z @ p["qkv"]).reshape(b, n, self.heads, -1), 3, -1)
        if n <= 8:
            logits = (q[:, :, None] * k[:, None]).sum(-1) / q.shape[-1] ** 0.5  # (B, N, N, heads)
            share = jax.nn.softmax(logits, axis=2)
            mixed = (share[..., None] * v[:, None]).sum(2)
        else:
            logits = jnp.einsum("bihd,bjhd->bhij", q, k) / q.shape[-1] ** 0.5
            mixed = jnp.einsum("bhij,bjhd->bihd", jax.nn.softmax(logits, axis=-1), v)
        return mixed.reshape(b, n, w) @ p["mix"]


def _block(key: Key, width: int) -> dict[str, Array]:
    k = jax.random.split(key, 5)
    normal = lambda key, i, o, gain=1.0: jax.random.normal(key, (i, o)) * (gain / i**0.5)  # noqa: E731
    return {
        "modulate": normal(k[0], width, 4 * width, 0.1),
        "qkv": normal(k[1], width, 3 * width),
        "mix": normal(k[2], width, width, 0.3),
        "up": normal(k[3], width, 2 * width),
        "bias": jnp.zeros(2 * width),
        "down": normal(k[4], 2 * width, width, 0.3),
    }


def _norm(x: Array) -> Array:
    x = x - x.mean(-1, keepdims=True)
    return x * jax.lax.rsqrt((x**2).mean(-1, keepdims=True) + 1e-6)
