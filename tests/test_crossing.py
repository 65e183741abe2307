"""The room of discs with momentum, its data, and what a guard foresees in it."""

import dataclasses
import sys
from dataclasses import astuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence import guard
from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.datasets.recipes import crossing as recipe
from ringfence.deploy.controller import Controller
from ringfence.envs import Crossing
from ringfence.envs.crossing import RADIUS, SIGHT, CrossingState
from ringfence.envs.film import RED
from ringfence.envs.pettingzoo import CrossingParallel
from ringfence.errors import UserError
from ringfence.evaluation.evaluate import evaluate
from ringfence.evaluation.play import play
from ringfence.evaluation.protocol import unsafe_starts
from ringfence.training import loop, worlds
from ringfence.world import load as load_world
from ringfence.world import save
from ringfence.world.logged import held_out
from tests.quick import QUICK_WORLD, Compiled


def lone(velocity, **room) -> tuple[Crossing, CrossingState]:
    """One disc at the room's centre with its goal to the right."""
    env = Compiled(Crossing(n_agents=1, **room))
    state = env.reset(jax.random.key(0), 1)
    zero = jnp.zeros((1, 1, 2))
    return env, state._replace(position=zero, velocity=zero + jnp.asarray(velocity), goal=zero + jnp.array([9.0, 0.0]))


def test_full_braking_takes_ten_steps_and_half_a_metre():
    env, state = lone([1.0, 0.0])
    for _ in range(10):
        state, _ = env.step(state, jnp.array([[[-1.0, 0.0]]]))
    np.testing.assert_allclose(state.velocity, 0.0, atol=1e-6)
    assert float(state.position[0, 0, 0]) == pytest.approx(0.45)
    pushed, _ = env.step(state, jnp.array([[[1.0, 1.0]]]))  # the push is bounded in all, not along each axis
    assert float(jnp.linalg.norm(pushed.velocity)) == pytest.approx(0.1)


def test_a_unicycle_moves_along_its_heading():
    env, state = lone([0.5, 0.0], body="unicycle")
    state = state._replace(heading=jnp.zeros((1, 1)))
    state, _ = env.step(state, jnp.array([[[1.0, 1.0]]]))
    assert float(state.heading[0, 0]) == pytest.approx(0.2)
    np.testing.assert_allclose(state.velocity[0, 0], 0.6 * np.array([np.cos(0.2), np.sin(0.2)]), rtol=1e-5)
    still, _ = env.step(state._replace(velocity=jnp.zeros((1, 1, 2))), jnp.array([[[-1.0, 0.0]]]))
    np.testing.assert_allclose(still.velocity, 0.0)  # it does not back up


def test_drivers_of_the_pool_keep_to_their_sides():
    """Somebody comes head on: two of the four go to one side each, the others do as their certificates say; with nobody
    near all go straight. All four drive equally often, and the card says who."""
    env = Crossing(n_agents=2)
    state = Compiled(env).reset(jax.random.key(0), 1)
    way = jnp.array([[[1.0, 0.0], [-1.0, 0.0]]])
    for gap, turned in ((0.6, True), (2.9, False)):
        place = jnp.array([[[0.0, 0.0], [gap, 0.0]]])
        here = state._replace(position=place, velocity=jnp.zeros((1, 2, 2)), goal=place + 9.0 * way)
        aside = {name: recipe._aside(env, here, way, jnp.full((1, 2), d.side)) for name, d in recipe.HABITS.items()}
        across = {name: float(push[0, 0, 1]) for name, push in aside.items()}
        assert across["careful"] == across["hasty"] == 0.0
        assert (across["keeps right"] < -0.2 and across["keeps left"] > 0.2) == turned
        assert float(aside["keeps right"][0, 1, 1]) == -across["keeps right"], "each to its own right"
    numbers = np.asarray(recipe._drivers("pooled", jax.random.key(0), 8, 8))
    assert [int((numbers[..., -1] == side).sum()) for side in (0.5, -0.5, 0.0)] == [16, 16, 32]
    store, _ = make(registry.get("crossing-pooled"), 4000, must_keep=False)
    assert store.card.extra["drivers"] == ["careful", "hasty", "keeps right", "keeps left"]
    assert store.episodes == 40 and store.returns.mean() > 2.0


