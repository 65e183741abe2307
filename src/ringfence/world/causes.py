"""Causes of danger: few numbers that tell it by themselves, and where they begin to."""

from __future__ import annotations

from collections.abc import Iterator
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
