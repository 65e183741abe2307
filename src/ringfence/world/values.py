"""What states, steps and windows are worth, learned from the logs before anything is generated.

Two numbers of a state are regressed on s̃_i and averaged over agents: the team's reward on arriving in it, and the
behaviour's discounted return-to-go from it. They steer plans and turn a window into the score that the denoiser is
conditioned on. A third is of a step with its action, r̂(s, a, s'). Guards rank and climb by it, since effort is paid.
"""

from __future__ import annotations

import itertools
import math
from typing import TypedDict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.nets.layers import MLP
from ringfence.nets.optim import regress
from ringfence.problem.features import FeatureMap
from ringfence.problem.homogeneous import team_mean
from ringfence.problem.normalise import varying
from ringfence.types import Array, Key
from ringfence.utils.precision import on_device
from ringfence.world.settings import Settings

ROWS = 100_000  # states evaluated at once
STATES = 20_000  # that features are standardised by, or up to twice as many
BATCH = 64  # states or steps that a step of the optimiser reads
STEPS = 2  # such steps in an update: what can be climbed is a matter of how many there are, not of what each reads
WIDTH = 128  # units of each of the critic's 2 hidden layers


class Critic(TypedDict):
    """A regression of (reward on arrival, return-to-go) on states, as `fit_critic` makes it."""

    net: MLP
    mean: Array  # (D,) of the features
    scale: Array  # (D,)
    value: Array  # (2, 2) mean and deviation of both targets


class Values(eqx.Module):
    """What states and steps are worth to the team; to each agent itself, as it sees them, where it is `alone`."""

    critic: Critic
    reward: MLP  # r̂(s̃, a, s̃'), standardised as the critic's first target
    discount: float = eqx.field(static=True)
    joint: bool = eqx.field(static=True)  # a body: all of it is read at once, with everybody's action
    alone: bool = eqx.field(static=True)  # what every agent earns, from its own view and action

    def of_plan(self, rows: Array, actions: Array) -> Array:
        """Σ_k γ^k r̂(s_k, a_k, s_{k+1}) + γ^K V̂(s_K) of rows (..., K+1, N, D), the present first, and actions
        (..., K, N, A), in the data's units: (...,), or (..., N) of agents that are alone."""
        reward = self.of_steps(rows[..., :-1, :, :], actions, rows[..., 1:, :, :])
        steps = actions.shape[-3]
        weight = self.discount ** jnp.arange(steps)
        if self.alone:
            weight = weight[:, None]
        return (reward * weight).sum(-weight.ndim) + self.discount**steps * self.ahead(rows[..., -1, :, :])

    def of_steps(self, before: Array, action: Array, after: Array) -> Array:
        """r̂ (...,) of steps from features (..., N, D) to others with actions (..., N, A), or (..., N) alone."""
        mean, scale = self.critic["value"][0]
        out = self.reward(_of_step(self.critic, self.joint, before, action, after))[..., 0]
        return team_mean(out, self.alone) * scale + mean

    def ahead(self, x: Array) -> Array:
        """V̂ of states (..., N, D), likewise."""
        return state_values(self.critic, x, self.alone)[1]

    @property
    def value_std(self) -> Array:
        """The deviation of the logs' returns-to-go: the unit that values are compared in."""
        return self.critic["value"][1, 1]


def fit_values(
    arrays: dict[str, Array], picked: Array, map: FeatureMap, key: Key, settings: Settings, period: int
) -> Values:
    """Values of a data set's `arrays` (windows.py) by the steps in `picked` (K,); `period` as in `fit_critic`. Agents
    that are `alone` learn what each of them earns, (T, N) rewards and `returns_to_go`, the others what the team does,
    (T,)."""
    key_critic, key_reward, key_net = jax.random.split(key, 3)
    alone = settings.alone
    updates = STEPS * settings.value_updates
    rewards = team_mean(arrays["rewards"], alone)
    seen, arrived, returns = _targets(arrays, rewards, picked)
    critic = fit_critic(seen, arrived, returns, key_critic, updates, period=period, weight=map.critic_weight)
    net = _reward_net(key_net, map, arrays["actions"].shape[-1])

    def loss(net: MLP, data: tuple[Array, ...], pick: Array) -> Array:
        features, actions, row, earned = data
        inputs = _of_step(critic, map.joint, features[row[pick]], actions[pick], features[row[pick] + 1])
        out = net(inputs)[..., 0]
        mean, scale = critic["value"][0]
        goal = (earned[pick] - mean) / scale
        return ((team_mean(out, alone) - goal) ** 2).mean()

    some = (np.asarray(x)[np.asarray(picked)] for x in (arrays["actions"], arrays["row"], rewards))  # on the host
    data = arrays["features"], *(on_device(x) for x in some)
    label = "rewards, what steps are worth"
    reward = regress(loss, net, data, len(picked), key_reward, updates, BATCH, 4e-3, label)
    return Values(critic, reward, settings.discount, map.joint, alone)


def _targets(arrays: dict[str, Array], rewards: Array, picked: Array) -> tuple[Array, Array, Array]:
    """States, the reward on arriving in each and the return-to-go from it: the critic's two targets are those of a
    state that was arrived in by a step and left by another. First rows take the reward of their own first step, a fair
    stand-in. An episode that ended for good left a state that nothing follows; guards predict such states, too."""
    steps = np.asarray(picked)
    over = steps[np.asarray(arrays["terminated"])[steps]]
    return _targets_of(arrays, rewards, picked, over)


