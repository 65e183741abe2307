"""What importers of step arrays share: where episodes end, a log of one stream of steps before it is shared out among
agents, the rules that its arrays in HDF5 obey whatever the layout, and the map that says which columns are whose:

    {"left": {"observation": [0, 1, 2], "action": [0]}, "right": {"observation": [0, 3], "action": [1, 2]}}

Several agents may see the same column; an action column is one agent's alone, and every one is somebody's. Agents that
see or do less than others are filled up at the end. Refusals name the file, the array and the row.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypedDict

import h5py
import msgspec
import numpy as np

from ringfence.errors import StoreError
from ringfence.problem.bounds import Bounds
from ringfence.utils import arrays, schemas

LARGEST = 2**20  # bytes of a map
Indices = Annotated[list[schemas.Count], msgspec.Meta(min_length=1)]


class Agent(TypedDict):
    observation: Indices
    action: Indices


Agents = dict[str, Agent]
_KIND = Annotated[Agents, msgspec.Meta(min_length=1)]
_EXAMPLE = """give e.g. {"a": {"observation": [0, 1], "action": [0]}, "b": {"observation": [1, 2], "action": [1]}}"""


# --- where episodes end ---
def inside(ends: np.ndarray) -> np.ndarray:
    """(T,) whether a step is followed by another one of its episode; `ends` (E,) are cumulative steps."""
    found = np.ones(int(ends[-1]), bool)
    found[ends - 1] = False
    return found


def without_last_steps(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Episodes whose last step is given up, since nothing says where it led: (T',) the steps that stay, (E',) where
    their episodes end, (E',) the rows whose observations these end with. Episodes of one step are gone."""
    lengths = np.diff(ends, prepend=0)
    long = lengths > 1
    return np.flatnonzero(inside(ends)), np.cumsum(lengths[long] - 1), ends[long] - 1


# --- one stream of steps ---
@dataclass(frozen=True)
class Asked:
    """What the caller says of the file."""

    agents: Agents | None
    low: Any  # bounds of actions, as a card takes them
    high: Any


@dataclass(frozen=True)
class Logs:
    """One stream of T steps in E episodes, not yet shared out among agents."""

    layout: str
    observations: np.ndarray  # (T, O)
    final: np.ndarray  # (E, O) what each episode ended in
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


# --- arrays in HDF5 ---
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


# --- agents ---
def shared_out(path: Path, log: Logs, agents: Agents | None) -> dict[str, Any]:
    """What `EpisodeStore.from_steps` takes, of the steps shared out among agents; its card has no task."""
    bounds = log.bounds
    notes = list(log.notes)
    names = log.names
    seen, final, done = (x[:, None] for x in (log.observations, log.final, log.actions))
    card: dict[str, Any] = {"agents": ["agent0"]}
    if agents is not None:
        looks, moves = ([agent[kind] for agent in agents.values()] for kind in ("observation", "action"))
        rows = (len(seen) + len(final)) * max(map(len, looks)) + len(done) * max(map(len, moves))
        arrays.fits(path, 4 * rows * len(agents))
        bounds = _bounds_of_agents(bounds, moves)
        seen, final = _taken(log.observations, looks), _taken(log.final, looks)
        done = _taken(log.actions, moves, bounds.middle)
        sizes = [len(own) for own in moves]
        card = {"agents": list(agents), "columns": agents}
        card |= {"action_sizes": sizes} if len({*sizes}) > 1 else {}
        notes += [note] if (note := _filled_up(agents)) else []
        names = [names[k] for k in looks[0]] if names and len(agents) == 1 else None  # several see different columns
    if log.costs is None:
        notes.append("no costs are recorded, so every step has 0: what is learned from this knows no danger")
    return {
        "observations": seen,
        "actions": np.ascontiguousarray(done),
        "rewards": log.rewards,
        "costs": log.costs,
        "terminated": log.terminated,
        "episode_ends": log.ends,
        "final_observations": final,
        "card": {
            **card,
            "simulator": log.simulator,
            "provenance": f"imported from {log.layout}'s layout in '{path}'",
            "action_low": bounds.low,
            "action_high": bounds.high,
            "observation_names": names,
            "warnings": notes,
        },
    }


