"""Read OMAR's Simple Spread arrays (Pan et al. 2022), which MADIFF and others use, too.

A directory holds, for every agent i, `obs_i.npy` (M, O), `acs_i.npy` (M, 2), `rews_i.npy` (M,), `dones_i.npy` (M,) and
`next_obs_i.npy` (M, O): one learner's transitions in the order of time. What the files do not say, and is done here:

* `dones` are all zero, so episodes are cut every 25 steps; an unfinished last one is dropped;
* every episode's last state comes from `next_obs`; in copies without those files (MADIFF reads none) the last step of
  every episode is dropped, because nothing says where it led;
* the global state is recovered from the joint observation; costs are recomputed from a hazard on the states reached.

Whatever contradicts Simple Spread or the length of episodes is refused, with file and row. Several directories are to
be one for each seed of the learner; the literature trains on all five.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs import SimpleSpread
from ringfence.errors import StoreError
from ringfence.logs.io.common import inside, without_last_steps
from ringfence.problem import constraints
from ringfence.utils.files import read_npy

REQUIRED = ("obs", "acs", "rews", "dones")  # next_obs may be absent
ACTION_SLACK = 1e-3  # rounding beyond the bounds that is clipped; more is an error
STATE_SLACK = 1e-3  # m or m/s; two records of the same state differ by rounding alone
REWARD_SLACK = 0.05  # of a reward of up to 30, which changes fast near a landmark
CHUNK = 50_000  # rows at a time
CHECKED = 2_000  # first steps of each of several seeds, which must be of one simulator


def read_seed(directory: Path, hazard: constraints.Hazard, episode_length: int = 25) -> dict[str, Any]:
    """What `EpisodeStore.from_steps` takes, of one directory; its card has no task. `hazard` defines the costs."""
    n, has_next = survey(directory)
    if episode_length < 1 or (episode_length < 2 and not has_next):
        raise StoreError(f"episode_length={episode_length} leaves no whole step; OMAR's episodes have 25.")
    env = SimpleSpread(n_agents=n, episode_length=episode_length)
    observations = _observations(directory, "obs", env)
    rows = len(observations)
    actions = _clip(directory, _agents(directory, "acs", n, rows, 2))
    rewards = _agents(directory, "rews", n, rows, None)
    dones = np.all(_agents(directory, "dones", n, rows, None).astype(bool), axis=1)
    following = _observations(directory, "next_obs", env, rows) if has_next else None
    ends = _episode_ends(dones, episode_length)
    if not len(ends):
        raise StoreError(
            f"'{directory}' holds {rows} rows, fewer than one episode of {episode_length}; pass a smaller "
            "episode_length."
        )
    notes = []
    kept = int(ends[-1])
    if kept < rows:
        notes.append(f"the last {rows - kept} rows are an unfinished episode and were dropped")
    if dones[:kept].any():
        notes.append("dones are set; a done before the time limit is read as a termination, at the limit as truncation")
    if following is not None:
        _check_order(directory, observations, following, ends, episode_length)
        steps = slice(kept)
        final = following[ends - 1]
        terminated = dones[ends - 1] & (np.diff(ends, prepend=0) < episode_length)
    else:
        notes.append("next_obs is missing, so the last step of every episode was dropped")
        steps, ends, last = without_last_steps(ends)
        final = observations[last]
        terminated = np.zeros(len(ends), bool)  # where they ended is not recorded
    observations = observations[steps]
    silent = [f"other{j}.said{c}" for j in range(n - 1) for c in "01"]  # the channel, which nobody speaks on
    state, final_state = _global_state(env, observations), _global_state(env, final)
    return {
        "observations": observations,
        "actions": actions[steps],
        "rewards": rewards[steps],
        "episode_ends": ends,
        "final_observations": final,
        "state": state,
        "final_state": final_state,
        "terminated": terminated,
        "costs": _costs(hazard, env, _reached(state, final_state, ends)),
        "card": {
            "simulator": "multiagent-particle-envs simple_spread, as changed by OMAR",
            "provenance": f"imported from OMAR arrays in '{directory}'",
            "integrator": "velocity_first",
            "reward": "omar",
            "agents": [f"agent{i}" for i in range(n)],
            "observation_names": [*env.feature_map("decentralized").names, *silent],
            "state_names": list(env.state_names),
            "hazard": constraints.to_dict(hazard),
            "episode_length": episode_length,
            "warnings": notes,
        },
    }


# --- several seeds ---
def check_alike(directories: list[Path]) -> int:
    """How many agents all directories are of; refuses those that are given twice, are of different agents or hold
    different files."""
    if not directories:
        raise StoreError("No directory was given; pass those of the seeds, e.g. expert/seed_0_data expert/seed_1_data.")
    places = [d.resolve() for d in directories]
    for k, place in enumerate(places):
        if place in places[:k]:
            raise StoreError(f"'{directories[k]}' is given twice; name every seed once.")
    surveys = [survey(d) for d in directories]
    first, first_has_next = surveys[0]
    for directory, (n, has_next) in zip(directories, surveys):
        if n != first:
            raise StoreError(f"'{directory}' holds {n} agents, '{directories[0]}' {first}; pool seeds of one team.")
        if has_next != first_has_next:
            raise StoreError(
                f"'{directory}' and '{directories[0]}' do not both hold next_obs, so their episodes differ in length; "
                "pool seeds with the same files."
            )
    return first


def check_constants(directories: list[Path], seeds: list[dict[str, Any]]) -> None:
    """Refuse seeds of which one moves or is rewarded as Simple Spread says and another is not: their actions have other
    bounds, or their simulators other constants."""
    first, *others = map(_follows, seeds)
    for directory, found in zip(directories[1:], others):
        for what, here, there in zip(("moves", "is rewarded"), found, first):
            if here != there:
                raise StoreError(
                    f"'{directory}' {what} differently from '{directories[0]}', so action bounds or constants of their "
                    "simulators differ; pool seeds of one simulator."
                )


def _follows(steps: dict[str, Any]) -> tuple[bool, bool]:
    """Whether the first steps move, and are rewarded, as Simple Spread says (most of them: two records of a contact may
    differ)."""
    env = SimpleSpread(n_agents=steps["actions"].shape[1])
    reached = _reached(steps["state"], steps["final_state"], steps["episode_ends"])
    before = env.from_global_state(jnp.asarray(steps["state"][:CHECKED]))
    after, outcome = jax.jit(env.step)(before, jnp.asarray(steps["actions"][:CHECKED]))
    moved = np.abs(np.asarray(env.global_state(after)) - reached[:CHECKED]).max(-1)
    paid = np.abs(np.asarray(outcome.reward) - steps["rewards"][:CHECKED]).max(-1)
    return bool(np.median(moved) <= STATE_SLACK), bool(np.median(paid) <= REWARD_SLACK)


# --- the files ---
def survey(directory: Path) -> tuple[int, bool]:
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


def _observations(directory: Path, kind: str, env: SimpleSpread, rows: int | None = None) -> np.ndarray:
    """(M, N, O) of Simple Spread: joint observations that do not describe one state are files of different runs, or
    another environment, and refused."""
    found = _agents(directory, kind, env.n_agents, rows, env.observation_dim)
    seen = 4 + 2 * env.n_agents + 2 * (env.n_agents - 1)  # without the communication channel
    reconstruct = jax.jit(lambda x: env.observe(env.from_observations(x)))
    for start in range(0, len(found), CHUNK):
        given = found[start : start + CHUNK]
        expected = np.asarray(reconstruct(given))
        error = np.abs(expected - given)[..., :seen].max(-1)  # (M, N)
        if (error > STATE_SLACK).any():
            row, agent = np.argwhere(error > STATE_SLACK)[0].tolist()
            raise StoreError(
                f"'{directory / f'{kind}_{agent}.npy'}' row {start + row} contradicts the other agents' observations "
                f"by {error[row, agent]:.3g}; the files belong to different runs or another environment."
            )
    return found


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
    boundary = ~inside(ends)[:-1]
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


def _reached(state: np.ndarray, final_state: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """(T, S) the state that each step leads to."""
    reached = np.concatenate([state[1:], final_state[-1:]])
    reached[ends - 1] = final_state
    return reached


def _costs(hazard: constraints.Hazard, env: SimpleSpread, reached: np.ndarray) -> np.ndarray:
    """(T,) 1 where the state that a step leads to is unsafe for any agent."""
    view = env.feature_map("pruned")
    bound = constraints.bind(hazard, view.names, env.n_agents)
    if not bound.has_formula:
        raise StoreError("OMAR's files hold no costs, so CostColumn has nothing to read; pass a hazard with a formula.")
    labels = jax.jit(bound.labels)
    chunks = [reached[start : start + CHUNK] for start in range(0, len(reached), CHUNK)]
    unsafe = [labels(view(None, chunk))[0] for chunk in chunks]
    return np.any(np.concatenate(unsafe), axis=-1).astype(np.float32)