@jax.jit
def _targets_of(arrays: dict[str, Array], rewards: Array, picked: Array, over: Array) -> tuple[Array, Array, Array]:
    """The same, where `over` are the steps after which nothing follows."""
    x = arrays["features"]
    row = arrays["row"][picked]
    first = row == arrays["first_row"][picked]
    if rewards.ndim == 2:
        first = first[:, None]
    arrived = jnp.where(first, rewards[picked], rewards[jnp.maximum(picked - 1, 0)])
    return (
        jnp.concatenate([x[row], x[arrays["row"][over] + 1]]),
        jnp.concatenate([arrived, rewards[over]]),
        jnp.concatenate([arrays["returns_to_go"][picked], jnp.zeros_like(rewards[over])]),
    )


def _reward_net(key: Key, map: FeatureMap, action: int) -> MLP:
    n, d = map.plus.shape
    return MLP(key, (2 * d + (n if map.joint else 1) * action, WIDTH, WIDTH, 1), linear=True)


def blank_values(map: FeatureMap, action: int, discount: float, alone: bool) -> Values:
    """Values of the right shapes that say nothing."""
    reward = _reward_net(jax.random.key(0), map, action)
    return Values(blank_critic(map.plus.shape[1]), reward, discount, map.joint, alone)


def _of_step(critic: Critic, joint: bool, before: Array, action: Array, after: Array) -> Array:
    """What the reward network reads, (..., N or 1, 2D + A or N A)."""
    if joint:
        before = before[..., :1, :]
        after = after[..., :1, :]
        action = action.reshape(*action.shape[:-2], 1, -1)
    return jnp.concatenate([_standardised(critic, before), _standardised(critic, after), action], -1)


def _standardised(critic: Critic, x: Array) -> Array:
    return (x - critic["mean"]) / critic["scale"]


def fit_critic(
    features: Array,
    rewards: Array,
    returns_to_go: Array,
    key: Key,
    updates: int = 8000,
    batch: int = BATCH,
    period: int = 1,
    weight: tuple[float, ...] | None = None,
) -> Critic:
    """The critic of a data set: features (M, N, D), rewards (M,) of arriving in each row and returns to go (M,) of the
    team, which is the mean over agents; or (M, N) of each agent.

    Adam with cosine decay; the loss is the mean squared error of standardised targets. `period`: rows of an episode,
    which are not to be in step with the rows that features are standardised by. `weight` (D): how strongly the
    standardised entries are read.
    """
    targets = jnp.stack([rewards, returns_to_go], -1)
    each = jnp.ndim(rewards) == 2
    flat = targets.reshape(-1, 2)
    value = jnp.stack([flat.mean(0), jnp.maximum(flat.std(0), 1e-6)], -1)
    mean, scale = _statistics(features, period, weight)
    critic = Critic(net=MLP(key, (features.shape[-1], WIDTH, WIDTH, 2)), mean=mean, scale=scale, value=value)

    def loss(net: MLP, data: tuple[Array, Array], rows: Array) -> Array:
        features, targets = data
        out = net(_standardised(critic, features[rows]))
        goal = (targets[rows] - value[:, 0]) / value[:, 1]
        return (((out if each else out.mean(-2)) - goal) ** 2).mean()

    data = features, targets
    label = "critic, what states are worth"
    critic["net"] = regress(
        loss, critic["net"], data, len(features), jax.random.fold_in(key, 1), updates, batch, 4e-3, label
    )
    return critic


def _statistics(features: Array, period: int, weight: tuple[float, ...] | None) -> tuple[Array, Array]:
    """Mean and scale (D,) of some states, with every agent's view of them. A stride in step with the episodes would see
    the same few moments of all of them, e.g. the start, where everybody rests."""
    strides = itertools.count(max(1, len(features) // STATES))
    some = np.asarray(features)[:: next(stride for stride in strides if math.gcd(stride, period) == 1)]
    flat = some.reshape(-1, features.shape[-1]).astype(np.float64)
    mean = flat.mean(0)
    scale = varying(flat.std(0), mean)
    if weight is not None:
        with np.errstate(divide="ignore"):  # what has no weight is not read
            scale = scale / np.asarray(weight)
    return on_device(mean, np.float32), on_device(scale, np.float32)


def blank_critic(features: int) -> Critic:
    """A critic of the right shapes that says nothing."""
    return Critic(
        net=MLP(jax.random.key(0), (features, WIDTH, WIDTH, 2)),
        mean=jnp.zeros(features),
        scale=jnp.ones(features),
        value=jnp.ones((2, 2)),
    )


def state_values(critic: Critic, x: Array, each: bool = False) -> tuple[Array, Array]:
    """(team reward on arriving in a state, return-to-go from it), each (...,), in the data's units; x (..., N, D).
    `each`: (..., N), of every agent."""
    value = critic["value"]
    out = critic["net"](_standardised(critic, x))
    out = team_mean(out, each, -2) * value[:, 1] + value[:, 0]
    return out[..., 0], out[..., 1]


def values_of(critic: Critic, features: Array) -> np.ndarray:
    """V̂ (M,) of every row (M, N, D), in pieces of bounded memory."""
    parts = [np.asarray(_state_value(critic, features[k : k + ROWS])) for k in range(0, len(features), ROWS)]
    return np.concatenate(parts)


@jax.jit
def _state_value(critic: Critic, x: Array) -> Array:
    return state_values(critic, x)[1]
