"""Which few entries tell danger: the causes of a cost column, found by what is never safe.

A cost says that a step was unsafe, and neither who was in danger nor why. But a step without cost says much: wherever
any agent was in it, and however near any two were, was safe. So of every small set of entries (a place, a speed, the
distance to another) it is counted how often a step is unsafe when somebody is in a cell of it. A cause is a set with
cells where steps are nearly always unsafe, and it is the simplest that tells held-out steps best. What it tells is
then explained, and the next cause is looked for in what is left, so that a rare one is found, too.

This is a noisy-or over causes and agents (Pearl 1988), grown greedily: P(safe) = Π over causes, agents and things of
(1 − p(cell)). Entries that come along with danger (goals, velocities, others' places) tell nothing that is left.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from msgspec.structs import replace

from ringfence.problem.features import numbered

VERSION = 3  # of the search: what was found by another is looked for again
CELLS = {1: 200, 2: 48, 3: 20, 4: 11}  # along each axis, by the number of entries, at most
UNSAFE_STEPS = 30_000  # that causes are looked for in, at most
SAFE_STEPS = 120_000  # likewise
MOST = 8  # causes
WIDEST = 4  # entries of one cause
SUFFICIENT = 0.3  # share of unsafe steps, beyond what others explain, at which a cell is dangerous
PRIOR = 2.0  # safe visits that every cell is taken to have had
SIMPLER = 0.02  # share of a gain that a simpler cause may lack
LEAST_GAIN = 0.002  # of the likelihood that there is to win
SURE = 3.0  # standard errors, over episodes, by which a gain has to exceed nothing
TESTED = 0.3  # share of the episodes that gains are measured on
BEYOND = 0.5  # of the range of what was seen: how far outside of it cells are taken to be like the nearest ones
APART = 1.5  # cells from the nearest visited one, from which on a place counts as never visited
NEARBY = 4.0  # cells, deviation of the places that are asked about close to visited ones
VISITED = 3  # visits that make a cell known


class Cause(msgspec.Struct, frozen=True):
    """A small set of entries that tells danger by itself: the same for each of J things, e.g. others."""

    name: str  # in words, e.g. "own.x, own.y" or "distance of other"
    things: tuple[tuple[int, ...], ...]  # (J, k) entries of the features
    length: bool = False  # of the entries as a vector, only how long it is

    @property
    def width(self) -> int:
        """How many numbers it reads of a thing."""
        return 1 if self.length else len(self.things[0])

    def of(self, x: np.ndarray) -> np.ndarray:
        """(..., J, width) what it reads of features (..., D)."""
        read = x[..., np.array(self.things)]
        if not self.length:
            return read
        return np.sqrt((read**2).sum(-1, keepdims=True))


class Edge(msgspec.Struct, frozen=True):
    """Where a cause is dangerous, as the logs tell it."""

    low: tuple[float, ...]  # of what was seen
    high: tuple[float, ...]
    at: float | None = None  # of a cause of one number: where danger begins
    below: bool = True  # whether it is dangerous below that, e.g. near another, or above


class Found(msgspec.Struct, frozen=True):
    """Causes of a data set, and how much of its danger they tell on steps that did not find them."""

    causes: tuple[Cause, ...] = ()
    explained: float = 0.0  # share of unsafe steps that a cause explains
    false_alarms: float = 0.0  # share of safe steps that a cause calls unsafe
    shares: tuple[float, ...] = ()  # by cause: share of unsafe steps that it explains
    edges: tuple[Edge, ...] = ()  # by cause


@dataclass(frozen=True, eq=False)
class Cells:
    """Where a cause is dangerous, cell by cell."""

    cause: Cause
    low: np.ndarray  # (width,) where cells begin
    high: np.ndarray  # (width,) where they end
    bins: int  # along each axis
    visits: np.ndarray  # (bins ** width,) by safe and unsafe steps
    danger: np.ndarray  # (bins ** width,) probability that being there makes a step unsafe

    def known(self) -> tuple[np.ndarray, np.ndarray]:
        """(centres (K, width), unsafe (K,) bool) of the cells that were visited."""
        cell = np.flatnonzero(self.visits >= VISITED)
        places = np.stack(np.unravel_index(cell, (self.bins,) * len(self.low)), -1)
        centres = self.low + (places + 0.5) / self.bins * (self.high - self.low)
        return centres, self.danger[cell] > 0.5

    @property
    def edge(self) -> Edge:
        low = tuple(round(float(v), 4) for v in self.low)
        high = tuple(round(float(v), 4) for v in self.high)
        centres, unsafe = self.known()
        if len(low) > 1 or not unsafe.any() or unsafe.all():
            return Edge(low, high)
        bad = centres[unsafe, 0]
        below = bool(np.median(bad) < np.median(centres[~unsafe, 0]))
        half = 0.5 * (self.high[0] - self.low[0]) / self.bins
        at = bad.max() + half if below else bad.min() - half
        return Edge(low, high, round(float(at), 4), below)

    def beyond(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """(values (count, width), unsafe (count,) bool) of places that were never visited.

        Along a distance each is like the nearest that was: what is nearer than anybody came is as unsafe as that, and
        what is farther away as safe. Anywhere else what nobody visited is unsafe: nothing says that it is not a wall.
        """
        from scipy.spatial import KDTree  # slow to import, and read by fits alone

        centres, unsafe = self.known()
        scale = (self.high - self.low) / self.bins
        values = self._around(centres, scale, 4 * count, rng)
        far, nearest = (np.asarray(a) for a in KDTree(centres / scale).query(values / scale))
        new = np.flatnonzero(far > APART)[:count]
        if not len(new):
            new = np.arange(count)
        new = np.resize(new, count)
        if self.cause.length:
            return values[new], unsafe[nearest[new]]
        return values[new], unsafe[nearest[new]] | (far[new] > APART)

    def _around(self, centres: np.ndarray, scale: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
        """(count, width) values in and around what was visited: half of them anywhere, half close to it."""
        reach = BEYOND * (self.high - self.low)
        anywhere = rng.uniform(self.low - reach, self.high + reach, (count // 2, len(scale)))
        close = centres[rng.integers(len(centres), size=count - count // 2)]
        close = close + scale * rng.normal(0.0, NEARBY, close.shape)
        values = np.concatenate([anywhere, close])[rng.permutation(count)]
        return np.maximum(values, 0.0) if self.cause.length else values


# --- what may be a cause ---


def candidates(names: Sequence[str]) -> Iterator[Cause]:
    """Every entry and every two entries of oneself, and of each kind of thing; of two also their length."""
    things = _things(names)
    inside = {d for kind in things.values() for fields in kind for d in fields.values()}
    own = [d for d in range(len(names)) if d not in inside]
    yield from _sets("", [{names[d]: d for d in own}])
    for kind, each in things.items():
        yield from _sets(kind, each)


def radius(x: np.ndarray, unsafe: np.ndarray, episode: np.ndarray, cause: Cause) -> Edge:
    """Where one cause is dangerous, as steps tell it that look for no other."""
    steps = _some(x, unsafe, episode, np.random.default_rng(0))
    return _counted(steps, cause, np.zeros(steps.unsafe.shape), everything=True).edge


def offsets(names: Sequence[str]) -> list[Cause]:
    """How far away things are, by kind, as names tell (dx, dy, dz)."""
    found = []
    for kind, each in _things(names).items():
        axes = [f"d{c}" for c in "xyz" if f"d{c}" in each[0]]
        if axes:
            things = tuple(tuple(thing[a] for a in axes) for thing in each)
            found.append(Cause(f"length of {kind}.{', '.join(axes)}", things, length=True))
    return found


def _things(names: Sequence[str]) -> dict[str, list[dict[str, int]]]:
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


def _wider(cause: Cause, names: Sequence[str]) -> Iterator[Cause]:
    """The cause with one more entry of oneself, or of the same thing."""
    if cause.length:
        cause = replace(cause, length=False, name=cause.name.removeprefix("length of "))
    if len(cause.things[0]) >= WIDEST:
        return
    things = _things(names)
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


# --- finding ---


@dataclass(frozen=True, eq=False)
class _Steps:
    """Some of the logged steps."""

    x: np.ndarray  # (T, N, D) where they led to
    unsafe: np.ndarray  # (T,) of the team or (T, N)
    tested: np.ndarray  # (T,) bool: gains are measured on these
    episode: np.ndarray  # (T,)
    low: np.ndarray  # (D,) of nearly all that was seen
    high: np.ndarray  # (D,)
    seen: dict[Cause, tuple[np.ndarray, np.ndarray, int, np.ndarray]]  # ranges, cells along an axis, cells of steps

    def cells(self, cause: Cause) -> tuple[np.ndarray, np.ndarray, int, np.ndarray]:
        """(low, high, cells along each axis, (T, N, J) cell of each thing); remembered."""
        if cause not in self.seen:
            low, high = _range(self, cause)
            bins = _bins(cause, len(self.x) * self.x.shape[1])
            self.seen[cause] = low, high, bins, _cell(cause, self.x, low, high, bins).astype(np.int32)
        return self.seen[cause]

    @property
    def each(self) -> bool:
        """Whether every agent has a cost of its own."""
        return self.unsafe.ndim == 2


@dataclass(frozen=True, eq=False)
class _Tried:
    """A cause, and log P(safe) of the steps by it."""

    cells: Cells
    safe: np.ndarray  # (T,) or (T, N)
    gain: float = 0.0
    error: float = 0.0  # standard error of the gain over episodes


def find(
    x: np.ndarray, unsafe: np.ndarray, episode: np.ndarray, names: Sequence[str], seed: int = 0
) -> tuple[Found, list[Cells]]:
    """The causes of danger in steps that led to features x (T, N, D), `unsafe` (T,) of the team or (T, N) bool of each
    agent, of these episodes (T,); with the cells of each cause."""
    steps = _some(x, unsafe, episode, np.random.default_rng([seed, 5]))
    chosen = _grown(steps, names)
    chosen = _pruned(steps, chosen)
    if not chosen:
        return Found(), []
    cells = [_counted(steps, one.cells.cause, _without(steps, chosen, one), everything=True) for one in chosen]
    edges = tuple(one.edge for one in cells)
    return replace(_summary(steps, chosen), edges=edges), cells


def _some(x: np.ndarray, unsafe: np.ndarray, episode: np.ndarray, rng: np.random.Generator) -> _Steps:
    """As many steps as are needed, whole episodes tested."""
    bad = unsafe if unsafe.ndim == 1 else np.asarray(unsafe.any(1))
    some = _sampled(bad, rng) if len(x) > SAFE_STEPS // 2 else np.arange(len(x))
    x = np.asarray(x[some], np.float32)
    flat = x.reshape(-1, x.shape[-1])
    flat = flat[:: max(1, len(flat) // 200_000)]
    low, high = np.quantile(flat, [0.0005, 0.9995], axis=0)
    tested_episodes = rng.random(int(episode.max()) + 1) < TESTED
    return _Steps(x, unsafe[some], tested_episodes[episode[some]], episode[some], low, high, {})


def _sampled(bad: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rows of steps, in order: UNSAFE_STEPS of the unsafe ones at most, and the same share of the safe ones, at least
    as many and at most SAFE_STEPS."""
    rows = np.flatnonzero(bad)
    rows = rng.choice(rows, min(len(rows), UNSAFE_STEPS), replace=False)
    fine = np.flatnonzero(~bad)
    share = len(rows) / max(bad.sum(), 1)
    count = min(len(fine), SAFE_STEPS, max(int(share * len(fine)), UNSAFE_STEPS))
    return np.sort(np.concatenate([rows, rng.choice(fine, count, replace=False)]))


