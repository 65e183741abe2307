"""Who drives: the windows of a log shared among joint clones by who explains them best, without labels.

    r_c ∝ exp(−Σ_t ‖a_t − μ_c(s_t)‖² / 2σ²),   L^E = E Σ_c r_c ‖a_t − μ_c(s_t)‖²   (expectation–maximisation)

At first all clones get equal shares (the balance of Cuturi 2013 and Caron et al. 2020), so that none takes everything;
later those that nobody needs are left with nothing. A generator that is given the driver learns one policy at a time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ringfence.errors import UserError
from ringfence.logs.windows import NOT_ARRIVED
from ringfence.nets.layers import ResidualMLP
from ringfence.problem.normalise import Normaliser
from ringfence.proposals.drivers import driver_scores
from ringfence.types import Array, Batch, Key, Metrics

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


class Driven(NamedTuple):
    """Whose the windows of a batch are."""

    driver: Array  # (B,) drawn by its shares
    loss: Array  # () L^E + L^Q
    metrics: Metrics


def networks(
    of_clones: Key, of_prior: Key, drivers: int, seen: int, acts: int, width: int, depth: int
) -> dict[str, ResidualMLP]:
    """Joint clones of every driver, and who drives: of `seen` entries of a team, whose joint action has `acts`."""
    return {
        "clones": ResidualMLP(of_clones, seen, drivers * acts, width, depth),
        "prior": ResidualMLP(of_prior, seen + 2, drivers, PRIOR_WIDTH, 2, 0.1),
    }


def driven(search: Search, params: Any, norm: Normaliser, batch: Batch, keep: Array, step: Array, key: Key) -> Driven:
    """Whose the windows of `batch` are, by its steps (T); `keep` (B,) which of them tell the prior their score."""
    windows, steps = batch.actions.shape[:2]
    there = steps_there(batch)
    seen = norm.state(batch.features[:, :-1]).reshape(windows * steps, -1)
    actions = batch.actions.reshape(windows * steps, -1)
    clones = params["clones"](seen).reshape(windows, steps, search.drivers, -1)
    shares, clone_loss = cloned(search, clones, actions.reshape(windows, steps, -1), there, step)
    driver = jax.random.categorical(key, jnp.log(shares + 1e-9))
    guess = driver_scores(params["prior"], seen, jnp.repeat(batch.score, steps), jnp.repeat(keep, steps))
    prior_loss = surprise(guess, shares, there)
    metrics = {"loss/clones": clone_loss, "loss/prior": prior_loss}
    metrics["drivers/sure"] = shares.max(-1).mean()
    pays = worth(clones, actions.reshape(windows, steps, -1), there, shares)
    metrics |= {"drivers/worth": pays, "drivers/distinguished": distinguished(shares)}
    return Driven(driver, clone_loss + prior_loss, metrics)


def found(metrics: Mapping[str, float]) -> int:
    """How many drivers made the logs, by a line of a run's metrics: one where following one saves nothing."""
    return round(metrics["drivers/distinguished"]) if metrics["drivers/worth"] > 0 else 1


def distinguished(shares: Array) -> Array:
    """() how many drivers shares (B, C) distinguish: exp of what a window tells of its driver, in nats."""
    mean = shares.mean(0)
    return jnp.exp(_entropy(mean) - _entropy(shares).mean())


def worth(clones: Array, actions: Array, there: Array, shares: Array) -> Array:
    """() share of the squared error in the second half of windows that is saved by following the clone that explains
    their first half best, and not the mean of all. 0 or less where one driver made the logs: then clones differ by
    chance, and their mean errs least. `clones` (B, T, C, N·A), `actions` (B, T, N·A), `there` (B, T), `shares`
    (B, C)."""
    half = actions.shape[1] // 2
    errors = ((clones - actions[:, :, None]) ** 2).sum(-1) * there[..., None]
    best = errors[:, :half].sum(1).argmin(-1)
    followed = jnp.take_along_axis(errors[:, half:].sum(1), best[:, None], 1).sum()
    mean = jnp.einsum("btca,c->bta", clones[:, half:], shares.mean(0))
    shared = (((mean - actions[:, half:]) ** 2).sum(-1) * there[:, half:]).sum()
    return 1.0 - followed / jnp.maximum(shared, 1e-9)


def _entropy(shares: Array) -> Array:
    return -(shares * jnp.log(shares + 1e-9)).sum(-1)


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


def cloned(search: Search, clones: Array, actions: Array, there: Array, step: Array) -> tuple[Array, Array]:
    """Shares (B, C) of windows in drivers, which carry no gradient, and L^E of what their clones do (B, T, C, N·A) for
    `actions` (B, T, N·A); `there` (B, T) which steps count."""
    errors = ((clones - actions[:, :, None]) ** 2).sum(-1) * there[..., None]
    explained = -errors.sum(1) / (2 * spread(search, step) ** 2)
    shares = shares_of(search, jax.lax.stop_gradient(explained), step)
    return shares, (shares[:, None] * errors).sum() / jnp.maximum(there.sum(), 1)


def surprise(guess: Array, shares: Array, there: Array) -> Array:
    """L^Q: cross-entropy of who drives, by logits `guess` (B·T, C) at the steps of windows with `shares` (B, C)."""
    steps = there.shape[1]
    of_steps = -(jnp.repeat(shares, steps, 0) * jax.nn.log_softmax(guess)).sum(-1)
    return (of_steps * there.reshape(-1)).sum() / jnp.maximum(there.sum(), 1)
