"""The evaluation protocol: fixed resets shared by all methods, raw numbers first, unsafe starts apart.

Test resets and validation resets come from disjoint keys; settings are chosen on validation, tables are made on test.
Every episode is counted; `cost_safe_start` is the mean cost of the episodes that start safe. Episodes are played
batched, and compiled where the simulator is.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.datasets.task import Task
from ringfence.envs import base as outside
from ringfence.envs.base import Measured, NativeEnv, PureEnv
from ringfence.errors import UserError, whole_number
from ringfence.evaluation import statistics
from ringfence.faults import Faults
from ringfence.faults.policy import Faulty, under_faults
from ringfence.problem import constraints
from ringfence.problem.homogeneous import local_features
from ringfence.types import Array, Key, Policy, PolicyStep, PyTree, act_with, with_cost
from ringfence.utils.precision import float32, in_float32
from ringfence.utils.progress import Progress

RATES = {  # columns of what is counted in steps
    "infeasible": "infeasible_rate",
    "ood": "ood_rate",
    "proved": "proved_rate",
    "agent_proved": "agent_proved_rate",
}
NO_FAULTS = Faults()
PROTOCOL = 1  # results of different protocols are never mixed in one table
RESETS = {"test": 7_000_001, "validation": 9_000_001}  # roots of the reset keys
CHUNK = 50  # episodes per compiled batch
# of every step: a guard's condition could not be met; its World knew nothing there; its plan was proved
COUNTED = ("infeasible", "ood", "proved")
SHARES = ("agent_proved",)  # of every step: the share of agents, e.g. of those whose own plan was proved
FORESEEN = "next_clearance"  # by the guard: the least score of the state that its action leads to
CUT = ("reward", "cost", "state", "violated", FORESEEN, *COUNTED, *SHARES)  # of as many episodes as were asked for

Played = dict[str, np.ndarray]
_compiled_act = in_float32(jax.jit(act_with))


def summarise(played: dict[str, np.ndarray], task: Task, hazard_at_start: np.ndarray) -> dict:
    """The protocol's numbers from per-step rewards and costs (E, L), the episodes' steps and terminations (E,), and
    who started unsafe (E,). An episode that ends early costs little: `steps_mean`, `termination_rate` and `cost_rate`
    (cost per step played) tell."""
    returns = played["rewards"].sum(1, dtype=np.float64)
    costs = played["costs"].sum(1, dtype=np.float64)
    steps = played["steps"]
    terminated = played["terminated"]
    episodes = len(returns)
    violated = costs > 0
    starts_safe = ~hazard_at_start
    cost_safe_start = costs[starts_safe] if starts_safe.any() else np.zeros(1)
    return {
        "episodes": episodes,
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_interval": statistics.bootstrap_mean(returns),
        "return_norm": float(task.normalised_return(returns.mean())),
        "cost_mean": float(costs.mean()),
        "cost_interval": statistics.bootstrap_mean(costs),
        "cost_norm": float(task.normalised_cost(costs.mean())),
        "cost_cvar10": statistics.cvar(costs),
        "cost_rate": float(costs.sum() / steps.sum()),
        "steps_mean": float(steps.mean()),
        "termination_rate": float(terminated.mean()),
        "violation_rate": float(violated.mean()),
        "violation_interval": statistics.clopper_pearson(int(violated.sum()), episodes),
        "violation_upper": statistics.upper_bound(int(violated.sum()), episodes),
        **{RATES[k]: float(played[k].sum() / steps.sum()) for k in RATES if k in played},
        # Share of (agent, episode) with a cost of the agent's own.
        **({"agent_violation_rate": float(played["violated"].any(1).mean())} if "violated" in played else {}),
        "unsafe_starts": int(hazard_at_start.sum()),
        "cost_safe_start": float(cost_safe_start.mean()),
        "cost_safe_start_interval": statistics.bootstrap_mean(cost_safe_start),
        "violation_upper_safe_start": statistics.upper_bound(int((cost_safe_start > 0).sum()), len(cost_safe_start)),
        "constants": {
            "return_min": task.return_min,
            "return_max": task.return_max,
            "cost_limit": task.cost_limit,
            "cost_offset": task.cost_offset,
        },
        "per_episode": {
            "return": [round(float(x), 3) for x in returns],
            "cost": [float(x) for x in costs],
            "unsafe_start": [bool(x) for x in hazard_at_start],
            "steps": [int(x) for x in steps],
            "terminated": [bool(x) for x in terminated],
        },
    }


def of_constraint(costs: np.ndarray, limit: float | None) -> dict[str, Any]:
    """What a result says of a constraint whose costs per episode are (E,), and of its limit, if it has one."""
    violated = costs > 0
    found = {
        "cost_mean": float(costs.mean()),
        "cost_interval": statistics.bootstrap_mean(costs),
        "violation_rate": float(violated.mean()),
        "violation_upper": statistics.upper_bound(int(violated.sum()), len(costs)),
    }
    if limit is not None:
        found |= {"limit": limit, "limit_satisfied_rate": float((costs <= limit).mean())}
    return found


def complete(result: dict, task: Task) -> bool:
    """Whether a stored result says all that the protocol asks for: how many episodes ended early is younger than
    results there are, which matters only where they can."""
    return "termination_rate" in result or task.env is None or not task.env.terminates


def of_last_step(result: dict, config: dict) -> bool:
    """Whether a stored result is of a run's last step, by its config; a foreign one may tell none."""
    updates = config.get("num_updates")
    return updates is None or result.get("step", updates) == updates


