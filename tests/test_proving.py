"""The proving ground: systems as values, their drivers, data and films."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.datasets.recipes.proving import Naive
from ringfence.envs.base import Filmed, Measured
from ringfence.envs.film import RED
from ringfence.envs.proving import System, drivers, layout
from ringfence.envs.proving.system import DEVELOPMENT, TEST
from ringfence.errors import UserError
from ringfence.evaluation.protocol import unsafe_starts
from ringfence.loading import oracle
from ringfence.loading.spec import PolicySpec
from tests.quick import in_one_program

SYSTEMS = TEST | {f"dev-{name}": system for name, system in DEVELOPMENT.items()}
FEW = ("posts", "crowd", "drones", "dev-swing", "train")  # of every kind of state and observation


def random_steps(system: System, batch: int = 6, steps: int = 12):
    """States (L, B, ...) and what each step gave, under actions at random."""
    first = in_one_program(system.reset, jax.random.key(1), batch)

    def step(state, key):
        low, high = np.array(system.action_low), np.array(system.action_high)
        unit = jax.random.uniform(key, (batch, system.n_agents, system.action_dim))
        after, out = system.step(state, low + 1.2 * (high - low) * (unit - 0.08))  # now and then beyond the bounds
        return after, (after, out)

    return first, *jax.jit(lambda first: jax.lax.scan(step, first, jax.random.split(jax.random.key(2), steps))[1])(
        first
    )


@pytest.mark.parametrize("name", FEW)
def test_the_state_tells_all_and_everything_has_its_shape(name):
    system = SYSTEMS[name]
    first, states, out = random_steps(system)
    assert float(in_one_program(system.clearance, first).min()) > 0.02 and not np.any(first.rate)
    flat = in_one_program(system.global_state, states)
    assert flat.shape == (12, 6, len(system.state_names)) and np.isfinite(flat).all()
    again = in_one_program(system.from_global_state, flat)
    assert all(np.array_equal(a, b) for a, b in zip(states, again))
    assert in_one_program(system.observe, states).shape == (12, 6, system.n_agents, system.observation_dim)
    assert out.reward.shape == (12, 6, system.n_agents)
    assert out.cost.shape == ((12, 6, system.n_agents) if system.costs == "each" else (12, 6))
    _, same, _ = random_steps(system)
    assert all(np.array_equal(a, b) for a, b in zip(states, same))


@pytest.mark.parametrize("name", FEW)
def test_it_costs_where_a_distance_is_negative(name):
    system = SYSTEMS[name]
    _, states, out = random_steps(system, steps=30)
    distances, clearance = in_one_program(lambda x: (system.distances(x), system.clearance(x)), states)
    below = np.any([np.asarray(d) < 0 for d in distances.values()], 0)
    np.testing.assert_array_equal(below, np.asarray(clearance) < 0)
    np.testing.assert_array_equal(np.asarray(out.cost) > 0, below if system.costs == "each" else below.any(-1))


def test_names_are_said_or_kept():
    named = System("arm", ("posts", "pairs"), 2)
    nameless = replace(named, names="none")
    assert nameless.observation_names == tuple(f"obs{d}" for d in range(named.observation_dim))
    state = in_one_program(named.reset, jax.random.key(0), 3)
    np.testing.assert_array_equal(*in_one_program(lambda x: (named.observe(x), nameless.observe(x)), state))
    assert not any(word in name for name in named.observation_names for word in ("post", "danger", "cost"))


def test_bounds_are_of_each_entry_and_hold():
    unit = System("car", ("pairs",), 2)
    physical = replace(unit, actions="physical")
    assert physical.action_low == (-2.5, -0.6) and physical.action_high == (1.2, 0.6)
    state = in_one_program(unit.reset, jax.random.key(0), 4)
    least, _ = in_one_program(unit.step, state, jnp.full((4, 2, 2), -1.0))
    beyond, _ = in_one_program(unit.step, state, jnp.full((4, 2, 2), -7.0))
    same, _ = in_one_program(physical.step, state, jnp.full((4, 2, 2), -9.0))
    for other in (beyond, same):
        np.testing.assert_allclose(other.applied, least.applied, rtol=1e-6)
    np.testing.assert_allclose(least.applied[0, 0], [-2.5, -0.6], rtol=1e-6)


def test_motion_is_read_back_from_what_is_observed():
    for name in ("hall", "street", "drones", "arms"):
        system = SYSTEMS[name]
        _, states, _ = random_steps(system)
        motion, ahead = in_one_program(lambda x, system=system: layout.read(system, system.observe(x)), states)
        np.testing.assert_allclose(motion.rate, states.rate, atol=1e-5)
        turned = np.cos(np.asarray(motion.pose) - np.asarray(states.pose))
        np.testing.assert_allclose(turned, np.ones_like(turned), atol=1e-5)
        np.testing.assert_allclose(ahead, np.asarray(states.goal) - np.asarray(states.config), atol=1e-5)


def test_slopes_that_drivers_brake_by_are_those_of_the_distances():
    system = System("arm", ("pairs", "joints"), 2)
    _, states, _ = random_steps(system, batch=2, steps=3)
    state = jax.tree.map(lambda x: x[-1], states)
    slopes = jax.jit(lambda x: drivers._barriers(system, x)[:2])
    distance, slope = slopes(state)
    moved = state._replace(config=state.config.at[:, 0, 1].add(1e-3))  # the first agent's second joint
    change = (slopes(moved)[0] - distance)[:, 0] / 1e-3
    np.testing.assert_allclose(change[:, 1:-1], slope[:, 0, 1:-1, 1], atol=2e-2)  # but for itself, and what is far


@pytest.mark.parametrize("name", ["posts", "pillar"])
def test_logs_are_unsafe_now_and_then_and_an_expert_is_not(name):
    system = SYSTEMS[name]
    play = jax.jit(lambda key, habit: system.played(key, 200, habit)[2][:2])
    shape = (200, system.n_agents)
    logged = drivers.habits(system.drivers, jax.random.key(0), shape)
    expert = drivers.Habit(*(jnp.full(shape, x) for x in drivers.EXPERT))
    (earned, costs), (most, none) = (play(jax.random.key(1), habit) for habit in (logged, expert))
    assert 0.01 < float((costs > 0).mean()) < 0.1 and float((none > 0).mean()) < 1e-3
    assert float(earned.sum(1).mean()) > 0.6 * float(most.sum(1).mean()) > 0.5


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"body": "boat"}, "body 'boat'"),
        ({"danger": ()}, "costs nothing"),
        ({"danger": ("ghosts",)}, "danger 'ghosts'"),
        ({"danger": ("joints",)}, "no danger to a body that is a integrator"),
        ({"n_agents": 1}, "too few for pairs"),
    ],
)
def test_what_is_no_system_is_refused(changes, message):
    with pytest.raises(UserError, match=message):
        System(**changes)


def test_a_data_set_is_made_and_begins_safe(tmp_path, monkeypatch):
    monkeypatch.setenv("RINGFENCE_HOME", str(tmp_path))
    task = registry.get("proving-posts")
    store, _ = make(task, 30 * 80)
    again, _ = make(task, 30 * 80, fresh=True)
    np.testing.assert_array_equal(store.actions, again.actions)
    assert store.episodes == 30 and store.card.dt == task.env.dt and "posts" in store.card.simulator
    assert not unsafe_starts(task, store.state[::81]).any() and isinstance(task.env, Measured)
    view = task.feature_map("pruned")
    assert view.names[:4] == ("own.vx", "own.vy", "own.x", "own.y") and view.source == "observations"


def test_a_film_shows_in_red_who_pays():
    system = SYSTEMS["posts"]
    assert isinstance(system, Filmed)
    state = in_one_program(system.reset, jax.random.key(0), 1)
    x, y, _ = system.posts[0]
    inside = state._replace(config=state.config.at[0, 0].set(jnp.array([x, y])))
    states = np.concatenate([in_one_program(system.global_state, s) for s in (state, inside)])
    fine, touching = (np.asarray(p) for p in system.frames(states, [(0, False), (1, True)]))
    red = [(np.abs(p.astype(int) - RED).max(-1) < 12).sum() for p in (fine, touching)]
    assert red[0] == 0 and red[1] > 100


def test_an_oracle_keeps_a_naive_driver_from_what_it_would_touch():
    task = registry.get("proving-pillar")
    system = replace(task.env, episode_length=30)
    task = replace(task, env=system)
    naive = Naive(system)
    guarded = oracle.guarded(naive, task, "shield", {"horizon": 10})
    first = in_one_program(system.reset, jax.random.key(0), 8)
    inward = jnp.sign(-first.config) * 2.0  # goals beyond the post
    first = first._replace(goal=first.config + inward)

    def unsafe(policy) -> float:
        def step(before, key):
            carry, state = before
            carry, decided = policy.act(carry, system.observe(state), system.global_state(state), key)
            state, out = system.step(state, decided.action)
            return (carry, state), out.cost

        keys = jax.random.split(jax.random.key(1), 40)
        _, costs = jax.jit(lambda: jax.lax.scan(step, (policy.initial_state(8), first), keys))()
        return float(costs.sum())

    assert unsafe(guarded) < 0.2 * unsafe(naive)


def test_the_oracle_is_refused_where_a_simulator_knows_no_distances():
    task = registry.get("simple_spread-random")
    with pytest.raises(UserError, match="needs a simulator that knows"):
        oracle.known(task)
    assert PolicySpec.parse("shield-oracle").name == "shield-oracle"
    with pytest.raises(UserError, match="an oracle has read none"):
        oracle.options("shield", registry.get("proving-discs"), {"within_logs": True})
