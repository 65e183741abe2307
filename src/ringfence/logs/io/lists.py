"""Columns of lists (`observation.state`), each as columns of its entries."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from ringfence.errors import StoreError, UserError
from ringfence.logs.io.columns import Columns
from ringfence.logs.io.table_schema import TableSchema

FIELDS = ("state", "action", "goal", "cost")
ENTRIES = 1000  # of a list


def expanded(
    columns: Columns, schema: TableSchema, names: Mapping[str, Sequence[str] | None]
) -> tuple[Columns, TableSchema]:
    """The columns, and the schema that names entries instead of lists: `names` has those of a column's entries by the
    column's name; entries without names are counted (`action.0`). They may be renamed, too."""
    found = dict(columns)
    fields: dict[str, tuple[str, ...]] = {}
    for field in FIELDS:
        inner: list[str] = []
        for column in getattr(schema, field):
            entries = _entries(column, columns[column], names.get(column))
            entries = {schema.rename.get(name, name): values for name, values in entries.items()}
            found |= entries
            inner += entries
        fields[field] = tuple(inner)
    return found, dataclasses.replace(schema, **fields)


def _entries(name: str, column: np.ndarray, names: Sequence[str] | None) -> Columns:
    """The column itself, or those of its lists' entries."""
    rows = stacked(name, column)
    if rows is None:
        return {name: column}
    if names is not None and len(names) != rows.shape[1]:
        raise StoreError(
            f"{name} holds lists of {rows.shape[1]}, and meta/info.json names {len(names)} entries; mend one of them."
        )
    whose = [f"{name}.{entry}" for entry in (names if names is not None else range(rows.shape[1]))]
    return {inner: rows[:, k] for k, inner in enumerate(whose)}


def stacked(name: str, column: np.ndarray) -> np.ndarray | None:
    """(M, entries) of a column of lists, all of one length; None of any other column."""
    if column.ndim == 2:
        return column
    if column.dtype.kind != "O" or not any(_is_list(entry) for entry in column):
        return None
    length = next(len(entry) for entry in column if _is_list(entry))
    for row, entry in enumerate(column):
        if not _is_list(entry) or len(entry) != length or any(_is_list(inner) for inner in entry):
            raise StoreError(
                f"row {row}: {name} is no list of {length} numbers as in the rows before; drop the row, or mend it."
            )
    if not 0 < length <= ENTRIES:
        raise UserError(f"{name} holds lists of {length} entries, from 1 to {ENTRIES} can be read; leave it out.")
    rows = np.array([list(entry) for entry in column], object)
    try:
        return rows.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        return rows  # whoever reads its numbers refuses the first that is none, by its row


def _is_list(entry: object) -> bool:
    return isinstance(entry, list | tuple) or (isinstance(entry, np.ndarray) and entry.ndim == 1)
