"""What a policy does in logged states, where that leads as a World of the logs predicts it, and what it earns there.

Policies read observations and states, a World predicts features of them. Both are indices and differences of the same
entries, so observations follow from features by a linear map, which is fitted to the logs and must be exact there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.evaluation import statistics
from ringfence.evaluation.ope_result import Behaviour, Mean, ModelRollout, Safety
from ringfence.guards import BarrierSource
from ringfence.guards.policy import Guarded
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData
from ringfence.problem import normalise
from ringfence.problem.normalise import varying
from ringfence.proposals.base import held, in_bounds_of
from ringfence.types import Array, Key, Proposes, PyTree
from ringfence.utils.precision import on_device
from ringfence.world import World

BATCH = 512  # states that a policy is asked in together
CHANGED = 0.05  # of the actions' range of 2: what counts as an intervention
EXACT = 0.01  # deviations by which an entry may be missed, root mean square
ROWS = 4000  # logged states that the observer is fitted to, and as many that it is tried on


class Logs:
    """A store in a World's view: T steps in E episodes, actions in [−1, 1], rewards and costs of the team.

    `x` (T + E, N, D) holds an episode's last state, too, so `row` (T,) says where a step begins.
    """

    def __init__(self, store: EpisodeStore, world: World):
        arrays = WindowData(store, world.map).arrays
        self.store = store
        self.x = arrays["features"]
        self.actions = np.asarray(arrays["actions"])
        self.row = np.arange(store.steps) + store.episode_of_step
        self.rewards = store.rewards.mean(1)
        self.costs = store.team_costs.astype(np.float32)
        self.terminated = store.terminated
        self.episode = store.episode_of_step
        self.step_of_start = np.concatenate([[0], store.episode_ends[:-1]])  # (E,)
        self.starts = self.step_of_start + np.arange(store.episodes)  # (E,) rows
        self.last_step = np.repeat(store.episode_ends - 1, store.lengths)  # of each step's episode
        self.joint = world.map.joint

    @property
    def steps(self) -> int:
        return self.store.steps

    @property
    def episodes(self) -> int:
        return self.store.episodes


@dataclass(frozen=True)
class Responses:
    """What a policy does in M logged states; what only a guard says is None without one."""

    action: np.ndarray  # (M, N, A) in [−1, 1]
    plan: np.ndarray  # (M, K, N, A) that it means to take along what the World predicts
    changed: np.ndarray | None = None  # (M,) bool: the guard changed the action
    infeasible: np.ndarray | None = None  # (M,) bool
    ood: np.ndarray | None = None  # (M,) bool: the guard's World knows nothing there


class Respondent:
    """A policy that is asked in logged states; a World predicts where its plans lead, `ahead` steps."""

    def __init__(self, policy: Any, logs: Logs, world: World, reads_state: bool, ahead: int, seed: int):
        self.policy = policy
        self.logs = logs
        self.world = world
        self.reads_state = reads_state
        self.ahead = ahead
        self.seed = seed
        self._respond = jax.jit(_respond, static_argnames="ahead")

    def __call__(self, rows: np.ndarray) -> Responses:
        """The responses in the states of so many rows (M,)."""
        root = jax.random.key(self.seed)
        parts = []
        for first in range(0, len(rows), BATCH):
            some = np.resize(rows[first : first + BATCH], BATCH)  # one shape, one program
            store = self.logs.store
            seen = on_device(store.observations[some])
            state = on_device(store.state[some]) if self.reads_state and store.state is not None else None
            key = jax.random.fold_in(root, first)
            part = self._respond(self.policy, self.world, seen, state, key, ahead=self.ahead)
            parts.append({name: np.asarray(v)[: len(rows) - first] for name, v in part.items()})
        return Responses(**{name: np.concatenate([p[name] for p in parts]) for name in parts[0]})


def _respond(policy: Any, world: World, seen: Array, state: Array | None, key: Key, *, ahead: int) -> dict[str, Array]:
    """Fields of `Responses`."""
    spec = world.spec
    act_key, plan_key = jax.random.split(key)
    carry, step = policy.act(policy.initial_state(len(seen)), seen, state, act_key)
    action = normalise.to_unit(step.action, spec.action_low, spec.action_high)
    found = {"action": action} | {k: step.info[k] for k in ("infeasible", "ood") if k in step.info}
    if isinstance(policy, Guarded):
        _, wanted, _ = policy.proposed(policy.initial_state(len(seen))["inner"], seen, state, act_key)
        wanted = normalise.in_units_of(world.spec, policy.guard.world.spec, wanted)
        difference = jnp.abs(wanted - action[:, None, None])[:, :, 0].max((-2, -1))
        found["changed"] = difference.min(-1) > CHANGED
    plan = _plan(policy, carry, world, seen, state, action, plan_key, ahead)
    rest = jnp.broadcast_to(plan[:, -1:], (len(seen), ahead, *plan.shape[2:]))
    return found | {"plan": jnp.concatenate([action[:, None], plan[:, 1:], rest], 1)[:, :ahead]}


def _plan(
    policy: Any, carry: PyTree, world: World, seen: Array, state: Array | None, action: Array, key: Key, ahead: int
) -> Array:
    """(B, K, N, A): the guard's plan, else what the policy proposes, else its action held."""
    if isinstance(policy, Guarded):
        return normalise.in_units_of(world.spec, policy.guard.world.spec, carry["last"])
    if isinstance(policy, Proposes):
        own = getattr(policy, "spec", world.spec)
        moved = in_bounds_of(own, world)
        proposed = policy.propose(policy.initial_state(len(seen)), seen, state, key, 1, ahead, moved)[1][:, 0]
        return normalise.in_units_of(world.spec, own, proposed)
    return held(action, ahead)[:, 0]


