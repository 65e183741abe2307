"""Read the HDF5 files of single-agent offline reinforcement learning: DSRL's, D4RL's and Minari's. M rows or T steps:

    DSRL    observations, next_observations (M, ...), actions (M, ...), rewards, costs, terminals, timeouts (M,)
    D4RL    observations, actions, rewards, terminals, timeouts; next_observations in some, and infos/, metadata/
    Minari  episode_0, episode_1, ..., a group of every episode (`minari.py`)

The names and shapes are those of the repositories liuzuxin/DSRL (`dsrl/offline_env.py`, Liu et al. 2023) and
Farama-Foundation/D4RL (`d4rl/offline_env.py`, `d4rl/__init__.py`, Fu et al. 2020). What the files do not say, and is
done here:

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

import os
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ringfence.errors import StoreError, reading
from ringfence.logs.io import common, minari
from ringfence.utils import arrays

D4RL = ("observations", "actions", "rewards", "terminals", "timeouts")
DSRL = ("observations", "next_observations", "actions", "rewards", "costs", "terminals", "timeouts")
MINARI = ("terminations", "truncations")  # names that stand in its episodes alone
EPISODE = re.compile(r"episode_(\d{1,9})")
DATASET = re.compile(r"\w[\w\-/]*-v\d+")  # a Minari data set's name
APART = 1e-3  # of an entry's deviation: two records of one state differ by rounding alone
STRAYS = 0.05  # of the steps: more of them that do not lead to the next row are no episodes
CHUNK = 50_000  # rows at a time


def read_hdf5(path: Path, asked: common.Asked) -> tuple[dict[str, Any], str]:
    """What `EpisodeStore.from_steps` takes, of a DSRL, D4RL or Minari file, and the data's own name. The layout is
    recognised by the names in the file."""
    with reading(path, "HDF5 of DSRL, D4RL or Minari"), h5py.File(path, "r") as f:
        episodes = _recognised(path, f)
        log = minari.read(path, f, episodes, asked) if episodes else _flat(path, f, asked)
    return common.shared_out(path, log, asked.agents), log.name


# --- finding and recognising ---
def located(given: str | os.PathLike) -> Path:
    """The HDF5 file of a path, of a Minari data set's folder, or of its name."""
    path = Path(given)
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
    ends = _ends(path, terminals | timeouts)
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


def _ends(path: Path, last: np.ndarray) -> np.ndarray:
    """(E,) where episodes end, of rows (T,) that are marked as their last."""
    ends = np.flatnonzero(last) + 1
    if not len(ends):
        raise StoreError(
            f"'{path}' marks no end of an episode in its {len(last)} rows; set terminals or timeouts at their last "
            "steps."
        )
    return ends


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
