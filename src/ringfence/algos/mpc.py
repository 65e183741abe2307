"""Model-predictive control from a zero proposal: nothing is learned but the World, nothing is proposed but rest, and
whatever is done a guard finds by climbing value from noise (guards/guard.py, `refine`). What a learned proposal is
worth is what it adds to this."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax.numpy as jnp

from ringfence.algos import actor_critic as ac
from ringfence.problem import features
from ringfence.types import Algorithm, Array, Batch, Key, Metrics, PolicyStep, PyTree, Spec
from ringfence.utils.config import BatchSize, Count, Natural, Rows
from ringfence.world import World


@dataclass(frozen=True)
class Config:
    """There is nothing to choose: one update that changes nothing makes the run folder."""

    view: features.View = "decentralized"  # nobody looks
    horizon: Rows = 2  # rows of a window
    history: Natural = 0  # rows of the past
    num_updates: Count = 1  # updates
    batch: BatchSize = 1  # windows per update


class Rest(eqx.Module):
    """Proposes to do nothing."""

    spec: Spec = eqx.field(static=True)

    def start(self, batch: int) -> PyTree:
        return {}

    def act(self, memory: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        s = self.spec
        middle = (s.action_low + s.action_high) / 2
        return memory, PolicyStep(jnp.full((observations.shape[0], s.n_agents, s.action_dim), middle), {})

    def propose(
        self, memory: PyTree, observations: Array, state: Array, key: Key, count: int, rows: int, world: World
    ) -> tuple[PyTree, Array, dict[str, Array]]:
        shape = (observations.shape[0], 1, rows, self.spec.n_agents, self.spec.action_dim)
        return memory, jnp.zeros(shape), {}


def init(key: Key, spec: Spec, config: Config, data, feature_map, hazard) -> PyTree:
    return {"step": jnp.zeros((), jnp.int32)}


def make_update(config: Config, spec: Spec, feature_map, hazard):
    def update(state: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
        return {"step": state["step"] + 1}, {}

    return update


def make_policy(state: PyTree, config: Config, spec: Spec, feature_map, hazard, options=None) -> Rest:
    return Rest(spec)


def cost_source(config: Config) -> Literal["nothing"]:
    return "nothing"


MPC = Algorithm(
    "mpc",
    Config,
    lambda config, hazard: None,
    init,
    make_update,
    ac.no_diagnosis,
    make_policy,
    {"default": {}},
    cost_source,
)
