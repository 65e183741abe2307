"""Algorithms that learn nothing: one update that changes nothing makes the run folder.

`naive` heads straight for its goal; a guard shows by it what becomes of somebody who never saw the logs. `mpc` proposes
rest, so that whatever is done a guard finds by climbing value: what a learned proposal is worth it adds to this.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp

from ringfence.algos import actor_critic as ac
from ringfence.datasets import registry
from ringfence.datasets.recipes.proving import Naive
from ringfence.envs import System
from ringfence.errors import UserError
from ringfence.problem import features
from ringfence.problem.bounds import Bounds
from ringfence.types import Algorithm, Array, Batch, Key, Metrics, Policy, PolicyStep, PyTree, Spec
from ringfence.utils.config import BatchSize, Count, Natural, Rows
from ringfence.world import World


@dataclass(frozen=True)
class Config:
    """There is nothing to choose."""

    view: features.View = "decentralized"  # nobody looks
    horizon: Rows = 2  # rows of a window
    history: Natural = 0  # rows of the past
    num_updates: Count = 1
    batch: BatchSize = 1  # windows per update


def untrained(name: str, policy: Callable[[Spec], Policy]) -> Algorithm:
    """The algorithm of that name whose policy follows from the spec alone; `policy` refuses a spec that it cannot
    play, before anything is made."""

    def init(key: Key, spec: Spec, config: Config, data: Any, feature_map: Any, hazard: Any) -> PyTree:
        policy(spec)
        return {"step": jnp.zeros((), jnp.int32)}

    def make_policy(
        state: PyTree, config: Config, spec: Spec, feature_map: Any, hazard: Any, options: Any = None
    ) -> Policy:
        return policy(spec)

    return Algorithm(
        name,
        Config,
        lambda config, hazard: None,
        init,
        _make_update,
        ac.no_diagnosis,
        make_policy,
        {"default": {}},
        _cost_source,
    )


def _make_update(config: Config, spec: Spec, feature_map: Any, hazard: Any) -> Callable:
    def update(state: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
        return {"step": state["step"] + 1}, {}

    return update


def _cost_source(config: Config) -> Literal["nothing"]:
    return "nothing"


def _naive(spec: Spec) -> Naive:
    """The driver of a task, whose bodies it knows."""
    task = registry.TASKS.get(spec.task)
    if task is None or not isinstance(task.env, System):
        raise UserError(f"The naive driver knows the bodies of the proving ground, not those of '{spec.task}'.")
    return Naive(task.env)


NAIVE = untrained("naive", _naive)


class Rest(eqx.Module):
    """Proposes to do nothing."""

    spec: Spec = eqx.field(static=True)

    def initial_state(self, batch: int) -> PyTree:
        return {}

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        s = self.spec
        shape = (observations.shape[0], s.n_agents, s.action_dim)
        return carry, PolicyStep(jnp.full(shape, Bounds(s.action_low, s.action_high).middle, jnp.float32), {})

    def propose(
        self, carry: PyTree, observations: Array, state: Array, key: Key, count: int, rows: int, world: World
    ) -> tuple[PyTree, Array, dict[str, Array]]:
        shape = (observations.shape[0], 1, rows, self.spec.n_agents, self.spec.action_dim)
        return carry, jnp.zeros(shape), {}


MPC = untrained("mpc", Rest)
