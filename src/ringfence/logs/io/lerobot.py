"""LeRobot's data sets, of versions 2 and 3 of its format, as one table: a row for every arm and frame.

A data set is a folder: meta/info.json says the names, the frames a second and what a column's entries are called, and
data/chunk-000 holds Parquet files, one for each episode (v2) or for many (v3). Films are not read.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.errors import StoreError, UserError, of_kind, one_of, reading
from ringfence.logs.io.columns import Columns, Table, by_entry, known, numbers, reader, stacked
from ringfence.logs.io.formats import names_in, read_parquet
from ringfence.utils import schemas
from ringfence.utils.files import place
from ringfence.utils.text import natural

INFO = "meta/info.json"
LARGEST = 2**24  # bytes of meta/info.json
SLOWEST, FASTEST = 1e-6, 1e6  # frames a second
SIDES = ("left", "right")  # arms, where every action begins with one of them
STATE = "observation.state"
ACTION = "action"
REWARD = "next.reward"
DONE = "next.done"


@dataclass(frozen=True, eq=False)
class LeRobotTable:
    """Columns (R,) `time` (s), `agent`, `episode`, those of `state` and `action`, and `reward` where it was logged."""

    columns: Columns
    state: tuple[str, ...]
    action: tuple[str, ...]
    reward: str | None
    agents: tuple[str, ...]
    dt: float  # s
    notes: tuple[str, ...]


def read_lerobot(folder: str | Path, arms: Sequence[str] = (), state: Sequence[str] = (STATE,)) -> LeRobotTable:
    """The table of a data set. `arms` are prefixes of entries' names: each is an agent, whose entries are called alike
    without it (`left_waist` and `right_waist`). By default `left` and `right`, where every action begins with one of
    them, else the robot is one agent. Entries of the state without such a prefix are every arm's."""
    folder = place(folder)
    info = read_info(folder / INFO)
    wanted = [*state, ACTION]
    for name in wanted:
        one_of("column of the data set", name, info.names)
    reward, done = ([name] if name in info.names else [] for name in (REWARD, DONE))
    read = _read_files(folder, ["episode_index", "frame_index", *wanted, *reward, *done])
    single = {name: _single(name, read[name]) for name in read if name not in wanted}
    own = {name: _entries(name, read[name], info.names[name]) for name in wanted}
    states = dict(own[state[0]]) if state else {}
    for name in state[1:]:  # entries of another column (`observation.velocity`) say whose they are
        states |= {f"{name.rpartition('.')[2]}.{entry}": column for entry, column in own[name].items()}
    actions = own[ACTION]
    agents = _agents(arms, list(actions))
    frames = len(read["frame_index"])
    frame, episode = numbers(single, "frame_index"), single["episode_index"]
    follows = episode[1:] == episode[:-1]
    usual = float(np.median(np.diff(frame)[follows])) if follows.any() else 1.0
    if usual != 1:
        raise StoreError(
            f"frame_index goes up by {usual:g} from row to row, and {INFO} counts {info.fps:g} frames a second; count "
            "an episode's frames 0, 1, 2, … and say how many a second has."
        )
    over = follows & (numbers(single, DONE)[:-1] != 0) if done else np.zeros(len(follows), bool)
    if over.any():
        episode = np.append(0, np.cumsum(~follows | over))
        follows &= ~over
    columns = {"time": frame / info.fps, "episode": episode}
    if reward:  # what a frame's action earned, in the frame in which it arrived
        columns["reward"] = np.zeros(frames)
        columns["reward"][1:][follows] = numbers(single, REWARD)[:-1][follows]
    table, names = _by_agent(columns, agents, states, actions)
    missing = frames != info.frames
    notes = [f"{INFO} counts {info.frames} frames, {frames} are here"] if missing else []
    notes += [f"{DONE} is set inside of episodes, which are cut there: {over.sum()} times"] if over.any() else []
    return LeRobotTable(table, *names, "reward" if reward else None, tuple(agents), 1 / info.fps, tuple(notes))


# --- meta/info.json ---
@dataclass(frozen=True)
class Info:
    """What meta/info.json says."""

    fps: float
    frames: int
    names: Mapping[str, list[str] | None]  # of the entries of each column, None where they have none


def read_info(file: Path) -> Info:
    if not file.is_file():
        raise StoreError(f"'{file.parent.parent}' holds no {INFO}, so it is no LeRobot data set; give its folder.")
    with reading(file, "info.json that LeRobot writes"):
        info = json.loads(schemas.content(file, LARGEST))
        version = str(info["codebase_version"])
        fps = float(info["fps"])
        features = {str(name): _feature_names(feature) for name, feature in info["features"].items()}
        frames = int(info.get("total_frames", 0))
    if not version.startswith(("v2.", "v3.")):
        raise StoreError(
            f"'{file}' is of version {version[:20]} of LeRobot's format; v2 and v3 can be read, so convert it."
        )
    if not SLOWEST <= fps <= FASTEST:
        raise StoreError(f"'{file}' says {fps} frames a second; it must be a number from {SLOWEST} to {FASTEST:g}.")
    return Info(fps, frames, features)


