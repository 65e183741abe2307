"""Causes of danger: few numbers that tell it by themselves, and where they begin to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from msgspec.structs import replace

from ringfence.world.quantities import (
    Between,
    Entry,
    Length,
    Quantity,
    from_zero,
    goes_on,
    how_many,
    is_condition,
    leaves,
    varies,
)


class Cause(msgspec.Struct, frozen=True):
    """A few numbers that tell danger by themselves: the same for each of J things, e.g. others."""

    reads: tuple[Quantity, ...]
    who: tuple[tuple[int, int], ...] = ()  # agents, and things of theirs, that it holds for; none: all of them

    @property
    def name(self) -> str:
        """In words, e.g. "own.x, own.y" or "length of other.dx, other.dy"."""
        if not self.who:
            return self._words
        kind, several = self.kind, self.things > 1
        each = [f"agent {agent}'s {kind}{thing}" if several else f"agent {agent}" for agent, thing in self.who]
        return f"{self._words} of {', '.join(each)}"

    @property
    def _words(self) -> str:
        alone = self.reads[0]
        if len(self.reads) == 1 and isinstance(alone, Length) and len(alone.parts) > 1:
            return f"length of {', '.join(part.words for part in alone.parts)}"
        return ", ".join(read.words for read in self.reads)

    @property
    def kind(self) -> str:
        """What kind of things it is about."""
        several = [leaf for read in self.reads for leaf in leaves(read) if len(leaf.at) > 1]
        return (several or list(leaves(self.reads[0])))[0].name.split(".")[0]

    @property
    def width(self) -> int:
        """How many numbers it reads of a thing."""
        return len(self.reads)

    @property
    def things(self) -> int:
        """J"""
        return max(how_many(read) for read in self.reads)

    @property
    def from_zero(self) -> bool:
        """Whether the first number that it reads is how far something is, or how long."""
        return from_zero(self.reads[0])

    @property
    def goes_on(self) -> bool:
        """Whether it is one number, of which nearer is worse, also nearer than anything was."""
        return self.width == 1 and goes_on(self.reads[0])

    @property
    def is_rule(self) -> bool:
        """Whether it is conditions that hold together, and dangerous below 0."""
        return self.width == 1 and is_condition(self.reads[0])

    @property
    def vector(self) -> tuple[Entry, ...] | None:
        """Of what reads how long a vector is, or how far something is away, and nothing else: the vector's entries."""
        (first, *more) = self.reads
        parts = first.parts if isinstance(first, Length) and not more else ()
        entries = tuple(part for part in parts if isinstance(part, Entry))
        return entries if entries and len(entries) == len(parts) else None

    def entries(self) -> tuple[frozenset[int], ...]:
        """(J,) the entries that it reads of each thing."""
        read = [np.array(leaf.at) for one in self.reads for leaf in leaves(one)]
        each = (at if len(at) == self.things > 1 else np.tile(at, (self.things, 1)).T for at in read)
        rows = np.concatenate([at.reshape(-1, self.things) for at in each])
        return tuple(frozenset(rows[:, j].tolist()) for j in range(self.things))

    def of(self, x: Any) -> Any:
        """(..., J, width) what it reads of features (..., D), NumPy's or JAX's."""
        numbers = jnp if isinstance(x, jax.Array) else np
        read = [one.of(x) for one in self.reads]
        if self.width == 1:
            return read[0][..., None]
        return numbers.stack(numbers.broadcast_arrays(*read), -1)

    def between(self, low: Any, high: Any) -> tuple[Any, Any]:
        """The least and the most (..., J, width) that it reads of all features between (..., D)."""
        each = [one.of(Between(low, high)) for one in self.reads]
        return tuple(jnp.stack(jnp.broadcast_arrays(*ends), -1) for ends in zip(*each))  # pyright: ignore

    def varies(self, entries: np.ndarray) -> np.ndarray:
        """(N, J) bool: of which agents and things all that it reads varies, by the entries (N, D) that do."""
        found = np.ones((len(entries), self.things), bool)
        for read in self.reads:
            found &= varies(read, entries)
        return found

    def holds(self, n_agents: int) -> np.ndarray:
        """(N, J) bool: the agents and things that it is about."""
        if not self.who:
            return np.ones((n_agents, self.things), bool)
        held = np.zeros((n_agents, self.things), bool)
        held[tuple(np.array(self.who).T)] = True
        return held


