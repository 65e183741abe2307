"""Causes that danger may have, as names of entries tell: what is read together by its types."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence

from ringfence.problem.entries import LANE, SPACE, Entries, axes_of
from ringfence.world.causes import Cause
from ringfence.world.quantities import (
    All,
    Closing,
    Entry,
    Length,
    Over,
    Product,
    Quantity,
    Sum,
    Turned,
    leaves,
    squared,
)

WIDEST = 4  # numbers of one cause
ROW = 3  # entries at least that names number
NAMELESS = ("obs", "state", "entry")  # what numbers alone tell apart is no row
FARTHEST = 6  # of several things, the so many-th nearest at most
MOST_PAIRS = 45  # of things, that are read with oneself as three
Fields = list[dict[str, int]]  # entries of each thing, by what they are


def candidates(names: Sequence[str]) -> Iterator[Cause]:
    """Every entry and every two entries of oneself, and of each kind of thing; of two also their length."""
    yield from _rows(names)
    yield from _sets("", [_own(names)])
    for kind, each in things_of(names).items():
        yield from _sets(f"{kind}.", each)
    yield from (cause for cause in offsets(names) if len(cause.reads[0].parts) > 2)


def offsets(names: Sequence[str]) -> list[Cause]:
    """How far away things are, by kind, as names tell (dx, dy, dz)."""
    found = []
    for kind, each in things_of(names).items():
        if axes := axes_of(each[0]):
            found.append(Cause((Length(_vector(kind, each, axes)),)))
    return found


def pairs(names: Sequence[str]) -> Iterator[Cause]:
    """How far things are together with one number more, by kind, where names tell: how fast they come nearer (danger of
    how soon they meet), or an entry or a vector of oneself or of theirs (near and fast); where they are to who looks
    into a direction; how far along an axis, and how far across; and both places. And of oneself an entry, or two that
    are a vector, with how long another vector is: e.g. a place and a speed."""
    own, several, lone = _own(names), things_of(names), _lone_things(names)
    known = Entries.of(names)
    looks = _entries(names, known.direction or known.pair("v{}"))  # who tells no direction looks to where he moves
    of_lone = {d for each in lone.values() for d in each[0].values()}
    moving = {name: d for name, d in own.items() if d not in of_lone}
    for kind, each in (several | lone).items():
        if axes := axes_of(each[0]):
            offset = _vector(kind, each, axes)
            far = Length(offset)
            second = [*_closing(kind, each, axes, own), *_numbers("", [own if kind in several else moving])]
            second += _numbers(f"{kind}.", [{f: d for f, d in fields.items() if f[1:] not in axes} for fields in each])
            if len(offset) == 2 and looks:
                second.append(Turned(offset, looks, "angle"))
                yield Cause((Turned(offset, looks, "ahead"), Turned(offset, looks, "aside")))
            yield from (Cause((far, one)) for one in second)
            for k in _apart(offset):
                yield Cause((Length(tuple(part for part in offset if part is not offset[k])), Length((offset[k],))))
            if kind in several:
                yield from _both(offset, axes, own)
    for one, vector in itertools.product(list(_groups(list(own))), list(_groups(list(own)))):
        if len(vector) > 1 and len(one) < 3 and not set(one) & set(vector):
            entries = tuple(Entry((own[name],), name) for name in one)
            yield Cause((*entries, Length(tuple(Entry((own[name],), name) for name in vector))))


def products(names: Sequence[str]) -> Iterator[Cause]:
    """Of oneself two entries times each other, and how far that is from 0: powers, or how hard one is thrown aside."""
    for product in _products(_own(names)):
        yield Cause((product,))
        yield Cause((Length((product,)),))


def _products(own: dict[str, int]) -> list[Quantity]:
    entries = [Entry((d,), name) for name, d in own.items()]
    both = list(itertools.combinations(entries, 2))
    return [Product(each) for each in both] if len(both) <= MOST_PAIRS else []


def of_several(names: Sequence[str]) -> Iterator[Cause]:
    """How far away the nearest of several things is, the second nearest, and so on: who is crowded, or alone; how far
    the middle of all is; and of oneself and two of them, how far apart all three are, what area lies between, and at
    what angle one sees both."""
    for cause in offsets(names):
        count = cause.things
        offset = cause.reads[0].parts
        if count < 2:
            continue
        for k in range(1, min(count, FARTHEST) + 1):
            yield Cause((Over(cause.reads[0], "things", k, count),))
        yield Cause((Length(tuple(Over(part, "things", 0, count) for part in offset)),))
        if count * (count - 1) // 2 <= MOST_PAIRS:
            yield from _of_three(cause.vector or ())


def _of_three(offset: tuple[Entry, ...]) -> Iterator[Cause]:
    pairs = list(itertools.combinations(range(len(offset[0].at)), 2))
    one, two = ([Entry(tuple(part.at[j[k]] for j in pairs), part.name) for part in offset] for k in range(2))
    two = [Entry(part.at, f"another {part.name}") for part in two]
    between = Length(tuple(Sum((a, b), (1.0, -1.0)) for a, b in zip(one, two)))
    yield Cause((All((Length(tuple(one)), Length(tuple(two)), between)),))
    if len(offset) == 2:
        yield Cause((Length((Sum((Product((one[0], two[1])), Product((one[1], two[0]))), (0.5, -0.5)),)),))
        yield Cause((Turned((one[0], one[1]), tuple(two), "angle"),))


def beside(cause: Cause, names: Sequence[str], multiplied: bool = False) -> Iterator[Quantity]:
    """What may shift a threshold of the cause: numbers of oneself, and of the same things, e.g. how large they are, and
    how far from 0 these are; and what is `multiplied`: their squares, as of a way to stop, and products."""
    own, several = _own(names), things_of(names)
    found = _numbers("", [own])
    for kind, each in several.items():
        if kind == cause.kind and len(each) == cause.things:
            axes = axes_of(each[0])
            found += _numbers(f"{kind}.", [{f: d for f, d in fields.items() if f[1:] not in axes} for fields in each])
            found += _closing(kind, each, axes, own) if axes else ()
    yield from found
    yield from _sizes(found)
    if multiplied:
        read = {one for each in cause.reads for one in leaves(each)}
        yield from (squared(one) for one in found if one not in read)
        yield from _products(own)


def of_team(names: Sequence[str]) -> Iterator[Cause]:
    """Sums over the team of what is each one's own: loads, powers, which are a force times a speed."""
    own = _own(names)
    numbers = _numbers("", [own])
    entries = [one for one in numbers if isinstance(one, Entry)]
    numbers += _sizes(entries)
    numbers += [Product(both) for both in itertools.combinations_with_replacement(entries, 2)]
    yield from (Cause((Over(one, "team"),)) for one in numbers)


