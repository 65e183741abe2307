"""What there is to solve: a simulator, a definition of danger, a data tier, and the constants of its table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ringfence.envs.base import NativeEnv, PureEnv
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints, features
from ringfence.types import Bound, Policy, Spec

Card = dict[str, Any]


def whole_episodes(task: Task, transitions: int) -> int:
    """The size rounded up to whole episodes, where all have one length."""
    length = task.simulator.episode_length
    return -(-transitions // length) * length


@dataclass(frozen=True)
class Recipe:
    """How a task's data sets are regenerated: plain functions."""

    # task -> what the card says of the simulator; data of another one are made again
    about: Callable[[Task], Card]
    # (task, transitions, seed, card) -> a store whose card is `card` and more
    collect: Callable[[Task, int, int, Card], EpisodeStore]
    # (task, transitions) -> the size that is made where so many steps are asked for
    whole: Callable[[Task, int], int] = whole_episodes
    # task -> policies for rows beside the table: who collected the data, if that was one, and what is known to be good
    references: Callable[[Task], dict[str, Policy]] = lambda task: {}
    # (task, store) -> costs (T,) of kept steps under this task's danger and what the card says then; None where the
    # steps do not tell, or there is one definition of danger
    relabelled: Callable[[Task, EpisodeStore], tuple[np.ndarray, Card] | None] = lambda task, store: None


@dataclass(frozen=True)
class Task:
    """One row of the benchmark. Normalised return: (r − return_min)/(return_max − return_min); normalised cost:
    (c + cost_offset)/(cost_limit + cost_offset), both per episode."""

    name: str
    env: PureEnv | NativeEnv | None  # None: a task that exists only as data
    hazard: constraints.Hazard
    tier: str = ""
    return_min: float = 0.0
    return_max: float = 1.0
    cost_limit: float = 1.0  # l
    cost_offset: float = 0.0  # k
    published_return: tuple[float, float | None] | None = None  # mean and deviation (if known) of the public data set
    transitions: int = 1_000_000  # of the full data set
    presets: tuple[str, ...] = ()  # of algorithms that have one of these: the one to take by default
    protocol: str = ""  # where a task exists with several limits: which one this is
    action_low: Bound = -1.0
    action_high: Bound = 1.0
    recipe: Recipe | None = None  # how its data sets are regenerated; None: they cannot be
    homogeneous: bool = False  # its agents are homogeneous and see for themselves (problem/homogeneous.py)

    @property
    def simulator(self) -> PureEnv | NativeEnv:
        """Its simulator; `UserError` where the task exists only as data."""
        if self.env is None:
            raise UserError(f"Task '{self.name}' exists only as data, so it has no simulator; play in one of your own.")
        return self.env

    @property
    def world(self) -> dict[str, Any]:
        """What settings of a World its simulator asks for."""
        return {} if self.env is None else dict(self.env.world)

    @property
    def guard(self) -> dict[str, Mapping[str, Any]]:
        """Options of named guards that its simulator asks for."""
        return {} if self.env is None else dict(self.env.guard)

    @property
    def guard_by_card(self) -> bool:
        """Whether guards look as far as the World's card says, as they do in anybody's logs: nobody here knows better
        where costs alone say what is dangerous."""
        return self.env is None or isinstance(self.hazard, constraints.CostColumn)

    def normalised_return(self, value):
        """Of a return or of an array of them."""
        return (value - self.return_min) / (self.return_max - self.return_min)

    def normalised_cost(self, value):
        """Of a cost or of an array of them."""
        return (value + self.cost_offset) / (self.cost_limit + self.cost_offset)

    def logs(self, store: EpisodeStore) -> EpisodeStore:
        """What is learned from: the store, or every agent's own part of it."""
        return store.split_agents() if self.homogeneous and store.n_agents > 1 else store

    def feature_map(self, view: str, store: EpisodeStore | None = None, team: bool = False) -> features.FeatureMap:
        """s̃_i of this task. Tasks that exist only as data need the store to see which entries vary. Whoever acts or
        judges for the whole `team` reads everybody's observations."""
        if self.env is not None:
            return self.env.feature_map(view)
        if store is None:
            raise UserError(f"Task '{self.name}' has no simulator, so its features come from data; pass the store.")
        width = 0 if store.state is None else store.state.shape[1]
        names = store.entry_names
        state_names = store.card.state_names or [f"state{d}" for d in range(width)]
        return features.from_data(
            view,
            store.observations,
            store.state,
            names,
            tuple(state_names),
            first_rows=store.first_rows,
            keep=constraints.reads(self.hazard, store.n_agents, names),
            homogeneous=self.homogeneous,
            dt=store.card.dt,
            team=team,
        )

    def spec(self, feature_map: features.FeatureMap, store: EpisodeStore | None = None) -> Spec:
        """What an algorithm must know of this task; one that exists only as data needs the store."""
        if self.env is not None:
            agents = self.env.n_agents
            action_dim = self.env.action_dim
            episode_length = self.env.episode_length
            action_sizes = None
        elif store is not None:
            agents = store.n_agents
            action_dim = store.actions.shape[2]
            episode_length = int(store.lengths.max())
            action_sizes = store.card.action_sizes
        else:
            raise UserError(f"Task '{self.name}' has no simulator; pass the store to learn its sizes.")
        return Spec(
            task=self.name,
            n_agents=1 if self.homogeneous else agents,
            action_dim=action_dim,
            feature_names=feature_map.names,
            action_low=self.action_low,
            action_high=self.action_high,
            episode_length=episode_length,
            homogeneous=self.homogeneous,
            action_sizes=tuple(action_sizes) if action_sizes else None,
        )
