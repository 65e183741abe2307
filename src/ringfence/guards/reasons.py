"""What was amiss with the plan that a guard was asked for."""

from __future__ import annotations

import jax.numpy as jnp

from ringfence.guards.filter import Guard
from ringfence.problem import normalise
from ringfence.types import Array


def reasons(guard: Guard, present: Array, plan: Array) -> dict[str, Array]:
    """Of a requested plan (B, K, N, A) in the present (B, N, D), for each agent: the action, and the part of the
    barrier that scored least along it, in which row and by how much. `guard.barrier.part_names` names the parts."""
    spec = guard.world.spec
    rows, _ = guard.predict(present, plan[:, None])
    scores = guard.barrier.parts(rows)[:, 0]  # (B, K, N, M)
    batch, steps, agents, many = scores.shape
    flat = jnp.moveaxis(scores, 2, 1).reshape(batch, agents, steps * many)
    worst = flat.argmin(-1)
    return {
        "agent_requested": normalise.from_unit(spec.own(plan[:, 0]), spec.action_low, spec.action_high),
        "agent_reason": worst % many,
        "agent_reason_row": worst // many + 1,
        "agent_reason_score": flat.min(-1),
    }
