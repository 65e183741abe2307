"""Tables of logs, a row per agent and time, as an episode store: data frames, files, dictionaries of arrays.

What agents see is made of the columns of their state: their own entries (`own.x`), where the goal is (`goal.dx`), and
where others are and how they move relative to them (`other0.dx`, `other0.dvx`), named so that a World knows what
follows from what (docs/import.md).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.errors import StoreError, UserError, of_kind, one_of
from ringfence.logs.io.columns import (
    Columns,
    Form,
    Table,
    Tables,
    by_entry,
    dates,
    names_of,
    numbers,
    read_columns,
    seconds,
    stacked,
    words,
)
from ringfence.logs.io.episodes import BLOCK, Episodes, Motion, neighbour_episodes, team_episodes
from ringfence.logs.io.lerobot import entry_names
from ringfence.logs.io.rows import (
    Rows,
    Values,
    blurred,
    doubts,
    in_metres,
    parted,
    refuse_jumps,
    refuse_turns,
    sorted_rows,
    values_of,
    without_angles,
    without_jumps,
)
from ringfence.logs.io.table_schema import TableSchema
from ringfence.logs.io.tracks import (
    PASSED_OVER,
    Clock,
    Tracks,
    clock_of,
    off_the_clock,
    on_whole_steps,
    resample,
    unrounded,
)
from ringfence.logs.moving import looked_at, origins_of
from ringfence.problem.constraints import CostColumn

USUAL = 0.999  # of accelerations, that are no outliers
RECORDING = "ringfence.recording"  # column that tells apart what is of several tables
AGENT, COLUMN = "{agent}", "{column}"  # in how wide tables call columns
STANDS_OUT = 2.0  # times that, above which the largest are outliers


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
    # SynDrone-Swarm (Unal 2026), telemetry.csv: multirotors of AirSim, z is down. Its times are the computer's, which
    # the simulator does not keep up with, so that its velocities are 1.5 times what places change by.
    "syndrone": Layout({"time": "Time", "agent": "DroneID", "x": "X", "y": "Y", "z": "Z"}, 1.0, state=("x", "y", "z")),
    # What the readers of these files call time, agent, x, y, vx and vy.
    "sumo": Layout({}, 1.0),
    "obsmat": Layout({}, 1.0),
}


def read_table(
    table: Tables,
    schema: TableSchema,
    *,
    notes: Sequence[str] = (),
    card: Mapping[str, Any] | None = None,
    origins: np.ndarray | None = None,
) -> dict[str, Any]:
    """What an `EpisodeStore` is made of, of a table with a row per agent and time, in any order of agents; each
    agent's times increase. Several tables are recordings of their own: no episode is of two, and rows are counted over
    all of them.

    The card's warnings say what was taken for what, and what was left out, after the `notes` of whoever read the
    table. `card` adds fields to it; its `constraints` holds the limits of several costs (0 by default). `StoreError`
    names the first row that cannot be (counted from 0, without a header).
    """
    return read_parts(table, schema, None, notes=notes, card=card, origins=origins)[0]


def read_parts(
    table: Tables,
    schema: TableSchema,
    share: float | None,
    *,
    notes: Sequence[str] = (),
    card: Mapping[str, Any] | None = None,
    origins: np.ndarray | None = None,
) -> tuple[dict[str, Any], int]:
    """The same, and how many of the episodes are of the first `share` of the time: these come first, and none is of
    both parts. Without a share, all of the time is one part. `origins` (D,) are taken from entries; by default, what
    they tell."""
    of_kind("card", card, Mapping | None, "give a dictionary of its fields")
    of_kind("notes", notes, Sequence, "give a list of sentences")
    columns, schema = _joined([_columns_of(one, schema, whose) for whose, one in _each(table, schema.join)])
    columns, metres = in_metres(columns, schema)
    columns, schema, angles = without_angles(columns, schema)
    rows = sorted_rows(columns, schema)
    twice = len(columns[schema.time]) - len(rows.order)
    repeated = [f"{twice} rows that repeat another are left out"] if twice else []
    values = values_of(columns, rows, schema)
    rows, values, dropped = without_jumps(rows, values, schema)
    refuse_jumps(rows, values, schema)
    refuse_turns(rows, values, schema)
    rows, rounded = unrounded(rows)
    clock = clock_of(rows, schema)
    doubtful = list(doubts(rows, values, clock.dt, schema))
    lost = any(blurred(rows, values))
    recordings = int(rows.recording.max()) + 1
    if share is not None:
        rows, values = parted(rows, values, share)
    rows, drifts = on_whole_steps(rows, clock)
    if schema.dt is None:
        drifts += off_the_clock(rows, clock)
    drifts += _passed_over(rows, values, clock, schema)
    motion = Motion(schema, _on_clock(rows, values, clock, schema), rows.agents)
    episodes = neighbour_episodes(motion) if schema.homogeneous else team_episodes(motion)
    early = motion.tracks.recording[episodes.rows[episodes.last, 0]] < recordings
    warnings = [
        *notes,
        *metres,
        *angles,
        *repeated,
        *dropped,
        *rounded,
        *doubtful,
        *drifts,
        *_made_of(schema),
        *episodes.notes,
    ]
    return _arrays(motion, episodes, warnings, card or {}, lost, origins), int(early.sum())


def read_layout(table: Tables, layout: str, options: Mapping[str, Any]) -> tuple[Columns, TableSchema]:
    """A table in a published format (`LAYOUTS`), or several, as one that `read_table` takes, and its schema; options
    are those of a `TableSchema` beside columns."""
    known = one_of("layout", layout, LAYOUTS)
    join = bool(options.get("join"))
    tables = [_of_layout(one, known, layout, options, whose) for whose, one in _each(table, join)]
    columns, schema = _joined(tables)
    return columns, replace(schema, join=False)


def _of_layout(
    table: Table, known: Layout, layout: str, options: Mapping[str, Any], whose: str
) -> tuple[Columns, TableSchema]:
    names = {"time": "time", "agent": "agent", "state": known.state, "action": known.action}
    for name in names:
        if name in options:
            raise UserError(f"The layout '{layout}' says which columns are what; leave {name} out.")
    schema = TableSchema.of({**names, **options})
    theirs = {name: known.columns.get(name, name) for name in ("time", "agent", *known.state, *known.action)}
    sides = known.corner or ()
    others = [name for name in schema.columns if name not in theirs]
    form = Form(decimal=schema.decimal, texts=(theirs["agent"],))
    read = read_columns(table, [*theirs.values(), *sides, *others], form)
    columns = read | {ours: read[name] for ours, name in theirs.items()}
    columns["time"] = seconds(read, theirs["time"]) * known.time_unit
    for axis, side in zip("xy", sides):
        columns[axis] = numbers(columns, axis) + numbers(read, side) / 2
    if schema.join:
        columns["agent"] = _after_the_table(whose, columns, schema)
    return columns, schema


def _each(table: Tables, join: bool) -> list[tuple[str, Table]]:
    """Tables, of one or several, and what agents are called after where they `join`: as much of the end of paths as
    tells them apart, and the number of what is no file."""
    tables = list(table) if isinstance(table, list | tuple) else [table]
    if not tables:
        raise UserError("The list of tables is empty; give one table, or several.")
    files = [Path(os.path.abspath(one) if isinstance(one, str | Path) else str(k)) for k, one in enumerate(tables)]
    names = [""] * len(files)
    for paths in ([file.with_suffix("") for file in files], files) if join else ():
        for many in range(1, max(len(path.parts) for path in paths) + 1):
            names = [str(Path(*path.parts[-many:])) for path in paths]
            if len({*names}) == len(names):
                return list(zip(names, tables))
    if join:
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(f"'{twice}' is given twice, and its agents would be one; give each table once.")
    return list(zip(names, tables))


def _joined(tables: list[tuple[Columns, TableSchema]]) -> tuple[Columns, TableSchema]:
    """Tables after one another, each a recording of its own."""
    if len(tables) == 1:
        return tables[0]
    first = tables[0][1]
    for k, (_, schema) in enumerate(tables):
        if schema != first:
            raise StoreError(f"Table {k} has other entries in its lists than table 0; give tables of one kind.")
    episodes = []
    for k, (columns, schema) in enumerate(tables):
        own = [""] * len(columns[schema.time]) if schema.episode is None else words(columns, schema.episode)
        episodes.append(np.array([f"{k:06d}/{name}" for name in own], object))
    columns = {name: _one_after_another(name, [columns[name] for columns, _ in tables]) for name in tables[0][0]}
    if first.join:
        return columns, first
    return columns | {RECORDING: np.concatenate(episodes)}, replace(first, episode=RECORDING)


def _one_after_another(name: str, parts: list[np.ndarray]) -> np.ndarray:
    try:
        return np.concatenate(parts)
    except (TypeError, ValueError):  # dates after numbers
        kinds = " and ".join(sorted({str(part.dtype) for part in parts}))
        raise StoreError(f"{name} is {kinds} in tables that are given together; write it in one way.") from None


def _columns_of(table: Table, schema: TableSchema, whose: str) -> tuple[Columns, TableSchema]:
    """The schema's columns of a table under our names, and the schema with the entries of its lists."""
    theirs = {ours: their for their, ours in schema.rename.items()}
    texts = [name for name in (schema.agent, schema.episode, schema.time_format and schema.time) if name]
    form = Form(schema.header, schema.decimal, tuple(theirs.get(name, name) for name in texts))
    if schema.wide is not None:
        columns = _read_wide(table, schema, theirs, form)
    else:
        named = list(schema.columns)
        if schema.join and theirs.get(schema.agent, schema.agent) not in names_of(table, form):
            named.remove(schema.agent)
        read = read_columns(table, [theirs.get(name, name) for name in named], form)
        columns = {name: read[theirs.get(name, name)] for name in named}
    if schema.join:
        columns[schema.agent] = _after_the_table(whose, columns, schema)
    columns[schema.time] = dates(schema.time, columns[schema.time], schema.time_format)
    for name in (schema.time, schema.agent, schema.episode, schema.reward, schema.terminated):
        if name is not None and columns[name].ndim != 1:
            raise StoreError(f"{name} has shape {columns[name].shape}; give one entry per row.")
    names = entry_names(table)
    return _expanded(columns, schema, {name: names.get(theirs.get(name, name)) for name in columns})


