"""Episodes are played: `rollout` loops over whatever steps outside JAX, `scanned` is that loop within JAX."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.base import Env, Outcome, PureEnv, Seen
from ringfence.types import Array, Key, Policy, PolicyStep, PyTree, Transition, act_with, with_cost
from ringfence.utils import interrupts


class Moment(NamedTuple):
    """A step of B episodes."""

    running: np.ndarray  # (B,) bool: which of them took it
    before: Seen
    decided: PolicyStep
    outcome: Outcome
    after: Seen


Watch = Callable[[Moment], None]


def nobody(now: Moment) -> None:
    """Watches."""


def rollout(policy: Policy, env: Env, watch: Watch, keys: Iterator[Any]) -> None:
    """Play the episodes that have begun in `env` to their end, and show every step to `watch`.

    keys: what the policy draws from, one for each step; where they end, so does the rollout.
    """
    carry = policy.initial_state(len(env.running))
    before = env.observe()
    while env.running.any() and (key := next(keys, None)) is not None:
        interrupts.check()
        running = env.running.copy()
        carry, decided = act_with(policy, carry, *before, key)
        outcome = env.step(np.asarray(decided.action))
        after = env.observe()
        watch(Moment(running, before, decided, outcome, after))
        carry = with_cost(policy, carry, outcome.cost)
        before = after


def scanned(
    env: PureEnv, first: PyTree, choose: Callable[[PyTree, Any], Array], xs: PyTree
) -> tuple[PyTree, Array, Transition]:
    """(states (B, L+1, ...), actions (B, L, N, A), what came of them (B, L, ...)) of episodes from the states `first`,
    under actions `choose(state, x)`, x along the first axis of `xs`."""

    def step(state: PyTree, x: Any) -> tuple[PyTree, tuple[PyTree, Array, Transition]]:
        action = choose(state, x)
        after, transition = env.step(state, action)
        return after, (after, action, transition)

    _, (after, actions, transitions) = jax.lax.scan(step, first, xs)
    states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, after)
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (states, actions, transitions))


@dataclass(frozen=True)
class Memoryless:
    """A function of observations, the state and a key as a policy."""

    function: Callable[[Any, Any, Any], Any]

    def initial_state(self, batch: int) -> PyTree:
        return None

    def act(self, carry: PyTree, observations: Any, state: Any, key: Any) -> tuple[PyTree, PolicyStep]:
        return carry, PolicyStep(self.function(observations, state, key), {})


def split_off(key: Key) -> Iterator[Key]:
    """Keys without end, each split off from what the last one left."""
    while True:
        key, now = jax.random.split(key)
        yield now
