"""Where others and things are, of agents who see it as places on a map: how far that is from themselves.

What an agent sees of another is then, number for number, that other's own entry, and a thing that an agent passes does
not come nearer in its entries. Danger is of how far away they are, and so are most predictions. The difference holds as
much as the place does, since one's own place is seen, too.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ringfence.problem.entries import SPACE, Entries, loosely
from ringfence.problem.inferred_names import EXACT, LIKE, SHARE, Steps, inferred_names, unlike

FIRST = 8  # of the rows that are compared, by which most entries are told apart
DISTINCT = 0.2  # of the rows: what takes fewer values is a flag or a count, and alike by chance
LEAP = 0.5  # of the range: what changes by more in a step begins again, as angles do
ALIKE = 0.5  # correlation of what changes along with one's own place
SOMEBODY = 0.5  # of the rows, in which what is listed is of one of the team
SPREAD = 0.1  # of the range of one's own place: by less nothing varies that is on the same map
MINE = re.compile(r"(?:(?:own|ego|self|me|agent|robot|pos|position|p)[._]?)?([xyz])")
SPEEDS = ("v", "dv", "vel", "velocity", "speed")
AXIS = re.compile(rf"(.*?)((?<![a-z])(?:p|pos|position|{'|'.join(SPEEDS)}))?[._]?([xyz])")


@dataclass(frozen=True, eq=False)
class Columns:
    """What features are made of: column c of agent i is source[plus[i, c]] − source[minus[i, c]] (minus = −1: nothing
    is taken away), where its source is its observation with the global state behind it."""

    plus: np.ndarray  # (N, C)
    minus: np.ndarray  # (N, C)
    names: tuple[str, ...]  # C
    of_state: frozenset[int] = frozenset()  # entries of the state that they hold

    @classmethod
    def as_seen(cls, agents: int, names: Sequence[str]) -> Columns:
        """Every entry of an observation."""
        plus = np.tile(np.arange(len(names)), (agents, 1))
        return cls(plus, np.full_like(plus, -1), tuple(names))

    @property
    def differ(self) -> bool:
        """Whether any is not as it is seen."""
        return bool((self.minus >= 0).any())

    def of(self, observations: np.ndarray, state: np.ndarray | None = None) -> np.ndarray:
        """(M, N, C) of observations (M, N, O) and state (M, S)."""
        width = observations.shape[-1]
        if not self.differ and self.plus.shape[1] == width:
            return observations
        return np.stack([self._column(c, observations, state) for c in range(self.plus.shape[1])], -1)

    def _column(self, c: int, observations: np.ndarray, state: np.ndarray | None) -> np.ndarray:
        def taken(entries: np.ndarray) -> np.ndarray:
            width = observations.shape[-1]
            each = []
            for agent, entry in enumerate(entries):
                if entry < width:
                    each.append(observations[:, agent, entry])
                else:
                    assert state is not None, "columns of a state are given one"
                    each.append(state[:, entry - width])
            return np.stack(each, 1)

        found = taken(self.plus[:, c])
        return found if self.minus[0, c] < 0 else found - taken(self.minus[:, c])

    def less(self, pairs: dict[int, int]) -> Columns:
        """With these columns less others (column: the other); those whose names say whose they are, are called so, too:
        `other0.dx` for `other0.x`."""
        minus, names = self.minus.copy(), list(self.names)
        for column, other in pairs.items():
            minus[:, column] = self.plus[:, other]
            names[column] = re.sub(r"^(\w+)\.(\w+)$", r"\1.d\2", names[column])
        return replace(self, minus=minus, names=tuple(names))

    def with_others(self, fields: dict[int, list[int]]) -> Columns:
        """With what the state tells of others at these entries, by agent, less these columns of one's own."""
        width, n = self.plus.shape[1], len(self.plus)
        found = self
        for own, of_agents in fields.items():
            theirs = np.array([[of_agents[j] for j in range(n) if j != i] for i in range(n)])
            given = self.names[own]
            called = "other{}.d" + given[4:] if given.startswith("own.") else given + " of another {}"
            names = [called.format(k) for k in range(n - 1)]
            mine = np.repeat(self.plus[:, own, None], n - 1, 1)
            found = Columns(
                np.concatenate([found.plus, width + theirs], 1),
                np.concatenate([found.minus, mine], 1),
                (*found.names, *names),
                found.of_state | set(of_agents),
            )
        return found

    def with_entries(self, entries: Sequence[int], names: Sequence[str]) -> Columns:
        """With these entries of the source as they are."""
        more = np.tile(np.array(entries, int), (len(self.plus), 1))
        plus = np.concatenate([self.plus, more], 1)
        minus = np.concatenate([self.minus, np.full_like(more, -1)], 1)
        return replace(self, plus=plus, minus=minus, names=(*self.names, *names))


