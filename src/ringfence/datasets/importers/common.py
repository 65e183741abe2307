"""A log of one stream of steps, before it is shared out among agents, and the rules that its arrays in HDF5 obey
whatever the layout. Refusals name the file, the array and the row."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ringfence.datasets.importers import columns
from ringfence.errors import StoreError
from ringfence.problem.bounds import Bounds

PACKED = 20  # times its size that a compressed file may unpack to; columns of zeros pack well


@dataclass(frozen=True)
class Asked:
    """What the caller says of the file."""

    agents: columns.Columns | None
    low: Any  # bounds of actions, as a card takes them
    high: Any


@dataclass(frozen=True)
class Logs:
    """One stream of T steps in E episodes, not yet shared out among agents."""

    layout: str
    observations: np.ndarray  # (T + E, O) as in a store
    actions: np.ndarray  # (T, A)
    rewards: np.ndarray  # (T,)
    costs: np.ndarray | None  # (T,), None where nothing is recorded
    ends: np.ndarray  # (E,)
    terminated: np.ndarray  # (E,) bool
    bounds: Bounds
    notes: list[str]
    name: str  # of the data
    names: list[str] | None = None  # of the observation entries
    simulator: str | None = None


def bounds_of(space: Bounds | None, asked: Asked, entries: int) -> Bounds:
    """Within what the entries of one stream's actions lie: as asked, else as the action space says, else −1 and 1."""
    low, high = space or (-1.0, 1.0)
    bounds = Bounds.of(low if asked.low is None else asked.low, high if asked.high is None else asked.high)
    if bounds.by_agent or not bounds.fit(1, entries):
        raise StoreError(
            f"Actions are bounded by {bounds}, and the file has {entries} action entries in a row; give action_low "
            "and action_high one number, or one of each entry."
        )
    return bounds


def within(path: Path, name: str, actions: np.ndarray, bounds: Bounds) -> None:
    outside = bounds.outside(actions)
    if outside.any():
        row, entry = (int(k) for k in np.argwhere(outside)[0])
        low, high = bounds.of_entry(0, entry)
        raise StoreError(
            f"'{path}' has '{name}' from {actions.min():.4g} to {actions.max():.4g}, row {row} first outside "
            f"[{low:g}, {high:g}]; pass action_low and action_high (--action-low, --action-high)."
        )


def of_agents(bounds: Bounds, indices: list[list[int]]) -> Bounds:
    """The bounds of a stream's entries, shared out among agents by the entries that each has. An entry that an agent
    lacks is bounded as that of an agent who has it."""
    if not np.ndim(bounds.low) and not np.ndim(bounds.high):
        return bounds
    widest = max(indices, key=len)
    places = [[*own, *widest[len(own) :]] for own in indices]
    of_each = [np.broadcast_to(one, sum(map(len, indices)))[places] for one in bounds]
    return Bounds.of(*of_each)


def numbers(path: Path, name: str, array: h5py.Dataset, rows: int | None = None) -> np.ndarray:
    """The first `rows` of an array, (M, D) in single precision; what that cannot hold is refused with its row."""
    raw = array[: len(array) if rows is None else rows]
    with np.errstate(over="ignore"):
        x = raw.astype(np.float32, copy=False).reshape(len(raw), math.prod(raw.shape[1:]))
    if not np.isfinite(x).all():
        row, entry = (int(k) for k in np.argwhere(~np.isfinite(x))[0])
        raise StoreError(
            f"'{path}' holds {raw.reshape(x.shape)[row, entry]} in row {row} of '{name}', not a finite number of "
            "single precision; remove or repair the episode that holds it."
        )
    return x


def flags(path: Path, name: str, array: h5py.Dataset, rows: int) -> np.ndarray:
    raw = array[()].reshape(rows)
    wrong = np.flatnonzero((raw != 0) & (raw != 1))  # NaN, too
    if len(wrong):
        raise StoreError(f"'{path}' holds {raw[wrong[0]]} in row {wrong[0]} of '{name}'; it must be 0 or 1.")
    return raw.astype(bool)


def vector(path: Path, name: str, shape: tuple[int, ...]) -> None:
    if shape[1:] not in ((), (1,)):
        raise StoreError(f"'{path}' has '{name}' of shape {shape}; it must hold one number of every step.")


def entries(path: Path, name: str, shape: tuple[int, ...]) -> int:
    if not (size := math.prod(shape[1:])):
        raise StoreError(f"'{path}' has '{name}' of shape {shape}; every row must hold a number.")
    return size


def rows_of(path: Path, name: str, got: int, expected: int, steps: int) -> None:
    if got != expected:
        raise StoreError(f"'{path}' has {got} rows in '{name}', its {steps} rewards ask for {expected}; copy it again.")


def continuous(path: Path, name: str, array: h5py.Dataset) -> None:
    if array.dtype.kind != "f":
        raise StoreError(
            f"'{path}' holds '{name}' of type {array.dtype}, choices among few; only continuous ones are learned here."
        )


def flattened(*shapes: tuple[int, ...]) -> list[str]:
    return [f"rows of shape {s[1:]} are read as {math.prod(s[1:])} entries" for s in shapes if len(s) > 2]
