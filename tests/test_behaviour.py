"""The behaviour learner, its files, and the statistics of the data it makes."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.behaviour import snapshot, statistics
from ringfence.datasets import behaviour, matd3, registry
from ringfence.datasets.behaviour import (
    BehaviourPolicy,
    collect,
    load_behaviour,
    replay_episodes,
    resimulate,
    save_behaviour,
    shipped_policy,
    train_behaviour,
)
from ringfence.datasets.matd3 import MATD3Config
from ringfence.datasets.recipes import spread
from ringfence.envs.simple_spread import SimpleSpread
from ringfence.errors import UserError

ENV = SimpleSpread()
TINY = MATD3Config(hidden=8, envs=4, random_rounds=2, updates=3, batch=16, snapshot_every=2)


@pytest.fixture(scope="module")
def run():
    return train_behaviour(ENV, TINY, jax.random.key(7), 600)


@pytest.fixture(scope="module")
def replayed():
    return replay_episodes(ENV, 3900)


def test_learner_is_finite_deterministic_and_whole(run):
    again = train_behaviour(ENV, TINY, jax.random.key(7), 600)
    for a, b in zip(jax.tree.leaves(run), jax.tree.leaves(again)):
        np.testing.assert_array_equal(a, b)
        assert np.isfinite(a).all()
    assert run.actions.shape == (24, 25, 3, 2) and run.actions.dtype == np.float16
    assert run.seen.tolist() == [200, 400, 600]
    first, last = (jax.tree.leaves(snapshot(run, k, 0.0).actors)[0] for k in (0, -1))
    assert not np.array_equal(first, last)


def test_other_key_gives_another_run(run):
    other = train_behaviour(ENV, TINY, jax.random.key(8), 600)
    assert not np.array_equal(run.actions, other.actions)


def test_recorded_actions_repeat_the_learners_run(run):
    """The running return was computed while learning; playing the float16 record gives the same number."""
    returns = resimulate(ENV, run.initial, run.actions)["rewards"].mean(-1).sum(-1)
    np.testing.assert_allclose(returns.reshape(3, 8).mean(1), run.returns, rtol=1e-4)


def test_updates_move_the_critics_towards_the_reward():
    """With no future (discount 0) and enough updates, the critics' values approach the scaled rewards."""
    config = MATD3Config(hidden=32, envs=16, random_rounds=1, updates=400, batch=128, discount=0.0)
    key = jax.random.key(0)
    learner, memory = behaviour._init_learner(ENV, config, key), behaviour._empty_memory(ENV, 16)
    rounds = jnp.arange(1)

    learner, memory, _ = behaviour._train_rounds(ENV, config, learner, memory, rounds, key[None])
    states = jax.tree.map(lambda x: x[:, :-1].reshape(-1, *x.shape[2:]), memory.states)
    seen = ENV.observe(states)
    value = matd3.value(learner.critics, seen.reshape(len(seen), -1), memory.actions.reshape(-1, 3, 2))
    target = config.reward_scale * memory.rewards.reshape(-1, 3).T
    error = jnp.abs(value - target).mean()
    assert error < 0.5 * jnp.abs(target - target.mean()).mean()


def test_any_number_of_agents(agents=5):
    env = SimpleSpread(n_agents=agents)
    key = jax.random.key(0)
    learner, memory = behaviour._init_learner(env, TINY, key), behaviour._empty_memory(env, 8)
    # Traced, not compiled: shapes are what may depend on the number of agents.
    traced = jax.eval_shape(
        partial(behaviour._train_rounds, env, TINY), learner, memory, jnp.arange(2), jax.random.split(key, 2)
    )
    assert jax.tree.map(jnp.shape, traced[:2]) == jax.tree.map(jnp.shape, (learner, memory))
    data = collect(env, BehaviourPolicy(learner.actors, 0.1), 5, jax.random.key(1), batch=3)
    assert data["actions"].shape == (5, 25, agents, 2)
    assert data["observations"].shape == (5, 26, agents, env.observation_dim)
    assert data["state"].shape == (5, 26, 6 * agents)
    assert data["rewards"].shape == (5, 25, agents) and data["costs"].shape == (5, 25)


