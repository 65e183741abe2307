"""Systems in which danger is no distance alone: a cylinder, how soon two meet, who is near and fast, who is in sight.

None of them chose a setting. Names of entries and units are those that somebody might give who knows this project by
its README alone.
"""

from __future__ import annotations

import numpy as np
from _system import Carts, System, entries, length


class Sector(System):
    """Aircraft at three levels: no two may be within 9.26 km across *and* 300 m in height."""

    n, steps, dt, actions, noise = 4, 60, 5.0, 3, (0.85, 0.35)  # they turn, climb and accelerate
    names = entries(
        ["x", "y", "altitude", "speed", "heading_sin", "heading_cos", "climb", "exit_dx", "exit_dy", "exit_dz"],
        "intruder",
        3,
        ["dx", "dy", "dz", "dvx", "dvy", "dvz"],
    )
    across, in_height = 9.26, 0.3  # km
    levels = (8.0, 8.6, 9.2)  # km
    turn, climb_rate, faster = np.radians(1.5) * 5.0, 0.012, 0.002  # rad a step, km/s, km/s a step
    slowest, fastest = 0.18, 0.27  # km/s

    def begin(self, rng):
        around = rng.uniform(0, 2 * np.pi) + 2 * np.pi * (np.arange(4) + rng.uniform(-0.3, 0.3, 4)) / 4
        far = rng.uniform(30, 40, 4)
        height = rng.choice(self.levels, 4) + rng.normal(0, 0.1, 4)
        self.p = np.stack([far * np.cos(around), far * np.sin(around), height], 1)
        self.exit = np.concatenate([-self.p[:, :2], rng.choice(self.levels, (4, 1))], 1)
        gap = self.exit - self.p
        self.heading = np.arctan2(gap[:, 1], gap[:, 0]) + rng.normal(0, 0.1, 4)
        self.speed = rng.uniform(0.20, 0.25, 4)
        self.climb = np.zeros(4)

    def velocity(self):
        return np.stack([self.speed * np.cos(self.heading), self.speed * np.sin(self.heading), self.climb], 1)

    def seen(self):
        own = np.stack([self.speed, np.sin(self.heading), np.cos(self.heading), self.climb], 1)
        velocity = self.velocity()
        others = self.others()
        relative = [self.p[others] - self.p[:, None], velocity[others] - velocity[:, None]]
        return np.concatenate([self.p, own, self.exit - self.p, np.concatenate(relative, -1).reshape(4, -1)], 1)

    def danger(self):
        gap = np.abs(self.p[:, None] - self.p[None])[np.triu_indices(4, 1)]
        return bool(((np.hypot(gap[:, 0], gap[:, 1]) < self.across) & (gap[:, 2] < self.in_height)).any())

    def move(self, actions):
        before = length((self.exit - self.p)[:, :2])
        turn, climb, faster = actions.T
        self.heading = self.heading + self.turn * turn
        self.climb = self.climb + 0.6 * (self.climb_rate * climb - self.climb)
        self.speed = np.clip(self.speed + self.faster * faster, self.slowest, self.fastest)
        self.p = self.p + self.dt * self.velocity()
        after = length((self.exit - self.p)[:, :2])
        return float((before - after).mean() - 0.3 * np.abs(self.exit - self.p)[:, 2].mean())

    @classmethod
    def naive(cls, seen, state=None):
        """To the exit and its level, past nobody."""
        off = np.arctan2(seen[:, 8], seen[:, 7]) - np.arctan2(seen[:, 4], seen[:, 5])
        off = (off + np.pi) % (2 * np.pi) - np.pi
        return np.clip(np.stack([off / cls.turn, seen[:, 9] / 0.12, (0.24 - seen[:, 3]) * 100], 1), -1, 1)

    @classmethod
    def careful(cls, seen, care):
        """Climbs and turns away."""
        action = cls.naive(seen)
        for i in range(4):
            for dx, dy, dz, dvx, dvy, _ in seen[i, 10:].reshape(3, 6):
                far = np.hypot(dx, dy)
                closing = max(-(dx * dvx + dy * dvy) / (far + 1e-6), 0.0)
                if abs(dz) > 0.6 or far > 14 + 60 * closing:
                    continue
                action[i, 1] += 2 * care * (np.sign(-dz) if abs(dz) > 0.02 else (-1) ** (i % 2))
                if far < 14:
                    action[i, 0] += care * (1 if dx * seen[i, 4] > dy * seen[i, 5] else -1)
        return action


class Meeting(Carts):
    """No two carts may come nearer so fast that they would be 0.4 m apart in 1.2 s."""

    def danger(self):
        gap = self.p[:, None] - self.p[None]
        far = self.gaps(self.p)
        closing = -(gap * (self.v[:, None] - self.v[None])).sum(-1) / far
        return bool((far - 0.4 < 1.2 * closing).any())

    @classmethod
    def naive(cls, seen, state=None):
        """To the goal, past nobody."""
        return np.clip(1.5 * seen[:, 4:6] - 1.8 * seen[:, 2:4], -1, 1)

    @classmethod
    def careful(cls, seen, care):
        """Away from who is near, and past them on the right."""
        action = cls.naive(seen)
        offset = seen[:, 6:].reshape(4, 3, 4)[..., :2]
        far = length(offset)[..., None]
        aside = np.stack([-offset[..., 1], offset[..., 0]], -1) / far
        away = -2 * (2 - far) * offset / far + 0.8 * aside
        return action + care * np.where(far < 2, away, 0.0).sum(1)


