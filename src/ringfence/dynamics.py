"""What actions do: forward dynamics, learned from the logs before anything is generated. Planners check by it where a
plan really leads, so its errors are what they have to keep in hand.

Fitted once per data set, like the critic (values.py), and long enough to learn contacts: a few thousand updates, which
predict free motion well, predict no kick.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax

from ringfence.nets.mlp import MLP
from ringfence.normalise import varying
from ringfence.optim import regress
from ringfence.types import Array, Key, PyTree

STATES = 20_000  # steps that features and their changes are standardised by
BATCH = 128  # small and often: at equal time it learns contacts that 512 at half the rate does not


def fit_dynamics(
    features: Array,
    actions: Array,
    row: Array,
    key: Key,
    updates: int,
    width: int,
    joint: bool = False,
    quiet: bool = True,
) -> PyTree:
    """g_φi of every agent: {'net', 'mean', 'scale', 'step_mean', 'step_scale'}, statistics (D,) pooled over agents.

    features (M, N, D); actions (T, N, A) of the T steps, each from row `row` (T,) to the next. `joint`: the agents move
    one body, so g reads everybody's action. The loss is Huber's, in standard deviations of the step: it keeps the kicks
    of contacts, which dwarf everything else, from owning the model.
    """
    kn, ks, kf = jax.random.split(key, 3)
    n, d = features.shape[1:]
    some = row[jax.random.randint(ks, (min(STATES, 4 * len(row)),), 0, len(row))]
    before = np.asarray(features[some], np.float64).reshape(-1, d)
    moved = np.asarray(features[some + 1], np.float64).reshape(-1, d) - before
    mean, step_mean = before.mean(0), moved.mean(0)
    scale = varying(before.std(0), mean)
    step_scale = varying(moved.std(0), np.abs(mean) + scale)
    told = {"mean": mean, "scale": scale, "step_mean": step_mean, "step_scale": step_scale}
    frozen = {k: jnp.asarray(v, jnp.float32) for k, v in told.items()}

    def loss(net: MLP, data: tuple[Array, ...], step: Array) -> Array:
        features, actions, row = data
        before, after = features[row[step]], features[row[step] + 1]
        moved = (after - before - frozen["step_mean"]) / frozen["step_scale"]
        return optax.losses.huber_loss(_step(net, frozen, before, actions[step], joint), moved, delta=1.0).mean()

    net = _network(kn, n, d, actions.shape[-1], width, joint)
    label = "" if quiet else "forward dynamics, what actions do"
    return frozen | {"net": regress(loss, net, (features, actions, row), len(row), kf, updates, BATCH, 4e-3, label)}


def blank_dynamics(agents: int, features: int, action: int, width: int, joint: bool = False) -> PyTree:
    """Dynamics of the right shapes that say nothing."""
    one = jnp.ones(features)
    net = _network(jax.random.key(0), agents, features, action, width, joint)
    return {"net": net, "mean": one, "scale": one, "step_mean": one, "step_scale": one}


def foresee(dynamics: PyTree, before: Array, action: Array, joint: bool = False) -> Array:
    """Features (..., N, D) after one step from `before` (..., N, D) with actions (..., N, A)."""
    return (
        before
        + _step(dynamics["net"], dynamics, before, action, joint) * dynamics["step_scale"]
        + dynamics["step_mean"]
    )


def _network(key: Key, agents: int, features: int, action: int, width: int, joint: bool) -> MLP:
    read = features + (agents if joint else 1) * action
    return MLP(key, (read, width, width, features), groups=agents, linear=True)


def _step(net: MLP, frozen: PyTree, before: Array, action: Array, joint: bool) -> Array:
    """The standardised change (..., N, D) that actions bring about."""
    if joint:
        n, a = action.shape[-2:]
        order = (np.arange(n)[:, None] + np.arange(n)) % n  # the own action first
        action = action[..., order, :].reshape(*action.shape[:-1], n * a)
    return net(jnp.concatenate([(before - frozen["mean"]) / frozen["scale"], action], -1))
