"""Which columns of a joint log belong to which agent: an index map, as a dictionary, JSON text or a JSON file.

    {"left": {"observation": [0, 1, 2], "action": [0]}, "right": {"observation": [0, 3], "action": [1, 2]}}

Several agents may see the same column; an action column is one agent's alone, and every one is somebody's. Agents that
see or do less than others are filled up at the end.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, TypedDict

import msgspec
import numpy as np

from ringfence.errors import StoreError
from ringfence.utils import schemas

LARGEST = 2**20  # bytes of a map
Indices = Annotated[list[schemas.Count], msgspec.Meta(min_length=1)]


class Agent(TypedDict):
    observation: Indices
    action: Indices


Columns = dict[str, Agent]
_KIND = Annotated[Columns, msgspec.Meta(min_length=1)]
_EXAMPLE = """give e.g. {"a": {"observation": [0, 1], "action": [0]}, "b": {"observation": [1, 2], "action": [1]}}"""


def read(given: dict | str | os.PathLike) -> Columns:
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
        columns: Columns = schemas.decode(raw, _KIND)
        for name, agent in columns.items():
            if extra := sorted(agent.keys() - {"observation", "action"}):
                raise ValueError(f"agent '{name}' has '{extra[0]}', which is neither observation nor action")
    except (OSError, TypeError, ValueError) as error:
        raise StoreError(f"agents is no map of columns ({error}); {_EXAMPLE}.") from None
    return columns


def check(path: Path, columns: Columns, observations: int, actions: int) -> None:
    """Refuse indices beyond the file's columns, repeated ones, and actions that are nobody's or two agents'."""
    owner: dict[int, str] = {}
    for name, agent in columns.items():
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


def take(joint: np.ndarray, indices: list[list[int]], fill: float | np.ndarray = 0.0) -> np.ndarray:
    """(T, D) -> (T, N, W), W the most columns of an agent; what an agent has not is `fill`, of all or (N, W)."""
    sizes = np.array([len(k) for k in indices])
    there = np.arange(sizes.max()) < sizes[:, None]  # (N, W)
    table = np.zeros(there.shape, int)
    table[there] = np.concatenate(indices)
    taken = joint[:, table]
    taken[:, ~there] = np.broadcast_to(fill, there.shape)[~there]
    return taken


def note(columns: Columns) -> str | None:
    """Which agents are filled up, in words."""
    said = []
    for kind in ("observation", "action"):
        sizes = {name: len(agent[kind]) for name, agent in columns.items()}
        widest = max(sizes.values())
        said += [f"'{name}' has {size} of {widest} {kind} entries" for name, size in sizes.items() if size < widest]
    return f"agents of different sizes are filled up at the end: {', '.join(said)}" if said else None
