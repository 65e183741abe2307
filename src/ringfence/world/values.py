"""What states, steps and windows are worth, learned from the logs before anything is generated.

Two numbers of a state, regressed on s̃_i and averaged over agents: the team's reward on arriving in it and the
behaviour's discounted return-to-go from it. They steer plans and turn a window into the score that the denoiser is
conditioned on. A third is of a step with its action, r̂(s, a, s'): guards rank and climb by it, since effort is paid.
"""

from __future__ import annotations

import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.nets.mlp import MLP
from ringfence.nets.optim import regress
from ringfence.problem.features import FeatureMap
from ringfence.problem.normalise import varying
from ringfence.types import Array, Key

ROWS = 100_000  # states evaluated at once
STATES = 20_000  # that features are standardised by, or up to twice as many
WIDTH = 128  # units of each of the critic's 2 hidden layers


class Values(eqx.Module):
    """What states and steps are worth to the team; to each agent itself, as it sees them, where it is `alone`."""

    critic: dict[str, Array]  # fit_critic's
    reward: MLP  # r̂(s̃, a, s̃'), standardised as the critic's first target
    discount: float = eqx.field(static=True)
    joint: bool = eqx.field(static=True)  # a body: one look at all of it, with everybody's action
    alone: bool = eqx.field(static=True)  # what every agent earns, from its own view and action

    def of_plan(self, rows: Array, actions: Array) -> Array:
        """Σ_k γ^k r̂(s_k, a_k, s_{k+1}) + γ^K V̂(s_K) of rows (..., K+1, N, D), the present first, and actions
        (..., K, N, A), in the data's units: (...,), or (..., N) of agents that are alone."""
        reward = self.of_steps(rows[..., :-1, :, :], actions, rows[..., 1:, :, :])
        axis = -2 if self.alone else -1
        steps = actions.shape[-3]
        weight = self.discount ** jnp.arange(steps)
        weight = weight[:, None] if self.alone else weight
        return (reward * weight).sum(axis) + self.discount**steps * self.ahead(rows[..., -1, :, :])

    def of_steps(self, before: Array, action: Array, after: Array) -> Array:
        """r̂ (...,) of steps from features (..., N, D) to others with actions (..., N, A), or (..., N) alone."""
        told = self.critic["value"][0]
        out = self.reward(_of_step(self.critic, self.joint, before, action, after))[..., 0]
        return (out if self.alone else out.mean(-1)) * told[1] + told[0]

    def ahead(self, x: Array) -> Array:
        """V̂ of states (..., N, D), likewise."""
        return state_values(self.critic, x, self.alone)[1]

    @property
    def usual(self) -> Array:
        """The deviation of the logs' returns-to-go: the unit that values are compared in."""
        return self.critic["value"][1, 1]


def fit_values(
    arrays: dict[str, Array],
    picked: Array,
    map: FeatureMap,
    key: Key,
    *,
    discount: float,
    updates: int,
    period: int,
    alone: bool = False,
    quiet: bool = True,
) -> Values:
    """Values of a data set's `arrays` (windows.py) by the steps in `picked` (K,); `period` as in `fit_critic`. Agents
    that are `alone` learn what each of them earns, (T, N) rewards and `togo`, the others what the team does, (T,)."""
    kc, kr, kn = jax.random.split(key, 3)
    row = arrays["row"][picked]
    rewards = arrays["rewards"] if alone else arrays["rewards"].mean(1)
    togo, earned = arrays["togo"][picked], rewards[picked]
    # A state that was arrived in by a step and left by another: the critic's two targets. First rows take the reward of
    # their own first step, a fair stand-in.
    before = jnp.maximum(picked - 1, 0)
    first = arrays["row"][picked] == arrays["first_row"][picked]
    arrived = jnp.where(first[:, None] if alone else first, earned, rewards[before])
    weight = map.critic_weight
    x = arrays["features"][row]
    # An episode that ended for good left a state that nothing follows; guards foresee such states, too.
    over = picked[jnp.flatnonzero(arrays["terminated"][picked])]
    seen = jnp.concatenate([x, arrays["features"][arrays["row"][over] + 1]])
    arrived = jnp.concatenate([arrived, rewards[over]])
    togo = jnp.concatenate([togo, jnp.zeros_like(rewards[over])])
    critic = fit_critic(seen, arrived, togo, kc, updates, period=period, weight=weight, quiet=quiet)
    told = critic["value"][0]
    n, d, a = x.shape[1], x.shape[2], arrays["actions"].shape[-1]
    net = MLP(kn, (2 * d + (n if map.joint else 1) * a, WIDTH, WIDTH, 1), linear=True)

    def loss(net: MLP, data, pick: Array) -> Array:
        features, actions, row, earned = data
        inputs = _of_step(critic, map.joint, features[row[pick]], actions[pick], features[row[pick] + 1])
        out = net(inputs)[..., 0]
        goal = (earned[pick] - told[0]) / told[1]
        return (((out if alone else out.mean(-1)) - goal) ** 2).mean()

    data = arrays["features"], arrays["actions"][picked], row, earned
    label = "" if quiet else "rewards, what steps are worth"
    reward = regress(loss, net, data, len(picked), kr, updates, 512, 4e-3, label)
    return Values(critic, reward, discount, map.joint, alone)


