"""Small systems whose agents log numbers and a cost of the team: what is dangerous, what they see, and who drives.

Each is a value of `Kind`. Names of entries and units are those that somebody might give who knows this project by its
README alone. `SHAPED` has danger that is no distance alone (the first eleven led the search for causes, `downwash`,
`pickers` and `swarm` were written after it), `MAPPED` logs of places on a map, and `tracked` a list of the two nearest
that does not say who they are; it was made to find faults, and has chosen no setting.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from ringfence.logs.store import EpisodeStore

CARE = (0.0, 0.5, 1.0)  # of the drivers who are logged
Array = np.ndarray


def length(vectors: Array) -> Array:
    return np.sqrt((vectors**2).sum(-1))


def entries(own: str, kind: str, others: int, each: str) -> list[str]:
    """Names of own entries, and of those of things or others, one after the other."""
    return own.split() + [f"{kind}{k}_{e}" for k in range(others) for e in each.split()]


# Who drives: actions (N, A) of what agents see (N, O), and with how much care.


def driven(k: Kind, seen: Array, fastest: float | Array) -> Array:
    """To the goal, at most so fast (m/s) that it can stop there."""
    gap = seen[:, 4:6]
    far = length(gap)[:, None]
    wanted = gap / np.maximum(far, 1e-6) * np.minimum(fastest, np.sqrt(1.5 * far))
    return np.clip(0.5 * (wanted - seen[:, 2:4]) / (k.dt * k.push), -1, 1)


def at_most(fastest: float) -> Driver:
    """To the goal, past nobody."""
    return lambda k, seen: driven(k, seen, fastest)


def spring(k: Kind, seen: Array) -> Array:
    """To the goal by a spring with a damper, past nobody."""
    a = k.actions
    return np.clip(1.5 * seen[:, 2 * a : 3 * a] - 1.8 * seen[:, a : 2 * a], -1, 1)


def offsets(k: Kind, seen: Array) -> Array:
    """(N, N − 1, A) where others are, who are listed behind all else."""
    return seen[:, 3 * k.actions :].reshape(k.n, k.n - 1, 2 * k.actions)[..., : k.actions]


def slower(where: Callable[[Kind, Array], Array], least: float, more: float, usual: float) -> Careful:
    """More slowly in some places."""
    return lambda k, seen, care: driven(k, seen, np.where(where(k, seen), least + (1 - care) * more, usual)[:, None])


def past(strength: float, aside: float) -> Careful:
    """Away from who is within 2 m, and past them on the right."""

    def drive(k: Kind, seen: Array, care: float) -> Array:
        offset = offsets(k, seen)
        far = length(offset)[..., None]
        right = np.stack([-offset[..., 1], offset[..., 0]], -1) / far
        away = strength * (2 - far) * offset / far + aside * right
        return k.naive(seen) + care * np.where(far < 2, away, 0.0).sum(1)

    return drive


def towards(rank: int, near: float) -> Careful:
    """To the other who is so many-th nearest, where it is far."""

    def drive(k: Kind, seen: Array, care: float) -> Array:
        offset = offsets(k, seen)
        gap = offset[np.arange(k.n), np.argsort(length(offset), 1)[:, rank]]
        far = length(gap)[:, None]
        return k.naive(seen) + care * np.where(far > near, 4 * (far - near) * gap / np.maximum(far, 0.1), 0)

    return drive


# What moves: bodies that are pushed along axes, or who turn.


def placed(s: Moment) -> None:
    """Places and goals at random, apart from each other."""
    k = s.kind
    while True:
        s.p, s.goal = s.rng.uniform(-np.array(k.room), k.room, (2, k.n, len(k.room)))
        s.v = np.zeros_like(s.p)
        if min(s.gaps().min(), s.gaps(s.goal).min()) > k.apart:
            return


def and_at_random(
    apart: bool = True, **what: tuple[float | tuple[float, ...], tuple[int, ...]]
) -> Callable[[Moment], None]:
    """Likewise, and then what else there is, in a box of that half width: (width, shape), in this order."""

    def begin(s: Moment) -> None:
        if apart:
            placed(s)
        for name, (width, shape) in what.items():
            setattr(s, name, s.rng.uniform(-np.array(width), width, shape))
        s.v = np.zeros_like(s.p)

    return begin


def pushed(s: Moment, actions: Array) -> float:
    k = s.kind
    before = length(s.goal - s.p)
    s.v = np.clip(s.v + k.dt * k.push * actions, -k.fastest, k.fastest)
    s.p = s.p + k.dt * s.v
    return float((before - length(s.goal - s.p)).mean())


def own_and_others(s: Moment) -> list[Array]:
    """Place, velocity, the way to the goal, and where others are and how they move."""
    return [s.p, s.v, s.goal - s.p, s.relative(s.p[s.others], s.v[s.others])]


Driver = Callable[["Kind", Array], Array]
Careful = Callable[["Kind", Array, float], Array]


@dataclass(frozen=True)
class Body:
    """Numbers of a system; by default four carts in a square that push themselves along x and y."""

    n: int = 4
    steps: int = 80
    dt: float = 0.1  # s
    actions: int = 2
    noise: tuple[float, float] = (0.9, 0.3)  # of logged drivers: how much of it stays for a step, and how much comes
    push: float = 1.5  # m/s²
    fastest: float = 1.5  # m/s along each axis
    room: tuple[float, ...] = (4.0, 4.0)  # m to either side that carts and goals are in
    apart: float = 1.0  # m at least, of both


@dataclass(frozen=True)
class Kind:
    """A system as data."""

    name: str
    says: str  # what is dangerous
    danger: Callable[[Moment], Any]  # whether the team is in danger, or what each agent (N,) pays
    drives: Driver  # past nobody
    takes_care: Careful
    names: Sequence[str]  # of the numbers that each sees
    seen: Callable[[Moment], list[Array]] = own_and_others  # parts (N, …) of the rows
    begin: Callable[[Moment], None] = placed
    move: Callable[[Moment, Array], Any] = pushed  # a step by actions (N, A): the reward
    body: Body = Body()
    state: Callable[[Moment], Array] | None = None  # (N, …) of everybody, whose rows also begin with it
    record: Callable[[Kind, int, int], EpisodeStore] | None = None  # another way to log

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "body"), name)

    def naive(self, seen: Array, state: Any = None) -> Array:
        """Actions of who looks at nobody."""
        return self.drives(self, seen)

    def careful(self, seen: Array, care: float) -> Array:
        return self.takes_care(self, seen, care)

    def env(self) -> Moment:
        """The system as a simulator of PettingZoo's API."""
        return Moment(self)

    def recorded(self, episodes: int, seed: int) -> EpisodeStore:
        """Logs of drivers who take care not at all, by half or fully, with noise."""
        return self.record(self, episodes, seed) if self.record else _recorded(self, episodes, seed)

    def store(self, observations: Array, actions: Array, rewards: Array, costs: Array) -> EpisodeStore:
        """Logs (E, T, …) with what is known of them."""
        card = {"task": self.name, "observation_names": list(self.names), "dt": self.dt}
        card |= {"provenance": "benchmarks/systems.py"}
        state = None
        if self.state:
            state = observations[..., : 2 * self.actions].reshape(*observations.shape[:2], -1)
        return EpisodeStore.from_episodes(observations, actions, rewards, costs, state=state, card=card)