@pytest.mark.parametrize("room", [{}, {"n_agents": 64}, {"n_agents": 3, "obstacles": 4, "walls": True}])
def test_everybody_starts_at_rest_and_free_and_the_state_tells_all(room):
    env = Compiled(Crossing(**room))
    state = env.reset(jax.random.key(1), 50)
    assert float(env.clearance(state).min()) > 0.05 and float(jnp.abs(state.velocity).max()) == 0
    again = env.from_global_state(env.global_state(state))
    assert all(jnp.array_equal(a, b) for a, b in zip(state, again))
    assert env.global_state(state).shape[-1] == len(env.state_names)
    assert jax.eval_shape(env.observe, state).shape[-1] == len(env.observation_names) == env.observation_dim
    push = jax.random.uniform(jax.random.key(2), (50, env.n_agents, 2), minval=-1.0, maxval=1.0)
    step = env.step
    (a, told), (b, same) = step(state, push), step(again, push)
    assert all(jnp.array_equal(x, y) for x, y in zip((*a, *told), (*b, *same)))  # even where a goal is drawn anew


def comes_within(offset, speed) -> float:
    """m, in the next second; out of sight: far."""
    near = min(np.linalg.norm(offset + t * speed) for t in np.linspace(0, 1, 2001))
    return near if np.linalg.norm(offset) < SIGHT else 1e3


def test_agents_see_first_who_comes_near():
    env = Compiled(Crossing(n_agents=12))
    state = env.reset(jax.random.key(3), 4)
    state = state._replace(velocity=jax.random.normal(jax.random.key(4), state.velocity.shape))
    seen, names = np.asarray(env.observe(state)), env.observation_names
    p, v = np.asarray(state.position), np.asarray(state.velocity)
    at = names.index("other0.dx")
    for b, i in ((0, 0), (2, 7), (3, 11)):
        order = sorted(
            (j for j in range(12) if j != i), key=lambda j: comes_within(p[b, j] - p[b, i], v[b, j] - v[b, i])
        )
        for k, j in enumerate(order[:6]):
            told = seen[b, i, at + 5 * k : at + 5 * k + 5]
            if np.linalg.norm(p[b, j] - p[b, i]) < SIGHT:
                np.testing.assert_allclose(told, [*(p[b, j] - p[b, i]), *(v[b, j] - v[b, i]), 1], rtol=1e-4, atol=1e-5)
            else:
                np.testing.assert_array_equal(told, [SIGHT, 0, 0, 0, 0])
    assert Crossing(n_agents=3).observation_names == names  # a smaller team looks the same
    few = Crossing(n_agents=3)
    assert jax.jit(lambda: few.observe(few.reset(jax.random.key(0), 2)))()[..., at + 10 + 4 :: 5].max() == 0


def test_costs_are_of_those_who_touch():
    env = Compiled(Crossing(n_agents=3))
    state = env.reset(jax.random.key(0), 1)
    place = jnp.array([[[0.0, 0.0], [1.9 * RADIUS, 0.0], [2.0, 0.0]]])
    _, out = env.step(state._replace(position=place), jnp.zeros((1, 3, 2)))
    np.testing.assert_array_equal(out.cost, [[1, 1, 0]])
    walled = Compiled(Crossing(n_agents=1, walls=True))
    state = walled.reset(jax.random.key(0), 1)
    state = state._replace(position=jnp.full((1, 1, 2), walled.side / 2 - RADIUS - 0.01), velocity=jnp.ones((1, 1, 2)))
    after, out = walled.step(state, jnp.zeros((1, 1, 2)))
    assert out.cost.all() and float(jnp.abs(after.velocity).max()) == 0


def test_what_is_foreseen_of_others_who_coast_is_exact():
    """Everything follows from the agents' own velocities, rows ahead, as long as nobody is pushed."""
    env = Crossing(n_agents=4)
    step = jax.jit(env.step)
    observe = jax.jit(env.observe)
    state = jax.jit(env.reset, static_argnums=1)(jax.random.key(0), 20)
    state = state._replace(velocity=0.3 * jax.random.normal(jax.random.key(1), state.velocity.shape))
    rows = [observe(state)]
    for _ in range(4):
        state, _ = step(state, jnp.zeros((20, 4, 2)))
        rows.append(observe(state))
    came = jnp.stack(rows, 1)
    view = env.feature_map("pruned")
    plan = jnp.repeat(came[:, :1], 5, 1).at[..., :2].set(came[..., :2])
    error = np.abs(np.asarray(view.reconcile(plan) - came))
    # But for who comes to be seen, is another than before, or has a new goal.
    assert np.quantile(error, 0.9) < 1e-5 and view.own == (0, 1) and view.decentralized


