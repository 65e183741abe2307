"""Imports are tested on real Vaults and MADIFF arrays, written here from the simulator in the old layouts."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from ringfence.datasets import registry
from ringfence.datasets.audit import audit
from ringfence.datasets.importers import import_madiff, import_vault
from ringfence.envs import SafeMuJoCo
from ringfence.errors import StoreError, UserError
from ringfence.evaluation import protocol
from ringfence.loading.resolve import load
from ringfence.logs.io.ogmarl import OLD_OBSERVATION
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.training import loop

TASKS = {"halfcheetah_2x3": "2x3", "ant_2x4": "2x4", "ant_4x2": "4x2"}


def recorded(parts: str, episodes: int = 3, length: int = 20, jump: bool = False) -> dict[str, np.ndarray]:
    """Flat logs of random episodes: state and action of every step, its reward and cost, and where episodes end.

    The first robot starts too fast; with `jump` the last one leaps out of the Ant's healthy heights.
    """
    env = SafeMuJoCo(parts)
    sim, rng = env.simulate(episodes, threads=1), np.random.default_rng(0)
    sim.reset([(3, k) for k in range(episodes)])
    qpos, qvel = sim._robots.qpos.copy(), sim._robots.qvel.copy()
    qvel[0, : 2 if env.ant else 1] += 4.0  # across, too
    qvel[-1, 2] += 8.0 * jump
    sim.restore(qpos, qvel)
    rows = [[] for _ in range(episodes)]
    fallen = np.zeros(episodes, bool)
    for _ in range(length):
        action = rng.uniform(-1, 1, (episodes, env.n_agents, env.action_dim)).astype(np.float32)
        state, on = sim.state().astype(np.float32), sim.running.copy()
        out = sim.step(action)
        fallen |= out.terminated
        for k in np.flatnonzero(on):
            rows[k].append((state[k], action[k], out.reward[k], out.cost[k], out.info["speed"][k]))
    lengths = np.array([len(r) for r in rows])
    state, action, reward, cost, speed = (np.stack(x) for x in zip(*[step for r in rows for step in r]))
    last = np.zeros(len(state), bool)
    last[np.cumsum(lengths) - 1] = True
    rewards = np.repeat(reward[:, None], env.n_agents, 1).astype(np.float32)
    told = {"costs": cost, "speed": speed, "last": last, "lengths": lengths, "fallen": fallen}
    return {"state": state, "actions": action, "rewards": rewards, **told}


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
        width = OLD_OBSERVATION[parts]
        seen = np.random.default_rng(1).normal(size=(steps, n, width))
        seen[:, :, -2] = at["torso.vx"][:, None]
    number = np.broadcast_to(np.eye(n), (steps, n, n))
    folder.mkdir()
    np.save(folder / "obs.npy", np.concatenate([number, seen], -1).astype(np.float32))
    np.save(folder / "actions.npy", log["actions"][..., ::-1] if reverse else log["actions"])
    np.save(folder / "rewards.npy", log["rewards"])
    np.save(folder / "path_lengths.npy", log["lengths"])
    return folder


@pytest.mark.parametrize("task", TASKS)
def test_a_vault_becomes_the_simulators_own_data(tmp_path, task):
    env = SafeMuJoCo(TASKS[task])
    log = recorded(TASKS[task], jump=env.ant)
    extra = np.zeros((len(log["state"]), 84 if env.ant else 0))
    vault = write_vault(tmp_path, log, reverse=not env.ant, states=np.concatenate([log["state"], extra], 1), pad=True)
    store = import_vault(vault, task)
    assert (store.episodes, store.lengths.tolist()) == (3, log["lengths"].tolist())
    np.testing.assert_allclose(store.actions, log["actions"], atol=1e-6)
    first = log["lengths"][0]
    np.testing.assert_array_equal(store.state[:first], log["state"][:first])
    np.testing.assert_array_equal(store.observations, store.state[:, env.observed])
    # what the last action led to: one more step, since nothing else is recorded between
    sim = env.simulate(1, threads=1)
    planar = 2 if env.ant else 1
    before = log["state"][first - 1][None].astype(np.float64)
    n = (15 if env.ant else 9) - planar
    sim.restore(np.concatenate([np.zeros((1, planar)), before[:, :n]], 1), before[:, n:])
    sim.step(log["actions"][first - 1][None])
    np.testing.assert_allclose(store.state[first], sim.state()[0], atol=1e-5)
    # vy is an approximation, vx is not
    assert log["costs"].sum() >= 3 and (store.costs == log["costs"]).mean() > 0.95
    assert store.terminated[store.episode_ends - 1].tolist() == log["fallen"].tolist()
    assert store.terminated.sum() == log["fallen"].sum() == env.ant
    assert store.card.task == f"{task}-good"
    told = " ".join(store.card.warnings)
    assert ("actions are as recorded" if env.ant else "actions are reversed") in told
    assert ("1 of 3 episodes end with a fall" in told) == env.ant
    again = EpisodeStore.load(store.save(tmp_path / "store.h5"))
    assert again.hazard.limit == env.limit
    facts, _, notes = audit(again)
    assert "(native); at most 25 steps" in facts["speed limit"] and notes == store.card.warnings
    assert facts["return ceiling"].startswith(f"{store.card.extra['return_ceiling']:.0f} within the limit")


def test_a_recording_can_be_read_under_another_limit(tmp_path):
    log = recorded("2x3")
    vault = write_vault(tmp_path, log)
    store = import_vault(vault, "halfcheetah_2x3", "quantile")
    assert registry.from_store(store) == registry.get("halfcheetah_2x3-good-quantile") and store.hazard.limit == 7.903
    assert store.card.extra["protocol"] == "quantile" and not store.costs.any()
    slow = import_vault(vault, "halfcheetah_2x3", 0.5)
    np.testing.assert_array_equal(slow.costs, log["speed"] > 0.5)
    task = registry.from_store(slow)
    assert (
        task.name == "halfcheetah_2x3-good-below-0.5" and task.env.limit == 0.5 and slow.card.extra["protocol"] == "own"
    )
    with pytest.raises(UserError, match="no quantile limit for 'halfcheetah_2x3-imported'; name the tier with --tier"):
        import_vault(vault.rename(tmp_path / "mine"), "halfcheetah_2x3", "quantile")
    again = import_vault(tmp_path / "mine", "halfcheetah_2x3", "quantile", tier="Good")
    assert again.card.task == store.card.task


def test_falls_that_were_not_paid_keep_their_speed(tmp_path):
    """Gymnasium's version 5 pays nothing for standing on the step that falls."""
    log = recorded("4x2", jump=True)
    v5 = {**log, "rewards": log["rewards"].copy()}
    ends = np.flatnonzero(log["last"])
    v5["rewards"][ends[log["fallen"]]] -= 1.0
    first = import_vault(write_vault(tmp_path / "a", log), "ant_4x2", 0.5)
    store = import_vault(write_vault(tmp_path / "b", v5), "ant_4x2", 0.5)
    np.testing.assert_array_equal(store.costs, first.costs)
    assert "1 falls were not paid the 1 for standing" in " ".join(store.card.warnings)
    assert "not paid" not in " ".join(first.card.warnings)
    assert "multiagent_mujoco" in first.card.simulator and "gymnasium-robotics" in store.card.simulator


