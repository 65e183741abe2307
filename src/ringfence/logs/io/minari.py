"""Read Minari's HDF5 layout: a group of every episode, metadata.json beside the file. T steps of an episode:

    episode_0, episode_1, ...   observations (T+1, ...) or a group of them, actions (T, ...) or a group,
                                rewards, terminations, truncations (T,), infos/ (T+1 rows, the first of the reset)

The layout is that of Farama-Foundation/Minari (`minari/dataset/_storages/hdf5_storage.py`; older versions keep the
metadata in the file's attributes). Groups are joined in the order of their names. The end of a group is the end of an
episode: one without a mark is truncated.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from ringfence.errors import StoreError, reading, reason
from ringfence.logs.io import common
from ringfence.problem.bounds import Bounds
from ringfence.utils import arrays, schemas

NAMES = ("observations", "actions", "rewards", "terminations", "truncations")
FOREIGN = {"terminals": "D4RL", "timeouts": "D4RL", "next_observations": "D4RL", "costs": "DSRL"}
DEEP, MANY = 8, 4096  # levels of groups within observations or actions, and arrays in them


@dataclass(frozen=True)
class Shapes:
    """What an episode's group holds."""

    steps: int
    observations: dict[str, tuple[int, ...]]  # arrays and the shapes of their rows
    actions: dict[str, tuple[int, ...]]
    cost: bool
    size: int  # bytes


def read(path: Path, f: h5py.File, episodes: list[str], asked: common.Asked) -> common.Logs:
    """The steps of those episodes, in that order."""
    metadata = _metadata(path, f)
    notes: list[str] = []
    if isinstance(count := metadata.get("total_episodes"), int | np.integer) and count != len(episodes):
        raise StoreError(f"'{path}' holds {len(episodes)} episodes, its metadata tells of {count}; copy it again.")
    found = {name: _shapes(path, f, name) for name in episodes}
    first = found[episodes[0]]
    _check_alike(path, found, episodes[0])
    seen, acted = _widths(path, first)
    if asked.agents is not None:
        common.check_agents(path, asked.agents, seen, acted)
    bounds = common.bounds_of(_action_space(path, metadata, asked, acted), asked, acted)
    arrays.affordable(path, sum(shapes.size for shapes in found.values()))

    found = _with_steps(path, found, notes)
    ends = np.cumsum([shapes.steps for shapes in found.values()], dtype=np.int64)
    steps = int(ends[-1])
    sizes = ((steps, seen), (len(ends), seen), (steps, acted), (steps,), (steps,))
    observations, final, actions, rewards, costs = (np.empty(size, np.float32) for size in sizes)
    terminated, truncated = np.zeros((2, len(ends)), bool)
    for k, (name, shapes) in enumerate(found.items()):
        stop = int(ends[k])
        now = slice(stop - shapes.steps, stop)
        rows = np.concatenate([_numbers(path, f, f"{name}/{key}") for key in shapes.observations], 1)
        observations[now], final[k] = rows[:-1], rows[-1]
        actions[now] = np.concatenate([_numbers(path, f, f"{name}/{key}") for key in shapes.actions], 1)
        common.within(path, f"{name}/actions", actions[now], bounds)
        rewards[now] = _numbers(path, f, f"{name}/rewards")[:, 0]
        terminated[k], truncated[k] = _ended(path, f, name, shapes.steps)
        if first.cost:
            costs[now] = _numbers(path, f, f"{name}/infos/cost")[-shapes.steps :, 0]
    notes += _odd_ends(terminated, truncated)
    flat = tuple(first.observations) == ("observations",)
    if flat:
        notes += common.flattened((0, *first.observations["observations"]), (0,))
    return common.Logs(
        "Minari",
        observations,
        final,
        actions,
        rewards,
        costs if first.cost else None,
        ends,
        terminated,
        bounds,
        notes,
        metadata["dataset_id"] if isinstance(metadata.get("dataset_id"), str) else path.stem,
        None if flat else _names(first.observations),
        _simulator(metadata),
    )


def _check_alike(path: Path, found: dict[str, Shapes], of: str) -> None:
    """Refuse episodes that hold other arrays than the first one, `of`."""
    first = found[of]
    for name, shapes in found.items():
        if replace(shapes, steps=0, size=0) != replace(first, steps=0, size=0):
            kinds = ("observations", "actions", "cost")
            kind = next(k for k in kinds if getattr(shapes, k) != getattr(first, k))
            raise StoreError(
                f"'{path}' has '{name}' with other {'infos/cost' if kind == 'cost' else kind} than '{of}'; "
                "all episodes must hold the same arrays."
            )


