"""Import OMAR's Simple Spread arrays (Pan et al. 2022), which MADIFF and others use, too.

A directory holds, for every agent i, `obs_i.npy` (M, O), `acs_i.npy` (M, 2), `rews_i.npy` (M,), `dones_i.npy` (M,) and
`next_obs_i.npy` (M, O): one learner's transitions in the order of time. What the files do not say, and is done here:

* `dones` are all zero, so episodes are cut every 25 steps; an unfinished last one is dropped;
* every episode's last state comes from `next_obs`; in copies without those files (MADIFF reads none) the last step of
  every episode is dropped, because nothing says where it led;
* the global state is recovered from the joint observation; costs are recomputed from a hazard on the states reached.

Whatever contradicts Simple Spread or the length of episodes is refused, with file and row. Several directories, one for
each seed of the learner, are read into one store; the literature trains on all five.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.datasets import registry
from ringfence.datasets.recipes.spread import POOLED
from ringfence.envs import SimpleSpread
from ringfence.errors import StoreError
from ringfence.logs.schema import complete_card
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.utils.files import read_npy

REQUIRED = ("obs", "acs", "rews", "dones")  # next_obs may be absent
TIER = re.compile(r"(?:simple_spread[-_])?(medium[-_]replay|medium|expert|random)")
ACTION_SLACK = 1e-3  # rounding beyond the bounds that is clipped; more is an error
STATE_SLACK = 1e-3  # m or m/s; two records of the same state differ by rounding alone
REWARD_SLACK = 0.05  # of a reward of up to 30, which changes fast near a landmark
CHUNK = 50_000  # rows at a time
CHECKED = 2_000  # first steps of each of several seeds, which must be of one simulator


def import_omar(
    directory: str | os.PathLike | Sequence[str | os.PathLike],
    hazard: constraints.Hazard | None = None,
    task: str | None = None,
    episode_length: int = 25,
) -> EpisodeStore:
    """The store of one of OMAR's directories, e.g. `simple_spread/expert/seed_0_data`, for any number of agents; or of
    several, one after the other, with the number of episodes of each on the card.

    `hazard` defines the costs (default: `Separation(0.30)`, the contact of two agents). `task` defaults to
    `simple_spread-<tier>` where the path names the tier, with `-pooled` behind it for several directories, else to
    `simple_spread-imported`.
    """
    if task is not None:
        complete_card({"task": task})  # a name that cannot be one is refused before the files are read
    if isinstance(directory, str | os.PathLike):
        return _import_seed(Path(directory), hazard, task, episode_length)
    directories = [Path(d) for d in directory]
    _check_alike(directories)
    task = _common_task(directories) if task is None else task
    stores = [_import_seed(d, hazard, task, episode_length) for d in directories]
    _check_constants(directories, stores)
    pool = stores[0]
    for other in stores[1:]:
        pool = pool.followed_by(other)
    names = [str(d) for d in directories]
    notes = [f"'{name}': {note}" for name, store in zip(names, stores) for note in store.card.warnings]
    card = pool.card.updated(
        provenance="imported from OMAR arrays in " + ", ".join(f"'{name}'" for name in names),
        drivers=names,
        episodes_of_driver=[store.episodes for store in stores],
        warnings=notes,
    )
    return replace(pool, card=card)


def _common_task(directories: list[Path]) -> str:
    """What data of several directories are called, which must be of the same tier."""
    n, _ = _survey(directories[0])
    names = [_task_name(d, n) for d in directories]
    for directory, name in zip(directories, names):
        if name != names[0]:
            raise StoreError(
                f"'{directories[0]}' is of {names[0]}, '{directory}' of {name}; pool one tier, or pass a task."
            )
    pooled = names[0] + POOLED
    return pooled if pooled in registry.TASKS else names[0]


def _check_alike(directories: list[Path]) -> None:
    """Refuse directories that are given twice, are of different agents or hold different files."""
    if not directories:
        raise StoreError("No directory was given; pass those of the seeds, e.g. expert/seed_0_data expert/seed_1_data.")
    places = [d.resolve() for d in directories]
    for k, place in enumerate(places):
        if place in places[:k]:
            raise StoreError(f"'{directories[k]}' is given twice; name every seed once.")
    surveys = [_survey(d) for d in directories]
    for directory, (n, has_next) in zip(directories, surveys):
        if n != surveys[0][0]:
            raise StoreError(
                f"'{directory}' holds {n} agents, '{directories[0]}' {surveys[0][0]}; pool seeds of one team."
            )
        if has_next != surveys[0][1]:
            raise StoreError(
                f"'{directory}' and '{directories[0]}' do not both hold next_obs, so their episodes differ in length; "
                "pool seeds with the same files."
            )


def _check_constants(directories: list[Path], stores: list[EpisodeStore]) -> None:
    """Refuse seeds of which one moves or is rewarded as Simple Spread says and another is not: their actions have other
    bounds, or their simulators other constants."""
    first = _follows(stores[0])
    for directory, store in zip(directories[1:], stores[1:]):
        found = _follows(store)
        for what, here, there in zip(("moves", "is rewarded"), found, first):
            if here != there:
                raise StoreError(
                    f"'{directory}' {what} differently from '{directories[0]}', so action bounds or constants of their "
                    "simulators differ; pool seeds of one simulator."
                )


def _follows(store: EpisodeStore) -> tuple[bool, bool]:
    """Whether the first steps of a store move, and are rewarded, as Simple Spread says (most of them: two records of a
    contact may differ)."""
    assert store.state is not None, "OMAR's observations determine the state"
    env = SimpleSpread(n_agents=store.n_agents)
    step = np.arange(min(store.steps, CHECKED))
    row = step + store.episode_of_step[step]
    before = env.from_global_state(jnp.asarray(store.state[row]))
    after, outcome = jax.jit(env.step)(before, jnp.asarray(store.actions[step]))
    moved = np.abs(np.asarray(env.global_state(after)) - store.state[row + 1]).max(-1)
    paid = np.abs(np.asarray(outcome.reward) - store.rewards[step]).max(-1)
    return bool(np.median(moved) <= STATE_SLACK), bool(np.median(paid) <= REWARD_SLACK)


def _import_seed(
    directory: Path, hazard: constraints.Hazard | None, task: str | None, episode_length: int
) -> EpisodeStore:
    """The store of one directory."""
    n, has_next = _survey(directory)
    if episode_length < 1 or (episode_length < 2 and not has_next):
        raise StoreError(f"episode_length={episode_length} leaves no whole step; OMAR's episodes have 25.")
    env = SimpleSpread(n_agents=n, episode_length=episode_length)
    task = _task_name(directory, n) if task is None else task
    known = _agents_of(task)
    if known not in (None, n):
        raise StoreError(f"'{directory}' holds {n} agents, the task '{task}' has {known}; pass another name as task.")
    hazard = hazard or constraints.Separation()
    files = _read(directory, env, has_next)
    log = _whole_episodes(directory, files, episode_length)
    state = _global_state(env, log.observations)
    final_state = _global_state(env, log.final)
    return EpisodeStore.from_steps(
        log.observations,
        log.actions,
        log.rewards,
        episode_ends=log.ends,
        final_observations=log.final,
        state=state,
        final_state=final_state,
        terminated=log.terminated,
        costs=_costs(hazard, env, state, final_state, log.ends),
        card={
            "task": task,
            "simulator": "multiagent-particle-envs simple_spread, as changed by OMAR",
            "provenance": f"imported from OMAR arrays in '{directory}'",
            "integrator": "velocity_first",
            "reward": "omar",
            "agents": [f"agent{i}" for i in range(n)],
            "observation_names": list(_observation_names(n)),
            "state_names": list(env.state_names),
            "hazard": constraints.to_dict(hazard),
            "episode_length": episode_length,
            "warnings": log.notes,
        },
    )


@dataclass(frozen=True)
class Files:
    """What a directory holds, M rows."""

    observations: np.ndarray  # (M, N, O)
    actions: np.ndarray  # (M, N, 2)
    rewards: np.ndarray  # (M, N)
    dones: np.ndarray  # (M,) bool
    following: np.ndarray | None  # (M, N, O) next_obs


@dataclass(frozen=True)
class Log:
    """Whole episodes, T steps."""

    observations: np.ndarray  # (T, N, O)
    actions: np.ndarray  # (T, N, 2)
    rewards: np.ndarray  # (T, N)
    ends: np.ndarray  # (E,) cumulative steps
    final: np.ndarray  # (E, N, O)
    terminated: np.ndarray  # (E,) bool
    notes: list[str]  # what was found and lost


def _read(directory: Path, env: SimpleSpread, has_next: bool) -> Files:
    """The arrays, each of the right shape and of Simple Spread."""
    n = env.n_agents
    width = env.observation_dim
    observations = _agents(directory, "obs", n, None, width)
    rows = len(observations)
    files = Files(
        observations=observations,
        actions=_agents(directory, "acs", n, rows, 2),
        rewards=_agents(directory, "rews", n, rows, None),
        dones=np.all(_agents(directory, "dones", n, rows, None).astype(bool), axis=1),
        following=_agents(directory, "next_obs", n, rows, width) if has_next else None,
    )
    _check_state(directory, env, observations, "obs")
    if files.following is not None:
        _check_state(directory, env, files.following, "next_obs")
    return replace(files, actions=_clip(directory, files.actions))


def _whole_episodes(directory: Path, files: Files, episode_length: int) -> Log:
    """The files cut into episodes; an unfinished last one is dropped."""
    rows = len(files.observations)
    ends = _episode_ends(files.dones, episode_length)
    if not len(ends):
        raise StoreError(
            f"'{directory}' holds {rows} rows, fewer than one episode of {episode_length}; pass a smaller "
            "episode_length."
        )
    notes = []
    kept = int(ends[-1])
    if kept < rows:
        notes.append(f"the last {rows - kept} rows are an unfinished episode and were dropped")
    if files.dones[:kept].any():
        notes.append("dones are set; a done before the time limit is read as a termination, at the limit as truncation")
    if files.following is not None:
        _check_order(directory, files.observations, files.following, ends, episode_length)
        return Log(
            observations=files.observations[:kept],
            actions=files.actions[:kept],
            rewards=files.rewards[:kept],
            ends=ends,
            final=files.following[ends - 1],
            terminated=files.dones[ends - 1] & (np.diff(ends, prepend=0) < episode_length),
            notes=notes,
        )
    notes.append("next_obs is missing, so the last step of every episode was dropped")
    return _without_last_steps(files, ends, notes)


def _without_last_steps(files: Files, ends: np.ndarray, notes: list[str]) -> Log:
    """Episodes up to the last row that is known, where nothing says what their last action led to."""
    inside = np.ones(int(ends[-1]), bool)
    inside[ends - 1] = False
    steps = np.flatnonzero(inside)
    lengths = np.diff(ends, prepend=0)
    long_enough = lengths > 1
    return Log(
        observations=files.observations[steps],
        actions=files.actions[steps],
        rewards=files.rewards[steps],
        ends=np.cumsum(lengths[long_enough] - 1),
        final=files.observations[ends[long_enough] - 1],
        terminated=np.zeros(int(long_enough.sum()), bool),  # where they ended is not recorded
        notes=notes,
    )


def _survey(directory: Path) -> tuple[int, bool]:
    """(number of agents, whether next_obs is there); a directory that lacks a file is refused."""
    if not directory.is_dir():
        raise StoreError(f"There is no directory '{directory}'; pass the one that holds obs_0.npy.")
    found: dict[str, set[int]] = {kind: set() for kind in (*REQUIRED, "next_obs")}
    for file in directory.iterdir():
        match = re.fullmatch(r"(next_obs|obs|acs|rews|dones)_(\d+)\.npy", file.name)
        if match:
            found[match[1]].add(int(match[2]))
    agents = set().union(*found.values())
    if not agents:
        below = sorted({*directory.glob("*/obs_0.npy"), *directory.glob("*/*/obs_0.npy")})
        if below:
            names = ", ".join(f"'{f.parent.relative_to(directory)}'" for f in below[:10])
            more = f" and {len(below) - 10} more" if len(below) > 10 else ""
            raise StoreError(f"'{directory}' holds several data sets; pass subfolders of one tier: {names}{more}.")
        raise StoreError(f"'{directory}' lacks obs_0.npy; pass a directory of OMAR arrays (obs_0.npy, acs_0.npy, ...).")
    n = max(agents) + 1
    kinds = REQUIRED + (("next_obs",) if found["next_obs"] else ())
    for i in range(n):
        for kind in kinds:
            if i not in found[kind]:
                raise StoreError(f"'{directory}' lacks {kind}_{i}.npy; the {n} agents' files must all be there.")
    return n, bool(found["next_obs"])


def _agents(directory: Path, kind: str, n: int, rows: int | None, width: int | None) -> np.ndarray:
    """One kind of array of all agents: (M, N, width) float32, or (M, N) where `width` is None."""
    columns = []
    for i in range(n):
        file = directory / f"{kind}_{i}.npy"
        array = read_npy(file)
        if width is None and array.ndim == 2 and array.shape[1] == 1:
            array = array[:, 0]
        expected = "(M,)" if width is None else f"(M, {width})"
        if array.ndim != (1 if width is None else 2) or (width is not None and array.shape[1] != width):
            raise StoreError(
                f"'{file}' has shape {array.shape}, expected {expected} of Simple Spread with {n} agents; OMAR's other "
                "environments are not read here, use EpisodeStore.from_steps for them."
            )
        rows = len(array) if rows is None else rows
        if len(array) != rows:
            raise StoreError(f"'{file}' has {len(array)} rows, the other files {rows}; copy the files again.")
        columns.append(np.asarray(array, np.float32))
    return np.stack(columns, 1)


def _check_state(directory: Path, env: SimpleSpread, observations: np.ndarray, kind: str) -> None:
    """Refuse joint observations that do not describe one state: files of different runs, or another environment."""
    n = env.n_agents
    seen = 4 + 2 * n + 2 * (n - 1)  # without the communication channel
    reconstruct = jax.jit(lambda x: env.observe(env.from_observations(x)))
    for start in range(0, len(observations), CHUNK):
        given = observations[start : start + CHUNK]
        expected = np.asarray(reconstruct(given))
        error = np.abs(expected - given)[..., :seen].max(-1)  # (M, N)
        if (error > STATE_SLACK).any():
            row, agent = np.argwhere(error > STATE_SLACK)[0].tolist()
            raise StoreError(
                f"'{directory / f'{kind}_{agent}.npy'}' row {start + row} contradicts the other agents' observations "
                f"by {error[row, agent]:.3g}; the files belong to different runs or another environment."
            )


def _clip(directory: Path, actions: np.ndarray) -> np.ndarray:
    beyond = np.abs(actions) - 1.0
    if (beyond >= ACTION_SLACK).any():
        row, agent, entry = np.argwhere(beyond >= ACTION_SLACK)[0].tolist()
        raise StoreError(
            f"'{directory / f'acs_{agent}.npy'}' row {row} is {actions[row, agent, entry]:.4g}, outside [-1, 1]; "
            "rescale the actions."
        )
    return np.clip(actions, -1.0, 1.0)


def _episode_ends(dones: np.ndarray, length: int) -> np.ndarray:
    """(E,) cumulative steps: a cut at every done and after every `length` steps without one."""
    cuts = np.flatnonzero(dones) + 1
    starts = np.concatenate([[0], cuts]).astype(np.int64)
    stops = np.concatenate([cuts, [len(dones)]]).astype(np.int64)
    parts = [np.arange(start + length, stop + 1, length) for start, stop in zip(starts, stops)]
    return np.unique(np.concatenate([*parts, cuts]))


def _check_order(
    directory: Path, observations: np.ndarray, following: np.ndarray, ends: np.ndarray, length: int
) -> None:
    """next_obs must be the next row's obs inside an episode, and must not be at its end."""
    kept = int(ends[-1])
    gap = np.empty(kept - 1, np.float32)  # largest difference over agents and entries
    for start in range(0, kept - 1, CHUNK):
        stop = min(start + CHUNK, kept - 1)
        gap[start:stop] = np.abs(following[start:stop] - observations[start + 1 : stop + 1]).max((1, 2))
    boundary = np.zeros(kept, bool)
    boundary[ends - 1] = True
    boundary = boundary[:-1]
    breaks_here = gap > STATE_SLACK  # neither this nor the next where a value is NaN, which the store refuses
    goes_on = gap <= STATE_SLACK
    wrong = np.flatnonzero(np.where(boundary, goes_on, breaks_here))
    if not len(wrong):
        return
    row = int(wrong[0])
    breaks = np.flatnonzero(breaks_here)
    first = f"the first break comes after {breaks[0] + 1} rows" if len(breaks) else "the rows never break"
    if boundary[row]:
        raise StoreError(
            f"'{directory}': row {row} ends an episode of {length} steps, but row {row + 1} goes on from it ({first}); "
            "pass the right episode_length."
        )
    raise StoreError(
        f"'{directory}': next_obs of row {row} differs from obs of row {row + 1} by {gap[row]:.3g} inside an episode "
        f"of {length} steps ({first}); pass the right episode_length, or unshuffled files."
    )


