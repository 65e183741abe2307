"""Import OG-MARL's robots (Formanek et al. 2023): Vaults, and the arrays that MADIFF made of the older release.

Both were recorded with the old multi-agent MuJoCo, whose observations are not those of Safe Multi-Agent MuJoCo; its
*states* are, up to what follows them. So everything is rebuilt from states:

* a Vault holds states; MADIFF's arrays hold none, but HalfCheetah's follows from its observations. The Ant's does not:
  z, orientation and vy are in no observation, so its arrays keep their own observations, no simulator can evaluate what
  is learned from them, and speed means |vx|;
* the order of HalfCheetah's actions differs between versions of the old code. One step is replayed in the simulator
  with each order; the one that reproduces the next state is taken, and a data set that neither reproduces is refused;
* what an episode's last action led to is not recorded, so that step is dropped; an episode that ended at the time
  limit was truncated, whatever its flags say;
* the speed follows from the reward, vx = r + 0.1 ‖a‖² (HalfCheetah) or r − 1 + 0.5 ‖a‖² (Ant); vy is the mean of both
  ends' of a step, 0.01 m/s off in the median.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ringfence import hazards
from ringfence.data.store import EpisodeStore
from ringfence.envs import SafeMuJoCo, mujoco
from ringfence.errors import StoreError, unknown

ROBOTS = {SafeMuJoCo(parts).name: parts for parts in mujoco.ROBOTS}
OLD_OBSERVATION = {"2x3": 13, "2x4": 54, "4x2": 33}
TIER = re.compile(r"(?<![a-z])(good|medium|poor|expert|replay)(?![a-z])", re.IGNORECASE)
REPLAYED = 256  # steps that are replayed to find the order of actions
AGREES = 0.05  # median over replayed steps of the largest error in the state; the wrong order has errors of 1 to 10


@dataclass
class Log:
    """A flat recording; T steps, one robot."""

    where: str
    state: np.ndarray | None  # (T, S) in the layout of SafeMuJoCo
    observations: np.ndarray | None  # (T, N, O), where there is no state
    actions: np.ndarray  # (T, N, A)
    rewards: np.ndarray  # (T, N)
    last: np.ndarray  # (T,) bool: the step ended an episode


def import_vault(vault: str | os.PathLike, task: str) -> EpisodeStore:
    """The store of a Vault, e.g. `2halfcheetah.vlt/Good`; `task`: halfcheetah_2x3, ant_2x4 or ant_4x2."""
    env, vault = _robot(task), Path(vault)
    arrays = _read_vault(vault)
    where = f"Vault '{vault}'"
    for name in ("actions", "rewards", "terminals", "truncations", "infos.state"):
        if name not in arrays:
            raise StoreError(
                f"{where} holds no '{name}'; only recordings with actions, rewards and states can be read."
            )
    sequences, steps = arrays["actions"].shape[:2]
    state = arrays["infos.state"]
    state = state[:, :, 0] if state.ndim == 4 else state  # some copies repeat it for every agent
    _shape(where, "actions", arrays["actions"], (sequences, steps, env.n_agents, env.action_dim))
    s = len(env.state_names)
    known = {17} if not env.ant else {27, 105, 111}
    if state.shape[-1] not in known:
        raise StoreError(
            f"{where} has states of {state.shape[-1]} entries; known layouts of {task} have "
            f"{', '.join(str(k) for k in sorted(known))} (positions but the planar place, velocities, contact forces)."
        )
    flags = (arrays["terminals"] > 0) | (arrays["truncations"] > 0)
    last = flags.reshape(sequences, steps, -1).any(-1)
    last[:, -1] |= True  # nothing after a sequence's end belongs to it
    flat = lambda x: x.reshape(sequences * steps, *x.shape[2:])  # noqa: E731
    log = Log(where, flat(state[..., :s]), None, flat(arrays["actions"]), flat(arrays["rewards"]), last.ravel())
    return _store(log, env, task, f"imported from an OG-MARL Vault, '{vault}'", _tier(vault))


def import_madiff(directory: str | os.PathLike, task: str) -> EpisodeStore:
    """The store of MADIFF's `obs.npy` (T, N, N+O), `actions.npy`, `rewards.npy`, `path_lengths.npy`."""
    env, directory = _robot(task), Path(directory)
    where = f"'{directory}'"
    obs, actions, rewards, lengths = (_load(directory, f) for f in ("obs", "actions", "rewards", "path_lengths"))
    n, wide = env.n_agents, OLD_OBSERVATION[env.parts]
    steps = int(lengths.sum())
    _shape(where, "obs.npy", obs, (steps, n, n + wide))
    _shape(where, "actions.npy", actions, (steps, n, env.action_dim))
    rewards = rewards.reshape(steps, -1) if rewards.size in (steps, steps * n) else rewards
    _shape(where, "rewards.npy", rewards, (steps, rewards.shape[-1] if rewards.shape[-1:] == (1,) else n))
    if not (obs[:, :, :n] == np.eye(n)).all():
        raise StoreError(
            f"{where}: obs.npy does not begin with every agent's number in one-hot form; it is not MADIFF's."
        )
    last = np.zeros(steps, bool)
    last[np.cumsum(lengths) - 1] = True
    obs = obs[:, :, n:]
    state = _cheetah_state(where, obs) if not env.ant else None
    log = Log(where, state, None if state is not None else obs, actions, rewards, last)
    return _store(log, env, task, f"imported from MADIFF's arrays in {where}", _tier(directory))


