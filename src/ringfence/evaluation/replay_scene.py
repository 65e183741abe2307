"""Windows of logs in which one agent is driven, and what everybody would observe while it is."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.problem import on_map
from ringfence.problem.entries import HEADINGS, SPEEDS, Names
from ringfence.problem.motion import late_share
from ringfence.problem.partners import others

EXACT = 1e-4  # of how far a team is apart: what is rounded is off by less
NOBODY = 1e6  # m: how far away is who is not there


def names_of(store: EpisodeStore) -> Names:
    """What names say of a store's entries; names that nobody gave are told from the logs. Others and things that are
    seen as places on a map keep theirs, and stay where they were."""
    seen = on_map.relative(store.observations, store.entry_names, None, store.first_rows)
    given = [old if less else new for old, new, less in zip(store.entry_names, seen.names, seen.minus[0] >= 0)]
    return Names.of(given, store.card.state_names or () if store.state is not None else (), store.n_agents)


def require_replayable(names: Names, task: str) -> None:
    """Refuse logs that cannot be replayed."""
    if not names.slots and names.agents < 2:
        raise UserError(f"'{task}' has one agent and observes no other, so nobody can be replayed; give logs of two.")
    if not names.slots and not names.placed:
        raise UserError(
            f"The logs of '{task}' hold no places: name entries other0.dx and other0.dy, or own.x and own.y, or "
            "agent0.x and agent0.y of the state."
        )


@dataclass(frozen=True, eq=False)
class Motion:
    """What M logged moments say of each agent's motion."""

    place: np.ndarray | None  # (M, N, X) m, X axes; None: to be summed up from velocities
    velocity: np.ndarray | None  # (M, N, X) m/s; None: by differences
    offset: np.ndarray  # (M, N, K, X) m to others, NOBODY where nobody is seen
    seen: np.ndarray  # (M, N, K) bool
    late: float  # share of a step that a body goes with its next velocity; the rest with this one


def motion_of(store: EpisodeStore, names: Names) -> Motion:
    """The motion in all rows of a store."""
    x = np.asarray(store.observations, np.float64)
    n = store.n_agents
    place = names.place(x, None if store.state is None else np.asarray(store.state, np.float64))
    if place is None and (goal := names.pair("goal.d{}")):
        place = -x[..., goal]
    seen = np.ones((len(x), n, names.slots or n - 1), bool)
    if names.slots:
        offset = x[..., np.array(names.pairs("other{}.d{{}}", names.slots))]
        for j in range(names.slots):
            if f"other{j}.seen" in names.observation:
                seen[..., j] = x[..., names.observation[f"other{j}.seen"]] > 0.5
    else:
        assert place is not None, "checked before"
        offset = place[:, others(n)] - place[:, :, None]
    offset = np.where(seen[..., None], offset, NOBODY)
    velocity = _velocities(store, names, x)
    return Motion(place, velocity, offset, seen, _late(store, names, x, place, velocity, offset, seen))


def _late(
    store: EpisodeStore,
    names: Names,
    x: np.ndarray,
    place: np.ndarray | None,
    velocity: np.ndarray | None,
    offset: np.ndarray,
    seen: np.ndarray,
) -> float:
    """The share of a step that bodies go with their next velocity, as most of the logged steps have it."""
    if velocity is None:
        return 1.0  # it is made of differences to the place before
    row = np.arange(store.steps) + store.episode_of_step
    drift = names.pairs("other{}.dv{{}}", names.slots) if place is None else None
    if place is not None:
        moved, before, after = place[row + 1] - place[row], velocity[row], velocity[row + 1]
    elif drift:
        both = seen[row] & seen[row + 1]
        moved = (offset[row + 1] - offset[row])[both]
        before, after = (x[r][..., np.array(drift)][both] for r in (row, row + 1))
    else:
        return 0.5
    share = late_share(moved, before, after, float(store.card.dt or 1.0))
    return 0.5 if share is None else share


def _velocities(store: EpisodeStore, names: Names, x: np.ndarray) -> np.ndarray | None:
    if pair := names.pair("own.v{}"):
        return x[..., pair]
    if store.state is not None and (where := names.state_pairs("agent{}.v{{}}")):
        return np.asarray(store.state, np.float64)[:, where]
    speed, looks = names.entries.speed, names.entries.direction
    if speed is not None and len(looks) == 2:
        along = x[..., looks] * x[..., speed, None]
        return along if len(names.axes) == 2 else None
    return None


