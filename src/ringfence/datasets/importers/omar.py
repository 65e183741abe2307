"""Import OMAR's Simple Spread arrays (Pan et al. 2022), which MADIFF and others use, too.

A directory holds, for every agent i, `obs_i.npy` (M, O), `acs_i.npy` (M, 2), `rews_i.npy` (M,), `dones_i.npy` (M,) and
`next_obs_i.npy` (M, O): one learner's transitions in the order of time. What the files do not say, and is done here:

* `dones` are all zero, so episodes are cut every 25 steps; an unfinished last one is dropped;
* every episode's last state comes from `next_obs`; in copies without those files (MADIFF reads none) the last step of
  every episode is dropped, because nothing says where it led;
* the global state is recovered from the joint observation; costs are recomputed from a hazard on the states reached.

Whatever contradicts Simple Spread or the length of episodes is refused, with file and row.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import jax
import numpy as np

from ringfence.datasets import registry
from ringfence.envs import SimpleSpread
from ringfence.errors import StoreError
from ringfence.logs.schema import complete_card
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints

REQUIRED = ("obs", "acs", "rews", "dones")  # next_obs may be absent
TIER = re.compile(r"(?:simple_spread[-_])?(medium[-_]replay|medium|expert|random)")
ACTION_SLACK = 1e-3  # rounding beyond the bounds that is clipped; more is an error
STATE_SLACK = 1e-3  # m or m/s; two records of the same state differ by rounding alone
CHUNK = 50_000  # rows at a time


def import_omar(
    directory: str | os.PathLike,
    hazard: constraints.Hazard | None = None,
    task: str | None = None,
    episode_length: int = 25,
) -> EpisodeStore:
    """The store of one of OMAR's directories, e.g. `simple_spread/expert/seed_0_data`, for any number of agents.

    `hazard` defines the costs (default: `Separation(0.30)`, the contact of two agents). `task` defaults to
    `simple_spread-<tier>` where the path names the tier, else to `simple_spread-imported`.
    """
    if task is not None:
        complete_card({"task": task})  # a name that cannot be one is refused before the files are read
    directory = Path(directory)
    n, has_next = _survey(directory)
    if episode_length < 1 or (episode_length < 2 and not has_next):
        raise StoreError(f"episode_length={episode_length} leaves no whole step; OMAR's episodes have 25.")
    env = SimpleSpread(n_agents=n, episode_length=episode_length)
    task = _task_name(directory, n) if task is None else task
    known = registry.TASKS.get(task)
    if known is not None and known.env is not None and known.env.n_agents != n:
        raise StoreError(
            f"'{directory}' holds {n} agents, the task '{task}' has {known.env.n_agents}; pass another name as task."
        )

    width = env.observation_dim
    observations = _agents(directory, "obs", n, None, width)  # (M, N, O)
    rows = len(observations)
    actions = _agents(directory, "acs", n, rows, 2)
    rewards = _agents(directory, "rews", n, rows, None)
    dones = _agents(directory, "dones", n, rows, None).astype(bool).all(1)
    following = _agents(directory, "next_obs", n, rows, width) if has_next else None
    _check_state(directory, env, observations, "obs")
    if following is not None:
        _check_state(directory, env, following, "next_obs")
    actions = _clip(directory, actions)

    notes = []
    ends = _episode_ends(dones, episode_length)
    if not len(ends):
        raise StoreError(
            f"'{directory}' holds {rows} rows, fewer than one episode of {episode_length}; pass a smaller "
            "episode_length."
        )
    kept = int(ends[-1])
    if kept < rows:
        notes.append(f"the last {rows - kept} rows are an unfinished episode and were dropped")
    if dones[:kept].any():
        notes.append("dones are set; a done before the time limit is read as a termination, at the limit as truncation")
    if following is not None:
        _check_order(directory, observations, following, ends, episode_length)
    lengths = np.diff(ends, prepend=0)
    terminated = dones[ends - 1] & (lengths < episode_length)
    if following is not None:
        steps = np.arange(kept)
        final = following[ends - 1]
    else:
        notes.append("next_obs is missing, so the last step of every episode was dropped")
        long_enough = lengths > 1
        final = observations[ends[long_enough] - 1]
        inside = np.ones(kept, bool)
        inside[ends - 1] = False
        steps = np.flatnonzero(inside)
        ends = np.cumsum(lengths[long_enough] - 1)
        terminated = np.zeros(len(ends), bool)  # where they ended is not recorded

    state = _global_state(env, observations[steps])
    final_state = _global_state(env, final)
    store = EpisodeStore.from_steps(
        observations[steps],
        actions[steps],
        rewards[steps],
        episode_ends=ends,
        final_observations=final,
        state=state,
        final_state=final_state,
        terminated=terminated,
        costs=_costs(hazard or constraints.Separation(), env, state, final_state, ends),
        card={
            "task": task,
            "simulator": "multiagent-particle-envs simple_spread, as changed by OMAR",
            "provenance": f"imported from OMAR arrays in '{directory}'",
            "integrator": "velocity_first",
            "reward": "omar",
            "agents": [f"agent{i}" for i in range(n)],
            "observation_names": list(_observation_names(n)),
            "state_names": list(env.state_names),
            "hazard": constraints.to_dict(hazard or constraints.Separation()),
            "episode_length": episode_length,
            "warnings": notes,
        },
    )
    return store


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
            raise StoreError(f"'{directory}' holds several data sets; pass one of its subfolders: {names}{more}.")
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
        try:
            array = np.load(file, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise StoreError(f"'{file}' is truncated or no .npy file of numbers ({error}); copy it again.") from error
        if array.dtype.kind not in "fbiu":
            raise StoreError(f"'{file}' holds {array.dtype}, not numbers; save it as float32 or float64.")
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
    retell = jax.jit(lambda x: env.observe(env.from_observations(x)))
    for start in range(0, len(observations), CHUNK):
        given = observations[start : start + CHUNK]
        told = np.asarray(retell(given))
        error = np.abs(told - given)[..., :seen].max(-1)  # (M, N)
        if (error > STATE_SLACK).any():
            row, agent = (int(v) for v in np.argwhere(error > STATE_SLACK)[0])
            raise StoreError(
                f"'{directory / f'{kind}_{agent}.npy'}' row {start + row} contradicts the other agents' observations "
                f"by {error[row, agent]:.3g}; the files belong to different runs or another environment."
            )


def _clip(directory: Path, actions: np.ndarray) -> np.ndarray:
    beyond = np.abs(actions) - 1.0
    if (beyond >= ACTION_SLACK).any():
        row, agent, entry = (int(v) for v in np.argwhere(beyond >= ACTION_SLACK)[0])
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
    parts = [np.arange(a + length, b + 1, length) for a, b in zip(starts, stops)]
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
    apart, together = gap > STATE_SLACK, gap <= STATE_SLACK  # neither where a value is NaN, which the store refuses
    wrong = np.flatnonzero(np.where(boundary, together, apart))
    if not len(wrong):
        return
    row, breaks = int(wrong[0]), np.flatnonzero(apart)
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
    return np.asarray(env.global_state(env.from_observations(observations)))


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
    unsafe = [labels(view(None, reached[i : i + CHUNK]))[0] for i in range(0, len(reached), CHUNK)]
    return np.concatenate(unsafe).any(-1).astype(np.float32)


def _observation_names(n: int) -> tuple[str, ...]:
    """Names as in the `decentralized` view, with the silent channel behind them."""
    spoken = tuple(f"other{j}.said{c}" for j in range(n - 1) for c in "01")
    return SimpleSpread(n_agents=n).feature_map("decentralized").names + spoken


def _task_name(directory: Path, n: int) -> str:
    """`simple_spread-<tier>` if one of the last three folders names a tier and such a task exists."""
    for part in reversed(directory.resolve().parts[-3:]):
        match = TIER.fullmatch(part.lower())
        name = match and f"simple_spread-{match[1].replace('_', '-')}"
        if name in registry.TASKS and registry.TASKS[name].env.n_agents == n:
            return name
    return "simple_spread-imported"
