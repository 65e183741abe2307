"""Read OG-MARL's robots (Formanek et al. 2023): Vaults, and the arrays that MADIFF made of the older release.

Both were recorded with the old multi-agent MuJoCo, whose observations are not those of Safe Multi-Agent MuJoCo; its
*states* are, up to what follows them. So everything is rebuilt from states:

* a Vault holds states; MADIFF's arrays hold none, but HalfCheetah's follows from its observations. The Ant's does not:
  z, orientation and vy are in no observation, so its arrays keep their own observations, no simulator can evaluate what
  is learned from them, and speed means |vx|;
* the order of HalfCheetah's actions differs between versions of the old code. One step is replayed in the simulator
  with each order; the one that reproduces the next state is taken, and a data set that neither reproduces is refused;
* what an episode's last action led to is not recorded. Where there are states it is replayed in the simulator, which
  also tells an Ant's fall from a time limit; the flags do not. Where there are none, the step is dropped;
* the speed follows from the reward, vx = r + 0.1 ‖a‖² (HalfCheetah) or r − 1 + 0.5 ‖a‖² (Ant, and what contact forces
  cost where they were charged); vy is the mean of both ends' of a step, 0.01 m/s off in the median. The replay checks
  vx, since rewards may have been scaled or shared out.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.envs import SafeMuJoCo
from ringfence.envs.base import Outcome
from ringfence.envs.mujoco import COST_LIMIT
from ringfence.errors import StoreError, reading
from ringfence.logs.io.common import inside, without_last_steps
from ringfence.problem import constraints
from ringfence.utils.arrays import affordable
from ringfence.utils.files import read_npy

OLD_OBSERVATION = {"2x3": 13, "2x4": 54, "4x2": 33}
REPLAYED = 256  # steps that are replayed to find the order of actions
AGREES = 0.05  # median over replayed steps of the largest error in the state; the wrong order has errors of 1 to 10
STRAY = 1.0  # a replayed step that misses by more is a stray
STRAYS = 0.05  # the share of them that is allowed
SPEED_AGREES = 0.1  # m/s, median over replayed steps of the error of the speed that the reward tells
VAULT = ("actions", "rewards", "terminals", "truncations", "infos.state")
RECORDED_WITH = "multiagent_mujoco 1.1, MuJoCo 2.1 (OG-MARL's word; the files do not say)"
GYMNASIUM_FORCES = 78  # contact forces in the states of gymnasium-robotics' Ant, which leaves out the world's six
CONTACT = 5e-4  # of the squared contact forces, which some versions of the Ant charge


@dataclass(frozen=True)
class Log:
    """A flat recording; T steps, one robot."""

    where: str
    actions: np.ndarray  # (T, N, A)
    rewards: np.ndarray  # (T, N), or (T, 1) of the team
    last: np.ndarray  # (T,) bool: the step ended an episode


@dataclass(frozen=True)
class StateLog(Log):
    """One that holds the simulator's states."""

    state: np.ndarray  # (T, S) in the layout of SafeMuJoCo
    contact: np.ndarray | None = None  # (T, F) contact forces, where the states hold them


@dataclass(frozen=True)
class ObservationLog(Log):
    """One that holds observations alone."""

    observations: np.ndarray  # (T, N, O)


Made = tuple[dict[str, Any], np.ndarray, str]  # arrays by name, (T,) speed in m/s, what it was recorded with