class Moment(ParallelEnv):
    """A system as it is now: places `p`, velocities `v`, goals (N, A), and what else there is. Agents share a reward,
    and a cost where any of them is in danger, unless danger is of each."""

    p: Array
    v: Array
    goal: Array
    rng: np.random.Generator

    def __init__(self, kind: Kind):
        self.kind = kind
        self.possible_agents = [f"agent_{i}" for i in range(kind.n)]
        self.metadata = {"name": kind.name, "dt": kind.dt}
        self.others = np.array([[j for j in range(kind.n) if j != i] for i in range(kind.n)])  # (N, N − 1)

    def observation_space(self, agent):
        return Box(-np.inf, np.inf, (len(self.kind.names),))

    def action_space(self, agent):
        return Box(-1.0, 1.0, (self.kind.actions,))

    @property
    def state_space(self):
        if self.kind.state is None:
            raise NotImplementedError
        return Box(-np.inf, np.inf, (2 * self.kind.actions * self.kind.n,))

    def state(self):
        if self.kind.state is None:
            raise NotImplementedError
        return self.kind.state(self).ravel().astype(np.float32)

    def reset(self, seed=None, options=None):
        self.rng = np.random.default_rng(seed)
        self.agents, self.t = list(self.possible_agents), 0
        self.kind.begin(self)
        while np.any(self.kind.danger(self)):
            self.kind.begin(self)
        return self._by_agent(self.rows().astype(np.float32)), {a: {} for a in self.agents}

    def step(self, actions):
        reward, cost = self.moved(np.array([actions[a] for a in self.possible_agents]))
        agents, over = self.agents, self.t >= self.kind.steps
        self.agents = [] if over else agents
        same = self._by_agent(np.broadcast_to(reward, self.kind.n).tolist())
        costs = self._by_agent(np.broadcast_to(cost, self.kind.n).tolist())
        infos = {a: {"cost": costs[a]} for a in agents}
        seen = self._by_agent(self.rows().astype(np.float32))
        return seen, same, dict.fromkeys(agents, False), dict.fromkeys(agents, over), infos

    def moved(self, actions: Array) -> tuple[Any, Any]:
        """Reward and cost of actions (N, A): the team's, or (N,) of each."""
        reward = self.kind.move(self, np.clip(actions, -1, 1))
        self.t += 1
        danger = self.kind.danger(self)
        return reward, np.asarray(danger, float) if np.ndim(danger) else float(bool(danger))

    def rows(self) -> Array:
        """(N, O) what each sees."""
        return np.concatenate(self.kind.seen(self), 1)

    def gaps(self, places: Array | None = None) -> Array:
        """(N, N) how far each is from each; far from oneself."""
        places = self.p if places is None else places
        return length(places[:, None] - places[None]) + 9 * np.eye(self.kind.n)

    def relative(self, places: Array, velocities: Array) -> Array:
        """(N, …) places and velocities (N or 1, K, A), one thing after the other, as each sees them."""
        return np.concatenate([places - self.p[:, None], velocities - self.v[:, None]], -1).reshape(self.kind.n, -1)

    def _by_agent(self, values):
        return dict(zip(self.possible_agents, values))


