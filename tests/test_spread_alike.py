"""Simple Spread in views of homogeneous agents, any number of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.envs import SimpleSpread, SpreadAlike
from ringfence.envs.pettingzoo import SpreadAlikeParallel
from ringfence.envs.simple_spread import SIGHT, SpreadState
from ringfence.errors import UserError
from ringfence.evaluation.evaluate import evaluate
from ringfence.evaluation.play import play
from ringfence.problem import constraints
from ringfence.training import loop, worlds
from tests.quick import QUICK_WORLD, Compiled

TASK = registry.get("spread_alike-expert")


@pytest.fixture(scope="module")
def logs():
    return make(TASK, 2000)[0]


def seen(env, state) -> list[dict[str, float]]:
    """What each agent of a single room sees, by name."""
    return [dict(zip(env.observation_names, row)) for row in np.asarray(env.observe(state)[0]).tolist()]


def test_who_comes_is_told_before_who_is_near():
    env = Compiled(SpreadAlike(n_agents=4))
    place = jnp.array([[[0.0, 0.0], [0.5, 0.0], [0.0, 0.6], [-1.0, 0.0]]])
    speed = jnp.array([[[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [2.0, 0.0]]])
    landmarks = jnp.array([[[1.0, 0.0], [0.0, 0.5], [-0.2, 0.0], [9.0, 0.0]]])
    first, _, _, last = seen(env, SpreadState(place, speed, landmarks))
    assert (first["other0.dx"], first["other0.dvx"], first["other0.seen"]) == (-1.0, 2.0, 1.0)  # 0.4 m in 0.3 s
    assert (first["other1.dx"], first["other1.dy"]) == (0.5, 0.0)
    assert [round(first[f"landmark{j}.dx"], 3) for j in range(3)] == [-0.2, 0.0, 1.0]
    assert last["own.vx"] == 2.0 and last["other0.dvx"] == -2.0


def test_what_is_not_there_looks_like_what_is_far():
    """Two agents see what three see of whom one is beyond sight."""
    place = jnp.array([[[0.0, 0.0], [0.5, 0.0], [9.0, 9.0]]])
    marks = jnp.array([[[0.0, 0.3], [0.7, 0.0], [9.0, 0.0]]])
    three = Compiled(SpreadAlike()).observe(SpreadState(place, 0 * place, marks))
    two = Compiled(SpreadAlike(n_agents=2)).observe(SpreadState(place[:, :2], 0 * place[:, :2], marks[:, :2]))
    np.testing.assert_array_equal(three[:, :2], two)
    told = seen(Compiled(SpreadAlike()), SpreadState(place, 0 * place, marks))[0]
    assert (told["other1.dx"], told["other1.seen"], told["landmark2.dx"]) == (SIGHT, 0.0, SIGHT)


@pytest.mark.parametrize("agents", [1, 2, 3, 6])
def test_every_team_sees_alike_in_a_room_as_crowded(agents):
    env = Compiled(SpreadAlike(n_agents=agents))
    state = env.reset(jax.random.key(0), 20)
    assert env.observe(state).shape == (20, agents, len(SpreadAlike().observation_names))
    assert (2 * env.half_width) ** 2 / agents == pytest.approx(4 / 3)
    assert float(jnp.abs(state.position).max()) <= env.half_width
    after, transition = env.step(state, jnp.zeros((20, agents, 2)))
    whole, told = Compiled(env.whole).step(state, jnp.zeros((20, agents, 2)))
    np.testing.assert_array_equal(after.position, whole.position)
    assert transition.cost.shape == (20, agents)
    np.testing.assert_array_equal(transition.cost.max(-1), told.cost)  # who touches, and whether anybody does
    flat = env.global_state(after)
    jax.tree.map(np.testing.assert_array_equal, env.from_global_state(flat), after)


def test_the_same_play_told_otherwise(logs):
    plain = make(registry.get("simple_spread-expert"), 2000)[0]
    np.testing.assert_array_equal(logs.state, plain.state)
    np.testing.assert_array_equal(logs.actions, plain.actions)
    np.testing.assert_array_equal(logs.costs.max(1), plain.costs)
    assert logs.costs.any() and logs.card.agents == ["agent0", "agent1", "agent2"]
    each = logs.split_agents()
    hazard = constraints.bind(TASK.hazard, TASK.feature_map("pruned").names, 1)
    ends = np.arange(1, 26) + 26 * np.arange(each.episodes)[:, None]  # rows that steps lead to
    unsafe = hazard.labels(jnp.asarray(each.observations[ends.ravel()]))[0]
    np.testing.assert_array_equal(np.asarray(unsafe).reshape(-1), each.costs > 0)  # what is seen tells what is paid


def test_one_checkpoint_plays_teams_of_another_size(logs, tmp_path):
    run = loop.train("bc", logs, out=tmp_path, changes={"num_updates": 4, "width": 16}, quiet=True)[0]
    world = worlds.fit(logs, **QUICK_WORLD)
    assert world.map.decentralized
    for agents in (2, 6):
        quick = {"correction_steps": 1, "correction_restarts": 0, "horizon": 1}
        found = evaluate(run, episodes=4, agents=agents, guard="shield", world=world, **quick)
        assert found["agents"] == agents and found["episodes"] == 4
    found = play(run, lambda: SpreadAlikeParallel(n_agents=4), episodes=1, agents=4)
    assert found["episodes"] == 1


def test_what_cannot_be_is_refused():
    with pytest.raises(UserError, match="n_agents=0 must be at least 1"):
        SpreadAlike(n_agents=0)
    with pytest.raises(UserError, match="played by 3, so agents=4 have no data"):
        make(registry.of_team(TASK, 4), 100, fresh=True)
    assert SimpleSpread().half_width == SpreadAlike().half_width == 1.0
