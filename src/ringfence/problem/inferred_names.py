"""Names that follow from logs, where nobody says what is an agent's own and what is of others.

What an agent sees of another is, number for number, that other's own entry less its own; and what two see of each other
is the same with the opposite sign. Nothing else in logs is so exact, so such entries may be named as if somebody had:
`other0.dx` of agent 0 is minus `other0.dx` of agent 1. Their velocities, one's own place, what stands still, what else
moves and where a body heads for follow. Who sees nobody has a place that changes as a velocity says. Names that were
given and may mean something (`truck0_dx`) decide what numbers leave open: which of several such entries are places.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import jax.numpy as jnp
import numpy as np

from ringfence.problem import partners
from ringfence.problem.entries import SPACE, Entries, Role, loosely
from ringfence.problem.partners import EXACT

ROWS = 2000  # that are compared
FEWEST = 50  # below which nothing is said
MOST = 20_000_000  # numbers that are compared; of wide logs fewer rows
LIKE = 0.05  # of a change: what a velocity predicts is off by less
ALIKE = 0.9  # correlation of a change with a velocity, below which it is none
LESS = 0.5  # of a change that is left of that of a velocity relative to one's own, once one's own is added
CALLED = 0.5  # of a change: what names call a velocity is off by less
SHARE = 0.9  # of the rows that have to agree: angles jump where they are full, and goals where they are reached
MEANING = ("own", "other", "agent", "obs", "state")  # words that name something else, or nothing


@dataclass
class _Field:
    """One thing that agents see of others, e.g. how far away each of them is along x."""

    entries: tuple[int, ...]  # of each of the others, in order
    own: int | None = None  # the entry of one's own that it is the difference of
    speed: _Field | None = field(default=None, repr=False)  # how it changes


def inferred_names(
    observations: np.ndarray,
    names: Sequence[str],
    first_rows: np.ndarray | None = None,
    keep: Collection[str] = (),
) -> tuple[str, ...]:
    """Names (O) of entries of observations (M, N, O) where those that were given, if any were, say of none whose it is.
    Those that do not follow stay as they are, and so do those to `keep`. `first_rows` (E,) are those that episodes
    begin with."""
    said = Entries.of(names)
    if said.own or said.others:
        return tuple(names)
    steps = Steps.of(observations, first_rows)
    if steps is None:
        return tuple(names)
    several = observations.shape[1] > 1
    fields = _with_speeds(steps, [_with_own(steps, f) for f in _fields(steps)]) or _listed(steps) if several else []
    moving = _along_axes(steps, fields or _by_oneself(steps, names), names)
    if moving is None:
        return tuple(names)
    found: dict[int, str] = {}
    for axis, place in moving.items():
        found |= _of_axis(steps, place, axis)
    found |= dict(_still(steps, moving, set(found)))
    found |= _heading(steps, found, Entries.of([f"own.{name}" for name in names]).direction)
    found |= dict(_differences(fields, found))
    found |= dict(_numbers(steps, found, names))
    found |= dict(_things(steps, found))
    found |= _as_given(found, names)
    return tuple(name if name in keep else found.get(entry, name) for entry, name in enumerate(names))


@dataclass(frozen=True, eq=False)
class Steps:
    """Some logged steps, evenly spread."""

    rows: np.ndarray  # (W,)
    before: np.ndarray  # (W, N, O), the numbers of an entry side by side, as they are read
    after: np.ndarray
    deviation: np.ndarray  # (O,) the least of any agent

    @classmethod
    def of(cls, observations: np.ndarray, first_rows: np.ndarray | None) -> Self | None:
        """None where there are too few."""
        many = min(ROWS, MOST // (observations[0].size or 1))
        rows = np.unique(np.linspace(0, max(len(observations) - 2, 0), many).astype(int))
        if first_rows is not None:
            rows = rows[~np.isin(rows + 1, first_rows)]
        if len(rows) < FEWEST:
            return None
        before, after = (
            np.moveaxis(np.array(np.moveaxis(observations[some], -1, 0), np.float64, order="C"), 0, -1)
            for some in (rows, rows + 1)
        )
        return cls(rows, before, after, before.std(0).min(0))

    def varies(self, entry: int) -> bool:
        return self.deviation[entry] > 0

    def equal(self, one: np.ndarray, two: np.ndarray, entry: int) -> bool:
        """Whether (W,) and (W,) are the same numbers, as far as `entry` is known."""
        return bool((np.abs(one - two) <= EXACT * self.deviation[entry]).mean() >= SHARE)

    def change(self, entries: Sequence[int]) -> np.ndarray:
        """(W, N, k) of entries in a step."""
        return self.after[..., list(entries)] - self.before[..., list(entries)]


def _fields(steps: Steps) -> Iterator[_Field]:
    """What agents 0 and 1 see of each other with opposite signs, where the others do so, too."""
    x = steps.before
    agents = x.shape[1]
    apart = np.abs(x[:, 0] + x[:, 1]) <= EXACT * steps.deviation
    for first in np.flatnonzero((steps.deviation > 0) & (apart.mean(0) >= SHARE)).tolist():
        if any(np.array_equal(x[..., first], x[..., earlier]) for earlier in range(first)):
            continue
        # agent 0 sees agent k + 1 in its k-th place, and is seen by it in the first
        entries = [first]
        for k in range(1, agents - 1):
            near = np.abs(x[:, 0] + x[:, k + 1, [first]]) <= EXACT * steps.deviation[first]
            mirrored = np.flatnonzero(near.mean(0) >= SHARE).tolist()
            entries += [e for e in mirrored if e not in entries][:1]
        seen = ((x[:, i, entries[j - 1]], -x[:, j, entries[i]], entries[i]) for i, j in _pairs(agents))
        if len(entries) == agents - 1 and all(steps.equal(*each) for each in seen):
            yield _Field(tuple(entries))


def _listed(steps: Steps) -> list[_Field]:
    """The same where others are listed by how near they are: who is in which place changes, and is found by what two
    see of each other."""
    seen = [part for part in partners.found_in(steps.before) if part.sign < 0]
    if not seen:
        return []
    scale = np.maximum(steps.before.std((0, 1)), 1e-9)
    before, after = (partners.seen_by(seen, jnp.asarray(x), scale, partners.SAME) for x in (steps.before, steps.after))
    who, known = (np.asarray(x) for x in before)  # (W, N, J)
    stays = known & np.asarray(after[1]) & (who == np.asarray(after[0]))
    fields = [_Field(part.entries, _own_of_listed(steps, part.entries, who, known)) for part in seen]
    return _with_speeds(steps, fields, stays)


def _own_of_listed(steps: Steps, entries: Sequence[int], who: np.ndarray, known: np.ndarray) -> int | None:
    """The entry of one's own that what is seen of others is the difference of, where there is one."""
    x = steps.before
    seen = x[..., list(entries[: who.shape[-1]])]
    rows = np.arange(len(x))[:, None, None]
    for own in range(x.shape[2]):
        gap = x[rows, who, own] - x[:, :, None, own]
        if own not in entries and steps.varies(own) and known.any() and steps.equal(seen[known], gap[known], own):
            return own
    return None


