"""ℓ by causes: a score for each cause that was found, the worst of them counts. Of one number it is the distance to
where danger begins, which the logs tell, of several a small network, which is learned.

Which agent and which cause made a step unsafe is not logged. Learning takes the soft minimum of all scores, from an
average over causes to the sum of odds (noisy-or), with a small term by which every score explains the cost alone.
What was never visited is taught to networks, too (`Cells.beyond`): it is unsafe, whether it lies deeper in a wall or
merely where nobody went.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from ringfence.nets.layers import MLP
from ringfence.nets.optim import regress
from ringfence.problem.constraints import lowest
from ringfence.types import Array, Key
from ringfence.utils.precision import on_device
from ringfence.world.causes import CELLS, Cause, Cells, Edge, Found
from ringfence.world.settings import Settings

BATCH = 128  # steps
HOT = 10.0  # temperature that learning begins with: many causes share a cost
COOLED = 0.6  # share of the updates after which it is 1: odds add up
MARGINAL = 0.05  # weight of the term by which each score explains the cost alone
BEYOND = 0.1  # weight of places that were never visited
PLACES = 8192  # of these, by cause
PICKED = 64  # of these, in every batch
SHARP = 2.0  # log-odds that a distance begins with, for each cell that it is from the edge
LEAST = 4.0  # score of a cause's own margin: log-odds of 1 in 55, with both classes equally frequent
FAR = 1e3  # score of agents and things that a cause is not about


class CauseNet(eqx.Module):
    """The score of a cause of several numbers: a network's log-odds, times `gain`."""

    net: MLP
    mean: Array  # (k,) of what it reads
    scale: Array  # (k,)
    log_gain: Array  # ()
    cause: Cause = eqx.field(static=True)
    edge: Edge = eqx.field(static=True)

    def of_values(self, values: Array) -> Array:
        """(...,) of values (..., k)."""
        return jnp.exp(self.log_gain) * self.net((values - self.mean) / self.scale)[..., 0]


class Distance(eqx.Module):
    """The score of a cause of one number: how far it is to where danger begins, times `gain`. It grows with distance
    and never turns, so that nearer is worse, and a margin is a length."""

    bounds: Array  # (m,) where danger begins or ends, in order, over `scale`
    scale: Array  # () of the number, the range that was seen
    log_gain: Array  # ()
    cause: Cause = eqx.field(static=True)
    edge: Edge = eqx.field(static=True)

    def of_values(self, values: Array) -> Array:
        """(...,) of values (..., 1)."""
        offset = values / self.scale - self.bounds  # (..., m)
        passed = (offset > 0).sum(-1)
        safe = (passed % 2 == 1) == self.edge.inside
        return jnp.exp(self.log_gain) * jnp.where(safe, 1.0, -1.0) * lowest(jnp.abs(offset))


Score = CauseNet | Distance
# Of what scores are learned: features (M, N, D), predicted (T, N, D), row (T,), label (T,) or (T, N) bool of steps.
Labelled = tuple[Array, Array, Array, Array]


def scores(net: Score, x: Array) -> Array:
    """(..., N, J) of features (..., N, D), by thing; FAR of those that the cause is not about."""
    found = net.of_values(net.cause.of(x))
    if not net.cause.who:
        return found
    return jnp.where(net.cause.holds(x.shape[-2]), found, FAR)


def worst(nets: Sequence[Score], x: Array) -> Array:
    """(..., N) the score of features (..., N, D): of the worst thing by the worst cause."""
    return _worst(tuple(nets), x)


@jax.jit
def _worst(nets: tuple[Score, ...], x: Array) -> Array:
    return lowest(jnp.concatenate([scores(net, x) for net in nets], -1))


def blank(found: Found, width: int, key: Key | None = None) -> tuple[Score, ...]:
    """Scores that know nothing; networks have 3 hidden layers."""
    keys = jax.random.split(jax.random.key(0) if key is None else key, max(len(found.causes), 1))
    return tuple(_blank(k, cause, edge, width) for k, cause, edge in zip(keys, found.causes, found.edges))


def _blank(key: Key, cause: Cause, edge: Edge, width: int) -> Score:
    zero = jnp.zeros(())
    if edge.bounds:
        return Distance(on_device(edge.bounds, np.float32), jnp.ones(()), zero, cause, edge)
    k = cause.width
    return CauseNet(MLP(key, (k, width, width, width, 1)), jnp.zeros(k), jnp.ones(k), zero, cause, edge)


class _Learning(NamedTuple):
    """What is learned, and how far it has cooled."""

    nets: tuple[Score, ...]
    temperature: Array  # ()


