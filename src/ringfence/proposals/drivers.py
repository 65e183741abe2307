"""Which of the drivers that a log was found to hold may drive here, given the state and the return."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from ringfence.types import Array


def driver_scores(net: Any, seen: Array, score: Array, keep: Array) -> Array:
    """Logits (B, C) of who drives at standardised states (B, N·D), given y (B,) where `keep` (B,) says so."""
    return net(jnp.concatenate([seen, asked(seen, score, keep)], -1))


def asked(seen: Array, score: Array, keep: Array) -> Array:
    """(B, 2): y and whether it is given."""
    return jnp.stack([jnp.where(keep, score, 0.0), keep.astype(seen.dtype)], -1)


def classifier_free(answer: Callable[[Array, Array], Array], score: Array, scale: float) -> Array:
    """Classifier-free guidance: out(∅) + ω (out(y) − out(∅)) of what answers to (y (B,), whether it is given (B,));
    ω = 1 asks once."""
    everyone = jnp.ones(score.shape, bool)
    conditional = answer(score, everyone)
    if scale == 1.0:
        return conditional
    free = answer(score, ~everyone)
    return free + scale * (conditional - free)


def drawn(logits: Array, normal: Array) -> Array:
    """(B,) one driver each, drawn by logits (B, C) with normal noise (B, C), the only one that exported files can be
    given."""
    share = jnp.clip(0.5 * (1.0 + jax.lax.erf(normal / 2**0.5)), 1e-6, 1.0 - 1e-6)
    gumbel = -jnp.log(-jnp.log(share))
    return jnp.argmax(logits + gumbel, -1).astype(jnp.int32)
