"""Public data sets as episode stores, under the names of their tasks: what `logs/io` reads of OMAR's, OG-MARL's,
MADIFF's, DSRL's, D4RL's and Minari's files."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from ringfence.datasets import registry
from ringfence.datasets.recipes.spread import POOLED
from ringfence.envs import SafeMuJoCo, mujoco
from ringfence.errors import StoreError, UserError, one_of
from ringfence.logs.io import common, hdf5, ogmarl, omar
from ringfence.logs.schema import complete_card
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.utils import schemas
from ringfence.utils.files import place

SPREAD_TIER = re.compile(r"(?:simple_spread[-_])?(medium[-_]replay|medium|expert|random)")
ROBOTS: dict[str, mujoco.Parts] = {SafeMuJoCo(parts).name: parts for parts in mujoco.ROBOTS}
ROBOT_TIERS = ("good", "medium", "poor", "expert", "replay")
Limit = float | Literal["quantile"] | None


# --- OMAR ---
def import_omar(
    directory: str | os.PathLike | Sequence[str | os.PathLike],
    hazard: constraints.Hazard | None = None,
    task: str | None = None,
    episode_length: int = 25,
) -> EpisodeStore:
    """The store of one of OMAR's directories, e.g. `simple_spread/expert/seed_0_data`, for any number of agents; or of
    several, one after the other, with the number of episodes of each on the card. `logs/io/omar.py` says what is made
    of the files.

    `hazard` defines the costs (default: `Separation(0.30)`, the contact of two agents). `task` defaults to
    `simple_spread-<tier>` where the path names the tier, with `-pooled` behind it for several directories, else to
    `simple_spread-imported`.
    """
    if task is not None:
        complete_card({"task": task})  # a name that cannot be one is refused before the files are read
    single = isinstance(directory, str | os.PathLike) or not isinstance(directory, Iterable)
    given: Any = [directory] if single else directory
    directories = [place(d) for d in given]
    n = omar.check_alike(directories)
    task = _spread_task(directories, n, not single) if task is None else task
    known = _agents_of(task)
    if known not in (None, n):
        raise StoreError(
            f"'{directories[0]}' holds {n} agents, the task '{task}' has {known}; pass another name as task."
        )
    seeds = [omar.read_seed(d, hazard or constraints.Separation(), episode_length) for d in directories]
    if len(seeds) > 1:
        omar.check_constants(directories, seeds)
    stores = [EpisodeStore.from_steps(**{**seed, "card": {"task": task, **seed["card"]}}) for seed in seeds]
    return stores[0] if single else _pooled(directories, stores)


def _pooled(directories: list[Path], stores: list[EpisodeStore]) -> EpisodeStore:
    """Seeds one after the other, with the number of episodes of each on the card."""
    pool = stores[0]
    for other in stores[1:]:
        pool = pool.followed_by(other)
    names = [str(d) for d in directories]
    card = pool.card.updated(
        provenance="imported from OMAR arrays in " + ", ".join(f"'{name}'" for name in names),
        drivers=names,
        episodes_of_driver=[store.episodes for store in stores],
        warnings=[f"'{name}': {note}" for name, store in zip(names, stores) for note in store.card.warnings],
    )
    return replace(pool, card=card)


def _spread_task(directories: list[Path], n: int, several: bool) -> str:
    """What data of directories are called, which must be of the same tier."""
    names = [_spread_tier(d, n) for d in directories]
    for directory, name in zip(directories, names):
        if name != names[0]:
            raise StoreError(
                f"'{directories[0]}' is of {names[0]}, '{directory}' of {name}; pool one tier, or pass a task."
            )
    pooled = names[0] + POOLED
    return pooled if several and pooled in registry.TASKS else names[0]


def _spread_tier(directory: Path, n: int) -> str:
    """`simple_spread-<tier>` if one of the last three folders names a tier and such a task exists."""
    for part in reversed(directory.resolve().parts[-3:]):
        match = SPREAD_TIER.fullmatch(part.lower())
        name = match and f"simple_spread-{match[1].replace('_', '-')}"
        if name and _agents_of(name) == n:
            return name
    return "simple_spread-imported"


def _agents_of(task: str) -> int | None:
    """How many agents a task of that name has; None where there is none."""
    known = registry.TASKS.get(task)
    return None if known is None or known.env is None else known.env.n_agents


# --- robots ---
def import_vault(
    vault: str | os.PathLike, task: str, speed_limit: Limit = None, tier: str | None = None
) -> EpisodeStore:
    """The store of a Vault of OG-MARL's, e.g. `2halfcheetah.vlt/Good`; `task`: halfcheetah_2x3, ant_2x4 or ant_4x2.
    `logs/io/ogmarl.py` says what is made of it.

    `speed_limit`: safety-gymnasium's (None), that of the tier's `-quantile` task ("quantile"), or any other (m/s).
    `tier`: a word for the data; the folder's name, where it is good, medium, poor, expert or replay.
    """
    vault = place(vault)
    env, facts = _robot(task, _robot_tier(vault, tier), speed_limit)
    return _robots_store(ogmarl.read_vault(vault, env), facts)


def import_madiff(
    directory: str | os.PathLike, task: str, speed_limit: Limit = None, tier: str | None = None
) -> EpisodeStore:
    """The store of MADIFF's `obs.npy` (T, N, N+O), `actions.npy`, `rewards.npy`, `path_lengths.npy`; `speed_limit` and
    `tier` as of `import_vault`."""
    directory = place(directory)
    env, facts = _robot(task, _robot_tier(directory, tier), speed_limit)
    return _robots_store(ogmarl.read_madiff(directory, env), facts)


def _robots_store(steps: dict[str, Any], facts: dict[str, str]) -> EpisodeStore:
    """A store of its own name where no state tells what a simulator needs."""
    if "state" not in steps:
        facts = {**facts, "task": f"{facts['task']}-observations"}
    return EpisodeStore.from_steps(**{**steps, "card": facts | steps["card"]})


def _robot(task: str, tier: str, speed_limit: Limit) -> tuple[SafeMuJoCo, dict[str, str]]:
    """The robot under the data's limit, and what a card says of it: a task's name stands for one limit."""
    env = SafeMuJoCo(one_of("robot", task, ROBOTS))
    name = f"{task}-{tier}"
    if speed_limit is None:
        return env, {"task": name, "protocol": "native"}
    if speed_limit != "quantile":
        below = replace(env, speed_limit=float(speed_limit))
        return below, {"task": f"{name}-below-{speed_limit:g}", "protocol": "own"}
    if name not in registry.QUANTILE_LIMITS:
        raise UserError(
            f"There is no quantile limit for '{name}'; name the tier with --tier good, medium or poor, or pass "
            "--speed-limit in m/s."
        )
    limited = replace(env, speed_limit=registry.QUANTILE_LIMITS[name])
    return limited, {"task": f"{name}-quantile", "protocol": "quantile"}


def _robot_tier(path: Path, given: str | None) -> str:
    """The word for the data: the one that is given, or the folder's name."""
    if given:
        return given.lower() if given.lower() in ROBOT_TIERS else given
    name = path.resolve().name.lower()
    return name if name in ROBOT_TIERS else "imported"