def _pairs(agents: int) -> Iterator[tuple[int, int]]:
    return ((i, j) for i in range(agents) for j in range(i + 1, agents))


def _with_own(steps: Steps, found: _Field) -> _Field:
    """The field with the entry of one's own that it is the difference of, where there is one."""
    x = steps.before
    for own in range(x.shape[2]):
        same = (
            steps.equal(x[:, i, found.entries[j - 1]], x[:, j, own] - x[:, i, own], own) for i, j in _pairs(x.shape[1])
        )
        if steps.varies(own) and all(same):
            return _Field(found.entries, own)
    return found


def _with_speeds(steps: Steps, fields: list[_Field], where: np.ndarray | None = None) -> list[_Field]:
    """The fields, each with the one that is its rate of change, in all steps or `where` (W, N, k) the first k of the
    others stay who they are."""
    places = None if where is None else where.shape[-1]
    for place in fields:
        others = [f for f in fields if f is not place and f.speed is not place]
        left = [unlike(steps, place.entries[:places], f.entries[:places], where) for f in others]
        if left and min(left) <= LIKE:
            place.speed = others[int(np.argmin(left))]
    return fields


def _by_oneself(steps: Steps, names: Sequence[str]) -> list[_Field]:
    """Of who sees nobody: one's own places, which change as their velocities say. None where there are too many."""
    free = [e for e in range(len(steps.deviation)) if steps.varies(e)]
    change = _centred(steps.change(free))
    rates = [_centred(rows[..., free]) for rows in (steps.after, steps.before)]
    alike = np.maximum(*(change.T @ rate for rate in rates)) > ALIKE
    pairs = {}
    for p, place in enumerate(free):
        off = {v: unlike(steps, [place], [v]) for v in (free[k] for k in np.flatnonzero(alike[p])) if v != place}
        best = min(off, key=off.__getitem__, default=place)
        if best != place and off[best] <= LIKE and loosely(names[place])[0] in (None, "place"):
            pairs[place] = best
    pairs = {place: v for place, v in pairs.items() if place not in pairs.values()}  # of velocities, accelerations
    if any(one != two and _is_relative(steps, one, two) for one in pairs.values() for two in pairs.values()):
        pairs = {place: v for place, v in pairs.items() if _opposite(steps, place, free)}
    return [_Field((), place, _Field((), v)) for place, v in pairs.items()] if len(pairs) <= len(SPACE) else []


