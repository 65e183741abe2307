"""Rows of a table: their columns in SI units, the rows in order, what is doubtful about their numbers, and the rows in
two parts by time.

Numbers are times a factor, degrees of longitude and latitude become metres, and angles their cosine and sine, since an
angle jumps by a turn, and between -pi and pi lies no 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ringfence.errors import StoreError, UserError, unknown
from ringfence.logs.io.columns import Columns, is_missing, numbers, seconds, words
from ringfence.logs.io.table_schema import TableSchema
from ringfence.problem.entries import DEGREES, RADIANS
from ringfence.utils.text import numbered

COARSE = 0.01  # of what a column changes by in a row: the distance of neighbouring numbers above which it is coarse
LONG = 5.0  # s, a step that hardly any controller has
FEW_MOVED = 0.01  # of the rows, that may have jumped and leave the others in doubt of nothing
MANY_MOVED = 0.05  # of the rows, that are not dropped for having jumped: the unit is another
JITTER = 0.25  # of a step, by which rows of one moment come apart
SPAN = 10  # rows that velocities are compared over
JITTERS = 0.25  # power of rows, by which places move farther than they jitter: 0 of jitter alone, 0.5 of a random walk
DEGREE = 111_000.0  # m of a degree of latitude
MAX_SPEED = 100.0  # m/s that nothing there can do, unless somebody says what it can

# WGS 84 and the transverse Mercator projection of UTM, by Krüger's series (Karney 2011, to the third order: 1 mm).
RADIUS, FLATTENING = 6378137.0, 1 / 298.257223563
N = FLATTENING / (2 - FLATTENING)
MERIDIAN = RADIUS / (1 + N) * (1 + N**2 / 4 + N**4 / 64)
SERIES = (N / 2 - 2 * N**2 / 3 + 5 * N**3 / 16, 13 * N**2 / 48 - 3 * N**3 / 5, 61 * N**3 / 240)
SCALE, EASTING, NORTHING = 0.9996, 500_000.0, 10_000_000.0
REACH = 9.0  # degrees from a zone's middle, beyond which distances are off by more than a hundredth
POLES = 84.0  # degrees of latitude, where UTM ends

ANGLES = ("theta", "yaw", "heading", "compass", "course", "bearing", "psi")
TURN = 2 * np.pi + 1e-6
TURNS = {360.0: "_deg", 2 * np.pi: ""}  # by which angles jump, and what is added to their names
APART = 0.1  # of a turn: as near to none or to a whole one an angle changes from row to row


@dataclass(frozen=True, eq=False)
class Rows:
    """M rows sorted by recording, agent and time."""

    order: np.ndarray  # (M,) rows of the table
    recording: np.ndarray  # (M,)
    agent: np.ndarray  # (M,)
    time: np.ndarray  # (M,) s
    agents: np.ndarray  # names, by number, in natural order
    ended: np.ndarray  # (M,) whether an episode ended by itself with the row

    def chosen(self, kept: np.ndarray) -> Rows:
        return Rows(
            self.order[kept], self.recording[kept], self.agent[kept], self.time[kept], self.agents, self.ended[kept]
        )

    @cached_property
    def follows(self) -> np.ndarray:
        """(M-1,) whether a row is of the same agent and episode as the one before."""
        return (np.diff(self.recording) == 0) & (np.diff(self.agent) == 0) & ~self.ended[:-1]

    @cached_property
    def step(self) -> float:
        """s between rows of an agent, in the median."""
        return float(np.median(np.diff(self.time)[self.follows]))


@dataclass(frozen=True, eq=False)
class Values:
    """Numbers of the rows, in their order."""

    columns: Columns  # (M,) each of state, action and goal
    reward: np.ndarray  # (M,)
    cost: np.ndarray  # (M, K)
    single: tuple[str, ...] = ()  # columns that the table holds in single precision

    def chosen(self, kept: np.ndarray) -> Values:
        columns = {name: column[kept] for name, column in self.columns.items()}
        return Values(columns, self.reward[kept], self.cost[kept], self.single)

    def stacked(self, names: tuple[str, ...]) -> np.ndarray:
        """(M, columns)"""
        return np.stack([self.columns[name] for name in names], 1)


def sorted_rows(columns: Columns, schema: TableSchema) -> Rows:
    """The rows in order; an agent's times must increase."""
    dates = columns[schema.time].dtype.kind in "mM"
    clock = seconds(columns, schema.time) * (1.0 if dates else schema.time_unit or 1.0)
    agents, owner = numbered(words(columns, schema.agent))
    recording = np.zeros(len(clock), int)
    if schema.episode is not None:
        recording = numbered(words(columns, schema.episode))[1]
    later = clock if schema.sort else np.zeros(len(clock))
    order = np.lexsort((np.arange(len(clock)), later, owner, recording))  # else an agent's rows as in the table
    ended = _ends(columns, schema, len(clock))
    rows = Rows(order, recording[order], owner[order], clock[order], agents, ended[order])
    if schema.sort:
        table = [columns[name][order] for name in schema.columns]
        repeats = np.all([np.asarray(column[1:] == column[:-1], bool) for column in table], 0)
        rows = rows.chosen(np.append(True, ~repeats))
    _refuse_disorder(rows, columns, schema)
    if not rows.follows.any():
        raise StoreError(
            f"No agent has two rows; check that {schema.agent} tells agents and {schema.time} their times."
        )
    together = rows if schema.homogeneous else _ended_together(rows)
    if not together.follows.any():
        raise StoreError(f"{schema.terminated} ends an episode at every row, so that none has a step; check its flags.")
    return together