def _widths(path: Path, shapes: Shapes) -> tuple[int, int]:
    """Entries of an observation and of an action."""
    seen, acted = (sum(math.prod(s) for s in x.values()) for x in (shapes.observations, shapes.actions))
    if not seen or not acted:
        raise StoreError(f"'{path}' has {seen} observation and {acted} action entries; both must be 1 or more.")
    return seen, acted


def _with_steps(path: Path, found: dict[str, Shapes], notes: list[str]) -> dict[str, Shapes]:
    """The episodes that have steps; that others were dropped is noted."""
    if empty := [name for name, shapes in found.items() if not shapes.steps]:
        notes.append(f"{len(empty)} episodes without a step were dropped")
        found = {name: shapes for name, shapes in found.items() if shapes.steps}
    if not found:
        raise StoreError(f"'{path}' holds no episode with a step; record some.")
    return found


def _odd_ends(terminated: np.ndarray, truncated: np.ndarray) -> list[str]:
    """What is said of episodes (E,) with two marks at their end, or none."""
    notes = []
    if both := int((terminated & truncated).sum()):
        notes.append(f"{both} episodes are marked as terminated and as truncated, too, and count as terminated")
    if neither := int((~terminated & ~truncated).sum()):
        notes.append(f"{neither} episodes end without a mark and count as truncated")
    return notes


def _names(observations: dict[str, tuple[int, ...]]) -> list[str]:
    """Names of the entries of arrays with rows of those shapes."""
    return [
        f"{key.partition('/')[2]}" + f".{j}" * (math.prod(shape) > 1)
        for key, shape in observations.items()
        for j in range(math.prod(shape))
    ]


def _shapes(path: Path, f: h5py.File, name: str) -> Shapes:
    """What an episode holds, looked at before anything is read."""
    group = arrays.member(path, f, name)
    if not isinstance(group, h5py.Group):
        raise StoreError(f"'{path}' holds an array where the group '{name}' belongs; write the file again.")
    strays = [n for n in group if n in FOREIGN]
    if strays:
        raise StoreError(
            f"'{path}' mixes layouts: '{name}' holds {FOREIGN[strays[0]]}'s '{strays[0]}'; see docs/import.md."
        )
    missing = [n for n in NAMES if n not in group]
    if missing:
        raise StoreError(f"'{path}' lacks '{name}/{missing[0]}', which every episode of Minari's has; copy it again.")
    flat = {n: arrays.array(path, group, n, f"{name}/{n}") for n in ("rewards", "terminations", "truncations")}
    steps, size = len(flat["rewards"]), sum(array.nbytes for array in flat.values())
    for key, array in flat.items():
        common.vector(path, f"{name}/{key}", array.shape)
        common.rows_of(path, f"{name}/{key}", len(array), steps, steps)
    parts: dict[str, dict[str, tuple[int, ...]]] = {}
    for kind, expected in (("observations", steps + 1), ("actions", steps)):
        parts[kind] = {}
        for key, array in _leaves(path, group, kind, name):
            common.rows_of(path, f"{name}/{key}", len(array), expected, steps)
            if kind == "actions":
                common.continuous(path, f"{name}/{key}", array)
            parts[kind][key] = array.shape[1:]
            size += array.nbytes
    infos = arrays.member(path, group, "infos", f"{name}/infos") if "infos" in group else None
    cost = False
    if isinstance(infos, h5py.Group) and "cost" in infos:
        cost = True
        array = arrays.array(path, infos, "cost", f"{name}/infos/cost")
        common.vector(path, f"{name}/infos/cost", array.shape)
        if len(array) != steps:  # one of every step; the reset has none
            common.rows_of(path, f"{name}/infos/cost", len(array), steps + 1, steps)
        size += array.nbytes
    return Shapes(steps, parts["observations"], parts["actions"], cost, size)


def _leaves(path: Path, group: h5py.Group, kind: str, name: str) -> Iterator[tuple[str, h5py.Dataset]]:
    """The arrays of observations or actions, of groups in the order of their names."""
    stack = [(kind, group)]
    count = 0
    while stack:
        key, holder = stack.pop()
        last = key.rpartition("/")[2]
        found = arrays.member(path, holder, last, f"{name}/{key}")
        if not isinstance(found, h5py.Group):
            yield key, arrays.array(path, holder, last, f"{name}/{key}")
        elif key.count("/") >= DEEP:
            raise StoreError(f"'{path}' nests '{name}/{key[:200]}' too deeply; keep {DEEP} levels at most.")
        else:
            stack += [(f"{key}/{part}", found) for part in sorted(found, key=_place, reverse=True)]
        count += 1
        if count > MANY:
            raise StoreError(f"'{path}' has more than {MANY} arrays in '{name}/{kind}'; join them into fewer.")


