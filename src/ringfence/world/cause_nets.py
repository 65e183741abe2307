"""ℓ by causes: a small network for each cause that was found, the worst of them counts.

Which agent and which cause made a step unsafe is not logged. Learning takes the soft minimum of all scores, from an
average over causes to the sum of odds (noisy-or), with a small term by which every score explains the cost alone.
What was never visited is taught, too (`Cells.beyond`): a distance is as unsafe as the nearest one that was, and any
other place is unsafe, whether it lies deeper in a wall or merely where nobody went.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from ringfence.nets.mlp import MLP
from ringfence.nets.optim import regress
from ringfence.problem.constraints import least
from ringfence.types import Array, Key
from ringfence.world.causes import Cause, Cells

HOT = 10.0  # temperature that learning begins with: many causes share a cost
COOLED = 0.6  # share of the updates after which it is 1: odds add up
MARGINAL = 0.05  # weight of the term by which each score explains the cost alone
BEYOND = 0.1  # weight of places that were never visited
PLACES = 8192  # of these, by cause
PICKED = 64  # of these, in every batch


class CauseNet(eqx.Module):
    """The score of one cause."""

    net: MLP
    mean: Array  # (k,) of what it reads
    scale: Array  # (k,)
    cause: Cause = eqx.field(static=True)

    def scores(self, x: Array) -> Array:
        """(..., J) of features (..., D), by thing."""
        read = x[..., np.array(self.cause.things)]
        if self.cause.length:
            read = jnp.sqrt((read**2).sum(-1, keepdims=True) + 1e-9)
        return self.of_values(read)

    def of_values(self, values: Array) -> Array:
        """(...,) of values (..., k)."""
        return self.net((values - self.mean) / self.scale)[..., 0]


def worst(nets: Sequence[CauseNet], x: Array) -> Array:
    """(...,) the score of features (..., D): of the worst thing by the worst cause."""
    parts = [net.scores(x) for net in nets]
    return least([part[..., j] for part in parts for j in range(part.shape[-1])])


def blank(causes: Sequence[Cause], width: int, key: Key | None = None) -> tuple[CauseNet, ...]:
    """Networks that know nothing, 3 hidden layers each."""
    keys = jax.random.split(jax.random.key(0) if key is None else key, max(len(causes), 1))
    return tuple(_blank(k, cause, width) for k, cause in zip(keys, causes))


def _blank(key: Key, cause: Cause, width: int) -> CauseNet:
    k = cause.width
    return CauseNet(MLP(key, (k, width, width, width, 1)), jnp.zeros(k), jnp.ones(k), cause)


class _Learning(NamedTuple):
    """What is learned, and how far it has cooled."""

    nets: tuple[CauseNet, ...]
    temperature: Array  # ()


def fit_causes(
    cells: Sequence[Cells],
    data: tuple[Array, Array, Array, Array],
    unsafe: np.ndarray,
    safe: np.ndarray,
    key: Key,
    *,
    share: float,
    updates: int,
    width: int,
    batch: int = 512,
    quiet: bool = True,
) -> tuple[CauseNet, ...]:
    """Networks of the causes with these cells, from the same data as `barrier.fit_label`."""
    key_nets, key_fit = jax.random.split(key)
    nets = tuple(_standardised(net, one) for net, one in zip(blank([c.cause for c in cells], width, key_nets), cells))
    rng = np.random.default_rng(0)
    places = [one.beyond(PLACES, rng) for one in cells]
    few = batch // 4
    every = jnp.floor(jnp.arange(1, batch + 1) * share) > jnp.floor(jnp.arange(batch) * share)
    cooling = (HOT - 1.0) / max(1.0, COOLED * updates)

    def objective(learning: _Learning, data: tuple, pick: Array) -> Array:
        x, predicted, row, label, bad, fine, beyond = data
        step = jnp.concatenate([bad[pick[:few] % len(unsafe)], fine[pick[few:] % len(safe)]])
        after = jnp.where(every[:, None, None], predicted[step], x[row[step] + 1])
        scores = jnp.concatenate([net.scores(after) for net in learning.nets], -1)  # (B, N, K)
        truth = label[step].astype(jnp.float32)
        temperature = jax.lax.stop_gradient(learning.temperature)
        apart = scores if truth.ndim == 2 else scores.reshape(batch, -1)
        together = -temperature * jax.nn.logsumexp(-apart / temperature, -1)
        total = optax.sigmoid_binary_cross_entropy(-together, truth).mean()
        each = jnp.broadcast_to(truth[..., None], apart.shape)
        total += MARGINAL * optax.sigmoid_binary_cross_entropy(-apart, each).mean()
        for net, (values, unknown) in zip(learning.nets, beyond):
            some = pick[:PICKED] % len(values)
            total += BEYOND * optax.sigmoid_binary_cross_entropy(-net.of_values(values[some]), unknown[some]).mean()
        return total

    def cooled(learning: _Learning) -> _Learning:
        fixed = [eqx.tree_at(lambda n: (n.mean, n.scale), n, (o.mean, o.scale)) for n, o in zip(learning.nets, nets)]
        return _Learning(tuple(fixed), jnp.maximum(1.0, learning.temperature - cooling))

    beyond = [(jnp.asarray(values, jnp.float32), jnp.asarray(unknown, jnp.float32)) for values, unknown in places]
    given = (*data, jnp.asarray(unsafe), jnp.asarray(safe), beyond)
    begun = _Learning(nets, jnp.float32(HOT))
    words = "" if quiet else "barrier, what is dangerous now"
    found = regress(objective, begun, given, 2**31 - 1, key_fit, updates, batch, 2e-3, words, 1e-4, cooled)
    return found.nets


def _standardised(net: CauseNet, cells: Cells) -> CauseNet:
    """The network with mean and deviation of what was visited."""
    centres, _ = cells.known()
    spread = np.maximum(centres.std(0), 1e-6)
    if cells.cause.width > 1 and _alike(centres.std(0)):
        spread = np.full_like(spread, spread.mean())
    statistics = [jnp.asarray(a, jnp.float32) for a in (centres.mean(0), spread)]
    return eqx.tree_at(lambda n: (n.mean, n.scale), net, statistics)


def _alike(spread: np.ndarray) -> bool:
    """Whether entries vary by about as much, as the axes of a place do: then directions are kept."""
    return bool(spread.max() < 2 * spread.min())