def wider(cause: Cause, names: Sequence[str]) -> Iterator[Cause]:
    """The cause with one more entry of oneself, or of the same thing; of whom it is."""
    reads = cause.reads if cause.vector is None else cause.vector
    if len(reads) >= WIDEST or any(not isinstance(one, Entry) for one in reads):
        return
    known = {leaf.at for read in reads for leaf in leaves(read)}
    for name, d in _own(names).items():
        if (d,) not in known:
            yield Cause((*reads, Entry((d,), name)), cause.who)
    for kind, each in things_of(names).items():
        for field in each[0]:
            entry = Entry(tuple(fields[field] for fields in each), f"{kind}.{field}")
            if len(each) == cause.things and entry.at not in known and _of_these(each, reads):
                yield Cause((*reads, entry), cause.who)


def _of_these(each: Fields, reads: Sequence[Quantity]) -> bool:
    """Whether some of the entries are those of things."""
    inside = {tuple(fields[field] for fields in each) for field in each[0]}
    return any(isinstance(one, Entry) and one.at in inside for one in reads)


def _rows(names: Sequence[str]) -> Iterator[Cause]:
    """Entries that names number, of which any may be dangerous: rays of a lidar (`lidar_0`, `ray3`), cells of a
    battery. As numbers, and as how long they are: what is nearer than anything was, is as dangerous."""
    found: dict[str, list[tuple[int, int]]] = {}
    for d, name in enumerate(names):
        if (match := re.fullmatch(r"([\w.]*?[a-z])[._[ ]?(\d+)]?", name)) and match[1] not in NAMELESS:
            found.setdefault(match[1], []).append((int(match[2]), d))
    for name, row in found.items():
        if len(row) >= ROW:
            entry = Entry(tuple(d for _, d in sorted(row)), name)
            yield Cause((entry,))
            yield Cause((Length((entry,)),))