def test_certificates_keep_apart_who_would_touch():
    env = Crossing()
    first = Compiled(env).reset(jax.random.key(5), 20)

    def contacts(name: str) -> float:
        habits = jnp.array(astuple(recipe.DRIVERS[name]))
        driver = jnp.broadcast_to(habits, (20, 8, len(habits)))

        def step(state, key):
            after, out = env.step(state, recipe.drive(env, state, driver, key))
            return after, out.cost

        return float(jax.lax.scan(step, first, jax.random.split(jax.random.key(0), 60))[1].mean())

    assert contacts("careful") < 0.001 < contacts("hasty")


def test_a_unicycle_is_steered_as_a_disc_is_pushed():
    env, state = lone([0.8, 0.0], body="unicycle")
    push = jnp.array([[[0.3, -0.4]]])
    state = state._replace(heading=jnp.zeros((1, 1)))
    moved, _ = env.step(state, recipe.steered(state, push))
    np.testing.assert_allclose(moved.velocity[0, 0], [0.83, -0.04], atol=2e-3)
    still = state._replace(velocity=jnp.zeros((1, 1, 2)), heading=jnp.full((1, 1), jnp.pi / 2))
    assert recipe.steered(still, push)[0, 0, 1] < -0.5  # it turns first to where it is pushed


def test_unicycles_drive_to_their_goals_in_logs_of_their_own():
    store = make(registry.get("crossing_unicycle-hasty"), 2000)[0]
    assert store.card.observation_names[2:4] == ["own.cos", "own.sin"] and store.returns.min() > 0.5
    with pytest.raises(UserError, match="obstacles or walls"):
        task = registry.get("crossing_unicycle-hasty")
        make(dataclasses.replace(task, env=Crossing(walls=True)), 2000)


@pytest.fixture(scope="module")
def logs():
    return make(registry.get("crossing-hasty"), 2000)[0]


def test_logs_tell_whom_they_cost(logs):
    assert logs.costs.shape == (2000, 8) and logs.card.observation_names[0] == "own.vx"
    same = make(registry.get("crossing-hasty"), 2000, fresh=True)[0]
    assert same.content == logs.content
    starts = unsafe_starts(registry.get("crossing-hasty"), logs.state[::101])
    assert not starts.any()


def test_it_is_learned_guarded_and_played_by_any_number(logs, tmp_path, monkeypatch):
    """One set of weights for all agents, a World of what each of them sees, and a guard that hears of nobody."""
    monkeypatch.setattr(sys.modules["ringfence.evaluation.protocol"], "CHUNK", 2)
    run = loop.train("bc", logs, out=tmp_path, changes={"num_updates": 4, "width": 16}, quiet=True)[0]
    world = worlds.fit(logs, **QUICK_WORLD)
    assert world.alone and world.spec.n_agents == 1 and world.card.data.episodes == 20
    result = evaluate(run, episodes=2, guard="shield", world=world, agents=3, correction_steps=1, horizon=1)
    assert result["agents"] == 3 and result["execution"] == "decentralized" and 0 <= result["infeasible_rate"] <= 1
    assert 0 <= result["agent_violation_rate"] <= result["violation_rate"]
    assert result["variant"] == "default+shield-learned+correction_steps1+horizon1+agents3"
    assert evaluate(run, episodes=2)["agents"] == 8
    pilot = Controller(run, guard="shield", world=world, agents=5)
    env = Compiled(Crossing(n_agents=5))
    seen = np.asarray(env.observe(env.reset(jax.random.key(0), 1))[0])
    acted = pilot.act(seen)
    assert acted.shape == (5, 2)
    order = np.array([3, 1, 4, 0, 2])  # who is asked first changes nothing
    pilot.reset()
    np.testing.assert_allclose(pilot.act(seen[order]), acted[order], atol=1e-6)
    mine = guard(lambda seen, state: np.zeros((len(seen), 2)), world, agents=5)
    assert mine.act(seen).shape == (5, 2) and mine.info["infeasible"].shape == ()
    with pytest.raises(UserError, match="no execution='centralized'"):
        evaluate(run, episodes=2, guard="shield", world=world, execution="centralized")
    with pytest.raises(UserError, match="say with agents="):
        guard(lambda seen, state: np.zeros((len(seen), 2)), world)