def read_vault(vault: Path, env: SafeMuJoCo) -> dict[str, Any]:
    """What `EpisodeStore.from_steps` takes, of a Vault of the robot `env`, under whose limit costs are; its card has no
    task."""
    where = f"Vault '{vault}'"
    arrays = _read_vault(vault, VAULT)
    for name in VAULT:
        if name not in arrays:
            raise StoreError(
                f"{where} holds no '{name}'; only recordings with actions, rewards and states can be read."
            )
    sequences, steps = arrays["actions"].shape[:2]
    _check_shape(where, "actions", arrays["actions"], (sequences, steps, env.n_agents, env.action_dim))
    states = arrays["infos.state"]
    if states.ndim == 4:
        states = states[:, :, 0]  # some copies repeat them for every agent
    known = (27, 105, 111) if env.ant else (17,)
    if states.ndim != 3 or states.shape[-1] not in known:
        raise StoreError(
            f"{where} has states of {states.shape[-1]} entries; known layouts of {env.name} have "
            f"{', '.join(map(str, known))} (positions but the planar place, velocities, contact forces)."
        )
    width = len(env.state_names)
    for name in ("rewards", "terminals", "truncations"):  # of every agent, or of the team
        if arrays[name].ndim == 2:
            arrays[name] = np.repeat(arrays[name][..., None], env.n_agents, -1)
        _check_shape(where, name, arrays[name], (sequences, steps, env.n_agents))
    last = np.any((arrays["terminals"] > 0) | (arrays["truncations"] > 0), axis=-1)
    unended = int((~last[:, -1]).sum())
    last[:, -1] = True  # nothing after a sequence's end belongs to it

    def flat(x: np.ndarray) -> np.ndarray:
        return x.reshape(sequences * steps, *x.shape[2:])

    log = StateLog(
        where=where,
        actions=flat(arrays["actions"]),
        rewards=flat(arrays["rewards"]),
        last=last.ravel(),
        state=flat(states[..., :width]),
        contact=flat(states[..., width:]) if states.shape[-1] > width else None,
    )
    notes = []
    if unended:
        notes.append(f"{unended} episodes at the end of a recording have no end of their own and count as cut off")
    return _steps(log, env, f"imported from an OG-MARL Vault, '{vault}'", notes)


def read_madiff(directory: Path, env: SafeMuJoCo) -> dict[str, Any]:
    """The same of MADIFF's `obs.npy` (T, N, N+O), `actions.npy`, `rewards.npy`, `path_lengths.npy`. There is no `state`
    of the Ant."""
    n = env.n_agents
    where = f"'{directory}'"
    observations = _load(directory, "obs")
    actions = _load(directory, "actions")
    rewards = _load(directory, "rewards")
    lengths = _load(directory, "path_lengths")
    whole = lengths.dtype.kind != "b" and ((lengths >= 1) & (lengths % 1 == 0)).all()
    if lengths.ndim != 1 or not whole:
        raise StoreError(f"{where}: path_lengths.npy must hold the steps of every episode, whole numbers of 1 or more.")
    lengths = lengths.astype(np.int64)
    steps = int(lengths.sum())
    _check_shape(where, "obs.npy", observations, (steps, n, n + OLD_OBSERVATION[env.parts]))
    _check_shape(where, "actions.npy", actions, (steps, n, env.action_dim))
    if rewards.shape in ((steps,), (steps, 1), (steps, n, 1)):  # of the team, or with an axis too many
        rewards = rewards.reshape(steps, -1)
    of_team = rewards.shape[-1:] == (1,)
    _check_shape(where, "rewards.npy", rewards, (steps, 1 if of_team else n))
    _check_finite(where, {"obs.npy": observations, "actions.npy": actions, "rewards.npy": rewards})
    if not (observations[:, :, :n] == np.eye(n)).all():
        raise StoreError(
            f"{where}: obs.npy does not begin with every agent's number in one-hot form; it is not MADIFF's."
        )
    observations = observations[:, :, n:]
    last = np.zeros(steps, bool)
    last[np.cumsum(lengths) - 1] = True
    provenance = f"imported from MADIFF's arrays in {where}"
    if env.ant:
        return _steps(ObservationLog(where, actions, rewards, last, observations), env, provenance, [])
    return _steps(StateLog(where, actions, rewards, last, _cheetah_state(where, observations)), env, provenance, [])


def _cheetah_state(where: str, obs: np.ndarray) -> np.ndarray:
    """(T, 17) from (T, 2, 13): own (q, v) of foot, shin, thigh; the other thigh; vx, vpitch, vz; x, pitch, z."""
    if not np.allclose(obs[:, 0, 7:], obs[:, 1, 7:], atol=1e-4):
        raise StoreError(f"{where}: the two halves see different torsos, so obs.npy is in no known layout.")
    own = obs[:, :, :6].reshape(len(obs), 2, 3, 2)[:, :, ::-1]  # thigh, shin, foot
    vx, vpitch, vz, _, pitch, z = np.moveaxis(obs[:, 0, 7:], 1, 0)
    position, velocity = own[..., 0].reshape(-1, 6), own[..., 1].reshape(-1, 6)
    return np.column_stack([z, pitch, position, vx, vz, vpitch, velocity])