def _recorded(k: Kind, episodes: int, seed: int) -> EpisodeStore:
    rng = np.random.default_rng(seed)
    env, (keep, more), kept = k.env(), k.noise, []
    for _ in range(episodes):
        care = rng.choice(CARE)
        env.reset(seed=int(rng.integers(2**31)))
        noise = np.zeros((k.n, k.actions))
        rows, steps = [env.rows()], []
        for _ in range(k.steps):
            noise = keep * noise + rng.normal(0, more, noise.shape)
            action = np.clip(k.careful(rows[-1], care) + noise, -1, 1)
            steps.append((action, *env.moved(action)))
            rows.append(env.rows())
        kept.append((rows, *zip(*steps)))
    observations, actions, rewards, costs = (np.array(x) for x in zip(*kept))
    return k.store(observations, actions, np.repeat(rewards[..., None], k.n, -1), costs)


# Danger, of several systems.


def fast_near(near: float, slow: float, things: str = "") -> Callable[[Moment], bool]:
    """Whether anybody is faster than `slow` within `near` of another, or of a thing."""

    def danger(s: Moment) -> bool:
        far = length(getattr(s, things)[None] - s.p[:, None]) if things else s.gaps()
        return bool(((far.min(1) < near) & (length(s.v) > slow)).any())

    return danger


def over_each_other(across: float, high: float) -> Callable[[Moment], bool]:
    """Whether two are that near across and in height."""

    def danger(s: Moment) -> bool:
        gap = np.abs(s.p[:, None] - s.p[None])[np.triu_indices(s.kind.n, 1)]
        return bool(((length(gap[:, :2]) < across) & (gap[:, 2] < high)).any())

    return danger


def ahead(far: float, wide: float, looks: Callable[[Moment], Array], least: float = -1.0) -> Callable[[Moment], bool]:
    """Whether another is that near and within an angle (rad) of where one looks, (N, 2), who is faster than `least`."""

    def danger(s: Moment) -> bool:
        gap, speed, look = s.p[None] - s.p[:, None], length(s.v)[:, None], looks(s)
        cosine = (gap * look[:, None]).sum(-1) / s.gaps()
        if least >= 0:
            cosine = cosine / np.maximum(speed, 1e-6)
        return bool(((s.gaps() < far) & (cosine > np.cos(wide)) & (speed > least)).any())

    return danger


def around(s: Moment, spread: float) -> Array:
    """(4,) angles at which agents stand around a middle."""
    return s.rng.uniform(0, 2 * np.pi) + 2 * np.pi * (np.arange(4) + s.rng.uniform(-spread, spread, 4)) / 4


def turned(gap: Array, sine: Array, cosine: Array) -> Array:
    """By what angle (N,) something is to the left of where one looks."""
    off = np.arctan2(gap[:, 1], gap[:, 0]) - np.arctan2(sine, cosine)
    return (off + np.pi) % (2 * np.pi) - np.pi


# Aircraft at three levels, km and seconds.
LEVELS, TURN, CLIMB, FASTER = (8.0, 8.6, 9.2), np.radians(1.5) * 5.0, 0.012, 0.002


def sector_begin(s: Moment) -> None:
    angle = around(s, 0.3)
    far = s.rng.uniform(30, 40, 4)
    height = s.rng.choice(LEVELS, 4) + s.rng.normal(0, 0.1, 4)
    s.p = np.stack([far * np.cos(angle), far * np.sin(angle), height], 1)
    s.goal = np.concatenate([-s.p[:, :2], s.rng.choice(LEVELS, (4, 1))], 1)
    gap = s.goal - s.p
    s.heading = np.arctan2(gap[:, 1], gap[:, 0]) + s.rng.normal(0, 0.1, 4)
    s.speed = s.rng.uniform(0.20, 0.25, 4)
    s.climb = np.zeros(4)


def sector_seen(s: Moment) -> list[Array]:
    s.v = np.stack([s.speed * np.cos(s.heading), s.speed * np.sin(s.heading), s.climb], 1)
    own = np.stack([s.speed, np.sin(s.heading), np.cos(s.heading), s.climb], 1)
    return [s.p, own, s.goal - s.p, s.relative(s.p[s.others], s.v[s.others])]


def sector_move(s: Moment, actions: Array) -> float:
    before = length((s.goal - s.p)[:, :2])
    turn, climb, faster = actions.T
    s.heading = s.heading + TURN * turn
    s.climb = s.climb + 0.6 * (CLIMB * climb - s.climb)
    s.speed = np.clip(s.speed + FASTER * faster, 0.18, 0.27)
    s.p = s.p + s.kind.dt * np.stack([s.speed * np.cos(s.heading), s.speed * np.sin(s.heading), s.climb], 1)
    after = length((s.goal - s.p)[:, :2])
    return float((before - after).mean() - 0.3 * np.abs(s.goal - s.p)[:, 2].mean())


def sector_naive(k: Kind, seen: Array) -> Array:
    """To the exit and its level, past nobody."""
    off = turned(seen[:, 7:9], seen[:, 4], seen[:, 5])
    return np.clip(np.stack([off / TURN, seen[:, 9] / 0.12, (0.24 - seen[:, 3]) * 100], 1), -1, 1)


def sector_careful(k: Kind, seen: Array, care: float) -> Array:
    """Climbs and turns away."""
    action = k.naive(seen)
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


# Robots that spray ahead of them.


def sprayers_begin(s: Moment) -> None:
    placed(s)
    gap = s.goal - s.p
    s.heading = np.arctan2(gap[:, 1], gap[:, 0]) + s.rng.normal(0, 0.3, 4)
    s.speed = np.zeros(4)


def looks(s: Moment) -> Array:
    return np.stack([np.cos(s.heading), np.sin(s.heading)], 1)