# --- HDF5 ---
def import_hdf5(
    path: str | os.PathLike,
    *,
    task: str | None = None,
    agents: dict | str | os.PathLike | None = None,
    cost_limit: float | None = None,
    action_low: float | Sequence[float] | None = None,
    action_high: float | Sequence[float] | None = None,
) -> EpisodeStore:
    """The store of a DSRL, D4RL or Minari file, of a folder with Minari's main_data.hdf5, or of a Minari data set that
    is on this machine, by its name (needs the extra `minari`). The layout is recognised by the names in the file.

    `agents` shares the columns out (see `logs/io/common.py`): a dictionary, JSON text or a JSON file's path; one agent
    by default. `task` defaults to the name of the file or the data set. `cost_limit` is the cost per episode that
    reports call safe. Actions are bounded by `action_low` and `action_high`, one number for all entries or one of each,
    by default by Minari's action space, else by −1 and 1. `StoreError` names what does not fit, with the row of the
    file.
    """
    known = {"task": task, "cost_limit": cost_limit}
    known = {key: value for key, value in known.items() if value is not None}
    complete_card(known)  # a name that cannot be one is refused before the file is read
    asked = common.Asked(None if agents is None else common.read_agents(agents), action_low, action_high)
    path = hdf5.located(path)
    steps, name = hdf5.read_hdf5(path, asked)
    try:
        return EpisodeStore.from_steps(**{**steps, "card": {**steps["card"], "task": _free_name(name), **known}})
    except UserError as error:
        raise StoreError(f"'{path}': {error}") from None


def _free_name(name: str) -> str:
    """A data set's name as a task's; that of a task of ours would tie the data to its simulator."""
    name = name.replace("/", "-").strip()
    try:
        schemas.check(name, schemas.Name)
    except ValueError:
        return "imported"
    return f"{name}-imported" if name in registry.TASKS else name
