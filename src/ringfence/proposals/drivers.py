"""Which of the drivers that a log was found to hold may drive here, given the state and the return."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from ringfence.types import Array, Key


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


def draw(prior: Any, seen: Array, key: Key, guided: Callable[[Callable[[Array, Array], Array]], Array]) -> Array:
    """(B,) who drives at standardised states (B, N·D), drawn; `guided` answers by the return that is asked for."""
    logits = guided(partial(driver_scores, prior, seen))
    return drawn(logits, jax.random.normal(key, logits.shape))


def several(own: Array, count: int, others: Callable[[int], Array]) -> Array:
    """(B · count,) whose proposals to make: the episode's own driver's (B,) first, then of such as may drive here, whom
    `others` draws, a number for each of B."""
    if count == 1:
        return own
    rest = others(count - 1).reshape(len(own), count - 1)
    return jnp.concatenate([own[:, None], rest], 1).reshape(-1)


def drawn(logits: Array, normal: Array) -> Array:
    """(B,) one driver each, drawn by logits (B, C) with normal noise (B, C), the only one that exported files can be
    given."""
    share = jnp.clip(0.5 * (1.0 + jax.lax.erf(normal / 2**0.5)), 1e-6, 1.0 - 1e-6)
    gumbel = -jnp.log(-jnp.log(share))
    return jnp.argmax(logits + gumbel, -1).astype(jnp.int32)
