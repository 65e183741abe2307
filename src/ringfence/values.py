"""What states and windows are worth, learned from the logs before anything is generated.

Two numbers of a state, regressed on s̃_i and averaged over agents: the team's reward on arriving in it and the
behaviour's discounted return-to-go from it. They rank plans at run time, and they turn a window into the score that
the denoiser is conditioned on.
"""

from __future__ import annotations

import itertools
import math
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtri
from scipy.stats import rankdata

from ringfence.nets.mlp import MLP
from ringfence.normalise import varying
from ringfence.optim import regress
from ringfence.types import Array, Key

Condition = Literal["advantage", "return"]
ROWS = 100_000  # states evaluated at once
STATES = 20_000  # that features are standardised by, or up to twice as many
WIDTH = 128  # units of each of the critic's 2 hidden layers


def fit_critic(
    features: Array,
    rewards: Array,
    togo: Array,
    key: Key,
    updates: int = 8000,
    batch: int = 512,
    period: int = 1,
    weight: tuple[float, ...] | None = None,
    quiet: bool = True,
) -> dict[str, Array]:
    """{'net', 'mean', 'scale', 'value'}: regression of (reward on arrival, return-to-go) on states.

    features (M, N, D), rewards (M,) of arriving in each row, togo (M,); 'value' (2, 2) holds mean and deviation of
    both targets. Adam with cosine decay; the loss is the mean squared error of standardised targets. `period`: rows of
    an episode, which are not to be in step with the rows that features are standardised by. `weight` (D): how strongly
    the standardised entries are read.
    """
    targets = jnp.stack([rewards, togo], -1)
    value = jnp.stack([targets.mean(0), jnp.maximum(targets.std(0), 1e-6)], -1)
    # Some states, with every agent's view of them. A stride in step with the episodes would see the same few moments
    # of all of them, e.g. the start, where everybody rests.
    stride = next(n for n in itertools.count(max(1, len(features) // STATES)) if math.gcd(n, period) == 1)
    some = features[::stride]
    flat = np.asarray(some.reshape(-1, features.shape[-1]), np.float64)
    mean = flat.mean(0)
    with np.errstate(divide="ignore"):  # what has no weight is not read
        scale = varying(flat.std(0), mean) / (1.0 if weight is None else np.asarray(weight))
    critic = {
        "net": MLP(key, (features.shape[-1], WIDTH, WIDTH, 2)),
        "mean": jnp.asarray(mean, jnp.float32),
        "scale": jnp.asarray(scale, jnp.float32),
        "value": value,
    }

    def loss(net: MLP, data: tuple[Array, Array], rows: Array) -> Array:
        x, y = data[0][rows], data[1][rows]
        out = net((x - critic["mean"]) / critic["scale"]).mean(-2)
        return ((out - (y - value[:, 0]) / value[:, 1]) ** 2).mean()

    data = features, targets
    label = "" if quiet else "critic, what states are worth"
    net = regress(loss, critic["net"], data, len(features), jax.random.fold_in(key, 1), updates, batch, 4e-3, label)
    return critic | {"net": net}


def blank_critic(features: int) -> dict[str, Array]:
    """A critic of the right shapes that says nothing."""
    net = MLP(jax.random.key(0), (features, WIDTH, WIDTH, 2))
    return {"net": net, "mean": jnp.zeros(features), "scale": jnp.ones(features), "value": jnp.ones((2, 2))}


def state_values(critic: dict[str, Array], x: Array) -> tuple[Array, Array]:
    """(team reward on arriving in a state, return-to-go from it), each (...,), in the data's units; x (..., N, D)."""
    value = critic["value"]
    out = critic["net"]((x - critic["mean"]) / critic["scale"]).mean(-2) * value[:, 1] + value[:, 0]
    return out[..., 0], out[..., 1]


def values_of(critic: dict[str, Array], features: Array) -> np.ndarray:
    """V̂ (M,) of every row (M, N, D), in pieces of bounded memory."""
    value = jax.jit(lambda critic, x: state_values(critic, x)[1])
    parts = [np.asarray(value(critic, features[i : i + ROWS])) for i in range(0, len(features), ROWS)]
    return np.concatenate(parts)


def plan_value(critic: dict[str, Array], rows: Array, discount: float) -> Array:
    """Σ_{h<H} γ^h r̂(row_h) + γ^H V̂(row_{H−1}) of plans (..., H, N, D) without their present row, in data units."""
    reward, togo = state_values(critic, rows)
    weight = discount ** jnp.arange(reward.shape[-1])
    return (reward * weight).sum(-1) + weight[-1] * discount * togo[..., -1]


def advantages(
    value: np.ndarray, team: np.ndarray, row: np.ndarray, last: np.ndarray, horizon: int, discount: float
) -> np.ndarray:
    """(T,) how much better than expected the next H−1 steps went:

        A_t = Σ_{h<n} γ^h r_{t+h} + γ^n V̂(s_{t+n}) − V̂(s_t),   n = min(H − 1, steps left),

    with V̂ = 0 at the end of an episode. value (M,) of rows, team reward (T,), row and last row (T,) of every step.
    Unlike the return-to-go, which mostly says how good the state already is, it is about the window itself.
    """
    steps = np.arange(len(team))
    total = np.zeros(len(team))
    left = last - row
    for h in range(horizon - 1):
        inside = left > h
        total[inside] += discount**h * team[steps[inside] + h]
    n = np.minimum(horizon - 1, left)
    tail = np.where(left > horizon - 1, value[row + n], 0.0)
    return total + discount**n * tail - value[row]


def normal_scores(x: np.ndarray) -> np.ndarray:
    """Φ⁻¹ of the rank: a scale that is the same for every data set; +2 is the best 2.3 %."""
    return ndtri((rankdata(x) - 0.5) / len(x))
