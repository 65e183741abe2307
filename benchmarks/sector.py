"""Danger in a cylinder: four aircraft cross a sector, and are too near where they are less than 9.26 km apart across
and less than 300 m in height. A naive driver and a clone of the logs, alone and under a shield, by a World whose causes
may have an axis by itself, and by one whose may not.

    python benchmarks/sector.py       # writes results/sector.csv and docs/proving-ground.md's table; twenty minutes

Rows that are there already are not made again.
"""

from __future__ import annotations

import warnings
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import gymnasium
import numpy as np
from _rows import append, read
from pettingzoo import ParallelEnv
from readme import put

import ringfence
from ringfence.evaluation.statistics import upper_bound
from ringfence.logs.store import EpisodeStore
from ringfence.world import cause_search

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "results" / "sector.csv"
N, STEPS, DT = 4, 60, 5.0  # s
ACROSS, IN_HEIGHT = 9.26, 0.3  # km
LEVELS = (8.0, 8.6, 9.2)  # km
TURN, CLIMB, FASTER = np.radians(1.5) * DT, 0.012, 0.002  # rad a step, km/s, km/s a step
SLOWEST, FASTEST = 0.18, 0.27  # km/s
LOGGED, EPISODES, SEED = 600, 200, 10
OWN = ["x", "y", "altitude", "speed", "heading_sin", "heading_cos", "climb", "exit_dx", "exit_dy", "exit_dz"]
NAMES = OWN + [f"intruder{k}_d{e}" for k in range(N - 1) for e in ("x", "y", "z", "vx", "vy", "vz")]
HEAD = ("driver", "causes", "verdict", "found", "guard", "episodes", "return", "violated", "bound", "infeasible")
WITH, WITHOUT = "an axis by itself", "no axis by itself"


class Sector(ParallelEnv):
    """Aircraft that fly across at three levels, each to the other side."""

    metadata = {"name": "sector", "dt": DT}

    def __init__(self):
        self.possible_agents = [f"aircraft_{i}" for i in range(N)]

    def observation_space(self, agent):
        return gymnasium.spaces.Box(-np.inf, np.inf, (len(NAMES),))

    def action_space(self, agent):
        return gymnasium.spaces.Box(-1.0, 1.0, (3,))  # turn, climb, accelerate

    def reset(self, seed=None, options=None):
        rng = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self.t = 0
        while True:
            around = rng.uniform(0, 2 * np.pi) + 2 * np.pi * (np.arange(N) + rng.uniform(-0.3, 0.3, N)) / N
            far = rng.uniform(30, 40, N)
            height = rng.choice(LEVELS, N) + rng.normal(0, 0.1, N)
            self.p = np.stack([far * np.cos(around), far * np.sin(around), height], 1)
            self.exit = np.concatenate([-self.p[:, :2], rng.choice(LEVELS, (N, 1))], 1)
            gap = self.exit - self.p
            self.heading = np.arctan2(gap[:, 1], gap[:, 0]) + rng.normal(0, 0.1, N)
            self.speed = rng.uniform(0.20, 0.25, N)
            self.climb = np.zeros(N)
            if not self.lost():
                return self._by_agent(self.seen()), {a: {} for a in self.agents}

    def velocity(self):
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return np.stack([self.speed * cos, self.speed * sin, self.climb], 1)

    def seen(self):
        """(N, O)"""
        own = [self.p, np.stack([self.speed, np.sin(self.heading), np.cos(self.heading), self.climb], 1)]
        velocity = self.velocity()
        others = np.array([[j for j in range(N) if j != i] for i in range(N)])
        relative = [self.p[others] - self.p[:, None], velocity[others] - velocity[:, None]]
        return np.concatenate([*own, self.exit - self.p, np.concatenate(relative, -1).reshape(N, -1)], 1)

    def lost(self):
        gap = np.abs(self.p[:, None] - self.p[None])[np.triu_indices(N, 1)]
        return bool(((np.hypot(gap[:, 0], gap[:, 1]) < ACROSS) & (gap[:, 2] < IN_HEIGHT)).any())

    def move(self, actions):
        """(reward, cost) of actions (N, 3)."""
        before = np.hypot(*(self.exit - self.p)[:, :2].T)
        turn, climb, faster = np.clip(actions, -1, 1).T
        self.heading = self.heading + TURN * turn
        self.climb = self.climb + 0.6 * (CLIMB * climb - self.climb)
        self.speed = np.clip(self.speed + FASTER * faster, SLOWEST, FASTEST)
        self.p = self.p + DT * self.velocity()
        self.t += 1
        after = np.hypot(*(self.exit - self.p)[:, :2].T)
        return float((before - after).mean() - 0.3 * np.abs(self.exit - self.p)[:, 2].mean()), float(self.lost())

    def step(self, actions):
        reward, cost = self.move(np.array([actions[a] for a in self.possible_agents]))
        over = self.t >= STEPS
        agents = self.agents
        self.agents = [] if over else agents
        rewards = {a: reward for a in agents}
        infos = {a: {"cost": cost} for a in agents}
        return self._by_agent(self.seen()), rewards, {a: False for a in agents}, {a: over for a in agents}, infos

    def _by_agent(self, rows):
        return {a: row.astype(np.float32) for a, row in zip(self.possible_agents, rows)}


