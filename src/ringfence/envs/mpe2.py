"""Simple Spread as everybody else plays it: MPE2's `simple_spread_v3`, its physics and its rewards, with the actions,
state and costs that policies of this package's data know (`pip install mpe2`).

    ringfence play RUN --env ringfence.envs.mpe2:Spread --episodes 200 --guard shield

It moves positions with the *old* velocity, the public data with the new one (simple_spread.py), so what a policy does
comes a step later there than where its logs are from.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ringfence.envs.pettingzoo import _Parallel
from ringfence.envs.simple_spread import CONTACT_DISTANCE, SimpleSpread
from ringfence.errors import UserError


class Spread(_Parallel):
    """`simple_spread_v3` of three agents for 25 steps. An action (2,) in [−1, 1] is the force's direction, theirs has
    five entries of which two are against two others; `state()` (18,) holds positions, velocities and landmarks; infos
    tell `cost` 1 while anybody touches."""

    metadata: dict[str, Any] = {"name": "mpe2_simple_spread_v3"}

    def __init__(self):
        try:
            from mpe2 import simple_spread_v3
        except ImportError:
            raise UserError("MPE2's simple_spread_v3 is not installed; run pip install mpe2.") from None
        core = SimpleSpread()
        self.theirs = simple_spread_v3.parallel_env(
            N=core.n_agents, max_cycles=core.episode_length, continuous_actions=True
        )
        super().__init__(core, np.float32)

    def reset(self, seed: int | None = None, options: dict | None = None):
        seen, infos = self.theirs.reset(seed=seed)
        self.agents = list(self.theirs.agents)
        return seen, {a: {"cost": 0.0} for a in infos}

    def step(self, actions: dict[str, Any]):
        five = {}
        for agent, action in actions.items():
            x, y = np.clip(np.asarray(action, np.float32), -1.0, 1.0)
            five[agent] = np.array([0, max(-x, 0), max(x, 0), max(-y, 0), max(y, 0)], np.float32)
        seen, reward, terminated, truncated, infos = self.theirs.step(five)
        self.agents = list(self.theirs.agents)
        place = np.stack([agent.state.p_pos for agent in self.theirs.unwrapped.world.agents])
        gap = np.linalg.norm(place[:, None] - place, axis=-1) + 9.0 * np.eye(len(place))
        cost = float((gap < CONTACT_DISTANCE).any())
        return seen, reward, terminated, truncated, {a: {"cost": cost} for a in infos}

    def state(self) -> np.ndarray:
        world = self.theirs.unwrapped.world
        positions = [agent.state.p_pos for agent in world.agents]
        velocities = [agent.state.p_vel for agent in world.agents]
        landmarks = [landmark.state.p_pos for landmark in world.landmarks]
        return np.concatenate([*positions, *velocities, *landmarks]).astype(np.float32)