def fit_causes(
    found: Found,
    cells: Sequence[Cells],
    data: Labelled,
    unsafe: np.ndarray,
    safe: np.ndarray,
    key: Key,
    settings: Settings,
) -> tuple[Score, ...]:
    """Scores of the causes that were found, with these cells, from the same data as `barrier.fit_label`."""
    key_nets, key_fit = jax.random.split(key)
    blanks = blank(found, settings.barrier_width, key_nets)
    nets = tuple(_standardised(net, one) for net, one in zip(blanks, cells))
    rng = np.random.default_rng(0)
    share, updates = settings.predicted_share, settings.barrier_updates
    few = BATCH // 4
    if not any(isinstance(net, CauseNet) for net in nets):
        return nets  # distances are read off the logs; nothing is left to learn
    about = [net.cause.holds(data[0].shape[1]) for net in nets]
    about = np.concatenate(about, -1)
    about = about if data[3].ndim == 2 else about.reshape(-1)
    every = jnp.floor(jnp.arange(1, BATCH + 1) * share) > jnp.floor(jnp.arange(BATCH) * share)
    cooling = (HOT - 1.0) / max(1.0, COOLED * updates)

    def objective(learning: _Learning, data: tuple, pick: Array) -> Array:
        x, predicted, row, label, bad, fine, beyond = data
        step = jnp.concatenate([bad[pick[:few] % len(unsafe)], fine[pick[few:] % len(safe)]])
        after = jnp.where(every[:, None, None], predicted[step], x[row[step] + 1])
        each = jnp.concatenate([scores(net, after) for net in learning.nets], -1)  # (B, N, K)
        truth = label[step].astype(jnp.float32)
        temperature = jax.lax.stop_gradient(learning.temperature)
        apart = each if truth.ndim == 2 else each.reshape(BATCH, -1)
        together = -temperature * jax.nn.logsumexp(-apart / temperature, -1)
        total = optax.sigmoid_binary_cross_entropy(-together, truth).mean()
        blamed = jnp.broadcast_to(truth[..., None], apart.shape)
        total += MARGINAL * (optax.sigmoid_binary_cross_entropy(-apart, blamed) * about).mean()
        for net, (values, unknown) in zip([net for net in learning.nets if isinstance(net, CauseNet)], beyond):
            some = pick[:PICKED] % len(values)
            total += BEYOND * optax.sigmoid_binary_cross_entropy(-net.of_values(values[some]), unknown[some]).mean()
        return total

    def cooled(learning: _Learning) -> _Learning:
        fixed = tuple(_fixed(net, one) for net, one in zip(learning.nets, nets))
        return _Learning(fixed, jnp.maximum(1.0, learning.temperature - cooling))

    places = [one.beyond(PLACES, rng) for one, net in zip(cells, nets) if isinstance(net, CauseNet)]
    beyond = [(on_device(values, np.float32), on_device(unknown, np.float32)) for values, unknown in places]
    given = (*data, on_device(unsafe), on_device(safe), beyond)
    begun = _Learning(nets, jnp.float32(HOT))
    words = "barrier, what is dangerous now"
    return regress(objective, begun, given, 2**31 - 1, key_fit, updates, BATCH, 2e-3, words, 1e-4, cooled).nets


def _fixed(net: Score, begun: Score) -> Score:
    """The score with what is not learned as it was: a network's statistics and gain, and all of a distance."""
    if not isinstance(net, CauseNet) or not isinstance(begun, CauseNet):
        return begun
    return eqx.tree_at(lambda n: (n.mean, n.scale, n.log_gain), net, (begun.mean, begun.scale, begun.log_gain))


def _standardised(net: Score, cells: Cells) -> Score:
    """The score with the statistics of what was visited."""
    if isinstance(net, Distance):
        span = max(float(cells.high[0] - cells.low[0]), 1e-6)
        sharp = np.log(SHARP * cells.bins)
        given = [on_device(a, np.float32) for a in (np.array(net.edge.bounds) / span, span, sharp)]
        return eqx.tree_at(lambda n: (n.bounds, n.scale, n.log_gain), net, given)
    centres, _ = cells.known()
    deviation = centres.std(0)
    spread = np.maximum(deviation, 1e-6)
    if cells.cause.width > 1 and deviation.max() < 2 * deviation.min():  # as axes of a place do: directions are kept
        spread = np.full_like(spread, spread.mean())
    statistics = [on_device(a, np.float32) for a in (centres.mean(0), spread)]
    return eqx.tree_at(lambda n: (n.mean, n.scale), net, statistics)


def with_margin(net: Score, margin: float) -> Score:
    """The score in units in which this margin, so far its own, is LEAST; the logs' end is as far away as that."""
    gain = jnp.asarray(np.log(LEAST / margin), jnp.float32)
    if isinstance(net, CauseNet):
        return eqx.tree_at(lambda n: n.log_gain, net, net.log_gain + gain)
    length = margin / np.exp(float(net.log_gain))
    m = len(net.edge.unseen)
    outward = np.where(np.arange(m) == 0, -1.0, 1.0) * np.array(net.edge.unseen) * length
    return eqx.tree_at(lambda n: (n.log_gain, n.bounds), net, (net.log_gain + gain, net.bounds + outward))


def least_margin(net: Score) -> float:
    """No margin is less: log-odds of a network, and of a distance half a cell, since no edge is known better."""
    if isinstance(net, CauseNet):
        return LEAST
    return float(jnp.exp(net.log_gain)) * 0.5 / CELLS[1]
