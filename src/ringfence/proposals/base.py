"""What acts without planning, and how any policy's actions are foreseen: batched, pure, normaliser inside."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.problem import normalise
from ringfence.problem.features import FeatureMap, translation
from ringfence.problem.normalise import Normaliser
from ringfence.types import Array, Key, PolicyStep, PyTree, Spec
from ringfence.world import World


class Direct(eqx.Module):
    """An actor network on the present features, one per agent, squashed into the action bounds."""

    actor: Any
    normaliser: Normaliser
    spec: Spec = eqx.field(static=True)
    feature_map: FeatureMap = eqx.field(static=True)

    def initial_state(self, batch: int) -> PyTree:
        return {}

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        return carry, PolicyStep(from_unit(self.decide(self.feature_map(observations, state)), self.spec), {})

    def decide(self, x: Array) -> Array:
        """Actions (..., N, A) in [−1, 1] at features (..., N, D)."""
        return jnp.tanh(self.actor(self.normaliser.state(x)))

    def propose(
        self, carry: PyTree, observations: Array, state: Array, key: Key, count: int, rows: int, world: World
    ) -> tuple[PyTree, Array, dict[str, Array]]:
        """(carry, actions (B, 1, `rows`, N, A) in [−1, 1], info): what the actor does now and along foreseen rows."""
        seen, present = self.feature_map(observations, state), world.map(observations, state)
        return carry, rolled(self.decide, self.feature_map, world, seen, present, rows), {}


def from_unit(action: Array, spec: Spec) -> Array:
    """Actions in [−1, 1], as everything learns them, in the task's bounds."""
    return normalise.from_unit(spec.own(action), spec.action_low, spec.action_high)


class Constant(eqx.Module):
    """Does nothing, or acts uniformly at random: the reference rows of every table."""

    spec: Spec = eqx.field(static=True)
    random: bool = eqx.field(static=True, default=False)

    def initial_state(self, batch: int) -> PyTree:
        return {}

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        s = self.spec
        shape = (observations.shape[0], s.n_agents, s.action_dim)
        if self.random:
            low, high = jnp.asarray(s.action_low, jnp.float32), jnp.asarray(s.action_high, jnp.float32)
            return carry, PolicyStep(jax.random.uniform(key, shape, minval=low, maxval=high), {})
        nothing = np.clip(0.0, s.action_low, s.action_high)  # where the bounds leave 0 out, what is nearest to it
        return carry, PolicyStep(jnp.full(shape, nothing, jnp.float32), {})


def held(action: Array, rows: int) -> Array:
    """(B, 1, K, N, A): one action (B, N, A), held."""
    return jnp.broadcast_to(action[:, None, None], (action.shape[0], 1, rows, *action.shape[1:]))


class _Rescaled(eqx.Module):
    """Forward dynamics by actions in [−1, 1] of other bounds than those that they were learned in."""

    dynamics: Any
    learned: Spec = eqx.field(static=True)
    given: Spec = eqx.field(static=True)

    def step(self, x: Array, action: Array) -> tuple[Array, Array]:
        return self.dynamics.step(x, normalise.in_units_of(self.learned, self.given, action))


def in_bounds_of(spec: Spec, world: World) -> World:
    """The World as a proposal's actions move it, whose bounds may be those of other logs."""
    if (spec.action_low, spec.action_high) == (world.spec.action_low, world.spec.action_high):
        return world
    dynamics: Any = _Rescaled(world.dynamics, world.spec, spec)
    return dataclasses.replace(world, dynamics=dynamics)


def rolled(act: Callable[[Array], Array], own, world: World, seen: Array, present: Array, rows: int) -> Array:
    """(B, 1, K, N, A): what a policy `act`, of features in its own view `own`, does now (`seen`) and along the rows
    that the World foresees from `present`; the first action held where the views cannot be translated."""
    index = translation(own, world.map)
    first = act(seen)
    if index is None or rows == 1:
        return held(first, rows)
    x, action, actions = present, first, [first]
    for _ in range(rows - 1):
        x, _ = world.dynamics.step(x, action)
        action = act(jnp.take_along_axis(x, jnp.broadcast_to(index, (*x.shape[:-1], index.shape[1])), -1))
        actions.append(action)
    return jnp.stack(actions, 1)[:, None]