def _bounds_of_agents(bounds: Bounds, indices: list[list[int]]) -> Bounds:
    """The bounds of a stream's entries, shared out among agents by the entries that each has. An entry that an agent
    lacks is bounded as that of an agent who has it."""
    if not np.ndim(bounds.low) and not np.ndim(bounds.high):
        return bounds
    widest = max(indices, key=len)
    places = [[*own, *widest[len(own) :]] for own in indices]
    of_each = [np.broadcast_to(one, sum(map(len, indices)))[places] for one in bounds]
    return Bounds.of(*of_each)


def read_agents(given: dict | str | os.PathLike) -> Agents:
    """The map in a dictionary, in JSON text, or in a file of that; `StoreError` says what is wrong with it."""
    try:
        if isinstance(given, str) and given.lstrip()[:1] in ("{", "["):
            raw = given
        elif isinstance(given, str | os.PathLike):
            file = Path(given)
            if not file.is_file():
                raise ValueError(f"there is no file '{file}'")
            if file.stat().st_size > LARGEST:
                raise ValueError(f"'{file}' is larger than {LARGEST / 2**20:.0f} MiB")
            raw = file.read_bytes()
        else:  # ranges and arrays of Python's become lists
            raw = json.dumps(given, default=lambda x: x.tolist() if isinstance(x, np.ndarray | np.generic) else list(x))
        agents: Agents = schemas.decode(raw, _KIND)
        for name, agent in agents.items():
            if extra := sorted(agent.keys() - {"observation", "action"}):
                raise ValueError(f"agent '{name}' has '{extra[0]}', which is neither observation nor action")
    except (OSError, TypeError, ValueError) as error:
        raise StoreError(f"agents is no map of columns ({error}); {_EXAMPLE}.") from None
    return agents


def check_agents(path: Path, agents: Agents, observations: int, actions: int) -> None:
    """Refuse indices beyond the file's columns, repeated ones, and actions that are nobody's or two agents'."""
    owner: dict[int, str] = {}
    for name, agent in agents.items():
        for kind, there in (("observation", observations), ("action", actions)):
            beyond = [k for k in agent[kind] if k >= there]
            if beyond:
                raise StoreError(
                    f"Agent '{name}' reads {kind} column {beyond[0]}, '{path}' has {there}, counted from 0; correct "
                    "the agents' map."
                )
            twice = [k for k in set(agent[kind]) if agent[kind].count(k) > 1]
            if twice:
                raise StoreError(f"Agent '{name}' names {kind} column {min(twice)} twice; name it once.")
        for k in agent["action"]:
            if k in owner:
                raise StoreError(
                    f"Action column {k} belongs to '{owner[k]}' and to '{name}'; give it to one of the agents."
                )
            owner[k] = name
    nobodys = [k for k in range(actions) if k not in owner]
    if nobodys:
        raise StoreError(
            f"Action column {nobodys[0]} of '{path}' is no agent's; give every one of the {actions} to one agent."
        )


def _taken(joint: np.ndarray, indices: list[list[int]], fill: float | np.ndarray = 0.0) -> np.ndarray:
    """(T, D) -> (T, N, W), W the most columns of an agent; what an agent has not is `fill`, of all or (N, W)."""
    sizes = np.array([len(k) for k in indices])
    there = np.arange(sizes.max()) < sizes[:, None]  # (N, W)
    table = np.zeros(there.shape, int)
    table[there] = np.concatenate(indices)
    taken = joint[:, table]
    taken[:, ~there] = np.broadcast_to(fill, there.shape)[~there]
    return taken


def _filled_up(agents: Agents) -> str | None:
    """Which agents are, in words."""
    said = []
    for kind in ("observation", "action"):
        sizes = {name: len(agent[kind]) for name, agent in agents.items()}
        widest = max(sizes.values())
        said += [f"'{name}' has {size} of {widest} {kind} entries" for name, size in sizes.items() if size < widest]
    return f"agents of different sizes are filled up at the end: {', '.join(said)}" if said else None
