"""What there is to solve: a simulator, a definition of danger, a data tier, and the constants of its table."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import numpy as np

from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints, features
from ringfence.types import Env, Spec


@dataclass(frozen=True)
class Task:
    """One row of the benchmark. Normalised return: (r − return_min)/(return_max − return_min); normalised cost:
    (c + cost_offset)/(cost_limit + cost_offset), both per episode."""

    name: str
    env: Env | None  # None: a task that exists only as data
    hazard: constraints.Hazard
    tier: str = ""
    return_min: float = 0.0
    return_max: float = 1.0
    cost_limit: float = 1.0  # l
    cost_offset: float = 0.0  # k
    published_return: tuple[float, float | None] | None = None  # mean and deviation (if known) of the public data set
    transitions: int = 1_000_000  # of the full data set
    presets: tuple[str, ...] = ()  # of algorithms that have one of these: the one to take unless told otherwise
    protocol: str = ""  # where a task exists with several limits: which one this is
    action_low: float = -1.0
    action_high: float = 1.0
    recipe: ModuleType | None = None  # how its data sets are regenerated (data/recipes); None: they cannot be
    alike: bool = False  # its agents are alike and see for themselves (each.py)

    @property
    def world(self) -> dict:
        """What settings of a World its simulator asks for."""
        return dict(getattr(self.env, "world", {}))

    @property
    def guard(self) -> dict[str, dict]:
        """Options of named guards that its simulator asks for."""
        return dict(getattr(self.env, "guard", {}))

    def normalised_return(self, r):
        return (r - self.return_min) / (self.return_max - self.return_min)

    def normalised_cost(self, c):
        return (c + self.cost_offset) / (self.cost_limit + self.cost_offset)

    def logs(self, store: EpisodeStore) -> EpisodeStore:
        """What is learned from: the store, or every agent's own part of it."""
        return store.apart() if self.alike and store.n_agents > 1 else store

    def feature_map(self, view: str, store: EpisodeStore | None = None) -> features.FeatureMap:
        """s̃_i of this task. Tasks that exist only as data need the store to see which entries vary."""
        if hasattr(self.env, "feature_map"):
            return self.env.feature_map(view)
        if store is None:
            raise UserError(f"Task '{self.name}' has no simulator, so its features come from data; pass the store.")
        width = 0 if store.state is None else store.state.shape[1]
        names = store.card["observation_names"] or [f"obs{d}" for d in range(store.observations.shape[2])]
        state_names = store.card["state_names"] or [f"state{d}" for d in range(width)]
        firsts = np.concatenate([[0], store.episode_ends[:-1]]) + np.arange(store.episodes)
        keep = constraints.reads(self.hazard, store.n_agents, tuple(names))
        told = store.observations, store.state, tuple(names), tuple(state_names), firsts, keep
        return features.from_data(view, *told, alike=self.alike, dt=store.card.get("dt"))

    def spec(self, feature_map: features.FeatureMap, store: EpisodeStore | None = None) -> Spec:
        env = self.env
        if env is not None:
            n, a, length = env.n_agents, env.action_dim, env.episode_length
        elif store is not None:
            n, a, length = store.n_agents, store.actions.shape[2], int(store.lengths.max())
        else:
            raise UserError(f"Task '{self.name}' has no simulator; pass the store to learn its sizes.")
        n = 1 if self.alike else n
        sizes = None if env is not None else store.card.get("action_sizes")
        names, bounds = feature_map.names, (self.action_low, self.action_high)
        return Spec(self.name, n, a, names, *bounds, length, self.alike, sizes and tuple(sizes))
