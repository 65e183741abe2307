"""A guard that knows everything: the simulator's own dynamics, its own distances from danger, and what the policy will
do, as far ahead as avoiding takes. No user has one; it says what guarding can reach."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.datasets.task import Task
from ringfence.envs.base import Measured, PureEnv
from ringfence.errors import UserError
from ringfence.guards import BarrierSource, Guard, Guarded, GuardOptions, options_of
from ringfence.guards.options import in_steps
from ringfence.problem import constraints, normalise
from ringfence.problem.features import FeatureMap
from ringfence.types import Array, Key, Policy, PyTree, Spec
from ringfence.utils.config import build_config
from ringfence.world import World
from ringfence.world.card import Card

ORACLE = "oracle"  # the name of this barrier
AHEAD = 1.5  # s that are foreseen
SAFE_MARGIN = 0.1  # m: the unit of its margins
DISCOUNT = 0.97  # of rewards, in a step


@runtime_checkable
class Known(PureEnv, Measured, Protocol):
    """A pure simulator that knows how far everybody is from danger, and how long a step takes."""

    @property
    def dt(self) -> float:
        """s"""
        ...


class TrueDynamics(eqx.Module):
    """The simulator in the place of a World's dynamics. Features are the global state, the same for every agent."""

    env: Known = eqx.field(static=True)
    spec: Spec = eqx.field(static=True)

    @property
    def size(self) -> int:
        return 1

    def members(self, index: Array) -> tuple[Array, None]:
        return index, None

    def by_members(self, nets: Any) -> TrueDynamics:
        return self

    def step(self, before: Array, action: Array) -> tuple[Array, Array]:
        """(after (..., N, D), disagreement (..., N), which is none)."""
        after, _ = self.env.step(self.env.from_global_state(before[..., 0, :]), _given(action, self.spec))
        return shown(self.env, after), jnp.zeros(before.shape[:-1])


class TrueValues(eqx.Module):
    """What the simulator pays, in the place of a World's values."""

    env: Known = eqx.field(static=True)
    spec: Spec = eqx.field(static=True)

    @property
    def value_std(self) -> float:
        return 0.3

    def of_plan(self, rows: Array, actions: Array) -> Array:
        """(...,) discounted rewards of rows (..., K+1, N, D) under actions (..., K, N, A)."""
        _, out = self.env.step(self.env.from_global_state(rows[..., :-1, 0, :]), _given(actions, self.spec))
        return (out.reward.mean(-1) * DISCOUNT ** jnp.arange(actions.shape[-3])).sum(-1)


class Foreseen(eqx.Module):
    """A policy that proposes what it will do, by playing on in the simulator."""

    policy: Any
    env: Known = eqx.field(static=True)
    spec: Spec = eqx.field(static=True)

    def initial_state(self, batch: int) -> PyTree:
        return self.policy.initial_state(batch)

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> Any:
        return self.policy.act(carry, observations, state, key)

    def propose(
        self, carry: PyTree, observations: Array, state: Array, key: Key, count: int, rows: int, world: World
    ) -> tuple[PyTree, Array, dict[str, Array]]:
        def step(before: tuple[PyTree, PyTree], _: None) -> tuple[tuple[PyTree, PyTree], tuple[Array, PyTree]]:
            carry, now = before
            carry, decided = self.policy.act(carry, self.env.observe(now), self.env.global_state(now), key)
            after, _out = self.env.step(now, decided.action)
            unit = normalise.to_unit(decided.action, self.spec.action_low, self.spec.action_high)
            return (carry, after), (unit, carry)

        first = (carry, self.env.from_global_state(state))
        _, (actions, carries) = jax.lax.scan(step, first, None, length=rows)
        after_first = jax.tree.map(lambda x: x[0], carries)
        return after_first, jnp.moveaxis(actions, 0, 1)[:, None], {}


def guarded(policy: Policy, task: Task, name: str, changes: Mapping[str, Any]) -> Guarded:
    """A team's policy under the named guard of one who knows everything."""
    env = known(task)
    world, bound = _world(task.name, env, task.action_low, task.action_high)
    choices = options(name, task, changes)
    proposal = Foreseen(policy, env, world.spec)
    return Guarded(proposal, Guard(BarrierSource(world, "analytic", bound, False), choices))


def options(name: str, task: Task, changes: Mapping[str, Any]) -> GuardOptions:
    """The named guard's options, looking `AHEAD` s ahead."""
    dt = known(task).dt
    horizon = {"horizon": max(1, round(AHEAD / dt))}
    given = build_config(GuardOptions, {**options_of(name, "analytic"), **horizon, **changes}, "the guard")
    if given.within_logs:
        raise UserError("within_logs keeps a guard to logs, and an oracle has read none; leave it out.")
    return in_steps(given, dt)


def known(task: Task) -> Known:
    """A task's simulator; refused where it does not know its own distances."""
    env = task.simulator
    if not isinstance(env, Known):
        raise UserError(
            f"barrier='{ORACLE}' needs a simulator that knows how far everybody is from danger, and that of "
            f"'{task.name}' does not; use barrier='learned'."
        )
    return getattr(env, "unhindered", env)


def shown(env: Known, state: PyTree) -> Array:
    """(..., N, D) the global state, for each agent."""
    flat = env.global_state(state)
    return jnp.broadcast_to(flat[..., None, :], (*flat.shape[:-1], env.n_agents, flat.shape[-1]))


@functools.lru_cache(64)
def _world(task: str, env: Known, low: Any, high: Any) -> tuple[World, constraints.BoundHazard]:
    """The simulator as a World, and its danger as a formula; the same for the same simulator, so that what was compiled
    with it serves again."""
    n = env.n_agents
    names = env.state_names
    table = np.tile(np.arange(len(names)), (n, 1))
    map = FeatureMap("centralized", names, "state", table, np.full_like(table, -1))
    spec = Spec(task, n, env.action_dim, names, low, high, env.episode_length)

    def clearance(x: Any) -> Array:
        return env.clearance(env.from_global_state(jnp.asarray(x)[..., 0, :]))

    dynamics: Any = TrueDynamics(env, spec)
    values: Any = TrueValues(env, spec)
    world = World(
        dynamics=dynamics,
        values=values,
        barrier=None,
        ood_threshold=jnp.ones(()),
        map=map,
        spec=spec,
        alone=False,
        card=Card(),
    )
    return world, constraints.BoundHazard(constraints.CostColumn(), clearance, SAFE_MARGIN)


def _given(action: Array, spec: Spec) -> Array:
    """Actions of [−1, 1] in the task's bounds."""
    return normalise.from_unit(action, spec.action_low, spec.action_high)
