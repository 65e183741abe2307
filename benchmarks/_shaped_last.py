"""Systems that chose nothing of the search: they were written after it. Drones over each other, carts among people who
walk, and a swarm of which each needs two companions."""

from __future__ import annotations

import numpy as np
from _shaped_more import Pushed
from _system import AmongPeople, entries, length


class Downwash(Pushed):
    """Drones in a hall: nobody may be within 0.6 m across and 1.5 m in height of another, who would blow it down."""

    actions = 3
    names = entries(
        ["x", "y", "z", "vx", "vy", "vz", "goal_x", "goal_y", "goal_z"],
        "drone",
        3,
        ["rel_x", "rel_y", "rel_z", "rel_vx", "rel_vy", "rel_vz"],
    )
    push, fastest, room = 2.0, 1.5, (3.0, 3.0, 1.5)
    across, in_height = 0.6, 1.5

    def begin(self, rng):
        self.p, self.goal = rng.uniform(-np.array(self.room), self.room, (2, 4, 3))
        self.v = np.zeros((4, 3))

    def danger(self):
        gap = np.abs(self.p[:, None] - self.p[None])[np.triu_indices(4, 1)]
        return bool(((length(gap[:, :2]) < self.across) & (gap[:, 2] < self.in_height)).any())

    @classmethod
    def naive(cls, seen, state=None):
        """To the goal, past nobody."""
        return np.clip(1.5 * seen[:, 6:9] - 1.8 * seen[:, 3:6], -1, 1)

    @classmethod
    def careful(cls, seen, care):
        """Aside, from whom it is over or under."""
        offset = seen[:, 9:].reshape(4, 3, 6)[..., :3]
        far = length(offset[..., :2])[..., None]
        near = (far < 1.3) & (np.abs(offset[..., 2:]) < 2.0)
        away = -2 * (1.6 - far) * offset[..., :2] / np.maximum(far, 0.1)
        action = cls.naive(seen)
        action[:, :2] += care * np.where(near, away, 0.0).sum(1)
        return action


class Pickers(AmongPeople):
    """Carts among two people who walk to and fro: within 1.5 m of one of them nobody may drive faster than 0.4 m/s."""

    n, noise = 3, (0.9, 0.25)
    names = entries(["x", "y", "v_x", "v_y", "shelf_x", "shelf_y"], "human", 2, ["x", "y", "vx", "vy"])
    names = entries(names, "cart", 2, ["x", "y", "vx", "vy"])
    push, fastest = 2.5, 1.6
    near, slow = 1.5, 0.4

    def seen(self):
        rows = super().seen()
        relative = [self.people[None] - self.p[:, None], self.walk[None] - self.v[:, None]]
        people = np.concatenate(relative, -1).reshape(self.n, -1)
        return np.concatenate([rows[:, :6], people, rows[:, 6:]], 1)

    def danger(self):
        near = length(self.people[None] - self.p[:, None]).min(1) < self.near
        return bool((near & (length(self.v) > self.slow)).any())

    @classmethod
    def naive(cls, seen, state=None):
        """To the shelf, as fast as it can stop there."""
        return cls.driven(seen, 1.4)

    @classmethod
    def careful(cls, seen, care):
        """Slower where somebody is near."""
        near = length(seen[:, 6:14].reshape(-1, 2, 4)[..., :2]).min(1) < cls.near + 0.7
        return cls.driven(seen, np.where(near, 0.2 + (1 - care) * 1.2, 1.4)[:, None])


class Swarm(Pushed):
    """Five robots in space whose radio has to reach two others, at most 3 m away; entries have no names."""

    n, actions = 5, 3
    names = [f"obs{d}" for d in range(9 + 4 * 6)]
    push, fastest = 1.5, 1.0
    far = 3.0

    def begin(self, rng):
        self.p = rng.uniform(-1.5, 1.5, (5, 3))
        self.goal = rng.uniform(-3.0, 3.0, (5, 3))
        self.v = np.zeros((5, 3))

    def danger(self):
        return bool((np.sort(self.gaps(self.p), 1)[:, 1] > self.far).any())

    @classmethod
    def naive(cls, seen, state=None):
        """To the goal, with nobody."""
        return np.clip(1.5 * seen[:, 6:9] - 1.8 * seen[:, 3:6], -1, 1)

    @classmethod
    def careful(cls, seen, care):
        """To the second nearest, where it is far."""
        offset = seen[:, 9:].reshape(5, 4, 6)[..., :3]
        second = np.argsort(length(offset), 1)[:, 1]
        gap = offset[np.arange(5), second]
        far = length(gap)[:, None]
        return cls.naive(seen) + care * np.where(far > 2.0, 4 * (far - 2.0) * gap / far, 0.0)