def sprayers_seen(s: Moment) -> list[Array]:
    s.v = s.speed[:, None] * looks(s)
    return [s.p, s.speed[:, None], looks(s), s.goal - s.p, s.relative(s.p[s.others], s.v[s.others])]


def sprayers_move(s: Moment, actions: Array) -> float:
    before = length(s.goal - s.p)
    s.heading = s.heading + s.kind.dt * 2.5 * actions[:, 0]
    s.speed = np.clip(s.speed + s.kind.dt * s.kind.push * actions[:, 1], 0.0, s.kind.fastest)
    s.p = s.p + s.kind.dt * s.speed[:, None] * looks(s)
    return float((before - length(s.goal - s.p)).mean())


def sprayers_naive(k: Kind, seen: Array) -> Array:
    """To the plant, past nobody."""
    off, far = turned(seen[:, 5:7], seen[:, 4], seen[:, 3]), length(seen[:, 5:7])
    wanted = np.minimum(1.1, np.sqrt(1.5 * far)) * np.maximum(np.cos(off), 0.0)
    return np.clip(np.stack([2.0 * off, 3.0 * (wanted - seen[:, 2])], 1), -1, 1)


def sprayers_careful(k: Kind, seen: Array, care: float) -> Array:
    """Turns away from who would be ahead."""
    action = k.naive(seen)
    for gap in (seen[:, 7 + 4 * j : 9 + 4 * j] for j in range(3)):
        off, far = turned(gap, seen[:, 4], seen[:, 3]), length(gap)
        near = (far < 2.2) & (np.abs(off) < np.radians(65))
        action[:, 0] -= care * np.where(near, 1.8 * np.where(off >= 0, 1.0, -1.0), 0.0)
        action[:, 1] -= care * np.where(near & (far < 2.0), 0.8, 0.0)
    return action


# Carts in special places, and among persons, people who walk, and posts.


def docks_begin(s: Moment) -> None:
    angle = around(s, 0.3)
    s.p = np.stack([np.cos(angle), np.sin(angle)], 1) * s.rng.uniform(4, 7, (4, 1))
    s.v = np.zeros((4, 2))
    docks = np.array([[0.6, 0.6], [0.6, -0.6], [-0.6, 0.6], [-0.6, -0.6]])
    s.goal = docks[s.rng.permutation(4)] + s.rng.normal(0, 1.0, 2)


def walkway(x: Array, y: Array) -> Array:
    return (np.abs(x - 0.5) < 1.2) & (y < 1.0)


def before_walkway(k: Kind, seen: Array) -> Array:
    """On the walkway and half a second before it."""
    x, y, vx, vy = seen[:, :4].T
    return walkway(x, y) | walkway(x + 0.5 * vx, y + 0.5 * vy)


def people_begin(s: Moment) -> None:
    placed(s)
    angle = s.rng.uniform(0, 2 * np.pi, 2)
    s.walk = 0.5 * np.stack([np.cos(angle), np.sin(angle)], 1)
    s.people = s.rng.uniform(-3, 3, (2, 2))


def people_move(s: Moment, actions: Array) -> float:
    """They walk to and fro."""
    s.walk = np.where(np.abs(s.people + s.kind.dt * s.walk) > 4, -s.walk, s.walk)
    s.people = s.people + s.kind.dt * s.walk
    return pushed(s, actions)


def crowd_careful(k: Kind, seen: Array, care: float) -> Array:
    """Away from the middle of the two nearest, where the second is near."""
    offset = offsets(k, seen)
    far = length(offset)
    two = np.take_along_axis(offset, np.argsort(far, 1)[:, :2, None], 1).mean(1)
    crowded = np.sort(far, 1)[:, 1:2] < 1.0 + 0.5
    return k.naive(seen) - care * np.where(crowded, 2.5 * two / np.maximum(length(two)[:, None], 0.1), 0)


def junction_begin(s: Moment) -> None:
    towards = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])[s.rng.permutation(4)]
    aside = np.stack([-towards[:, 1], towards[:, 0]], 1) * s.rng.uniform(-0.5, 0.5, (4, 1))
    s.p = aside + towards * s.rng.uniform(2.5, 6, (4, 1))
    s.goal, s.v = aside - 5 * towards, np.zeros((4, 2))


def waits(k: Kind, seen: Array) -> Array:
    """Where another is in the square, or nearer to it and on the way there."""
    relative = seen[:, 6:].reshape(4, 3, 4)
    place, velocity = seen[:, None, :2] + relative[..., :2], seen[:, None, 2:4] + relative[..., 2:]
    mine, theirs = np.abs(seen[:, :2]).max(1)[:, None], np.abs(place).max(-1)
    first = (theirs < mine) & (theirs < 1.8) & ((place * velocity).sum(-1) < 0.5)
    return ((mine > 1) & (mine < 2.3) & (first | (theirs < 1))).any(1)


RAYS = np.stack([f(np.arange(12) * np.pi / 6) for f in (np.cos, np.sin)], 1)


def rays_begin(s: Moment) -> None:
    s.posts = s.rng.uniform(-3, 3, (4, 2))
    while True:
        placed(s)
        if min(length(at[:, None] - s.posts).min() for at in (s.p, s.goal)) > s.kind.apart:
            return
        s.posts = s.rng.uniform(-3, 3, (4, 2))


