"""OMAR's directories: written here with NumPy, imported, and refused when they contradict themselves."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.cli.app import main
from ringfence.datasets import behaviour, registry
from ringfence.datasets.importers import import_omar
from ringfence.envs.simple_spread import SimpleSpread, SpreadState
from ringfence.errors import StoreError, UserError
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints


def write(folder, played, dtype=np.float64, following=True, extra=0):
    """OMAR's files of episodes (E, L, ...), flat in time; `extra` rows of the first episode are put behind them."""
    folder.mkdir(parents=True, exist_ok=True)
    observations = played["observations"]
    flat = lambda x: x.reshape(-1, *x.shape[2:])  # noqa: E731
    columns = {
        "obs": flat(observations[:, :-1]),
        "next_obs": flat(observations[:, 1:]),
        "acs": flat(played["actions"]),
        "rews": flat(played["rewards"]),
        "dones": np.zeros(played["rewards"].size // played["rewards"].shape[-1] * observations.shape[2]).reshape(
            -1, observations.shape[2]
        ),
    }
    if not following:
        del columns["next_obs"]
    for kind, array in columns.items():
        for i in range(observations.shape[2]):
            column = np.concatenate([array[:, i], array[:extra, i]])
            np.save(folder / f"{kind}_{i}.npy", column.astype(bool if kind == "dones" else dtype))
    return folder


@pytest.fixture(scope="module")
def few(played):
    return {name: x[:8] for name, x in played.items()}


def change(file, function):
    np.save(file, function(np.load(file)))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_import_equals_the_episodes(tmp_path, few, dtype):
    store = import_omar(write(tmp_path / "simple_spread" / "medium-replay" / "seed_0_data", few, dtype))
    direct = EpisodeStore.from_episodes(
        few["observations"], few["actions"], few["rewards"], few["costs"], state=few["state"]
    )
    for name in ("observations", "actions", "rewards", "costs", "terminated", "truncated", "episode_ends"):
        np.testing.assert_array_equal(getattr(store, name), getattr(direct, name), err_msg=name)
    np.testing.assert_allclose(store.state, direct.state, atol=1e-6)
    assert store.costs.any() and not store.terminated.any()
    assert store.card.task == "simple_spread-medium-replay"
    assert store.card.provenance.startswith("imported from OMAR arrays") and store.card.warnings == []
    assert store.hazard == constraints.Separation()
    assert registry.from_store(store).name == "simple_spread-medium-replay"


def test_five_agents_and_an_unfinished_episode(tmp_path):
    env, rng = SimpleSpread(n_agents=5), np.random.default_rng(0)
    parts = (rng.uniform(-1, 1, (4, 26, 5, 2)) for _ in range(3))
    states = SpreadState(*(jnp.asarray(x, jnp.float32) for x in parts))
    gaps = np.linalg.norm(np.asarray(states.position[:, 1:, :, None] - states.position[:, 1:, None]), axis=-1)
    played = {
        "observations": np.asarray(jax.jit(env.observe)(states)),
        "actions": rng.uniform(-1, 1, (4, 25, 5, 2)),
        "rewards": rng.normal(size=(4, 25, 5)),
        "costs": (gaps + np.eye(5) < 0.3).any((2, 3)),
    }
    store = import_omar(write(tmp_path / "expert", played, extra=7))
    assert (store.n_agents, store.episodes, store.steps) == (5, 4, 100)
    np.testing.assert_array_equal(store.costs, played["costs"].ravel())
    np.testing.assert_allclose(store.state, np.asarray(env.global_state(states)).reshape(104, 30), atol=1e-6)
    assert store.card.warnings == ["the last 7 rows are an unfinished episode and were dropped"]
    assert store.card.task == "simple_spread-imported"  # the shipped tasks have three agents
    with pytest.raises(StoreError, match="5 agents, the task 'simple_spread-expert' has 3"):
        import_omar(tmp_path / "expert", task="simple_spread-expert")
    task = registry.from_store(store)
    for view in ("pruned", "decentralized"):  # the hazard finds its features by name
        names = task.feature_map(view, store).names
        assert constraints.bind(task.hazard, names, 5).has_formula


def test_without_next_obs_the_last_steps_are_dropped(tmp_path, few):
    store = import_omar(write(tmp_path / "d", few, following=False), task="mine")
    assert store.lengths.tolist() == [24] * 8 and store.card.task == "mine"
    np.testing.assert_array_equal(store.observations, few["observations"][:, :-1].reshape(-1, 3, 18))
    np.testing.assert_array_equal(store.costs, few["costs"][:, :-1].ravel())
    assert "next_obs is missing" in store.card.warnings[0]


