"""A policy played in the World of the logs, from logged starts: return and danger where there is no simulator.

Policies read observations and states, a World foresees features of them. Both are indices and differences of the same
entries, so observations follow from features by a linear map, which is fitted to the logs and must be exact there.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import t as student

from ringfence.evaluation.ope.logs import Logs
from ringfence.guards import Danger
from ringfence.logs.store import EpisodeStore
from ringfence.problem import normalise
from ringfence.problem.normalise import varying
from ringfence.types import Array, Key
from ringfence.world import World

EXACT = 0.01  # deviations by which an entry may be missed, root mean square
ROWS = 4000  # logged states that the map back is fitted to, and as many that it is tried on


class Back(eqx.Module):
    """Observations (..., N, O) and the state (..., S) of features (..., N, D): linear, one map per agent."""

    seen: Array  # (N, D + 1, O)
    state: Array | None  # (N D + 1, S)

    def __call__(self, x: Array) -> tuple[Array, Array | None]:
        one = jnp.ones((*x.shape[:-1], 1))
        seen = jnp.einsum("...nd,ndo->...no", jnp.concatenate([x, one], -1), self.seen)
        if self.state is None:
            return seen, None
        flat = jnp.concatenate([x.reshape(*x.shape[:-2], -1), one[..., 0, :]], -1)
        return seen, flat @ self.state


def back(told: Logs, logs: EpisodeStore, needs_state: bool, rng: np.random.Generator) -> Back | None:
    """The way back from features; None where they do not hold what the policy reads."""
    rows = rng.permutation(len(told.x))[: 2 * ROWS]
    x = np.asarray(told.x[rows], np.float64)
    seen = [_linear(x[:, i], logs.observations[rows, i]) for i in range(x.shape[1])]
    state = _linear(x.reshape(len(rows), -1), logs.state[rows]) if needs_state else None
    if any(w is None for w in seen) or (needs_state and state is None):
        return None
    return Back(jnp.asarray(np.stack(seen), jnp.float32), None if state is None else jnp.asarray(state, jnp.float32))


def _linear(x: np.ndarray, y: np.ndarray) -> np.ndarray | None:
    """(D + 1, O) such that [x, 1] W is y (rows, O); None where it is not."""
    half = len(x) // 2
    mean, scale = x.mean(0), varying(x.std(0), x.mean(0))
    z = np.concatenate([(x - mean) / scale, np.ones((len(x), 1))], 1)
    y = np.asarray(y, np.float64)
    weights = np.linalg.lstsq(z[:half], y[:half], rcond=1e-9)[0]
    missed = np.sqrt(((z[half:] @ weights - y[half:]) ** 2).mean(0))
    if (missed > EXACT * varying(y.std(0), y.mean(0))).any():
        return None
    slope = weights[:-1] / scale[:, None]
    return np.concatenate([slope, weights[-1:] - mean @ slope])


def played(
    policy: Any,
    told: Logs,
    logs: EpisodeStore,
    world: World,
    needs_state: bool,
    key: Key,
    episodes: int,
    steps: int,
) -> dict[str, Any] | None:
    """What a policy earns and risks in `episodes` of the World, of `steps` steps or as many as the longest logged
    episode has; None where features do not tell what it reads.

    Every member of the ensemble plays them all, and intervals are Student's over members: what is told is how far the
    forward models agree, not how far they are right. Keys `steps`, `return`, `danger` (steps per episode that the
    World judges dangerous): {mean, low, high}; `episodes_in_danger` and `lost`, the shares of episodes with such a step
    and of steps in which the members are further apart than in the logs; `return_of_logs`, `danger_of_logs`, of the
    logged episodes that begin alike, `danger` by the same judgement.
    """
    rng = np.random.default_rng(int(jax.random.bits(key)))
    way = back(told, logs, needs_state, rng)
    if way is None:
        return None
    which = rng.permutation(logs.episodes)[:episodes]
    steps = int(min(steps, logs.lengths[which].max()))
    danger = Danger(world, "learned", None, False) if world.barrier is not None else None
    spec = world.spec
    members = world.dynamics.size

    @jax.jit
    def play(policy, way: Back, world: World, danger: Danger | None, x: Array, member: Array, key: Key):
        def step(carry, key: Key):
            memory, x = carry
            memory, done = policy.act(memory, *way(x), key)
            action = normalise.to_unit(done.action, spec.action_low, spec.action_high)
            change = world.dynamics.changes(x, action)
            after = world.dynamics.arrived(x, change[member])
            spread = jnp.broadcast_to(jnp.sqrt((change.var(0)).mean(-1) + 1e-12), after.shape[:-1])
            earned = world.values.of_steps(x, action, after)
            earned = earned if earned.ndim == 1 else earned.mean(-1)
            unsafe = _unsafe(danger, x[:, None], after[:, None], spread[:, None])[:, 0]
            return (memory, after), (earned, unsafe, (spread > world.strange).any(-1))

        _, out = jax.lax.scan(step, (policy.start(len(x)), x), jax.random.split(key, steps))
        return out  # (steps, episodes) each

    x = told.x[told.starts[which]]
    found = [play(policy, way, world, danger, x, jnp.asarray(m), jax.random.fold_in(key, m)) for m in range(members)]
    earned, unsafe, lost = (np.stack([np.asarray(f[k]) for f in found]) for k in range(3))
    at = told.step_of_start[which][:, None] + np.arange(steps)
    there = at <= told.last_step[told.step_of_start[which]][:, None]
    at = np.where(there, at, 0)
    of_logs = jax.jit(_unsafe)(
        danger, told.x[told.row[at]][:, :, None], told.x[told.row[at] + 1][:, :, None], jnp.zeros((*at.shape, 1, 1))
    )[..., 0]
    return {
        "episodes": len(which),
        "steps": steps,
        "return": _between(earned.sum(1).mean(-1)),
        "danger": None if danger is None else _between(unsafe.sum(1).mean(-1)),
        "episodes_in_danger": None if danger is None else float(unsafe.any(1).mean()),
        "lost": float(lost.mean()),
        "return_of_logs": float((told.rewards[at] * there).sum(1).mean()),
        "danger_of_logs": None if danger is None else float((np.asarray(of_logs) & there).sum(1).mean()),
    }


def _unsafe(danger: Danger | None, before: Array, after: Array, spread: Array) -> Array:
    """(..., 1) bool of single steps from features (..., 1, N, D): somebody's margin is below 0."""
    if danger is None:
        return jnp.zeros(before.shape[:-2], bool)
    rows = jnp.concatenate([before, after], -3)
    return (danger.along(rows, spread) < 0).any((-2, -1))


def _between(x: np.ndarray) -> dict[str, float]:
    """Mean and Student's 95 % interval of (members,)."""
    half = float(student.ppf(0.975, len(x) - 1) * x.std(ddof=1) / np.sqrt(len(x))) if len(x) > 1 else float("nan")
    return {"mean": float(x.mean()), "low": float(x.mean()) - half, "high": float(x.mean()) + half}
