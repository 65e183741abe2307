"""What algorithms that learn nothing share: one update that changes nothing makes the run folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp

from ringfence.algos import actor_critic as ac
from ringfence.problem import features
from ringfence.types import Algorithm, Batch, Key, Metrics, Policy, PyTree, Spec
from ringfence.utils.config import BatchSize, Count, Natural, Rows


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