@pytest.mark.parametrize(
    "path, task",
    [
        ("simple_spread/expert/seed_3_data", "simple_spread-expert"),
        ("simple_spread-medium", "simple_spread-medium"),
        ("medium_replay", "simple_spread-medium-replay"),
        ("expert/random/d", "simple_spread-random"),
        ("randomised/d", "simple_spread-imported"),
        ("expert/random_seed_3", "simple_spread-expert"),
    ],
)
def test_the_path_names_the_tier(tmp_path, few, path, task):
    assert import_omar(write(tmp_path / "x" / "y" / path, few)).card.task == task


def test_another_danger_from_the_command_line_needs_a_name(tmp_path, few, capsys):
    folder, out = write(tmp_path / "expert", few), tmp_path / "mine.h5"
    arguments = ["data", "import-omar", str(folder), "--out", str(out), "--radius", "0.5"]
    with pytest.raises(SystemExit):
        main(arguments)
    assert "give the data a name with --task" in capsys.readouterr().err and not out.exists()
    main([*arguments, "--task", "mine"])
    wide = EpisodeStore.load(out)
    assert wide.card.task == "mine" and wide.hazard == constraints.Separation(0.5, 0.125)
    assert wide.costs.sum() > import_omar(folder).costs.sum()


def test_dones_that_are_set_cut_episodes(tmp_path, few):
    folder = write(tmp_path / "d", few)
    for i in range(3):  # at the limit of episode 0; in the middle of what would be episode 1
        for kind in ("obs", "next_obs", "acs", "rews", "dones"):
            file = folder / f"{kind}_{i}.npy"
            change(file, lambda x: np.delete(x, np.arange(35, 50), axis=0))
        change(folder / f"dones_{i}.npy", lambda x: x | np.isin(np.arange(len(x)), (24, 34)))
    store = import_omar(folder)
    assert store.lengths.tolist() == [25, 10, *[25] * 6]
    assert store.terminated.nonzero()[0].tolist() == [34]
    assert "dones are set" in store.card.warnings[0]


@pytest.mark.parametrize("length, message", [(20, "row 19 ends.*comes after 25"), (50, "row 24.*obs of row 25")])
def test_wrong_episode_length_is_found(tmp_path, few, length, message):
    with pytest.raises(StoreError, match=message):
        import_omar(write(tmp_path / "d", few), episode_length=length)


def test_other_lengths_are_read(tmp_path, few):
    short = {name: x[:, : 7 if name == "observations" else 6] for name, x in few.items()}
    assert import_omar(write(tmp_path / "d", short), episode_length=6).lengths.tolist() == [6] * 8


def test_missing_files_are_named(tmp_path, few):
    folder = write(tmp_path / "d", few)
    for name in ("rews_1.npy", "next_obs_2.npy", "obs_0.npy"):
        data = (folder / name).read_bytes()
        (folder / name).unlink()
        with pytest.raises(StoreError, match=f"lacks {name}"):
            import_omar(folder)
        (folder / name).write_bytes(data)
    (tmp_path / "empty").mkdir()
    with pytest.raises(StoreError, match="lacks obs_0.npy"):
        import_omar(tmp_path / "empty")
    with pytest.raises(StoreError, match="There is no directory"):
        import_omar(tmp_path / "absent")
    for task in ("", "..", "a/b"):
        with pytest.raises(StoreError, match="it must be a name without slashes"):
            import_omar(folder, task=task)


def test_a_parent_directory_lists_its_data_sets(tmp_path, few):
    for seed in (0, 1):
        write(tmp_path / "expert" / f"seed_{seed}_data", few)
    with pytest.raises(StoreError, match="'seed_0_data', 'seed_1_data'"):
        import_omar(tmp_path / "expert")
    with pytest.raises(StoreError, match="'expert/seed_0_data', 'expert/seed_1_data'"):
        import_omar(tmp_path)


def test_damaged_files_are_named(tmp_path, few):
    folder = write(tmp_path / "d", few)
    file = folder / "acs_1.npy"
    data = file.read_bytes()
    for size in (0, 40, 500):
        file.write_bytes(data[:size])
        with pytest.raises(StoreError, match=r"acs_1\.npy' is truncated"):
            import_omar(folder)
    np.save(file, np.array([None] * 200))
    with pytest.raises(StoreError, match=r"acs_1\.npy' is truncated, damaged or no .npy file of numbers"):
        import_omar(folder)
    np.save(file, np.array([["a", "b"]] * 200))
    with pytest.raises(
        StoreError, match=r"acs_1\.npy' is truncated, damaged or no .npy file of numbers \(it holds <U1\)"
    ):
        import_omar(folder)
    np.save(file, np.zeros(200))
    with pytest.raises(StoreError, match=r"acs_1\.npy' has shape \(200,\), expected \(M, 2\)"):
        import_omar(folder)
    np.save(file, np.zeros((199, 2)))
    with pytest.raises(StoreError, match=r"acs_1\.npy' has 199 rows, the other files 200"):
        import_omar(folder)