def unsafe_starts(task: Task, states: np.ndarray) -> np.ndarray:
    """(E,) whether the first state (E, S) of an episode is already unsafe for anyone: by the formula of danger, or by
    the simulator's own distances where costs alone say what is dangerous."""
    if isinstance(task.hazard, constraints.CostColumn) and isinstance(task.env, Measured):
        return np.asarray(_touching(task.env, jnp.asarray(states)))
    view = task.feature_map("pruned")
    bound = constraints.bind(task.hazard, view.names, view.plus.shape[0])

    def observed(states: Array) -> Array | None:
        env = task.simulator
        if view.source == "state" or isinstance(env, NativeEnv):  # a native one's view reads its state
            return None
        return env.observe(env.from_global_state(states))

    @jax.jit  # one program instead of one for every operation
    def unsafe(states: Array) -> Array:
        labels, _ = bound.labels(local_features(view, task.homogeneous, observed(states), states))
        return labels.reshape(len(states), -1).any(-1)

    return np.asarray(unsafe(jnp.asarray(states)))


@functools.partial(jax.jit, static_argnums=0)
def _touching(env: Measured, states: Array) -> Array:
    return (env.clearance(env.from_global_state(states)) < 0).any(-1)


def evaluate_policy(
    policy: Policy,
    task: Task,
    episodes: int = 200,
    split: str = "test",
    seed: int = 0,
    num_recorded: int = 0,
    label: str = "",
    quiet: bool = True,
    faults: Faults = NO_FAULTS,
) -> tuple[dict, dict[str, np.ndarray]]:
    """(summary, what was recorded) of a policy on a task's simulator, behind faults where there are some. Robots are
    played by any object with `initial_state` and `act` (types.Policy); Simple Spread, which runs inside JAX, by
    pytrees."""
    if task.env is None:
        raise UserError(
            f"Task '{task.name}' exists only as data, so `ringfence eval` has nothing to play in; play in a simulator "
            "of your own: `ringfence play RUN --env FILE.py:NAME`."
        )
    episodes = whole_number("episodes", episodes, 1, 10**7)
    num_recorded = min(whole_number("num_recorded", num_recorded), episodes)
    begun = time.perf_counter()
    policy = under_faults(policy, faults, task)
    played = rollout(policy, task.env, episodes, split, seed, num_recorded, label, quiet)
    result = summarise(played, task, unsafe_starts(task, played["states"][:, 0]))
    result |= {"protocol": PROTOCOL, "task": task.name, "split": split, "seed": seed}
    return result | {"eval_seconds": time.perf_counter() - begun}, played


class Acting:
    """A policy as `rollout` of `envs/base.py` plays it: compiled where it can be, and in 32 bits, whatever the
    precision of the simulator. What JAX cannot take apart acts in its own."""

    def __init__(self, policy: Policy):
        self.policy = policy
        self.act_with = act_with if _foreign(policy) else _compiled_act

    def initial_state(self, batch: int) -> PyTree:
        with float32():
            return self.policy.initial_state(batch)

    def act(self, carry: PyTree, observations: Any, state: Any, key: Key) -> tuple[PyTree, PolicyStep]:
        return self.act_with(self.policy, carry, observations, state, key)

    def observe_cost(self, carry: PyTree, cost: Any) -> PyTree:
        with float32():
            return with_cost(self.policy, carry, cost)


