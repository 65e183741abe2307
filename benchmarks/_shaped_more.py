"""Systems that were tried on the search for causes of those of _shaped.py: speed in a place and near persons, crowds,
boats that lose each other, who is ahead, and a junction for one at a time."""

from __future__ import annotations

import numpy as np
from _system import Carts, entries, length


class Depot(Carts):
    """A depot with a walkway: nobody may drive faster than 0.6 m/s across it."""

    n, noise = 3, (0.9, 0.25)
    names = entries(["pos_x", "pos_y", "vel_x", "vel_y", "goal_dx", "goal_dy"], "truck", 2, ["dx", "dy", "dvx", "dvy"])
    push, fastest, room = 2.0, 1.8, (5.0, 3.0)
    slow = 0.6

    @staticmethod
    def walkway(x, y):
        return (np.abs(x - 0.5) < 1.2) & (y < 1.0)

    def danger(self):
        return bool((self.walkway(*self.p.T) & (length(self.v) > self.slow)).any())

    @classmethod
    def naive(cls, seen, state=None):
        """To the goal, as fast as it can stop there."""
        return cls.driven(seen, 1.6)

    @classmethod
    def careful(cls, seen, care):
        """Slower on the walkway and half a second before it."""
        x, y, vx, vy = seen[:, :4].T
        there = cls.walkway(x, y) | cls.walkway(x + 0.5 * vx, y + 0.5 * vy)
        return cls.driven(seen, np.where(there, 0.4 + (1 - care) * 1.2, 1.6)[:, None])


class Persons(Carts):
    """Three persons stand about: nobody may drive faster than 0.5 m/s within 1.3 m of one."""

    n, noise = 3, (0.9, 0.25)
    names = entries(["x", "y", "vx", "vy", "target_dx", "target_dy"], "person", 3, ["dx", "dy"])
    names = entries(names, "truck", 2, ["dx", "dy", "dvx", "dvy"])
    push, fastest = 2.0, 1.6
    near, slow = 1.3, 0.5

    def begin(self, rng):
        super().begin(rng)
        self.persons = rng.uniform(-4, 4, (3, 2))

    def seen(self):
        rows = super().seen()
        persons = (self.persons[None] - self.p[:, None]).reshape(self.n, -1)
        return np.concatenate([rows[:, :6], persons, rows[:, 6:]], 1)

    def danger(self):
        near = length(self.persons[None] - self.p[:, None]).min(1) < self.near
        return bool((near & (length(self.v) > self.slow)).any())

    @classmethod
    def naive(cls, seen, state=None):
        """To the target, as fast as it can stop there."""
        return cls.driven(seen, 1.4)

    @classmethod
    def careful(cls, seen, care):
        """Slower where a person is near."""
        near = length(seen[:, 6:12].reshape(-1, 3, 2)).min(1) < cls.near + 0.5
        return cls.driven(seen, np.where(near, 0.3 + (1 - care) * 1.1, 1.4)[:, None])


class Pushed(Carts):
    """Carts whose naive driver is a spring with a damper, and whose careful one corrects it."""

    @classmethod
    def naive(cls, seen, state=None):
        """To the goal, past nobody."""
        return np.clip(1.5 * seen[:, 4:6] - 1.8 * seen[:, 2:4], -1, 1)

    @classmethod
    def offsets(cls, seen):
        """(N, N − 1, 2) where others are."""
        return seen[:, 6:].reshape(cls.n, cls.n - 1, 4)[..., :2]


class Crowd(Pushed):
    """Six robots: nobody may have two others within 1 m."""

    n, apart = 6, 0.0
    names = entries(["x", "y", "vx", "vy", "goal_dx", "goal_dy"], "robot", 5, ["dx", "dy", "dvx", "dvy"])
    fastest, room = 1.2, (3.0, 3.0)
    near = 1.0

    def danger(self):
        return bool((np.sort(self.gaps(self.p), 1)[:, 1] < self.near).any())

    @classmethod
    def careful(cls, seen, care):
        """Away from the middle of the two nearest, where the second is near."""
        offset = cls.offsets(seen)
        far = length(offset)
        two = np.take_along_axis(offset, np.argsort(far, 1)[:, :2, None], 1).mean(1)
        crowded = np.sort(far, 1)[:, 1:2] < cls.near + 0.5
        return cls.naive(seen) - care * np.where(crowded, 2.5 * two / np.maximum(length(two)[:, None], 0.1), 0)


class Boats(Pushed):
    """Four boats that search: nobody may be more than 2.5 km from the boat that is nearest, or the radio is lost."""

    names = entries(["x", "y", "vx", "vy", "waypoint_dx", "waypoint_dy"], "boat", 3, ["dx", "dy", "dvx", "dvy"])
    fastest = 1.2  # km a minute; a step is a tenth of one
    far = 2.5

    def begin(self, rng):
        super().begin(rng)
        self.p = rng.uniform(-1.5, 1.5, (self.n, 2))

    def danger(self):
        return bool((self.gaps(self.p).min(1) > self.far).any())

    @classmethod
    def careful(cls, seen, care):
        """To the nearest boat, where it is far."""
        offset = cls.offsets(seen)
        nearest = length(offset).argmin(1)
        gap = offset[np.arange(cls.n), nearest]
        far = length(gap)[:, None]
        return cls.naive(seen) + care * np.where(far > 1.5, 4 * (far - 1.5) * gap / np.maximum(far, 0.1), 0)


