"""Causes that danger may have, as names of entries tell: places, speeds, and how near things are."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence

from msgspec.structs import replace

from ringfence.problem.entries import LANE, SPACE, Entries, axes_of
from ringfence.world.causes import Cause, narrowed

WIDEST = 4  # entries of one cause
ROW = 3  # entries at least that names number
NAMELESS = ("obs", "state", "entry")  # what numbers alone tell apart is no row
ORDINALS = ("", "second ", "third ", "fourth ", "fifth ", "sixth ")  # nearest of several things, that causes read


def candidates(names: Sequence[str]) -> Iterator[Cause]:
    """Every entry and every two entries of oneself, and of each kind of thing; of two also their length."""
    yield from _rows(names)
    yield from _sets("", [_own(names)])
    for kind, each in things_of(names).items():
        yield from _sets(kind, each)
    yield from (cause for cause in offsets(names) if len(cause.things[0]) > 2)


def _rows(names: Sequence[str]) -> Iterator[Cause]:
    """Entries that names number, of which any may be dangerous: rays of a lidar (`lidar_0`, `ray3`), cells of a
    battery. As numbers, and as how long they are: what is nearer than anything was, is as dangerous."""
    found: dict[str, list[tuple[int, int]]] = {}
    for d, name in enumerate(names):
        if (match := re.fullmatch(r"([\w.]*?[a-z])[._[ ]?(\d+)]?", name)) and match[1] not in NAMELESS:
            found.setdefault(match[1], []).append((int(match[2]), d))
    for name, row in found.items():
        if len(row) >= ROW:
            entries = tuple((d,) for _, d in sorted(row))
            yield Cause(name, entries)
            yield Cause(name, entries, length=True)


def offsets(names: Sequence[str]) -> list[Cause]:
    """How far away things are, by kind, as names tell (dx, dy, dz)."""
    found = []
    for kind, each in things_of(names).items():
        if axes := [f"d{c}" for c in axes_of(each[0])]:
            found.append(Cause(f"length of {kind}.{', '.join(axes)}", _picked(each, axes), length=True))
    return found


def with_distances(names: Sequence[str]) -> list[Cause]:
    """How far things are together with one number more, by kind, where names tell: how fast they come nearer (danger of
    how soon they meet), or an entry or a vector of oneself or of theirs (near and fast). And where they are to who
    looks into a direction."""
    found: list[Cause] = []
    own, several, lone = _own(names), things_of(names), _lone_things(names)
    known = Entries.of(names)
    looks = known.direction or known.pair("v{}")  # who tells no direction looks to where he moves
    of_lone = {d for each in lone.values() for d in each[0].values()}
    moving = {name: d for name, d in own.items() if d not in of_lone}
    for kind, each in (several | lone).items():
        axes = axes_of(each[0])
        if axes:
            offset = Cause(f"{kind}.distance", _picked(each, [f"d{c}" for c in axes]))
            found += _nearing(offset, each, axes, own)
            found += _turned(offset, kind, looks)
            found += _beside(offset, [own if kind in several else moving] * len(each))
            theirs = [{f"{kind}.{f}": d for f, d in thing.items() if f[1:] not in axes} for thing in each]
            found += _beside(offset, theirs)
        if kind in several:
            found += _both(kind, each, axes, own)
    return found


def _nearing(offset: Cause, each: Sequence[dict[str, int]], axes: str, own: dict[str, int]) -> Iterator[Cause]:
    """How far things are, and how fast that shrinks: by their velocity, or of what logs none by one's own."""
    theirs, mine = [f"dv{c}" for c in axes], [f"own.v{c}" for c in axes]
    name = f"{offset.name}, how fast it shrinks"
    if set(theirs) <= set(each[0]):
        yield replace(offset, name=name, also=_picked(each, theirs), how="nearing")
    elif set(mine) <= set(own):
        yield replace(offset, name=name, also=_picked([own] * len(each), mine), how="nearing", against=True)


def _turned(offset: Cause, kind: str, looks: tuple[int, ...]) -> Iterator[Cause]:
    """How far ahead things in a plane are, and how far aside."""
    if len(offset.things[0]) == 2 and looks:
        also = (looks,) * len(offset.things)
        yield replace(offset, name=f"{kind}.ahead, {kind}.aside", also=also, how="turned")


