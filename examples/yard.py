"""Your own robots, danger by a cost column alone: four discs with momentum cross a yard.

    python examples/yard.py            # logs, World, cloning, and what a guard makes of it; some minutes

Nothing here is known to the library: the simulator stands for your robots, its careless controller for whatever made
your logs. Full braking takes ten steps, and 16 to 20 % of the logged episodes end with a contact.
"""

from __future__ import annotations

import sys

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

import ringfence

N, RADIUS, SPEED, PUSH, DT, WALL, STEPS = 4, 0.15, 1.0, 1.0, 0.1, 2.2, 80  # m, m/s, m/s², s, m
OTHERS = np.array([[j for j in range(N) if j != i] for i in range(N)])
NAMES = ["own.vx", "own.vy", "own.x", "own.y", "goal.dx", "goal.dy"]
NAMES += [f"other{j}.d{c}" for j in range(N - 1) for c in "xy"] + [
    f"other{j}.dv{c}" for j in range(N - 1) for c in "xy"
]


def begin(rng: np.random.Generator, batch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions near a circle, rest, goals across it: each (B, N, 2)."""
    turn = rng.uniform(0, 2 * np.pi, (batch, 1)) + np.arange(N) * 2 * np.pi / N + rng.normal(0, 0.25, (batch, N))
    back = turn + np.pi + rng.normal(0, 0.2, (batch, N))
    place, goal = (
        np.stack([np.cos(a), np.sin(a)], -1) * (1.6 + rng.normal(0, 0.12, (batch, N)))[..., None] for a in (turn, back)
    )
    return place, np.zeros_like(place), goal


def seen(p: np.ndarray, v: np.ndarray, g: np.ndarray) -> np.ndarray:
    """(B, N, 18) what every robot observes."""
    apart = [(x[:, OTHERS] - x[:, :, None]).reshape(len(x), N, -1) for x in (p, v)]
    return np.concatenate([v, p, g - p, *apart], -1).astype(np.float32)


def move(p: np.ndarray, v: np.ndarray, g: np.ndarray, action: np.ndarray):
    """One step: positions, velocities, reward (B, N), cost (B,). Contact is inelastic; walls stop."""
    v = v + np.clip(action, -1, 1) * PUSH * DT
    v = v * np.minimum(1, SPEED / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9))
    before = np.linalg.norm(p - g, axis=-1)
    p = p + v * DT
    out = np.abs(p) > WALL
    p, v = np.clip(p, -WALL, WALL), np.where(out, 0, v)
    cost = np.zeros(len(p), bool)
    for i in range(N):
        for j in range(i):
            gap = p[:, j] - p[:, i]
            far = np.linalg.norm(gap, axis=-1)
            hit = far < 2 * RADIUS
            normal = gap / np.maximum(far, 1e-9)[:, None]
            closing = np.maximum(((v[:, i] - v[:, j]) * normal).sum(-1), 0)
            push = (0.5 * closing * hit)[:, None] * normal
            v[:, i] -= push
            v[:, j] += push
            cost |= hit
    after = np.linalg.norm(p - g, axis=-1)
    return p, v, before - after + 0.05 * (after < 0.2), cost.astype(float)


class Yard(ParallelEnv):
    """The yard behind PettingZoo's API; every agent gets the cost of contact."""

    metadata = {"name": "yard"}

    def __init__(self):
        self.possible_agents = [f"robot{i}" for i in range(N)]
        self.observation_spaces = {a: Box(-np.inf, np.inf, (len(NAMES),)) for a in self.possible_agents}
        self.action_spaces = {a: Box(-1, 1, (2,)) for a in self.possible_agents}

    def observation_space(self, agent):
        return self.observation_spaces[agent]

    def action_space(self, agent):
        return self.action_spaces[agent]

    def reset(self, seed=None, options=None):
        self.now, self.t = begin(np.random.default_rng(seed), 1), 0
        self.agents = list(self.possible_agents)
        return self._by_agent(seen(*self.now)[0]), {a: {} for a in self.agents}

    def step(self, actions):
        p, v, g = self.now
        p, v, reward, cost = move(p, v, g, np.array([actions[a] for a in self.possible_agents], float)[None])
        self.now, self.t = (p, v, g), self.t + 1
        over = self.t >= STEPS
        self.agents = [] if over else self.agents
        each = self._by_agent
        ends = each([False] * N), each([over] * N)
        return each(seen(p, v, g)[0]), each(reward[0].tolist()), *ends, each([{"cost": float(cost[0])}] * N)

    def _by_agent(self, rows):
        return dict(zip(self.possible_agents, rows))


class Careless:
    """Seeks its goal and avoids others late or weakly, each robot as it feels in this episode."""

    def __init__(self, rng: np.random.Generator, batch: int):
        self.rng = rng
        self.heed = rng.uniform(0.35, 2.4, (batch, N, 1))  # s ahead
        self.gain = rng.uniform(0.4, 1.6, (batch, N, 1))
        self.drift = np.zeros((batch, N, 2))

    def __call__(self, p: np.ndarray, v: np.ndarray, g: np.ndarray) -> np.ndarray:
        gap = g - p
        far = np.linalg.norm(gap, axis=-1, keepdims=True)
        wanted = gap / np.maximum(far, 1e-6) * np.minimum(0.95, np.sqrt(1.2 * far) * (far > 0.03))
        dp, dv = p[:, OTHERS] - p[:, :, None], v[:, OTHERS] - v[:, :, None]
        time = np.clip(-(dp * dv).sum(-1) / np.maximum((dv**2).sum(-1), 1e-6), 0, 5)  # of closest approach
        miss = np.linalg.norm(dp + dv * time[..., None], axis=-1)
        d = np.linalg.norm(dp, axis=-1)
        away = -dp / np.maximum(d, 1e-6)[..., None]
        right = np.stack([-away[..., 1], away[..., 0]], -1)
        soon = (time < self.heed) & (time > 0) & (miss < 0.5)
        urge = soon * np.clip(1 - miss / 0.6, 0, 1) * np.clip(1.5 - time / self.heed, 0, 1.5)
        near = np.clip(0.45 - d, 0, 0.45) * 6 * (self.heed > 0.6)
        push = (wanted - v) / 0.35 + 2 * self.gain * (urge[..., None] * (1.2 * away + 1.6 * right)).sum(2)
        push = push + self.gain * (near[..., None] * away).sum(2)
        self.drift = 0.9 * self.drift + self.rng.normal(0, 0.12, self.drift.shape)
        return np.clip(push + self.drift + self.rng.normal(0, 0.15, push.shape), -1, 1)


def record(episodes: int = 3000, seed: int = 0) -> ringfence.EpisodeStore:
    """What the careless controller did, as a store: no state, no formula, one cost for the team."""
    rng = np.random.default_rng(seed)
    p, v, g = begin(rng, episodes)
    act = Careless(rng, episodes)
    rows, kept = [seen(p, v, g)], []
    for _ in range(STEPS):
        action = act(p, v, g)
        p, v, reward, cost = move(p, v, g, action)
        rows.append(seen(p, v, g))
        kept.append((action, reward, cost))
    actions, rewards, costs = (np.stack(x, 1) for x in zip(*kept))
    card = {"task": "yard", "observation_names": NAMES, "provenance": "examples/yard.py"}
    return ringfence.EpisodeStore.from_episodes(np.stack(rows, 1), actions, rewards, costs, card=card)


def main(episodes: int = 200) -> None:
    store = record()
    touched = (store.episode_costs > 0).mean()
    print(f"logs: {store.episodes} episodes, return {store.returns.mean():.2f}, {100 * touched:.0f} % with contact")
    world = ringfence.fit(store, quiet=False)
    print(world.card)
    run = ringfence.train("bc", store)[0]
    for guard in ("none", "shield", "full"):
        how = {} if guard == "none" else {"guard": guard, "world": world}
        result = ringfence.play(run, Yard, episodes=episodes, num_envs=100, **how)
        bad = 100 * result["violation_rate"]
        print(f"cloning, guard {guard:7} return {result['return_mean']:.2f}, {bad:.1f} % of episodes with contact")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
