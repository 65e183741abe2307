"""Episodes of tracks: of a constant team, or of one agent among its neighbours, and what each agent sees."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ringfence.errors import StoreError
from ringfence.logs.io.table_schema import TableSchema
from ringfence.logs.io.tracks import Tracks, cut, is_first, nearest, teams
from ringfence.problem.entries import SPACE
from ringfence.problem.partners import others

RELATIVE = tuple(f"d{kind}{axis}" for kind in ("", "v") for axis in SPACE)
BLOCK = 2**22  # entries of observations that are made at once
LARGEST = 2**30  # bytes of observations, above which they are refused unless the table itself is
TIMES = 100  # the bytes of the table: of twenty agents they are forty


@dataclass(frozen=True, eq=False)
class Motion:
    """R rows of tracks, and what their columns are."""

    schema: TableSchema
    tracks: Tracks
    agents: np.ndarray  # their names

    def column(self, name: str) -> np.ndarray:
        """(R,)"""
        return self.tracks.state[:, self.schema.state.index(name)]

    @cached_property
    def place(self) -> np.ndarray:
        """(R, axes of the position) m."""
        return np.stack([self.column(axis) for axis in self.schema.position], 1)

    @cached_property
    def velocity(self) -> np.ndarray:
        """(R, axes) m/s: logged, or by how much positions change from the row before (from the first to the next)."""
        if not self.schema.axes:
            return np.zeros((len(self.tracks.step), 0))
        logged = self.schema.velocity
        return np.stack(
            [self.column(f"v{axis}") if f"v{axis}" in logged else self._slope(axis) for axis in self.schema.axes], 1
        )

    def _slope(self, axis: str) -> np.ndarray:
        first = is_first(self.tracks.segment)
        column = self.column(axis)
        change = np.diff(column, prepend=column[:1]) / self.tracks.dt
        later = np.append(change[1:], 0.0)
        single = first & np.append(first[1:], True)
        return np.where(single, 0.0, np.where(first, later, change))

    def accelerations(self, rows: np.ndarray) -> np.ndarray:
        """(W, N, axes) m/s², of windows' rows; what follows the last row of a window is nobody's."""
        velocity = self.velocity[rows]
        return np.diff(velocity, axis=0, append=velocity[-1:]) / self.tracks.dt

    @property
    def to_goal(self) -> np.ndarray:
        """(R, axes of the position) m."""
        return self.tracks.state[:, len(self.schema.state) :] - self.place

    def own(self, with_place: bool) -> list[Entry]:
        """What an agent knows of itself and of its goal."""
        schema = self.schema
        hidden = schema.velocity if with_place else (*schema.velocity, *schema.position)
        rest = [name for name in schema.state if name not in hidden]
        found = [Entry(f"own.v{axis}", self.velocity[:, k]) for k, axis in enumerate(schema.axes)]
        found += [Entry(f"own.{name}", self.column(name)) for name in rest]
        if schema.goal:
            found += [Entry(f"goal.d{axis}", self.to_goal[:, k]) for k, axis in enumerate(schema.position)]
        return found


class Entry(NamedTuple):
    """One number that each agent of a window sees."""

    name: str
    column: np.ndarray  # (R,)
    whose: np.ndarray | None = None  # (N,) of which other agent of the window, by who sees it; None: of oneself
    relative: bool = False  # to oneself
    near: np.ndarray | None = None  # (R,) the row of another agent, relative to oneself; −1 of nobody, who is `beyond`
    beyond: float = 0.0

    def of(self, rows: np.ndarray) -> np.ndarray:
        """(..., N) in rows (..., N) of the tracks."""
        if self.near is not None:
            theirs = self.near[rows]
            return np.where(theirs < 0, self.beyond, self.column[theirs] - self.column[rows])
        if self.whose is None:
            return self.column[rows]
        theirs = self.column[rows[..., self.whose]]
        return theirs - self.column[rows] if self.relative else theirs


@dataclass(frozen=True, eq=False)
class Episodes:
    """W rows of E episodes of N agents, one after another."""

    rows: np.ndarray  # (W, N) of the tracks
    lengths: np.ndarray  # (E,) rows of each episode
    entries: list[Entry]  # O, of observations
    cost: np.ndarray  # (W, N, K)
    notes: tuple[str, ...] = ()
    sensing_radius: float | None = None  # m, of agents who see their neighbours
    agents: list[str] | None = None  # N names, of a team whose members stay the same

    @property
    def last(self) -> np.ndarray:
        """(E,) rows in which an episode ends."""
        return np.cumsum(self.lengths) - 1

    @property
    def leaves(self) -> np.ndarray:
        """(W,) whether a step follows a row."""
        found = np.ones(len(self.rows), bool)
        found[self.last] = False
        return found

    @property
    def arrives(self) -> np.ndarray:
        """(W,) whether a step leads to a row."""
        found = np.ones(len(self.rows), bool)
        found[self.last - self.lengths + 1] = False
        return found

    def seen(self, rows: np.ndarray) -> np.ndarray:
        """(..., N, O) in double precision."""
        return np.stack([entry.of(rows) for entry in self.entries], -1)

    def observations(self, origins: np.ndarray) -> np.ndarray:
        """(W, N, O) in single precision, less the origins (O,). They are most of what a store holds, so they are made
        once, and block by block."""
        found = np.empty((*self.rows.shape, len(self.entries)), np.float32)
        with np.errstate(over="ignore"):  # what is too large is refused later, by name
            block = max(BLOCK // max(found[:1].size, 1), 1)
            for start in range(0, len(found), block):
                found[start : start + block] = self.seen(self.rows[start : start + block]) - origins
        return found


def team_episodes(motion: Motion) -> Episodes:
    """Episodes of a constant team, of which everybody sees all others."""
    schema, tracks = motion.schema, motion.tracks
    rows, there, n = teams(tracks, schema.team)
    rows = _in_place(motion, rows, there)
    index, lengths = cut(there, schema.min_episode_steps, schema.max_episode_steps)
    if not len(lengths):
        here = np.unique(tracks.agent).size
        raise StoreError(
            f"No {n} agents are together for {schema.min_episode_steps} steps of {tracks.dt:g} s (the table has "
            f"{here}); give another team, a smaller min_episode_steps, a longer gap, or neighbours."
        )
    short = _too_short(motion, rows, there, index, len(lengths))
    rows = rows[index]
    entries = motion.own(with_place=True)
    # of another agent: those of RELATIVE relative to oneself, the rest as they are
    columns = {f"d{axis}": motion.column(axis) for axis in schema.position}
    columns |= {f"dv{axis}": motion.velocity[:, k] for k, axis in enumerate(schema.axes)}
    known = (*schema.position, *schema.velocity)
    columns |= {name: motion.column(name) for name in schema.state if name not in known}
    _refuse_large(motion, rows.size, len(entries) + (rows.shape[1] - 1) * len(columns))
    for j, whose in enumerate(others(rows.shape[1]).T):
        entries += [Entry(f"other{j}.{name}", column, whose, name in RELATIVE) for name, column in columns.items()]
    cost = tracks.cost[rows]
    if schema.separation is not None:  # 1 where the nearest other is closer than the radius
        place = motion.place[rows]
        distance = np.linalg.norm(place[:, None] - place[:, :, None], axis=-1) + 1e9 * np.eye(place.shape[1])
        cost = (distance.min(-1) < schema.separation.radius).astype(float)[..., None]
    members, changes = _members(motion, rows)
    return Episodes(rows, lengths, entries, cost, (*short, *_left_out(motion, rows), *changes), agents=members)


def _refuse_large(motion: Motion, rows: int, entries: int) -> None:
    """Refuse what everybody sees of everybody else, where that is many times what the table holds."""
    size = 4 * rows * entries
    if size > max(LARGEST, TIMES * motion.tracks.state.nbytes):
        raise StoreError(
            f"{rows:,} rows of {entries:,} observations would be {size / 2**30:.1f} GiB; let agents see fewer others, "
            "the nearest alone, with neighbours (--neighbours 6)."
        )


def _members(motion: Motion, rows: np.ndarray) -> tuple[list[str] | None, tuple[str, ...]]:
    """Who stands in each column of rows (W, N), where that is the same agent throughout; else what is said of it."""
    who = motion.tracks.agent[rows]
    if not (who != who[0]).any():
        return [str(name) for name in motion.agents[who[0]].tolist()], ()
    if who.shape[1] == 1:
        return None, ()
    places = np.unique(np.stack([who, np.broadcast_to(np.arange(who.shape[1]), who.shape)]).reshape(2, -1), axis=1)
    moved = motion.agents[np.flatnonzero(np.bincount(places[0]) > 1)].tolist()
    said = "the team changes its members: who comes is seen where somebody left"
    if moved:
        said += f", and so {', '.join(map(str, moved[:5]))}{', ...' * (len(moved) > 5)} change places"
    return None, (said,)


def _in_place(motion: Motion, rows: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Rows (W, N) of windows of `there` rows each, in which agents stay in the column that they had, where nobody who
    was there in the window before has it now; who is new has the first that is free."""
    members = motion.tracks.agent[rows[np.cumsum(there) - there]]
    order = np.empty_like(members)
    place: dict[int, int] = {}
    before: set[int] = set()
    for window, who in enumerate(members.tolist()):
        taken: dict[int, int] = {}
        for agent in sorted(who, key=lambda agent: agent not in before):
            if agent in place:
                taken.setdefault(place[agent], agent)
        free = iter(sorted({*range(len(who))} - taken.keys()))
        taken |= {next(free): agent for agent in who if taken.get(place.get(agent, -1)) != agent}
        place |= {agent: column for column, agent in taken.items()}
        at = {agent: k for k, agent in enumerate(who)}
        order[window] = [at[taken[column]] for column in range(len(who))]
        before = set(who)
    return np.take_along_axis(rows, np.repeat(order, there, 0), 1)