def relative(
    observations: np.ndarray,
    names: Sequence[str],
    joined: tuple[np.ndarray, Sequence[str] | None] | None = None,
    first_rows: np.ndarray | None = None,
    keep: Collection[str] = (),
) -> Columns:
    """The columns of observations (M, N, O), with the names that follow from logs (problem/inferred_names.py): others
    and things by how far they are from who sees them. Where an agent sees no other, others are those of the global
    state (M, S) that is `joined`, with its names, or without any if it is made of everybody's observations: then they
    are where their names say. Entries to `keep` stay."""
    columns = Columns.as_seen(observations.shape[1], names)
    steps = _Steps.of(observations, first_rows)
    state = None if joined is None else joined[0]

    def called(columns: Columns) -> tuple[str, ...]:
        return inferred_names(columns.of(observations, state), columns.names, first_rows, keep)

    if steps is None:
        return replace(columns, names=called(columns))
    free = [d for d in range(len(names)) if names[d] not in keep and steps.varies(d)]
    of_others = _of_others(steps, free, names)
    columns = columns.less(of_others)
    found = called(columns)
    listed = _listed(steps, found) if joined is not None else []
    if listed:
        columns = replace(columns, names=tuple(re.sub(r"^other(\d+\.)", r"listed\1", name) for name in columns.names))
    if joined is not None and len(columns.plus) > 1 and (listed or not Entries.of(found).others):
        seen = free if joined[1] is not None else list(_own_axes(steps, free, found if listed else names).values())
        columns = columns.with_others(_of_state(steps, seen, names, joined, keep))
        found = called(columns)
    own = _own_axes(steps, free, found)
    left = [d for d in free if d not in of_others and found[d] == names[d]]
    of_things = _of_things(steps, left, names, own)
    if of_things:
        columns = columns.less(of_things)
        found = _with_things(called(columns), names, of_things, own)
    columns = replace(columns, names=found)
    if not listed or not Entries.of(found).others:
        return columns
    kept = [c for c in range(len(found)) if c not in listed]
    return replace(
        columns, plus=columns.plus[:, kept], minus=columns.minus[:, kept], names=tuple(found[c] for c in kept)
    )


