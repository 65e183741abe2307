"""JSON lines as columns: an object for each row, whose own objects are joined to its names by dots (`pose.x`)."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.errors import StoreError
from ringfence.utils.arrays import affordable

DEPTH = 8  # objects within objects
PACKED = 20  # times its size that a file may unpack to: a row has few bytes that names few columns


def read_json_lines(path: Path, wanted: Collection[str] | None) -> dict[str, np.ndarray]:
    """The wanted columns (M,) by name, and the names of all others without a row; what a row does not name is None
    there. Lists stay lists."""
    names: dict[str, None] = {}
    found: dict[str, tuple[list[int], list[Any]]] = {name: ([], []) for name in wanted or ()}  # rows and their values
    rows = 0
    with path.open(encoding="utf-8-sig") as file:
        for number, line in enumerate(file, 1):
            if not line.strip():
                continue
            for name, value in _fields(path, number, line):
                names[name] = None
                if name in found:
                    found[name][0].append(rows)
                    found[name][1].append(value)
            rows += 1
    there = {name: column for name, column in found.items() if name in names}
    affordable(path, 8 * rows * len(there), PACKED)
    return dict.fromkeys(names, np.zeros(0)) | {name: _column(rows, *column) for name, column in there.items()}


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


def _column(rows: int, where: list[int], values: list[Any]) -> np.ndarray:
    """Numbers as numbers and words as words; anything else as it is, for whoever reads the column to judge."""
    kinds = {type(value) for value in values} if len(values) == rows else {type(None)}
    if kinds <= {int, float}:
        try:
            return np.array(values, np.int64 if kinds == {int} else np.float64)  # ids are longer than floats are exact
        except OverflowError:  # an integer that no float holds
            pass
    if kinds == {bool}:
        return np.array(values)
    column = np.empty(rows, object)
    for row, value in zip(where, values):  # lists, which NumPy would make into more axes
        column[row] = value
    return column