def _steps(log: StateLog | ObservationLog, env: SafeMuJoCo, provenance: str, notes: list[str]) -> dict[str, Any]:
    """What `EpisodeStore.from_steps` takes."""
    arrays = ("state", "contact", "observations", "actions", "rewards")
    _check_finite(log.where, {name: getattr(log, name, None) for name in arrays})
    ends = _ends(log, env, notes)
    if isinstance(log, StateLog):
        steps, speed, simulator = _from_states(log, env, ends, notes)
        names, fast = list(env.observation_names), ("torso.vx", "torso.vy") if env.ant else ("torso.vx",)
    else:
        steps, speed, simulator = _from_observations(log, env, ends, notes)
        near = env.n_agents - 1 if env.parts == "4x2" else 2
        own = log.observations.shape[2] - near - 2
        names = [f"own{k}" for k in range(own)] + [f"near{k}.q" for k in range(near)] + ["torso.vx", "torso.x"]
        fast = ("torso.vx",)
    short = int((np.diff(ends, prepend=0) < env.episode_length).sum() - steps["terminated"].sum())
    if env.ant and short:
        notes.append(f"{short} episodes are shorter than {env.episode_length} steps without a fall that is known of")
    card = {
        "simulator": simulator,
        "provenance": provenance,
        "agents": [f"agent{i}" for i in range(env.n_agents)],
        "observation_names": names,
        "state_names": list(env.state_names) if "state" in steps else [],
        "hazard": constraints.to_dict(constraints.SpeedLimit(env.limit, fast)),
        "episode_length": env.episode_length,
        "warnings": notes,
        **env.describe(speed, COST_LIMIT),
    }
    return {**steps, "costs": speed > env.limit, "card": card}


def _ends(log: StateLog | ObservationLog, env: SafeMuJoCo, notes: list[str]) -> np.ndarray:
    """(E,) where the log's whole episodes end; what is odd about them is noted."""
    if not log.last.any():
        raise StoreError(f"{log.where} marks no end of an episode; cut it into episodes first.")
    ends = np.flatnonzero(log.last) + 1
    total = int(ends[-1])
    lengths = np.diff(ends, prepend=0)
    if total < len(log.actions):
        notes.append(f"the last {len(log.actions) - total} steps are an unfinished episode and were dropped")
    if (lengths > env.episode_length).any():
        raise StoreError(
            f"{log.where} has an episode of {lengths.max()} steps, {env.name} ends after {env.episode_length}; "
            "its ends are marked wrongly."
        )
    beyond = float((np.abs(log.actions[:total]) > 1 + 1e-3).mean())
    if beyond:
        notes.append(f"{100 * beyond:.2g} % of action entries are beyond ±1 and were clipped, as the robot does")
    return ends


def _check_finite(where: str, arrays: dict[str, np.ndarray | None]) -> None:
    for name, x in arrays.items():
        if x is not None and not np.isfinite(x).all():
            row = int(np.argwhere(~np.isfinite(x).reshape(len(x), -1).all(1))[0, 0])
            raise StoreError(f"{where}: {name} of step {row} is not finite (some pad with -inf); cut those rows first.")


