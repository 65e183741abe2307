"""Causes of danger: few entries that tell it by themselves, and where they begin to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace

from ringfence.world.readings import SEVERAL, How, in_one, second, shortest


class Cause(msgspec.Struct, frozen=True):
    """A small set of entries that tells danger by itself: the same for each of J things, e.g. others."""

    name: str  # in words, e.g. "own.x, own.y" or "length of other.dx, other.dy"
    things: tuple[tuple[int, ...], ...]  # (J, k) entries of the features
    length: bool = False  # of the entries as a vector, only how long it is
    who: tuple[tuple[int, int], ...] = ()  # agents, and things of theirs, that it holds for; none: all of them
    # Of a length: where in `things` an axis stands that counts by itself, and how much more. The longer of both counts,
    # so that what is nearer is in a cylinder, or in a box.
    apart: int | None = None
    ratio: float = 1.0
    # Of a length whose entries are those of several things: (k, how many), the k-th shortest of theirs counts. Who is
    # crowded has a second one near, and who is lost has nobody.
    nearest: tuple[int, int] | None = None
    # (J, m) entries that are read together with those of `things`, and how: as several numbers, or of a length in one.
    also: tuple[tuple[int, ...], ...] = ()
    how: How = ""
    end: float = 0.0  # of the values of what is high or low where danger is
    against: bool = False  # what is read of `also` counts the other way: one's own velocity, to what stands still

    @property
    def width(self) -> int:
        """How many numbers it reads of a thing."""
        if self.length:
            return 1
        entries = len(self.things[0])
        return {"": entries, "vector": entries + 1, "both": 2 * entries}.get(self.how, 2)

    @property
    def first_is_distance(self) -> bool:
        """Whether the first number that it reads is how far something is, or how long."""
        return self.how in ("nearing", "beside") or (self.length and self.how != "soon")

    def second_edge(self, at: float) -> float:
        """Where the second number begins to be dangerous, if the longer of both is so below `at`."""
        if self.how == "low":
            return self.end + at / self.ratio
        return at / self.ratio if self.how == "ahead" else self.end - at / self.ratio

    @property
    def is_distance(self) -> bool:
        """Whether it reads how far something is, or how long, and nothing else."""
        return self.length and not self.also and self.nearest is None

    def of(self, x: np.ndarray) -> np.ndarray:
        """(..., J, width) what it reads of features (..., D)."""
        read = x[..., np.array(self.things)]
        also = self.read_also(x)
        if not self.length:
            return np.stack(SEVERAL[self.how](read, also), -1) if self.also else read
        lengths = [np.sqrt((part**2).sum(-1)) for part in self.parts(read)]
        return self.in_one(lengths + self.second(read, also))[..., None]

    def read_also(self, x: Any) -> Any:
        """(..., J, m) what is read of `also` in features (..., D), NumPy's or JAX's; None where there is none."""
        if not self.also:
            return None
        also = x[..., np.array(self.also)]
        return -also if self.against else also

    def second(self, read: Any, also: Any) -> list[Any]:
        """Of a length, what it reads of other entries (..., m), NumPy's or JAX's, if it reads any."""
        return [second(self.how, read, also, self.end)] if self.also else []

    def parts(self, read: Any) -> list[Any]:
        """Of a length: the entries (..., k) of each vector of which the longest counts; of several things (..., K, k)
        those of all."""
        if self.nearest is not None:
            return [read.reshape(*read.shape[:-1], self.nearest[1], -1)]
        if self.apart is None:
            return [read]
        rest = [k for k in range(len(self.things[0])) if k != self.apart]
        return [read[..., np.array(rest)], read[..., self.apart : self.apart + 1]]

    def in_one(self, lengths: Sequence[Any]) -> Any:
        """Of the lengths of its parts, or of a length and a second number, NumPy's or JAX's: what it reads."""
        if self.nearest is not None:
            return shortest(lengths[0], self.nearest[0])
        if len(lengths) == 1:
            return lengths[0]
        one, other = lengths
        return in_one(self.how, one, other, self.ratio)

    def holds(self, n_agents: int) -> np.ndarray:
        """(N, J) bool: the agents and things that it is about."""
        if not self.who:
            return np.ones((n_agents, len(self.things)), bool)
        held = np.zeros((n_agents, len(self.things)), bool)
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


def only_of(cause: Cause, n_agents: int) -> Iterator[Cause]:
    """The cause as one that holds for a single agent of those that it holds for, and a single thing of it."""
    for agent, thing in np.argwhere(cause.holds(n_agents)).tolist():
        yield narrowed(cause, ((agent, thing),))


def narrowed(cause: Cause, who: tuple[tuple[int, int], ...]) -> Cause:
    """The cause as one of these agents and things alone; as one of all where none is given."""
    base = cause.name.split(" of agent ")[0]
    if not who:
        return replace(cause, name=base, who=()) if cause.who else cause
    kind = base.removeprefix("length of ").split(".")[0]
    several = len(cause.things) > 1
    each = [f"agent {agent}'s {kind}{thing}" if several else f"agent {agent}" for agent, thing in sorted(who)]
    return replace(cause, name=f"{base} of {', '.join(each)}", who=tuple(sorted(who)))


def only_where(cause: Cause, held: np.ndarray) -> Cause:
    """The cause as one of the agents and things (N, J) that hold."""
    return narrowed(cause, tuple((int(agent), int(thing)) for agent, thing in np.argwhere(held)))


def in_one_number(cause: Cause, how: How, end: float, ratio: float) -> Cause:
    """A cause of a distance and another number in one: dangerous where things are near *and* that is high, or low, or
    they are ahead; or where they will be near soon."""
    distance, other = cause.name.split(", ", 1)
    distance = f"{distance.split('.')[0]}.distance"
    words = {"ahead": "ahead", "soon": f"less {ratio:.3g} times {other}", "low": f"while {other} is low"}
    words = words.get(how, f"while {other} is high")
    return replace(cause, name=f"{distance} {words}", length=True, how=how, end=end, ratio=ratio)


def with_an_axis_apart(cause: Cause, axis: int, ratio: float) -> Cause:
    """The length with one of its axes by itself, which counts so much more: the longer of both."""
    of_all = narrowed(cause, ())
    entries = of_all.name.removeprefix("length of ").split(", ")
    kind = entries[0].split(".")[0]
    entries[0] = entries[0].removeprefix(f"{kind}.")
    rest = ", ".join(name for k, name in enumerate(entries) if k != axis)
    name = f"{kind}.{rest} or {ratio:.3g} {entries[axis]}, the longer"
    return narrowed(replace(of_all, name=name, apart=axis, ratio=ratio), cause.who)