def test_files_give_the_same_actions(run, tmp_path):
    policy = snapshot(run, -1, 0.3)
    save_behaviour(BehaviourPolicy(policy.actors, 0.3, {"level": "tiny"}), tmp_path / "deep" / "tiny.safetensors")
    back = load_behaviour(tmp_path / "deep" / "tiny.safetensors")
    observations = jax.random.normal(jax.random.key(0), (9, 3, 18))
    actions = policy.act(observations, jax.random.key(1))
    np.testing.assert_array_equal(actions, back.act(observations, jax.random.key(1)))
    assert actions.shape == (9, 3, 2) and (jnp.abs(actions) <= 1).all()
    assert back.noise == 0.3 and back.info["level"] == "tiny"
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["tiny.safetensors"]


def test_broken_files_are_refused(run, tmp_path):
    path = tmp_path / "p.safetensors"
    save_behaviour(snapshot(run, 0, 0.1), path)
    whole = path.read_bytes()
    for size in (0, 5, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(UserError, match="not a whole behaviour policy"):
            load_behaviour(path)
    with pytest.raises(UserError, match="no behaviour policy"):
        load_behaviour(tmp_path / "absent.safetensors")
    npz = behaviour.POLICIES / "simple_spread-medium-replay.npz"
    (tmp_path / "r.npz").write_bytes(npz.read_bytes()[:50_000])
    with pytest.raises(UserError, match="not a whole replay"):
        behaviour._load_replay(tmp_path / "r.npz")


def test_bad_requests_are_refused():
    with pytest.raises(UserError, match="agents"):
        collect(SimpleSpread(n_agents=4), shipped_policy("medium"), 2, jax.random.key(0))
    with pytest.raises(UserError, match="random"):
        collect(ENV, "rnadom", 2, jax.random.key(0))
    with pytest.raises(UserError, match="at least 1"):
        collect(ENV, "random", 0, jax.random.key(0))
    with pytest.raises(UserError, match="3900"):
        replay_episodes(ENV, 3901)
    with pytest.raises(UserError, match="behaviour level"):
        shipped_policy("exprt")
    with pytest.raises(UserError, match="delay"):
        MATD3Config(delay=0)


def test_collect_is_deterministic_and_consistent():
    a, b = (collect(ENV, shipped_policy("expert"), 70, jax.random.key(3), batch=32) for _ in range(2))
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])
        assert a[name].dtype == np.float32
    again = resimulate(ENV, ENV.from_global_state(jnp.asarray(a["state"][:, 0])), a["actions"], batch=32)
    for name in a:
        np.testing.assert_allclose(a[name], again[name], rtol=2e-5, atol=1e-4)
    other = collect(ENV, shipped_policy("expert"), 70, jax.random.key(4), batch=32)
    assert not np.array_equal(a["state"][:, 0], other["state"][:, 0])
    assert len(np.unique(a["state"][:, 0], axis=0)) == 70  # chunks do not repeat one another


@pytest.mark.parametrize("level, mean", [("medium", 273.4), ("expert", 531.0)])
def test_shipped_tiers_match_the_public_returns(level, mean):
    policy = shipped_policy(level)
    found = statistics(collect(ENV, policy, 2000, jax.random.key(5)))
    assert found["return_mean"] == pytest.approx(mean, rel=0.05)
    assert policy.info["return"] == pytest.approx(mean, rel=0.02)
    assert policy.info["task"] == "simple_spread" and policy.info["level"] == level


