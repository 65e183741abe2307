"""The one loop outside JAX, and the one within: who is asked what, and when."""

from __future__ import annotations

import jax
import numpy as np

from ringfence.envs import SimpleSpread
from ringfence.envs.base import Memoryless, Outcome, Seen, nobody, rollout, scanned, split_off
from ringfence.types import PolicyStep


class Countdown:
    """Episodes that end after so many steps; what is observed is how many are left, and each costs them."""

    def reset(self, seeds):
        self.left = np.array(seeds)

    @property
    def running(self):
        return self.left > 0

    def observe(self):
        return Seen(np.array(self.left, float)[:, None, None], None)

    def step(self, action):
        assert action.shape == (len(self.left), 1, 1)
        on = self.running
        self.left = self.left - on
        return Outcome(-1.0 * on, 1.0 * self.left, on & ~self.running, on)


class Adding:
    """Remembers what it was told of costs, and acts by it."""

    def initial_state(self, batch):
        return np.zeros(batch)

    def observe_cost(self, carry, cost):
        return carry + cost

    def act(self, carry, observations, state, key):
        assert state is None
        return carry, PolicyStep(carry[:, None, None] + key, {"left": observations[:, 0, 0]})


def test_every_step_is_shown_until_all_have_ended():
    env, seen = Countdown(), []
    env.reset([1, 3, 2])
    keys = iter([10, 20, 30, 40])
    rollout(Adding(), env, seen.append, keys)
    assert [now.running.tolist() for now in seen] == [[True] * 3, [False, True, True], [False, True, False]]
    assert [now.decided.info["left"].tolist() for now in seen] == [[1, 3, 2], [0, 2, 1], [0, 1, 0]]
    told = [now.decided.action[:, 0, 0].tolist() for now in seen]
    assert told == [[10, 10, 10], [20, 22, 21], [30, 33, 31]], "costs are told after the step, before the next one"
    assert [now.outcome.terminated.tolist() for now in seen] == np.eye(3, dtype=bool)[[0, 2, 1]].tolist()
    for now, then in zip(seen, seen[1:]):
        assert now.after is then.before
    assert list(keys) == [40], "nothing is drawn for steps that nobody takes"


def test_it_ends_where_the_keys_do():
    env, seen = Countdown(), []
    env.reset([5, 9])
    rollout(Memoryless(lambda observations, state, key: observations), env, seen.append, iter([0, 0]))
    assert len(seen) == 2 and env.left.tolist() == [3, 7]
    rollout(Memoryless(lambda observations, state, key: observations), env, nobody, iter([]))
    assert env.left.tolist() == [3, 7]


def test_keys_are_split_off_one_after_the_other():
    key = jax.random.key(3)
    for found, _ in zip(split_off(key), range(3)):
        key, wanted = jax.random.split(key)
        assert (jax.random.key_data(found) == jax.random.key_data(wanted)).all()


def test_a_scan_is_the_loop_by_hand():
    env = SimpleSpread(episode_length=4)
    first = env.reset(jax.random.key(0), 2)
    pushes = jax.random.uniform(jax.random.key(1), (4, 2, 3, 2), minval=-1.0)
    states, actions, out = jax.jit(lambda first: scanned(env, first, lambda state, push: push, pushes))(first)
    assert actions.shape == (2, 4, 3, 2) and out.reward.shape == (2, 4, 3) and states.position.shape == (2, 5, 3, 2)
    state, step = first, jax.jit(env.step)
    for t, push in enumerate(pushes):
        np.testing.assert_array_equal(states.position[:, t], state.position)
        state, told = step(state, push)
        np.testing.assert_allclose(out.reward[:, t], told.reward, rtol=1e-6)
    np.testing.assert_allclose(states.position[:, -1], state.position, rtol=1e-6)
