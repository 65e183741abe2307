"""MATD3 (Ackermann et al. 2019): MADDPG with TD3's three repairs, the learner behind the behaviour policies.

Twin critics, delayed actors, smoothed targets. Every agent has its own actor on its own observation; critics see
what everyone sees and does, one pair per agent, or one for a team that shares its reward. The parameters of all
agents are stacked on a leading axis, so one program trains any number of agents.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from ringfence.errors import UserError
from ringfence.types import Array, Key, PyTree


@dataclass(frozen=True)
class MATD3Config:
    """Hyper-parameters of the behaviour learner; the defaults are those of the shipped tiers."""

    hidden: int = 64  # width of both hidden layers of every actor and critic (OMAR's)
    critic_hidden: int | None = None  # of critics, if it is another
    envs: int = 30  # environments stepped side by side; a round is one episode of each
    random_rounds: int = 20  # rounds of uniform actions before the actors take over
    updates: int = 29  # critic updates after every round
    batch: int = 256  # transitions per update
    actor_rate: float = 1e-3  # Adam's step size of the actors
    critic_rate: float = 3e-3  # Adam's step size of the critics
    delay: int = 2  # critic updates per actor update
    discount: float = 0.95  # per step of 0.1 s (OMAR's)
    polyak: float = 0.02  # share of the online parameters that enters the targets per actor update
    noise: float = 0.2  # std of the exploration noise, in units of action
    target_noise: float = 0.2  # std of the noise on the target actors' actions
    target_clip: float = 0.5  # bound on that noise
    reward_scale: float = 0.1  # multiplies the reward before learning, for values of order 10
    logit_penalty: float = 3e-2  # weight of the actors' mean squared output before tanh, which must not saturate
    snapshot_every: int = 5  # rounds between two snapshots of the actors

    def __post_init__(self):
        for field in ("hidden", "envs", "batch", "delay", "snapshot_every"):
            if getattr(self, field) < 1:
                raise UserError(f"MATD3Config {field}={getattr(self, field)} must be at least 1; pass a larger one.")


class Mlp(NamedTuple):
    """Stacked multi-layer perceptrons: layer k is (..., in, out) and (..., 1, out), with any leading axes."""

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]

    def __call__(self, x: Array) -> Array:
        """(..., B, in) -> (..., B, out); the leading axes are those of the parameters."""
        last = len(self.weights) - 1
        for k, (w, b) in enumerate(zip(self.weights, self.biases)):
            x = x @ w + b
            x = x if k == last else jax.nn.relu(x)
        return x


class Learner(NamedTuple):
    """Online and target networks with their moments."""

    actors: Mlp  # (N, ...)
    critics: Mlp  # (2, N, ...), or (2, 1, ...) for a team
    actors_target: Mlp
    critics_target: Mlp
    actors_opt: PyTree
    critics_opt: PyTree


class Transitions(NamedTuple):
    """A batch of single steps."""

    observations: Array  # (B, N, O)
    seen: Array  # (B, F) what critics read beside the actions
    actions: Array  # (B, N, A)
    rewards: Array  # (B, N), or (B, 1) for a team
    terminated: Array  # (B,) bool; the time limit is not an end of the task
    next_observations: Array
    next_seen: Array


def _init_mlp(key: Key, lead: tuple[int, ...], sizes: tuple[int, ...], last: float | None = None) -> Mlp:
    """Uniform in +-1/sqrt(in); `last` bounds the last layer instead, so that actors start near zero action."""
    layers = list(zip(sizes[:-1], sizes[1:]))
    # One draw for all layers: each call of the generator costs more than a second of compilation.
    draw = jax.random.uniform(key, (*lead, sum((n_in + 1) * n_out for n_in, n_out in layers)), minval=-1.0, maxval=1.0)
    weights, biases = [], []
    at = 0
    for k, (n_in, n_out) in enumerate(layers):
        is_last = k == len(layers) - 1
        bound = last if last is not None and is_last else n_in**-0.5
        part = bound * draw[..., at : at + (n_in + 1) * n_out].reshape(*lead, n_in + 1, n_out)
        weights.append(part[..., :-1, :])
        biases.append(part[..., -1:, :])
        at += (n_in + 1) * n_out
    return Mlp(tuple(weights), tuple(biases))


def _optimisers(config: MATD3Config) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    return optax.adam(config.actor_rate), optax.adam(config.critic_rate)


def init(config: MATD3Config, key: Key, n: int, observed: int, seen: int, a: int, team: bool = False) -> Learner:
    """A fresh learner for N agents with O observation, F critic-input and A action entries."""
    key_actors, key_critics = jax.random.split(key)
    actor_opt, critic_opt = _optimisers(config)
    width = config.hidden
    actors = _init_mlp(key_actors, (n,), (observed, width, width, a), last=3e-3)
    width = config.critic_hidden or config.hidden
    critics = _init_mlp(key_critics, (2, 1 if team else n), (seen + n * a, width, width, 1))
    copy = partial(jax.tree.map, jnp.copy)  # the training loop donates its buffers, so targets need their own
    return Learner(actors, critics, copy(actors), copy(critics), actor_opt.init(actors), critic_opt.init(critics))


def act(actors: Mlp, observations: Array) -> Array:
    """(B, N, O) -> (B, N, A)."""
    return jnp.swapaxes(jnp.tanh(actors(jnp.swapaxes(observations, 0, 1))), 0, 1)


def noisy(action: Array, noise: float | Array, key: Key) -> Array:
    return jnp.clip(action + noise * jax.random.normal(key, action.shape), -1.0, 1.0)


def update(config: MATD3Config, learner: Learner, batch: Transitions, improve: Array, key: Key) -> Learner:
    """One critic update and, if `improve`, one update of actors and targets."""
    observations, seen, actions, rewards, terminated, next_observations, next_seen = batch
    actor_opt, critic_opt = _optimisers(config)

    smoothing = config.target_noise * jax.random.normal(key, actions.shape)
    smoothing = jnp.clip(smoothing, -config.target_clip, config.target_clip)
    next_actions = jnp.clip(act(learner.actors_target, next_observations) + smoothing, -1.0, 1.0)
    next_value = value(learner.critics_target, next_seen, next_actions).min(0)  # (N, B)
    # The time limit is not an end of the task, so only true terminations stop the bootstrap.
    target = config.reward_scale * rewards.T + config.discount * jnp.where(terminated, 0.0, next_value)

    def critic_loss(critics: Mlp) -> Array:
        return ((value(critics, seen, actions) - target) ** 2).mean(-1).sum()

    grads = jax.grad(critic_loss)(learner.critics)
    steps, critics_opt = critic_opt.update(grads, learner.critics_opt)
    critics = optax.apply_updates(learner.critics, steps)
    learner = learner._replace(critics=critics, critics_opt=critics_opt)

    def actor_loss(actors: Mlp) -> Array:
        logits = jnp.swapaxes(actors(jnp.swapaxes(observations, 0, 1)), 0, 1)
        own = jnp.tanh(logits)  # (B, N, A)
        mine = jnp.eye(actions.shape[1], dtype=bool)[:, None, :, None]
        joint = jnp.where(mine, own, actions)  # (N, B, N, A): row i has agent i's own action, the others' as stored
        first = jax.tree.map(lambda x: x[0], critics)
        # A sum over agents: the gradient of each agent's parameters is that of its own loss.
        return (config.logit_penalty * (logits**2).mean((0, 2)) - value(first, seen, joint).mean(-1)).sum()

    def better(learner: Learner) -> Learner:
        steps, actors_opt = actor_opt.update(jax.grad(actor_loss)(learner.actors), learner.actors_opt)
        actors = optax.apply_updates(learner.actors, steps)
        follow = partial(optax.incremental_update, step_size=config.polyak)
        return learner._replace(
            actors=actors,
            actors_opt=actors_opt,
            actors_target=follow(actors, learner.actors_target),
            critics_target=follow(learner.critics, learner.critics_target),
        )

    return jax.lax.cond(improve, better, lambda learner: learner, learner)


def value(critics: Mlp, seen: Array, actions: Array) -> Array:
    """Critic inputs (B, F) and actions (B, N, A), or (N, B, N, A) with one per critic -> (..., N, B)."""
    flat = actions.reshape(*actions.shape[:-2], -1)
    inputs = jnp.concatenate([jnp.broadcast_to(seen, (*flat.shape[:-1], seen.shape[-1])), flat], -1)
    return critics(inputs)[..., 0]