def _cheetah_state(where: str, obs: np.ndarray) -> np.ndarray:
    """(T, 17) from (T, 2, 13): own (q, v) of foot, shin, thigh; the other thigh; vx, vpitch, vz; x, pitch, z."""
    if not np.allclose(obs[:, 0, 7:], obs[:, 1, 7:], atol=1e-4):
        raise StoreError(f"{where}: the two halves see different torsos, so obs.npy is in no known layout.")
    own = obs[:, :, :6].reshape(len(obs), 2, 3, 2)[:, :, ::-1]  # thigh, shin, foot
    vx, vpitch, vz, _, pitch, z = np.moveaxis(obs[:, 0, 7:], 1, 0)
    position, velocity = own[..., 0].reshape(-1, 6), own[..., 1].reshape(-1, 6)
    return np.column_stack([z, pitch, position, vx, vz, vpitch, velocity])


def _store(log: Log, env: SafeMuJoCo, task: str, provenance: str, tier: str) -> EpisodeStore:
    for name in ("state", "observations", "actions", "rewards"):
        x = getattr(log, name)
        if x is not None and not np.isfinite(x).all():
            row = int(np.argwhere(~np.isfinite(x).reshape(len(x), -1).all(1))[0, 0])
            raise StoreError(
                f"{log.where}: {name} of step {row} is not finite (some pad with -inf); cut those rows first."
            )
    if not log.last.any():
        raise StoreError(f"{log.where} marks no end of an episode; cut it into episodes first.")
    ends = np.flatnonzero(log.last) + 1
    total = int(ends[-1])
    lengths = np.diff(ends, prepend=0)
    notes = ["the last step of every episode was dropped: what it led to is not recorded"]
    if total < len(log.actions):
        notes.append(f"the last {len(log.actions) - total} steps are an unfinished episode and were dropped")
    if (lengths > env.episode_length).any():
        raise StoreError(
            f"{log.where} has an episode of {lengths.max()} steps, {task} ends after {env.episode_length}; "
            "its ends are marked wrongly."
        )
    keep = np.ones(total, bool)
    keep[ends - 1] = False
    long_enough = lengths > 1
    actions = np.clip(log.actions[:total], -1.0, 1.0).astype(np.float64)
    rewards = log.rewards[:total].astype(np.float64).mean(-1)
    order, told = np.arange(env.action_dim), ""
    if log.state is not None:
        order, told = _action_order(log, env, actions, np.flatnonzero(keep))
        notes.append(told)
    actions = actions[:, :, order]
    effort = (actions**2).sum((1, 2))
    vx = rewards - 1.0 + 0.5 * effort if env.ant else rewards + 0.1 * effort
    speed, seen = np.abs(vx), ("torso.vx",)
    if env.ant and log.state is not None:
        at = env.state_names.index("torso.vy")
        vy = (log.state[:total, at] + np.append(log.state[1:total, at], 0.0)) / 2
        speed, seen = np.hypot(vx, vy), ("torso.vx", "torso.vy")
    elif env.ant:
        notes.append(
            "vy, height and orientation are in no observation and cannot be recovered: costs and hazard read |vx| "
            "alone, and the simulator cannot evaluate what is learned from this data"
        )
    x = log.state[:total].astype(np.float32) if log.state is not None else log.observations[:total].astype(np.float32)
    name = f"{task}-{tier}" if log.state is not None else f"{task}-{tier}-observations"
    observations = x[:, env.observed] if log.state is not None else x
    final = np.flatnonzero(log.last[:total])[long_enough]
    card = {
        "task": name,
        "simulator": "multiagent_mujoco 1.1, MuJoCo 2.1",
        "provenance": provenance,
        "agents": [f"agent{i}" for i in range(env.n_agents)],
        "observation_names": list(env.observation_names if log.state is not None else _old_names(x.shape[2], env)),
        "state_names": list(env.state_names) if log.state is not None else [],
        "hazard": hazards.to_dict(hazards.SpeedLimit(env.limit, seen)),
        "episode_length": env.episode_length,
        "warnings": notes,
    }
    return EpisodeStore.from_steps(
        observations[keep],
        actions[keep],
        rewards[keep],
        episode_ends=np.cumsum(lengths[long_enough] - 1),
        final_observations=observations[final],
        costs=(speed > env.limit)[keep],
        state=x[keep] if log.state is not None else None,
        final_state=x[final] if log.state is not None else None,
        card=card,
    )


