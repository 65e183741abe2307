"""Logs in the view of the World that evaluates."""

from __future__ import annotations

import numpy as np

from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData
from ringfence.world import World


class Logs:
    """A store in a World's view: T steps in E episodes, actions in [−1, 1], rewards and costs of the team.

    `x` (T + E, N, D) holds an episode's last state, too, so `row` (T,) says where a step begins.
    """

    def __init__(self, store: EpisodeStore, world: World):
        arrays = WindowData(store, world.map).arrays
        self.store = store
        self.x = arrays["features"]
        self.actions = np.asarray(arrays["actions"])
        self.row = np.arange(store.steps) + store.episode_of_step
        self.rewards = store.rewards.mean(1)
        self.costs = store.team_costs.astype(np.float32)
        self.terminated = store.terminated
        self.episode = store.episode_of_step
        self.step_of_start = np.concatenate([[0], store.episode_ends[:-1]])  # (E,)
        self.starts = self.step_of_start + np.arange(store.episodes)  # (E,) rows
        self.last_step = np.repeat(store.episode_ends - 1, store.lengths)  # of each step's episode
        self.joint = world.map.joint

    @property
    def steps(self) -> int:
        return self.store.steps

    @property
    def episodes(self) -> int:
        return self.store.episodes