def _centred(x: np.ndarray) -> np.ndarray:
    """(W N, k) of numbers (W, N, k), whose products are correlations."""
    flat = x.reshape(-1, x.shape[-1])
    flat = flat - flat.mean(0)
    return flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-30)


def _along_axes(steps: Steps, fields: Sequence[_Field], names: Sequence[str]) -> dict[str, _Field] | None:
    """The fields that are places, by axis: those that names call so; of those that they call nothing, what changes as
    another one says, or all. None where there are too many."""
    called = [(f, *_called(f, names)) for f in fields if not any(f is other.speed for other in fields)]
    along: dict[str, _Field] = {}
    for f, role, axis in called:
        if role in ("place", "offset"):
            along.setdefault(axis, f)
    for f, role, axis in called:
        place = along.get(axis)
        if role in ("velocity", "drift") and place is not None and place.speed is None:
            if unlike(steps, place.entries, f.entries) <= CALLED:
                place.speed = f
    left = [f for f, role, _ in called if role is None]
    left = [f for f in left if f.speed is not None] or ([] if along else left)
    if along and len(along) + len(left) > len(SPACE):
        left = []
    axes = sorted(along)
    if axes != list(SPACE[: len(axes)]):  # a plane is one of x and y, whatever names it has
        along = dict(zip(SPACE, (along[axis] for axis in axes)))
    along |= zip([axis for axis in SPACE if axis not in along], left)
    return along if len(left) <= len(SPACE) else None


def _called(found: _Field, names: Sequence[str]) -> tuple[Role | None, str]:
    """What names call it, where they agree."""
    said = {loosely(names[entry]) for entry in found.entries or [found.own] if entry is not None}
    if len(said) > 1:
        return None, ""
    role, axis = said.pop()
    mine, its = (None, "") if found.own is None else loosely(names[found.own])
    moves = ("velocity", "drift")
    if mine is not None and (its != axis or (mine in moves) != (role in moves)):
        return None, ""
    return role, axis


def _differences(fields: Sequence[_Field], found: Mapping[int, str]) -> Iterator[tuple[int, str]]:
    """Entries that are what others have less what one has oneself, where that has a name: `other0.dcos`."""
    for f in fields:
        name = "" if f.own is None else found.get(f.own, "")
        if name.startswith("own.") and not any(entry in found for entry in f.entries):
            yield from ((entry, f"other{k}.d{name[4:]}") for k, entry in enumerate(f.entries))


