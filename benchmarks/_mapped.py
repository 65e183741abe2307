"""Systems whose agents see where others and things are on a map, and not how far away these are."""

from __future__ import annotations

from typing import ClassVar
from unittest import mock

import gymnasium
import numpy as np
from _system import AmongPeople, Carts, EpisodeStore, entries, length


class Mapped(Carts):
    """Carts that see where the others are: within 0.8 m of another."""

    names = entries(["x", "y", "vx", "vy", "goal_x", "goal_y"], "cart", 3, ["x", "y", "vx", "vy"])
    near = 0.8
    away: ClassVar[tuple[int, int]] = (3, 4)  # how many are seen, and by how many numbers

    def seen(self):
        return np.concatenate([self.p, self.v, self.goal, self.around()], 1)

    def around(self):
        """(N, K) what else each sees."""
        others = self.others()
        return np.concatenate([self.p[others], self.v[others]], -1).reshape(self.n, -1)

    def danger(self):
        return bool(self.gaps(self.p).min() < self.near)

    @classmethod
    def naive(cls, seen, state=None):
        """To the goal, past nobody."""
        return cls.driven(cls._relative(seen), 1.4)

    @classmethod
    def careful(cls, seen, care):
        """Aside, from who or what is near."""
        offset = seen[:, 6:].reshape(len(seen), *cls.away)[..., :2] - seen[:, None, :2]
        far = length(offset)[..., None]
        aside = np.where(far < 1.5, 2 * (1.6 - far) * offset / np.maximum(far, 0.1), 0.0).sum(1)
        return cls.naive(seen) - care * aside

    @staticmethod
    def _relative(seen):
        return np.concatenate([seen[:, :4], seen[:, 4:6] - seen[:, :2], seen[:, 6:]], 1)


class Unnamed(Mapped):
    """The same carts, of whose entries nobody says what they are."""

    names = [f"obs{d}" for d in range(len(Mapped.names))]


class Alone(Mapped):
    """The same carts, who see themselves alone; there is no global state."""

    names = Mapped.names[:6]

    def around(self):
        return np.zeros((self.n, 0))

    @classmethod
    def careful(cls, seen, care):
        """Slower."""
        return cls.driven(cls._relative(seen), 1.4 - 0.8 * care)


class Stated(Alone):
    """The same; a global state has everybody's place and velocity."""

    @property
    def state_space(self):
        return gymnasium.spaces.Box(-np.inf, np.inf, (4 * self.n,))

    def state(self):
        return np.concatenate([self.p, self.v], 1).ravel().astype(np.float32)

    @classmethod
    def recorded(cls, episodes, seed):
        whole = EpisodeStore.from_episodes

        def with_state(observations, *rest, card):
            state = observations[..., :4].reshape(*observations.shape[:2], -1)
            return whole(observations, *rest, state=state, card=card)

        with mock.patch.object(EpisodeStore, "from_episodes", with_state):
            return super().recorded(episodes, seed)


class Listed(Mapped):
    """The same carts, who see the two nearest."""

    names = entries(Mapped.names[:6], "near", 2, ["x", "y", "vx", "vy"])
    away = (2, 4)

    def around(self):
        others = np.argsort(self.gaps(self.p) + 99 * np.eye(self.n), 1)[:, :2]
        return np.concatenate([self.p[others], self.v[others]], -1).reshape(self.n, -1)


class Posts(Mapped):
    """Carts among two posts, which stand elsewhere in every episode: within 0.8 m of one."""

    names = entries(Mapped.names[:6], "post", 2, ["x", "y"])
    away = (2, 2)

    def begin(self, rng):
        super().begin(rng)
        self.posts = rng.uniform(-3, 3, (2, 2))

    def around(self):
        return np.repeat(self.posts.reshape(1, -1), self.n, 0)

    def danger(self):
        return bool(length(self.p[:, None] - self.posts[None]).min() < self.near)


class Walkers(AmongPeople, Mapped):
    """Carts among two people who walk to and fro: within 0.8 m of one."""

    names = entries(
        ["px", "py", "speed_x", "speed_y", "goal_x", "goal_y"], "person", 2, ["pos_x", "pos_y", "vel_x", "vel_y"]
    )
    away = (2, 4)

    def around(self):
        return np.repeat(np.concatenate([self.people, self.walk], 1).reshape(1, -1), self.n, 0)

    def danger(self):
        return bool(length(self.p[:, None] - self.people[None]).min() < self.near)