@dataclass(frozen=True, eq=False)
class _Steps(Steps):
    """Some logged steps, evenly spread, and what their entries look like."""

    def smooth(self, entry: int) -> bool:
        """Whether it takes many values and never leaps."""
        leap = np.abs(self.change([entry])).max()
        return self.is_continuous(entry) and bool(leap <= LEAP * np.ptp(self.before[..., entry]))

    def is_continuous(self, entry: int) -> bool:
        """Whether it takes many values."""
        x = self.before[:, 0, entry]
        return len(np.unique(x)) >= DISTINCT * len(x)

    def of_another(self, own: int, entries: Sequence[int]) -> list[int]:
        """Those of the entries where what each agent sees is what another has at `own`."""
        entries = [d for d in entries if d != own]
        few = self.before[:: len(self.before) // FIRST + 1]
        likely = self._like(few, own, entries, 1).mean(0)[0] > 0.5
        left = [d for d, may_be in zip(entries, likely) if may_be and not self.is_shared(d)]
        same = (self._like(self.before, own, left, self.before.shape[1]).mean(0) >= SHARE).all(0)
        return [d for d, is_so in zip(left, same) if is_so]

    def _like(self, rows: np.ndarray, own: int, entries: Sequence[int], agents: int) -> np.ndarray:
        """(W, agents, k) bool: whether rows (W, N, O) have there, for the first so many, what another has at `own`."""
        found = np.zeros((len(rows), agents, len(entries)), bool)
        for i, j in itertools.product(range(agents), range(rows.shape[1])):
            if i != j:
                gap = np.abs(rows[:, i, list(entries)] - rows[:, j, own, None])
                found[:, i] |= gap <= EXACT * self.deviation[own]
        return found

    def is_shared(self, entry: int) -> bool:
        """Whether all see the same there, e.g. what time it is."""
        seen = self.before[..., entry]
        return bool((np.ptp(seen, axis=1) <= EXACT * self.deviation[entry]).mean() > 1 - SHARE)


def _listed(steps: _Steps, found: Sequence[str]) -> list[int]:
    """Entries that tell how far some of the team are whose places in a list change, as the nearest do, and that follow
    from where everybody is."""
    known = Entries.of(found)
    own = {e.what: e.source for e in known.each if e.whose == "own"}
    of_others = [e for e in known.each if e.whose == "other"]
    if not all(e.what[1:] in own for e in of_others if e.role == "offset"):
        return []  # of velocities alone nothing is known of who comes
    told = [e for e in of_others if e.role in ("offset", "drift") and e.what[1:] in own]
    x = steps.before
    agents = x.shape[1]
    moves = False
    for e in told:
        mine = own[e.what[1:]]
        gap = x[:, None, :, mine] - x[:, :, None, mine]  # (W, N, N) of each to all
        near = np.abs(x[:, :, None, e.source] - gap) <= EXACT * steps.deviation[mine]
        near &= ~np.eye(agents, dtype=bool)
        if near.any(2).mean() < SOMEBODY:
            return []
        moves |= bool((near.mean(0).max(1) < SHARE).any())  # of some agent it is nobody's in particular
    return [e.source for e in told] if moves else []


def _of_others(steps: _Steps, free: Sequence[int], names: Sequence[str]) -> dict[int, int]:
    """Entries that are others' own: whose own one each is. The first of two that are each other's is one's own."""
    found: dict[int, int] = {}
    continuous = [d for d in free if steps.is_continuous(d)]
    for own in [d for d in continuous if steps.smooth(d)]:
        if own in found:
            continue
        left = [d for d in continuous if d not in found and d not in found.values()]
        found |= dict.fromkeys(steps.of_another(own, left), own)
    return found if _are_places(set(found.values()), names) else {}


def _of_state(
    steps: _Steps,
    free: Sequence[int],
    names: Sequence[str],
    joined: tuple[np.ndarray, Sequence[str] | None],
    keep: Collection[str],
) -> dict[int, list[int]]:
    """Own entries that the state tells of every agent: the state's entries of each."""
    state, called = joined
    stays = [s for s, name in enumerate(called or ()) if name in keep]
    known = np.asarray(state[steps.rows], np.float64)
    found: dict[int, list[int]] = {}
    for own in [d for d in free if steps.smooth(d)]:
        taken = {s for of in found.values() for s in of}
        where: list[int] = []
        for agent in range(steps.before.shape[1]):
            gap = np.abs(known - steps.before[:, agent, own, None])  # (W, S)
            same = (gap <= EXACT * steps.deviation[own]).mean(0) >= SHARE
            entries = np.flatnonzero(same).tolist()
            where += [s for s in entries if s not in (*taken, *where, *stays)][:1]
        if len(where) == steps.before.shape[1]:
            found[own] = where
    return found if _are_places(found, names) else {}


def _are_places(own: Collection[int], names: Sequence[str]) -> bool:
    """Whether own entries may be a place: one number of each other, that is not called so, is none."""
    return len(own) > 1 or any(AXIS.fullmatch(names[d].lower()) for d in own)


def _of_things(steps: _Steps, free: Sequence[int], names: Sequence[str], own: dict[str, int]) -> dict[int, int]:
    """Entries that names tell to be places of things, and that do not change as one moves, with the own entry of that
    axis; and their velocities with one's own."""
    found: dict[int, int] = {}
    for of in _things(free, names, own).values():
        places = {axis: d for (fast, axis), d in of.items() if not fast}
        if not places or not all(axis in own and _is_fixed(steps, d, own[axis]) for axis, d in places.items()):
            continue
        found |= {d: own[axis] for axis, d in places.items()}
        for axis, d in places.items():
            speed, mine = of.get((True, axis)), own.get(f"v{axis}")
            if speed is not None and mine is not None and unlike(steps, [d], [speed]) <= LIKE:
                found[speed] = mine
    return found


def _things(free: Sequence[int], names: Sequence[str], own: dict[str, int]) -> dict[str, dict[tuple[bool, str], int]]:
    """Entries of each thing that names tell of, by whether they are velocities and by axis, but for what they call
    relative to oneself."""
    found: dict[str, dict[tuple[bool, str], int]] = {}
    for d in free:
        match = None if loosely(names[d])[0] in ("offset", "drift") else AXIS.fullmatch(names[d].lower())
        if match and d not in own.values() and (thing := match[1].strip("._")):
            found.setdefault(thing, {})[match[2] in SPEEDS, match[3]] = d
    return found


def _with_things(
    found: Sequence[str], names: Sequence[str], taken: Collection[int], own: dict[str, int]
) -> tuple[str, ...]:
    """Names of columns where no others told any: of the things whose places were taken, and of one's own."""
    called = list(found)
    for axis, d in own.items():
        if f"own.{axis}" not in called:
            called[d] = f"own.{axis}"
    for thing, of in _things(sorted(taken), names, own).items():
        word = re.sub(r"[^a-z0-9]", "", thing)
        for (fast, axis), d in of.items():
            if called[d] == names[d] and re.fullmatch(r"[a-z]+\d*", word):
                called[d] = f"{word}.d{'v' * fast}{axis}"
    return tuple(called)


def _own_axes(steps: _Steps, free: Sequence[int], found: Sequence[str]) -> dict[str, int]:
    """Entries of one's own place and velocity by axis (x, vx): as they are called, or as their names have it, and what
    the place changes by."""
    moving = [e for e in Entries.of(found).each if e.whose == "own" and e.role in ("place", "velocity")]
    own = {e.what: e.source for e in moving if e.axis in SPACE}
    if any(axis in own for axis in SPACE):
        return own
    for d in free:
        if match := MINE.fullmatch(found[d].lower()):
            own.setdefault(match[1], d)
    for axis, d in dict(own).items():
        fast = next((e for e in free if e != d and unlike(steps, [d], [e]) <= LIKE), None)
        if fast is not None:
            own[f"v{axis}"] = fast
    return own


def _is_fixed(steps: _Steps, entry: int, own: int) -> bool:
    """Whether an entry may be a place on the map of one's own that does not change as one moves: of what is seen
    relative to oneself all of that does, and of what is so in other units a share, but nothing else then."""
    if not steps.varies(own):
        return False
    moved, change = steps.change([own]).ravel(), steps.change([entry]).ravel()
    both, size = (change * moved).sum(), (moved**2).sum()
    alike = both**2 > ALIKE**2 * size * (change**2).sum()
    least, most = (np.quantile(steps.before[..., [entry, own]], q, axis=(0, 1)) for q in (0.1, 0.9))
    on_one_map = least.max() < most.min() and (most - least).min() > SPREAD * (most - least).max()
    return bool(not alike and both > -0.5 * size and on_one_map)
