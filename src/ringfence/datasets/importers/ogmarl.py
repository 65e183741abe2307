"""Import OG-MARL's robots (Formanek et al. 2023): Vaults, and the arrays that MADIFF made of the older release.

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
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ringfence.datasets.registry import QUANTILE_LIMITS, ROBOT_COST_LIMIT
from ringfence.envs import SafeMuJoCo, mujoco
from ringfence.envs.mujoco import Outcome
from ringfence.errors import StoreError, UserError, unknown
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints

ROBOTS = {SafeMuJoCo(parts).name: parts for parts in mujoco.ROBOTS}
OLD_OBSERVATION = {"2x3": 13, "2x4": 54, "4x2": 33}
TIERS = ("good", "medium", "poor", "expert", "replay")
REPLAYED = 256  # steps that are replayed to find the order of actions
AGREES = 0.05  # median over replayed steps of the largest error in the state; the wrong order has errors of 1 to 10
STRAY, STRAYS = 1.0, 0.05  # a replayed step that misses by more is a stray; the share of them that is allowed
SPEED_AGREES = 0.1  # m/s, median over replayed steps of the error of the speed that the reward tells
Limit = float | Literal["quantile"] | None
RECORDED_WITH = "multiagent_mujoco 1.1, MuJoCo 2.1 (OG-MARL's word; the files do not say)"
GYMNASIUM_FORCES = 78  # contact forces in the states of gymnasium-robotics' Ant, which leaves out the world's six
CONTACT = 5e-4  # of the squared contact forces, which some versions of the Ant charge


@dataclass
class Log:
    """A flat recording; T steps, one robot."""

    where: str
    state: np.ndarray | None  # (T, S) in the layout of SafeMuJoCo
    contact: np.ndarray | None  # (T, F) contact forces, where the states hold them
    observations: np.ndarray | None  # (T, N, O), where there is no state
    actions: np.ndarray  # (T, N, A)
    rewards: np.ndarray  # (T, N)
    last: np.ndarray  # (T,) bool: the step ended an episode


def import_vault(
    vault: str | os.PathLike, task: str, speed_limit: Limit = None, tier: str | None = None
) -> EpisodeStore:
    """The store of a Vault, e.g. `2halfcheetah.vlt/Good`; `task`: halfcheetah_2x3, ant_2x4 or ant_4x2.

    `speed_limit`: safety-gymnasium's (None), that of the tier's `-quantile` task ("quantile"), or any other (m/s).
    `tier`: a word for the data; the folder's name, where it is good, medium, poor, expert or replay.
    """
    env, vault = _robot(task), Path(vault)
    env, called, protocol = _limited(env, f"{task}-{_tier(vault, tier)}", speed_limit)
    wanted = ("actions", "rewards", "terminals", "truncations", "infos.state")
    arrays = _read_vault(vault, wanted)
    where = f"Vault '{vault}'"
    for name in wanted:
        if name not in arrays:
            raise StoreError(
                f"{where} holds no '{name}'; only recordings with actions, rewards and states can be read."
            )
    sequences, steps = arrays["actions"].shape[:2]
    _shape(where, "actions", arrays["actions"], (sequences, steps, env.n_agents, env.action_dim))
    state = arrays["infos.state"]
    state = state[:, :, 0] if state.ndim == 4 else state  # some copies repeat it for every agent
    s = len(env.state_names)
    known = {17} if not env.ant else {27, 105, 111}
    if state.ndim != 3 or state.shape[-1] not in known:
        raise StoreError(
            f"{where} has states of {state.shape[-1]} entries; known layouts of {task} have "
            f"{', '.join(str(k) for k in sorted(known))} (positions but the planar place, velocities, contact forces)."
        )
    for name in ("rewards", "terminals", "truncations"):  # of every agent, or of the team
        if arrays[name].ndim == 2:
            arrays[name] = np.repeat(arrays[name][..., None], env.n_agents, -1)
        _shape(where, name, arrays[name], (sequences, steps, env.n_agents))
    last = ((arrays["terminals"] > 0) | (arrays["truncations"] > 0)).any(-1)
    open_ = int((~last[:, -1]).sum())
    last[:, -1] = True  # nothing after a sequence's end belongs to it
    flat = lambda x: x.reshape(sequences * steps, *x.shape[2:])  # noqa: E731
    contact = flat(state[..., s:]) if state.shape[-1] > s else None
    log = Log(
        where, flat(state[..., :s]), contact, None, flat(arrays["actions"]), flat(arrays["rewards"]), last.ravel()
    )
    notes = (
        [f"{open_} episodes at the end of a recording have no end of their own and count as cut off"] if open_ else []
    )
    return _store(log, env, called, protocol, f"imported from an OG-MARL Vault, '{vault}'", notes)


def import_madiff(
    directory: str | os.PathLike, task: str, speed_limit: Limit = None, tier: str | None = None
) -> EpisodeStore:
    """The store of MADIFF's `obs.npy` (T, N, N+O), `actions.npy`, `rewards.npy`, `path_lengths.npy`; `speed_limit` and
    `tier` as of `import_vault`."""
    env, directory = _robot(task), Path(directory)
    env, called, protocol = _limited(env, f"{task}-{_tier(directory, tier)}", speed_limit)
    where = f"'{directory}'"
    obs, actions, rewards, lengths = (_load(directory, f) for f in ("obs", "actions", "rewards", "path_lengths"))
    n, wide = env.n_agents, OLD_OBSERVATION[env.parts]
    if lengths.ndim != 1 or lengths.dtype.kind == "b" or not ((lengths >= 1) & (lengths % 1 == 0)).all():
        raise StoreError(f"{where}: path_lengths.npy must hold the steps of every episode, whole numbers of 1 or more.")
    lengths = lengths.astype(np.int64)
    steps = int(lengths.sum())
    _shape(where, "obs.npy", obs, (steps, n, n + wide))
    _shape(where, "actions.npy", actions, (steps, n, env.action_dim))
    if rewards.shape in ((steps,), (steps, 1), (steps, n, 1)):  # of the team, or with an axis too many
        rewards = rewards.reshape(steps, -1)
    _shape(where, "rewards.npy", rewards, (steps, rewards.shape[-1] if rewards.shape[-1:] == (1,) else n))
    _finite(where, {"obs.npy": obs, "actions.npy": actions, "rewards.npy": rewards})
    if not (obs[:, :, :n] == np.eye(n)).all():
        raise StoreError(
            f"{where}: obs.npy does not begin with every agent's number in one-hot form; it is not MADIFF's."
        )
    last = np.zeros(steps, bool)
    last[np.cumsum(lengths) - 1] = True
    obs = obs[:, :, n:]
    state = _cheetah_state(where, obs) if not env.ant else None
    log = Log(where, state, None, None if state is not None else obs, actions, rewards, last)
    return _store(log, env, called, protocol, f"imported from MADIFF's arrays in {where}", [])


def _limited(env: SafeMuJoCo, name: str, speed_limit: Limit) -> tuple[SafeMuJoCo, str, str]:
    """(the robot under its limit, the task's name, what the limit is): a name stands for one limit."""
    if speed_limit is None:
        return env, name, "native"
    if speed_limit == "quantile":
        if name not in QUANTILE_LIMITS:
            raise UserError(
                f"There is no quantile limit for '{name}'; name the tier with --tier good, medium or poor, or pass "
                "--speed-limit in m/s."
            )
        return replace(env, speed_limit=QUANTILE_LIMITS[name]), f"{name}-quantile", "quantile"
    return replace(env, speed_limit=float(speed_limit)), f"{name}-below-{speed_limit:g}", "own"


def _cheetah_state(where: str, obs: np.ndarray) -> np.ndarray:
    """(T, 17) from (T, 2, 13): own (q, v) of foot, shin, thigh; the other thigh; vx, vpitch, vz; x, pitch, z."""
    if not np.allclose(obs[:, 0, 7:], obs[:, 1, 7:], atol=1e-4):
        raise StoreError(f"{where}: the two halves see different torsos, so obs.npy is in no known layout.")
    own = obs[:, :, :6].reshape(len(obs), 2, 3, 2)[:, :, ::-1]  # thigh, shin, foot
    vx, vpitch, vz, _, pitch, z = np.moveaxis(obs[:, 0, 7:], 1, 0)
    position, velocity = own[..., 0].reshape(-1, 6), own[..., 1].reshape(-1, 6)
    return np.column_stack([z, pitch, position, vx, vz, vpitch, velocity])


def _store(log: Log, env: SafeMuJoCo, name: str, protocol: str, provenance: str, notes: list[str]) -> EpisodeStore:
    _finite(log.where, {k: getattr(log, k) for k in ("state", "contact", "observations", "actions", "rewards")})
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
    made = (_from_states if log.state is not None else _from_observations)(log, env, ends, notes)
    short = int((lengths < env.episode_length).sum() - made["terminated"].sum())
    if env.ant and short:
        notes.append(f"{short} episodes are shorter than {env.episode_length} steps without a fall that is known of")
    name += "" if log.state is not None else "-observations"
    speed, seen = made.pop("speed"), made.pop("seen")
    card = {
        "task": name,
        "simulator": made.pop("simulator"),
        "provenance": provenance,
        "agents": [f"agent{i}" for i in range(env.n_agents)],
        "observation_names": made.pop("names"),
        "state_names": list(env.state_names) if log.state is not None else [],
        "hazard": constraints.to_dict(constraints.SpeedLimit(env.limit, seen)),
        "episode_length": env.episode_length,
        "warnings": notes,
        "protocol": protocol,
        **env.describe(speed, ROBOT_COST_LIMIT),
    }
    return EpisodeStore.from_steps(**made, costs=speed > env.limit, card=card)


def _finite(where: str, arrays: dict[str, np.ndarray | None]) -> None:
    for name, x in arrays.items():
        if x is not None and not np.isfinite(x).all():
            row = int(np.argwhere(~np.isfinite(x).reshape(len(x), -1).all(1))[0, 0])
            raise StoreError(f"{where}: {name} of step {row} is not finite (some pad with -inf); cut those rows first.")


def _earned_by_running(env: SafeMuJoCo, rewards: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """(T,) the part of rewards (T,) that is neither for actions (T, N, A) nor, on the Ant, for standing."""
    effort = (actions**2).sum((1, 2))
    return rewards + (0.5 * effort - 1.0 if env.ant else 0.1 * effort)


def _forward_speed(log: Log, env: SafeMuJoCo, total: int, contact: bool = False) -> np.ndarray:
    """(T,) vx of every step, from its reward. Contact forces are those after the step."""
    rewards = log.rewards[:total].astype(np.float64).mean(-1)
    vx = _earned_by_running(env, rewards, log.actions[:total].astype(np.float64))  # as recorded: what was charged
    if contact:
        after = np.append(log.contact[1:total], log.contact[total - 1 : total], 0)
        vx += CONTACT * (np.clip(after, -1.0, 1.0) ** 2).sum(1)
    return vx


def _from_states(log: Log, env: SafeMuJoCo, ends: np.ndarray, notes: list[str]) -> dict:
    """Arrays of a store whose episodes end with what the simulator says their last action led to."""
    total, at = int(ends[-1]), ends - 1
    actions = np.clip(log.actions[:total], -1.0, 1.0).astype(np.float64)
    inside = np.ones(total, bool)
    inside[at] = False
    order, vx = _replay(log, env, actions, np.flatnonzero(inside), notes)
    actions = actions[:, :, order]
    outcome, final = _one_step(env, log.state[at], actions[at])
    notes.append(
        "what the last action of every episode led to is not recorded: it was replayed in the simulator"
        + (f", in which {int(outcome.terminated.sum())} of {len(ends)} episodes end with a fall" if env.ant else "")
    )
    # Gymnasium's version 5 does not pay the 1 for standing on the step that falls: its reward tells 1 m/s too little.
    missing = outcome.reward - log.rewards[at].mean(-1)
    unpaid = outcome.terminated & (np.abs(missing - 1.0) < np.abs(missing))
    vx[at[unpaid]] += 1.0
    if unpaid.any():
        notes.append(f"{int(unpaid.sum())} falls were not paid the 1 for standing; their speed is corrected")
    state, final = log.state[:total].astype(np.float32), final.astype(np.float32)
    speed, seen = np.abs(vx), ("torso.vx",)
    if env.ant:
        k = env.state_names.index("torso.vy")
        after = np.append(state[1:, k], 0.0)
        after[at] = final[:, k]
        speed, seen = np.hypot(vx, (state[:, k] + after) / 2), ("torso.vx", "torso.vy")
    newer = unpaid.any() or (log.contact is not None and log.contact.shape[1] == GYMNASIUM_FORCES)
    return {
        "simulator": "gymnasium-robotics, version not recorded" if newer else RECORDED_WITH,
        "observations": state[:, env.observed],
        "actions": actions,
        "rewards": log.rewards[:total].astype(np.float64).mean(-1),
        "episode_ends": ends,
        "final_observations": final[:, env.observed],
        "state": state,
        "final_state": final,
        "terminated": outcome.terminated,
        "speed": speed,
        "seen": seen,
        "names": list(env.observation_names),
    }


def _from_observations(log: Log, env: SafeMuJoCo, ends: np.ndarray, notes: list[str]) -> dict:
    """Arrays of a store without states; the last step of every episode is missing."""
    notes += [
        "the last step of every episode was dropped: what it led to is not recorded, and falls are not marked",
        "vy, height and orientation are in no observation and cannot be recovered: costs and hazard read |vx| "
        "alone, and the simulator cannot evaluate what is learned from this data",
        "without states nothing could be replayed: rewards and the order of actions are taken as recorded",
    ]
    total, lengths = int(ends[-1]), np.diff(ends, prepend=0)
    keep = np.ones(total, bool)
    keep[ends - 1] = False
    if not keep.any():
        raise StoreError(f"{log.where} holds no episode of two steps or more.")
    x = log.observations[:total].astype(np.float32)
    return {
        "simulator": RECORDED_WITH,
        "observations": x[keep],
        "actions": np.clip(log.actions[:total], -1.0, 1.0)[keep],
        "rewards": log.rewards[:total].astype(np.float64).mean(-1)[keep],
        "episode_ends": np.cumsum(lengths[lengths > 1] - 1),
        "final_observations": x[ends[lengths > 1] - 1],
        "terminated": np.zeros(int((lengths > 1).sum()), bool),
        "speed": np.abs(_forward_speed(log, env, total))[keep],
        "seen": ("torso.vx",),
        "names": _old_names(x.shape[2], env),
    }


def _one_step(env: SafeMuJoCo, state: np.ndarray, actions: np.ndarray) -> tuple[Outcome, np.ndarray]:
    """What the simulator makes of actions (B, N, A) in states (B, S): its outcome and the next states."""
    sim = env.simulate(len(state))
    planar, nq = (2, 15) if env.ant else (1, 9)
    state = state.astype(np.float64)
    sim.restore(np.concatenate([np.zeros((len(state), planar)), state[:, : nq - planar]], 1), state[:, nq - planar :])
    return sim.step(actions), sim.state()


def _replay(
    log: Log, env: SafeMuJoCo, actions: np.ndarray, steps: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """(order of an agent's action entries, vx (T,)), checked by replaying some of `steps` in the simulator."""
    if not len(steps):
        raise StoreError(f"{log.where} holds no episode of two steps or more.")
    steps = np.sort(np.random.default_rng(0).permutation(steps)[:REPLAYED])
    forward, errors, earned = np.arange(env.action_dim), {}, {}
    orders = {"as recorded": forward, "reversed": forward[::-1]}
    for name, order in orders.items():
        outcome, after = _one_step(env, log.state[steps], actions[steps][:, :, order])
        errors[name] = np.abs(after - log.state[steps + 1]).max(1)
        earned[name] = outcome.reward
    best, other = sorted(errors, key=lambda name: np.median(errors[name]))
    miss, astray = float(np.median(errors[best])), errors[best] > STRAY
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
    wanted = _earned_by_running(env, earned[best], actions[steps])
    told = {
        c: _forward_speed(log, env, len(actions), c) for c in ((False, True) if log.contact is not None else (False,))
    }
    off = {c: float(np.median(np.abs(vx[steps] - wanted))) for c, vx in told.items()}
    charged = min(off, key=off.get)
    if off[charged] > SPEED_AGREES:
        raise StoreError(
            f"{log.where}: rewards are not this robot's, the speed that they tell is {off[charged]:.3g} m/s off in the "
            f"median ({SPEED_AGREES} is allowed); undo any scaling or sharing out of rewards first."
        )
    notes.append(
        f"actions are {best}: a replayed step misses by {miss:.2g} in the median, in the other order by "
        f"{np.median(errors[other]):.2g}; {100 * astray.mean():.2g} % miss by more than {STRAY:g}"
    )
    notes.append(
        f"speeds follow from rewards, {off[charged]:.2g} m/s off in the median{', contact forces charged' * charged}"
    )
    return orders[best], told[charged]


def _old_names(width: int, env: SafeMuJoCo) -> list[str]:
    near = env.n_agents - 1 if env.parts == "4x2" else 2
    own = width - near - 2
    return [f"own{k}" for k in range(own)] + [f"near{k}.q" for k in range(near)] + ["torso.vx", "torso.x"]


def _robot(task: str) -> SafeMuJoCo:
    if task not in ROBOTS:
        raise unknown("robot", task, ROBOTS)
    return SafeMuJoCo(ROBOTS[task])


def _tier(path: Path, told: str | None) -> str:
    if told:
        return told.lower() if told.lower() in TIERS else told
    name = path.resolve().name.lower()
    return name if name in TIERS else "imported"


def _shape(where: str, name: str, array: np.ndarray, wanted: tuple[int, ...]) -> None:
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
    try:
        array = np.load(file, mmap_mode="r", allow_pickle=False)  # a header that lies is refused before it is believed
        if array.dtype.kind not in "biuf":
            raise ValueError(f"it holds entries of type {array.dtype}")
        return array
    except (OSError, ValueError, EOFError) as error:
        raise StoreError(f"'{file}' is truncated or no .npy file of numbers ({error}); copy it again.") from error


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
    try:
        shapes = json.loads(file.read_text())["structure_shape"]
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"'{file}' is damaged ({error}); copy the Vault again.") from error

    def read(name: str, cut: slice | None = None) -> np.ndarray:
        base = {"driver": "ocdbt", "base": f"file://{vault.resolve()}", "path": name}
        try:
            array = tensorstore.open({"driver": "zarr", "kvstore": base}).result()
            return np.asarray((array if cut is None else array[:, cut]).read().result())
        except ValueError as error:
            raise StoreError(
                f"The array '{name}' of '{vault}' is missing or damaged ({str(error)[:80]}); copy the Vault again."
            ) from error

    def leaves(tree: dict, lead: str = "") -> list[str]:
        return [
            x for k, v in tree.items() for x in (leaves(v, f"{lead}{k}.") if isinstance(v, dict) else [f"{lead}{k}"])
        ]

    steps = int(read("vault_index")[0])
    if steps < 2:
        raise StoreError(f"'{vault}' holds {steps} steps; it was never filled.")
    return {name: read(f"{name}.", slice(steps)) for name in leaves(shapes) if name in wanted}