def lidar(s: Moment) -> Array:
    """(N, 12) m how far each sees, past posts of 0.4 m and carts of 0.3 m."""
    at = np.concatenate([np.repeat(s.posts[None], s.kind.n, 0), s.p[s.others]], 1)
    radius = np.repeat([0.4, 0.3], [4, s.kind.n - 1])
    offset = at - s.p[:, None]
    along = offset @ RAYS.T  # (N, things, rays)
    aside = (offset**2).sum(-1)[..., None] - along**2
    hit = (along > 0) & (aside < radius[:, None] ** 2)
    far = along - np.sqrt(np.maximum(radius[:, None] ** 2 - aside, 0))
    return np.clip(np.where(hit, far, 5.0).min(1), 0, 5.0)


def rays_careful(k: Kind, seen: Array, care: float) -> Array:
    """Away from what is near."""
    weight = np.where(seen[:, 6:] < 1.0, 2.4 * (1.1 - seen[:, 6:]), 0.0)
    return k.naive(seen) - care * weight @ RAYS


def hall_careful(k: Kind, seen: Array, care: float) -> Array:
    """Aside, from whom it is over or under."""
    offset = offsets(k, seen)
    far = length(offset[..., :2])[..., None]
    near = (far < 1.3) & (np.abs(offset[..., 2:]) < 2.0)
    away = -2 * (1.6 - far) * offset[..., :2] / np.maximum(far, 0.1)
    action = k.naive(seen)
    action[:, :2] += care * np.where(near, away, 0.0).sum(1)
    return action


def with_things(things: Callable[[Moment], Array]) -> Callable[[Moment], list[Array]]:
    """Things before the others."""

    def seen(s: Moment) -> list[Array]:
        *own, others = own_and_others(s)
        return [*own, things(s), others]

    return seen


def near_thing(things: slice, shape: tuple[int, int], near: float) -> Callable[[Kind, Array], Array]:
    """Where a thing of those rows is near."""
    return lambda k, seen: length(seen[:, things].reshape(-1, *shape)[..., :2]).min(1) < near


def _closing(s: Moment) -> bool:
    gap, far = s.p[:, None] - s.p[None], s.gaps()
    return bool((far - 0.4 < 1.2 * (-(gap * (s.v[:, None] - s.v[None])).sum(-1) / far)).any())