def _expanded(
    columns: Columns, schema: TableSchema, names: Mapping[str, Sequence[str] | None]
) -> tuple[Columns, TableSchema]:
    """The columns, and the schema that names entries instead of lists: `names` has those of a column's entries by the
    column's name; entries without names are counted (`action.0`). They may be renamed, too."""
    found = dict(columns)
    fields: dict[str, tuple[str, ...]] = {}
    for field in ("state", "action", "goal", "cost"):
        inner: list[str] = []
        for column in getattr(schema, field):
            rows = stacked(column, columns[column])
            entries = {column: columns[column]}
            if rows is not None:
                lists = by_entry(column, rows, names.get(column))
                entries = {f"{column}.{entry}": values for entry, values in lists.items()}
            entries = {schema.rename.get(name, name): values for name, values in entries.items()}
            found |= entries
            inner += entries
        fields[field] = tuple(inner)
    return found, replace(schema, **fields)


def _after_the_table(whose: str, columns: Columns, schema: TableSchema) -> np.ndarray:
    """(M,) names of the agents of a table that is joined with others."""
    if schema.agent not in columns:
        return np.full(len(columns[schema.time]), whose)
    return np.array([f"{whose}/{name}" for name in words(columns, schema.agent)])


def _passed_over(rows: Rows, values: Values, clock: Clock, schema: TableSchema) -> list[str]:
    """What to say of commands that come between steps which are longer than the rows are apart."""
    if not schema.action or clock.dt < 1.5 * rows.step:
        return []
    other = (np.diff(values.stacked(schema.action), axis=0) != 0).any(1)[rows.follows]
    share = float(other.mean()) if len(other) else 0.0
    said = f"commands change at {100 * share:.0f} % of the rows, every {rows.step:.4g} s; of a step of {clock.dt:.4g} s"
    return [f"{said} the first counts alone"] if share > PASSED_OVER else []