def _action_order(log: Log, env: SafeMuJoCo, actions: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, str]:
    """(order of an agent's action entries, what was found), by replaying single steps in the simulator."""
    steps = np.random.default_rng(0).permutation(steps)[:REPLAYED]
    if not len(steps):
        raise StoreError(f"{log.where} holds no episode of two steps or more.")
    sim = env.simulate(len(steps))
    planar, nq = (2, 15) if env.ant else (1, 9)
    state = log.state[steps].astype(np.float64)
    qpos = np.concatenate([np.zeros((len(steps), planar)), state[:, : nq - planar]], 1)
    forward, errors = np.arange(env.action_dim), {}
    for name, order in {"as recorded": forward, "reversed": forward[::-1]}.items():
        sim.restore(qpos, state[:, nq - planar :])
        sim.step(actions[steps][:, :, order])
        errors[name] = float(np.median(np.abs(sim.state() - log.state[steps + 1]).max(1)))
    best = min(errors, key=errors.get)
    if errors[best] > AGREES:
        raise StoreError(
            f"{log.where} is not this robot's: one step in the simulator misses the recorded state by "
            f"{errors[best]:.3g} in the median ({AGREES} is allowed) in either order of actions; check the task."
        )
    order = forward if best == "as recorded" else forward[::-1]
    other = max(errors.values())
    return order, f"actions are {best}: a replayed step misses by {errors[best]:.2g}, in the other order by {other:.2g}"


def _old_names(width: int, env: SafeMuJoCo) -> list[str]:
    near = env.n_agents - 1 if env.parts == "4x2" else 2
    own = width - near - 2
    return [f"own{k}" for k in range(own)] + [f"near{k}.q" for k in range(near)] + ["torso.vx", "torso.x"]


def _robot(task: str) -> SafeMuJoCo:
    if task not in ROBOTS:
        raise unknown("robot", task, ROBOTS)
    return SafeMuJoCo(ROBOTS[task])


def _tier(path: Path) -> str:
    found = TIER.findall(str(path))
    return found[-1].lower() if found else "imported"


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
        return np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise StoreError(f"'{file}' is truncated or no .npy file of numbers ({error}); copy it again.") from error


def _read_vault(vault: Path) -> dict[str, np.ndarray]:
    """Dotted name -> (B, T, ...); a Vault is zarr arrays in an OCDBT store, with their names in metadata.json."""
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
    except (ValueError, KeyError) as error:
        raise StoreError(f"'{file}' is damaged ({error}); copy the Vault again.") from error

    def open_(name: str):
        base = {"driver": "ocdbt", "base": f"file://{vault.resolve()}", "path": name}
        try:
            return tensorstore.open({"driver": "zarr", "kvstore": base}).result()
        except ValueError as error:
            raise StoreError(
                f"'{vault}' lacks the array '{name}' ({str(error)[:80]}); copy the Vault again."
            ) from error

    def leaves(tree: dict, lead: str = "") -> list[str]:
        return [
            x for k, v in tree.items() for x in (leaves(v, f"{lead}{k}.") if isinstance(v, dict) else [f"{lead}{k}."])
        ]

    steps = int(open_("vault_index").read().result()[0])
    if steps < 2:
        raise StoreError(f"'{vault}' holds {steps} steps; it was never filled.")
    return {name.rstrip("."): np.asarray(open_(name)[:, :steps].read().result()) for name in leaves(shapes)}