class Docks(Carts):
    """Docks that lie together: within 2 m of another cart nobody may drive faster than 0.5 m/s."""

    steps, dt, noise = 80, 0.2, (0.85, 0.12)
    names = entries(
        ["px", "py", "velocity_x", "velocity_y", "dock_dx", "dock_dy"], "cart", 3, ["dx", "dy", "dvx", "dvy"]
    )
    near, slow = 2.0, 0.5

    def begin(self, rng):
        around = rng.uniform(0, 2 * np.pi) + 2 * np.pi * (np.arange(4) + rng.uniform(-0.3, 0.3, 4)) / 4
        self.p = np.stack([np.cos(around), np.sin(around)], 1) * rng.uniform(4, 7, (4, 1))
        self.v = np.zeros((4, 2))
        docks = np.array([[0.6, 0.6], [0.6, -0.6], [-0.6, 0.6], [-0.6, -0.6]])
        self.goal = docks[rng.permutation(4)] + rng.normal(0, 1.0, 2)

    def danger(self):
        return bool(((self.gaps(self.p).min(1) < self.near) & (length(self.v) > self.slow)).any())

    @classmethod
    def naive(cls, seen, state=None):
        """To the dock, as fast as it can stop there."""
        return cls.driven(seen, 1.4)

    @classmethod
    def careful(cls, seen, care):
        """Slower where somebody is near."""
        near = length(seen[:, 6:].reshape(4, 3, 4)[..., :2]).min(1) < cls.near + 0.8
        return cls.driven(seen, np.where(near, 0.3 + (1 - care) * 1.1, 1.4)[:, None])


class Sprayers(System):
    """Robots that spray ahead of them: nobody may be within 1.5 m and 40 degrees of where another looks."""

    n, steps, dt, actions, noise = 4, 80, 0.1, 2, (0.9, 0.25)  # they turn and accelerate
    names = entries(
        ["x", "y", "speed", "heading_cos", "heading_sin", "plant_dx", "plant_dy"],
        "robot",
        3,
        ["dx", "dy", "dvx", "dvy"],
    )
    far, wide = 1.5, np.radians(40.0)  # m, rad to either side
    turn, push, fastest = 2.5, 2.0, 1.2  # rad/s, m/s², m/s

    def begin(self, rng):
        while True:
            self.p, self.goal = rng.uniform(-3.5, 3.5, (2, 4, 2))
            if min(self.gaps(self.p).min(), self.gaps(self.goal).min()) > 1.2:
                break
        gap = self.goal - self.p
        self.heading = np.arctan2(gap[:, 1], gap[:, 0]) + rng.normal(0, 0.3, 4)
        self.speed = np.zeros(4)

    def looks(self):
        return np.stack([np.cos(self.heading), np.sin(self.heading)], 1)

    def seen(self):
        others = self.others()
        velocity = self.speed[:, None] * self.looks()
        relative = [self.p[others] - self.p[:, None], velocity[others] - velocity[:, None]]
        own = [self.p, self.speed[:, None], self.looks(), self.goal - self.p]
        return np.concatenate([*own, np.concatenate(relative, -1).reshape(4, -1)], 1)

    def danger(self):
        gap = self.p[None] - self.p[:, None]
        far = self.gaps(self.p)
        ahead = (gap * self.looks()[:, None]).sum(-1) / far
        return bool(((far < self.far) & (ahead > np.cos(self.wide))).any())

    def move(self, actions):
        before = length(self.goal - self.p)
        self.heading = self.heading + self.dt * self.turn * actions[:, 0]
        self.speed = np.clip(self.speed + self.dt * self.push * actions[:, 1], 0.0, self.fastest)
        self.p = self.p + self.dt * self.speed[:, None] * self.looks()
        return float((before - length(self.goal - self.p)).mean())

    @classmethod
    def naive(cls, seen, state=None):
        """To the plant, past nobody."""
        off, far = cls._off(seen, seen[:, 5:7])
        wanted = np.minimum(1.1, np.sqrt(1.5 * far)) * np.maximum(np.cos(off), 0.0)
        return np.clip(np.stack([2.0 * off, 3.0 * (wanted - seen[:, 2])], 1), -1, 1)

    @classmethod
    def careful(cls, seen, care):
        """Turns away from who would be ahead."""
        action = cls.naive(seen)
        for k in range(3):
            off, far = cls._off(seen, seen[:, 7 + 4 * k : 9 + 4 * k])
            ahead = (far < 2.2) & (np.abs(off) < np.radians(65))
            action[:, 0] -= care * np.where(ahead, 1.8 * np.where(off >= 0, 1.0, -1.0), 0.0)
            action[:, 1] -= care * np.where(ahead & (far < 2.0), 0.8, 0.0)
        return action

    @staticmethod
    def _off(seen, gap):
        """By what angle (N,) something is to the left of where one looks, and how far away."""
        off = np.arctan2(gap[:, 1], gap[:, 0]) - np.arctan2(seen[:, 4], seen[:, 3])
        return (off + np.pi) % (2 * np.pi) - np.pi, length(gap)