CART = entries("x y vx vy to_goal_x to_goal_y", "cart", 3, "dx dy dvx dvy")
GOAL = "x y vx vy goal_dx goal_dy"
MOVES = "dx dy dvx dvy"
SHAPED = (
    Kind(
        "sector",
        "Aircraft at three levels: no two may be within 9.26 km across *and* 300 m in height",
        over_each_other(9.26, 0.3),
        sector_naive,
        sector_careful,
        entries(
            "x y altitude speed heading_sin heading_cos climb exit_dx exit_dy exit_dz",
            "intruder",
            3,
            "dx dy dz dvx dvy dvz",
        ),
        sector_seen,
        sector_begin,
        sector_move,
        body=Body(steps=60, dt=5.0, actions=3, noise=(0.85, 0.35)),
    ),
    Kind(
        "meeting",
        "No two carts may come nearer so fast that they would be 0.4 m apart in 1.2 s",
        _closing,
        spring,
        past(-2, 0.8),
        CART,
    ),
    Kind(
        "docks",
        "Docks that lie together: within 2 m of another cart nobody may drive faster than 0.5 m/s",
        fast_near(2.0, 0.5),
        at_most(1.4),
        slower(lambda k, seen: length(offsets(k, seen)).min(1) < 2.0 + 0.8, 0.3, 1.1, 1.4),
        entries("px py velocity_x velocity_y dock_dx dock_dy", "cart", 3, MOVES),
        begin=docks_begin,
        body=Body(dt=0.2, noise=(0.85, 0.12)),
    ),
    Kind(
        "sprayers",
        "Robots that spray ahead of them: nobody may be within 1.5 m and 40 degrees of where another looks",
        ahead(1.5, np.radians(40.0), looks),
        sprayers_naive,
        sprayers_careful,
        entries("x y speed heading_cos heading_sin plant_dx plant_dy", "robot", 3, MOVES),
        sprayers_seen,
        sprayers_begin,
        sprayers_move,
        body=Body(noise=(0.9, 0.25), push=2.0, fastest=1.2, room=(3.5, 3.5), apart=1.2),
    ),
    Kind(
        "persons",
        "Three persons stand about: nobody may drive faster than 0.5 m/s within 1.3 m of one",
        fast_near(1.3, 0.5, "persons"),
        at_most(1.4),
        slower(near_thing(slice(6, 12), (3, 2), 1.3 + 0.5), 0.3, 1.1, 1.4),
        entries(" ".join(entries("x y vx vy target_dx target_dy", "person", 3, "dx dy")), "truck", 2, MOVES),
        with_things(lambda s: (s.persons[None] - s.p[:, None]).reshape(s.kind.n, -1)),
        and_at_random(persons=(4.0, (3, 2))),
        body=Body(n=3, noise=(0.9, 0.25), push=2.0, fastest=1.6),
    ),
    Kind(
        "crowd",
        "Six robots: nobody may have two others within 1 m",
        lambda s: (np.sort(s.gaps(), 1)[:, 1] < 1.0).any(),
        spring,
        crowd_careful,
        entries(GOAL, "robot", 5, MOVES),
        body=Body(n=6, apart=0.0, fastest=1.2, room=(3.0, 3.0)),
    ),
    Kind(
        "boats",
        "Four boats that search: nobody may be more than 2.5 km from the boat that is nearest, or the radio is lost",
        lambda s: (s.gaps().min(1) > 2.5).any(),
        spring,
        towards(0, 1.5),
        entries("x y vx vy waypoint_dx waypoint_dy", "boat", 3, MOVES),
        begin=and_at_random(p=(1.5, (4, 2))),
        body=Body(fastest=1.2),
    ),
    Kind(
        "bikes",
        "Nobody may be within 1.5 m and 30 degrees of where another drives; no heading is logged",
        ahead(1.5, np.radians(30.0), lambda s: s.v, 0.1),
        spring,
        past(-1.5, 1.0),
        entries(GOAL, "bike", 3, MOVES),
    ),
    Kind(
        "depot",
        "A depot with a walkway: nobody may drive faster than 0.6 m/s across it",
        lambda s: (walkway(*s.p.T) & (length(s.v) > 0.6)).any(),
        at_most(1.6),
        slower(before_walkway, 0.4, 1.2, 1.6),
        entries("pos_x pos_y vel_x vel_y goal_dx goal_dy", "truck", 2, MOVES),
        body=Body(n=3, noise=(0.9, 0.25), push=2.0, fastest=1.8, room=(5.0, 3.0)),
    ),
    Kind(
        "junction",
        "Carts that cross a square of 2 m by 2 m: no two may be in it at once",
        lambda s: (np.abs(s.p).max(1) < 1).sum() > 1,
        at_most(1.3),
        slower(waits, 0.0, 1.3, 1.3),
        entries(GOAL, "cart", 3, MOVES),
        begin=junction_begin,
        body=Body(steps=100, noise=(0.9, 0.25), push=2.0),
    ),
    Kind(
        "rays",
        "Carts among four posts that they do not see; a lidar of twelve rays does, and none may be shorter than 0.3 m",
        lambda s: (lidar(s) < 0.3).any(),
        at_most(1.2),
        rays_careful,
        ["x", "y", "vx", "vy", "to_goal_x", "to_goal_y", *(f"lidar_{j}" for j in range(12))],
        lambda s: [s.p, s.v, s.goal - s.p, lidar(s)],
        rays_begin,
        body=Body(n=3, apart=1.2),
    ),
    Kind(
        "downwash",
        "Drones in a hall: nobody may be within 0.6 m across and 1.5 m in height of another, who would blow it down",
        over_each_other(0.6, 1.5),
        spring,
        hall_careful,
        entries("x y z vx vy vz goal_x goal_y goal_z", "drone", 3, "rel_x rel_y rel_z rel_vx rel_vy rel_vz"),
        begin=and_at_random(False, p=((3.0, 3.0, 1.5), (4, 3)), goal=((3.0, 3.0, 1.5), (4, 3))),
        body=Body(actions=3, push=2.0, room=(3.0, 3.0, 1.5)),
    ),
    Kind(
        "pickers",
        "Carts among two people who walk to and fro: within 1.5 m of one of them nobody may drive faster than 0.4 m/s",
        fast_near(1.5, 0.4, "people"),
        at_most(1.4),
        slower(near_thing(slice(6, 14), (2, 4), 1.5 + 0.7), 0.2, 1.2, 1.4),
        entries(" ".join(entries("x y v_x v_y shelf_x shelf_y", "human", 2, "x y vx vy")), "cart", 2, "x y vx vy"),
        with_things(lambda s: s.relative(s.people[None], s.walk[None])),
        people_begin,
        people_move,
        body=Body(n=3, noise=(0.9, 0.25), push=2.5, fastest=1.6),
    ),
    Kind(
        "swarm",
        "Five robots in space whose radio has to reach two others, at most 3 m away; entries have no names",
        lambda s: (np.sort(s.gaps(), 1)[:, 1] > 3.0).any(),
        spring,
        towards(1, 2.0),
        [f"obs{d}" for d in range(9 + 4 * 6)],
        begin=and_at_random(False, p=(1.5, (5, 3)), goal=(3.0, (5, 3))),
        body=Body(n=5, actions=3, fastest=1.0),
    ),
)


# Logs of places on a map.
PLACED = "x y vx vy goal_x goal_y"


def on_map(around: Callable[[Moment], Array]) -> Callable[[Moment], list[Array]]:
    """Places as they are, of oneself, of the goal, and of what else each sees (N, K)."""
    return lambda s: [s.p, s.v, s.goal, around(s)]


def others_on_map(s: Moment, who: Array | None = None) -> Array:
    who = s.others if who is None else who
    return np.concatenate([s.p[who], s.v[who]], -1).reshape(s.kind.n, -1)


def two_nearest(s: Moment) -> Array:
    return others_on_map(s, np.argsort(s.gaps() + 99 * np.eye(s.kind.n), 1)[:, :2])


def relative(seen: Array) -> Array:
    return np.concatenate([seen[:, :4], seen[:, 4:6] - seen[:, :2], seen[:, 6:]], 1)


def aside(shape: tuple[int, int]) -> Careful:
    """Aside, from who or what is near: so many, of so many numbers."""

    def drive(k: Kind, seen: Array, care: float) -> Array:
        offset = seen[:, 6:].reshape(len(seen), *shape)[..., :2] - seen[:, None, :2]
        far = length(offset)[..., None]
        return k.naive(seen) - care * np.where(far < 1.5, 2 * (1.6 - far) * offset / np.maximum(far, 0.1), 0.0).sum(1)

    return drive