class Bikes(Pushed):
    """Nobody may be within 1.5 m and 30 degrees of where another drives; no heading is logged."""

    names = entries(["x", "y", "vx", "vy", "goal_dx", "goal_dy"], "bike", 3, ["dx", "dy", "dvx", "dvy"])
    far, wide = 1.5, np.radians(30.0)

    def danger(self):
        gap = self.p[None] - self.p[:, None]
        far, speed = self.gaps(self.p), length(self.v)[:, None]
        ahead = (gap * self.v[:, None]).sum(-1) / far / np.maximum(speed, 1e-6)
        return bool(((far < self.far) & (ahead > np.cos(self.wide)) & (speed > 0.1)).any())

    @classmethod
    def careful(cls, seen, care):
        """Away from who is near, and past them on the right."""
        offset = cls.offsets(seen)
        far = length(offset)[..., None]
        aside = np.stack([-offset[..., 1], offset[..., 0]], -1) / far
        away = -1.5 * (2 - far) * offset / far + aside
        return cls.naive(seen) + care * np.where(far < 2, away, 0.0).sum(1)


class Junction(Carts):
    """Carts that cross a square of 2 m by 2 m: no two may be in it at once."""

    steps, noise = 100, (0.9, 0.25)
    names = entries(["x", "y", "vx", "vy", "goal_dx", "goal_dy"], "cart", 3, ["dx", "dy", "dvx", "dvy"])
    push = 2.0

    def begin(self, rng):
        towards = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])[rng.permutation(4)]
        aside = np.stack([-towards[:, 1], towards[:, 0]], 1) * rng.uniform(-0.5, 0.5, (4, 1))
        self.p = aside + towards * rng.uniform(2.5, 6, (4, 1))
        self.goal = aside - 5 * towards
        self.v = np.zeros((4, 2))

    def danger(self):
        return bool((np.abs(self.p).max(1) < 1).sum() > 1)

    @classmethod
    def naive(cls, seen, state=None):
        """To the goal, as fast as it can stop there."""
        return cls.driven(seen, 1.3)

    @classmethod
    def careful(cls, seen, care):
        """Waits where another is in the square, or nearer to it and on the way there."""
        relative = seen[:, 6:].reshape(4, 3, 4)
        place, velocity = seen[:, None, :2] + relative[..., :2], seen[:, None, 2:4] + relative[..., 2:]
        mine, theirs = np.abs(seen[:, :2]).max(1)[:, None], np.abs(place).max(-1)
        first = (theirs < mine) & (theirs < 1.8) & ((place * velocity).sum(-1) < 0.5)
        waits = ((mine > 1) & (mine < 2.3) & (first | (theirs < 1))).any(1)
        return cls.driven(seen, np.where(waits, 1.3 * (1 - care), 1.3)[:, None])


class Rays(Carts):
    """Carts among four posts that they do not see; a lidar of twelve rays does, and none may be shorter than 0.3 m."""

    n = 3
    names = ["x", "y", "vx", "vy", "to_goal_x", "to_goal_y", *(f"lidar_{k}" for k in range(12))]
    post, cart, near, sight, apart = 0.4, 0.3, 0.3, 5.0, 1.2  # m: radii, and how far they see
    rays = np.stack([f(np.arange(12) * np.pi / 6) for f in (np.cos, np.sin)], 1)

    def begin(self, rng):
        self.posts = rng.uniform(-3, 3, (4, 2))
        while True:
            super().begin(rng)
            if min(length(at[:, None] - self.posts).min() for at in (self.p, self.goal)) > self.apart:
                return
            self.posts = rng.uniform(-3, 3, (4, 2))

    def lidar(self):
        """(N, 12) m how far each sees."""
        at = np.concatenate([np.repeat(self.posts[None], self.n, 0), self.p[self.others()]], 1)
        radius = np.repeat([self.post, self.cart], [4, self.n - 1])
        offset = at - self.p[:, None]
        along = offset @ self.rays.T  # (N, things, rays)
        aside = (offset**2).sum(-1)[..., None] - along**2
        hit = (along > 0) & (aside < radius[:, None] ** 2)
        far = along - np.sqrt(np.maximum(radius[:, None] ** 2 - aside, 0))
        return np.clip(np.where(hit, far, self.sight).min(1), 0, self.sight)

    def seen(self):
        return np.concatenate([self.p, self.v, self.goal - self.p, self.lidar()], 1)

    def danger(self):
        return bool((self.lidar() < self.near).any())

    @classmethod
    def naive(cls, seen, state=None):
        """To the goal, past nobody."""
        return cls.driven(seen, 1.2)

    @classmethod
    def careful(cls, seen, care):
        """Away from what is near."""
        weight = np.where(seen[:, 6:] < 1.0, 2.4 * (1.1 - seen[:, 6:]), 0.0)
        return cls.naive(seen) - care * weight @ cls.rays
