"""Read the HDF5 files of single-agent offline reinforcement learning: DSRL's, D4RL's and Minari's. M rows or T steps:

    DSRL    observations, next_observations (M, ...), actions (M, ...), rewards, costs, terminals, timeouts (M,)
    D4RL    observations, actions, rewards, terminals, timeouts; next_observations in some, and infos/, metadata/
    Minari  episode_0, episode_1, ..., a group of every episode, metadata.json beside the file; in each
            observations, actions and infos  an array, or groups of arrays (Dict and Tuple spaces); T+1 observations
            rewards, terminations, truncations (T,)

The names and shapes are those of the repositories liuzuxin/DSRL (`dsrl/offline_env.py`, Liu et al. 2023),
Farama-Foundation/D4RL (`d4rl/offline_env.py`, `d4rl/__init__.py`, Fu et al. 2020) and Farama-Foundation/Minari
(`minari/dataset/_storages/hdf5_storage.py`; older versions keep the metadata in the file's attributes; groups are
joined in the order of their names). What the files do not say, and is done here:

* the state that an episode's last step led to is in `next_observations` or, with Minari, in the last row. D4RL's files
  without it give up the last step of every episode, whose own observation becomes the last state; since nothing is
  known of where that step led, no such episode counts as terminated;
* a step that is marked both as a terminal and as a timeout is a terminal; rows after the last mark are an unfinished
  episode and are dropped. Minari's episodes end with their group: one without a mark is truncated;
* costs are DSRL's `costs` and Minari's `infos/cost`, both of the state that a step leads to. Elsewhere they are 0, and
  the card says that nothing was recorded;
* the log is one agent's, unless a map of columns shares it out among several (`common.py`).
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ringfence.errors import StoreError, reading, reason
from ringfence.logs.io import common
from ringfence.problem.bounds import Bounds
from ringfence.utils import arrays, schemas
from ringfence.utils.files import place

D4RL = ("observations", "actions", "rewards", "terminals", "timeouts")
DSRL = ("observations", "next_observations", "actions", "rewards", "costs", "terminals", "timeouts")
MINARI = ("terminations", "truncations")  # names that stand in its episodes alone
EPISODE = re.compile(r"episode_(\d{1,9})")
DATASET = re.compile(r"\w[\w\-/]*-v\d+")  # a Minari data set's name
OF_EPISODES = ("observations", "actions", "rewards", "terminations", "truncations")  # of Minari
FOREIGN = {"terminals": "D4RL", "timeouts": "D4RL", "next_observations": "D4RL", "costs": "DSRL"}
DEEP, MANY = 8, 4096  # levels of groups within observations or actions, and arrays in them
APART = 1e-3  # of an entry's deviation: two records of one state differ by rounding alone
STRAYS = 0.05  # of the steps: more of them that do not lead to the next row are no episodes
CHUNK = 50_000  # rows at a time
FLOAT = 4  # bytes of a number in a store


def read_hdf5(path: Path, asked: common.Asked) -> tuple[dict[str, Any], str]:
    """What `EpisodeStore.from_steps` takes, of a DSRL, D4RL or Minari file, and the data's own name. The layout is
    recognised by the names in the file."""
    with reading(path, "HDF5 of DSRL, D4RL or Minari"), h5py.File(path, "r") as f:
        episodes = _recognised(path, f)
        log = _of_episodes(path, f, episodes, asked) if episodes else _flat(path, f, asked)
    return common.shared_out(path, log, asked.agents), log.name


# --- finding and recognising ---
def located(given: str | os.PathLike) -> Path:
    """The HDF5 file of a path, of a Minari data set's folder, or of its name."""
    path = place(given)
    if path.is_file():
        return path
    if path.is_dir():
        inside = [f for f in (path / "main_data.hdf5", path / "data" / "main_data.hdf5") if f.is_file()]
        if not inside:
            raise StoreError(f"'{path}' holds no main_data.hdf5; give an HDF5 file or the folder of a Minari data set.")
        return inside[0]
    if path.exists():
        raise StoreError(f"'{path}' is no regular file; give an HDF5 file.")
    if not DATASET.fullmatch(str(given)):
        raise StoreError(
            f"There is no file '{path}'; give an HDF5 file, or the name of a Minari data set (door/human-v2)."
        )
    try:
        from minari.storage import get_dataset_path
    except ImportError:
        raise StoreError(
            f"There is no file '{path}'; to find a Minari data set by its name, run pip install 'ringfence[minari]'."
        ) from None
    folder = get_dataset_path(str(given))
    if not folder.is_dir():
        raise StoreError(
            f"There is no file '{path}', and no such Minari data set in '{folder}'; download it with Minari."
        )
    return located(folder)


