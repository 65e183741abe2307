"""The cheapest rivals of a return-conditioned planner: cloning the best episodes (`bc-best`), and an
actor that reads the return it is to reach (`bc-return`; Emmons et al. 2022, "RvS", whose outcomes are ours).

`bc-return` sees what the planner sees and is conditioned on the same return, at the same discount and target: what
differs is that it answers with one action and no plan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ringfence.algos import actor_critic as ac
from ringfence.algos import bc
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData
from ringfence.problem import features
from ringfence.problem.constraints import BoundHazard
from ringfence.proposals import conditions
from ringfence.proposals.base import Direct
from ringfence.types import Algorithm, Array, Key, PyTree, Spec
from ringfence.utils.config import AtLeastOne, Share
from ringfence.world import World


@dataclass(frozen=True)
class BestConfig(bc.Config):
    """Behaviour cloning on the share `best` of the episodes that earned most (10 % BC of Chen et al. 2021)."""

    best: float = 0.1  # share of the episodes, by the team's return; at least one


def best_of(store: EpisodeStore, config: BestConfig, feature_map: features.FeatureMap, world: None) -> WindowData:
    """The episodes that earned most, of those within the cost limit where there is one."""
    store = bc.within(store, config)
    earned = store.returns
    chosen = np.zeros(len(earned), bool)
    chosen[np.argsort(-earned, kind="stable")[: max(1, round(config.best * len(earned)))]] = True
    return WindowData(store.select(chosen), feature_map)


@dataclass(frozen=True)
class Config(bc.Config):
    """L = E ‖a_i − π_i(s̃_i, y)‖² with y the score of what followed; played with y = `target_return`."""

    view: features.View = "pruned"  # the planner's
    condition: conditions.Condition = "return"  # what y is: the return-to-go, ranked or raw, or the advantage
    discount: Share = 0.9  # of what y scores
    ahead: AtLeastOne = 8  # rows that an advantage is of
    target_return: float = 1.5  # y when it acts, as a normal score: the best 7 %; of the largest, if raw


class Asking(eqx.Module):
    """An actor with y as one more input."""

    net: Any
    target: float = eqx.field(static=True)

    def __call__(self, x: Array) -> Array:
        return self.net(with_score(x, self.target))


def with_score(x: Array, y: Array | float) -> Array:
    """(..., N, D) and y (...) -> (..., N, D + 1)."""
    y = jnp.broadcast_to(jnp.asarray(y, x.dtype)[..., None, None], (*x.shape[:-1], 1))
    return jnp.concatenate([x, y], -1)


def init(
    key: Key,
    spec: Spec,
    config: Config,
    data: WindowData | None,
    feature_map: features.FeatureMap,
    hazard: BoundHazard,
    world: World | None = None,
) -> PyTree:
    """As `bc`, with actors that read one entry more."""
    return bc.start(key, spec, config, data, spec.feature_dim + 1)


def make_windows(
    store: EpisodeStore, config: Config, feature_map: features.FeatureMap, world: World | None
) -> WindowData:
    """Windows with their scores."""
    kept = bc.within(store, config)
    return conditions.scored_windows(kept, feature_map, world, config.condition, config.ahead, config.discount)


def make_update(config: Config, spec: Spec, feature_map: features.FeatureMap, hazard: BoundHazard):
    return bc.clone(config, lambda normaliser, batch: with_score(normaliser.state(batch.features[:, 0]), batch.score))


def make_policy(state: PyTree, config: Config, spec: Spec, feature_map, hazard: BoundHazard, options=None) -> Direct:
    actor = Asking(state["ema"]["actor"], config.target_return)
    return Direct(actor, state["frozen"]["normaliser"], spec, feature_map)


BC_BEST = replace(
    bc.BC,
    name="bc-best",
    Config=BestConfig,
    make_windows=best_of,
    presets={"default": {}, "mujoco": {"num_updates": 20_000}},
)
BC_RETURN = Algorithm(
    "bc-return",
    Config,
    bc.check,
    init,
    make_update,
    ac.no_diagnosis,
    make_policy,
    {"default": {}, "mujoco": {"num_updates": 8_000}, "advantage": {"condition": "advantage"}},
    cost_source=bc.cost_source,
    make_windows=make_windows,
    world_settings=conditions.world_settings,
    from_world=lambda world, config: {},
)
