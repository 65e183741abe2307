"""A policy played in the World of the logs, from logged starts: return and danger where there is no simulator.

Policies read observations and states, a World predicts features of them. Both are indices and differences of the same
entries, so observations follow from features by a linear map, which is fitted to the logs and must be exact there.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.evaluation.ope.logs import Logs
from ringfence.evaluation.ope.result import Mean, ModelRollout
from ringfence.guards import BarrierSource
from ringfence.problem import normalise
from ringfence.problem.normalise import varying
from ringfence.types import Array, Key
from ringfence.utils.precision import on_device
from ringfence.world import World

EXACT = 0.01  # deviations by which an entry may be missed, root mean square
ROWS = 4000  # logged states that the observer is fitted to, and as many that it is tried on


class Observer(eqx.Module):
    """Observations (..., N, O) and the state (..., S) of features (..., N, D): linear, one map per agent."""

    of_agents: Array  # (N, D + 1, O)
    of_state: Array | None  # (N D + 1, S)

    def __call__(self, x: Array) -> tuple[Array, Array | None]:
        one = jnp.ones((*x.shape[:-1], 1))
        seen = jnp.einsum("...nd,ndo->...no", jnp.concatenate([x, one], -1), self.of_agents)
        if self.of_state is None:
            return seen, None
        flat = jnp.concatenate([x.reshape(*x.shape[:-2], -1), one[..., 0, :]], -1)
        return seen, flat @ self.of_state


def observer(logs: Logs, reads_state: bool, rng: np.random.Generator) -> Observer | None:
    """The observer that fits these logs; None where features do not hold what the policy reads."""
    store = logs.store
    rows = rng.permutation(len(logs.x))[: 2 * ROWS]
    x = np.asarray(logs.x[rows], np.float64)
    of_agents = []
    for agent in range(x.shape[1]):
        weights = _linear(x[:, agent], store.observations[rows, agent])
        if weights is None:
            return None
        of_agents.append(weights)
    of_state = None
    if reads_state and store.state is not None:
        weights = _linear(x.reshape(len(rows), -1), store.state[rows])
        if weights is None:
            return None
        of_state = on_device(weights, np.float32)
    return Observer(on_device(np.stack(of_agents), np.float32), of_state)


def _linear(x: np.ndarray, y: np.ndarray) -> np.ndarray | None:
    """(D + 1, O) such that [x, 1] W is y (rows, O); None where it is not."""
    half = len(x) // 2
    mean = x.mean(0)
    scale = varying(x.std(0), mean)
    z = np.concatenate([(x - mean) / scale, np.ones((len(x), 1))], 1)
    y = np.asarray(y, np.float64)
    weights = np.linalg.lstsq(z[:half], y[:half], rcond=1e-9)[0]
    missed = np.sqrt(((z[half:] @ weights - y[half:]) ** 2).mean(0))
    if (missed > EXACT * varying(y.std(0), y.mean(0))).any():
        return None
    slope = weights[:-1] / scale[:, None]
    return np.concatenate([slope, weights[-1:] - mean @ slope])


def rollout(
    policy: Any, logs: Logs, world: World, reads_state: bool, key: Key, episodes: int, steps: int
) -> ModelRollout | None:
    """`episodes` episodes in the World, of `steps` steps or as many as the logged one that begins there has, by
    every member of the ensemble; None where features do not tell what the policy reads."""
    rng = np.random.default_rng(int(jax.random.bits(key)))
    observe = observer(logs, reads_state, rng)
    if observe is None:
        return None
    which = rng.permutation(logs.episodes)[:episodes]
    steps = int(min(steps, logs.store.lengths[which].max()))
    barrier = BarrierSource(world, "learned", None, False) if world.barrier is not None else None
    starts = logs.x[logs.starts[which]]
    play = jax.jit(_play, static_argnames="steps")
    played = []
    for member in range(world.dynamics.size):
        member_key = jax.random.fold_in(key, member)
        played.append(play(policy, observe, world, barrier, starts, jnp.asarray(member), member_key, steps=steps))
    earned, unsafe, ood = (np.stack([np.asarray(of_member[k]) for of_member in played]) for k in range(3))
    # As long as the episode that began there was logged: who goes on for longer would earn more by that alone.
    there = np.arange(steps)[:, None] < logs.store.lengths[which]
    earned = earned * there
    unsafe = unsafe & there
    ood = ood & there
    returns_of_logs, unsafe_of_logs = _of_logs(logs, which, steps, barrier)
    return ModelRollout(
        episodes=len(which),
        steps=steps,
        returns=Mean.of_samples(earned.sum(1).mean(-1)),
        returns_of_logs=returns_of_logs,
        unsafe_steps=None if barrier is None else Mean.of_samples(unsafe.sum(1).mean(-1)),
        unsafe_steps_of_logs=unsafe_of_logs,
        violation_rate=None if barrier is None else float(unsafe.any(1).mean()),
        ood_rate=float(ood.sum() / (len(played) * there.sum())),
    )


def _play(
    policy: Any,
    observe: Observer,
    world: World,
    barrier: BarrierSource | None,
    starts: Array,
    member: Array,
    key: Key,
    *,
    steps: int,
) -> tuple[Array, Array, Array]:
    """(steps, episodes) each: what is earned, whether a step is unsafe, whether it leaves the logs' distribution."""
    spec = world.spec

    def step(before, key: Key):
        carry, x = before
        carry, decided = policy.act(carry, *observe(x), key)
        action = normalise.to_unit(decided.action, spec.action_low, spec.action_high)
        change = world.dynamics.changes(x, action)
        after = world.dynamics.arrived(x, change[member])
        spread = jnp.broadcast_to(jnp.sqrt((change.var(0)).mean(-1) + 1e-12), after.shape[:-1])
        earned = world.values.of_steps(x, action, after)
        earned = earned if earned.ndim == 1 else earned.mean(-1)
        unsafe = _unsafe(barrier, x[:, None], after[:, None], spread[:, None])[:, 0]
        return (carry, after), (earned, unsafe, (spread > world.ood_threshold).any(-1))

    _, kept = jax.lax.scan(step, (policy.initial_state(len(starts)), starts), jax.random.split(key, steps))
    return kept


def _of_logs(logs: Logs, which: np.ndarray, steps: int, barrier: BarrierSource | None) -> tuple[float, float | None]:
    """Return and unsafe steps of the first `steps` steps of logged episodes."""
    first = logs.step_of_start[which]
    at = first[:, None] + np.arange(steps)
    there = at <= logs.last_step[first][:, None]
    at = np.where(there, at, 0)
    earned = float((logs.rewards[at] * there).sum(1).mean())
    if barrier is None:
        return earned, None
    before = logs.x[logs.row[at]][:, :, None]
    after = logs.x[logs.row[at] + 1][:, :, None]
    unsafe = jax.jit(_unsafe)(barrier, before, after, jnp.zeros((*at.shape, 1, 1)))[..., 0]
    return earned, float((np.asarray(unsafe) & there).sum(1).mean())


def _unsafe(barrier: BarrierSource | None, before: Array, after: Array, spread: Array) -> Array:
    """(..., 1) bool of single steps from features (..., 1, N, D): somebody's margin is below 0."""
    if barrier is None:
        return jnp.zeros(before.shape[:-2], bool)
    rows = jnp.concatenate([before, after], -3)
    return (barrier.along(rows, spread) < 0).any((-2, -1))
