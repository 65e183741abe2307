"""Imports are tested on real Vaults and MADIFF arrays, written here from the simulator in the old layouts."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ringfence.data import EpisodeStore, ogmarl
from ringfence.data.ogmarl import import_madiff, import_vault
from ringfence.envs import SafeMuJoCo
from ringfence.errors import StoreError, UserError

TASKS = {"halfcheetah_2x3": "2x3", "ant_2x4": "2x4", "ant_4x2": "4x2"}


def recorded(parts: str, episodes: int = 3, length: int = 20) -> dict[str, np.ndarray]:
    """Flat logs of random episodes: state and action of every step, its reward and cost, and where episodes end."""
    env = SafeMuJoCo(parts)
    sim, rng = env.simulate(episodes, threads=1), np.random.default_rng(0)
    sim.reset([(3, k) for k in range(episodes)])
    rows = []
    for _ in range(length):
        action = rng.uniform(-1, 1, (episodes, env.n_agents, env.action_dim)).astype(np.float32)
        state = sim.state().astype(np.float32)
        out = sim.step(action)
        rows.append((state, action, out.reward, out.cost))
    state, action, reward, cost = (np.stack(x, 1).reshape(episodes * length, *x[0].shape[1:]) for x in zip(*rows))
    last = np.tile(np.arange(length) == length - 1, episodes)
    rewards = np.repeat(reward[:, None], env.n_agents, 1).astype(np.float32)
    return {"state": state, "actions": action, "rewards": rewards, "costs": cost, "last": last}


def write_vault(folder, log, reverse=False, states=None, pad=False):
    """A Vault as OG-MARL writes it, by flashbax."""
    fbx = pytest.importorskip("flashbax", reason="flashbax writes the Vaults of this test")
    import jax
    import jax.numpy as jnp
    from flashbax.vault import Vault

    n = log["actions"].shape[1]
    steps = len(log["actions"])
    actions = log["actions"][..., ::-1] if reverse else log["actions"]
    flag = np.repeat(log["last"][:, None], n, 1).astype(np.float32)
    state = log["state"] if states is None else states
    seen = np.full((steps, n, 13), -np.inf if pad else 0.0, np.float32)
    tree = {
        "observations": seen,
        "actions": actions.copy(),
        "rewards": log["rewards"],
        "terminals": flag,
        "truncations": np.zeros_like(flag),
        "infos": {"state": state.astype(np.float32)},
    }
    buffer = fbx.make_flat_buffer(
        max_length=steps + 1, min_length=1, sample_batch_size=1, add_sequences=True, add_batch_size=None
    )
    tree = jax.tree.map(jnp.asarray, tree)
    kept = buffer.init(jax.tree.map(lambda x: x[0], tree))
    kept = buffer.add(kept, tree)
    vault = Vault(vault_name="robot.vlt", experience_structure=kept.experience, rel_dir=str(folder), vault_uid="Good")
    assert vault.write(kept) == steps
    return folder / "robot.vlt" / "Good"


def write_madiff(folder, log, parts, reverse=True):
    """obs.npy and its companions, in the layouts of the old multi-agent MuJoCo."""
    env, state, steps = SafeMuJoCo(parts), log["state"], len(log["actions"])
    at = {name: state[:, k] for k, name in enumerate(env.state_names)}
    n = env.n_agents
    if parts == "2x3":
        x = np.cumsum(at["torso.vx"]) * 0.05
        world = [at["torso.vx"], at["torso.vpitch"], at["torso.vz"], x, at["torso.pitch"], at["torso.z"]]
        rows = []
        for mine, other in (("b", "f"), ("f", "b")):
            own = [at[f"{mine}{j}.{c}"] for j in ("foot", "shin", "thigh") for c in "qv"]
            rows.append(np.column_stack([*own, at[f"{other}thigh.q"], *world]))
        seen = np.stack(rows, 1)
    else:
        width = ogmarl.OLD_OBSERVATION[parts]
        seen = np.random.default_rng(1).normal(size=(steps, n, width))
        seen[:, :, -2] = at["torso.vx"][:, None]
    number = np.broadcast_to(np.eye(n), (steps, n, n))
    folder.mkdir()
    np.save(folder / "obs.npy", np.concatenate([number, seen], -1).astype(np.float32))
    np.save(folder / "actions.npy", log["actions"][..., ::-1] if reverse else log["actions"])
    np.save(folder / "rewards.npy", log["rewards"])
    np.save(folder / "path_lengths.npy", np.full(log["last"].sum(), steps // log["last"].sum()))
    return folder


@pytest.mark.parametrize("task", TASKS)
def test_a_vault_becomes_the_simulators_own_data(tmp_path, task):
    env, log = SafeMuJoCo(TASKS[task]), recorded(TASKS[task])
    extra = np.zeros((len(log["state"]), 84 if env.ant else 0))
    vault = write_vault(tmp_path, log, reverse=not env.ant, states=np.concatenate([log["state"], extra], 1), pad=True)
    store = import_vault(vault, task)
    assert (store.episodes, store.lengths.tolist()) == (3, [19, 19, 19])
    inside = ~log["last"]
    np.testing.assert_allclose(store.actions, log["actions"][inside], atol=1e-6)
    np.testing.assert_array_equal(store.state[:20], log["state"][:20])
    np.testing.assert_array_equal(store.observations, store.state[:, env.observed])
    assert (store.costs == log["costs"][inside]).mean() > 0.97  # vy is an approximation
    assert store.truncated.sum() == 3 and not store.terminated.any()
    assert store.card["task"] == f"{task}-good"
    told = " ".join(store.card["warnings"])
    assert ("actions are as recorded" if env.ant else "actions are reversed") in told
    again = EpisodeStore.load(store.save(tmp_path / "store.h5"))
    assert again.hazard.limit == env.limit


def test_costs_of_a_fast_cheetah_are_exact(tmp_path):
    log = recorded("2x3")
    log["rewards"][5] += 4.0  # as if it had been 4 m/s faster
    store = import_vault(write_vault(tmp_path, log), "halfcheetah_2x3")
    assert store.costs[5] == 1 and store.costs.sum() == 1


def test_madiffs_cheetah_has_its_state_back(tmp_path):
    log = recorded("2x3")
    store = import_madiff(write_madiff(tmp_path / "good", log, "2x3"), "halfcheetah_2x3")
    np.testing.assert_allclose(store.state[:20], log["state"][:20], atol=1e-6)
    np.testing.assert_allclose(store.actions, log["actions"][~log["last"]], atol=1e-6)
    assert store.card["task"] == "halfcheetah_2x3-good"


def test_madiffs_ant_says_what_it_lacks(tmp_path):
    log = recorded("4x2")
    store = import_madiff(write_madiff(tmp_path / "medium", log, "4x2", reverse=False), "ant_4x2")
    assert store.state is None and store.observations.shape[1:] == (4, 33)
    assert "cannot be recovered" in " ".join(store.card["warnings"])
    assert store.hazard.features == ("torso.vx",) and store.card["task"] == "ant_4x2-medium-observations"


def test_other_robots_and_damaged_files_are_refused(tmp_path):
    log = recorded("2x3")
    wrong = {**log, "state": np.roll(log["state"], 1, 1)}
    with pytest.raises(StoreError, match="misses the recorded state by .* in the median"):
        import_vault(write_vault(tmp_path / "a", wrong), "halfcheetah_2x3")
    vault = write_vault(tmp_path / "b", log)
    with pytest.raises(StoreError, match=r"actions has shape .* known are halfcheetah_2x3"):
        import_vault(vault, "ant_2x4")
    with pytest.raises(StoreError, match="states of 16 entries; known layouts of halfcheetah_2x3 have 17"):
        import_vault(write_vault(tmp_path / "c", log, states=log["state"][:, 1:]), "halfcheetah_2x3")
    with pytest.raises(StoreError, match="pass one of its subfolders: Good"):
        import_vault(vault.parent, "halfcheetah_2x3")
    with pytest.raises(UserError, match="did you mean"):
        import_vault(vault, "halfcheetah_3x2")
    padded = {**log, "state": log["state"].copy()}
    padded["state"][7, 3] = -np.inf
    with pytest.raises(StoreError, match="state of step 7 is not finite"):
        import_vault(write_vault(tmp_path / "d", padded), "halfcheetah_2x3")
    (vault / "metadata.json").write_text(json.dumps({"version": 1.2}))
    with pytest.raises(StoreError, match="metadata.json' is damaged"):
        import_vault(vault, "halfcheetah_2x3")
    folder = write_madiff(tmp_path / "poor", log, "2x3")
    with pytest.raises(StoreError, match="obs.npy has shape"):
        import_madiff(folder, "ant_4x2")
    (folder / "rewards.npy").unlink()
    with pytest.raises(StoreError, match="lacks rewards.npy"):
        import_madiff(folder, "halfcheetah_2x3")