def _numbers(steps: Steps, found: Mapping[int, str], names: Sequence[str]) -> Iterator[tuple[int, str]]:
    """What names call alike of oneself and of each of the others who are known, e.g. `load` and `truck0_load`, where it
    is what these have themselves."""
    x = steps.before
    if "other0.dx" not in found.values():
        return
    called: dict[tuple[str, str], dict[int, int]] = {}
    for entry, name in enumerate(names):
        if entry not in found and (match := re.fullmatch(r"(\w*?[A-Za-z])_?(\d{1,9})[._](\w*[A-Za-z])", name)):
            called.setdefault((match[1], match[3]), {})[int(match[2])] = entry
    for (_, what), each in called.items():
        entries = [each[k] for k in sorted(each)]
        own = names.index(what) if what in names else None
        if own is None or own in found or len(entries) != x.shape[1] - 1:
            continue
        seen = ((i, j) for pair in _pairs(x.shape[1]) for i, j in (pair, pair[::-1]))
        if all(steps.equal(x[:, i, entries[j - (j > i)]], x[:, j, own], own) for i, j in seen):
            yield own, f"own.{what}"
            yield from ((entry, f"other{k}.{what}") for k, entry in enumerate(entries))


def _of_axis(steps: Steps, place: _Field, axis: str) -> dict[int, str]:
    """Names, by entry, of the places and speeds of others and of oneself along an axis."""
    own_speed = place.speed.own if place.speed else None
    if place.speed is None and place.own is not None:  # what one's own place changes by
        entries = [e for e in range(len(steps.deviation)) if steps.varies(e) and e not in (place.own, *place.entries)]
        left = [unlike(steps, [place.own], [e]) for e in entries]
        own_speed = entries[int(np.argmin(left))] if left and min(left) <= LIKE else None
    own = {f"own.{axis}": place.own, f"own.v{axis}": own_speed}
    found = {entry: name for name, entry in own.items() if entry is not None}
    found |= {entry: f"other{k}.d{axis}" for k, entry in enumerate(place.entries)}
    if place.speed:
        found |= {entry: f"other{k}.dv{axis}" for k, entry in enumerate(place.speed.entries)}
    return found


def unlike(steps: Steps, places: Sequence[int], speeds: Sequence[int], where: np.ndarray | None = None) -> float:
    """By what share of their changes places are off what speeds predict, of all or `where` (W, N, k)."""
    return _off(steps, steps.change(places)[... if where is None else where].ravel(), speeds, where)


def _off(steps: Steps, change: np.ndarray, speeds: Sequence[int], where: np.ndarray | None = None) -> float:
    """By what share of changes (M,) they are off what speeds predict, in nine of ten steps; the seconds of a step are
    those that predict best."""
    if not change.size:
        return 1.0
    least = np.quantile(np.abs(change), SHARE)
    found = [1.0]
    after, before = (rows[..., list(speeds)][... if where is None else where] for rows in (steps.after, steps.before))
    for speed in (after.ravel(), before.ravel(), 0.5 * (after + before).ravel()):
        moves = np.abs(speed) > np.median(np.abs(speed))
        if least > 0 and moves.any() and (dt := float(np.median(change[moves] / speed[moves]))) > 0:
            found.append(float(np.quantile(np.abs(change - dt * speed), SHARE) / least))
    return min(found)


def _still(steps: Steps, places: Mapping[str, _Field], named: set[int]) -> Iterator[tuple[int, str]]:
    """Entries that change as one's own place does, with the opposite sign: where things are that stand still."""
    found = []
    for place in places.values():
        if place.own is None:
            return
        free = [e for e in range(len(steps.deviation)) if e not in named and steps.varies(e)]
        found.append(_opposite(steps, place.own, free))
    for letter, entries in zip("abcdefghijklmnopqrstuvwxyz", zip(*found)):
        for axis, entry in zip(places, entries):
            yield entry, f"still_{letter}.d{axis}"