def _grown(steps: _Steps, names: Sequence[str]) -> list[_Tried]:
    """Causes, one after the other, each the simplest of those that tell most of what is left."""
    chosen: list[_Tried] = []
    explained = np.zeros(steps.unsafe.shape)
    least = LEAST_GAIN * -_likelihood(steps, explained).mean()
    pool = list(candidates(names))
    while len(chosen) < MOST:
        best = _simplest([_tried(steps, cause, explained) for cause in pool])
        if best is None or best.gain < max(least, SURE * best.error):
            break
        chosen.append(best)
        explained = np.minimum(explained, best.safe)
    return [_widened(steps, one, _without(steps, chosen, one), names) for one in chosen]


def _widened(steps: _Steps, one: _Tried, explained: np.ndarray, names: Sequence[str]) -> _Tried:
    """The cause with more entries, where these tell clearly more; once simple ones tell what they can, so that a second
    cause is not taken for a part of the first."""
    best = _tried(steps, one.cells.cause, explained)
    while (more := _best_wider(steps, best, explained, names)) is not None:
        best = more
    return best


def _simplest(tried: list[_Tried]) -> _Tried | None:
    most = max((t.gain for t in tried), default=0.0)
    enough = [t for t in tried if t.gain > 0 and t.gain >= (1 - SIMPLER) * most]
    return min(enough, key=lambda t: (t.cells.cause.width, not t.cells.cause.length, -t.gain), default=None)


