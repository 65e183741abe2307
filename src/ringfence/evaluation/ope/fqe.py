"""What a policy is worth by fitted Q evaluation (Le et al. 2019, Batch Policy Learning under Constraints)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.evaluation.ope.logs import Logs
from ringfence.evaluation.ope.result import UNKNOWN, Mean, Values
from ringfence.nets.layers import MLP
from ringfence.nets.optim import regress
from ringfence.problem.normalise import varying
from ringfence.types import Array, Key
from ringfence.utils.precision import on_device

WIDTH = 64  # units of each of the 2 hidden layers
BEYOND = 0.5  # of the range that values can have: estimates further outside have diverged
SLOW = 0.05  # rate at which the copy that targets are read from follows


@dataclass(frozen=True)
class FQE:
    """Settings of fitted Q evaluation."""

    discount: float = 0.95
    num_ensemble: int = 5  # networks, each on episodes drawn with replacement
    updates: int = 3000


class Q(eqx.Module):
    """Q of the team, the mean over agents of networks that read an agent's view and action (of a body: everybody's);
    two outputs, return and cost."""

    net: MLP
    joint: bool = eqx.field(static=True)

    def __call__(self, x: Array, action: Array) -> Array:
        if self.joint:
            x = x[..., :1, :]
            action = action.reshape(*action.shape[:-2], 1, -1)
        return self.net(jnp.concatenate([x, action], -1)).mean(-2)


class Steps(NamedTuple):
    """Logged steps as Q learns from them; M members of the ensemble."""

    x: Array  # (T, N, D), standardised
    action: Array  # (T, N, A) logged
    next_x: Array  # (T, N, D)
    next_action: Array  # (T, N, A) of the policy that is evaluated
    earned: Array  # (T, 2) return and cost, standardised, times 1 − γ so that Q is of the order of 1
    goes_on: Array  # (T,) 0 where the task itself ended
    weight: Array  # (T, M) how often a member drew the step's episode


def fitted_q(
    logs: Logs,
    steps: np.ndarray,
    next_actions: np.ndarray,
    starts: np.ndarray,
    first_actions: np.ndarray,
    settings: FQE,
    key: Key,
    label: str = "",
) -> Values:
    """Discounted return and cost of a policy: y = r + γ Q̄(s', a'), where a' is what the policy does in s', and Q̄
    follows slowly.

    steps (T,): logged steps that Q learns from, with the policy's `next_actions` (T, N, A) in the states that they lead
    to; starts (S,): rows of first states, with its `first_actions` (S, N, A). Intervals are Student's over the
    ensemble. Progress is shown under a `label`."""
    net_key, weight_key, fit_key = jax.random.split(key, 3)
    x = np.asarray(logs.x)
    flat = x[logs.row[steps]].reshape(-1, x.shape[-1]).astype(np.float64)
    location = flat.mean(0)
    scale = varying(flat.std(0), location)

    def view(rows: np.ndarray) -> Array:
        return on_device((x[rows] - location) / scale, np.float32)

    earned = np.stack([logs.rewards[steps], logs.costs[steps]], -1).astype(np.float64)
    mean = earned.mean(0)
    deviation = np.maximum(earned.std(0), 1e-6)
    data = Steps(
        x=view(logs.row[steps]),
        action=on_device(logs.actions[steps]),
        next_x=view(logs.row[steps] + 1),
        next_action=on_device(next_actions),
        earned=on_device((earned - mean) / deviation * (1 - settings.discount), np.float32),
        goes_on=on_device(~logs.terminated[steps], np.float32),
        weight=on_device(_bootstrap(logs.episode[steps], settings.num_ensemble, weight_key), np.float32),
    )
    nets = _networks(data, logs.joint, settings.num_ensemble, net_key)
    # What ends for good earns nothing more, and nothing is −mean in these units.
    fast = _fitted(nets, data, on_device(-mean / deviation, np.float32), settings, fit_key, label)
    at_starts = jax.jit(lambda nets, x, action: jax.vmap(lambda q: q(x, action).mean(0))(nets))
    found = np.asarray(at_starts(fast, view(starts), first_actions), np.float64)  # (M, 2)
    found = (found * deviation + mean) / (1 - settings.discount)
    returns, costs = (_bounded(found[:, k], earned[:, k] / (1 - settings.discount)) for k in range(2))
    return Values(returns, costs)


def _bounded(found: np.ndarray, always: np.ndarray) -> Mean:
    """The estimate, or that there is none: a sum of discounted steps lies between always earning the least that was
    logged, or nothing, and always the most; an ensemble that leaves that by far has diverged."""
    low = min(float(always.min()), 0.0)
    high = max(float(always.max()), 0.0)
    slack = BEYOND * (high - low)
    if not (np.isfinite(found).all() and low - slack <= found.mean() <= high + slack):
        return UNKNOWN
    return Mean.of_bootstrap(found)


def _bootstrap(episode_of_step: np.ndarray, num_ensemble: int, key: Key) -> np.ndarray:
    """(T, M): how often each member drew the episode of a step."""
    episodes, which = np.unique(episode_of_step, return_inverse=True)
    rng = np.random.default_rng(int(jax.random.bits(key)))
    return rng.poisson(1.0, (len(episodes), num_ensemble))[which]


def _networks(data: Steps, joint: bool, num_ensemble: int, key: Key) -> Q:
    agents, actions = data.next_action.shape[1:]
    sizes = (data.x.shape[-1] + (agents * actions if joint else actions), WIDTH, WIDTH, 2)
    return jax.vmap(lambda k: Q(MLP(k, sizes, linear=True), joint))(jax.random.split(key, num_ensemble))


def _fitted(nets: Q, data: Steps, nothing: Array, settings: FQE, key: Key, label: str) -> Q:
    """The ensemble after training; `nothing` (2,) is what is earned where nothing is."""

    def loss(both: tuple[Q, Q], data: Steps, pick: Array) -> Array:
        fast, slow = both
        some = Steps(*(rows[pick] for rows in data))
        q = jax.vmap(lambda net: net(some.x, some.action))(fast)  # (M, batch, 2)
        ahead = jax.lax.stop_gradient(jax.vmap(lambda net: net(some.next_x, some.next_action))(slow))
        target = some.earned + settings.discount * jnp.where(some.goes_on[:, None] > 0, ahead, nothing)
        return (some.weight.T[..., None] * (q - target) ** 2).mean()

    def follow(both: tuple[Q, Q]) -> tuple[Q, Q]:
        fast, slow = both
        return fast, jax.tree.map(lambda f, s: s + SLOW * (f - s), fast, slow)

    return regress(loss, (nets, nets), data, len(data.x), key, settings.updates, 256, 1e-3, label, after=follow)[0]