def test_contradictions_are_found(tmp_path, few):
    folder = write(tmp_path / "d", few)
    change(folder / "obs_2.npy", lambda x: x + 0.01 * (np.arange(len(x)) == 31)[:, None])
    with pytest.raises(StoreError, match=r"obs_\d\.npy' row 31 contradicts"):
        import_omar(folder)
    write(folder, few)
    for i in range(3):  # velocity of everybody: consistent among agents, not with the row before
        change(folder / f"obs_{i}.npy", lambda x: x + 0.1 * ((np.arange(len(x)) == 31)[:, None] & (np.arange(18) < 2)))
    with pytest.raises(StoreError, match="next_obs of row 30 differs from obs of row 31 by 0.1"):
        import_omar(folder)


def test_actions_are_clipped_only_against_rounding(tmp_path, few):
    folder = write(tmp_path / "d", few)
    change(folder / "acs_0.npy", lambda x: np.where(np.arange(len(x))[:, None] == 3, 1.0005, x))
    assert import_omar(folder).actions[3, 0].tolist() == [1.0, 1.0]
    change(folder / "acs_0.npy", lambda x: np.where(np.arange(len(x))[:, None] == 3, 1.01, x))
    with pytest.raises(StoreError, match=r"acs_0\.npy' row 3 is 1.01, outside"):
        import_omar(folder)


def test_other_hazards_and_bad_values(tmp_path, few):
    folder = write(tmp_path / "d", few)
    wide = import_omar(folder, hazard=constraints.Separation(0.6))
    assert wide.costs.sum() > few["costs"].sum() and wide.hazard == constraints.Separation(0.6)
    with pytest.raises(StoreError, match="hold no costs"):
        import_omar(folder, hazard=constraints.CostColumn())
    with pytest.raises(UserError, match="SpeedLimit reads the feature 'torso.vx'"):
        import_omar(folder, hazard=constraints.SpeedLimit(1.0))
    assert import_omar(folder, hazard=constraints.SpeedLimit(0.5, ("own.vx", "own.vy"))).costs.any()
    change(folder / "rews_0.npy", lambda x: np.where(np.arange(len(x)) == 7, np.nan, x))
    with pytest.raises(StoreError, match=r"rewards\[7, 0\] is nan"):
        import_omar(folder)
    with pytest.raises(StoreError, match="fewer than one episode of 1000"):
        import_omar(folder, episode_length=1000)


def test_seeds_are_pooled(tmp_path, few, capsys):
    """One store of several seeds: their episodes one after the other, and on the card how many are whose."""
    parts = [{name: x[:5] for name, x in few.items()}, {name: x[5:] for name, x in few.items()}]
    folders = [write(tmp_path / "expert" / f"seed_{k}_data", part) for k, part in enumerate(parts)]
    pool, whole = import_omar(folders), import_omar(write(tmp_path / "whole", few))
    for name in ("observations", "state", "actions", "rewards", "costs", "truncated", "episode_ends"):
        np.testing.assert_array_equal(getattr(pool, name), getattr(whole, name), err_msg=name)
    assert pool.card.task == "simple_spread-expert-pooled"
    assert pool.card.extra["episodes_of_driver"] == [5, 3]
    assert pool.card.extra["drivers"] == [str(folder) for folder in folders]
    out = tmp_path / "pool.h5"
    main(["data", "import-omar", *map(str, folders), "--out", str(out)])
    assert EpisodeStore.load(out).card == pool.card
    main(["data", "import-omar", str(folders[0]), "--out", str(out)])
    assert EpisodeStore.load(out).card.task == "simple_spread-expert"


def test_seeds_that_disagree_are_refused(tmp_path, few):
    first = write(tmp_path / "expert" / "seed_0_data", few)
    other = write(tmp_path / "expert" / "seed_1_data", few)
    with pytest.raises(StoreError, match="No directory was given"):
        import_omar([])
    with pytest.raises(StoreError, match="given twice; name every seed once"):
        import_omar([first, other, first])
    with pytest.raises(StoreError, match="is of simple_spread-expert, '.*' of simple_spread-medium; pool one tier"):
        import_omar([first, write(tmp_path / "medium" / "seed_1_data", few)])
    with pytest.raises(StoreError, match="do not both hold next_obs"):
        import_omar([first, write(tmp_path / "expert" / "seed_2_data", few, following=False)])
    env = SimpleSpread(n_agents=4)
    wide = behaviour.collect(env, "random", 2, jax.random.key(0))
    with pytest.raises(StoreError, match="holds 4 agents, '.*' 3; pool seeds of one team"):
        import_omar([first, write(tmp_path / "expert" / "seed_3_data", wide)])
    for i in range(3):
        change(other / f"acs_{i}.npy", lambda a: a / 2)
    with pytest.raises(StoreError, match="seed_1_data' moves differently from .*seed_0_data', so action bounds"):
        import_omar([first, other])
    for i in range(3):
        change(other / f"acs_{i}.npy", lambda a: a * 2)
        change(other / f"rews_{i}.npy", lambda r: r / 10)
    with pytest.raises(StoreError, match="seed_1_data' is rewarded differently"):
        import_omar([first, other])
