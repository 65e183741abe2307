"""Tables of logs, a row per agent and time, as an episode store: data frames, CSV and Parquet files, dictionaries of
arrays.

What agents see is made of the columns of their state: their own entries (`own.x`), where the goal is (`goal.dx`), and
where others are and how they move relative to them (`other0.dx`, `other0.dvx`), named so that a World knows what
follows from what (docs/data.md).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.errors import StoreError, UserError, unknown, whole_number
from ringfence.logs.io.tracks import Tracks, cut, nearest, resample, teams
from ringfence.problem.constraints import CostColumn, Hazard, Separation
from ringfence.problem.features import others
from ringfence.utils import stored

AXES = "xyz"
GAP = 5.0  # steps without a row that end an episode
LONG = 5.0  # s, a step that hardly any controller has
Table = Mapping[str, Any] | str | Path | Any  # or a data frame that narwhals reads
# Options as 0.1.0 called them.
OLD_OPTIONS = {
    "longest": "max_episode_steps",
    "shortest": "min_episode_steps",
    "fastest": "max_speed",
    "sight": "sensing_radius",
}


@dataclass(frozen=True)
class Layout:
    """Which columns of a published format are what."""

    columns: dict[str, str]  # ours: theirs
    time_unit: float  # s
    state: tuple[str, ...] = ("x", "y", "vx", "vy")
    action: tuple[str, ...] = ()
    corner: tuple[str, str] | None = None  # x, y are of a box's corner, whose sides these columns are


LAYOUTS = {
    # highD (Krajewski et al. 2018), xx_tracks.csv: 25 frames a second, x and y of the box's upper left corner.
    "highd": Layout(
        {"time": "frame", "agent": "id", "vx": "xVelocity", "vy": "yVelocity", "ax": "xAcceleration"}
        | {"ay": "yAcceleration"},
        1 / 25,
        action=("ax", "ay"),
        corner=("width", "height"),
    ),
    # INTERACTION (Zhan et al. 2019), vehicle_tracks_xxx.csv.
    "interaction": Layout({"time": "timestamp_ms", "agent": "track_id"}, 1e-3),
}


def read_table(
    table: Table,
    *,
    time: str,
    agent: str,
    state: Sequence[str],
    episode: str | None = None,
    action: Sequence[str] = (),
    reward: str | None = None,
    cost: str | Sequence[str] | None = None,
    goal: Sequence[str] = (),
    dt: float | None = None,
    gap: float | None = None,
    team: int | None = None,
    neighbours: int | None = None,
    sensing_radius: float | None = None,
    min_episode_steps: int = 5,
    max_episode_steps: int | None = None,
    max_speed: float = 100.0,
    danger: Hazard | None = None,
    notes: Sequence[str] = (),
    card: dict | None = None,
) -> dict[str, Any]:
    """What `EpisodeStore.from_steps` takes, of a table with a row per agent and time, in any order of agents; each
    agent's times increase.

    `state`: columns of an agent's state, in SI units. Those named x, y, z are where it is and vx, vy, vz how fast it
    moves in the same axes; velocities that are not there are the differences of positions. `action`: its command at
    that time, which it followed until its next row; without any, actions are its accelerations. `reward` and `cost`
    are what came since its row before; without `reward`, it is the progress to the `goal` (columns of its x, y), in m,
    or 0; without `cost` it follows from `danger`, a `Separation`, or is 0. Several columns of costs are constraints of
    these names, whose limits per episode the `card`'s `constraints` holds (0 by default).

    Rows are put on steps of `dt` s (by default the table's own): states are interpolated, actions held. An agent that
    is silent for more than `gap` s (five steps) was away. Agents come and go: an episode is a time in which the same
    `team` of them is there (by default of the size with most rows), or with `neighbours`=k the whole track of one
    agent, who sees the k nearest others within `sensing_radius` m; such agents are homogeneous, and a policy plays any
    number of them. Episodes have `min_episode_steps` to `max_episode_steps` steps. `max_speed` m/s is more than
    anything there can do.

    The card's warnings say what was taken for what, and what was left out, after the `notes` of whoever read the
    table. `StoreError` names the first row that cannot be (counted from 0, without a header).
    """
    position, speed = ([f"{v}{c}" for c in AXES if f"{v}{c}" in state] for v in ("", "v"))
    cost = [cost] if isinstance(cost, str) else list(cost or ())
    for name, given in (("state", state), ("action", action), ("goal", goal), ("cost", cost)):
        if isinstance(given, str):
            raise UserError(f"{name}='{given}' is one word; give a list of columns.")
        if twice := [c for c in given if list(given).count(c) > 1]:
            raise UserError(f"{name} names the column '{twice[0]}' twice; name it once.")
    _check_sizes(team, neighbours, min_episode_steps, max_episode_steps)
    for name, value in (("dt", dt), ("gap", gap), ("sensing_radius", sensing_radius), ("max_speed", max_speed)):
        if value is not None and not (isinstance(value, int | float) and 0 < value < np.inf):
            raise UserError(f"{name}={value!r} must be a number above 0.")
    if not state:
        raise UserError("state names no column; name those that say where an agent is and how it moves.")
    if goal and len(goal) != len(position):
        raise UserError(
            f"goal names {len(goal)} columns, the position has {len(position)}; state must hold as many of x, y, z, "
            "under these names."
        )
    if (neighbours is not None or danger is not None) and len(position) < 2:
        raise UserError("state holds no x and y, which neighbours and distances follow from; rename these columns.")
    if not isinstance(danger, Separation | None):
        raise UserError(f"danger={type(danger).__name__} is not read from a table; give a Separation or a cost column.")
    wanted = [time, agent, *state, *action, *goal, *cost, *(c for c in (episode, reward) if c)]
    read = _columns(table, wanted)
    rows = _sorted(read, time, agent, episode)
    notes = list(notes)
    values = {name: _numbers(read, name)[rows.order] for name in (*state, *action, *goal)}
    zero = np.zeros(len(rows.time))
    earned = _numbers(read, reward)[rows.order] if reward else zero
    charged = np.stack([_numbers(read, c)[rows.order] for c in cost] or [zero], 1)
    _check_units(values, rows, position, speed, max_speed, notes)
    step = dt or float(f"{rows.step:.6g}")
    gap = gap or GAP * max(step, rows.step)
    if gap < rows.step:
        raise UserError(
            f"gap={gap:g} is less than the {rows.step:g} s between an agent's rows; every row would be cut off."
        )
    if step >= LONG:
        notes.append(f"a step is {step:g} s: if times are in ms or µs, scale them to seconds")
    if cost and danger is not None:
        raise UserError("cost and danger both say what a step costs; give one of them.")
    clock = (
        rows.time
        - np.minimum.reduceat(rows.time, np.flatnonzero(np.diff(rows.recording, prepend=-1)))[
            np.unique(rows.recording, return_inverse=True)[1]
        ]
    ) / step
    off = np.abs(clock - np.round(clock))
    if dt is None and (far := float(np.quantile(off, 0.99))) > 0.01:
        notes.append(
            f"rows are up to {far:.2g} of a step of {step:g} s off the clock: states are interpolated, actions, costs "
            "and rewards are those nearest to a step"
        )
    if action and (big := max(np.abs(values[c]).max() for c in action)) > 10 * (
        usual := max(np.quantile(np.abs(values[c]), 0.99) for c in action)
    ):
        notes.append(
            f"the largest action is {big:.4g}, 99 % are below {usual:.4g}: all are learned in units of the largest"
        )
    if len(position) < 2:
        notes.append("state holds no x and y, so nobody sees where others are relative to oneself")
    states = np.stack([values[c] for c in (*state, *goal)], 1)
    acts = np.stack([values[c] for c in action], 1) if action else np.zeros((len(rows.time), 1))
    tracks = resample(rows.recording, rows.agent, rows.time, states, acts, earned, charged, step, gap or GAP * step)
    made = _Made(tracks, tuple(state), tuple(position), tuple(speed), bool(goal), notes, rows.agents)
    if not action and not made.axes:
        raise UserError(
            "action names no column, and state holds no x or vx to tell accelerations by; name the actions."
        )
    if danger is not None and not cost:
        notes.append(f"costs follow from centres closer than {danger.radius:g} m")
    if not cost and danger is None:
        notes.append("no cost was given: nothing says what is dangerous; name a column, or give a Separation")
    if not reward:
        what = "rewards are the progress to the goal, in m" if goal else "no reward was given: it is 0 everywhere"
        notes.append(what)
    if not action:
        notes.append("actions are accelerations, differences of velocities")
    if neighbours is None:
        arrays = _team(made, danger, bool(cost), min_episode_steps, max_episode_steps, team)
    else:
        arrays = _neighbourly(
            made, danger, bool(cost), min_episode_steps, max_episode_steps, neighbours, sensing_radius or np.inf
        )
    acts = arrays.pop("held") if action else made.accelerations(arrays["rows"])
    return _steps(made, arrays, acts, bool(reward), cost, danger, neighbours is not None, card or {})


def read_layout(table: Table, layout: str, **options) -> dict[str, Any]:
    """The same of a table in a published format (`LAYOUTS`); options as of `read_table`."""
    if layout not in LAYOUTS:
        raise unknown("layout", layout, LAYOUTS)
    of, cost = LAYOUTS[layout], options.get("cost") or ()
    cost = [cost] if isinstance(cost, str) else cost
    theirs = {c: of.columns.get(c, c) for c in ("time", "agent", *of.state, *of.action)}
    read = _columns(table, [*theirs.values(), *(of.corner or ()), *cost])
    columns = read | {ours: read[name] for ours, name in theirs.items()}
    columns["time"] = _numbers(read, theirs["time"]) * of.time_unit
    for c, side in zip("xy", of.corner or ()):
        columns[c] = _numbers(columns, c) + _numbers(read, side) / 2
    return read_table(columns, time="time", agent="agent", state=of.state, action=of.action, **options)


def observe(card: dict, state: Mapping[str, Any], goal: Mapping[str, Any] | None = None) -> np.ndarray:
    """(N, O) what agents observe now, as in the store of a table with this `card`: for a policy at run time.

    `state` holds (N,) of every column of the table's state (velocities, too, if the import had to make them), and
    `goal` those of x, y, z: where each agent is to go. Agents stand in the order of the table's names; of agents who
    are homogeneous, any number in any order.
    """
    card = stored.card(card)
    names = card.get("observation_names") or ()
    columns = {name: np.asarray(x, np.float64) for name, x in state.items()}
    aims = {name: np.asarray(x, np.float64) for name, x in (goal or {}).items()}
    sizes = {x.shape for x in (*columns.values(), *aims.values())}
    if len(sizes) != 1 or len(next(iter(sizes))) != 1:
        raise UserError(f"state and goal hold arrays of shapes {sorted(sizes)}; give one number per agent of each.")
    (n,) = next(iter(sizes))
    axes = [c for c in AXES if c in columns]
    slots = 1 + max((int(m[1]) for name in names if (m := re.match(r"other(\d+)\.", name))), default=-1)
    near = others(n)
    there = np.ones((n, slots), bool)
    reach = float(card.get("sensing_radius", np.inf))
    if card.get("homogeneous"):
        zero = np.zeros(n, int)
        place = np.stack([columns[c] for c in axes], 1)
        now = Tracks(zero, np.arange(n), np.arange(n), zero, place, place, zero, zero, card.get("dt", 1.0))
        near = nearest(now, place, slots, reach)
        there = near >= 0
    elif n != slots + 1:
        raise UserError(f"state tells of {n} agents, the logs of {slots + 1}; give all of them.")

    def entry(name: str) -> np.ndarray:
        whose, _, what = name.partition(".")
        plain = what[1:] if what[:1] == "d" and what[1:] in columns else what
        if whose == "goal" and plain in aims:
            return aims[plain] - columns[plain]
        if whose == "own" and what in columns:
            return columns[what]
        if whose.startswith("other"):
            j = int(whose[5:])
            if what == "seen":
                return there[:, j].astype(float)
            if plain in columns:
                theirs = columns[plain][near[:, j]] - columns[plain] * (plain != what)
                return np.where(there[:, j], theirs, reach if plain == axes[0] else 0.0)
        raise UserError(f"The logs observe '{name}', which state and goal do not tell; add it.")

    return np.stack([entry(name) for name in names], 1).astype(np.float32)


def _check_sizes(team, neighbours, min_episode_steps, max_episode_steps) -> None:
    if team is not None and neighbours is not None:
        raise UserError("team and neighbours both say who an episode is of; give one of them.")
    for name, value in (("team", team), ("neighbours", neighbours), ("max_episode_steps", max_episode_steps)):
        if value is not None:
            whole_number(name, value, 1, 10**6)
    whole_number("min_episode_steps", min_episode_steps, 1)
    if max_episode_steps is not None and max_episode_steps < min_episode_steps:
        raise UserError(
            f"max_episode_steps={max_episode_steps} is less than min_episode_steps={min_episode_steps}; give a smaller "
            "min_episode_steps, too."
        )


# --- reading ---
def _columns(table: Table, wanted: Iterable[str]) -> dict[str, np.ndarray]:
    """The named columns, whatever the table is; one that is absent is refused with the nearest name."""
    wanted = list(dict.fromkeys(wanted))
    if isinstance(table, str | Path):
        table = _file(Path(table), wanted)
    if isinstance(table, Mapping):
        names, get = list(table), table.__getitem__
    else:
        narwhals = _needs("narwhals")
        try:
            frame = narwhals.from_native(table, eager_only=True)
        except TypeError:
            raise StoreError(
                f"The table is a {type(table).__name__}; give a data frame (pandas, polars, pyarrow), a dictionary of "
                "columns, or a .csv or .parquet file."
            ) from None
        names, get = frame.columns, lambda name: frame[name].to_numpy()
    for name in wanted:
        if name not in names:
            raise unknown("column of the table", name, names)
    found = {name: np.asarray(get(name)) for name in wanted}
    sizes = {len(x) if x.ndim == 1 else -1 for x in found.values()}
    if len(sizes) != 1 or not sizes - {-1, 0}:
        shapes = ", ".join(f"{name} {x.shape}" for name, x in found.items())
        raise StoreError(f"The columns are not of one length above 0 ({shapes}); give one entry per row.")
    return found


def _needs(module: str):
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError:
        raise UserError(
            f"Tables are read by {module.partition('.')[0]}; install it with pip install 'ringfence[tables]'."
        ) from None


def _file(path: Path, wanted: list[str]) -> dict[str, np.ndarray]:
    """Columns of a CSV or Parquet file."""
    if not path.is_file():
        raise StoreError(f"'{path}' is no file; give a .csv or .parquet file.")
    kind = path.suffix.lower()
    if kind not in (".csv", ".parquet", ".pq"):
        raise StoreError(f"'{path}' ends in '{kind}'; give a .csv or .parquet file.")
    _needs("pyarrow")
    import pyarrow as pa
    from pyarrow import csv, parquet

    try:
        if kind == ".csv":
            with path.open(encoding="utf-8-sig", errors="replace") as file:
                head = file.readline(2**20)
            between = max(",;\t|", key=head.count)  # the first of those that separate as often
            table = csv.read_csv(path, parse_options=csv.ParseOptions(delimiter=between))
        else:
            with parquet.ParquetFile(path) as file:
                there = set(file.schema_arrow.names)
                size = sum(file.metadata.row_group(k).total_byte_size for k in range(file.metadata.num_row_groups))
                if size > 100 * path.stat().st_size + 2**28:
                    raise StoreError(f"'{path}' claims {size / 2**20:.0f} MiB and holds far less; write it again.")
                table = file.read([c for c in wanted if c in there]) if set(wanted) <= there else file.read()
    except (pa.ArrowException, OSError) as error:
        raise StoreError(f"'{path}' is no table that can be read ({str(error).splitlines()[0]}).") from None
    if twice := [name for name in table.column_names if table.column_names.count(name) > 1]:
        raise StoreError(f"'{path}' has the column '{twice[0]}' twice, or no header; give every column its own name.")
    return {name: table.column(name).to_numpy() for name in table.column_names}


def _numbers(columns: dict[str, np.ndarray], name: str) -> np.ndarray:
    """A column as float64; the first entry that is no finite number is refused by its row."""
    column = columns[name]
    if column.dtype.kind == "M":
        return (column - column.min()) / np.timedelta64(1, "s")
    if column.dtype.kind == "m":
        return column / np.timedelta64(1, "s")
    try:
        numbers = column.astype(np.float64)
    except (TypeError, ValueError):
        row = next((k for k, x in enumerate(column) if not _is_number(x)), 0)
        raise StoreError(f"row {row}: {name} is {str(column[row])[:40]!r}, no number; repair or drop it.") from None
    if not np.isfinite(numbers).all():
        row = int(np.flatnonzero(~np.isfinite(numbers))[0])
        many = int((~np.isfinite(numbers)).sum())
        raise StoreError(
            f"row {row}: {name} is {numbers[row]} ({many} such rows); fill it, or drop the rows (a hole of more than "
            "the gap ends an episode)."
        )
    return numbers


def _is_number(x) -> bool:
    try:
        float(x)
    except (TypeError, ValueError):
        return False
    return True


@dataclass(frozen=True)
class _Rows:
    """Sorted by recording, agent and time."""

    order: np.ndarray  # (M,) rows of the table
    recording: np.ndarray  # (M,)
    agent: np.ndarray  # (M,)
    time: np.ndarray  # (M,) s
    step: float  # s, between rows of an agent, in the median
    agents: np.ndarray  # names, by number


def _sorted(read: dict[str, np.ndarray], time: str, agent: str, episode: str | None) -> _Rows:
    clock = _numbers(read, time)
    agents, who = np.unique(_words(read, agent), return_inverse=True)
    run = np.zeros(len(clock), int) if episode is None else np.unique(_words(read, episode), return_inverse=True)[1]
    order = np.lexsort((np.arange(len(clock)), who, run))  # an agent's rows in the order of the table
    recording, owner, clock = run[order], who[order], clock[order]
    same = (np.diff(recording) == 0) & (np.diff(owner) == 0)
    passed = np.diff(clock)
    for bad, what in ((same & (passed < 0), "is earlier than"), (same & (passed == 0), "is the time of")):
        if bad.any():
            k = int(np.flatnonzero(bad)[np.argmin(order[1:][bad])])
            row, before = int(order[k + 1]), int(order[k])
            raise StoreError(
                f"row {row}: {time}={clock[k + 1]:.10g} {what} row {before} of the same agent "
                f"({agent}={read[agent][row]}); "
                + ("sort each agent's rows by time" if "earlier" in what else "keep one row per agent and time")
                + (", or name the column that tells episodes apart." if episode is None else ".")
            )
    if not same.any():
        raise StoreError(f"No agent has two rows; check that {agent} tells agents and {time} their times.")
    return _Rows(order, recording, owner, clock, float(np.median(passed[same])), agents)


def _words(read: dict[str, np.ndarray], name: str) -> np.ndarray:
    column = read[name]
    if column.dtype.kind == "f" and not np.isfinite(column).all():
        raise StoreError(f"row {int(np.flatnonzero(~np.isfinite(column))[0])}: {name} is missing; fill or drop it.")
    if column.dtype.kind == "O":
        if missing := [k for k, x in enumerate(column) if x is None or x != x]:
            raise StoreError(f"row {missing[0]}: {name} is missing; fill or drop it.")
        other = next((k for k, x in enumerate(column) if isinstance(x, bytes) and not _is_text(x)), None)
        if other is not None:
            raise StoreError(f"row {other}: {name} is {column[other][:40]!r}, no text in UTF-8; write it anew in that.")
        return np.array([x.decode() if isinstance(x, bytes) else str(x) for x in column])
    return column


def _is_text(x: bytes) -> bool:
    try:
        x.decode()
    except UnicodeDecodeError:
        return False
    return True


def _check_units(
    values, rows: _Rows, position: list[str], speed: list[str], max_speed: float, notes: list[str]
) -> None:
    """Refuse rows that nothing can lie apart by, and say where velocities are not those of the positions."""
    if not position:
        return
    place = np.stack([values[c] for c in position], 1)
    same = (np.diff(rows.recording) == 0) & (np.diff(rows.agent) == 0)
    passed = np.where(same, np.diff(rows.time), np.inf)
    moved = np.diff(place, axis=0) / passed[:, None]
    fast = np.linalg.norm(moved, axis=1)
    if (fast > max_speed).any():
        k = int(np.flatnonzero(fast > max_speed)[np.argmin(rows.order[1:][fast > max_speed])])
        raise StoreError(
            f"row {int(rows.order[k + 1])}: {', '.join(position)} moved at {fast[k]:.4g} m/s since row "
            f"{int(rows.order[k])} of the same agent, more than max_speed={max_speed:g}; check the units of positions "
            "(m) and times (s), or drop the row."
        )
    usual = same & (fast <= np.quantile(fast[same], 0.99))  # a row that jumped says nothing of the others
    for k, c in enumerate(position):
        if f"v{c}" not in speed:
            continue
        real, v = moved[usual, k], values[f"v{c}"]
        ends = v[:-1][usual], v[1:][usual], (v[:-1] + v[1:])[usual] / 2  # simulators differ in which one moves things
        logged = max(ends, key=lambda u: abs(float((real * u).sum())) / max(float(np.linalg.norm(u)), 1e-12))
        ratio = float((real * logged).sum() / max((real**2).sum(), 1e-12))
        if (real != 0).any() and not 0.67 < ratio < 1.5:
            notes.append(f"v{c} is {ratio:.3g} times what {c} changes by: check its unit, sign, axis and frame")
    if speed:
        most = max(float(np.linalg.norm(np.stack([values[c] for c in speed], 1), axis=1).max()), 1e-9)
        if (jumps := np.flatnonzero(fast > 5 * most)).size and jumps.size < 0.01 * len(fast):
            notes.append(
                f"row {int(rows.order[jumps[0] + 1])} and {jumps.size - 1} others moved more than five times as fast "
                "as any velocity says: positions jump there, or no column tells recordings apart"
            )


# --- making ---
@dataclass(frozen=True)
class _Made:
    """Tracks and what their columns are."""

    tracks: Tracks
    state: tuple[str, ...]
    position: tuple[str, ...]
    speed: tuple[str, ...]
    goal: bool
    notes: list[str]
    agents: np.ndarray  # their names

    @property
    def axes(self) -> list[str]:
        """Those that agents move along, by position or velocity."""
        return [c for c in AXES if c in self.position or f"v{c}" in self.speed]

    def column(self, name: str) -> np.ndarray:
        return self.tracks.state[:, self.state.index(name)]

    def place(self) -> np.ndarray:
        """(R, axes of the position) m."""
        return np.stack([self.column(c) for c in self.position], 1)

    def moving(self) -> np.ndarray:
        """(R, axes) m/s: logged, or by how much positions change from the row before (from the first to the next)."""
        t, out = self.tracks, []
        fresh = np.ones(len(t.step), bool)
        fresh[1:] = t.segment[1:] != t.segment[:-1]
        for c in self.axes:
            if f"v{c}" in self.speed:
                out.append(self.column(f"v{c}"))
                continue
            change = np.diff(self.column(c), prepend=self.column(c)[:1]) / t.dt
            later = np.append(change[1:], 0.0)
            alone = fresh & np.append(fresh[1:], True)
            out.append(np.where(alone, 0.0, np.where(fresh, later, change)))
        return np.stack(out, 1)

    def accelerations(self, rows: np.ndarray) -> np.ndarray:
        """(W, N, axes) m/s², of windows' rows; what follows the last row of a window is nobody's."""
        v = self.moving()[rows]
        return np.diff(v, axis=0, append=v[-1:]) / self.tracks.dt

    def towards_goal(self) -> np.ndarray:
        """(R, axes of the position) m."""
        return self.tracks.state[:, len(self.state) :] - self.place()


def _team(
    made: _Made,
    danger: Separation | None,
    has_cost: bool,
    min_episode_steps: int,
    max_episode_steps: int | None,
    size: int | None,
):
    """Episodes of a constant team: rows (W, N), their lengths and what everybody sees."""
    t = made.tracks
    rows, many, n = teams(t, size)
    index, many = cut(many, min_episode_steps, max_episode_steps)
    if not len(many):
        here = np.unique(t.agent).size
        raise StoreError(
            f"No {n} agents are together for {min_episode_steps} steps of {t.dt:g} s (the table has {here}); give "
            "another team, a smaller min_episode_steps, a longer gap, or neighbours."
        )
    kept = rows[index]
    share = 1 - len(np.unique(kept)) / len(t.step)
    if share > 0.001:
        made.notes.append(f"{100 * share:.1f} % of the rows are left out: other than {n} agents, or too short a time")
    lost = sorted(set(np.unique(t.agent)) - set(np.unique(t.agent[kept])))
    if lost:
        named = ", ".join(str(made.agents[k]) for k in lost[:5]) + (", ..." if len(lost) > 5 else "")
        made.notes.append(f"agents that are in no episode, so that nobody will see them: {named}")
    moving = made.moving() if made.axes else np.zeros((len(t.step), 0))
    names, parts = _own(made, moving, with_place=True)
    own = np.concatenate(parts, 1)[kept]
    seen = [own]
    whose = others(n)
    columns = [(f"d{c}", made.column(c)) for c in made.position]
    columns += [(f"dv{c}", moving[:, k]) for k, c in enumerate(made.axes)]
    columns += [(c, made.column(c)) for c in made.state if c not in (*made.position, *made.speed)]
    for j in range(n - 1):
        for name, column in columns:
            relative = name in [f"d{v}{c}" for v in ("", "v") for c in AXES]
            theirs = column[kept][:, whose[:, j]]
            seen.append((theirs - column[kept] * relative)[..., None])
            names.append(f"other{j}.{name}")
    cost = t.cost[kept]
    if danger is not None and not has_cost:
        place = made.place()[kept]
        far = np.linalg.norm(place[:, None] - place[:, :, None], axis=-1) + 1e9 * np.eye(n)
        cost = (far.min(-1) < danger.radius).astype(float)[..., None]
    return {"rows": kept, "many": many, "seen": np.concatenate(seen, -1), "names": names, "cost": cost,
            "held": t.action[kept]}  # fmt: skip


def _neighbourly(
    made: _Made,
    danger: Separation | None,
    has_cost: bool,
    min_episode_steps: int,
    max_episode_steps: int | None,
    k: int,
    sensing_radius,
):
    """Episodes of one agent each, who sees its k nearest."""
    t = made.tracks
    index, many = cut(np.bincount(t.segment, minlength=t.segment.max() + 1), min_episode_steps, max_episode_steps)
    if not len(many):
        raise StoreError(
            f"No agent is there for {min_episode_steps} steps of {t.dt:g} s; give a smaller min_episode_steps."
        )
    place, moving = made.place(), made.moving()
    near = nearest(t, place, k, sensing_radius)
    there = near >= 0
    offset = np.where(there[..., None], place[near] - place[:, None], 0.0)
    reach = sensing_radius if np.isfinite(sensing_radius) else float(np.linalg.norm(offset, axis=-1).max(initial=1.0))
    offset[~there] = np.eye(place.shape[1])[0] * reach  # nobody is as far as one sees
    drift = np.where(there[..., None], moving[near] - moving[:, None], 0.0)
    names, parts = _own(made, moving, with_place=False)
    for j in range(k):
        parts += [offset[:, j], drift[:, j], there[:, j, None].astype(float)]
        names += [f"other{j}.d{c}" for c in made.position] + [f"other{j}.dv{c}" for c in made.axes]
        names.append(f"other{j}.seen")
    cost = t.cost
    if danger is not None and not has_cost:
        cost = ((np.linalg.norm(offset[:, 0], axis=-1) < danger.radius) * there[:, 0]).astype(float)[:, None]
    rows = index[:, None]
    return {"rows": rows, "many": many, "seen": np.concatenate(parts, 1)[rows], "names": names, "cost": cost[rows],
            "held": t.action[rows], "sensing_radius": reach}  # fmt: skip


def _own(made: _Made, moving: np.ndarray, with_place: bool) -> tuple[list[str], list[np.ndarray]]:
    """Names and columns of what an agent knows of itself and of its goal."""
    names, parts = [f"own.v{c}" for c in made.axes], [moving]
    rest = [c for c in made.state if c not in made.speed and (with_place or c not in made.position)]
    names += [f"own.{c}" for c in rest]
    parts += [made.column(c)[:, None] for c in rest]
    if made.goal:
        names += [f"goal.d{c}" for c in made.position]
        parts.append(made.towards_goal())
    return names, parts


def _steps(
    made: _Made,
    arrays: dict,
    acts: np.ndarray,
    earned: bool,
    named: Sequence[str],
    danger,
    homogeneous: bool,
    card: dict,
) -> dict[str, Any]:
    t, rows, many = made.tracks, arrays["rows"], arrays["many"]
    last = np.cumsum(many) - 1
    steps = np.ones(len(rows), bool)
    steps[last] = False
    arrived = np.ones(len(rows), bool)
    arrived[np.concatenate([[0], last[:-1] + 1])] = False
    reward = t.earned[rows]
    if not earned and made.goal:
        far = np.linalg.norm(made.towards_goal(), axis=1)[rows]
        reward = -np.diff(far, axis=0, prepend=far[:1])
    cost = arrays["cost"][arrived]
    n = rows.shape[1]
    if n > 1 and (cost == cost[:, :1]).all():
        if cost.any():
            made.notes.append("all agents have the same costs: they are taken for the team's")
        cost = cost[:, 0]
    elif n == 1 and not homogeneous:
        cost = cost[:, 0]
    cost = dict(zip(named, np.moveaxis(cost, -1, 0))) if len(named) > 1 else cost[..., 0]
    acts = acts[steps]
    bound = float(np.abs(acts).max(initial=0.0)) or 1.0
    facts = {
        "task": "table",
        "observation_names": arrays["names"],
        "hazard": danger or CostColumn(),
        "dt": t.dt,
        "warnings": made.notes,
        "action_low": -bound,
        "action_high": bound,
    }
    facts |= {"homogeneous": True, "sensing_radius": arrays["sensing_radius"]} if homogeneous else {}
    return {
        "observations": arrays["seen"][steps],
        "actions": acts,
        "rewards": reward[arrived],
        "costs": cost,
        "episode_ends": np.cumsum(many - 1),
        "final_observations": arrays["seen"][last],
        "card": facts | card,
    }