def _recognised(path: Path, f: h5py.File) -> list[str]:
    """The names of Minari's episodes in order, none where the file is flat; refused where it is neither or both."""
    if "ringfence_store" in f.attrs:
        raise StoreError(f"'{path}' is an episode store already; use it as it is.")
    names = list(f)
    episodes = sorted((n for n in names if EPISODE.fullmatch(n)), key=lambda n: int(n.removeprefix("episode_")))
    flat = [n for n in names if n in DSRL]
    strays = [n for n in names if n in MINARI]
    if episodes and (flat or strays):
        raise StoreError(
            f"'{path}' mixes layouts: '{(flat or strays)[0]}' lies beside Minari's '{episodes[0]}'; keep one of them."
        )
    if episodes:
        return episodes
    if not flat:
        what = f"holds '{names[0]}'" if names else "holds nothing"
        raise StoreError(
            f"'{path}' {what}, which fits neither DSRL, D4RL nor Minari; see docs/import.md for their names."
        )
    if strays:
        raise StoreError(f"'{path}' mixes layouts: Minari's '{strays[0]}' lies beside '{flat[0]}'; keep one of them.")
    layout, needed = ("DSRL", DSRL) if "costs" in names else ("D4RL", D4RL)
    missing = [n for n in needed if n not in names]
    if missing:
        raise StoreError(
            f"'{path}' lacks '{missing[0]}', which {layout}'s layout has; add it, or use EpisodeStore.from_steps."
        )
    return []


# --- D4RL and DSRL ---
def _flat(path: Path, f: h5py.File, asked: common.Asked) -> common.Logs:
    layout = "DSRL" if "costs" in f else "D4RL"
    found = {name: arrays.array(path, f, name) for name in DSRL if name in f}
    rows = len(found["actions"])
    following = found.get("next_observations")
    seen, acted = _flat_widths(path, found)
    if asked.agents is not None:
        common.check_agents(path, asked.agents, seen, acted)
    bounds = common.bounds_of(None, asked, acted)
    arrays.affordable(path, sum(array.nbytes for array in found.values()))

    terminals, timeouts = (common.flags(path, name, found[name], rows) for name in ("terminals", "timeouts"))
    ends = np.flatnonzero(terminals | timeouts) + 1
    if not len(ends):
        raise StoreError(
            f"'{path}' marks no end of an episode in its {rows} rows; set terminals or timeouts at their last steps."
        )
    kept = int(ends[-1])
    notes = common.flattened(found["observations"].shape, found["actions"].shape)
    if kept < rows:
        notes.append(f"the last {rows - kept} rows are an unfinished episode and were dropped")
    if both := int((terminals & timeouts).sum()):
        notes.append(f"{both} steps are marked as terminals and as timeouts, too, and count as terminals")
    notes += _unread(f, layout)

    observations = common.numbers(path, "observations", found["observations"], kept)
    actions = common.numbers(path, "actions", found["actions"], kept)
    common.within(path, "actions", actions, bounds)
    rewards = common.numbers(path, "rewards", found["rewards"], kept)[:, 0]
    costs = common.numbers(path, "costs", found["costs"], kept)[:, 0] if "costs" in found else None
    terminated = terminals[ends - 1]
    if following is not None:
        reached = common.numbers(path, "next_observations", following, kept)
        notes += _broken(path, observations, reached, ends)
        final = reached[ends - 1]
    else:
        notes.append(_given_up(np.diff(ends, prepend=0), terminated))
        steps, ends, last = common.without_last_steps(ends)
        if not len(ends):
            raise StoreError(
                f"'{path}' has no next_observations and no episode of two steps, so nothing says where a step led; "
                "add next_observations."
            )
        final = observations[last]
        observations, actions, rewards = observations[steps], actions[steps], rewards[steps]
        terminated = np.zeros(len(ends), bool)
    return common.Logs(layout, observations, final, actions, rewards, costs, ends, terminated, bounds, notes, path.stem)