def _best_wider(steps: _Steps, best: _Tried, explained: np.ndarray, names: Sequence[str]) -> _Tried | None:
    """The cause with one more entry, where that tells clearly more."""
    tried = [_tried(steps, cause, explained) for cause in _wider(best.cells.cause, names)]
    found = max(tried, key=lambda t: t.gain, default=None)
    if found is None or found.gain < (1 + 2 * SIMPLER) * best.gain:
        return None
    return found if found.gain - best.gain > SURE * max(found.error, best.error) else None


def _pruned(steps: _Steps, chosen: list[_Tried]) -> list[_Tried]:
    """Without those that the rest make needless."""
    for one in sorted(chosen, key=lambda t: t.gain):
        rest = [t for t in chosen if t is not one]
        without = _together(steps, rest)
        lost = _likelihood(steps, np.minimum(without, one.safe)) - _likelihood(steps, without)
        if rest and lost.mean() < LEAST_GAIN * 0.5:
            chosen = rest
    return chosen


def _without(steps: _Steps, chosen: list[_Tried], one: _Tried) -> np.ndarray:
    return _together(steps, [t for t in chosen if t is not one])


def _together(steps: _Steps, chosen: list[_Tried]) -> np.ndarray:
    """Log P(safe) by several causes: the worst counts."""
    return np.minimum.reduce([np.zeros(steps.unsafe.shape), *[t.safe for t in chosen]])