def behaviour(logs: Logs, steps: np.ndarray, responses: Responses, world: World) -> Behaviour:
    """What was done at logged steps (M,), beside what the logs did."""
    logged = logs.actions[steps]
    done = responses.action
    spread = jax.jit(lambda dynamics, x, action: dynamics.step(x, action)[1].max(-1))
    apart = np.asarray(spread(world.dynamics, logs.x[logs.row[steps]], done))
    rmse = np.sqrt(((done - logged) ** 2).mean())
    return Behaviour(
        intervention_rate=_share(responses.changed),
        infeasible_rate=_share(responses.infeasible),
        guard_ood_rate=_share(responses.ood),
        ood_rate=float((apart > float(world.ood_threshold)).mean()),
        action_rmse=float(rmse / max(float(logged.std()), 1e-6)),
    )


def _share(flags: np.ndarray | None) -> float | None:
    """Of the states (M,) or (M, N) in which somebody's flag is set."""
    if flags is None:
        return None
    return float(flags.any(-1).mean() if flags.ndim > 1 else flags.mean())


def safety(logs: Logs, steps: np.ndarray, responses: Responses, world: World, ahead: int) -> Safety | None:
    """What is predicted at those of the logged steps (M,) that begin safe; None where the World knows no danger."""
    if world.barrier is None:
        return None
    begins = steps == logs.step_of_start[logs.episode[steps]]
    safe = begins | (logs.costs[np.maximum(steps - 1, 0)] == 0)
    later = np.minimum(steps[:, None] + np.arange(ahead), logs.last_step[steps][:, None])
    barrier = BarrierSource(world, "learned", None, False)
    x = logs.x[logs.row[steps]]
    smallest = jax.jit(_smallest_margin)
    of_policy = np.asarray(smallest(barrier, x, responses.plan))[safe]
    of_logs = np.asarray(smallest(barrier, x, logs.actions[later]))[safe]
    episodes = logs.episode[steps][safe]
    asked = len(np.unique(episodes))
    violated = len(np.unique(episodes[of_policy < 1]))
    scores = world.card.barrier
    return Safety(
        predicted_violation_rate=float((of_policy < 0).mean()),
        predicted_violation_rate_of_logs=float((of_logs < 0).mean()),
        margin_violation_rate=float((of_policy < 1).mean()),
        margin_violation_rate_of_logs=float((of_logs < 1).mean()),
        miscoverage=None if scores is None or scores.warning else scores.miscoverage,
        margin_violation_episodes=violated / asked,
        margin_violation_episodes_upper=statistics.upper_bound(violated, asked),
        margins=_quantiles(of_policy),
        margins_of_logs=_quantiles(of_logs),
    )


def _smallest_margin(barrier: BarrierSource, x: Array, plan: Array) -> Array:
    """(M,) over the steps, agents and constraints of plans (M, K, N, A) from states (M, N, D)."""

    def step(x, action):
        after, spread = barrier.world.dynamics.step(x, action)
        return after, (after, spread)

    rows, spread = jax.lax.scan(step, x, jnp.moveaxis(plan, 1, 0))[1]
    rows = jnp.concatenate([x[:, None], jnp.moveaxis(rows, 0, 1)], 1)
    return barrier.along(rows, jnp.moveaxis(spread, 0, 1)).min((1, 2, 3))


def _quantiles(x: np.ndarray) -> tuple[float, ...]:
    return tuple(round(float(v), 3) for v in np.quantile(x, np.linspace(0, 1, 41)))


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


def rollout(ask: Respondent, key: Key, episodes: int, steps: int) -> ModelRollout | None:
    """`episodes` episodes in the World, of `steps` steps or as many as the logged one that begins there has, by
    every member of the ensemble; None where features do not tell what the policy reads."""
    logs, world = ask.logs, ask.world
    rng = np.random.default_rng(int(jax.random.bits(key)))
    observe = observer(logs, ask.reads_state, rng)
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
        played.append(play(ask.policy, observe, world, barrier, starts, jnp.asarray(member), member_key, steps=steps))
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
