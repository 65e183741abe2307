"""Wide tables, with columns for every agent (`leader_x`, `follower_x`), as rows of agents and times."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np

from ringfence.errors import StoreError, UserError
from ringfence.logs.io.columns import Columns, Form, Table, names_of, read_columns
from ringfence.logs.io.table_schema import TableSchema

AGENT = "{agent}"
COLUMN = "{column}"


def read_wide(table: Table, schema: TableSchema, theirs: Mapping[str, str], form: Form) -> Columns:
    """The schema's columns, agent by agent. A column that no agent has of its own is everybody's. Rows in which all of
    an agent's own columns are missing are left out: it was away. `theirs` are names in the table, by ours."""
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
                f" '{next(iter(columns))}' has; leave {name} out, or add it."
            )
    everybodys = {name: theirs.get(name, name) for name in (*shared, *(name for name in asked if not own[name]))}
    read = read_columns(
        table, [*everybodys.values(), *(column for columns in own.values() for column in columns.values())], form
    )
    parts = [_of_agent(agent, schema.agent, everybodys, own, read) for agent in agents]
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


def _of_agent(
    agent: str, name_of_agent: str, everybodys: Mapping[str, str], own: dict[str, dict[str, str]], read: Columns
) -> Columns:
    columns = {name: read[column] for name, column in everybodys.items()}
    mine = {name: read[columns_of[agent]] for name, columns_of in own.items() if columns_of}
    there = ~np.stack([_missing(column) for column in mine.values()]).all(0)
    rows = {name: column[there] for name, column in (columns | mine).items()}
    return rows | {name_of_agent: np.full(int(there.sum()), agent)}


def _missing(column: np.ndarray) -> np.ndarray:
    """(M,) whether an entry is None or NaN."""
    if column.dtype.kind == "f":
        return np.asarray(np.isnan(column).reshape(len(column), -1).all(1))
    if column.dtype.kind != "O":
        return np.zeros(len(column), bool)
    return np.array([entry is None or (isinstance(entry, float) and entry != entry) for entry in column], bool)