def _both(kind: str, each: Sequence[dict[str, int]], axes: str, own: dict[str, int]) -> Iterator[Cause]:
    """Where one is, and where things are: what has room for one is dangerous for two."""
    place = [f"own.{c}" for c in axes]
    if set(place) <= set(own) and 0 < 2 * len(axes) <= WIDEST:
        offset = _picked(each, [f"d{c}" for c in axes])
        yield Cause(f"{kind}.place, own.place", offset, also=_picked([own] * len(each), place), how="both")


def _beside(offset: Cause, fields: Sequence[dict[str, int]]) -> Iterator[Cause]:
    """How far things are, and a number more: of these fields, or how long several are as a vector."""
    for group in _numbers(list(fields[0])):
        number = ("length of " if len(group) > 1 else "") + ", ".join(group)
        yield replace(offset, name=f"{offset.name}, {number}", also=_picked(fields, group), how="beside")


def of_several(names: Sequence[str]) -> Iterator[Cause]:
    """How far away the nearest of several things is, the second nearest, and so on: who is crowded, or alone."""
    for cause in offsets(names):
        count = len(cause.things)
        kind = cause.name.removeprefix("length of ").split(".")[0]
        for k, ordinal in enumerate(ORDINALS[:count] if count > 1 else (), 1):
            name = f"{kind}.distance of the {ordinal}nearest"
            yield replace(cause, name=name, things=(sum(cause.things, ()),), nearest=(k, count))


def with_vectors(names: Sequence[str]) -> Iterator[Cause]:
    """An entry of oneself, or two that are a vector, with how long another vector is: e.g. a place and a speed."""
    own = _own(names)
    groups = list(_numbers(list(own)))
    for base, vector in itertools.product(groups, groups):
        if len(vector) > 1 and len(base) < 3 and not set(base) & set(vector):
            name = f"{', '.join(base)}, length of {', '.join(vector)}"
            yield Cause(name, _picked([own], base), also=_picked([own], vector), how="vector")


def _picked(things: Sequence[dict[str, int]], fields: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """(J, k) entries of these fields of each thing."""
    return tuple(tuple(thing[field] for field in fields) for thing in things)


def _own(names: Sequence[str]) -> dict[str, int]:
    """Entries that are no thing's, by name."""
    inside = {d for kind in things_of(names).values() for fields in kind for d in fields.values()}
    return {name: d for d, name in enumerate(names) if d not in inside}


def wider(cause: Cause, names: Sequence[str]) -> Iterator[Cause]:
    """The cause with one more entry of oneself, or of the same thing; of whom it is."""
    if len(cause.things[0]) < WIDEST and cause.apart is None and not cause.also:
        base = narrowed(cause, ())
        base = replace(base, length=False, name=base.name.removeprefix("length of "))
        yield from (narrowed(more, cause.who) for more in _with_one_more(base, names))


def _with_one_more(cause: Cause, names: Sequence[str]) -> Iterator[Cause]:
    for name, d in _own(names).items():
        if d not in cause.things[0]:
            yield replace(cause, name=f"{cause.name}, {name}", things=tuple((*t, d) for t in cause.things))
    for kind, each in things_of(names).items():
        if len(each) != len(cause.things) or not set(cause.things[0]) & set(each[0].values()):
            continue
        for field in each[0]:
            if each[0][field] not in cause.things[0]:
                more = tuple((*t, thing[field]) for t, thing in zip(cause.things, each))
                yield replace(cause, name=f"{cause.name}, {kind}.{field}", things=more)


def things_of(names: Sequence[str]) -> dict[str, list[dict[str, int]]]:
    """Fields of each thing, by kind: those that all of a kind have."""
    kinds = {}
    for kind, things in Entries.of(names).numbered.items():
        shared = set.intersection(*[set(fields) for fields in things])
        if shared:
            kinds[kind] = [{f: d for f, d in fields.items() if f in shared} for fields in things]
    return kinds


def _lone_things(names: Sequence[str]) -> dict[str, list[dict[str, int]]]:
    """Likewise things that no number tells from others of their kind, e.g. a goal: each is a kind of one."""
    kinds: dict[str, list[dict[str, int]]] = {}
    for e in Entries.of(names).each:
        if e.order is None and e.role in ("offset", "drift"):
            kinds.setdefault(e.whose, [{}])[0][e.what] = e.source
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


def _numbers(names: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Each by itself, and those that are a vector: they differ in the axis at the end alone."""
    yield from ((name,) for name in names)
    axes: dict[tuple[str, str], list[str]] = {}
    for name in names:
        for frame in (SPACE, LANE):
            if name[-1] in frame:
                axes.setdefault((name[:-1], frame), []).append(name)
    yield from (tuple(vector) for vector in axes.values() if len(vector) > 1)
