"""Who drives: the windows of a log shared among joint clones by who explains them best, without labels.

    r_c ∝ exp(−Σ_t ‖a_t − μ_c(s_t)‖² / 2σ²),   L^E = E Σ_c r_c ‖a_t − μ_c(s_t)‖²   (expectation–maximisation)

At first all clones get equal shares (the balance of Cuturi 2013 and Caron et al. 2020), so that none takes everything;
later those that nobody needs are left with nothing. A generator that is given the driver learns one policy at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from ringfence.errors import UserError
from ringfence.logs.windows import NOT_ARRIVED
from ringfence.types import Array, Batch

SINKHORN = 6  # rounds that balance the shares of a batch
PRIOR_WIDTH = 64  # units of who drives, given a state


@dataclass(frozen=True)
class Search:
    """How drivers are looked for."""

    drivers: int  # C; more than there are costs little, fewer mixes some
    num_updates: int  # of training
    sigma_first: float = 0.5  # σ of the shares at the first update, in units of action
    sigma: float = 0.15  # and when `settled`
    settled: float = 0.3  # of training: σ falls until then, and drivers are used equally


def check(drivers: int, batch: int) -> None:
    """Refuse more drivers than a batch has windows."""
    if drivers > batch:
        raise UserError(
            f"drivers={drivers} share {batch} windows equally, which are too few; raise batch or lower drivers."
        )


def steps_there(batch: Batch) -> Array:
    """(B, T) which steps of the windows are the episode's own: neither before its start nor past its end."""
    first = batch.costs == NOT_ARRIVED  # rows before the start repeat the first one
    return batch.valid[:, 1:] & ~(first[:, :-1] & first[:, 1:])


def balanced(explained: Array) -> Array:
    """Shares (B, C) of windows in drivers, by log-likelihoods (B, C): rows add up to 1, columns nearly to B/C."""
    for _ in range(SINKHORN):
        explained = explained - jax.nn.logsumexp(explained, 0, keepdims=True)
        explained = explained - jax.nn.logsumexp(explained, 1, keepdims=True)
    return jax.nn.softmax(explained, -1)


def shares_of(search: Search, explained: Array, step: Array) -> Array:
    """Shares (B, C) at an update: balanced until `settled`, then what each driver explains."""
    early = step < search.settled * search.num_updates
    return jnp.where(early, balanced(explained), jax.nn.softmax(explained, -1))


def spread(search: Search, step: Array) -> Array:
    """σ at an update: it falls from `sigma_first` to `sigma`, geometrically."""
    settled = jnp.clip(step / jnp.maximum(search.settled * search.num_updates, 1.0), 0.0, 1.0)
    return search.sigma_first * (search.sigma / search.sigma_first) ** settled


def cloned(search: Search, net: Any, seen: Array, actions: Array, there: Array, step: Array) -> tuple[Array, Array]:
    """Shares (B, C) of windows in drivers, which carry no gradient, and L^E of the clones `net`. `seen` (B·T, N·D)
    standardised, `actions` (B·T, N·A), `there` (B, T) which steps count."""
    windows, steps = there.shape
    clones = net(seen).reshape(windows * steps, search.drivers, -1)
    errors = ((clones - actions[:, None]) ** 2).sum(-1).reshape(windows, steps, -1) * there[..., None]
    explained = -errors.sum(1) / (2 * spread(search, step) ** 2)
    shares = shares_of(search, jax.lax.stop_gradient(explained), step)
    return shares, (shares[:, None] * errors).sum() / jnp.maximum(there.sum(), 1)


def surprise(guess: Array, shares: Array, there: Array) -> Array:
    """L^Q: cross-entropy of who drives, by logits `guess` (B·T, C) at the steps of windows with `shares` (B, C)."""
    steps = there.shape[1]
    of_steps = -(jnp.repeat(shares, steps, 0) * jax.nn.log_softmax(guess)).sum(-1)
    return (of_steps * there.reshape(-1)).sum() / jnp.maximum(there.sum(), 1)