def _too_short(
    motion: Motion, rows: np.ndarray, there: np.ndarray, index: np.ndarray, episodes: int
) -> tuple[str, ...]:
    """What is said of times with too few steps, which `cut` left out: a short one may be one that ended in danger. Of
    windows (W, N) of `there` rows each, `index` are in one of the `episodes`."""
    left = np.ones(len(rows), bool)
    left[index] = False
    window = np.repeat(np.arange(len(there)), there)
    goes_on = np.append(False, left[:-1] & (window[1:] == window[:-1]))
    begins = left & ~goes_on
    times = int(begins.sum())
    if not times:
        return ()
    fewest = motion.schema.min_episode_steps
    said = f"{times} of {times + episodes} times are left out, since they have fewer than {fewest} steps"
    said += " (min_episode_steps)"
    if motion.schema.cost:  # what follows from distances is not known yet
        costly = motion.tracks.cost[rows[left]].any((1, 2))
        with_cost = len(np.unique(np.cumsum(begins)[left][costly]))
        said += f", {with_cost or 'none'} of them with a cost"
    return (said,)


def _left_out(motion: Motion, rows: np.ndarray) -> tuple[str, ...]:
    """What is in no episode, in sentences."""
    tracks = motion.tracks
    notes = []
    every, here = (
        np.bincount(agent.ravel(), minlength=len(motion.agents)) > 0 for agent in (tracks.agent, tracks.agent[rows])
    )
    if rows.shape[1] == 1 and every.sum() > 1:
        notes.append(
            "no two agents are there at one time for long enough: episodes are of one agent alone, since recordings "
            "that are separate are no team"
        )
    used = np.zeros(len(tracks.step), bool)
    used[rows] = True
    share = 1 - used.mean()
    if share > 0.001:
        notes.append(
            f"{100 * share:.1f} % of the rows are left out: other than {rows.shape[1]} agents, or too short a time"
        )
    absent = np.flatnonzero(every & ~here).tolist()
    if absent:
        named = ", ".join(str(motion.agents[k]) for k in absent[:5]) + (", ..." if len(absent) > 5 else "")
        notes.append(f"agents that are in no episode, so that nobody will see them: {named}")
    return tuple(notes)