def naive(seen, state=None):
    """(N, 3) to the exit and its level, past nobody."""
    off = np.arctan2(seen[:, 8], seen[:, 7]) - np.arctan2(seen[:, 4], seen[:, 5])
    off = (off + np.pi) % (2 * np.pi) - np.pi
    return np.clip(np.stack([off / TURN, seen[:, 9] / 0.12, (0.24 - seen[:, 3]) * 100], 1), -1, 1)


def record(seed: int) -> EpisodeStore:
    """Logs of drivers who take care not at all, by half or fully, by climbing and turning away, with noise."""
    rng = np.random.default_rng(seed)
    env = Sector()
    kept = []
    for _ in range(LOGGED):
        care = rng.choice([0.0, 0.5, 1.0])
        env.reset(seed=int(rng.integers(2**31)))
        noise = np.zeros((N, 3))
        rows, steps = [env.seen()], []
        for _ in range(STEPS):
            noise = 0.85 * noise + rng.normal(0, 0.35, (N, 3))
            action = np.clip(_careful(rows[-1], care) + noise, -1, 1)
            steps.append((action, *env.move(action)))
            rows.append(env.seen())
        kept.append((rows, *zip(*steps)))
    observations, actions, rewards, costs = (np.array(x) for x in zip(*kept))
    rewards = np.repeat(rewards[..., None], N, -1)
    card = {"task": "sector", "observation_names": NAMES, "dt": DT, "provenance": "benchmarks/sector.py"}
    return EpisodeStore.from_episodes(observations, actions, rewards, costs, card=card)


def _careful(seen, care):
    action = naive(seen)
    for i in range(N):
        for dx, dy, dz, dvx, dvy, _ in seen[i, len(OWN) :].reshape(N - 1, 6):
            far = np.hypot(dx, dy)
            closing = max(-(dx * dvx + dy * dvy) / (far + 1e-6), 0.0)
            if abs(dz) > 0.6 or far > 14 + 60 * closing:
                continue
            action[i, 1] += 2 * care * (np.sign(-dz) if abs(dz) > 0.02 else (-1) ** (i % 2))
            if far < 14:
                action[i, 0] += care * (1 if dx * seen[i, 4] > dy * seen[i, 5] else -1)
    return action


@contextmanager
def without_axes_apart():
    """The search for causes as it would be without those of which an axis counts by itself."""
    with mock.patch.object(cause_search, "_with_more_shapes", lambda steps, chosen, names: chosen):
        yield


def main() -> None:
    done = {(r["driver"], r["causes"], r["guard"]) for r in read(OUT)}
    store = record(SEED)
    warnings.simplefilter("ignore")
    clone = ringfence.train("bc", store, out=ROOT / "runs" / "sector", quiet=True)[0]
    worlds = {WITH: ringfence.fit(store)}
    with without_axes_apart():
        worlds[WITHOUT] = ringfence.fit(store, cached=False)
    for driver, act in (("naive", naive), ("clone", clone)):
        for causes, guard in ((WITH, "none"), (WITHOUT, "shield"), (WITH, "shield")):
            if (driver, causes, guard) in done:
                continue
            world = worlds[causes]
            how = {} if guard == "none" else {"guard": guard, "world": world, "anyway": True}
            if driver == "naive":
                act, how = ringfence.guard(naive, world, guard=guard, anyway=True), {}
            r = ringfence.play(act, Sector, episodes=EPISODES, num_envs=100, **how)
            bound = upper_bound(round(r["violation_rate"] * EPISODES), EPISODES)
            found = world.card.causes[""].causes
            about = [driver, causes, world.card.verdict.word, "; ".join(c.name for c in found) or "networks", guard]
            row = [*about, EPISODES, r["return_mean"], r["violation_rate"], bound, r.get("infeasible_rate", 0.0)]
            row = [f"{v:.5g}" if isinstance(v, float) else v for v in row]
            append(OUT, dict(zip(HEAD, row)), HEAD)
            print(row, flush=True)
    put("docs/proving-ground.md", "sector", table())


def table() -> str:
    lines = [
        "| who acts | causes found | verdict | episodes with a loss of separation, % | return |",
        "|---|---|---|---|---|",
    ]
    for r in read(OUT):
        world, verdict = ("no guard", "") if r["guard"] == "none" else (r["found"], r["verdict"])
        lost = f"{100 * float(r['violated']):.3g} (≤ {100 * float(r['bound']):.3g})"
        lines.append(f"| {r['driver']} | {world} | {verdict} | {lost} | {float(r['return']):.1f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
