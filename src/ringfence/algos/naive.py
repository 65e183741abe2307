"""The naive driver of the proving ground: straight to the goal at full speed, whoever is in the way. Nothing is
learned; a guard shows by it what becomes of somebody who never saw the logs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp

from ringfence.algos import actor_critic as ac
from ringfence.datasets import registry
from ringfence.datasets.recipes.proving import Naive
from ringfence.envs import System
from ringfence.errors import UserError
from ringfence.problem import features
from ringfence.types import Algorithm, Batch, Key, Metrics, PyTree, Spec
from ringfence.utils.config import BatchSize, Count, Natural, Rows


@dataclass(frozen=True)
class Config:
    """There is nothing to choose: one update that changes nothing makes the run folder."""

    view: features.View = "decentralized"
    horizon: Rows = 2  # rows of a window
    history: Natural = 0  # rows of the past
    num_updates: Count = 1
    batch: BatchSize = 1  # windows per update


def init(key: Key, spec: Spec, config: Config, data, feature_map, hazard) -> PyTree:
    _system(spec)
    return {"step": jnp.zeros((), jnp.int32)}


def make_update(config: Config, spec: Spec, feature_map, hazard):
    def update(state: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
        return {"step": state["step"] + 1}, {}

    return update


def make_policy(state: PyTree, config: Config, spec: Spec, feature_map, hazard, options=None) -> Naive:
    return Naive(_system(spec))


def cost_source(config: Config) -> Literal["nothing"]:
    return "nothing"


def _system(spec: Spec) -> System:
    """The system of a task, whose bodies the driver knows."""
    task = registry.TASKS.get(spec.task)
    if task is None or not isinstance(task.env, System):
        raise UserError(f"The naive driver knows the bodies of the proving ground, not those of '{spec.task}'.")
    return task.env


NAIVE = Algorithm(
    "naive",
    Config,
    lambda config, hazard: None,
    init,
    make_update,
    ac.no_diagnosis,
    make_policy,
    {"default": {}},
    cost_source,
)
