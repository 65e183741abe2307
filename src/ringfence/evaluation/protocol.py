"""The evaluation protocol: fixed resets shared by all methods, raw numbers first, unsafe starts apart.

Test resets and validation resets come from disjoint keys; settings are chosen on validation, tables are made on test.
Every episode is counted; `cost_safe_start` is the mean cost of the episodes that start safe.
"""

from __future__ import annotations

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.datasets.task import Task
from ringfence.envs.base import Measured, NativeEnv
from ringfence.errors import UserError, whole_number
from ringfence.evaluation import statistics
from ringfence.evaluation.rollout import rollout
from ringfence.faults import Faults
from ringfence.faults.policy import under_faults
from ringfence.problem import constraints
from ringfence.problem.homogeneous import local_features
from ringfence.types import Array, Policy

RATES = {  # columns of what is counted in steps
    "infeasible": "infeasible_rate",
    "ood": "ood_rate",
    "proved": "proved_rate",
    "agent_proved": "agent_proved_rate",
}
NO_FAULTS = Faults()
PROTOCOL = 1  # results of different protocols are never mixed in one table


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