def test_data_that_is_not_what_its_name_says_is_refused(tmp_path):
    store = import_vault(write_vault(tmp_path, recorded("2x3")), "halfcheetah_2x3")
    named = lambda **card: replace(store, card=store.card.updated(**card))  # noqa: E731
    with pytest.raises(UserError, match="called 'halfcheetah_2x3-good', whose danger is .*3.227.* but defines .*1.0"):
        registry.from_store(named(hazard={"kind": "SpeedLimit", "limit": 1.0, "features": ["torso.vx"]}))
    wide = constraints.to_dict(replace(store.hazard, safe_margin=1.0))  # the same danger
    assert registry.from_store(named(hazard=wide)).hazard.safe_margin == 1.0
    bare = registry.from_store(named(hazard={"kind": "CostColumn"}))
    assert bare == registry.get("halfcheetah_2x3-good")
    shifted = np.concatenate([np.zeros((len(store.state), 1), np.float32), store.state], 1)
    with pytest.raises(StoreError, match="has 18 state entries, its simulator 17; bring it into that layout"):
        registry.from_store(replace(store, state=shifted, card=store.card.updated(state_names=None)))
    names = list(store.card.state_names)
    names[:2] = names[1::-1]
    with pytest.raises(StoreError, match="its state entry 0 is 'torso.pitch', of its simulator 'torso.z'"):
        registry.from_store(named(state_names=names))
    report = audit(named(state_names=names))
    assert report.warnings[0].startswith("Nothing can be trained on this: The data is called")
    # danger that the robot's simulator does not count: data alone
    own = named(task="halfcheetah_2x3-mine", hazard={"kind": "SpeedLimit", "limit": 1.0, "features": ["torso.vz"]})
    task = registry.from_store(own)
    assert task.env is None and task.cost_limit == 25.0 and task.presets == ("mujoco",)