def test_episodes_are_drawn():
    env = Compiled(Crossing(n_agents=3, obstacles=1))
    state = env.reset(jax.random.key(0), 1)
    touching = state._replace(position=state.position.at[:, 1].set(state.position[:, 0] + 0.1))
    states = np.concatenate([env.global_state(state), env.global_state(touching)])
    fine, bad = env.frames(states, [(0, False), (1, True)])
    assert fine.size == bad.size == (480, 480)
    red = [(np.abs(np.asarray(x).astype(int) - RED).sum(-1) < 20).sum() for x in (fine, bad)]
    assert red[0] == 0 < red[1]  # who touches is red


def test_it_keeps_pettingzoos_api(logs, tmp_path):
    from pettingzoo.test import parallel_api_test

    env = CrossingParallel(n_agents=3, render_mode="rgb_array")
    parallel_api_test(env, num_cycles=20)
    seen, _ = env.reset(seed=1)
    assert env.render().shape == (480, 480, 3) and seen["agent_0"].shape == (env.core.observation_dim,)
    run = loop.train("bc", logs, out=tmp_path, changes={"num_updates": 4, "width": 16}, quiet=True)[0]
    assert play(run, lambda: CrossingParallel(n_agents=3), episodes=1, agents=3)["episodes"] == 1
    with pytest.raises(UserError, match="has 3 agents, the run was trained with 8; pass agents=3 .--agents 3"):
        play(run, lambda: CrossingParallel(n_agents=3), episodes=1)


def test_logs_are_taken_apart(logs):
    each = logs.split_agents()
    assert each.n_agents == 1 and each.episodes == 160 and each.state is None
    i, e = 5, 7  # agent, episode
    mine = each.episode_ends[i * 20 + e - 1] + np.arange(100)
    theirs = logs.episode_ends[e - 1] + np.arange(100)
    np.testing.assert_array_equal(each.actions[mine, 0], logs.actions[theirs, i])
    np.testing.assert_array_equal(each.costs[mine], logs.costs[theirs, i])
    np.testing.assert_array_equal(each.observations[mine + i * 20 + e, 0], logs.observations[theirs + e, i])
    out = held_out(each, 0).reshape(8, 20)
    assert (out == out[0]).all() and out[0].sum() == 2  # who were together are held out together
    with pytest.raises(UserError, match="costs are the team's"):
        dataclasses.replace(logs, costs=logs.costs.max(1)).split_agents()


@pytest.mark.parametrize(
    "room, said", [({"body": "car"}, "body='car'"), ({"neighbours": 0}, "at least 1"), ({"spacing": 0.3}, "no way")]
)
def test_rooms_that_cannot_be_are_refused(room, said):
    with pytest.raises(UserError, match=said):
        Crossing(**room)


def test_own_logs_of_agents_who_are_alike(logs, tmp_path):
    """The card says so, and what was learned of eight plays five."""
    names = logs.card.observation_names
    card = {"observation_names": names, "hazard": logs.card.hazard, "task": "fleet", "homogeneous": True}
    mine = dataclasses.replace(logs, state=None, card=card)
    run = loop.train("bc", mine, out=tmp_path, changes={"num_updates": 4, "width": 16}, quiet=True)[0]
    world = worlds.fit(mine, **QUICK_WORLD)
    assert world.map.decentralized and world.map.dt == pytest.approx(0.1)  # as names and steps tell
    assert world.map.own == Crossing().feature_map("pruned").own
    world = load_world(save(world, tmp_path / "fleet.world"))
    assert world.map.decentralized
    seen = np.asarray(logs.observations[40, :5])
    pilot = Controller(run, guard="shield", world=world, agents=5)
    assert pilot.act(seen).shape == (5, 2)
    pilot.reset()
    assert Controller(run).act(logs.observations[40]).shape == (8, 2)
    with pytest.raises(UserError, match=r"\(5, 34\)"):
        pilot.act(logs.observations[40])
