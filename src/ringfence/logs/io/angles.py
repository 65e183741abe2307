"""Angles of a table's state as their cosine and sine: an angle jumps by a turn, and between -pi and pi lies no 0."""

from __future__ import annotations

import dataclasses

import numpy as np

from ringfence.errors import StoreError
from ringfence.logs.io.columns import Columns, numbers
from ringfence.logs.io.table_schema import TableSchema

ANGLES = ("theta", "yaw", "heading", "compass", "course", "bearing", "psi")
DEGREES = ("_deg", "_degrees")
RADIANS = ("_rad", "_radians")
TURN = 2 * np.pi + 1e-6


def without_angles(columns: Columns, schema: TableSchema) -> tuple[Columns, TableSchema, list[str]]:
    """The columns and the schema with `cos_yaw` and `sin_yaw` instead of `yaw`, and a note. Angles are known by their
    names; they are in radians, `compass` and what ends in `_deg` in degrees."""
    angles = [name for name in schema.state if _is_angle(name)]
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
    return found, dataclasses.replace(schema, state=tuple(state)), [note]


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


def _is_angle(name: str) -> bool:
    return _plain(name) in ANGLES


def _in_degrees(name: str) -> bool:
    return name.endswith(DEGREES) or _plain(name) == "compass"


def _plain(name: str) -> str:
    """The last word of a dotted name, without its unit."""
    word = name.rpartition(".")[2].lower()
    for unit in (*DEGREES, *RADIANS):
        word = word.removesuffix(unit)
    return word