def test_a_tier_of_another_name_keeps_its_simulator(tmp_path):
    """Recordings are called Replay, or anything: their robot can still be played."""
    vault = write_vault(tmp_path, recorded("2x3"))
    vault.rename(tmp_path / "replay")
    store = import_vault(tmp_path / "replay", "halfcheetah_2x3")
    task = registry.from_store(store)
    assert import_vault(tmp_path / "replay", "halfcheetah_2x3", tier="mine").card.task == "halfcheetah_2x3-mine"
    assert task.name == "halfcheetah_2x3-replay" and task.env == SafeMuJoCo("2x3", 3.227)
    assert (task.cost_limit, task.return_max, task.presets) == (25.0, 9132.25, ("mujoco",))
    small = {"num_updates": 2, "batch": 4, "width": 8}
    (run,) = loop.train("bc", store, out=tmp_path / "runs", changes=small, quiet=True)
    job, policy = load(run)
    assert job.task.env.limit == 3.227
    played, _ = protocol.evaluate_policy(policy, replace(job.task, env=SafeMuJoCo("2x3", 3.227, 5)), 1, "test", 0)
    assert played["task"] == "halfcheetah_2x3-replay" and np.isfinite(played["return_norm"])
    # a store of that name without the robot's states is anybody's own data
    own = replace(store, state=None, card=store.card.updated(state_names=[]))
    assert registry.from_store(own).env is None


def test_a_tier_is_named_by_its_own_folder_alone(tmp_path, monkeypatch):
    vault = write_vault(tmp_path / "poor", recorded("2x3"))
    monkeypatch.chdir(vault)
    assert import_vault(".", "halfcheetah_2x3").card.task == "halfcheetah_2x3-good"
    vault.rename(tmp_path / "poor" / "Mixed")
    assert import_vault(tmp_path / "poor" / "Mixed", "halfcheetah_2x3").card.task == "halfcheetah_2x3-imported"


def test_contact_forces_are_found_where_they_were_charged(tmp_path):
    log = recorded("4x2")
    contact = np.random.default_rng(0).uniform(0, 1, (len(log["state"]), 78)) * 3  # clipped at 1 where it is charged
    after = np.append(contact[1:], contact[-1:], 0)
    log["rewards"] -= (5e-4 * np.clip(after, -1, 1) ** 2).sum(1, keepdims=True).astype(np.float32) * 10
    states = np.concatenate([log["state"], contact], 1)
    with pytest.raises(StoreError, match="rewards are not this robot's, the speed that they tell is"):
        import_vault(write_vault(tmp_path / "a", log, states=states), "ant_4x2")
    log["rewards"] += (5e-4 * np.clip(after, -1, 1) ** 2).sum(1, keepdims=True).astype(np.float32) * 9
    store = import_vault(write_vault(tmp_path / "b", log, states=states), "ant_4x2")
    assert "contact forces charged" in " ".join(store.card.warnings)
    assert store.card.simulator.startswith("gymnasium-robotics"), "whose states hold 78 forces"


def test_rewards_that_were_scaled_and_rows_out_of_order_are_refused(tmp_path):
    log = recorded("2x3")
    shared = {**log, "rewards": log["rewards"] / 2}
    with pytest.raises(StoreError, match=r"speed that they tell is [\d.]+ m/s off .* undo any scaling or sharing"):
        import_vault(write_vault(tmp_path / "a", shared), "halfcheetah_2x3")
    mixed = {k: x.copy() for k, x in log.items()}
    mixed["state"][10:14] = mixed["state"][10:14][::-1]
    with pytest.raises(StoreError, match="% of replayed steps miss .* the first of them step 9; .* not consecutive"):
        import_vault(write_vault(tmp_path / "b", mixed), "halfcheetah_2x3")
    loud = {**log, "actions": log["actions"] * 1.5}
    loud["rewards"] = log["rewards"] + 0.1 * (log["actions"] ** 2 - loud["actions"] ** 2).sum((1, 2))[:, None]
    with pytest.raises(StoreError, match="misses the recorded state by"):  # it was driven by smaller actions
        import_vault(write_vault(tmp_path / "c", loud), "halfcheetah_2x3")


def test_costs_of_a_fast_cheetah_are_exact(tmp_path):
    log = recorded("2x3")
    log["rewards"][45] += 4.0  # as if it had been 4 m/s faster
    store = import_vault(write_vault(tmp_path, log), "halfcheetah_2x3")
    log["costs"][45] = 1.0
    np.testing.assert_array_equal(store.costs, log["costs"])


