"""A team of agents who are alike and see for themselves is so many teams of one.

What is learned of one of them holds for all, so logs are taken apart into each agent's own (`EpisodeStore.apart`),
every algorithm, World and guard works on teams of one, and one checkpoint plays any number of agents, at a cost per
agent that does not grow with the team.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from ringfence.problem.features import FeatureMap
from ringfence.types import Array, Key, PolicyStep, PyTree


class Each(eqx.Module):
    """A policy of teams of one, played by every agent of a team of `agents`. Nobody hears of anybody."""

    one: Any
    agents: int = eqx.field(static=True)

    def start(self, batch: int) -> PyTree:
        return self.one.start(batch * self.agents)

    def act(self, memory: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        """observations (B, N, O) -> actions (B, N, A); what is told of one agent is told of the team if it is of
        any."""
        memory, step = self.one.act(memory, apart(observations), None, key)
        return memory, together(step, observations.shape[:2])

    def hear(self, memory: PyTree, cost: Array | dict[str, Array]) -> PyTree:
        """Costs (B, N) of each agent, or (B,) of the team, which are then everybody's; or these by constraint."""
        if not hasattr(self.one, "hear"):
            return memory

        def each(cost: Array) -> Array:
            return (cost if cost.ndim == 2 else jnp.repeat(cost[:, None], self.agents, 1)).reshape(-1)

        return self.one.hear(memory, {k: each(c) for k, c in cost.items()} if isinstance(cost, dict) else each(cost))


def together(step: PolicyStep, shape: tuple[int, int]) -> PolicyStep:
    """What B N teams of one decided, as B teams of N."""
    info = {k: step.info[k].reshape(shape).any(1) for k in ("infeasible", "strange") if k in step.info}
    if "clearance" in step.info:
        info["clearance"] = step.info["clearance"].reshape(shape).min(1)
    return PolicyStep(step.action.reshape(*shape, -1), info)


def look(map: FeatureMap, alike: bool, observations: Array, state: Array | None) -> Array:
    """Features (B, N, D) of a team, or (B N, 1, D) of agents who are alike."""
    return map(apart(observations), None) if alike else map(observations, state)


def apart(x: Array) -> Array:
    """Teams (B, N, ...) as teams of one, (B N, 1, ...)."""
    return x.reshape(-1, 1, *x.shape[2:])