def within(things: str) -> Callable[[Moment], bool]:
    return lambda s: length(s.p[:, None] - getattr(s, things)[None]).min() < 0.8


_MAPPED = Kind(
    "mapped",
    "Carts that see where the others are: within 0.8 m of another",
    lambda s: s.gaps().min() < 0.8,
    lambda k, seen: driven(k, relative(seen), 1.4),
    aside((3, 4)),
    entries(PLACED, "cart", 3, "x y vx vy"),
    on_map(others_on_map),
)
_ALONE = replace(
    _MAPPED,
    name="alone",
    says="The same carts, who see themselves alone; there is no global state",
    takes_care=lambda k, seen, care: driven(k, relative(seen), 1.4 - 0.8 * care),
    names=PLACED.split(),
    seen=on_map(lambda s: np.zeros((s.kind.n, 0))),
)
MAPPED = (
    _MAPPED,
    replace(
        _MAPPED,
        name="unnamed",
        says="The same carts, of whose entries nobody says what they are",
        names=[f"obs{d}" for d in range(len(_MAPPED.names))],
    ),
    _ALONE,
    replace(
        _ALONE,
        name="stated",
        says="The same; a global state has everybody's place and velocity",
        state=lambda s: np.concatenate([s.p, s.v], 1),
    ),
    replace(
        _MAPPED,
        name="listed",
        says="The same carts, who see the two nearest",
        takes_care=aside((2, 4)),
        names=entries(PLACED, "near", 2, "x y vx vy"),
        seen=on_map(two_nearest),
    ),
    replace(
        _MAPPED,
        name="posts",
        says="Carts among two posts, which stand elsewhere in every episode: within 0.8 m of one",
        danger=within("posts"),
        takes_care=aside((2, 2)),
        names=entries(PLACED, "post", 2, "x y"),
        seen=on_map(lambda s: np.repeat(s.posts.reshape(1, -1), s.kind.n, 0)),
        begin=and_at_random(posts=(3.0, (2, 2))),
    ),
    replace(
        _MAPPED,
        name="walkers",
        says="Carts among two people who walk to and fro: within 0.8 m of one",
        danger=within("people"),
        takes_care=aside((2, 4)),
        names=entries("px py speed_x speed_y goal_x goal_y", "person", 2, "pos_x pos_y vel_x vel_y"),
        seen=on_map(lambda s: np.repeat(np.concatenate([s.people, s.walk], 1).reshape(1, -1), s.kind.n, 0)),
        begin=people_begin,
        move=people_move,
    ),
)


# Robots that are tracked by range and bearing: unicycles with momentum, many fields (E, N, …) at once.
NEAR, FIELD, QUICKEST, TURNING = 0.5, 3.0, 1.1, 1.6  # m between two, m to the middle, m/s, rad/s
PUSH, TWIST = 0.9, 3.0  # m/s², rad/s²: braking takes six steps


