"""Margins: by how much steps that came to be dangerous looked safe before."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.problem.constraints import lowest
from ringfence.types import Array
from ringfence.world.barrier import Barrier
from ringfence.world.card import JUDGED
from ringfence.world.cause_nets import Score, least_margin, with_margin, worst
from ringfence.world.dynamics import Dynamics
from ringfence.world.logged import Logged

WINDOWS = 3000  # entries, and safe steps, that margins are read from
ENTRIES = 30  # into danger: fewer say nothing, and all unsafe steps stand for them
BEARABLE = 0.8  # share of safe steps that should have the margin
OUTLIERS = 3  # entries that may look safe however few there are: one bad prediction is not to set the margin
FARTHEST = 30  # steps that entries are predicted over by one program
MISSED = 0.001  # share of entries that may look as safe as a cause's own margin


def rolled(dynamics: Dynamics, logged: Logged, starts: np.ndarray, ahead: int) -> tuple[Array, Array]:
    """Rows (W, K, N, D) and disagreement (W, K, N) from the states before steps, along the logged actions."""
    along = np.minimum(starts + np.arange(ahead)[:, None], logged.store.steps - 1)
    return _roll(dynamics, logged.before(starts), logged.picked("actions", along))


@jax.jit
def _roll(dynamics: Dynamics, x: Array, actions: Array) -> tuple[Array, Array]:
    """Rows (W, K, N, D) and disagreement (W, K, N) along actions (K, W, N, A)."""

    def step(x: Array, action: Array) -> tuple[Array, tuple[Array, Array]]:
        after, spread = dynamics.step(x, action)
        return after, (after, spread)

    rows, spread = jax.lax.scan(step, x, actions)[1]
    return jnp.moveaxis(rows, 0, 1), jnp.moveaxis(spread, 0, 1)


def conformal(values: np.ndarray, level: float) -> float:
    """The value that a new one stays below with that probability, whatever their distribution: the ⌈(n+1) level⌉-th
    smallest of n, the largest where there are too few."""
    n = len(values)
    return float(np.sort(values)[min(math.ceil((n + 1) * level), n) - 1])


def calibrated(predicted: np.ndarray, safe: np.ndarray, miscoverage: float) -> float:
    """The conformal margin of predicted scores of entries into danger, where most safe steps have it. Where they have
    not, because nothing that is logged explains some danger, the one that parts most of both."""
    calibrated = conformal(predicted, 1 - miscoverage)
    if (safe >= calibrated).mean() >= BEARABLE:
        return calibrated
    tried = np.quantile(predicted, np.linspace(0.5, 1.0, 201))
    below = np.searchsorted(np.sort(predicted), tried) / len(predicted)
    lost = np.searchsorted(np.sort(safe), tried) / len(safe)
    return float(tried[np.argmax(below - lost)])


def count_entries(logged: Logged, bad: np.ndarray) -> int:
    """Times that somebody was in danger: steps that entered it, or began in it, of those that are unsafe."""
    begins, follows = entered(logged, bad)
    return int((begins | follows).sum())


def entered(logged: Logged, bad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(begins an episode, follows a safe step) of unsafe steps, each (W,) bool."""
    row, first = (logged.picked(name, bad) for name in ("row", "first_row"))
    begins = row == first
    return begins, ~begins & ~logged.unsafe[np.maximum(bad - 1, 0)]


def entries(logged: Logged, bad: np.ndarray) -> np.ndarray:
    """Steps that entered danger, of those that are unsafe. Those that were in it already say little of where it begins:
    where a log is nearly all unsafe, most of them lie far beyond. Few entries say nothing; then it is all of `bad`."""
    _, follows = entered(logged, bad)
    return bad[follows] if follows.sum() >= ENTRIES else bad


def scores_of_ends(
    score: Callable[[Array, Array], Array], dynamics: Dynamics, logged: Logged, ends: np.ndarray
) -> np.ndarray:
    """The score(before, after) (W,) of steps that entered danger, each (W, N, D), as they are predicted from up to
    `JUDGED` steps before, one after another."""
    backs = range(JUDGED)
    found = [np.asarray(score(*_predicted(dynamics, logged, ends, back)))[_begun(logged, ends, back)] for back in backs]
    return np.concatenate(found)


def _begun(logged: Logged, ends: np.ndarray, back: int) -> np.ndarray:
    """(W,) bool: whether the episodes of steps had begun so many steps before."""
    row, first = (logged.picked(name, ends) for name in ("row", "first_row"))
    return (ends >= back) & (row - back >= first)


def _predicted(dynamics: Dynamics, logged: Logged, ends: np.ndarray, back: int) -> tuple[Array, Array]:
    """(before, after) of steps, each (W, N, D), as they are predicted from so many steps before; where the episode had
    not `_begun`, nothing in particular. One program for all `back` below FARTHEST."""
    starts = np.maximum(ends - back, 0)
    along = np.minimum(starts + np.arange(max(FARTHEST, back + 1))[:, None], logged.store.steps - 1)
    return _last_two(dynamics, logged.before(starts), logged.picked("actions", along), back + 1)