def _closing(kind: str, each: Fields, axes: str, own: dict[str, int]) -> Iterator[Quantity]:
    """How fast things come nearer: by their velocity, or of what logs none by one's own."""
    offset = _vector(kind, each, axes)
    theirs, mine = [f"dv{c}" for c in axes], [f"own.v{c}" for c in axes]
    if set(theirs) <= set(each[0]):
        yield Closing(offset, tuple(_entry(kind, each, name) for name in theirs))
    elif set(mine) <= set(own):
        yield Closing(offset, tuple(Sum((Entry((own[name],), name),), (-1.0,)) for name in mine))


def _both(offset: tuple[Entry, ...], axes: str, own: dict[str, int]) -> Iterator[Cause]:
    """Where one is, and where things are: what has room for one is dangerous for two."""
    names = [f"own.{c}" for c in axes]
    if set(names) <= set(own) and 2 * len(axes) <= WIDEST:
        place = tuple(Entry((own[name],), name) for name in names)
        yield Cause((*place, *(Sum((mine, far), (1.0, 1.0)) for mine, far in zip(place, offset))))


def _apart(offset: Sequence[Entry]) -> Sequence[int]:
    """Which axes may count by themselves; of two, one by itself leaves the other so, too."""
    return range(len(offset)) if len(offset) > 2 else range(1, len(offset))


def _vector(kind: str, each: Fields, axes: str) -> tuple[Entry, ...]:
    return tuple(_entry(kind, each, f"d{c}") for c in axes)


def _entry(kind: str, each: Fields, field: str) -> Entry:
    return Entry(tuple(fields[field] for fields in each), f"{kind}.{field}")


def _entries(names: Sequence[str], at: Sequence[int]) -> tuple[Entry, ...]:
    return tuple(Entry((d,), names[d]) for d in at)


def _own(names: Sequence[str]) -> dict[str, int]:
    """Entries that are no thing's, by name."""
    inside = {d for kind in things_of(names).values() for fields in kind for d in fields.values()}
    return {name: d for d, name in enumerate(names) if d not in inside}


def things_of(names: Sequence[str]) -> dict[str, Fields]:
    """Fields of each thing, by kind: those that all of a kind have."""
    kinds = {}
    for kind, things in Entries.of(names).numbered.items():
        shared = set.intersection(*[set(fields) for fields in things])
        if shared:
            kinds[kind] = [{f: d for f, d in fields.items() if f in shared} for fields in things]
    return kinds


def _lone_things(names: Sequence[str]) -> dict[str, Fields]:
    """Likewise things that no number tells from others of their kind, e.g. a goal: each is a kind of one."""
    kinds: dict[str, Fields] = {}
    for e in Entries.of(names).each:
        if e.order is None and e.role in ("offset", "drift"):
            kinds.setdefault(e.whose, [{}])[0][e.what] = e.source
    return kinds


def _sets(of: str, each: Fields) -> Iterator[Cause]:
    entries = [Entry(tuple(fields[field] for fields in each), of + field) for field in each[0]]
    for one in entries:
        yield Cause((one,))
    for both in itertools.combinations(entries, 2):
        yield Cause(both)
        if _stem(both[0].name) == _stem(both[1].name):
            yield Cause((Length(both),))


def _stem(name: str) -> str:
    """What two numbers of one unit are called alike, but for their axis or their number: x and y, obs4 and obs5."""
    return name[:-1] if name[-1] in SPACE + LANE else name.rstrip("0123456789_[].")


def _numbers(of: str, each: Fields) -> list[Quantity]:
    """Each field, and how long those are that make a vector."""
    found: list[Quantity] = []
    for group in _groups(list(each[0])):
        entries = tuple(Entry(tuple(fields[field] for fields in each), of + field) for field in group)
        found += [Length(entries)] if len(entries) > 1 else entries
    return found


def _sizes(numbers: Sequence[Quantity]) -> list[Length]:
    """How far from 0 entries are."""
    return [Length((one,)) for one in numbers if isinstance(one, Entry)]


def _groups(names: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Each by itself, and those that are a vector: they differ in the axis at the end alone."""
    yield from ((name,) for name in names)
    axes: dict[tuple[str, str], list[str]] = {}
    for name in names:
        for frame in (SPACE, LANE):
            if name[-1] in frame:
                axes.setdefault((name[:-1], frame), []).append(name)
    yield from (tuple(vector) for vector in axes.values() if len(vector) > 1)