def neighbour_episodes(motion: Motion) -> Episodes:
    """Episodes of one agent each, who sees its nearest."""
    schema = motion.schema
    tracks = motion.tracks
    assert schema.neighbours is not None
    there = np.bincount(tracks.segment, minlength=tracks.segment.max() + 1)
    index, lengths = cut(there, schema.min_episode_steps, schema.max_episode_steps)
    notes = _too_short(motion, np.arange(len(tracks.segment))[:, None], there, index, len(lengths))
    if not len(lengths):
        raise StoreError(
            f"No agent is there for {schema.min_episode_steps} steps of {tracks.dt:g} s; give a smaller "
            "min_episode_steps."
        )
    own, axes = motion.own(with_place=False), (*schema.position, *schema.axes)
    _refuse_large(motion, len(index), len(own) + schema.neighbours * (1 + len(axes)))
    near = nearest(tracks, motion.place, schema.neighbours, schema.sensing_radius or np.inf).T
    distance = np.full(len(tracks.step), np.inf)  # of the nearest
    reach = 1.0
    for whose in near[::-1]:
        seen = whose >= 0
        distance[seen] = np.linalg.norm(motion.place[whose[seen]] - motion.place[seen], axis=1)
        reach = max(reach, float(distance[seen].max(initial=0.0)))
    radius = schema.sensing_radius or reach
    entries = [*own]
    for j, whose in enumerate(near):  # nobody is as far as one sees
        for k, axis in enumerate(schema.position):
            entries.append(Entry(f"other{j}.d{axis}", motion.place[:, k], near=whose, beyond=0.0 if k else radius))
        for k, axis in enumerate(schema.axes):
            entries.append(Entry(f"other{j}.dv{axis}", motion.velocity[:, k], near=whose))
        entries.append(Entry(f"other{j}.seen", whose >= 0))
    cost = tracks.cost
    if schema.separation is not None:
        cost = (distance < schema.separation.radius).astype(float)[:, None]
    rows = index[:, None]
    return Episodes(rows, lengths, entries, cost[rows], notes, float(radius))
