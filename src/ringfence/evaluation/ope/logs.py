"""Logs as the World that judges sees them."""

from __future__ import annotations

import numpy as np

from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData
from ringfence.world import World


class Logs:
    """The logs in the judging World's view: actions in [−1, 1], rewards and costs of the team."""

    def __init__(self, logs: EpisodeStore, world: World):
        arrays = WindowData(logs, world.map).arrays
        self.x, self.actions = arrays["features"], np.asarray(arrays["actions"])
        self.row = np.arange(logs.steps) + logs.episode_of_step  # of the state that a step begins in
        self.rewards, self.costs = logs.rewards.mean(1), logs.team_costs.astype(np.float32)
        self.terminated, self.episode = logs.terminated, logs.episode_of_step
        self.step_of_start = np.concatenate([[0], logs.episode_ends[:-1]])
        self.starts = self.step_of_start + np.arange(logs.episodes)
        self.joint = world.map.joint
        self.last_step = np.repeat(logs.episode_ends - 1, logs.lengths)
