"""A team of homogeneous agents that see for themselves is so many teams of one.

What is learned of one of them holds for all. So logs are split into each agent's own (`EpisodeStore.split_agents`),
every algorithm, World and guard works on teams of one, and one checkpoint plays any number of agents, at a cost per
agent that does not grow with the team.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from ringfence.problem.features import FeatureMap, X
from ringfence.types import Array, Key, ObservesCost, ObservesDelay, PolicyStep, PyTree


class PerAgent(eqx.Module):
    """A policy of teams of one, played by every agent of a team of `agents`. Nobody hears of anybody."""

    one: Any
    agents: int = eqx.field(static=True)

    def initial_state(self, batch: int) -> PyTree:
        return self.one.initial_state(batch * self.agents)

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        """observations (B, N, O) -> actions (B, N, A); a flag of one agent is one of its team."""
        carry, step = self.one.act(carry, split_agents(observations), None, key)
        batch, agents = observations.shape[:2]
        return carry, merge_agents(step, (batch, agents))

    def observe_cost(self, carry: PyTree, cost: Array | dict[str, Array]) -> PyTree:
        """Costs (B, N) of each agent, or (B,) of the team, which are then everybody's; or these by constraint."""
        if not isinstance(self.one, ObservesCost):
            return carry

        def own(cost: Array) -> Array:
            own = cost if cost.ndim == 2 else jnp.repeat(cost[:, None], self.agents, 1)
            return own.reshape(-1)

        if isinstance(cost, dict):
            return self.one.observe_cost(carry, {name: own(part) for name, part in cost.items()})
        return self.one.observe_cost(carry, own(cost))

    def observe_age(self, carry: PyTree, age: Array) -> PyTree:
        """Ages (B, N) of observations, to each agent its own."""
        return self.one.observe_age(carry, age.reshape(-1, 1)) if isinstance(self.one, ObservesDelay) else carry

    def observe_sent(self, carry: PyTree, action: Array) -> PyTree:
        """What was sent (B, N, A), to each agent its own."""
        return self.one.observe_sent(carry, split_agents(action)) if isinstance(self.one, ObservesDelay) else carry


def team_policy(policy: Any, agents: int, homogeneous: bool) -> Any:
    """A policy as a team of `agents` plays it: that of one agent by each of them, where they are homogeneous."""
    return PerAgent(policy, agents) if homogeneous else policy


def agent_policy(policy: Any) -> Any:
    """Inverse of `team_policy`: the policy of one agent, where every agent plays it."""
    return policy.one if isinstance(policy, PerAgent) else policy


def merge_agents(step: PolicyStep, shape: tuple[int, int]) -> PolicyStep:
    """What B N teams of one decided, as B teams of N."""
    info = {k: step.info[k].reshape(shape).any(1) for k in ("infeasible", "ood") if k in step.info}
    if "proved" in step.info:
        info["proved"] = step.info["proved"].reshape(shape).all(1)
    for name in ("clearance", "next_clearance"):
        if name in step.info:
            info[name] = step.info[name].reshape(shape).min(1)
    of_agents = {name: value for name, value in step.info.items() if name.startswith("agent_")}
    info |= {name: value.reshape(*shape, *value.shape[2:]) for name, value in of_agents.items()}
    return PolicyStep(step.action.reshape(*shape, -1), info)


def local_features(map: FeatureMap, homogeneous: bool, observations: X | None, state: X | None) -> X:
    """Features (B, N, D) of a team, or (B N, 1, D) of homogeneous agents."""
    if not homogeneous:
        return map(observations, state)
    assert observations is not None, "homogeneous agents see for themselves"
    return map(split_agents(observations), None)


def team_mean(x: Array, alone: bool, axis: int = -1) -> Array:
    """Mean over the axis of agents; of agents who are alone, what it is of each."""
    return x if alone else x.mean(axis)


def team_sum(x: Array, axes: tuple[int, ...], alone: bool) -> Array:
    """Sum of (B, K, N, ...) over axes and agents, (B, 1); of agents who are alone over these axes, (B, N)."""
    return x.sum(axes) if alone else x.sum((*axes, 2))[:, None]


def split_agents(x: X) -> X:
    """Teams (B, N, ...) as teams of one, (B N, 1, ...)."""
    return x.reshape(-1, 1, *x.shape[2:])
