"""Causes of danger: few entries that tell it by themselves, where they begin to, and what is read of them.

What is read of several together is read of NumPy's arrays and of JAX's alike. `offset` (..., k) is where things are,
`also` (..., m) what else is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from msgspec.structs import replace

SLOPED = 1e-9  # of squares, by which their root has a slope at 0, too
# Nothing more; as several numbers, see SEVERAL; in one, see `Cause._second`.
How = Literal["", "nearing", "beside", "turned", "vector", "both", "high", "low", "ahead", "coming", "soon"]


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

    def of(self, x: Any, least: float = 0.0) -> Any:
        """(..., J, width) what it reads of features (..., D), NumPy's or JAX's. A length whose `least` square is SLOPED
        has a slope everywhere."""
        numbers = _numbers_of(x)
        read = x[..., np.array(self.things)]
        also = x[..., np.array(self.also)] if self.also else None
        if also is not None and self.against:
            also = -also
        if not self.length:
            return read if also is None else numbers.stack(SEVERAL[self.how](read, also), -1)
        lengths = [numbers.sqrt((part**2).sum(-1) + least) for part in self.parts(read)]
        return self.in_one(lengths if also is None else [*lengths, self._second(read, also)])[..., None]

    def _second(self, offset: Any, also: Any) -> Any:
        """(...,) the number that is read beside a distance: by how much an entry is below its highest value, or above
        its lowest, at `end`; by what angle (rad) things are off a direction, to either side; by how much slower they
        come nearer than ever; or how fast."""
        if self.how == "ahead":
            ahead, left = turned(offset, also)
            return _numbers_of(left).arctan2((left**2 + SLOPED) ** 0.5, ahead)  # with a slope where it is right ahead
        other = (nearing if self.how in ("soon", "coming") else beside)(offset, also)[1]
        if self.how == "soon":
            return other
        return other - self.end if self.how == "low" else self.end - other

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
        """What it reads of the lengths of its parts, or of a length and a second number, NumPy's or JAX's: the longer,
        of which the second counts so much more, so that it is low where both are; how far things will be in so long a
        time; or the k-th shortest of lengths (..., K)."""
        far = lengths[0]
        if self.nearest is not None:
            return _numbers_of(far).sort(far, axis=-1)[..., self.nearest[0] - 1]
        if len(lengths) == 1:
            return far
        other = self.ratio * lengths[1]
        return far - other if self.how == "soon" else _numbers_of(far).maximum(far, other)

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


# --- what is read of how far things are together with something more ---


def nearing(offset: Any, velocity: Any) -> tuple[Any, Any]:
    """How far things are, and how fast that comes nearer."""
    far = _length(offset)
    return far, -(offset * velocity).sum(-1) / far


def beside(offset: Any, also: Any) -> tuple[Any, Any]:
    """How far things are, and another entry, or how long several are as a vector."""
    return _length(offset), also[..., 0] if also.shape[-1] == 1 else _length(also)


def turned(offset: Any, direction: Any) -> tuple[Any, Any]:
    """How far ahead of who looks into a direction, a vector or an angle, things are, and how far to the left."""
    x, y = offset[..., 0], offset[..., 1]
    cos, sin = direction[..., 0], direction[..., -1]
    if direction.shape[-1] == 1:
        numbers = _numbers_of(direction)
        cos, sin = numbers.cos(cos), numbers.sin(sin)
    else:
        long = _length(direction)
        cos, sin = cos / long, sin / long
    return x * cos + y * sin, y * cos - x * sin


def with_vector(entries: Any, also: Any) -> tuple[Any, ...]:
    """Entries, and how long others are as a vector."""
    return *(entries[..., k] for k in range(entries.shape[-1])), _length(also)


def both(offset: Any, place: Any) -> tuple[Any, ...]:
    """Where one is oneself, and where things are."""
    axes = range(place.shape[-1])
    return *(place[..., k] for k in axes), *(place[..., k] + offset[..., k] for k in axes)


SEVERAL = {"nearing": nearing, "beside": beside, "turned": turned, "vector": with_vector, "both": both}


def _length(vectors: Any) -> Any:
    return ((vectors**2).sum(-1) + SLOPED) ** 0.5


def _numbers_of(array: Any) -> Any:
    return jnp if isinstance(array, jax.Array) else np