def _on_clock(rows: Rows, values: Values, clock: Clock, schema: TableSchema) -> Tracks:
    """The rows on steps of one length."""
    action = values.stacked(schema.action) if schema.action else np.zeros((len(rows.time), 1))
    return resample(
        rows.recording,
        rows.agent,
        rows.time,
        values.stacked((*schema.state, *schema.goal)),
        action,
        values.reward,
        values.cost,
        rows.ended,
        clock.dt,
        clock.gap,
    )


def _made_of(schema: TableSchema) -> Iterator[str]:
    """What stands for columns that the table lacks, in sentences."""
    if schema.separation is not None:
        yield f"costs follow from centres closer than {schema.separation.radius:g} m"
    elif not schema.cost:
        yield "no cost was given: nothing says what is dangerous; name a column, or give a Separation"
    if not schema.reward:
        yield (
            "rewards are the progress to the goal, in m" if schema.goal else "no reward was given: it is 0 everywhere"
        )
    made = [axis for axis in schema.axes if f"v{axis}" not in schema.velocity]
    if made:
        changes = f"what {', '.join(made)} changed by since the row before, per second"
        yield f"{', '.join(f'v{axis}' for axis in made)}: {changes}; give these to observe()"
    if not schema.action:
        yield "actions are accelerations, differences of velocities"