def _opposite(steps: Steps, place: int, entries: Sequence[int]) -> list[int]:
    """Those of the entries that change as a place does, with the opposite sign."""
    moved = steps.change([place])[..., 0].ravel()
    return [e for e in entries if steps.equal(steps.change([e])[..., 0].ravel(), -moved, place)]


def _heading(steps: Steps, found: Mapping[int, str], called: Sequence[int]) -> dict[int, str]:
    """Names of a direction in which a body moves that has one, as two entries or an angle: its velocity is along it, or
    the change of its place; in that case of its speed, too. What names have `called` so may also go backwards."""
    at = {name: entry for entry, name in found.items()}
    if {"own.vx", "own.vy"} <= set(at):
        velocity = steps.before[..., [at["own.vx"], at["own.vy"]]].reshape(-1, 2)
        return _direction(steps, steps.before, velocity, found) or _either_way(steps, steps.before, velocity, called)
    if not {"own.x", "own.y"} <= set(at):
        return {}
    moved = steps.change([at["own.x"], at["own.y"]]).reshape(-1, 2)
    for rows in (steps.after, steps.before):
        if direction := _direction(steps, rows, moved, found):
            length = np.linalg.norm(moved, axis=-1)
            return direction | _speed_ahead(steps, length, {*found, *direction})
    for rows in (steps.after, steps.before):
        if direction := _either_way(steps, rows, moved, called):
            ahead = (moved * _looks(rows, called)).sum(-1)
            return direction | _speed_ahead(steps, ahead, {*found, *direction})
    return {}


def _looks(rows: np.ndarray, entries: Sequence[int]) -> np.ndarray:
    """(W N, 2) the direction of these entries of `rows` (W, N, O): its cosine and sine, or an angle."""
    told = rows[..., list(entries)].reshape(-1, len(entries))
    return told if len(entries) == 2 else np.concatenate([np.cos(told), np.sin(told)], -1)


def _either_way(steps: Steps, rows: np.ndarray, velocity: np.ndarray, called: Sequence[int]) -> dict[int, str]:
    """Names of what is called a direction, where velocities (W N, 2) are along it, forwards or backwards."""
    speed = np.linalg.norm(velocity, axis=-1)
    moves = speed > np.median(speed)
    if not called or not moves.any() or not all(steps.varies(entry) for entry in called):
        return {}
    looks = _looks(rows, called)
    unit = np.abs(np.linalg.norm(looks, axis=-1) - 1.0) <= EXACT
    along = np.abs((velocity * looks).sum(-1))[moves] >= (1 - LIKE) * speed[moves]
    if unit.mean() < SHARE or along.mean() < SHARE:
        return {}
    return dict(zip(called, ("own.cos", "own.sin") if len(called) == 2 else ("own.heading",)))


def _direction(steps: Steps, rows: np.ndarray, velocity: np.ndarray, found: Mapping[int, str]) -> dict[int, str]:
    """Names of the entries of `rows` (W, N, O) along which velocities (W N, 2) are."""
    speed = np.linalg.norm(velocity, axis=-1)
    moves = speed > np.median(speed)
    if not moves.any():
        return {}

    def along(direction: np.ndarray) -> bool:
        ahead = (velocity * direction).sum(-1)
        return bool((ahead[moves] >= (1 - LIKE) * speed[moves]).mean() >= SHARE)

    free = [e for e in range(len(steps.deviation)) if e not in found and steps.varies(e)]
    for cos, sin in _of_unit_length(rows, free):
        direction = rows[..., [cos, sin]].reshape(-1, 2)
        unit = np.abs(np.linalg.norm(direction, axis=-1) - 1.0) <= EXACT
        if unit.mean() >= SHARE and along(direction):
            return {cos: "own.cos", sin: "own.sin"}
    for entry in free:
        angle = rows[..., entry].ravel()
        if along(np.stack([np.cos(angle), np.sin(angle)], -1)):
            return {entry: "own.heading"}
    return {}