def _tried(steps: _Steps, cause: Cause, explained: np.ndarray) -> _Tried:
    """How much better a cause tells the tested steps than what is explained already."""
    cells = _counted(steps, cause, explained)
    safe = _safe(steps, cells)
    if not cells.danger.any():
        return _Tried(cells, safe)
    more = _likelihood(steps, np.minimum(explained, safe)) - _likelihood(steps, explained)
    episode = steps.episode[steps.tested]
    totals = np.bincount(episode, more)
    counts = np.bincount(episode)
    totals = totals[counts > 0]
    error = totals.std() * np.sqrt(len(totals)) / len(more)
    return _Tried(cells, safe, float(more.mean()), float(error))


def _counted(steps: _Steps, cause: Cause, explained: np.ndarray, everything: bool = False) -> Cells:
    """Cells of a cause, by the steps that are not tested (or all): of what others leave unexplained."""
    part = np.ones(len(steps.x), bool) if everything else ~steps.tested
    low, high, bins, cell = steps.cells(cause)
    cell = cell[part]
    unsafe = steps.unsafe[part]
    left = np.exp(explained[part]) * unsafe
    size = bins**cause.width
    shape = cell.shape
    one = (slice(None), slice(None), None) if steps.each else (slice(None), None, None)
    bad = np.bincount(cell.ravel(), np.broadcast_to(left[one], shape).ravel(), size)
    fine = np.bincount(cell.ravel(), np.broadcast_to((~unsafe)[one], shape).ravel().astype(float), size)
    usual = left.sum() / max(left.sum() + (~unsafe).sum(), 1.0)
    share = bad / (bad + fine + PRIOR)
    error = np.sqrt(share * (1 - share) / (bad + fine + PRIOR))
    beyond = np.clip((share - error - usual) / (1 - usual), 0.0, 1.0)  # the rest comes of other causes
    danger = np.where(beyond > SUFFICIENT, np.clip((share - usual) / (1 - usual), 0.0, 0.999), 0.0)
    return Cells(cause, low, high, bins, bad + fine, danger)