@pytest.mark.parametrize("level, mean", [("medium", 259.85), ("expert", 516.76)])
def test_the_pools_policies_match_the_public_pools(level, mean):
    """Five learners: the mean of the pool is that of the public sets of five seeds, and no two play alike."""
    policies = [shipped_policy(level, lineage=k) for k in range(behaviour.LINEAGES)]
    assert np.mean([p.info["return"] for p in policies]) == pytest.approx(mean, rel=0.02)
    assert [p.info.get("lineage", 0) for p in policies] == list(range(5))
    seen = ENV.observe(ENV.reset(jax.random.key(0), 200))
    acts = np.stack([matd3.act(p.actors, seen) for p in policies])
    assert min(np.abs(acts[a] - acts[b]).mean() for a in range(5) for b in range(a)) > 0.2


@pytest.mark.parametrize("tier", ["expert", "medium-replay", "random"])
def test_pooled_tiers_take_turns(tier):
    """Episode e is of lineage e mod 5; the card says so, and the arrays hold nothing of it."""
    task = registry.get(f"simple_spread-{tier}-pooled")
    card = {"task": task.name}
    store = task.recipe.collect(task, 12 * 25, 0, card)
    assert store.episodes == 12 and store.card.task == task.name
    assert ("drivers" in store.card.extra) == (tier != "random")
    for k, episodes in ((0, [0, 5, 10]), (4, [4, 9])):
        alone = spread._of_lineage(ENV, tier, len(episodes), 0, k)
        rows = np.concatenate([np.arange(e * 25, e * 25 + 25) for e in episodes])
        np.testing.assert_array_equal(store.actions[rows], alone["actions"].reshape(-1, 3, 2))


def test_lineages_that_do_not_ship_are_refused():
    with pytest.raises(UserError, match="no lineage 5; the package ships 0 to 4"):
        shipped_policy("expert", lineage=5)
    with pytest.raises(UserError, match="1 to 780 episodes"):
        behaviour.shipped_replay(ENV, 781, 1)


def test_random_tier_matches_the_public_returns():
    found = statistics(collect(ENV, "random", 2000, jax.random.key(5)))
    assert found["return_mean"] == pytest.approx(159.9, rel=0.05)
    assert found["return_std"] == pytest.approx(60.5, rel=0.1)
    assert found["contact_starts"] == pytest.approx(0.177, abs=0.03)


def test_replay_matches_the_public_returns(replayed):
    found = statistics(replayed)
    assert found["episodes"] == 3900 and replayed["actions"].size // 6 == 97_500
    assert found["return_mean"] == pytest.approx(203.7, rel=0.05)
    returns = replayed["rewards"].mean(-1).sum(-1)
    assert returns[:600].mean() < 170 and returns[-150:].mean() > 240  # in order, from random to medium


def test_a_smaller_replay_keeps_the_mix(replayed):
    few = replay_episodes(ENV, 390)
    whole = statistics(replayed)
    error = whole["return_std"] / 390**0.5
    assert abs(statistics(few)["return_mean"] - whole["return_mean"]) < 3 * error
    np.testing.assert_allclose(few["state"][[0, -1]], replayed["state"][[0, -1]], atol=1e-4)


def test_replay_labels_follow_the_env(replayed):
    dense = replay_episodes(SimpleSpread(reward="coverage"), 39)
    rows = np.linspace(0, 3899, 39).round().astype(int)
    np.testing.assert_allclose(dense["state"], replayed["state"][rows], atol=1e-4)
    assert (dense["rewards"] <= 0).all()


def test_shipped_files_are_small():
    for level in ("medium", "expert"):
        assert (behaviour.POLICIES / f"simple_spread-{level}.safetensors").stat().st_size < 100_000
    assert (behaviour.POLICIES / "simple_spread-medium-replay.npz").stat().st_size < 1_500_000
    of_pools = [file for k in range(1, 5) for file in behaviour.POLICIES.glob(f"simple_spread-*-{k}.*")]
    assert len(of_pools) == 12 and sum(file.stat().st_size for file in of_pools) < 1_000_000
