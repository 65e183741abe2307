"""Causes of danger: few entries that tell it by themselves, and where they begin to."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from msgspec.structs import replace

from ringfence.problem.features import numbered
from ringfence.types import Array

WIDEST = 4  # entries of one cause
AHEAD = "own speed ahead"  # which names do not give, and which the card has a range of
RELATIVE = re.compile(r"(?!own\.)[a-z_]+\d*\.dv[xy]")  # how fast things move, less one's own velocity


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
    # (J, k) velocities relative to oneself: it reads how far each thing is, and how fast that comes nearer.
    speeds: tuple[tuple[int, ...], ...] = ()

    @property
    def width(self) -> int:
        """How many numbers it reads of a thing."""
        if self.speeds:
            return 2
        return 1 if self.length else len(self.things[0])

    def of(self, x: np.ndarray) -> np.ndarray:
        """(..., J, width) what it reads of features (..., D)."""
        read = x[..., np.array(self.things)]
        if self.speeds:
            return np.stack(nearing(read, x[..., np.array(self.speeds)]), -1)
        if not self.length:
            return read
        return self.longest([np.sqrt((part**2).sum(-1, keepdims=True)) for part in self.parts(read)])

    def parts(self, read: Any) -> list[Any]:
        """Of a length: the entries (..., k) of each vector of which the longest counts."""
        if self.apart is None:
            return [read]
        rest = [k for k in range(len(self.things[0])) if k != self.apart]
        return [read[..., np.array(rest)], read[..., self.apart : self.apart + 1]]

    def longest(self, lengths: Sequence[Any]) -> Any:
        """Of the lengths of its parts, NumPy's or JAX's: what it reads."""
        if self.apart is None:
            return lengths[0]
        one, other = lengths
        longer = jnp.maximum if isinstance(one, jax.Array) else np.maximum
        return longer(one, self.ratio * other)

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


def candidates(names: Sequence[str]) -> Iterator[Cause]:
    """Every entry and every two entries of oneself, and of each kind of thing; of two also their length."""
    things = things_of(names)
    inside = {d for kind in things.values() for fields in kind for d in fields.values()}
    own = [d for d in range(len(names)) if d not in inside]
    yield from _sets("", [{names[d]: d for d in own}])
    for kind, each in things.items():
        yield from _sets(kind, each)
    yield from (cause for cause in offsets(names) if len(cause.things[0]) > 2)


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


def offsets(names: Sequence[str]) -> list[Cause]:
    """How far away things are, by kind, as names tell (dx, dy, dz)."""
    found = []
    for kind, each in things_of(names).items():
        axes = [f"d{c}" for c in "xyz" if f"d{c}" in each[0]]
        if axes:
            things = tuple(tuple(thing[a] for a in axes) for thing in each)
            found.append(Cause(f"length of {kind}.{', '.join(axes)}", things, length=True))
    return found


def nearing(offset: Any, velocity: Any) -> tuple[Any, Any]:
    """How far things (..., k) are, NumPy's or JAX's, and how fast that comes nearer."""
    far = ((offset**2).sum(-1) + 1e-9) ** 0.5
    return far, -(offset * velocity).sum(-1) / far


def nearing_of(names: Sequence[str]) -> list[Cause]:
    """How far things are and how fast they come nearer, by kind, where names tell: danger of how soon they meet."""
    found = []
    for kind, each in things_of(names).items():
        axes = [c for c in "xyz" if f"d{c}" in each[0]]
        if axes and all(f"dv{c}" in each[0] for c in axes):
            things, speeds = (tuple(tuple(one[what + c] for c in axes) for one in each) for what in ("d", "dv"))
            found.append(Cause(f"{kind}.distance, how fast it shrinks", things, speeds=speeds))
    return found


def with_an_axis_apart(cause: Cause, axis: int, ratio: float) -> Cause:
    """The length with one of its axes by itself, which counts so much more: the longer of both."""
    of_all = narrowed(cause, ())
    entries = of_all.name.removeprefix("length of ").split(", ")
    kind = entries[0].split(".")[0]
    entries[0] = entries[0].removeprefix(f"{kind}.")
    rest = ", ".join(name for k, name in enumerate(entries) if k != axis)
    name = f"{kind}.{rest} or {ratio:.3g} {entries[axis]}, the longer"
    return narrowed(replace(of_all, name=name, apart=axis, ratio=ratio), cause.who)


class Heading(msgspec.Struct, frozen=True):
    """Entries that tell how fast a body that looks into a direction goes ahead: its velocity, or its speed, and that
    direction."""

    velocity: tuple[int, ...]  # two, or the speed
    direction: tuple[int, int]
    relative: tuple[tuple[int, int], ...] = ()  # velocities of things less one's own, and along which axis

    @classmethod
    def of(cls, names: Sequence[str]) -> Heading | None:
        """None where names tell of none."""
        at = {name: d for d, name in enumerate(names)}
        if not {"own.cos", "own.sin"} <= set(at):
            return None
        direction = at["own.cos"], at["own.sin"]
        relative = [(d, "xy".index(name[-1])) for name, d in at.items() if RELATIVE.fullmatch(name)]
        if {"own.vx", "own.vy"} <= set(at):
            return cls((at["own.vx"], at["own.vy"]), direction, tuple(relative))
        speed = next((at[name] for name in ("own.v", "own.speed") if name in at), None)
        return None if speed is None else cls((speed,), direction, tuple(relative))

    @property
    def about(self) -> tuple[int, ...]:
        """Entries that are relative to the velocity."""
        return tuple(entry for entry, _ in self.relative)

    def speed(self, x: Any) -> Any:
        """(...) ahead, of features (..., D), NumPy's or JAX's: negative of who goes backwards."""
        if len(self.velocity) == 1:
            return x[..., self.velocity[0]]
        cos, sin = (x[..., d] for d in self.direction)
        vx, vy = (x[..., v] for v in self.velocity)
        return (vx * cos + vy * sin) / (cos**2 + sin**2 + 1e-9) ** 0.5

    def no_slower(self, x: Array, least: float) -> Array:
        """Features (..., D) with that speed ahead at least, and what is relative to it as much less."""
        lacks = jnp.maximum(least - self.speed(x), 0.0)[..., None]
        direction = x[..., np.array(self.direction)]
        length = jnp.sqrt((direction**2).sum(-1, keepdims=True) + 1e-9)
        faster = lacks * direction / length
        x = x.at[..., np.array(self.velocity)].add(faster if len(self.velocity) == 2 else lacks)
        if not self.relative:
            return x
        axes = np.array([axis for _, axis in self.relative])
        return x.at[..., np.array(self.about)].add(-faster[..., axes])


def things_of(names: Sequence[str]) -> dict[str, list[dict[str, int]]]:
    """Fields of each thing, by kind: those that all of a kind have."""
    kinds = {}
    for kind, things in numbered(names).items():
        shared = set.intersection(*[set(fields) for fields in things])
        if shared:
            kinds[kind] = [{f: d for f, d in fields.items() if f in shared} for fields in things]
    return kinds


def _sets(kind: str, each: list[dict[str, int]]) -> Iterator[Cause]:
    fields = list(each[0])
    of = f"{kind}." if kind else ""
    for field in fields:
        yield Cause(of + field, tuple((thing[field],) for thing in each))
    for one, two in itertools.combinations(fields, 2):
        both = tuple((thing[one], thing[two]) for thing in each)
        yield Cause(f"{of}{one}, {of}{two}", both)
        yield Cause(f"length of {of}{one}, {of}{two}", both, length=True)


def wider(cause: Cause, names: Sequence[str]) -> Iterator[Cause]:
    """The cause with one more entry of oneself, or of the same thing; of whom it is."""
    if len(cause.things[0]) < WIDEST and cause.apart is None and not cause.speeds:
        base = narrowed(cause, ())
        base = replace(base, length=False, name=base.name.removeprefix("length of "))
        yield from (narrowed(more, cause.who) for more in _with_one_more(base, names))


def _with_one_more(cause: Cause, names: Sequence[str]) -> Iterator[Cause]:
    things = things_of(names)
    inside = {d for kind in things.values() for fields in kind for d in fields.values()}
    for d, name in enumerate(names):
        if d not in inside and d not in cause.things[0]:
            yield replace(cause, name=f"{cause.name}, {name}", things=tuple((*t, d) for t in cause.things))
    for kind, each in things.items():
        if len(each) != len(cause.things) or not set(cause.things[0]) & set(each[0].values()):
            continue
        for field in each[0]:
            if each[0][field] not in cause.things[0]:
                more = tuple((*t, thing[field]) for t, thing in zip(cause.things, each))
                yield replace(cause, name=f"{cause.name}, {kind}.{field}", things=more)