def _of_unit_length(rows: np.ndarray, entries: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Two of the entries of `rows` (W, N, O), in any order, that may be a direction: so in most of a few numbers."""
    if not entries:
        return
    some = np.random.default_rng(0).choice(rows.shape[0] * rows.shape[1], FEWEST)
    squares = rows[..., list(entries)].reshape(-1, len(entries))[some].T ** 2
    for one, cos in enumerate(entries):
        unit = np.abs(np.sqrt(squares[one] + squares) - 1.0) <= EXACT
        yield from ((cos, entries[two]) for two in np.flatnonzero(unit.mean(1) >= SHARE / 2).tolist() if two != one)


def _speed_ahead(steps: Steps, moved: np.ndarray, named: set[int]) -> dict[int, str]:
    """The name of the entry that says how far bodies with a direction move (W N,) in a step, where there is one."""
    free = [e for e in range(len(steps.deviation)) if e not in named and steps.varies(e)]
    off = {e: _off(steps, moved, [e]) for e in free}
    best = min(off, key=off.__getitem__, default=None)
    return {} if best is None or off[best] > LIKE else {best: "own.v"}


def _things(steps: Steps, found: Mapping[int, str]) -> Iterator[tuple[int, str]]:
    """Entries that tell where things are that move by themselves: places with a velocity that is relative to one's
    own."""
    at = {name: entry for entry, name in found.items()}
    pairs = []
    for axis in SPACE:
        if (own := at.get(f"own.v{axis}")) is None:
            break
        free = [e for e in range(len(steps.deviation)) if e not in found and steps.varies(e)]
        pairs.append([])
        for speed in [e for e in free if _is_relative(steps, e, own)]:
            off = {e: unlike(steps, [e], [speed]) for e in free if e != speed}
            place = min(off, key=off.__getitem__, default=speed)
            if place != speed and off[place] <= LIKE:
                pairs[-1].append((place, speed))
                free.remove(place)
    for letter, entries in zip("abcdefghijklmnopqrstuvwxyz", zip(*pairs)):
        for axis, (place, speed) in zip(SPACE, entries):
            yield place, f"thing_{letter}.d{axis}"
            yield speed, f"thing_{letter}.dv{axis}"


def _as_given(found: Mapping[int, str], names: Sequence[str]) -> dict[int, str]:
    """Names of things that stand still or move by themselves, as given ones call them: `person0.dx` and `person0.dy`
    for `person0_dx` and `person0_dy`, so that several persons are of one kind. Without those whose names say nothing,
    or the same as another's."""
    entries: dict[str, list[int]] = {}
    for entry, name in found.items():
        if re.match(r"(still|thing)_", name):
            entries.setdefault(name.split(".")[0], []).append(entry)
    called = {thing: _common_words([names[entry] for entry in of]) for thing, of in entries.items()}
    taken = list(called.values())
    return {
        entry: found[entry].replace(thing, word)
        for thing, word in called.items()
        for entry in entries[thing]
        if word and taken.count(word) == 1
    }


def _common_words(names: Sequence[str]) -> str:
    """What names have in common but for their axes, with a number at the end if they have one: "" where that is no
    word, or means something else."""
    split = [[part.lower() for part in re.findall(r"[A-Z]?[a-z]+|[A-Z]+|\d+", name)] for name in names]
    if len({len(parts) for parts in split}) > 1:
        return ""
    alike = [parts[0] for parts in zip(*split) if len(set(parts)) == 1]
    words = [part for part in alike if not part.isdigit()]
    numbers = [part for part in alike if part.isdigit()]
    apart = [part for parts in zip(*split) if len(set(parts)) > 1 for part in parts]
    if not words or len(numbers) > 1 or any(part.isdigit() for part in apart) or words[0] in MEANING:
        return ""
    return "".join(words) + numbers[0] if numbers else "_".join(words)


def _is_relative(steps: Steps, entry: int, own: int) -> bool:
    """Whether an entry changes against one's own velocity, and by little else."""
    change = steps.change([entry])[..., 0].ravel()
    left = change + steps.change([own])[..., 0].ravel()
    return bool(np.quantile(np.abs(left), SHARE) < LESS * np.quantile(np.abs(change), SHARE))
