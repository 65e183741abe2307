"""Bodies that are thrown back by what they touch: danger is where they would have been."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ringfence
from ringfence.datasets.make import make
from ringfence.datasets.registry import TASKS
from ringfence.envs import System
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.problem import features
from ringfence.world import impacts, probes
from ringfence.world.card import UNKNOWN, Settings
from ringfence.world.logged import Logged, held_out, labels_of

WALL = 1.0
DT = 0.1


def logs(rebound: float | None, episodes: int = 60, steps: int = 50) -> EpisodeStore:
    """One body on a line, pushed about; beyond x = 1 a step costs, and throws it back where something does."""
    rng = np.random.default_rng(0)
    x = np.zeros((episodes, steps + 1, 1, 2))
    x[:, 0, 0, 0] = rng.uniform(-1, 0.5, episodes)
    actions = np.clip(rng.normal(0.2, 0.6, (episodes, steps, 1, 1)), -1, 1)
    costs = np.zeros((episodes, steps))
    for t in range(steps):
        place, speed = x[:, t, 0, 0], x[:, t, 0, 1]
        after = 0.9 * speed + DT * 5 * actions[:, t, 0, 0]
        there = place + DT * after
        hit = there > WALL
        costs[:, t] = hit
        if rebound is not None:
            there, after = np.where(hit, place, there), np.where(hit, -rebound * after, after)
        x[:, t + 1, 0] = np.stack([there, after], -1)
    names = ["own.x", "own.vx"]
    return EpisodeStore.from_episodes(
        x, actions, np.zeros((episodes, steps, 1)), costs, card={"task": "line", "observation_names": names}
    )


def logged_of(store: EpisodeStore) -> Logged:
    names = store.entry_names
    map = features.from_data("pruned", store.observations, None, names, (), store.first_rows)
    labels = labels_of(store, map, Settings(), None)
    return Logged.of(store, map, held_out(store, 0, labels[""] > 0), labels)


class Coasts(eqx.Module):
    """Dynamics that know how the body moves."""

    def step(self, before: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        speed = 0.9 * before[..., 1] + DT * 5 * action[..., 0]
        return jnp.stack([before[..., 0] + DT * speed, speed], -1), jnp.zeros(before.shape[:-1])


def test_who_is_thrown_back_is_counted_and_who_passes_is_not():
    thrown = logs(0.4)
    count = impacts.count(logged_of(thrown), 0)
    assert 0.5 * thrown.costs.sum() < count <= thrown.costs.sum()
    assert impacts.count(logged_of(logs(None)), 0) == 0


def test_logs_are_cut_at_unsafe_steps_and_pieces_end_where_those_would_have_led():
    store = logs(0.4)
    before = logged_of(store)
    after = impacts.landed(before, Coasts())
    every, unsafe, safe = np.arange(store.steps), np.flatnonzero(before.unsafe), np.flatnonzero(~before.unsafe)
    assert (before.after(unsafe)[..., 0] <= WALL).all() and (after.after(unsafe)[..., 0] > WALL).all()
    np.testing.assert_array_equal(after.after(safe), before.after(safe))
    np.testing.assert_array_equal(after.before(every), before.before(every))  # a piece begins where the log goes on
    assert set(unsafe + 1) <= set(after.store.episode_ends)
    np.testing.assert_array_equal(after.held_out[after.store.episode_of_step], before.held_out[store.episode_of_step])


def test_agents_of_a_team_are_cut_at_once():
    store = logs(0.4, episodes=20)
    twice = store.followed_by(store)
    costs = np.concatenate([store.costs, np.zeros_like(store.costs)])  # the other agent touches nothing
    team = dataclasses.replace(twice, costs=costs, card=store.card.updated(team=2))
    pieces = impacts.landed(logged_of(team), Coasts()).store
    first, second = np.split(pieces.lengths, 2)
    np.testing.assert_array_equal(first, second)


def test_a_world_knows_danger_by_where_bodies_would_have_been():
    world = ringfence.fit(logs(0.4, 200), dynamics_updates=1500, value_updates=50, future_updates=300, causes=True)
    assert world.card.data.impacts > 0
    assert "thrown back" in str(world.card)
    x = jnp.array([0.0, 0.5, WALL + 0.05, WALL + 0.1])
    rows = jnp.stack([x, jnp.ones(4)], -1)[:, None]
    score = world.barrier.of_steps(rows, rows)[:, 0]
    assert (score[:2] > 0).all() and (score[2:] < 0).all()


def test_a_system_throws_back_who_touches():
    room = TASKS["proving-dev-room"]
    stores = []
    for rebound in (0.0, 0.4):
        system = System("integrator", ("posts",), 2, drivers="careless", rebound=rebound)
        task = dataclasses.replace(room, name=f"rebound-{rebound}", env=system)
        stores.append(make(task, 20_000)[0])
    passed, thrown = stores
    assert impacts.count(logged_of(passed), 0) == 0
    assert impacts.count(logged_of(thrown), 0) > 0
    state = thrown.state[:, : 2 * 2]  # places and rates of the first agent
    assert (np.linalg.norm(state[:, None, :2] - np.array([p[:2] for p in system.posts]), axis=-1) > 0.44).all()


def test_a_rebound_is_a_share():
    with pytest.raises(UserError, match="rebound=1.5 is a share"):
        System("integrator", ("walls",), 2, rebound=1.5)


def test_a_curve_that_danger_never_begins_on_has_no_edge():
    at = np.linspace(0, 1, 5)
    assert probes._along("own.x", at, np.ones(5)).edge is UNKNOWN  # which files leave out
    assert probes._along("own.x", at, at - 0.5).edge == 0.5
