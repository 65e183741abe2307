"""A policy behind faults: it observes what arrives, and what it sends is not what is done.

Faults lie between a policy and whatever it acts on, so that every simulator here has them, whether it runs in JAX or
not. A policy that wants to know is told: `observe_age(carry, age)` how many steps old its observations (B, N) are,
`observe_sent(carry, action)` what was sent of its action (B, N, A).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError
from ringfence.faults.faults import Faults
from ringfence.proposals.base import with_cost
from ringfence.types import Array, Key, ObservesDelay, Policy, PolicyStep, PyTree

EXACT = ("seen", "draw")  # entries that are no measurements, by the ends of their names
OWN_KEY = 39  # folded into the policy's key, whose own draws stay what they are without faults


class Faulty(eqx.Module):
    """A policy behind faults, itself a policy (types.Policy)."""

    policy: Any
    low: Array  # of actions, against (N, A)
    high: Array
    faults: Faults = eqx.field(static=True)
    shape: tuple[int, int, int, int] = eqx.field(static=True)  # N, O, S, A
    noisy: tuple[tuple[bool, ...], tuple[bool, ...]] = eqx.field(static=True)  # entries (O,) and (S,)

    def initial_state(self, batch: int) -> PyTree:
        n, o, s, a = self.shape
        nothing = jnp.broadcast_to(jnp.clip(0.0, self.low, self.high), (batch, n, a))
        return {
            "inner": self.policy.initial_state(batch),
            "queue": jnp.repeat(nothing[:, None], self.faults.delay, 1),  # the oldest first
            "sent": nothing,
            "observations": jnp.zeros((batch, n, o)),
            "state": jnp.zeros((batch, s)),
            "age": jnp.zeros((batch, n), jnp.int32),
            "state_age": jnp.zeros(batch, jnp.int32),
            "step": jnp.zeros((), jnp.int32),
        }

    def act(self, carry: PyTree, observations: Any, state: Any, key: Key) -> tuple[PyTree, PolicyStep]:
        outside = isinstance(observations, np.ndarray)  # of JAX: so is what a foreign policy is given
        carry = self._arrived(carry, observations, state, jax.random.fold_in(key, OWN_KEY))
        seen: Any = np.asarray(carry["observations"]) if outside else carry["observations"]
        if state is not None:
            state = np.asarray(carry["state"]) if outside else carry["state"]
        inner = carry["inner"]
        if isinstance(self.policy, ObservesDelay):
            age = carry["age"] if state is None else jnp.maximum(carry["age"], carry["state_age"][:, None])
            inner = self.policy.observe_age(inner, age)
        inner, step = self.policy.act(inner, seen, state, key)
        sent = jnp.where(self._decides(carry["step"]), jnp.asarray(step.action), carry["sent"])
        if isinstance(self.policy, ObservesDelay):
            inner = self.policy.observe_sent(inner, sent)
        queue = jnp.concatenate([carry["queue"], sent[:, None]], 1)
        done = jnp.clip(self.faults.gain * queue[:, 0], self.low, self.high)
        carry = {**carry, "inner": inner, "queue": queue[:, 1:], "sent": sent, "step": carry["step"] + 1}
        return carry, step._replace(action=done)

    def observe_cost(self, carry: PyTree, cost: Any) -> PyTree:
        """What a step cost arrives."""
        return {**carry, "inner": with_cost(self.policy, carry["inner"], cost)}

    def _arrived(self, carry: PyTree, observations: Any, state: Any, key: Key) -> PyTree:
        """The carry with what the policy observes now: measured with noise, or held where it was lost."""
        key_lost, key_noise, key_state_lost, key_state = jax.random.split(key, 4)
        first = carry["step"] == 0
        noisy, noisy_state = self.noisy
        lost = ~first & (jax.random.uniform(key_lost, carry["age"].shape) < self.faults.drop)
        fresh = self._measured(observations, noisy, key_noise)
        found = {
            "observations": jnp.where(lost[..., None], carry["observations"], fresh),
            "age": jnp.where(lost, carry["age"] + 1, 0),
        }
        if state is not None:
            lost = ~first & (jax.random.uniform(key_state_lost, carry["state_age"].shape) < self.faults.drop)
            fresh = self._measured(state, noisy_state, key_state)
            found["state"] = jnp.where(lost[:, None], carry["state"], fresh)
            found["state_age"] = jnp.where(lost, carry["state_age"] + 1, 0)
        return {**carry, **found}

    def _measured(self, x: Any, noisy: Sequence[bool], key: Key) -> Array:
        if not self.faults.noise:
            return jnp.asarray(x)
        return jnp.asarray(x) + self.faults.noise * jax.random.normal(key, x.shape) * np.array(noisy)

    def _decides(self, step: Array) -> Array:
        """(N, 1) whose turn it is: evenly in time, and in a rhythm of its own."""
        n = self.shape[0]
        if not self.faults.asynchrony:
            return jnp.ones((n, 1), bool)
        share = 1.0 - self.faults.asynchrony
        phase = jnp.arange(n) / n
        turns = jnp.floor(step * share + phase + 1e-4)
        return (jnp.floor((step + 1) * share + phase + 1e-4) > turns)[:, None]


def under_faults(policy: Policy, faults: Faults, task: Any) -> Policy:
    """The policy of a task's whole team behind faults; itself where there are none."""
    if not faults.given:
        return policy
    env = task.simulator
    if faults.delay >= env.episode_length:
        raise UserError(
            f"delay={faults.delay} steps is no less than an episode of {env.episode_length}, in which nothing would be "
            "done; give a shorter one."
        )
    states = tuple(env.state_names)
    seen = tuple(getattr(env, "observation_names", ())) or ("",) * env.observation_dim
    shape = (env.n_agents, env.observation_dim, len(states), env.action_dim)
    measured = tuple(tuple(not name.endswith(EXACT) for name in names) for names in (seen, states))
    low, high = (jnp.asarray(bound, jnp.float32) for bound in (task.action_low, task.action_high))
    return Faulty(policy, low, high, faults, shape, (measured[0], measured[1]))