@dataclass(frozen=True, eq=False)
class Windows:
    """W windows of L steps; in each of them agent `driven` (W,) is driven. Rows are L+1, axes X."""

    names: Names
    sorted: bool  # others are observed in the order of their distance
    driven: np.ndarray
    episode: np.ndarray  # (W,)
    start: np.ndarray  # (W,) step of the episode
    observations: np.ndarray  # (W, L+1, N, O)
    state: np.ndarray | None  # (W, L+1, S)
    actions: np.ndarray  # (W, L, N, A) as logged
    place: np.ndarray  # (W, L+1, X) of the driven agent, as logged
    velocity: np.ndarray  # (W, L+1, X)
    offset: np.ndarray  # (W, L+1, K, X) to others, from its logged place
    goal: np.ndarray  # (W, X)
    dt: float  # s

    @property
    def count(self) -> int:
        return len(self.driven)

    @property
    def rows(self) -> np.ndarray:
        """(W,) which indexes windows beside `driven`."""
        return np.arange(self.count)

    @property
    def steps(self) -> int:
        return self.actions.shape[1]

    @cached_property
    def others_at(self) -> np.ndarray:
        """(W, L+1, K, X) places of the others."""
        return self.place[:, :, None] + self.offset

    @cached_property
    def others_move(self) -> np.ndarray:
        """(W, L+1, K, X) m/s: as observed, or by differences."""
        if drift := self.names.pairs("other{}.dv{{}}", self.names.slots):
            mine = self.observations[self.rows, :, self.driven]
            return mine[..., np.array(drift)] + self.velocity[:, :, None]
        moved = np.diff(self.others_at, axis=1) / self.dt
        return np.concatenate([moved, moved[:, -1:]], 1)

    def only(self, which: np.ndarray) -> Windows:
        """Some of the windows."""
        of_each = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("names", "sorted", "dt")}
        return replace(self, **{name: None if x is None else x[which] for name, x in of_each.items()})

    def distances(self, t: int, place: np.ndarray) -> np.ndarray:
        """(W, K) m from places (W, X) to the others at row t."""
        return np.linalg.norm(self.others_at[:, t] - place[:, None], axis=-1)

    @cached_property
    def nearest_logged(self) -> np.ndarray:
        """(W, L+1) m to the nearest other, as logged."""
        return np.linalg.norm(self.offset, axis=-1).min(-1)

    def observed(
        self, t: int, place: np.ndarray, velocity: np.ndarray, heading: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Observations (W, N, O) and state (W, S) at row t, where the driven agent is at `place` (W, X) and moves with
        `velocity` (W, X), turned to `heading` (W,)."""
        moved = place - self.place[:, t]
        faster = velocity - self.velocity[:, t]
        x = np.array(self.observations[:, t], np.float64)
        mine = x[self.rows, self.driven]
        changes = [("own.{}", moved), ("own.v{}", faster)]
        for thing in self.names.things:  # that move or stand still as they did
            changes += [(f"{thing}.d{{}}", -moved), (f"{thing}.dv{{}}", -faster)]
        for pattern, change in changes:
            if pair := self.names.pair(pattern):
                mine[:, pair] += change
        along = (velocity[:, :2] * np.stack([np.cos(heading), np.sin(heading)], -1)).sum(-1)
        own = self.names.entries.own
        known = dict.fromkeys(SPEEDS, along) | dict.fromkeys(HEADINGS, heading)
        for what in known.keys() & own.keys():
            mine[:, own[what]] = known[what]
        if len(looks := self.names.entries.direction) == 2:
            mine[:, looks] = np.stack([np.cos(heading), np.sin(heading)], -1)
        self._others(mine, moved, faster)
        x[self.rows, self.driven] = mine
        self._as_others_see(t, x, moved, faster)
        return x.astype(np.float32), self._whole(t, moved, faster)

    def _others(self, mine, moved, faster) -> None:
        """What the driven agent sees of others; those who are not there stay where nobody is."""
        for j in range(self.names.slots):
            seen = np.ones((self.count, 1))
            if f"other{j}.seen" in self.names.observation:
                seen = mine[:, self.names.observation[f"other{j}.seen"], None] > 0.5
            mine[:, self.names.pair(f"other{j}.d{{}}")] -= moved * seen
            if pair := self.names.pair(f"other{j}.dv{{}}"):
                mine[:, pair] -= faster * seen
        if self.sorted and self.names.slots > 1:
            others = self.names.entries.others[: self.names.slots]
            whats = list(others[0])
            entries = np.array([[other[what] for what in whats] for other in others])
            blocks = mine[:, entries]  # (W, K, C)
            far = np.linalg.norm(blocks[..., [whats.index(f"d{axis}") for axis in self.names.axes]], axis=-1)
            if "seen" in whats:
                far = np.where(blocks[..., whats.index("seen")] > 0.5, far, NOBODY)
            order = np.argsort(far, -1, kind="stable")
            mine[:, entries] = np.take_along_axis(blocks, order[..., None], 1)

    def _as_others_see(self, t: int, x, moved, faster) -> None:
        """What others see of the driven agent, in teams in which everybody sees everybody."""
        if self.names.slots != self.names.agents - 1:
            return
        listed = self._listed(t)
        for j in range(self.names.agents):
            for slot in range(self.names.slots):
                about = ((self.driven != j) & (listed[:, j] == slot))[:, None]
                for pattern, change in ((f"other{slot}.d{{}}", moved), (f"other{slot}.dv{{}}", faster)):
                    if pair := self.names.pair(pattern):
                        x[:, j, pair] += change * about

    def _listed(self, t: int) -> np.ndarray:
        """(W, N) which of its others the driven agent is to each agent at row t: by the team's order, or the one that
        is where the driven agent is, where places tell that it is none of the team's order."""
        n = self.names.agents
        usual = np.minimum(self.driven[:, None] - (self.driven[:, None] > np.arange(n)), n - 2)
        x = np.asarray(self.observations[:, t], np.float64)
        place = self.names.place(x, None if self.state is None else np.asarray(self.state[:, t], np.float64))
        if place is None:
            return usual
        gap = x[..., np.array(self.names.pairs("other{}.d{{}}", n - 1))]  # (W, N, K, X)
        gap = np.linalg.norm(gap - (place[self.rows, self.driven][:, None] - place)[:, :, None], axis=-1)
        near = EXACT * np.maximum(np.linalg.norm(place - place[:, :1], axis=-1).max(-1), EXACT)[:, None]
        wrong = np.take_along_axis(gap, usual[..., None], -1)[..., 0] > near
        return np.where(wrong & (gap.min(-1) <= near), gap.argmin(-1), usual)

    def _whole(self, t: int, moved: np.ndarray, faster: np.ndarray) -> np.ndarray | None:
        if self.state is None:
            return None
        state = np.array(self.state[:, t], np.float64)
        for i in range(self.names.agents):
            about = (self.driven == i)[:, None]
            for pattern, change in ((f"agent{i}.{{}}", moved), (f"agent{i}.v{{}}", faster)):
                if pair := self.names.state_pair(pattern):
                    state[:, pair] += change * about
        return state.astype(np.float32)


def windows_of(
    store: EpisodeStore,
    names: Names,
    motion: Motion,
    episodes: np.ndarray,
    steps: int,
    most: int,
    radius: float,
    dt: float,
) -> tuple[Windows, int]:
    """Windows of `steps` in the episodes (E,) that do not overlap, each agent driven in turn, at most `most` drawn
    evenly; and how many were left out because they begin in contact."""
    first = np.concatenate([[0], store.episode_ends[:-1]])
    found = [(e, s) for e in episodes for s in range(0, int(store.lengths[e]) - steps + 1, steps)]
    if not found:
        longest = int(store.lengths[episodes].max())
        raise UserError(f"No held-out episode has {steps} steps (the longest has {longest}); give fewer with steps=.")
    pairs = np.array([(e, s, i) for e, s in found for i in range(store.n_agents)])
    row0 = first[pairs[:, 0]] + pairs[:, 0] + pairs[:, 1]
    touching = np.linalg.norm(motion.offset[row0, pairs[:, 2]], axis=-1).min(-1) < radius
    if touching.all():
        raise UserError(f"All {len(pairs)} windows begin closer than radius={radius:g} m; give a smaller radius.")
    left_out = int(touching.sum())
    keep = np.flatnonzero(~touching)
    if len(keep) > most:
        keep = keep[np.linspace(0, len(keep) - 1, most).astype(int)]
    pairs = pairs[keep]
    episode, start, driven = pairs.T
    rows = row0[keep, None] + np.arange(steps + 1)
    at = (first[episode] + start)[:, None] + np.arange(steps)
    place, velocity = _tracks(motion, rows, driven, dt)
    goal = place[:, -1]
    if pair := names.pair("goal.d{}"):
        goal = place[:, 0] + store.observations[rows[:, 0], driven][:, pair]
    made = Windows(
        names=names,
        sorted=store.card.homogeneous,
        driven=driven,
        episode=episode,
        start=start,
        observations=store.observations[rows],
        state=None if store.state is None else store.state[rows],
        actions=store.actions[at],
        place=place,
        velocity=velocity,
        offset=motion.offset[rows, driven[:, None]],
        goal=goal,
        dt=dt,
    )
    return made, left_out


def _tracks(motion: Motion, rows: np.ndarray, driven: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Places and velocities (W, L+1, X) of the driven agents."""
    who = driven[:, None]
    place = None if motion.place is None else motion.place[rows, who]
    if motion.velocity is not None:
        velocity = motion.velocity[rows, who]
    elif place is not None:
        moved = np.diff(place, axis=1) / dt
        velocity = np.concatenate([moved[:, :1], moved], 1)
    else:
        raise UserError("The logs hold neither places nor velocities of the driven agent; name own.vx and own.vy.")
    if place is None:
        moved = (motion.late * velocity[:, 1:] + (1 - motion.late) * velocity[:, :-1]) * dt
        place = np.concatenate([np.zeros_like(moved[:, :1]), moved.cumsum(1)], 1)
    return place, velocity