def entry_names(table: Table) -> dict[str, list[str]]:
    """Names of lists' entries, of a Parquet file in a data set's folder; none of any other table."""
    if not isinstance(table, str | Path) or Path(table).suffix.lower() not in (".parquet", ".pq"):
        return {}
    folder = next((folder for folder in Path(table).absolute().parents[:3] if (folder / INFO).is_file()), None)
    if folder is None:
        return {}
    return {name: names for name, names in read_info(folder / INFO).names.items() if names}


def _feature_names(feature: Mapping[str, Any]) -> list[str] | None:
    """Names of a column's entries: a list, a list in a list, or lists by kind ({"motors": [...]}); None of films and of
    what has none."""
    if feature.get("dtype") in ("video", "image") or feature.get("names") is None:
        return None
    names = list(_words(feature["names"]))
    shape = feature.get("shape") or [1]
    return names if [len(names)] == list(shape) and len(set(names)) == len(names) else None


def _words(names: Any) -> Iterator[str]:
    if isinstance(names, Mapping | list):
        for inner in names.values() if isinstance(names, Mapping) else names:
            yield from _words(inner)
    else:
        yield str(names)


# --- data ---
def _read_files(folder: Path, wanted: list[str]) -> Columns:
    files = sorted(folder.glob("data/*/*.parquet"), key=lambda file: natural(str(file)))
    if not files:
        raise StoreError(f"'{folder}' holds no data/*/*.parquet; download the data set with its data, films aside.")
    reader("pyarrow")
    for file in files:
        known(wanted, names_in(file))
    return read_parquet(files, wanted)


def _entries(name: str, column: np.ndarray, names: list[str] | None) -> Columns:
    """A column of lists by the names of its entries; numbers are lists of one."""
    rows = stacked(name, column)
    return by_entry(name, column[:, None] if rows is None else rows, names)


def _single(name: str, column: np.ndarray) -> np.ndarray:
    """A column of numbers, or of lists of one."""
    entries = list(_entries(name, column, None).values())
    if len(entries) > 1:
        raise StoreError(f"{name} holds lists of {len(entries)} entries, and one number is read; write one a frame.")
    return entries[0]


# --- agents ---
def _agents(arms: Sequence[str], actions: list[str]) -> dict[str, str]:
    """Prefixes by agents' names; one agent has none."""
    if not arms:
        sides = [side for side in SIDES if any(name.startswith(side) for name in actions)]
        whole = len(sides) == len(SIDES) and all(name.startswith(SIDES) for name in actions)
        return {side: side for side in sides} if whole else {"robot": ""}
    for arm in arms:
        of_kind("arms", arm, str, "give prefixes of entries' names, such as 'left_'")
    if len(set(arms)) < len(arms):
        raise UserError(f"arms={list(arms)} names one twice; name each once.")
    nobodys = [name for name in actions if not name.startswith(tuple(arms))]
    if nobodys:
        raise StoreError(
            f"The action '{nobodys[0]}' begins with none of {', '.join(arms)}; name the prefix of its arm, too."
        )
    return {arm.strip("_.-/") or arm: arm for arm in arms}


def _by_agent(
    columns: Columns, agents: Mapping[str, str], states: Columns, actions: Columns
) -> tuple[Columns, tuple[tuple[str, ...], tuple[str, ...]]]:
    """The table, arm by arm, and the names of its state and action."""
    everybodys = [name for name in states if not name.startswith(tuple(agents.values()))]
    own = {agent: _own(states, prefix, everybodys) for agent, prefix in agents.items()}
    done = {agent: _own(actions, prefix, []) for agent, prefix in agents.items()}
    for what, parts in (("state", own), ("action", done)):
        _refuse_unlike(what, parts)
    first = next(iter(agents))
    rows = len(columns["time"])
    table = {name: np.tile(column, len(agents)) for name, column in columns.items()}
    table["agent"] = np.repeat(list(agents), rows)
    for name in own[first]:
        table[name] = np.concatenate([part[name] for part in own.values()])
    for name in done[first]:
        table[f"{ACTION}.{name}"] = np.concatenate([part[name] for part in done.values()])
    return table, (tuple(own[first]), tuple(f"{ACTION}.{name}" for name in done[first]))


def _own(entries: Columns, prefix: str, everybodys: Sequence[str]) -> Columns:
    own = {name.removeprefix(prefix).lstrip("_.-/"): x for name, x in entries.items() if name.startswith(prefix)}
    return own | {name: entries[name] for name in everybodys}


def _refuse_unlike(what: str, parts: Mapping[str, Columns]) -> None:
    first, *others = parts
    for other in others:
        unlike = sorted(set(parts[first]) ^ set(parts[other]))
        if unlike:
            having, lacking = (first, other) if unlike[0] in parts[first] else (other, first)
            raise StoreError(
                f"The {what} of '{having}' has '{unlike[0]}', and '{lacking}' has not; arms need the same entries, so "
                "name others, or none."
            )
