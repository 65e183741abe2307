"""Behaviour cloning per agent, on all episodes (`bc`) or on those within the cost limit (`bc-safe`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import jax
import numpy as np

from ringfence.algos import actor_critic as ac
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData
from ringfence.nets import MLP
from ringfence.nets.optim import Optimiser, fresh, stepped
from ringfence.problem import features
from ringfence.problem.constraints import BoundHazard
from ringfence.problem.normalise import Normaliser
from ringfence.proposals.base import Direct
from ringfence.types import Algorithm, Array, Batch, Key, Metrics, PyTree, Spec
from ringfence.utils.config import BatchSize, Count, Depth, Natural, NonNegative, Positive, Rows, Share, Width


@dataclass(frozen=True)
class Config:
    """Behaviour cloning: L = E ‖a_i − π_i(s̃_i)‖² with a tanh-bounded deterministic π_i."""

    view: features.View = "decentralized"  # what an agent sees: its own observation, as in OMAR's study
    cost_limit: NonNegative | None = None  # keep episodes with cost ≤ this; None keeps all
    horizon: Rows = 2  # rows of a window: now and next
    history: Natural = 0  # rows of the past; cloning looks at the present alone
    width: Width = 128  # units of each hidden layer
    depth: Depth = 2  # hidden layers
    num_updates: Count = 4_000  # updates
    batch: BatchSize = 256  # windows per update
    lr: Positive = 1e-3  # Adam
    warmup: Natural = 100  # updates
    grad_clip: NonNegative = 1.0  # global norm; 0: no bound
    ema: Share = 0.995  # of the parameters


def init(
    key: Key,
    spec: Spec,
    config: Config,
    data: WindowData | None,
    feature_map: features.FeatureMap,
    hazard: BoundHazard,
) -> PyTree:
    """Parameters, their averages, optimiser state, the normaliser; without data, zeros stand for its statistics."""
    return start(key, spec, config, data, spec.feature_dim)


def start(key: Key, spec: Spec, config: Config, data: WindowData | None, inputs: int) -> PyTree:
    """The state of a run whose actors read `inputs` entries."""
    ka, kw = jax.random.split(key)

    def networks() -> dict:
        sizes = (inputs, *[config.width] * config.depth, spec.action_dim)
        params = {"actor": MLP(ka, sizes, groups=spec.n_agents, final_scale=0.1, acts=spec)}
        return fresh(Optimiser.of(config), params, "ema")

    return jax.jit(networks)() | {"frozen": {"normaliser": ac.fit_states(data, spec, kw)}}


def check(config: Config, hazard: BoundHazard) -> None:
    """Refuse settings that cannot work, before anything is computed."""
    if config.history or config.horizon != 2:
        raise UserError("bc looks at the present state alone; leave history=0 and horizon=2.")


def cost_source(config: Config) -> Literal["costs", "nothing"]:
    """Costs choose the episodes that are cloned, if anything does."""
    return "nothing" if config.cost_limit is None else "costs"


def make_windows(store: EpisodeStore, config: Config, feature_map: features.FeatureMap, world: None) -> WindowData:
    """All episodes, or those within the limit."""
    return WindowData(within(store, config), feature_map)


def within(store: EpisodeStore, config: Config) -> EpisodeStore:
    """The episodes within the cost limit, where there is one, or within those of all constraints, where the limit is
    the card's; if they are too few to learn from, the cheapest hundredth."""
    if config.cost_limit is None:
        return store
    over = store.episode_costs - config.cost_limit
    if store.limits and config.cost_limit == store.card.cost_limit:
        over = np.max([store.episode_costs_of(name) - limit for name, limit in store.limits.items()], 0)
    return store.select(over <= max(0.0, np.quantile(over, 0.01, method="higher")))


def make_update(config: Config, spec: Spec, feature_map: features.FeatureMap, hazard: BoundHazard):
    return clone(config, lambda normaliser, batch: normaliser.state(batch.features[:, 0]))


def clone(config: Config, see: Callable[[Normaliser, Batch], Array]):
    """update(state, batch, key) of actors that read `see(normaliser, batch)` (B, N, inputs)."""
    opt = Optimiser.of(config)

    def loss(params: PyTree, frozen: PyTree, batch: Batch) -> tuple[jax.Array, Metrics]:
        action = ac.act(params["actor"], see(frozen["normaliser"], batch))
        value = ((action - batch.actions[:, 0]) ** 2).sum(-1).mean()
        return value, {"loss/cloning": value}

    def update(state: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
        grads, metrics = jax.grad(loss, has_aux=True)(state["params"], state["frozen"], batch)
        state, norms = stepped(state, grads, opt, config.ema)
        return state, metrics | norms

    return update


def make_policy(state: PyTree, config: Config, spec: Spec, feature_map, hazard: BoundHazard, options=None) -> Direct:
    return Direct(state["ema"]["actor"], state["frozen"]["normaliser"], spec, feature_map)


BC = Algorithm(
    "bc",
    Config,
    check,
    init,
    make_update,
    ac.no_diagnosis,
    make_policy,
    # `joint`: with all that a planner sees
    {
        "default": {},
        "mujoco": {"num_updates": 8_000},
        "joint": {"view": "pruned"},
        "mujoco-joint": {"view": "pruned", "num_updates": 8_000},
    },
    cost_source=cost_source,
    make_windows=make_windows,
)
BC_SAFE = replace(
    BC,
    name="bc-safe",
    presets={"default": {"cost_limit": 0.0}, "mujoco": {"cost_limit": 25.0, "num_updates": 20_000}},
    limit="cost_limit",
)