def _earned_by_running(env: SafeMuJoCo, rewards: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """(T,) the part of rewards (T,) that is neither for actions (T, N, A) nor, on the Ant, for standing."""
    effort = (actions**2).sum((1, 2))
    return rewards + (0.5 * effort - 1.0 if env.ant else 0.1 * effort)


def _forward_speed(log: Log, env: SafeMuJoCo, total: int, contact: np.ndarray | None = None) -> np.ndarray:
    """(T,) vx of every step, from its reward; `contact` (T', F): forces that it was charged for, those after the
    step."""
    vx = _earned_by_running(env, _team_rewards(log)[:total], log.actions[:total].astype(np.float64))
    if contact is not None:
        after = np.append(contact[1:total], contact[total - 1 : total], 0)
        vx += CONTACT * (np.clip(after, -1.0, 1.0) ** 2).sum(1)
    return vx


def _team_rewards(log: Log) -> np.ndarray:
    """(T,) as recorded."""
    return log.rewards.astype(np.float64).mean(-1)


def _from_states(log: StateLog, env: SafeMuJoCo, ends: np.ndarray, notes: list[str]) -> Made:
    """Episodes that end with what the simulator says their last action led to."""
    total = int(ends[-1])
    at = ends - 1
    actions = np.clip(log.actions[:total], -1.0, 1.0).astype(np.float64)
    rewards = _team_rewards(log)[:total]
    order, vx = _replay(log, env, actions, np.flatnonzero(inside(ends)), notes)
    actions = actions[:, :, order]
    outcome, final_state = _one_step(env, log.state[at], actions[at])
    falls = f", in which {int(outcome.terminated.sum())} of {len(ends)} episodes end with a fall" if env.ant else ""
    notes.append(
        f"what the last action of every episode led to is not recorded: it was replayed in the simulator{falls}"
    )
    # Gymnasium's version 5 does not pay the 1 for standing on the step that falls: its reward tells 1 m/s too little.
    missing = outcome.reward - rewards[at]
    unpaid = outcome.terminated & (np.abs(missing - 1.0) < np.abs(missing))
    vx[at[unpaid]] += 1.0
    if unpaid.any():
        notes.append(f"{int(unpaid.sum())} falls were not paid the 1 for standing; their speed is corrected")
    state = log.state[:total].astype(np.float32)
    final_state = final_state.astype(np.float32)
    speed = np.abs(vx)
    if env.ant:
        sideways = env.state_names.index("torso.vy")
        after = np.append(state[1:, sideways], 0.0)
        after[at] = final_state[:, sideways]
        speed = np.hypot(vx, (state[:, sideways] + after) / 2)
    newer = unpaid.any() or (log.contact is not None and log.contact.shape[1] == GYMNASIUM_FORCES)
    steps = {
        "observations": state[:, env.observed],
        "actions": actions,
        "rewards": rewards,
        "episode_ends": ends,
        "final_observations": final_state[:, env.observed],
        "terminated": outcome.terminated,
        "state": state,
        "final_state": final_state,
    }
    return steps, speed, "gymnasium-robotics, version not recorded" if newer else RECORDED_WITH


def _from_observations(log: ObservationLog, env: SafeMuJoCo, ends: np.ndarray, notes: list[str]) -> Made:
    """Episodes without states, the last step of each missing."""
    notes += [
        "the last step of every episode was dropped: what it led to is not recorded, and falls are not marked",
        "vy, height and orientation are in no observation and cannot be recovered: costs and hazard read |vx| "
        "alone, and the simulator cannot evaluate what is learned from this data",
        "without states nothing could be replayed: rewards and the order of actions are taken as recorded",
    ]
    total = int(ends[-1])
    kept, ends, last = without_last_steps(ends)
    if not len(ends):
        raise StoreError(f"{log.where} holds no episode of two steps or more.")
    observations = log.observations.astype(np.float32)
    steps = {
        "observations": observations[kept],
        "actions": np.clip(log.actions[kept], -1.0, 1.0),
        "rewards": _team_rewards(log)[kept],
        "episode_ends": ends,
        "final_observations": observations[last],
        "terminated": np.zeros(len(ends), bool),
    }
    return steps, np.abs(_forward_speed(log, env, total))[kept], RECORDED_WITH


def _one_step(env: SafeMuJoCo, state: np.ndarray, actions: np.ndarray) -> tuple[Outcome, np.ndarray]:
    """What the simulator makes of actions (B, N, A) in states (B, S): its outcome and the next states."""
    sim = env.simulate(len(state))
    planar = 2 if env.ant else 1  # entries of the place, which states leave out
    positions = (15 if env.ant else 9) - planar
    state = state.astype(np.float64)
    place = np.zeros((len(state), planar))
    sim.restore(np.concatenate([place, state[:, :positions]], 1), state[:, positions:])
    return sim.step(actions), sim.state()


def _replay(
    log: StateLog, env: SafeMuJoCo, actions: np.ndarray, steps: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """(order of an agent's action entries, vx (T,)), checked by replaying some of `steps` in the simulator."""
    if not len(steps):
        raise StoreError(f"{log.where} holds no episode of two steps or more.")
    steps = np.sort(np.random.default_rng(0).permutation(steps)[:REPLAYED])
    forward = np.arange(env.action_dim)
    orders = {"as recorded": forward, "reversed": forward[::-1]}
    errors: dict[str, np.ndarray] = {}
    rewards: dict[str, np.ndarray] = {}
    for name, order in orders.items():
        outcome, after = _one_step(env, log.state[steps], actions[steps][:, :, order])
        errors[name] = np.abs(after - log.state[steps + 1]).max(1)
        rewards[name] = outcome.reward
    best, other = sorted(errors, key=lambda name: float(np.median(errors[name])))
    miss = float(np.median(errors[best]))
    astray = errors[best] > STRAY
    if miss > AGREES:
        raise StoreError(
            f"{log.where} is not this robot's: one step in the simulator misses the recorded state by "
            f"{miss:.3g} in the median ({AGREES} is allowed) in either order of actions; check the task."
        )
    if astray.mean() > STRAYS:
        raise StoreError(
            f"{log.where}: {100 * astray.mean():.0f} % of replayed steps miss the next recorded state by more than "
            f"{STRAY:g} ({100 * STRAYS:.0f} % are allowed), the first of them step {steps[astray][0]}; its rows are "
            "not consecutive, so put them in order and mark the ends of episodes."
        )
    wanted = _earned_by_running(env, rewards[best], actions[steps])
    vx, speed_note = _checked_speed(log, env, len(actions), steps, wanted)
    notes.append(
        f"actions are {best}: a replayed step misses by {miss:.2g} in the median, in the other "
        f"order by {np.median(errors[other]):.2g}; {100 * astray.mean():.2g} % miss by more than {STRAY:g}"
    )
    notes.append(speed_note)
    return orders[best], vx


def _checked_speed(
    log: StateLog, env: SafeMuJoCo, total: int, steps: np.ndarray, wanted: np.ndarray
) -> tuple[np.ndarray, str]:
    """(vx (T,) from rewards, a note of how), with or without a charge for contact, whichever agrees better with that of
    replayed steps: `wanted` (K,) of `steps` (K,)."""

    def error(vx: np.ndarray) -> float:
        return float(np.median(np.abs(vx[steps] - wanted)))

    vx = _forward_speed(log, env, total)
    how = ""
    if log.contact is not None:
        charged = _forward_speed(log, env, total, log.contact)
        if error(charged) < error(vx):
            vx = charged
            how = ", contact forces charged"
    off = error(vx)
    if off > SPEED_AGREES:
        raise StoreError(
            f"{log.where}: rewards are not this robot's, the speed that they tell is {off:.3g} m/s off in the "
            f"median ({SPEED_AGREES} is allowed); undo any scaling or sharing out of rewards first."
        )
    return vx, f"speeds follow from rewards, {off:.2g} m/s off in the median{how}"


def _check_shape(where: str, name: str, array: np.ndarray, wanted: tuple[int, ...]) -> None:
    if array.shape != wanted:
        raise StoreError(
            f"{where}: {name} has shape {array.shape}, {wanted} is expected; known are halfcheetah_2x3 "
            "(2 agents, 3 actions, 13 observations), ant_2x4 (2, 4, 54) and ant_4x2 (4, 2, 33)."
        )


def _load(directory: Path, name: str) -> np.ndarray:
    file = directory / f"{name}.npy"
    if not file.is_file():
        raise StoreError(
            f"'{directory}' lacks {name}.npy; pass a folder of MADIFF's robots (obs.npy, actions.npy, ...)."
        )
    return read_npy(file)


def _read_vault(vault: Path, wanted: Sequence[str]) -> dict[str, np.ndarray]:
    """Those of the `wanted` arrays that a Vault holds, by dotted name, (B, T, ...). A Vault is zarr arrays in an OCDBT
    store, with their names in metadata.json."""
    try:
        import tensorstore
    except ImportError:
        raise StoreError("Reading a Vault needs tensorstore; run pip install 'ringfence[vault]'.") from None
    file = vault / "metadata.json"
    if not file.is_file():
        below = sorted({str(f.parent.relative_to(vault)) for f in vault.glob("*/metadata.json")})
        hint = f"; pass one of its subfolders: {', '.join(below)}" if below else ""
        raise StoreError(f"'{vault}' holds no metadata.json, so it is no Vault{hint}.")
    with reading(file, "Vault's metadata", "copy the Vault again"):
        shapes = json.loads(file.read_text())["structure_shape"]
        names = [name for name in _leaves(shapes) if name in wanted]
    stored = sum(part.stat().st_size for part in vault.rglob("*") if part.is_file())

    def read(name: str, cut: slice | None = None) -> np.ndarray:
        base = {"driver": "ocdbt", "base": f"file://{vault.resolve()}", "path": name}
        with reading(vault / name, "array of a Vault", "copy the Vault again"):
            array = tensorstore.open({"driver": "zarr", "kvstore": base}).result()
            array = array if cut is None else array[:, cut]
            affordable(vault, array.dtype.numpy_dtype.itemsize * array.size, stored=stored)
            return np.asarray(array.read().result())

    steps = int(read("vault_index")[0])
    if steps < 2:
        raise StoreError(f"'{vault}' holds {steps} steps; it was never filled.")
    return {name: read(f"{name}.", slice(steps)) for name in names}


def _leaves(tree: dict[str, Any], lead: str = "") -> Iterator[str]:
    for name, part in tree.items():
        if isinstance(part, dict):
            yield from _leaves(part, f"{lead}{name}.")
        else:
            yield f"{lead}{name}"