class Edge(msgspec.Struct, frozen=True):
    """Where a cause is dangerous, as the logs tell it."""

    low: tuple[float, ...]  # of what was seen
    high: tuple[float, ...]
    at: float | None = None  # of a cause of one number with one edge: where danger begins
    below: bool = True  # whether it is dangerous below that, e.g. near another, or above
    # Of a cause of one number: everywhere that danger begins or ends, in order, and whether it is dangerous below all.
    bounds: tuple[float, ...] = ()
    inside: bool = True
    # Which of the bounds are where the logs end, and not where danger was seen.
    unseen: tuple[bool, ...] = ()


class Found(msgspec.Struct, frozen=True):
    """Causes of a data set, and how much of its danger they tell on steps that did not find them."""

    causes: tuple[Cause, ...] = ()
    explained: float = 0.0  # share of unsafe steps that a cause explains
    false_alarms: float = 0.0  # share of safe steps that a cause calls unsafe
    shares: tuple[float, ...] = ()  # by cause: share of unsafe steps that it explains
    edges: tuple[Edge, ...] = ()  # by cause
    searched: bool = False  # whether any were looked for


def only_of(cause: Cause, n_agents: int) -> Iterator[Cause]:
    """The cause as one that holds for a single agent of those that it holds for, and a single thing of it."""
    for agent, thing in np.argwhere(cause.holds(n_agents)).tolist():
        yield narrowed(cause, ((agent, thing),))


def narrowed(cause: Cause, who: tuple[tuple[int, int], ...]) -> Cause:
    """The cause as one of these agents and things alone; as one of all where none is given."""
    return cause if not who and not cause.who else replace(cause, who=tuple(sorted(who)))


def only_where(cause: Cause, held: np.ndarray) -> Cause:
    """The cause as one of the agents and things (N, J) that hold."""
    return narrowed(cause, tuple((int(agent), int(thing)) for agent, thing in np.argwhere(held)))


CELLS = {1: 200, 2: 48, 3: 20, 4: 11}  # along each axis, by the number of entries, at most
BEYOND = 0.5  # of the range of what was seen: how far outside of it cells are taken to be like the nearest ones
APART = 1.5  # cells from the nearest visited one, from which on a place counts as never visited
NEARBY = 4.0  # cells, deviation of the places that are asked about close to visited ones
ALONG = 0.05  # weight of a distance beside what else a cause reads: what is there is known by who was so, however far
VISITED = 3  # visits that make a cell known
GAP = 0.1  # of the range of one number, unvisited: no few steps more would have filled it
TURNS = (20.0, 0.1)  # visits, and share of the dangerous ones, that have to contradict before danger begins or ends