@jax.jit
def _last_two(dynamics: Dynamics, x: Array, actions: Array, steps: int) -> tuple[Array, Array]:
    """The last two of the states (W, N, D) along the first so many of the actions (K, W, N, A)."""

    def step(k: int, both: tuple[Array, Array]) -> tuple[Array, Array]:
        return both[1], dynamics.step(both[1], actions[k])[0]

    return jax.lax.fori_loop(0, steps, step, (x, x))


def _ends_and_safe(logged: Logged, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Steps that entered danger, and safe ones, of those that are learned from, each so many at most."""
    steps = logged.fitted_steps
    bad = entries(logged, steps[logged.unsafe[steps]])
    bad = rng.choice(bad, min(count, len(bad)), replace=False)
    fine = steps[~logged.unsafe[steps]]
    return bad, rng.choice(fine, min(count, len(fine)), replace=False)


def widening(
    barrier: Barrier, dynamics: Dynamics, logged: Logged, rng: np.random.Generator, ahead: Sequence[int], count: int
) -> tuple[tuple[float, ...], ...]:
    """By cause, or once where there are none, how many margins more rows ahead ask for: by so much farther from danger
    the steps that entered it looked, predicted from so many steps before. Read at `ahead`, from `count` entries."""
    bad, fine = _ends_and_safe(logged, count, rng)
    if not len(bad) or not len(fine):
        return ()

    def scored(before: np.ndarray | Array, after: np.ndarray | Array) -> np.ndarray:  # (W, causes) in margins
        return np.asarray(_by_cause(barrier, before, after))

    of_ends = scored(logged.before(bad), logged.after(bad))
    of_safe = scored(logged.before(fine), logged.after(fine))
    blamed = (of_ends.argmin(-1)[:, None] == np.arange(of_ends.shape[1])) & (of_ends < 1.0)
    asked = [np.zeros(of_ends.shape[1])]
    for k in ahead:
        known = _begun(logged, bad, k - 1)
        if known.sum() < ENTRIES:
            break
        ends = scored(*_predicted(dynamics, logged, bad, k - 1))[known]
        wanted = asked[-1].copy()
        for c in range(len(wanted)):
            mine = ends[blamed[known, c], c]
            if len(mine) >= ENTRIES:
                wanted[c] = max(wanted[c], _own_margin(mine, of_safe[:, c]) - 1.0)
        asked.append(wanted)
    at = np.array([JUDGED, *ahead][: len(asked)])
    every = np.arange(1, at[-1] + 1)
    found = [np.interp(every, at, np.array(asked)[:, c]) for c in range(of_ends.shape[1])]
    return tuple(tuple(round(float(w), 3) for w in one) for one in found)


@jax.jit
def _by_cause(barrier: Barrier, before: Array, after: Array) -> Array:
    """(W, C) ℓ of the agent in most danger by each cause, or once, in margins."""
    if not barrier.causes:
        return (lowest(barrier.of_steps(before, after)) / barrier.unit)[..., None]
    each = [lowest(worst([net], after)) for net in barrier.causes]
    return jnp.stack(each, -1) / barrier.unit


def in_own_margins(
    nets: Sequence[Score], dynamics: Dynamics, logged: Logged, rng: np.random.Generator
) -> tuple[Score, ...]:
    """The scores of causes, each in units of the margin that its own entries into danger ask for, so that a margin of
    one is as safe as the same of another: of a distance it is a length."""
    bad, fine = _ends_and_safe(logged, WINDOWS, rng)
    ended = logged.after(bad)
    stayed = logged.after(fine)
    by_each = np.stack([np.asarray(_least(net, ended)) for net in nets], -1)
    blamed = by_each.argmin(-1)
    found = []
    for k, net in enumerate(nets):
        explained = by_each[:, k] < least_margin(net)  # no margin foresees the rest
        ends = bad[(blamed == k) & explained]
        if len(ends):
            predicted = scores_of_ends(lambda _, after, net=net: _least(net, after), dynamics, logged, ends)
            net = with_margin(net, max(_own_margin(predicted, np.asarray(_least(net, stayed))), least_margin(net)))
        found.append(net)
    return tuple(found)


@jax.jit
def _least(net: Score, x: Array) -> Array:
    """(W,) the score of the agent in most danger by one cause."""
    return lowest(worst([net], x))


def _own_margin(predicted: np.ndarray, safe: np.ndarray) -> float:
    """The conformal margin of a cause's entries into danger; what cannot be foreseen is not bought by any."""
    missed = max(MISSED, OUTLIERS / len(predicted))
    return min(conformal(predicted, 1 - missed), float(np.quantile(safe, 1 - BEARABLE)))
