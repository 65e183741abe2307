"""A policy behind faults: it observes what arrives, and what it sends is not what is done.

Faults lie between a policy and whatever it acts on, so that every simulator here has them, whether it runs in JAX or
not. A policy may hear of them: by `observe_age(carry, age)` how many steps old its observations (B, N) are,
by `observe_sent(carry, action)` what was sent of its action (B, N, A).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError
from ringfence.faults import Faults
from ringfence.types import Array, Bound, Key, ObservesDelay, Policy, PolicyStep, PyTree, with_cost

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
        late = self.faults.delay + self.faults.jitter
        found = {}
        if self.faults.jitter:
            found["due"] = jnp.full((batch, late, n), -1, jnp.int32)  # steps until these arrive
            found["done"] = nothing
        if self.faults.bias:
            found["bias"] = jnp.zeros((batch, n, o))
            found["state_bias"] = jnp.zeros((batch, s))
        if self.faults.spread:
            found["gain"] = jnp.ones((batch, n, 1))
        if self.faults.stop:
            found["stopped"] = jnp.zeros((batch, n), bool)
        return found | {
            "inner": self.policy.initial_state(batch),
            "queue": jnp.repeat(nothing[:, None], late, 1),  # the oldest first
            "sent": nothing,
            "observations": jnp.zeros((batch, n, o)),
            "state": jnp.zeros((batch, s)),
            "age": jnp.zeros((batch, n), jnp.int32),
            "state_age": jnp.zeros(batch, jnp.int32),
            "step": jnp.zeros((), jnp.int32),
        }

    def act(self, carry: PyTree, observations: Any, state: Any, key: Key) -> tuple[PyTree, PolicyStep]:
        outside = isinstance(observations, np.ndarray)  # of JAX: so is what a foreign policy is given
        carry = self._drawn(carry, jax.random.fold_in(key, OWN_KEY + 1))
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
        carry, done = self._executed({**carry, "inner": inner, "sent": sent}, jax.random.fold_in(key, OWN_KEY + 2))
        return {**carry, "step": carry["step"] + 1}, step._replace(action=done)

    def _drawn(self, carry: PyTree, key: Key) -> PyTree:
        """The carry with what is drawn once for an episode, at its first step."""
        key_bias, key_state, key_gain = jax.random.split(key, 3)
        first = carry["step"] == 0
        noisy, noisy_state = (np.array(entries) for entries in self.noisy)
        found = {}
        if self.faults.bias:
            bias = self.faults.bias * noisy * jax.random.normal(key_bias, carry["bias"].shape)
            found["bias"] = jnp.where(first, bias, carry["bias"])
            bias = self.faults.bias * noisy_state * jax.random.normal(key_state, carry["state_bias"].shape)
            found["state_bias"] = jnp.where(first, bias, carry["state_bias"])
        if self.faults.spread:
            spread = self.faults.spread
            gain = jax.random.uniform(key_gain, carry["gain"].shape, minval=1 - spread, maxval=1 + spread)
            found["gain"] = jnp.where(first, gain, carry["gain"])
        return {**carry, **found}

    def _executed(self, carry: PyTree, key: Key) -> tuple[PyTree, Array]:
        """(carry, what is done now (B, N, A)) of what was sent now and before."""
        key_due, key_stop = jax.random.split(key)
        queue = jnp.concatenate([carry["queue"], carry["sent"][:, None]], 1)
        found = {"queue": queue[:, 1:]}
        done = queue[:, 0]
        if self.faults.jitter:
            late = self.faults.delay + jax.random.randint(
                key_due, carry["due"].shape[::2], 0, self.faults.jitter + 1
            )  # (B, N)
            due = jnp.concatenate([carry["due"], late[:, None]], 1)
            # the newest that has arrived; what was sent before it is overtaken
            newest = jnp.where(due == 0, jnp.arange(due.shape[1])[:, None], -1).max(1)
            arrived = jnp.take_along_axis(queue, jnp.maximum(newest, 0)[:, None, :, None], 1)[:, 0]
            done = jnp.where((newest >= 0)[..., None], arrived, carry["done"])
            overtaken = jnp.arange(due.shape[1])[:, None] <= newest[:, None]
            due = jnp.where(overtaken, -1, jnp.maximum(due - 1, -1))
            found |= {"due": due[:, 1:], "done": done}
        if self.faults.stop:
            now = jax.random.uniform(key_stop, carry["stopped"].shape) < self.faults.stop
            found["stopped"] = carry["stopped"] | now
            done = jnp.where(found["stopped"][..., None], jnp.clip(0.0, self.low, self.high), done)
        gain = self.faults.gain * (carry["gain"] if self.faults.spread else 1.0)
        return {**carry, **found}, jnp.clip(gain * done, self.low, self.high)

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
        if self.faults.bias:
            fresh = fresh + carry["bias"]
        found = {
            "observations": jnp.where(lost[..., None], carry["observations"], fresh),
            "age": jnp.where(lost, carry["age"] + 1, 0),
        }
        if state is not None:
            lost = ~first & (jax.random.uniform(key_state_lost, carry["state_age"].shape) < self.faults.drop)
            fresh = self._measured(state, noisy_state, key_state)
            if self.faults.bias:
                fresh = fresh + carry["state_bias"]
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
    env = task.simulator
    names = tuple(getattr(env, "observation_names", ())) or ("",) * env.observation_dim
    bounds = (task.action_low, task.action_high)
    return behind(
        policy, faults, env.n_agents, env.action_dim, names, tuple(env.state_names), bounds, env.episode_length
    )


def behind(
    policy: Policy,
    faults: Faults,
    agents: int,
    actions: int,
    observation_names: tuple[str, ...],
    state_names: tuple[str, ...],
    bounds: tuple[Bound | np.ndarray, Bound | np.ndarray],
    steps: int,
) -> Policy:
    """The policy of a team behind faults, by what it observes (names may be empty) and does; `steps` of an episode.
    Itself where there are no faults."""
    if not faults.given:
        return policy
    if faults.delay + faults.jitter >= steps:
        name = f"delay={faults.delay}" + (f" and jitter={faults.jitter}" if faults.jitter else "")
        raise UserError(
            f"{name} steps is no less than an episode of {steps}, in which nothing would be done; give a shorter one."
        )
    shape = (agents, len(observation_names), len(state_names), actions)
    seen, whole = (tuple(not name.endswith(EXACT) for name in names) for names in (observation_names, state_names))
    low, high = (jnp.asarray(bound, jnp.float32) for bound in bounds)
    return Faulty(policy, low, high, faults, shape, (seen, whole))