def rollout(
    policy: Policy,
    env: PureEnv | NativeEnv,
    episodes: int,
    split: str = "test",
    seed: int = 0,
    num_recorded: int = 0,
    label: str = "",
    quiet: bool = True,
    batch: int = 0,
    foreseen: bool = False,
) -> Played:
    """Play `episodes` episodes: `rewards`, `costs` (E, L) per step, `states` (E, L+1, S), `steps` (E,) taken and
    whether the task itself `terminated` (E,) it, and who was `violated` (E, L, N) where agents have costs of their own;
    the first `num_recorded` episodes also keep what the planner drew (`plans`, `chosen`). `seed` moves the policy's
    noise, never the resets; another `batch` has other resets. `foreseen` keeps what a guard foresees (E, L), which is
    −∞ after an episode's end."""
    if split not in RESETS:
        raise UserError(f"split='{split}' does not exist; use test or validation.")
    root = RESETS[split] + 2 * batch  # whose noise has the key after it
    act_key = jax.random.fold_in(jax.random.key(root + 1), seed)
    label = label or "evaluating"
    if isinstance(env, NativeEnv):
        with Progress(label, env.episode_length, 0, quiet) as bar:
            return _rollout_native(policy, env, episodes, root, act_key, num_recorded, foreseen, bar)
    if _foreign(policy):
        raise UserError(
            f"Simple Spread runs inside JAX, and {type(policy).__name__} is no pytree; make it an equinox.Module whose "
            "act() uses jax.numpy."
        )
    keys = jax.random.key(root), act_key
    played = _in_chunks(_compiled(env, foreseen), policy, keys, episodes, num_recorded, label, quiet)
    _refuse_lost(played)
    return {
        "rewards": played.pop("reward"),
        "costs": played.pop("cost"),
        "states": played.pop("state"),
        "steps": np.full(episodes, env.episode_length),
        "terminated": np.zeros(episodes, bool),
        **played,
    }


def _compiled(env: PureEnv, foreseen: bool) -> Callable[[Policy, tuple[Key, Key], int, int, int], dict[str, Array]]:
    """A program that plays the chunk `index` of `batch` episodes and keeps what was drawn in the first `keep`; keys are
    of resets and of actions. It is the same one for all seeds, and found again where compiled programs are kept."""

    def play(policy: Policy, keys: tuple[Key, Key], index: int, batch: int, keep: int) -> dict[str, Array]:
        reset_key, act_key = keys

        def step(before: PyTree, key: Key) -> tuple[PyTree, dict[str, Array]]:
            carry, state = before
            carry, decided = policy.act(carry, env.observe(state), env.global_state(state), key)
            after, out = env.step(state, decided.action)
            carry = with_cost(policy, carry, out.cost)
            kept = {"reward": out.reward.mean(-1), "cost": out.team_cost, "state": env.global_state(after)}
            if out.cost.ndim == 2:
                kept["violated"] = out.cost > 0
            kept |= _counted(decided)
            if foreseen:
                kept[FORESEEN] = decided.info[FORESEEN]
            if keep:
                kept |= {name: value[:keep] for name, value in _drawn(decided).items()}
            return (carry, after), kept

        state = env.reset(jax.random.fold_in(reset_key, index), batch)
        of_steps = jax.random.split(jax.random.fold_in(act_key, index), env.episode_length)
        _, kept = jax.lax.scan(step, (policy.initial_state(batch), state), of_steps)
        kept = {name: jnp.moveaxis(value, 0, 1) for name, value in kept.items()}
        kept["state"] = jnp.concatenate([env.global_state(state)[:, None], kept["state"]], 1)
        return kept

    return jax.jit(play, static_argnums=(3, 4))