def wrapped(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi


class Fields:
    """So many fields of four robots."""

    def __init__(self, rng: np.random.Generator, fields: int):
        self.rng, shape = rng, (fields, 4)
        self.place = rng.uniform(-2.7, 2.7, (*shape, 2))
        while (close := self.apart().min((1, 2)) < 1.3).any():
            self.place[close] = rng.uniform(-2.7, 2.7, (close.sum(), 4, 2))
        self.heading = rng.uniform(-np.pi, np.pi, shape)
        self.speed, self.turn = np.zeros(shape), np.zeros(shape)
        self.goal = self._goals()

    def apart(self) -> Array:
        """(E, N, N) m between two; far from oneself."""
        return np.linalg.norm(self.place[:, :, None] - self.place[:, None], axis=-1) + 1e3 * np.eye(4)

    def _goals(self) -> Array:
        """Mostly on the other side."""
        across = np.where(self.place > 0, -1.0, 1.0) * self.rng.uniform(0.3, 2.8, self.place.shape)
        anywhere = self.rng.uniform(-2.8, 2.8, self.place.shape)
        return np.where(self.rng.random(self.place.shape) < 0.3, anywhere, across)

    def polar(self, offset: Array) -> tuple[Array, Array]:
        """Range and bearing (E, N, ...) of offsets (E, N, ..., 2)."""
        heading = self.heading.reshape(*self.heading.shape, *[1] * (offset.ndim - 3))
        return np.linalg.norm(offset, axis=-1), wrapped(np.arctan2(offset[..., 1], offset[..., 0]) - heading)

    def others(self) -> Array:
        """(E, N, N − 1, 3) range, bearing and range rate of all others, the nearest first."""
        velocity = np.stack([np.cos(self.heading), np.sin(self.heading)], -1) * self.speed[..., None]
        offset = self.place[:, None] - self.place[:, :, None]
        far, bearing = self.polar(offset)
        rate = ((velocity[:, None] - velocity[:, :, None]) * offset).sum(-1) / np.maximum(far, 1e-6)
        order = self.apart().argsort(-1)[..., :3, None]
        return np.take_along_axis(np.stack([far, bearing, rate], -1), order, 2)

    def seen(self) -> Array:
        """(E, N, O), of the two nearest."""
        own = np.stack([self.speed, self.turn, *self.polar(self.goal - self.place)], -1)
        return np.concatenate([own, self.others()[:, :, :2].reshape(*own.shape[:2], -1)], -1).astype(np.float32)

    def danger(self) -> Array:
        return self.apart().min((1, 2)) < NEAR

    def step(self, action: Array, dt: float) -> Array:
        """Rewards (E, N) of push and twist (E, N, 2)."""
        outside = np.clip(np.abs(self.place).max(-1) - FIELD, 0, 1)  # who leaves the field is turned to its middle
        home = 2 * outside * np.sin(self.polar(-self.place)[1])
        self.turn = np.clip(self.turn + dt * (TWIST * action[..., 1] + home), -TURNING, TURNING)
        self.speed = np.clip(self.speed + dt * PUSH * action[..., 0], 0, QUICKEST)
        way = self.heading + 0.5 * dt * self.turn
        before = np.linalg.norm(self.goal - self.place, axis=-1)
        self.place = self.place + dt * self.speed[..., None] * np.stack([np.cos(way), np.sin(way)], -1)
        self.heading = wrapped(self.heading + dt * self.turn)
        after = np.linalg.norm(self.goal - self.place, axis=-1)
        reached = after < 0.35
        self.goal = np.where(reached[..., None], self._goals(), self.goal)
        return before - after + 0.3 * reached


class Trackers:
    """Who looks at nobody, brakes late, swerves, or does both in time: each by habits of its own."""

    def __init__(self, rng: np.random.Generator, fields: int):
        shape = (fields, 4)
        self.rng = rng
        self.habit = rng.choice(4, shape, p=[0.03, 0.17, 0.35, 0.45])
        self.fastest = rng.uniform(0.6, 1.0, shape)
        self.heeds = rng.uniform(1.0, 3.2, (*shape, 1))  # s
        self.turns = rng.uniform(1.5, 3.5, shape)
        self.drift = np.zeros((*shape, 2))

    def __call__(self, field: Fields, dt: float) -> Array:
        far, bearing, rate = np.moveaxis(field.others(), -1, 0)
        goal, angle = field.polar(field.goal - field.place)
        left = np.where((rate < -0.05) & (far > NEAR), (far - NEAR) / np.maximum(-rate, 0.05), 9.0)  # s
        ahead = np.abs(bearing) < 1.9
        urge = (left < self.heeds) * np.clip(1.5 - left / self.heeds, 0, 1) * (far < 2.6)
        brake = (urge * ahead).max(-1)
        late = (ahead & (left < 0.45 * self.heeds)).any(-1)
        stuck = 0.8 * (ahead & (far < 0.8) & (field.speed < 0.25)[..., None])
        swerve = -(np.where(np.abs(bearing) < 0.5, 1.0, np.sign(bearing)) * (urge + stuck)).sum(-1)
        close = (np.clip(1.0 - far, 0, 0.5) * ahead * (far > NEAR)).max(-1)
        habits = [1.0 - late, 1 - 0.4 * brake, np.clip(1 - 1.2 * brake - 0.5 * close, 0, 1)]
        slower = np.select([self.habit == 1, self.habit == 2, self.habit == 3], habits, 1.0)
        speed = self.fastest * np.minimum(1, 0.2 + goal) * np.clip(1.1 - np.abs(angle) / 1.6, 0.05, 1) * slower
        turn = np.clip(self.turns * angle, -1.3, 1.3) + swerve * np.choose(self.habit, [0.0, 1.4, 2.0, 1.4])
        turn = np.clip(turn, -TURNING, TURNING)
        wanted = [(speed - field.speed) / PUSH, (turn - field.turn) / TWIST]
        self.drift = 0.9 * self.drift + self.rng.normal(0, 0.1, self.drift.shape)
        noise = self.drift + self.rng.normal(0, 0.15, self.drift.shape)
        return np.clip(np.stack(wanted, -1) / (1.5 * dt) + noise, -1, 1)


def tracked_naive(k: Kind, seen: Array) -> Array:
    """At full speed to the goal, past nobody."""
    speed, turn, _, angle = np.moveaxis(seen[..., :4], -1, 0)
    wanted = QUICKEST * np.clip(1.2 - np.abs(angle) / 1.6, 0.1, 1), np.clip(2.5 * angle, -TURNING, TURNING)
    return np.clip(np.stack([(wanted[0] - speed) / (PUSH * k.dt), (wanted[1] - turn) / (TWIST * k.dt)], -1), -1, 1)


def tracked_begin(s: Moment) -> None:
    s.field = Fields(s.rng, 1)


def tracked_logs(k: Kind, episodes: int, seed: int) -> EpisodeStore:
    rng = np.random.default_rng(seed)
    field, drive = Fields(rng, episodes), Trackers(rng, episodes)
    seen, kept = [field.seen()], []
    for _ in range(k.steps):
        action = drive(field, k.dt)
        kept.append((action, field.step(action, k.dt), field.danger().astype(float)))
        seen.append(field.seen())
    return k.store(np.stack(seen, 1), *(np.stack(each, 1) for each in zip(*kept)))


TRACKED = Kind(
    "tracked",
    "Robots that log range and bearing of the two nearest: no two within 0.5 m",
    lambda s: s.field.danger()[0],
    tracked_naive,
    lambda k, seen, care: k.naive(seen),
    ["own.speed", "own.yaw_rate", "goal.range", "goal.bearing"]
    + [f"near{k}.{what}" for k in range(2) for what in ("range", "bearing", "range_rate")],
    lambda s: [s.field.seen()[0]],
    tracked_begin,
    lambda s, actions: s.field.step(actions[None], s.kind.dt)[0],
    body=Body(dt=0.2),
    record=tracked_logs,
)