def _arrays(
    motion: Motion,
    episodes: Episodes,
    warnings: list[str],
    card: Mapping[str, Any],
    lost: bool,
    origins: np.ndarray | None,
) -> dict[str, Any]:
    """What an `EpisodeStore` is made of. What the table has `lost` is not found again by moving it."""
    schema = motion.schema
    warnings = list(warnings)
    costs = episodes.cost[episodes.arrives]
    # the team's where all have the same; one that stands for any number has its own
    if not schema.homogeneous if costs.shape[1] == 1 else (costs == costs[:, :1]).all():
        if costs.shape[1] > 1 and costs.any():
            warnings.append("all agents have the same costs: they are taken for the team's")
        costs = costs[:, 0]
    warnings += _costly_starts(motion, episodes)
    rows = episodes.rows
    actions = (motion.tracks.action[rows] if schema.action else motion.accelerations(rows))[episodes.leaves]
    low, high = _of_commands(actions) if schema.action else _usual(actions)
    warnings += _one_sided(schema.action, low, high, card)
    outliers = int((np.abs(actions) > high).any(-1).sum()) if not schema.action else 0
    if outliers:
        cut = f"{float(np.abs(actions).max()):.4g} m/s² are outliers and cut to {high.max():.4g}"
        warnings.append(f"{outliers} accelerations of up to {cut}, which {100 * USUAL:g} % are within")
        actions = np.clip(actions, low, high)
    facts = {
        "task": "table",
        "observation_names": [entry.name for entry in episodes.entries],
        "hazard": schema.danger or CostColumn(),
        "dt": motion.tracks.dt,
        "warnings": warnings,
        "action_low": low,
        "action_high": high,
    }
    if episodes.agents is not None:
        facts["agents"] = episodes.agents
    if schema.homogeneous:
        facts |= {"homogeneous": True, "sensing_radius": episodes.sensing_radius}
    named = len(schema.cost) > 1
    ends = np.cumsum(episodes.lengths - 1)
    steps = looked_at(ends)
    steps = steps[:: 1 + len(steps) * len(episodes.entries) * rows.shape[1] // BLOCK]
    if origins is not None:
        origins = origins if origins.any() else None
    elif not lost and not card.get("observation_origins"):
        before, after = (episodes.seen(rows[each]) for each in (steps, steps + 1))
        found = origins_of({"observations": (before, after)}, {"observations": facts["observation_names"]})
        origins = found.get("observations")
    return {
        "observations": episodes.observations(np.zeros(len(episodes.entries)) if origins is None else origins),
        "origins": origins,
        "actions": actions,
        "rewards": _rewards(motion, episodes)[episodes.arrives],
        "costs": dict(zip(schema.cost, np.moveaxis(costs, -1, 0))) if named else costs[..., 0],
        "episode_ends": ends,
        "terminated": motion.tracks.ended[rows[episodes.last]].any(1),
        "card": {**facts, **card},
    }


def _costly_starts(motion: Motion, episodes: Episodes) -> Iterator[str]:
    """What costs something on the row that an episode begins with, and is not that which one before ends with."""
    starts = np.flatnonzero(~episodes.arrives)
    own = ~np.isin(episodes.rows[starts, 0], episodes.rows[episodes.last, 0])
    lost = int(episodes.cost[starts[own]].any((1, 2)).sum())
    if motion.schema.cost and lost:
        yield (
            f"{lost} episodes begin with a row that costs something, which no step leads to: that cost is left out (a "
            "longer gap lets an episode go on over a hole)"
        )


def _of_commands(actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (A,) of commands (T, N, A): the largest size, both ways but where every command is to one side of 0; 1
    where there is none. Each entry has its own, since commands are of several kinds: a speed is bounded by speeds and
    not by how fast something turned, and an opening from 0 to 1 is never negative."""
    least, most = actions.min((0, 1), initial=0.0), actions.max((0, 1), initial=0.0)
    largest = np.maximum(-least, most)
    largest = np.where(largest > 0, largest, 1.0)
    return np.where((least < 0) | (most == 0), -largest, 0.0), np.where((most > 0) | (least == 0), largest, 0.0)


def _one_sided(names: Sequence[str], low: np.ndarray, high: np.ndarray, card: Mapping[str, Any]) -> Iterator[str]:
    """Commands that are bounded by 0 because nobody gave any beyond it, and the card does not say how far they go."""
    for word, ends, option in (("negative", low, "low"), ("positive", high, "high")):
        found = [name for name, end in zip(names, ends) if end == 0]
        if found and f"action_{option}" not in card:
            yield (
                f"{', '.join(found)} {'are' if len(found) > 1 else 'is'} never {word} and bounded by 0; give "
                f"--action-{option} (card={{'action_{option}': ...}}) if it can be"
            )


def _usual(actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (1,) of accelerations (T, N, A), the same for all axes and both ways: the largest, unless it stands out.
    Differences of velocities that jitter or jump are far above what anything there can do."""
    sizes = np.abs(actions).reshape(-1, actions.shape[-1])
    largest = float(sizes.max(initial=0.0))
    usual = float(np.quantile(sizes, USUAL, axis=0, method="higher").max()) if len(sizes) else 0.0
    bound = usual if 0 < usual < largest / STANDS_OUT else largest
    found = np.array([bound if bound > 0 else 1.0])
    return -found, found


def _rewards(motion: Motion, episodes: Episodes) -> np.ndarray:
    """(W, N) on arriving in a row: logged, or by how much the goal has come nearer, or 0."""
    if motion.schema.reward or not motion.schema.goal:
        return motion.tracks.earned[episodes.rows]
    distance = np.linalg.norm(motion.to_goal, axis=1)[episodes.rows]
    return -np.diff(distance, axis=0, prepend=distance[:1])


def _read_wide(table: Table, schema: TableSchema, theirs: Mapping[str, str], form: Form) -> Columns:
    """The schema's columns of a table with columns for every agent, agent by agent. A column that no agent has of its
    own is everybody's. Rows in which all of an agent's own columns are missing are left out: it was away. `theirs` are
    names in the table, by ours."""
    assert schema.wide is not None
    shared = {name for name in (schema.time, schema.episode) if name}
    asked = [name for name in schema.columns if name not in shared and name != schema.agent]
    own = _owners(schema.wide, names_of(table, form), {name: theirs.get(name, name) for name in asked})
    agents = list(dict.fromkeys(agent for columns in own.values() for agent in columns))
    if not agents:
        raise UserError(
            f"wide='{schema.wide}' fits no column of {', '.join(asked[:5])}; write it with {AGENT} and {COLUMN} as the "
            "table's columns are called."
        )
    for name, columns in own.items():
        lacking = [agent for agent in agents if agent not in columns]
        if columns and lacking:
            column = schema.wide.replace(COLUMN, theirs.get(name, name)).replace(AGENT, lacking[0])
            raise StoreError(
                f"The agent '{lacking[0]}' has no column '{column}', and "
                f"'{next(iter(columns))}' has; leave {name} out, or add it."
            )
    everybodys = {name: theirs.get(name, name) for name in (*shared, *(name for name in asked if not own[name]))}
    read = read_columns(
        table, [*everybodys.values(), *(column for columns in own.values() for column in columns.values())], form
    )
    columns = {name: read[column] for name, column in everybodys.items()}
    parts = []
    for agent in agents:
        mine = {name: read[columns_of[agent]] for name, columns_of in own.items() if columns_of}
        there = ~np.stack([_missing(column) for column in mine.values()]).all(0)
        rows = {name: column[there] for name, column in (columns | mine).items()}
        parts.append(rows | {schema.agent: np.full(int(there.sum()), agent)})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _owners(wide: str, names: Iterable[str], asked: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """For every asked column, the table's columns of it by agent. A name that fits several is of the longest column:
    `leadervx` is vx of `leader`, not x of `leaderv`."""
    own: dict[str, dict[str, str]] = {name: {} for name in asked}
    by_length = sorted(asked, key=lambda name: -len(asked[name]))
    patterns: dict[str, re.Pattern[str]] = {}
    for name in by_length:
        before, after = wide.replace(COLUMN, asked[name]).split(AGENT)
        patterns[name] = re.compile(f"{re.escape(before)}(?P<agent>.+){re.escape(after)}")
    for column in names:
        for name in by_length:
            found = patterns[name].fullmatch(column)
            if found:
                own[name][found["agent"]] = column
                break
    return own


def _missing(column: np.ndarray) -> np.ndarray:
    """(M,) whether an entry is None or NaN."""
    if column.dtype.kind == "f":
        return np.asarray(np.isnan(column).reshape(len(column), -1).all(1))
    if column.dtype.kind != "O":
        return np.zeros(len(column), bool)
    return np.array([entry is None or (isinstance(entry, float) and entry != entry) for entry in column], bool)