def _in_chunks(
    play: Callable[[Policy, tuple[Key, Key], int, int, int], dict[str, Array]],
    policy: Policy,
    keys: tuple[Key, Key],
    episodes: int,
    num_recorded: int,
    label: str,
    quiet: bool,
) -> Played:
    """Always whole chunks, so that the first n episodes are the same ones whatever number is asked for, and by one
    program, which keeps as much of each as of the first."""
    chunks: list[Played] = []
    most = min(num_recorded, CHUNK)
    with Progress(label, episodes, 0, quiet) as bar:
        for first in range(0, episodes, CHUNK):
            chunk = jax.device_get(play(policy, keys, first // CHUNK, CHUNK, most))
            left = max(num_recorded - first, 0)
            chunks.append({name: value if name in CUT else value[:left] for name, value in chunk.items()})
            bar.advance(min(CHUNK, episodes - first))
    played = {name: np.concatenate([c[name] for c in chunks]) for name in chunks[0]}
    return {name: value[:episodes] if name in CUT else value for name, value in played.items()}


def _refuse_lost(played: Played) -> None:
    """Nothing collides with what is nowhere, so it would pass for safe."""
    lost = ~(np.isfinite(played["reward"]) & np.isfinite(played["state"][:, 1:]).all(-1))
    if lost.any():
        episode, step = np.argwhere(lost)[0]
        raise UserError(
            f"Step {step} of episode {episode} has a reward or state that is not finite, so the policy's actions are "
            "no numbers; it has diverged or divides by zero."
        )


def _rollout_native(
    policy: Policy,
    env: NativeEnv,
    episodes: int,
    root: int,
    key: Key,
    num_recorded: int,
    foreseen: bool,
    bar: Progress,
) -> Played:
    """`rollout` on a simulator that steps outside JAX: all episodes side by side. After an episode's end its rewards
    and costs are 0 and its state stays."""
    simulation = env.simulate(episodes)
    simulation.reset([(root, k) for k in range(episodes)])
    seen = [simulation.observe()]
    steps: list[dict[str, Any]] = []
    drawn: list[Played] = []

    def keep(now: outside.Moment) -> None:
        seen.append(now.after)
        kept = {"rewards": now.outcome.reward, "costs": now.outcome.cost, "terminated": now.outcome.terminated}
        kept = {name: np.asarray(value) * now.running for name, value in (kept | _counted(now.decided)).items()}
        if foreseen:
            kept[FORESEEN] = np.where(now.running, np.asarray(now.decided.info[FORESEEN]), -np.inf)
        steps.append(kept | {"steps": now.running})
        if num_recorded:
            drawn.append({name: np.asarray(value[:num_recorded]) for name, value in _drawn(now.decided).items()})
        bar.advance(1)

    keys = (jax.random.fold_in(key, t) for t in range(env.episode_length))
    outside.rollout(Acting(policy), simulation, keep, keys)
    played = _stacked(steps)
    states = np.stack([one.state for one in seen if one.state is not None], 1)  # robots have one
    after = env.episode_length - len(steps)  # rows in which nothing happens, and the last state stays
    return {
        "steps": np.asarray(played.pop("steps").sum(1)),
        "terminated": np.asarray(played.pop("terminated").any(1)),
        "states": np.concatenate([states, np.repeat(states[:, -1:], after, 1)], 1),
        **{
            name: np.pad(x, ((0, 0), (0, after)), constant_values=-np.inf if name == FORESEEN else 0.0)
            for name, x in played.items()
        },
        **_stacked(drawn),
    }


def _counted(decided: PolicyStep) -> dict[str, Array]:
    counted = {name: decided.info[name] for name in COUNTED if name in decided.info}
    return counted | {name: decided.info[name].mean(-1) for name in SHARES if name in decided.info}


def _drawn(decided: PolicyStep) -> dict[str, Array]:
    return {name: value for name, value in decided.info.items() if name not in (*COUNTED, *SHARES, FORESEEN)}


def _foreign(policy: Policy) -> bool:
    """Whether a policy is an ordinary object that JAX cannot take apart, e.g. one around a PyTorch network."""
    return jax.tree_util.all_leaves([policy.policy if isinstance(policy, Faulty) else policy])


def _stacked(steps: Sequence[dict[str, Any]]) -> Played:
    """Arrays (E, T, ...) of what every step kept; nothing of no steps."""
    return {name: np.stack([step[name] for step in steps], 1) for name in (steps[0] if steps else ())}
