"""Small systems of agents who log rows of numbers and a cost of the team, with drivers who take more and less care."""

from __future__ import annotations

from typing import ClassVar

import gymnasium
import numpy as np
from pettingzoo import ParallelEnv

from ringfence.logs.store import EpisodeStore

CARE = (0.0, 0.5, 1.0)  # of the drivers who are logged


class System(ParallelEnv):
    """Agents who see rows of numbers, share a reward, and a cost where any of them is in danger."""

    n: ClassVar[int]
    steps: ClassVar[int]
    dt: ClassVar[float]  # s
    names: ClassVar[list[str]]  # of the numbers that each sees
    actions: ClassVar[int]
    noise: ClassVar[tuple[float, float]]  # of logged drivers: how much of it stays for a step, and how much comes

    def __init__(self):
        self.possible_agents = [f"agent_{i}" for i in range(self.n)]
        self.metadata = {"name": type(self).__name__.lower(), "dt": self.dt}

    def observation_space(self, agent):
        return gymnasium.spaces.Box(-np.inf, np.inf, (len(self.names),))

    def action_space(self, agent):
        return gymnasium.spaces.Box(-1.0, 1.0, (self.actions,))

    def reset(self, seed=None, options=None):
        rng = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self.t = 0
        self.begin(rng)
        while self.danger():
            self.begin(rng)
        return self._by_agent(self.seen()), {a: {} for a in self.agents}

    def step(self, actions):
        reward, cost = self.moved(np.array([actions[a] for a in self.possible_agents]))
        agents = self.agents
        over = self.t >= self.steps
        self.agents = [] if over else agents
        seen = self._by_agent(self.seen())
        rewards = {a: reward for a in agents}
        infos = {a: {"cost": cost} for a in agents}
        return seen, rewards, {a: False for a in agents}, {a: over for a in agents}, infos

    def moved(self, actions):
        """(reward, cost) of actions (N, A)."""
        reward = self.move(np.clip(actions, -1, 1))
        self.t += 1
        return reward, float(self.danger())

    def others(self):
        """(N, N − 1) who the others are."""
        return np.array([[j for j in range(self.n) if j != i] for i in range(self.n)])

    def gaps(self, places):
        """(N, N) how far each is from each; far from oneself."""
        return length(places[:, None] - places[None]) + 9 * np.eye(self.n)

    def _by_agent(self, rows):
        return {a: row.astype(np.float32) for a, row in zip(self.possible_agents, rows)}

    @classmethod
    def recorded(cls, episodes: int, seed: int) -> EpisodeStore:
        """Logs of drivers who take care not at all, by half or fully, with noise."""
        rng = np.random.default_rng(seed)
        env = cls()
        keep, more = cls.noise
        kept = []
        for _ in range(episodes):
            care = rng.choice(CARE)
            env.reset(seed=int(rng.integers(2**31)))
            noise = np.zeros((cls.n, cls.actions))
            rows, steps = [env.seen()], []
            for _ in range(cls.steps):
                noise = keep * noise + rng.normal(0, more, noise.shape)
                action = np.clip(cls.careful(rows[-1], care) + noise, -1, 1)
                steps.append((action, *env.moved(action)))
                rows.append(env.seen())
            kept.append((rows, *zip(*steps)))
        observations, actions, rewards, costs = (np.array(x) for x in zip(*kept))
        rewards = np.repeat(rewards[..., None], cls.n, -1)
        about = {"task": cls.__name__.lower(), "observation_names": cls.names, "dt": cls.dt}
        card = {**about, "provenance": "benchmarks/shapes.py"}
        return EpisodeStore.from_episodes(observations, actions, rewards, costs, card=card)


def length(vectors):
    return np.sqrt((vectors**2).sum(-1))


def entries(own: list[str], kind: str, others: int, each: list[str]) -> list[str]:
    return own + [f"{kind}{k}_{e}" for k in range(others) for e in each]


class Carts(System):
    """Carts in a square that push themselves along x and y."""

    n, steps, dt, actions, noise = 4, 80, 0.1, 2, (0.9, 0.3)
    names = entries(["x", "y", "vx", "vy", "to_goal_x", "to_goal_y"], "cart", 3, ["dx", "dy", "dvx", "dvy"])
    push, fastest = 1.5, 1.5  # m/s², m/s along each axis
    room = (4.0, 4.0)  # m to either side that carts and goals are in
    apart = 1.0  # m at least, of both

    def begin(self, rng):
        while True:
            self.p, self.goal = rng.uniform(-np.array(self.room), self.room, (2, self.n, 2))
            self.v = np.zeros((self.n, 2))
            if min(self.gaps(self.p).min(), self.gaps(self.goal).min()) > self.apart:
                return

    def seen(self):
        others = self.others()
        relative = [self.p[others] - self.p[:, None], self.v[others] - self.v[:, None]]
        return np.concatenate([self.p, self.v, self.goal - self.p, np.concatenate(relative, -1).reshape(self.n, -1)], 1)

    def move(self, actions):
        before = length(self.goal - self.p)
        self.v = np.clip(self.v + self.dt * self.push * actions, -self.fastest, self.fastest)
        self.p = self.p + self.dt * self.v
        return float((before - length(self.goal - self.p)).mean())

    @classmethod
    def driven(cls, seen, fastest):
        """Actions to the goal, at most so fast (m/s) that it can stop there."""
        gap = seen[:, 4:6]
        far = length(gap)[:, None]
        wanted = gap / np.maximum(far, 1e-6) * np.minimum(fastest, np.sqrt(1.5 * far))
        return np.clip(0.5 * (wanted - seen[:, 2:4]) / (cls.dt * cls.push), -1, 1)


class AmongPeople(Carts):
    """Carts among two people who walk to and fro."""

    def begin(self, rng):
        super().begin(rng)
        around = rng.uniform(0, 2 * np.pi, 2)
        self.walk = 0.5 * np.stack([np.cos(around), np.sin(around)], 1)
        self.people = rng.uniform(-3, 3, (2, 2))

    def move(self, actions):
        self.walk = np.where(np.abs(self.people + self.dt * self.walk) > 4, -self.walk, self.walk)
        self.people = self.people + self.dt * self.walk
        return super().move(actions)