def _ended_together(rows: Rows) -> Rows:
    """The rows with all of a team ended where one of it has: an episode is of all of them."""
    ended, flagged = rows.ended.copy(), np.flatnonzero(rows.ended)
    goes_on = (np.diff(rows.recording) == 0) & (np.diff(rows.agent) == 0)
    for one in np.unique(rows.recording[flagged]):
        first, end = (int(np.searchsorted(rows.recording, one, side)) for side in ("left", "right"))
        moments = np.append(np.unique(rows.time[first:end][ended[first:end]]), np.inf)
        here, following = rows.time[first : end - 1], rows.time[first + 1 : end]
        moment = moments[np.searchsorted(moments + JITTER * rows.step, here)]  # the first that a row is the last of
        last = (moment + JITTER * rows.step < following) & (here > moment - (1 + JITTER) * rows.step)
        ended[first : end - 1] |= last & goes_on[first : end - 1]
    return replace(rows, ended=ended)


def _refuse_disorder(rows: Rows, columns: Columns, schema: TableSchema) -> None:
    passed = np.diff(rows.time)
    same = (np.diff(rows.recording) == 0) & (np.diff(rows.agent) == 0)
    backwards = same & (passed < 0)
    twice = same & (passed == 0)
    where = "." if schema.episode is not None else ", or name the column that tells episodes apart."
    for wrong, what, remedy in (
        (backwards, "is earlier than", "sort each agent's rows by time with sort=True (--sort)"),
        (twice, "is the time of", "keep one row per agent and time"),
    ):
        if not wrong.any():
            continue
        k = int(np.flatnonzero(wrong)[np.argmin(rows.order[1:][wrong])])
        row = int(rows.order[k + 1])
        time = columns[schema.time][row]
        when = f"{time:.10g}" if isinstance(time, int | float | np.number) else str(time)  # as the table has it
        raise StoreError(
            f"row {row}: {schema.time}={when} {what} row {int(rows.order[k])} of the same agent "
            f"({schema.agent}={columns[schema.agent][row]}); {remedy}{where}"
        )


def values_of(columns: Columns, rows: Rows, schema: TableSchema) -> Values:
    """The numbers that the schema names; without a reward or cost, 0."""
    columns = dict(columns)
    last = np.flatnonzero(np.append(~rows.follows, True))
    last = last[last > 0]
    for name in schema.action:  # nobody follows an agent's last command: one that is missing is the one before
        columns[name] = _filled(columns[name], rows.order[last], columns[name][rows.order[last - 1]])
    first = rows.order[np.append(True, ~rows.follows)]
    for name in (schema.reward, *schema.cost):  # nothing came before an agent's first row: one that is missing is 0
        if name is not None and columns[name].dtype.kind in "fO":  # no other has a missing number
            columns[name] = _filled(columns[name], first, np.zeros(len(first), int))
    read = {name: numbers(columns, name)[rows.order] for name in (*schema.state, *schema.action, *schema.goal)}
    zero = np.zeros(len(rows.time))
    reward = numbers(columns, schema.reward)[rows.order] if schema.reward else zero
    costs = [numbers(columns, name)[rows.order] for name in schema.cost]
    single = tuple(name for name in read if columns[name].dtype == np.float32)
    return Values(read, reward, np.stack(costs or [zero], 1), single)