def test_madiffs_cheetah_has_its_state_back(tmp_path):
    log = recorded("2x3")
    store = import_madiff(write_madiff(tmp_path / "good", log, "2x3"), "halfcheetah_2x3")
    np.testing.assert_allclose(store.state[:20], log["state"][:20], atol=1e-6)
    np.testing.assert_allclose(store.actions, log["actions"], atol=1e-6)
    assert store.card.task == "halfcheetah_2x3-good"


def test_lengths_of_madiffs_paths_are_whole_numbers(tmp_path):
    log = recorded("2x3", episodes=2, length=4)
    folder = write_madiff(tmp_path / "good", log, "2x3")
    np.save(folder / "path_lengths.npy", log["lengths"].astype(float))
    assert import_madiff(folder, "halfcheetah_2x3").episodes == 2
    for lengths in (log["lengths"] + 0.5, log["lengths"] * 0, log["lengths"][None], log["lengths"] > 0):
        np.save(folder / "path_lengths.npy", lengths)
        with pytest.raises(StoreError, match="path_lengths.npy must hold the steps of every episode"):
            import_madiff(folder, "halfcheetah_2x3")
    np.save(folder / "path_lengths.npy", log["lengths"].astype(str))
    with pytest.raises(StoreError, match="no .npy file of numbers"):
        import_madiff(folder, "halfcheetah_2x3")


def test_rewards_of_one_meaning_are_read_and_no_others(tmp_path):
    """An Ant's arrays cannot be replayed, so nothing else would tell that rewards are those of other steps."""
    log = recorded("4x2")
    folder = write_madiff(tmp_path / "medium", log, "4x2")
    first, rewards = import_madiff(folder, "ant_4x2"), log["rewards"]
    for same in (rewards[..., None], rewards[:, 0], rewards[:, :1]):
        np.save(folder / "rewards.npy", same)
        np.testing.assert_allclose(import_madiff(folder, "ant_4x2").rewards, first.rewards, rtol=1e-6)
    np.save(folder / "rewards.npy", rewards.T)
    with pytest.raises(StoreError, match=r"rewards.npy has shape \(4, 60\)"):
        import_madiff(folder, "ant_4x2")


def test_madiffs_ant_says_what_it_lacks(tmp_path):
    log = recorded("4x2")
    store = import_madiff(write_madiff(tmp_path / "medium", log, "4x2", reverse=False), "ant_4x2")
    assert store.state is None and store.observations.shape[1:] == (4, 33)
    told = " ".join(store.card.warnings)
    assert "cannot be recovered" in told and "order of actions are taken as recorded" in told
    assert store.lengths.tolist() == [19, 19, 19] and "falls are not marked" in told
    vx = log["rewards"].mean(1) - 1.0 + 0.5 * (log["actions"] ** 2).sum((1, 2))
    np.testing.assert_array_equal(store.costs, (abs(vx) > 2.418)[~log["last"]])
    task = registry.from_store(store)
    assert task.env is None and (task.cost_limit, task.presets) == (25.0, ("mujoco",))
    assert store.hazard.features == ("torso.vx",) and store.card.task == "ant_4x2-medium-observations"


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
    short = {**log, "rewards": log["rewards"][:, :1]}
    with pytest.raises(StoreError, match="rewards has shape"):
        import_vault(write_vault(tmp_path / "e", short), "halfcheetah_2x3")
    torn = write_vault(tmp_path / "f", log)
    for blob in torn.glob("d/*"):  # as an interrupted download leaves them
        blob.write_bytes(blob.read_bytes()[: blob.stat().st_size // 2])
    with pytest.raises(StoreError, match="damaged or no array of a Vault"):
        import_vault(torn, "halfcheetah_2x3")
    for told in ({"version": 1.2}, [1.2]):
        (vault / "metadata.json").write_text(json.dumps(told))
        with pytest.raises(StoreError, match="metadata.json' is truncated, damaged"):
            import_vault(vault, "halfcheetah_2x3")
    folder = write_madiff(tmp_path / "poor", log, "2x3")
    with pytest.raises(StoreError, match="obs.npy has shape"):
        import_madiff(folder, "ant_4x2")
    lost = np.load(folder / "obs.npy")
    lost[5, 0, 9] = np.nan
    np.save(folder / "obs.npy", lost)
    with pytest.raises(StoreError, match="obs.npy of step 5 is not finite"):
        import_madiff(folder, "halfcheetah_2x3")
    (folder / "rewards.npy").unlink()
    with pytest.raises(StoreError, match="lacks rewards.npy"):
        import_madiff(folder, "halfcheetah_2x3")