def _flat_widths(path: Path, found: dict[str, h5py.Dataset]) -> tuple[int, int]:
    """Entries of an observation and of an action, of arrays that fit each other."""
    rows = len(found["actions"])
    for name, array in found.items():
        if len(array) != rows:
            raise StoreError(f"'{path}' has {len(array)} rows of '{name}' and {rows} of 'actions'; copy it again.")
        if name in ("rewards", "costs", "terminals", "timeouts"):
            common.vector(path, name, array.shape)
    seen, acted = (common.entries(path, name, found[name].shape) for name in ("observations", "actions"))
    following = found.get("next_observations")
    if following is not None and following.shape != found["observations"].shape:
        raise StoreError(
            f"'{path}' has next_observations {following.shape} and observations {found['observations'].shape}; they "
            "must be of one shape."
        )
    common.continuous(path, "actions", found["actions"])
    return seen, acted


def _unread(f: h5py.File, layout: str) -> list[str]:
    """What is said of what the file holds beside."""
    notes = []
    others = sorted(set(f) - set(DSRL) - {"infos", "metadata"})
    if others:
        notes.append(f"not read: {', '.join(others[:10])}" + f" and {len(others) - 10} more" * (len(others) > 10))
    infos = f["infos"] if isinstance(f.get("infos", getlink=True), h5py.HardLink) else None
    if layout == "D4RL" and isinstance(infos, h5py.Group) and "cost" in infos:
        notes.append(
            "infos/cost is not read, since D4RL does not say which state it belongs to; as 'costs' it would be"
        )
    return notes


def _given_up(lengths: np.ndarray, terminated: np.ndarray) -> str:
    note = "next_observations is missing, so the last step of every episode was given up, its observation being the end"
    if terminated.any():
        note += f"; where {int(terminated.sum())} terminations led is not known, so those episodes count as truncated"
    short = int((lengths == 1).sum())
    return note + (f"; {short} episodes of one step are gone" if short else "")


def _broken(path: Path, observations: np.ndarray, reached: np.ndarray, ends: np.ndarray) -> list[str]:
    """Whether inside episodes a step leads to the next row: refused where many do not, else noted."""
    before = np.flatnonzero(common.inside(ends))
    usual = observations[:: max(1, len(observations) // 100_000)].astype(np.float64)
    slack = APART * usual.std(0) + 1e-5 * np.abs(usual).max(0)  # and single precision's rounding
    some = (before[k : k + CHUNK] for k in range(0, len(before), CHUNK))
    wrong = [k[(np.abs(reached[k] - observations[k + 1]) > slack).any(1)] for k in some]
    wrong = np.concatenate([*wrong, np.zeros(0, int)])
    if len(wrong) > STRAYS * len(before):
        raise StoreError(
            f"'{path}': row {wrong[0]} of next_observations differs from the next row of observations, and so do "
            f"{len(wrong)} of {len(before)} inside episodes; give rows in the order of time, and their ends."
        )
    if not len(wrong):
        return []
    return [
        f"{len(wrong)} steps inside episodes, row {wrong[0]} first, do not lead to the next row; its observation was "
        "taken for where they led"
    ]


# --- Minari ---
@dataclass(frozen=True)
class Shapes:
    """What an episode's group holds."""

    steps: int
    observations: dict[str, tuple[int, ...]]  # arrays and the shapes of their rows
    actions: dict[str, tuple[int, ...]]
    cost: bool
    size: int  # bytes, as they are read


def _of_episodes(path: Path, f: h5py.File, episodes: list[str], asked: common.Asked) -> common.Logs:
    """The steps of those episodes, in that order."""
    metadata = _metadata(path, f)
    notes: list[str] = []
    count = metadata.get("total_episodes", len(episodes))
    if isinstance(count, bool) or str(count) not in (str(len(episodes)), f"{len(episodes)}.0"):
        raise StoreError(f"'{path}' holds {len(episodes)} episodes, its metadata tells of {count}; copy it again.")
    found = {name: _shapes(path, f, name) for name in episodes}
    first = found[episodes[0]]
    _check_alike(path, found, episodes[0])
    seen, acted = (sum(math.prod(s) for s in x.values()) for x in (first.observations, first.actions))
    if not seen or not acted:
        raise StoreError(f"'{path}' has {seen} observation and {acted} action entries; both must be 1 or more.")
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
    missing = [n for n in OF_EPISODES if n not in group]
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
            size += max(array.nbytes, FLOAT * math.prod(array.shape))
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
        if len(low) != entries:
            raise ValueError(f"it has {len(low):,} entries, the file's actions have {entries}")
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