def _filled(column: np.ndarray, where: np.ndarray, instead: np.ndarray) -> np.ndarray:
    """The column with what is `instead` (K,) of those of its rows `where` (K,) that are missing."""
    missing = np.array([is_missing(entry) for entry in column[where]], bool)
    if not missing.any():
        return column
    filled = column.copy()
    filled[where[missing]] = instead[missing]
    return filled


def _ends(columns: Columns, schema: TableSchema, count: int) -> np.ndarray:
    """(M,) flags of `count` rows of the table."""
    if schema.terminated is None:
        return np.zeros(count, bool)
    flags = numbers(columns, schema.terminated)
    others = ~np.isin(flags, (0.0, 1.0))
    if others.any():
        row = int(np.flatnonzero(others)[0])
        raise StoreError(f"row {row}: {schema.terminated} is {flags[row]:g}, no flag; write 0 or 1.")
    return flags > 0


# --- jumps and other doubts ---
def refuse_jumps(rows: Rows, values: Values, schema: TableSchema) -> None:
    """Refuse rows that nothing can lie apart by."""
    if not schema.position:
        return
    limit = schema.max_speed or MAX_SPEED
    speed = _speeds(rows, values, schema)
    beyond = speed > limit
    if beyond.any():
        k = int(np.flatnonzero(beyond)[np.argmin(rows.order[1:][beyond])])
        raise StoreError(
            f"row {int(rows.order[k + 1])}: {', '.join(schema.position)} moved at {speed[k]:.4g} m/s since row "
            f"{int(rows.order[k])} of the same agent, more than max_speed={limit:g}, as {int(beyond.sum()) - 1} others "
            "did; check the units of positions (m) and times (s), or give --max-speed what is possible there, which "
            f"drops rows that jump, up to {100 * MANY_MOVED:g} % of them."
        )


def without_jumps(rows: Rows, values: Values, schema: TableSchema) -> tuple[Rows, Values, list[str]]:
    """The rows that nobody reached faster than the schema's `max_speed`, and how many are dropped; all of them where it
    says no speed, or where so many jumped that the unit must be another."""
    if schema.max_speed is None or not schema.position:
        return rows, values, []
    kept = np.arange(len(rows.time))
    while len(kept) > (1 - MANY_MOVED) * len(rows.time):
        some = rows.chosen(kept)
        beyond = _speeds(some, values.chosen(kept), schema) > schema.max_speed
        if not beyond.any():
            dropped = len(rows.time) - len(kept)
            said = [f"{dropped} rows that moved faster than {schema.max_speed:g} m/s are dropped"] if dropped else []
            return some, values.chosen(kept), said
        kept = np.delete(kept, _that_jumped(some, beyond))
    return rows, values, []


def _that_jumped(rows: Rows, beyond: np.ndarray) -> np.ndarray:
    """Rows to drop where `beyond` (M-1,) says what moved too fast since the row before: the later row of the first of
    several such moves, or an agent's first row where it is the one that lies apart."""
    before = np.append(False, beyond[:-1])
    after = np.append(beyond[1:], False)
    begins = np.append(True, ~rows.follows)[:-1]
    goes_on = np.append(rows.follows[1:], False)
    first_is_apart = beyond & begins & goes_on & ~after
    later = beyond & ~first_is_apart & (~before | begins)
    return np.concatenate([np.flatnonzero(first_is_apart), np.flatnonzero(later) + 1])


def doubts(rows: Rows, values: Values, dt: float, schema: TableSchema) -> Iterator[str]:
    """What is odd about the numbers, which are to be put on steps of `dt` s, in sentences."""
    if schema.position:
        yield from _doubtful_velocities(rows, values, schema)
        yield from _jumps(rows, values, schema)
    yield from blurred(rows, values)
    if dt >= LONG:
        yield f"a step is {dt:g} s: if times are in ms, µs or frames, say how long one is (time_unit)"
    if schema.action:
        sizes = np.abs(values.stacked(schema.action))
        largest = float(sizes.max())
        usual = float(np.quantile(sizes, 0.99, axis=0).max())
        if largest > 10 * usual:
            yield (
                f"the largest action is {largest:.4g}, 99 % are below {usual:.4g}: all are learned in units of the "
                "largest"
            )
    if not schema.position:
        yield "state holds no x, y or z, so nobody sees where others are relative to oneself"