def _global_state(env: SimpleSpread, observations: np.ndarray) -> np.ndarray:
    return np.asarray(env.global_state(env.from_observations(jnp.asarray(observations))))


def _costs(
    hazard: constraints.Hazard, env: SimpleSpread, state: np.ndarray, final_state: np.ndarray, ends: np.ndarray
) -> np.ndarray:
    """(T,) 1 where the state that a step leads to is unsafe for any agent."""
    view = env.feature_map("pruned")
    bound = constraints.bind(hazard, view.names, env.n_agents)
    if not bound.has_formula:
        raise StoreError("OMAR's files hold no costs, so CostColumn has nothing to read; pass a hazard with a formula.")
    reached = np.concatenate([state[1:], final_state[-1:]])
    reached[ends - 1] = final_state
    labels = jax.jit(bound.labels)
    chunks = [reached[start : start + CHUNK] for start in range(0, len(reached), CHUNK)]
    unsafe = [labels(view(None, chunk))[0] for chunk in chunks]
    return np.any(np.concatenate(unsafe), axis=-1).astype(np.float32)


def _observation_names(n: int) -> tuple[str, ...]:
    """Names as in the `decentralized` view, with the silent channel behind them."""
    spoken = tuple(f"other{j}.said{c}" for j in range(n - 1) for c in "01")
    return SimpleSpread(n_agents=n).feature_map("decentralized").names + spoken


def _task_name(directory: Path, n: int) -> str:
    """`simple_spread-<tier>` if one of the last three folders names a tier and such a task exists."""
    for part in reversed(directory.resolve().parts[-3:]):
        match = TIER.fullmatch(part.lower())
        name = match and f"simple_spread-{match[1].replace('_', '-')}"
        if name and _agents_of(name) == n:
            return name
    return "simple_spread-imported"


def _agents_of(task: str) -> int | None:
    """How many agents a task of that name has; None where there is none."""
    known = registry.TASKS.get(task)
    return None if known is None or known.env is None else known.env.n_agents