def _range(steps: _Steps, cause: Cause) -> tuple[np.ndarray, np.ndarray]:
    entries = np.array(cause.things)
    if not cause.length:
        return steps.low[entries].min(0), steps.high[entries].max(0)
    some = cause.of(steps.x[:: max(1, len(steps.x) // 20_000)])
    return np.zeros(1), np.quantile(some, 0.9995, axis=tuple(range(some.ndim - 1)))


def _bins(cause: Cause, samples: int) -> int:
    most = CELLS[cause.width]
    return int(np.clip((samples / 20) ** (1 / cause.width), 6, most))


def _cell(cause: Cause, x: np.ndarray, low: np.ndarray, high: np.ndarray, bins: int) -> np.ndarray:
    """(T, N, J) the cell of each thing."""
    scaled = (cause.of(x) - low) / np.maximum(high - low, 1e-9) * bins
    places = np.clip(scaled, 0, bins - 1).astype(np.int64)
    cell = places[..., 0]
    for k in range(1, cause.width):
        cell = cell * bins + places[..., k]
    return cell


def _safe(steps: _Steps, cells: Cells) -> np.ndarray:
    """Log P(safe) of steps by one cause: of the worst thing, and of the worst agent where costs are the team's."""
    if not cells.danger.any():
        return np.zeros(steps.unsafe.shape)
    cell = steps.cells(cells.cause)[-1]
    safe = np.log1p(-cells.danger)[cell].min(-1)
    return safe if steps.each else safe.min(1)


def _likelihood(steps: _Steps, safe: np.ndarray) -> np.ndarray:
    """(T',) log likelihood of the tested steps; what no cause explains is as frequent as in the rest."""
    fitted = ~steps.tested
    open_ = safe[fitted] > -1e-6
    unsafe = steps.unsafe[fitted]
    leak = np.clip(unsafe[open_].mean() if open_.any() else 0.0, 1e-4, 1 - 1e-4)
    chance = np.clip(1 - np.exp(safe[steps.tested]) * (1 - leak), 1e-4, 1 - 1e-4)
    each = np.where(steps.unsafe[steps.tested], np.log(chance), np.log1p(-chance))
    return each if each.ndim == 1 else each.sum(1)


def _summary(steps: _Steps, chosen: list[_Tried]) -> Found:
    unsafe = steps.unsafe[steps.tested]
    limit = np.log(0.5)

    def explained(safe: np.ndarray) -> tuple[float, float]:
        called = safe[steps.tested] < limit
        return float(called[unsafe].mean()), float(called[~unsafe].mean())

    share, false_alarms = explained(_together(steps, chosen))
    shares = tuple(round(explained(one.safe)[0], 4) for one in chosen)
    return Found(tuple(one.cells.cause for one in chosen), round(share, 4), round(false_alarms, 4), shares)