@dataclass(frozen=True, eq=False)
class Cells:
    """Where a cause is dangerous, cell by cell."""

    cause: Cause
    cuts: (
        np.ndarray
    )  # (width, bins + 1) where cells begin and end along each axis, the shorter the more danger is there
    visits: np.ndarray  # (bins ** width,) by safe and unsafe steps
    danger: np.ndarray  # (bins ** width,) probability that being there makes a step unsafe

    @property
    def low(self) -> np.ndarray:
        """(width,) where cells begin."""
        return np.asarray(self.cuts[:, 0], float)

    @property
    def high(self) -> np.ndarray:
        """(width,) where they end."""
        return np.asarray(self.cuts[:, -1], float)

    @property
    def bins(self) -> int:
        """Along each axis."""
        return self.cuts.shape[1] - 1

    def known(self) -> tuple[np.ndarray, np.ndarray]:
        """(centres (K, width), unsafe (K,) bool) of the cells that were visited."""
        cell = np.flatnonzero(self.visits >= VISITED)
        places = np.stack(np.unravel_index(cell, (self.bins,) * len(self.low)), -1)
        middles = 0.5 * (self.cuts[:, 1:] + self.cuts[:, :-1])
        centres = np.take_along_axis(middles.T.astype(float), places, 0)
        return centres, self.danger[cell] > 0.5

    @property
    def edge(self) -> Edge:
        low = tuple(round(float(v), 4) for v in self.low)
        high = tuple(round(float(v), 4) for v in self.high)
        if len(low) > 1 or not (self.danger > 0.5).any():
            return Edge(low, high)
        unsafe = self._unsafe_along()
        turns = np.flatnonzero(unsafe[1:] != unsafe[:-1]) + 1
        bounds = [float(self.cuts[0, k]) for k in turns]
        unseen = [False] * len(bounds)
        inside = bool(unsafe[0])
        at = round(bounds[0], 4) if len(bounds) == 1 or (bounds and self.cause.goes_on) else None
        if not self.cause.goes_on and not unsafe[0]:
            bounds.insert(0, float(self.low[0] - self.size))
            unseen.insert(0, True)
            inside = True
        if not self.cause.goes_on and not unsafe[-1]:
            bounds.append(float(self.high[0] + self.size))
            unseen.append(True)
        return Edge(low, high, at, bool(unsafe[0]), tuple(bounds), inside, tuple(unseen))

    @property
    def size(self) -> float:
        """How long a cell is along the first axis, in the mean."""
        return float(self.high[0] - self.low[0]) / self.bins

    def _unsafe_along(self) -> np.ndarray:
        """(bins,) bool of a cause of one number: dangerous cells, in as few pieces as what was counted allows, since
        the edge of danger is not to flicker where few were. The likeliest pieces (Viterbi 1967)."""
        known = self.visits >= VISITED
        called_safe = np.where(known, self.visits * self.danger, 0.0)
        called_unsafe = np.where(known, self.visits * (1.0 - self.danger), 0.0)
        # What nobody visited is like the nearest, or, but of a distance, unsafe where that is far.
        middles = 0.5 * (self.cuts[0, 1:] + self.cuts[0, :-1])
        nearest = np.abs(middles[:, None] - middles[known])
        like = self.danger[np.flatnonzero(known)[nearest.argmin(1)]] > 0.5
        far = nearest.min(1) / self.size > 0.5 * GAP * self.bins + 1e-6
        most, share = TURNS
        turn = min(most, share * called_safe.sum())
        called_safe = np.where(known, called_safe, 1e-3 * like)
        called_unsafe = np.where(known, called_unsafe, 1e-3 * ~like)
        if not self.cause.goes_on:
            called_safe = np.where(far, 3 * turn, called_safe)
        return _likeliest(np.stack([called_safe, called_unsafe], -1), turn)

    def beyond(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """(values (count, width), unsafe (count,) bool) of places that were never visited.

        Along a distance each is like the nearest that was, at the same speed where a cause reads this, too: what is
        nearer than anybody came is as unsafe as that, and what is farther away as safe. Anywhere else what nobody
        visited is unsafe: nothing says that it is not a wall.
        """
        from scipy.spatial import KDTree  # slow to import, and read by fits alone

        centres, unsafe = self.known()
        scale = (self.high - self.low) / self.bins
        values = self._around(centres, scale, 4 * count, rng)
        far, nearest = (np.asarray(a) for a in KDTree(centres / scale).query(values / scale))
        new = np.flatnonzero(far > APART)[:count]
        if not len(new):
            new = np.arange(count)
        values, far, nearest = (a[np.resize(new, count)] for a in (values, far, nearest))
        if self.cause.from_zero:
            scale = scale * [1 / ALONG, *[1.0] * (self.cause.width - 1)]
            nearest = np.asarray(KDTree(centres / scale).query(values / scale)[1])
            far = np.abs((values - centres[nearest]) / scale)[:, 1:].max(1, initial=0.0)
        return values, unsafe[nearest] | (far > APART)

    def _around(self, centres: np.ndarray, scale: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
        """(count, width) values in and around what was visited: half of them anywhere, half close to it."""
        reach = BEYOND * (self.high - self.low)
        anywhere = rng.uniform(self.low - reach, self.high + reach, (count // 2, len(scale)))
        close = centres[rng.integers(len(centres), size=count - count // 2)]
        close = close + scale * rng.normal(0.0, NEARBY, close.shape)
        values = np.concatenate([anywhere, close])[rng.permutation(count)]
        if self.cause.from_zero:
            values[:, 0] = np.maximum(values[:, 0], 0.0)
        return values


def _likeliest(costs: np.ndarray, turn: float) -> np.ndarray:
    """(K,) bool: which of two states each of K cells is in, at these costs (K, 2) of each and of a turn."""
    total = costs[0].copy()
    came_from = np.zeros((len(costs), 2), int)
    for k in range(1, len(costs)):
        other = total[::-1] + turn
        came_from[k] = np.where(other < total, [1, 0], [0, 1])
        total = np.minimum(total, other) + costs[k]
    state = int(total.argmin())
    found = np.empty(len(costs), bool)
    for k in range(len(costs) - 1, -1, -1):
        found[k] = bool(state)
        state = came_from[k, state]
    return found