def blank_values(map: FeatureMap, action: int, discount: float, alone: bool) -> Values:
    """Values of the right shapes that say nothing."""
    n, d = map.plus.shape
    sizes = (2 * d + (n if map.joint else 1) * action, WIDTH, WIDTH, 1)
    reward = MLP(jax.random.key(0), sizes, linear=True)
    return Values(blank_critic(d), reward, discount, map.joint, alone)


def _of_step(critic: dict[str, Array], joint: bool, before: Array, action: Array, after: Array) -> Array:
    """What the reward network reads, (..., N or 1, 2D + A or N A)."""
    if joint:
        before, after = before[..., :1, :], after[..., :1, :]
        action = action.reshape(*action.shape[:-2], 1, -1)
    x, y = ((z - critic["mean"]) / critic["scale"] for z in (before, after))
    return jnp.concatenate([x, y, action], -1)


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

    features (M, N, D), rewards (M,) of arriving in each row and togo (M,) of the team, told by the mean over agents, or
    (M, N) of each agent, told by itself; 'value' (2, 2) holds mean and deviation of both targets. Adam with cosine
    decay; the loss is the mean squared error of standardised targets. `period`: rows of an episode, which are not to be
    in step with the rows that features are standardised by. `weight` (D): how strongly the standardised entries are
    read.
    """
    targets, each = jnp.stack([rewards, togo], -1), jnp.ndim(rewards) == 2
    flat = targets.reshape(-1, 2)
    value = jnp.stack([flat.mean(0), jnp.maximum(flat.std(0), 1e-6)], -1)
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
        out, goal = net((x - critic["mean"]) / critic["scale"]), (y - value[:, 0]) / value[:, 1]
        return (((out if each else out.mean(-2)) - goal) ** 2).mean()

    data = features, targets
    label = "" if quiet else "critic, what states are worth"
    net = regress(loss, critic["net"], data, len(features), jax.random.fold_in(key, 1), updates, batch, 4e-3, label)
    return critic | {"net": net}


def blank_critic(features: int) -> dict[str, Array]:
    """A critic of the right shapes that says nothing."""
    net = MLP(jax.random.key(0), (features, WIDTH, WIDTH, 2))
    return {"net": net, "mean": jnp.zeros(features), "scale": jnp.ones(features), "value": jnp.ones((2, 2))}


def state_values(critic: dict[str, Array], x: Array, each: bool = False) -> tuple[Array, Array]:
    """(team reward on arriving in a state, return-to-go from it), each (...,), in the data's units; x (..., N, D).
    `each`: (..., N), as every agent tells them."""
    value = critic["value"]
    out = critic["net"]((x - critic["mean"]) / critic["scale"])
    out = (out if each else out.mean(-2)) * value[:, 1] + value[:, 0]
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
