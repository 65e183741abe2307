"""Rows of (time, agent) as episodes: one clock, holes cut, a constant team or an agent among its neighbours.

Tracks are NumPy on flat arrays; `rows.py` says what a table's rows are, `episodes.py` what agents see.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from ringfence.errors import StoreError, UserError
from ringfence.logs.io.rows import Rows
from ringfence.logs.io.table_schema import TableSchema

PASSED_OVER = 0.05  # share of commands that come between steps, or between a bag's rows, above which it is said
GAP = 5.0  # steps without a row that end an episode
EXACT = 0.05  # of a step, by which a round number of seconds or hertz may be off at a recording's end
DIGITS = 1e-5  # of a step, which six digits leave open
CLOSE = 0.01  # of a step, within which another is meant to be the same
NEAR = 10  # rows before and after, whose phase is one
COHERENT = 0.3  # length of the mean phase of rows that share a clock, nearly everywhere; 0 of rows at random times
SLIPS = 0.25  # of a step, above which rows are put on whole steps
OFF = 0.01  # of a step, above which it is said
FEW = 5  # rows whose times were rounded another way than most, below which none was: rows were lost
COARSEST = 0.62  # of a step, to which times may be rounded; coarser ones are of a clock that lost a third of its rows,
SINGLE = 0.8  # but those of single precision, which are rounded to powers of two
FINEST = 1000  # steps between two rows: more are another unit of time
MANY = 10  # steps between two rows of a large table
EARLY = 0.05  # of a step, by which an agent's first or last row may miss one
STEADY = 0.5  # length of the mean phase of rows that keep their place between steps
CHUNK = 4_000_000  # pairs of agents whose distances are looked at together
NOWHERE = 1e-9  # m


# --- the clock: how long a step is; rows whose clock drifts or begins late ---
@dataclass(frozen=True)
class Clock:
    """Steps that rows are put on."""

    dt: float  # s
    gap: float  # s without a row, after which an agent was away


def clock_of(rows: Rows, schema: TableSchema) -> Clock:
    """The steps that the schema asks for, or those of the rows."""
    dt = schema.dt or _step(rows)
    gap = schema.gap or GAP * max(dt, rows.step)
    if gap < rows.step:
        raise UserError(
            f"gap={gap:g} is less than the {rows.step:g} s between an agent's rows; every row would be cut off."
        )
    return Clock(dt, gap)


def _step(rows: Rows) -> float:
    """s between an agent's rows: the median with six digits, or what is near whole hertz, where nothing slips by that
    until the longest recording ends; else the mean over whole numbers of steps, which the digits of no time blur."""
    track = np.cumsum(np.append(True, ~rows.follows))
    lag = min(NEAR, int(np.bincount(track).max()) - 1)
    passed = (rows.time[lag:] - rows.time[:-lag])[track[lag:] == track[:-lag]]
    passed = passed[passed <= GAP * lag * rows.step]
    mean = rows.step
    for _ in range(3):  # a better one counts better
        mean = float(passed.sum() / max(np.round(passed / mean).sum(), 1))
    if abs(mean / rows.step - 1) > CLOSE:  # no clock
        return float(f"{rows.step:.6g}")
    hertz = 1 / max(round(1 / mean), 1)
    nice = [float(f"{rows.step:.6g}"), hertz, float(f"{mean:.6g}")]
    if abs(hertz / rows.step - 1) < DIGITS:
        nice.insert(0, hertz)
    begins = np.flatnonzero(is_first(rows.recording))
    spans = np.maximum.reduceat(rows.time, begins) - np.minimum.reduceat(rows.time, begins)  # of each recording
    longest = float(spans.max())
    return next((step for step in nice if abs(step / mean - 1) * longest <= EXACT * step), mean)


# --- rounding ---
def unrounded(rows: Rows) -> tuple[Rows, list[str]]:
    """The rows at the times that theirs were rounded from, where all are within one rounding of a clock that ticks
    evenly, of each recording or else of each agent; and a sentence that says so."""
    unit = _unit(rows.time)
    apart = np.diff(rows.time)[rows.follows]
    usual = apart[np.abs(apart - rows.step) < 1.5 * unit]
    mean = better = float(usual.mean()) if len(usual) else rows.step  # the mean of all where no row is lost
    coarsest = SINGLE if unit and np.log2(unit) % 1 == 0 else COARSEST
    if (np.abs(usual - rows.step) > unit / 2).sum() < FEW or not DIGITS * mean < unit <= coarsest * mean:
        return rows, []
    track = np.cumsum(np.append(True, ~rows.follows))
    for lag in 10 ** np.arange(1, np.log10(np.bincount(track).max())).astype(int):
        passed = (rows.time[lag:] - rows.time[:-lag])[track[lag:] == track[:-lag]]
        better = float(passed.sum() / max(np.round(passed / better).sum(), 1))
    hertz = 1 / max(round(1 / better), 1)
    for step, whose in itertools.product((hertz, better, mean), (rows.recording, track)):
        order = np.argsort(whose, kind="stable")
        parts = [
            _ticks(rows.time[here], step, unit) for here in np.split(order, np.flatnonzero(np.diff(whose[order])) + 1)
        ]
        found = [part for part in parts if part is not None]
        if len(found) < len(parts):
            continue
        time = np.empty(len(order))
        time[order] = np.concatenate(found)
        if (np.diff(time)[rows.follows] > 0).all():
            said = f"times are rounded to {unit:.3g} s: rows are at those of the clock of {step:.6g} s that fits them"
            return replace(rows, time=time), [said]
    return rows, []


def _ticks(time: np.ndarray, step: float, unit: float) -> np.ndarray | None:
    """Times (M,) of a clock that ticks every `step` s, or nearly so, which within one `unit` (s) are those given."""
    passed = time - time[0]
    tick = np.round(passed / step - np.angle(np.exp(2j * np.pi / step * passed).mean()) / (2 * np.pi))
    off = time - tick * step
    if np.ptp(off) > unit * (1 + CLOSE) and np.ptp(tick) > 0:  # its own clock is another
        step = float(np.polyfit(tick, passed, 1)[0])
        off = time - tick * step
    return None if np.ptp(off) > unit * (1 + CLOSE) else off.mean() + tick * step


def _unit(time: np.ndarray) -> float:
    """s of which all times are whole numbers since the first; 0 where there is none that their digits tell apart."""
    passed = time - time.min()
    blur = 4 * float(np.spacing(np.abs(time).max()))
    for size in 10.0 ** np.arange(14):
        if blur * size > 0.1 or passed.max() * size > 2**62:
            break
        if np.abs(passed * size - np.round(passed * size)).max() <= max(blur * size, 1e-6):
            return float(np.gcd.reduce(np.round(passed * size).astype(np.int64)) / size)
    return 0.0


# --- drift ---
def on_whole_steps(rows: Rows, clock: Clock) -> tuple[Rows, list[str]]:
    """The rows with times from 0 in each recording. Where a clock drifts or its first row comes late, so that rows
    would slip by more than a quarter of a step, steps are counted by rows, and a sentence says how far it drifted."""
    dt, step = clock.dt, rows.step
    many = round(max(dt / step, step / dt))
    spacing = dt / many if dt >= step else dt * many  # s between rows: dt is a whole number of it, or a whole part
    counted = abs(spacing / step - 1) < CLOSE
    time = rows.time.copy()
    begins = np.flatnonzero(is_first(rows.recording))
    furthest = 0.0
    for here in (slice(*ends) for ends in zip(begins, [*begins[1:], len(time)])):
        time[here] -= time[here].min()
        steps = time[here] / dt
        if not counted or float(np.abs(steps - np.round(steps)).max()) <= SLIPS:
            continue
        slip = _slip(time[here], rows.agent[here], spacing)
        if slip is not None and float(np.abs(slip).max()) * spacing > SLIPS * dt:
            furthest = max(furthest, float(np.ptp(slip)) * spacing / dt)
            time[here] = np.where(time[here] == 0, 0, time[here] - slip * spacing)
    said = f"a clock drifts by up to {furthest:.3g} steps of {dt:g} s: steps are counted by rows"
    return replace(rows, time=time), [said] if furthest > SLIPS else []


def _slip(time: np.ndarray, agent: np.ndarray, spacing: float) -> np.ndarray | None:
    """(M,) rows by which times are late against a clock that ticks from 0 every `spacing` s: of all agents, or of the
    one with most rows where they share no clock. None where that one has none either."""
    for chosen in (np.ones(len(time), bool), agent == np.bincount(agent).argmax()):
        some = np.sort(time[chosen])
        phases = np.concatenate([[0], np.cumsum(np.exp(2j * np.pi / spacing * some))])
        first = np.searchsorted(some, some - NEAR * spacing, "left")
        last = np.searchsorted(some, some + NEAR * spacing, "right")
        mean = (phases[last] - phases[first]) / (last - first)
        if float(np.quantile(np.abs(mean), 0.05)) > COHERENT:
            return np.interp(time, some, np.unwrap(np.angle(mean)) / (2 * np.pi))
    return None


def off_the_clock(rows: Rows, clock: Clock) -> Iterator[str]:
    """A sentence where rows whose times begin at 0 are off the steps."""
    steps = rows.time / clock.dt
    far = float(np.quantile(np.abs(steps - np.round(steps)), 0.99))
    if far > OFF:
        yield (
            f"rows are up to {far:.2g} of a step of {clock.dt:g} s off the clock: states are interpolated, actions, "
            "costs and rewards are those nearest to a step"
        )


# --- tracks ---
@dataclass(frozen=True)
class Tracks:
    """R rows on one clock, sorted by segment and step: a segment is one agent without a hole.

    What adds up (`earned`, `cost`) is of the time since the row before.
    """

    recording: np.ndarray  # (R,) int, whose rows share a clock
    agent: np.ndarray  # (R,) int
    segment: np.ndarray  # (R,) int
    step: np.ndarray  # (R,) int, of dt seconds since the recording's first row
    state: np.ndarray  # (R, C)
    action: np.ndarray  # (R, A): the last one at that time
    earned: np.ndarray  # (R,): the sum of rewards
    cost: np.ndarray  # (R, K): the sum of each kind
    ended: np.ndarray  # (R,) whether an episode ended by itself
    dt: float  # s


def resample(
    recording: np.ndarray,
    agent: np.ndarray,
    time: np.ndarray,
    state: np.ndarray,
    action: np.ndarray,
    reward: np.ndarray,
    cost: np.ndarray,
    ended: np.ndarray,
    dt: float,
    gap: float,
) -> Tracks:
    """Rows sorted by (recording, agent, time), (M,) each and (M, C), (M, A), (M, K) costs, onto steps of `dt` s.
    States are interpolated, actions held. Rewards and costs belong to the step that they are nearest to and keep their
    sum. A hole of more than `gap` s ends a segment, and so does a row that an episode `ended` with."""
    segments = _Segments.of(recording, agent, time, ended, gap)
    segment, step = segments.grid(dt)
    at, row = segments.placed(segment, step, dt)
    fresh = is_first(segment)
    row = np.where(np.append(fresh[1:], True), segments.last[segment], row)  # what comes after the last step is of it
    before = np.where(fresh, segments.first[segment] - 1, np.concatenate([[0], row[:-1]]))
    return Tracks(
        recording[segments.first][segment],
        agent[segments.first][segment],
        segment,
        step,
        np.stack([np.interp(at, segments.axis, column) for column in state.T], 1),
        action[row],
        _between(np.add, reward, before, row),
        _lasting(_between(np.add, cost, before, row), row > before, fresh),
        _between(np.logical_or, ended, before, row),
        dt,
    )


@dataclass(frozen=True, eq=False)
class _Segments:
    """Rows (M,) in time, and the S pieces without a hole that they are of: one agent's each."""

    time: np.ndarray  # (M,) s
    begins: np.ndarray  # (M,) bool: the first row of a segment
    first: np.ndarray  # (S,) index of rows
    last: np.ndarray  # (S,)
    origin: np.ndarray  # (S,) s: when the segment's recording begins

    @classmethod
    def of(cls, recording: np.ndarray, agent: np.ndarray, time: np.ndarray, ended: np.ndarray, gap: float) -> _Segments:
        begins = np.ones(len(time), bool)
        begins[1:] = (np.diff(recording) != 0) | (np.diff(agent) != 0) | (np.diff(time) > gap) | ended[:-1]
        first = np.flatnonzero(begins)
        zero = np.full(recording.max() + 1, np.inf)
        np.minimum.at(zero, recording, time)
        return cls(time, begins, first, np.append(first[1:], len(time)) - 1, zero[recording[first]])

    def grid(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """(segment, step) of every step of `dt` s that lies within a segment."""
        begin = self.time[self.first]
        end = self.time[self.last]
        wanted = float(((end - begin) / dt + 1).sum())
        if not wanted <= FINEST * FINEST + MANY * len(self.time):
            raise StoreError(
                f"Steps of {dt:g} s would be {wanted:.3g} for {len(self.time):,} rows; give a larger dt (times are in "
                "seconds)."
            )
        low = np.ceil((begin - self.origin) / dt - EARLY).astype(np.int64)
        high = np.floor((end - self.origin) / dt + EARLY).astype(np.int64)
        count = np.maximum(high - low + 1, 0)
        segment = np.repeat(np.arange(len(self.first)), count)
        return segment, np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + low[segment]

    @property
    def shift(self) -> np.ndarray:
        """(S,) s that puts all segments one after another on one axis, so that each is searched and interpolated in one
        call."""
        begin = self.time[self.first]
        spans = self.time[self.last] - begin
        return np.concatenate([[0.0], np.cumsum(spans + 1.0)[:-1]]) - begin

    @property
    def axis(self) -> np.ndarray:
        """(M,) s of the rows on that axis."""
        return self.time + self.shift[np.cumsum(self.begins) - 1]

    def placed(self, segment: np.ndarray, step: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """(where steps are on that axis, the last row at or before each)."""
        axis = self.axis
        place = step * dt + (self.origin + self.shift)[segment]
        row = np.searchsorted(axis, place + self._late(dt)[segment], "right") - 1
        at = np.clip(place, axis[self.first][segment], axis[self.last][segment])
        return at, np.clip(row, self.first[segment], self.last[segment])

    def _late(self, dt: float) -> np.ndarray:
        """(S,) s by which a row may come after the step that it is of: half a step, since clocks jitter (half of the
        finer of both steps). Around the usual place of a segment's rows between steps, where they have one, so that
        jitter makes no difference to agents whose rows come half a step after those of others."""
        inside = np.diff(self.time)[~self.begins[1:]]
        half = 0.499 * min(dt, float(np.median(inside)) if len(inside) else dt)
        steps = (self.time - self.origin[np.cumsum(self.begins) - 1]) / dt
        turns = np.add.reduceat(np.exp(2j * np.pi * steps), self.first) / (self.last - self.first + 1)
        return half + np.where(np.abs(turns) > STEADY, np.angle(turns) / (2 * np.pi) * dt, 0.0)


def _between(sum_of: np.ufunc, values: np.ndarray, before: np.ndarray, row: np.ndarray) -> np.ndarray:
    """(R, ...) what `sum_of` makes of the `values` (M, ...) of the rows after `before` and up to `row`; 0 of no row."""
    bounds = np.stack([np.minimum(before + 1, row), row + 1], 1).ravel()
    found = sum_of.reduceat(np.concatenate([values, np.zeros_like(values[:1])]), bounds)[::2]
    found[row <= before] = 0
    return found


def _lasting(cost: np.ndarray, own: np.ndarray, fresh: np.ndarray) -> np.ndarray:
    """Costs (R, K) of which steps without a row of their `own` have a share where danger lasts: where the rows before
    and after both cost something, what the later one costs is shared by the steps since. Segments begin with a row."""
    owners = np.flatnonzero(own)
    later = np.minimum(np.searchsorted(owners, np.arange(len(own))), len(owners) - 1)
    here, before = owners[later], owners[np.maximum(later - 1, 0)]
    lasts = (cost[here] > 0) & (cost[before] > 0) & ~fresh[here, None]
    return np.where(lasts, cost[here] / np.maximum(here - before, 1)[:, None], cost)


def is_first(*keys: np.ndarray) -> np.ndarray:
    """(M,) whether a row has another of the keys (M,) than the one before; the first row has."""
    return np.append(True, np.any([key[1:] != key[:-1] for key in keys], 0))


def _moments(recording: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(index of the first row of each time, how many rows it has), of rows (M,) in the order of time."""
    first = np.flatnonzero(is_first(recording, step))
    return first, np.diff(np.append(first, len(step)))


def teams(tracks: Tracks, size: int | None) -> tuple[np.ndarray, np.ndarray, int]:
    """Windows in which the same agents are there: rows (W, N) of `tracks`, of everybody at a time; how many rows each
    window has; and N, by default the size that most rows belong to."""
    order = np.lexsort((tracks.agent, tracks.step, tracks.recording))
    recording, step, segment = (x[order] for x in (tracks.recording, tracks.step, tracks.segment))
    first, many = _moments(recording, step)
    # Who is there, as one number: two sets of segments share theirs once in 2^64.
    mark = np.random.default_rng(0).integers(0, 2**63, segment.max() + 1, np.uint64, endpoint=True)[segment]
    who = np.add.reduceat(mark, first)
    changes = np.ones(len(first), bool)
    changes[1:] = (np.diff(who) != 0) | (np.diff(recording[first]) != 0) | (np.diff(step[first]) != 1)
    window = np.cumsum(changes) - 1
    rows = np.bincount(window)
    of = many[np.flatnonzero(changes)]  # agents of each window
    if size is None and not (rows > 1).any():
        return np.zeros((0, 1), int), np.zeros(0, int), 1
    if size is None:
        size = int(np.bincount(of, weights=(rows - 1) * of).argmax())
    chosen = of == size
    return order[np.repeat(chosen[window], many)].reshape(-1, size), rows[chosen], size


def cut(rows: np.ndarray, fewest: int, most: int | None) -> tuple[np.ndarray, np.ndarray]:
    """(index of rows, rows of each piece): windows of so many `rows` in pieces of `fewest` to `most` steps, each
    of which begins with the row that the one before ends with."""
    starts = np.cumsum(rows) - rows
    steps = rows - 1
    if most is not None:
        pieces = np.maximum(-(-steps // most), 1)
        number = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        starts = np.repeat(starts, pieces) + number * most
        steps = np.minimum(np.repeat(steps, pieces) - number * most, most)
    kept = steps >= fewest
    starts = starts[kept]
    many = steps[kept] + 1
    return np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many) + np.repeat(starts, many), many


def nearest(tracks: Tracks, position: np.ndarray, k: int, sensing_radius: float) -> np.ndarray:
    """(R, k) rows of the agents who are nearest at the same time, −1 where nobody is within `sensing_radius` m."""
    order = np.lexsort((tracks.step, tracks.recording))
    first, many = _moments(tracks.recording[order], tracks.step[order])
    found = np.full((len(order), k), -1, np.int32 if len(order) < 2**31 else np.int64)
    for moment in np.flatnonzero(many.astype(float) ** 2 > CHUNK).tolist():
        rows = order[first[moment] : first[moment] + many[moment]]
        found[rows, : many[moment] - 1] = _nearest_of_many(rows, position[rows], k, sensing_radius)
    by_size = np.argsort(many, kind="stable")  # so that little is padded
    by_size = by_size[many[by_size].astype(float) ** 2 <= CHUNK]
    while len(by_size):
        most = int(np.searchsorted(np.cumsum(many[by_size] ** 2), CHUNK)) + 1
        now = by_size[:most]
        by_size = by_size[most:]
        width = int(many[now].max())
        place = first[now, None] + np.arange(width)
        there = np.arange(width) < many[now, None]
        rows = np.where(there, order[np.minimum(place, len(order) - 1)], -1)
        at = np.where(there[..., None], position[rows], np.inf)
        with np.errstate(invalid="ignore"):
            far = np.sqrt(((at[:, None] - at[:, :, None]) ** 2).sum(-1))
        far[:, np.arange(width), np.arange(width)] = np.inf
        far = np.where(np.isnan(far) | (far > sensing_radius), np.inf, far)
        if width > 1:
            who = np.argsort(far, -1, kind="stable")[..., : min(k, width - 1)]
            close = np.isfinite(np.take_along_axis(far, who, -1))
            theirs = np.where(close, rows[np.arange(len(now))[:, None, None], who], -1)
            found[rows[there], : theirs.shape[-1]] = theirs[there]
    return found


def _nearest_of_many(rows: np.ndarray, place: np.ndarray, k: int, sensing_radius: float) -> np.ndarray:
    """(M, k) the same of `rows` (M,) of one moment, by a tree. Of those at one place, whoever is near in the list: an
    axis that is too short to matter tells them apart, so that a tree of them is none of one leaf."""
    apart = NOWHERE * np.arange(len(rows)) / len(rows)
    places = np.column_stack([place - place.mean(0), apart])
    tree = KDTree(places)
    found = np.full((len(rows), min(k, len(rows) - 1)), -1)
    size = max(CHUNK // (k + 1), 1)
    for start in range(0, len(rows), size):
        some, most = places[start : start + size], np.nextafter(sensing_radius, np.inf)
        _, near = tree.query(some, found.shape[1] + 1, distance_upper_bound=most)
        near = np.asarray(near)[:, 1:]  # oneself is the first
        found[start : start + size] = np.append(rows, -1)[near]
    return found
