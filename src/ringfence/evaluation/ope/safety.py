"""Where plans lead from logged states, as a World of the logs predicts it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.evaluation import statistics
from ringfence.evaluation.ope.logs import Logs
from ringfence.evaluation.ope.responses import Responses
from ringfence.evaluation.ope.result import Safety
from ringfence.guards import BarrierSource
from ringfence.types import Array
from ringfence.world import World


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
