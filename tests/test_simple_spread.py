"""Simple Spread against its two originals, its own definitions and the public statistics."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.envs.pettingzoo import parallel_env
from ringfence.envs.simple_spread import SimpleSpread, SpreadState, contact_force, in_contact
from ringfence.errors import UserError

GOLDEN = Path(__file__).parent / "golden" / "simple_spread_velocity_first.npz"


def golden():
    with np.load(GOLDEN) as file:
        return {name: file[name] for name in file.files}


def state_of(*arrays, dtype=None) -> SpreadState:
    return SpreadState(*(jnp.asarray(a, dtype) for a in arrays))


def play(env: SimpleSpread, episodes: int, seed: int = 0):
    """Team rewards and costs (T, B) of uniformly random actions, and the first state."""

    @jax.jit
    def rollout(key):
        first_key, key = jax.random.split(key)
        first = env.reset(first_key, episodes)

        def advance(state, key):
            action = jax.random.uniform(key, (episodes, env.n_agents, 2), minval=-1.0, maxval=1.0)
            state, transition = env.step(state, action)
            return state, (transition.reward.mean(-1), transition.cost)

        return first, jax.lax.scan(advance, first, jax.random.split(key, env.episode_length))[1]

    first, (reward, cost) = rollout(jax.random.key(seed))
    return np.asarray(reward), np.asarray(cost), first


# ---------------------------------------------------------------------------------------------------------------------
# the originals


def test_velocity_first_equals_the_original_environment():
    data = golden()
    for dtype, tolerance in (("float64", 1e-12), ("float32", 1e-5)):
        with jax.enable_x64(True):
            env = SimpleSpread(integrator="velocity_first", reward="omar")
            state = state_of(data["position"], data["velocity"], data["landmarks"], dtype=dtype)
            after, transition = jax.jit(env.step)(state, jnp.asarray(data["action"], dtype))
            observation = env.observe(after)
        assert after.position.dtype == dtype
        np.testing.assert_allclose(after.position, data["next_position"], rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(after.velocity, data["next_velocity"], rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(observation, data["next_observation"], rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(transition.reward, data["reward"], rtol=tolerance, atol=tolerance)
        distance = np.linalg.norm(data["next_position"][:, :, None] - data["next_position"][:, None], axis=-1)
        touches = (distance + 9 * np.eye(3) < 0.3).any((1, 2))
        assert 0 < touches.mean() < 1  # the file holds both kinds
        np.testing.assert_array_equal(transition.cost, touches)


@pytest.mark.filterwarnings("ignore")
def test_position_first_equals_mpe2():
    simple_spread_v3 = pytest.importorskip("mpe2.simple_spread_v3")
    other = simple_spread_v3.parallel_env(N=3, max_cycles=25, continuous_actions=True)
    rng = np.random.default_rng(0)
    before, actions, theirs = [], [], []
    for episode in range(24):  # 24 x 25 = 600 transitions
        other.reset(seed=episode)
        world = other.unwrapped.world
        spread = 0.3 if episode % 2 else 1.0  # every second episode starts crowded
        for body in (*world.agents, *world.landmarks):
            body.state.p_pos = rng.uniform(-spread, spread, 2)
        for agent in world.agents:
            agent.state.p_vel = rng.normal(0, 0.5, 2)
        for step in range(25):
            now = [np.stack([a.state.p_pos for a in world.agents]), np.stack([a.state.p_vel for a in world.agents])]
            before.append([*(x.copy() for x in now), np.stack([m.state.p_pos for m in world.landmarks])])
            u = rng.uniform(-1, 1, (3, 2)).astype(np.float32)  # their action space is float32
            actions.append(u)
            five = np.stack([0 * u[:, 0], *(np.maximum(s * u[:, k], 0) for k in (0, 1) for s in (-1, 1))], axis=-1)
            observations, rewards, terminated, truncated, _ = other.step(dict(zip(other.agents, five)))
            theirs.append(
                (
                    np.stack([a.state.p_pos for a in world.agents]),
                    np.stack([a.state.p_vel for a in world.agents]),
                    np.array(list(rewards.values())),
                    np.stack(list(observations.values())),
                )
            )
            assert set(truncated.values()) == {step == 24} and set(terminated.values()) == {False}
    position, velocity, reward, observation = (np.stack(x) for x in zip(*theirs))
    with jax.enable_x64(True):
        env = SimpleSpread(integrator="position_first", reward="pettingzoo")
        state = state_of(*(np.stack(x) for x in zip(*before)), dtype="float64")
        after, transition = jax.jit(env.step)(state, jnp.asarray(np.stack(actions), "float64"))
        seen = env.observe(after)
    assert (transition.cost > 0).mean() > 0.05
    np.testing.assert_allclose(after.position, position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.velocity, velocity, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(transition.reward, reward, rtol=0, atol=1e-12)
    np.testing.assert_allclose(seen, observation, rtol=1e-6, atol=1e-6)


def test_episode_is_truncated_with_the_original():
    env = parallel_env(integrator="position_first")
    env.reset(seed=3)
    flags = []
    while env.agents:
        _, _, terminated, truncated, _ = env.step({a: np.zeros(2) for a in env.agents})
        assert not any(terminated.values())
        flags.append(all(truncated.values()))
    assert flags == [False] * 24 + [True]


@pytest.mark.parametrize("action", [1, [0.0, 0.0, 0.0], [0.0, np.nan]])
def test_actions_that_are_no_force_are_refused(action):
    env = parallel_env()
    env.reset(seed=0)
    with pytest.raises(UserError, match="two finite numbers"):
        env.step(dict.fromkeys(env.agents, action))
    with pytest.raises(UserError, match="several shapes"):
        env.step({a: np.zeros(2 + k) for k, a in enumerate(env.agents)})


def test_the_integrators_differ_in_what_the_first_action_moves():
    action = jnp.ones((4, 3, 2))
    for name, moves in (("velocity_first", True), ("position_first", False)):
        env = SimpleSpread(integrator=name)
        far = state_of(np.tile(3.0 * np.arange(3)[:, None], (4, 1, 2)), np.zeros((4, 3, 2)), np.zeros((4, 3, 2)))
        after, _ = jax.jit(env.step)(far, action)
        assert bool((after.position != far.position).all()) is moves
        np.testing.assert_allclose(after.velocity, 0.5, rtol=1e-6)


# ---------------------------------------------------------------------------------------------------------------------
# public statistics


def test_random_actions_score_as_published():
    """The public random data: 159.9 +- 60.5 per episode."""
    episodes = 20_000
    reward, _, _ = play(SimpleSpread(), episodes)
    returns = reward.sum(0)
    error = 60.5 / np.sqrt(episodes)
    # The public set is a sample too (1 M transitions): both errors, four standard deviations.
    assert abs(returns.mean() - 159.9) < 4 * np.hypot(error, 60.5 / np.sqrt(40_000)) + 0.05
    assert abs(returns.std() - 60.5) < 4 * np.hypot(error, 60.5 / np.sqrt(40_000))


def test_share_of_resets_in_contact():
    env, n = SimpleSpread(), 100_000
    first = env.reset(jax.random.key(1), n)
    share = float(in_contact(first.position).any((-1, -2)).mean())
    assert abs(share - 0.176) < 4 * np.sqrt(0.176 * 0.824 / 100_000) + 5e-4  # the figure is rounded to 0.1 %
    still = jax.jit(env.step)(first, jnp.zeros((n, env.n_agents, 2)))[1].cost > 0  # after a step of doing nothing
    assert abs(float(still.mean()) - 0.007) < 4 * np.sqrt(0.007 / n) + 5e-4


# ---------------------------------------------------------------------------------------------------------------------
# definitions

CHAIN = np.array([[0.0, 0.0], [0.2, 0.0], [0.4, 0.0], [3.0, 0.0]])  # two touching pairs, three agents touch


@pytest.mark.parametrize("mode, expected", [("any", 1.0), ("pairs", 2.0), ("per_agent", 3.0)])
def test_cost_modes(mode, expected):
    env = SimpleSpread(n_agents=4, cost=mode, integrator="position_first")  # at rest: positions stay for one step
    apart = 3.0 * np.arange(4)[:, None] * np.ones(2)
    state = state_of(np.stack([CHAIN, apart]), np.zeros((2, 4, 2)), np.zeros((2, 4, 2)))
    _, transition = jax.jit(env.step)(state, jnp.zeros((2, 4, 2)))
    assert transition.cost.tolist() == [expected, 0.0]
    assert not transition.terminated.any()


def test_rewards_by_hand():
    position = np.array([[[0.0, 0.0], [0.2, 0.0], [2.0, 0.0]]])
    landmarks = np.array([[[0.0, 0.5], [2.0, 0.05], [0.2, -0.25]]])  # nearest agents at 0.5, 0.05, 0.25
    state = state_of(position, np.zeros((1, 3, 2)), landmarks)
    for name, expected in (
        ("omar", [2 + 10 + 4 - 5.0, 2 + 10 + 4 - 5.0, 2 + 10 + 4]),  # 1/d, at most 10; 5 per contact
        ("pettingzoo", [-0.4 - 0.5, -0.4 - 0.5, -0.4]),  # half the sum of distances, half per contact
        ("coverage", [-0.8 / 3] * 3),
    ):
        env = SimpleSpread(reward=name, integrator="position_first")
        _, transition = jax.jit(env.step)(state, jnp.zeros((1, 3, 2)))
        np.testing.assert_allclose(transition.reward[0], expected, rtol=1e-5)


def test_actions_are_clipped():
    env = SimpleSpread()
    state = env.reset(jax.random.key(0), 8)
    wild, _ = jax.jit(env.step)(state, jnp.full((8, 3, 2), 7.0))
    bound, _ = jax.jit(env.step)(state, jnp.ones((8, 3, 2)))
    np.testing.assert_array_equal(wild.velocity, bound.velocity)


def test_contact_force_is_finite_and_balanced():
    position = jnp.asarray([[0.1, 0.1], [0.1, 0.1], [0.2, 0.1]])  # two agents at the very same point
    force = np.asarray(jax.jit(contact_force)(position))
    slope = np.asarray(jax.jit(jax.grad(lambda p: contact_force(p)[2, 0]))(position))
    assert np.isfinite(force).all() and np.isfinite(slope).all()
    np.testing.assert_allclose(force.sum(0), 0.0, atol=1e-4)
    assert force[2, 0] > 0 > force[0, 0]


def test_states_survive_both_round_trips():
    env = SimpleSpread()
    state, _ = jax.jit(env.step)(env.reset(jax.random.key(0), 16), np.ones((16, 3, 2)))
    through_state = jax.jit(lambda s: env.from_global_state(env.global_state(s)))
    through_observations = jax.jit(lambda s: env.from_observations(env.observe(s)))
    for back in (through_state(state), through_observations(state)):
        for x, y in zip(state, back):
            np.testing.assert_allclose(x, y, atol=1e-6)
    assert env.global_state(state).shape == (16, len(env.state_names))


@pytest.mark.parametrize("n", [1, 2, 5])
def test_any_number_of_agents(n):
    env = SimpleSpread(n_agents=n)
    state = env.reset(jax.random.key(0), 7)
    assert np.abs(state.position).max() <= env.half_width == (1.0 if n <= 3 else 2.0)
    after, transition = jax.jit(env.step)(state, np.zeros((7, n, 2), np.float32))
    assert [x.shape for x in after] == [(7, n, 2)] * 3
    assert [x.shape for x in transition] == [(7, n), (7,), (7,)]
    observations = jax.jit(env.observe)(after)
    assert observations.shape == (7, n, env.observation_dim)
    assert env.global_state(after).shape == (7, 6 * n)
    for x, y in zip(after, jax.jit(env.from_observations)(observations)):
        np.testing.assert_allclose(x, y, atol=1e-6)


@pytest.mark.parametrize("option", [{"integrator": "euler"}, {"reward": "sparse"}, {"cost": "sum"}, {"n_agents": 0}])
def test_bad_options_are_named(option):
    with pytest.raises(UserError, match=next(iter(option))):
        SimpleSpread(**option)


# ---------------------------------------------------------------------------------------------------------------------
# PettingZoo


@pytest.mark.parametrize("n", [1, 3])
def test_pettingzoo_api(n):
    from pettingzoo.test import parallel_api_test

    parallel_api_test(parallel_env(n_agents=n), num_cycles=60)


def test_pettingzoo_is_the_same_core():
    env = parallel_env(render_mode="rgb_array", reward="pettingzoo")
    first, _ = env.reset(seed=5)
    again, infos = env.reset(seed=5)
    core = env.core
    state = core.from_global_state(jnp.asarray(env.state())[None])
    for i, agent in enumerate(env.agents):
        np.testing.assert_array_equal(first[agent], again[agent])
        assert first[agent].dtype == np.float32 and env.observation_space(agent).contains(first[agent])
        others = [j for j in range(3) if j != i]
        gaps = np.linalg.norm(np.asarray(state.position[0, others] - state.position[0, i]), axis=-1)
        assert infos[agent]["clearance"] == pytest.approx(gaps.min() - 0.3, abs=1e-6)
    action = np.random.default_rng(0).uniform(-1, 1, (3, 2)).astype(np.float32)
    after, transition = jax.jit(core.step)(state, action[None])
    observations, rewards, _, _, infos = env.step(dict(zip(env.agents, action)))
    np.testing.assert_allclose(np.stack(list(observations.values())), core.observe(after)[0], atol=1e-6)
    np.testing.assert_allclose(list(rewards.values()), transition.reward[0], atol=1e-5)
    assert {info["cost"] for info in infos.values()} == {float(transition.cost[0])}
    frame = env.render()
    assert frame.shape == (480, 480, 3) and frame.dtype == np.uint8 and len(np.unique(frame)) > 2


def test_pettingzoo_mistakes_are_named():
    with pytest.raises(UserError, match="render_mode"):
        parallel_env(render_mode="human")
    env = parallel_env()
    with pytest.raises(UserError, match="reset"):
        env.step({})
    env.reset(seed=0)
    with pytest.raises(UserError, match="agent_1"):
        env.step({"agent_0": np.zeros(2)})


@pytest.mark.filterwarnings("ignore")
def test_mpe2s_own_is_played_with_our_actions_and_state():
    """Its steps are ours with its integrator and rewards, which `test_position_first_equals_mpe2` holds to 1e-12."""
    pytest.importorskip("mpe2")
    from ringfence.envs.mpe2 import Spread

    other, env = Spread(), SimpleSpread(integrator="position_first", reward="pettingzoo")
    seen, _ = other.reset(seed=3)
    rng = np.random.default_rng(0)
    costs = []
    while other.agents:
        ours = env.from_global_state(jnp.asarray(other.state())[None])
        np.testing.assert_allclose(np.stack([*seen.values()]), env.observe(ours)[0], atol=1e-5)
        push = rng.uniform(-1.5, 1.5, (3, 2)).astype(np.float32)
        after, told = env.step(ours, jnp.asarray(push)[None])
        seen, reward, terminated, truncated, infos = other.step(dict(zip(other.agents, push)))
        np.testing.assert_allclose(other.state(), env.global_state(after)[0], atol=1e-4)
        np.testing.assert_allclose([*reward.values()], told.reward[0], atol=1e-4)
        costs.append([infos["agent_0"]["cost"], float(told.cost[0])])
    assert len(costs) == 25 and all(a == b for a, b in costs) and all(truncated.values())