def _speeds(rows: Rows, values: Values, schema: TableSchema) -> np.ndarray:
    """(M-1,) m/s since the row before; 0 where another agent's rows begin."""
    passed = np.where(rows.follows, np.diff(rows.time), np.inf)
    return np.linalg.norm(np.diff(values.stacked(schema.position), axis=0) / passed[:, None], axis=1)


def blurred(rows: Rows, values: Values) -> Iterator[str]:
    """Columns of single precision that tells their numbers apart by more than a part of what they usually change by,
    such as UTM. Those of double precision are moved (`logs.moving`)."""
    for name in values.single:
        column = values.columns[name]
        change = np.abs(np.diff(column))[rows.follows]
        usual = float(np.median(change[change > 0])) if (change > 0).any() else 0.0
        gap = float(np.spacing(np.float32(np.abs(column).max())))
        if usual and gap > COARSE * usual:
            yield (
                f"{name} reaches {np.abs(column).max():.4g} and changes by {usual:.2g} a row, which single precision "
                f"tells apart by {gap:.2g}: write the column in double precision"
            )


def _doubtful_velocities(rows: Rows, values: Values, schema: TableSchema) -> Iterator[str]:
    """Columns of velocities that are not those of the positions. Both are means over several rows, of which jitter of
    the places is a smaller part; where places move no farther than they jitter, nothing is said."""
    track = np.cumsum(np.append(True, ~rows.follows))
    span = max(min(SPAN, int(np.median(np.bincount(track)[track])) // 2), 1)
    whole = track[span:] == track[:-span]
    passed = np.where(whole, rows.time[span:] - rows.time[:-span], np.inf)
    place = values.stacked(schema.position)
    speed = np.linalg.norm(place[span:] - place[:-span], axis=1) / passed
    usual = whole & (speed <= np.quantile(speed[whole], 0.99))  # a row that jumped says nothing of the others
    for axis in schema.position:
        if f"v{axis}" not in schema.velocity:
            continue
        x, v = values.columns[axis], values.columns[f"v{axis}"]
        far, near = (x[span:] - x[:-span])[usual], np.diff(x)[rows.follows]
        moved = float(np.sqrt((far**2).mean()))
        if moved == 0 or moved < span**JITTERS * float(np.quantile(np.abs(near), 0.68)):
            continue
        # Simulators differ in which of both velocities moves things.
        ways = (v[:-1], v[1:], (v[:-1] + v[1:]) / 2)
        sums = (np.concatenate([[0], np.cumsum(way * np.diff(rows.time) * rows.follows)]) for way in ways)
        paths = [(path[span:] - path[:-span])[usual] for path in sums]
        logged = max(paths, key=lambda path: abs(float((far * path).sum())) / max(float(np.linalg.norm(path)), 1e-12))
        ratio = float((far * logged).sum() / (far**2).sum())
        if not 0.67 < ratio < 1.5:
            perhaps = ", or whether it is in degrees (--project utm)" if ratio > DEGREE / 2 else ""
            yield f"v{axis} is {ratio:.3g} times what {axis} changes by: check its unit, sign, axis and frame{perhaps}"


def _jumps(rows: Rows, values: Values, schema: TableSchema) -> Iterator[str]:
    speed = _speeds(rows, values, schema)
    if schema.velocity:
        limit = 5 * max(float(np.linalg.norm(values.stacked(schema.velocity), axis=1).max()), 1e-9)
        what = "five times as fast as any velocity says"
    else:
        limit = 10 * max(float(np.quantile(speed[rows.follows], 0.99)), 1e-9)
        what = "ten times as fast as 99 % of the rows"
    jumps = np.flatnonzero(speed > limit)
    if jumps.size and jumps.size < FEW_MOVED * len(speed):
        yield (
            f"row {int(rows.order[jumps[0] + 1])} and {jumps.size - 1} others moved more than {what}: positions jump "
            f"there, or no column tells recordings apart; --max-speed {limit:.3g} drops such rows"
        )


# --- two parts: to learn by and to judge by ---
def parted(rows: Rows, values: Values, share: float) -> tuple[Rows, Values]:
    """The rows with each part as recordings of its own, those of the first `share` of the rows in front, so that no
    episode is of both. Recordings whose times overlap count from a start of their own: these stay whole and are parted
    in the order of the table."""
    if not (isinstance(share, int | float) and 0 < share < 1):
        raise UserError(f"split={share!r:.60} must be a number between 0 and 1: the share of the time to learn by.")
    late = _late_recordings(rows, share) if _overlap(rows) else rows.time > np.quantile(rows.time, share)
    if late.all() or not late.any():
        raise StoreError(
            f"split={share:g} leaves one part without rows: the recordings count their own times, and there is one "
            "that holds most rows; give another share."
        )
    recording = rows.recording + late * (rows.recording.max() + 1)
    order = np.lexsort((np.arange(len(late)), rows.agent, recording))
    part = replace(rows.chosen(order), recording=recording[order])
    return part, values.chosen(order)


def _overlap(rows: Rows) -> bool:
    """Whether some recording begins before the one that began before it has ended."""
    begins = np.full(rows.recording.max() + 1, np.inf)
    ends = np.full(len(begins), -np.inf)
    np.minimum.at(begins, rows.recording, rows.time)
    np.maximum.at(ends, rows.recording, rows.time)
    order = np.argsort(begins, kind="stable")
    return bool((begins[order][1:] < ends[order][:-1]).any())


def _late_recordings(rows: Rows, share: float) -> np.ndarray:
    """(M,) whether a row's recording ends after the first `share` of the rows, recordings in the order of the table."""
    count = np.bincount(rows.recording)
    first = np.full(len(count), len(rows.order))
    np.minimum.at(first, rows.recording, rows.order)
    order = np.argsort(first, kind="stable")
    before = np.empty(len(count))
    before[order] = np.cumsum(count[order])
    return (before > share * len(rows.order) + 0.5)[rows.recording]


# --- units ---
def in_metres(columns: Columns, schema: TableSchema) -> tuple[Columns, list[str]]:
    """The columns in SI units, as the schema's `scale` and `project` say, and what was made of degrees."""
    for name, factor in schema.scale.items():
        if name not in schema.numbers:
            raise unknown("column of numbers", name, schema.numbers)
        if _plain(name) in ANGLES and _in_degrees(name) and abs(factor / np.deg2rad(1.0) - 1) < 0.01:
            raise UserError(f"{name} is made radians of by its name; leave its scale={factor:.6g} out.")
    columns = columns | {name: _times(columns, name, factor) for name, factor in schema.scale.items()}
    if schema.project != "utm":
        return columns, []
    pairs = [("x", "y"), schema.goal[:2]] if schema.goal else [("x", "y")]
    degrees = [[numbers(columns, name) for name in pair] for pair in pairs]
    for pair, values in zip(pairs, degrees):
        for name, value, largest in zip(pair, values, (180.0, POLES)):
            _require_degrees(name, value, largest)
    zone, north = zone_of(*degrees[0])
    for pair, values in zip(pairs, degrees):
        columns |= dict(zip(pair, utm(values[0], values[1], zone, north)))
    return columns, [f"degrees of longitude and latitude are metres of UTM zone {zone}{'N' if north else 'S'}"]


def _times(columns: Columns, name: str, factor: float) -> np.ndarray:
    """A column times a factor; what is missing in it stays so, for whoever reads it to judge."""
    column = columns[name]
    return (column if column.dtype.kind in "iuf" else numbers(columns, name)) * factor


def _require_degrees(name: str, value: np.ndarray, largest: float) -> None:
    beyond = np.abs(value) > largest
    if beyond.any():
        row = int(np.flatnonzero(beyond)[0])
        raise StoreError(
            f"row {row}: {name} is {value[row]:.10g}, and degrees of UTM are within {largest:g}; scale it to degrees "
            f"(--scale {name}=1e-7 of tenths of a millionth), drop the row, or see that x is the longitude."
        )


def zone_of(longitude: np.ndarray, latitude: np.ndarray) -> tuple[int, bool]:
    """The UTM zone in which places lie in the mean, 1 to 60, and whether it is of the north."""
    mean = float(np.rad2deg(np.angle(np.exp(1j * np.deg2rad(longitude)).mean())))
    zone = int((mean + 180) // 6) % 60 + 1
    far = np.abs((longitude - _middle(zone) + 180) % 360 - 180)
    if far.max() > REACH:
        row = int(np.flatnonzero(far > REACH)[0])
        raise StoreError(
            f"row {row}: the longitude {longitude[row]:.6g} is {far[row]:.3g} degrees from the middle of UTM zone "
            f"{zone}, where most rows are, and UTM is true within {REACH:g}; import one region at a time."
        )
    return zone, bool(np.median(latitude) >= 0)


def utm(longitude: np.ndarray, latitude: np.ndarray, zone: int, north: bool) -> tuple[np.ndarray, np.ndarray]:
    """Easting and northing (m) of degrees in a UTM zone."""
    sine = np.sin(np.deg2rad(latitude))
    around = np.deg2rad(longitude - _middle(zone))
    bend = 2 * np.sqrt(N) / (1 + N)
    t = np.sinh(np.arctanh(sine) - bend * np.arctanh(bend * sine))
    xi, eta = np.arctan2(t, np.cos(around)), np.arctanh(np.sin(around) / np.hypot(1, t))
    x, y = eta.copy(), xi.copy()
    for k, a in enumerate(SERIES, 1):
        x += a * np.cos(2 * k * xi) * np.sinh(2 * k * eta)
        y += a * np.sin(2 * k * xi) * np.cosh(2 * k * eta)
    return EASTING + SCALE * MERIDIAN * x, (0.0 if north else NORTHING) + SCALE * MERIDIAN * y


def _middle(zone: int) -> float:
    """Degrees of longitude of a zone's middle."""
    return 6.0 * zone - 183.0


# --- angles ---
def refuse_turns(rows: Rows, values: Values, schema: TableSchema) -> None:
    """Refuse entries that jump by whole turns, as angles do that no name tells: halfway between two rows there would
    be half a turn."""
    for name in schema.state:
        if name in (*schema.position, *schema.velocity):
            continue
        value = values.columns[name]
        change = np.abs(np.diff(value))[rows.follows]
        for turn, unit in TURNS.items():
            jumps = change > (1 - APART) * turn
            if not jumps.any() or (jumps != (change > APART * turn)).any() or np.ptp(value) > turn * (1 + 1e-6):
                continue
            before = np.flatnonzero(rows.follows)[jumps]
            if not np.minimum(np.abs(value[before]), np.abs(value[before + 1])).any():
                continue  # a reading that is 0 now and then
            k = before[0]
            raise StoreError(
                f"row {int(rows.order[k + 1])}: {name} jumps from {value[k]:.4g} to {value[k + 1]:.4g}, a turn, so it "
                f"is an angle; call it heading{unit} if it says where one looks (--rename {name}=heading{unit}), else "
                f"course{unit} or bearing{unit}, of which cosine and sine are made."
            )


def without_angles(columns: Columns, schema: TableSchema) -> tuple[Columns, TableSchema, list[str]]:
    """The columns and the schema with `cos_yaw` and `sin_yaw` instead of `yaw`, and a note. Angles are known by their
    names; they are in radians, `compass` and what ends in `_deg` in degrees."""
    angles = [name for name in schema.state if _plain(name) in ANGLES]
    if not angles:
        return columns, schema, []
    found = dict(columns)
    for name in angles:
        angle = _radians(columns, name)
        found |= {f"cos_{name}": np.cos(angle), f"sin_{name}": np.sin(angle)}
    state: list[str] = []
    for name in schema.state:
        state += [f"cos_{name}", f"sin_{name}"] if name in angles else [name]
    note = f"angles are observed as cosine and sine, since they jump by a turn: {', '.join(angles)}"
    return found, replace(schema, state=tuple(state)), [note]


def angle_of(name: str, value: np.ndarray) -> np.ndarray:
    """Radians of an angle of that name."""
    return np.deg2rad(value) if _in_degrees(name) else value


def _radians(columns: Columns, name: str) -> np.ndarray:
    value = numbers(columns, name)
    largest = float(np.abs(value).max())
    if not _in_degrees(name) and not name.endswith(RADIANS) and largest > TURN:
        raise StoreError(
            f"{name} reaches {largest:.4g}: if it is in degrees, call it {name}_deg (--rename {name}={name}_deg), "
            f"if it counts turns in radians, {name}_rad."
        )
    return angle_of(name, value)


def _in_degrees(name: str) -> bool:
    return name.endswith(DEGREES) or _plain(name) == "compass"


def _plain(name: str) -> str:
    """The last word of a dotted name, without its unit."""
    word = name.rpartition(".")[2].lower()
    for unit in (*DEGREES, *RADIANS):
        word = word.removesuffix(unit)
    return word
