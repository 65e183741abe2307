"""JSON lines as columns: an object for each row, whose own objects are joined to its names by dots (`pose.x`)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.errors import StoreError

DEPTH = 8  # objects within objects


def read_json_lines(path: Path) -> dict[str, np.ndarray]:
    """Columns (M,) by name; what a row does not name is None there. Lists stay lists."""
    columns: dict[str, list[Any]] = {}
    rows = 0
    with path.open(encoding="utf-8-sig") as file:
        for number, line in enumerate(file, 1):
            if not line.strip():
                continue
            for name, value in _fields(path, number, line):
                column = columns.setdefault(name, [])
                column.extend([None] * (rows - len(column)))
                column.append(value)
            rows += 1
    return {name: _column(values + [None] * (rows - len(values))) for name, values in columns.items()}


def _fields(path: Path, number: int, line: str) -> Iterator[tuple[str, Any]]:
    try:
        row = json.loads(line, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        raise StoreError(f"Line {number} of '{path}' is no JSON ({error}); write one object per line.") from None
    if not isinstance(row, dict):
        raise StoreError(f'Line {number} of \'{path}\' is no object; write one per row, such as {{"t": 0.1, "x": 2}}.')
    return _flat(path, number, row, "", DEPTH)


def _flat(path: Path, number: int, row: dict[str, Any], before: str, depth: int) -> Iterator[tuple[str, Any]]:
    if not depth:
        raise StoreError(f"Line {number} of '{path}' holds objects in objects {DEPTH} deep; write flatter rows.")
    for name, value in row.items():
        if isinstance(value, dict):
            yield from _flat(path, number, value, f"{before}{name}.", depth - 1)
        else:
            yield before + name, value


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    row = dict(pairs)
    if len(row) < len(pairs):
        raise ValueError("it names a field twice")
    return row


def _column(values: list[Any]) -> np.ndarray:
    """Numbers as numbers and words as words; anything else as it is, for whoever reads the column to judge."""
    kinds = {type(value) for value in values}
    if kinds <= {int, float}:
        try:
            return np.array(values, np.int64 if kinds == {int} else np.float64)  # ids are longer than floats are exact
        except OverflowError:  # an integer that no float holds
            pass
    if kinds == {bool}:
        return np.array(values)
    column = np.empty(len(values), object)
    column[:] = values
    return column