def _place(part: str) -> tuple[int, str]:
    """Members of a tuple are called _index_0, _index_1, ..., _index_10."""
    match = re.fullmatch(r"_index_(\d{1,9})", part)
    return (int(match[1]) if match else -1, part)


def _array(f: h5py.File, label: str) -> h5py.Dataset:
    """An array that was looked at before, by its place in the file."""
    found = f[label]
    assert isinstance(found, h5py.Dataset)
    return found


def _numbers(path: Path, f: h5py.File, label: str) -> np.ndarray:
    return common.numbers(path, label, _array(f, label))


def _ended(path: Path, f: h5py.File, name: str, steps: int) -> tuple[bool, bool]:
    """(terminated, truncated) of an episode's last step; a mark before it is refused."""
    terminated, truncated = (
        common.flags(path, f"{name}/{key}", _array(f, f"{name}/{key}"), steps)
        for key in ("terminations", "truncations")
    )
    early = np.flatnonzero((terminated | truncated)[:-1])
    if len(early):
        raise StoreError(
            f"'{path}' marks step {early[0]} of '{name}' as an end, but {steps - 1 - early[0]} more follow; split the "
            "episode there."
        )
    return bool(terminated[-1]), bool(truncated[-1])


def _metadata(path: Path, f: h5py.File) -> dict:
    """Minari's word on the data: metadata.json beside the file or, of old versions, the file's own attributes."""
    file = path.with_name("metadata.json")
    if not file.is_file():
        keys = ("total_episodes", "dataset_id", "env_spec", "action_space")
        return {k: v.decode() if isinstance(v := f.attrs[k], bytes) else v for k in keys if k in f.attrs}
    with reading(file, "metadata of Minari's", "copy it again, or read the HDF5 file without it"):
        metadata = json.loads(schemas.content(file))
        if not isinstance(metadata, dict):
            raise ValueError("it is no object")
    return metadata


def _action_space(path: Path, metadata: dict, asked: common.Asked, entries: int) -> Bounds | None:
    """The bounds of Minari's action space, of each of so many entries; None where it has none or they are not asked."""
    if "action_space" not in metadata or (asked.low is not None and asked.high is not None):
        return None
    try:
        boxes = list(_boxes(path, json.loads(metadata["action_space"])))
        low, high = (np.concatenate([_of_entries(box, name, entries) for box in boxes]) for name in ("low", "high"))
    except StoreError:
        raise
    except Exception as error:  # JSON of any kind: KeyError, TypeError, OverflowError, RecursionError, ...
        raise StoreError(
            f"'{path}' comes with an action space that cannot be read ({reason(error)}); pass "
            "action_low and action_high (--action-low, --action-high)."
        ) from None
    if not len(low) or not (np.isfinite(low).all() and np.isfinite(high).all()):
        return None
    return Bounds.of(low, high)


def _of_entries(box: dict, name: str, most: int) -> np.ndarray:
    """A bound of each entry of a Box, which may be given as one number."""
    bound = np.asarray(box[name], np.float64).ravel()
    size = math.prod(box.get("shape", (1,))) if len(bound) == 1 else len(bound)
    if not 0 <= size <= most:
        raise ValueError(f"it has {size:,} entries, the file's actions have {most}")
    return np.repeat(bound, size) if len(bound) == 1 else bound


def _boxes(path: Path, space: dict) -> Iterator[dict]:
    """The boxes of a space, in the order in which `_leaves` reads their arrays."""
    kind = space["type"]
    if kind == "Box":
        yield space
    elif kind in ("Dict", "Tuple"):
        parts = space["subspaces"]
        for part in [parts[name] for name in sorted(parts, key=_place)] if isinstance(parts, dict) else parts:
            yield from _boxes(path, part)
    else:
        raise StoreError(
            f"'{path}' has {str(kind)[:60]} actions, choices among few; only continuous ones are learned here."
        )


def _simulator(metadata: dict) -> str | None:
    try:
        name = json.loads(metadata["env_spec"])["id"]
    except (KeyError, RecursionError, TypeError, ValueError):
        return None
    return name[:200] if isinstance(name, str) else None
