"""What strangers give at run time: what is no number of the right shape is refused, and nothing is written into."""

from __future__ import annotations

import copy

import numpy as np
import pytest

import ringfence
from ringfence import world as world_files
from ringfence.envs.episode import Episode, Shape
from ringfence.errors import Interrupted, NoSafeAction, UserError
from ringfence.logs.collect import collect
from ringfence.logs.store import EpisodeStore
from ringfence.training import loop, worlds
from ringfence.utils.functions import memory_of, of_both
from ringfence.utils.given import cost_given, given_as
from tests.quick import QUICK_WORLD

STRANGE = {
    "NaN": lambda x: x * np.nan,
    "infinite": lambda x: x + np.inf,
    "too large": lambda x: x.astype(np.float64) + 1e300,
    "too narrow": lambda x: x[:, :-1],
    "too wide": lambda x: np.concatenate([x, x[:, :1]], 1),
    "one agent": lambda x: x[:1],
    "one agent more": lambda x: np.concatenate([x, x[:1]]),
    "flat": lambda x: x.ravel(),
    "masked": lambda x: np.ma.masked_array(x, x > 0),
    "complex": lambda x: x.astype(complex),
    "words": lambda x: x.astype(str),
    "objects": lambda x: x.astype(object),
    "times": lambda x: x.astype("datetime64[s]"),
    "nothing": lambda x: None,
    "text": lambda x: "observations",
    "a ragged list": lambda x: [x[0].tolist(), x[1, :2].tolist()],
}
COSTS = [-1.0, float("nan"), float("inf"), "free", [1.0, 2.0, 3.0], None.__class__, 1j, np.ma.masked, {}, {"zz": 1.0}]


@pytest.fixture(scope="module")
def store() -> EpisodeStore:
    g = np.random.default_rng(0)
    x = g.normal(size=(20, 11, 2, 4)).astype(np.float32)
    a = np.tanh(g.normal(size=(20, 10, 2, 2)))
    costs = (g.random((20, 10)) < 0.2) * 1.0
    return EpisodeStore.from_episodes(x, a, a.sum(-1), {"a": costs, "b": np.roll(costs, 3)}, card={"task": "toy"})


@pytest.fixture(scope="module")
def world(store):
    return worlds.fit(store, **QUICK_WORLD)


@pytest.fixture(scope="module")
def controllers(store, world, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    changes = {"num_updates": 4, "width": 8, "cost_limit": None}
    (run,) = loop.train("bc", store, changes=changes, quiet=True, out=out)
    file = world_files.save(world, out / "w.safetensors")
    return {
        "function": lambda: ringfence.guard(lambda o, s: np.zeros((2, 2)), world, guard="adapt"),
        "run": lambda: ringfence.Controller(run, guard="adapt", world=file),
    }


@pytest.mark.parametrize("whose", ["function", "run"])
def test_nobody_acts_upon_what_is_no_observation(whose, controllers, store):
    """NaN let everything pass, and was called feasible."""
    controller = controllers[whose]()
    good = store.observations[0]
    for what, spoil in STRANGE.items():
        with pytest.raises(NoSafeAction, match="there was no action before") as refused:
            controller.act(spoil(good))
        assert refused.value.last_action is None, what
    first = controller.act(good)
    assert first.dtype == np.float32 and first.shape == (2, 2)
    first[:] = 7.0
    with pytest.raises(NoSafeAction, match=r"the last action was \[\[") as refused:
        controller.act(good * np.nan)
    assert (np.abs(refused.value.last_action) <= 1).all(), "a copy of what was done"


@pytest.mark.parametrize("whose", ["function", "run"])
@pytest.mark.parametrize("cost", COSTS, ids=repr)
def test_what_is_no_cost_is_refused(whose, cost, controllers, store):
    """A negative one meant safe."""
    controller = controllers[whose]()
    controller.act(store.observations[0])
    with pytest.raises(UserError):
        controller.act(store.observations[1], cost=cost)
    again = controllers[whose]()
    again.act(store.observations[0])
    np.testing.assert_array_equal(again.act(store.observations[1]), controller.act(store.observations[1]))


def test_a_function_that_writes_into_what_it_sees_does_not_blind_its_guard(world, store):
    def blinding(observations, state):
        observations[:] = 0.0
        return np.zeros((2, 2))

    honest = ringfence.guard(lambda o, s: np.zeros((2, 2)), world)
    seen = store.observations[3].copy()
    np.testing.assert_array_equal(ringfence.guard(blinding, world).act(seen), honest.act(store.observations[3]))
    np.testing.assert_array_equal(seen, store.observations[3])


@pytest.mark.parametrize(
    "actions", [np.full((2, 2), np.nan), np.ma.masked_array(np.zeros((2, 2)), True), "go", [[0.0], [0.0, 1.0]]]
)
def test_actions_that_are_none_are_refused(actions, world, store):
    with pytest.raises(NoSafeAction, match="policy under guard returned"):
        ringfence.guard(lambda o, s: actions, world).act(store.observations[0])


def test_a_function_of_observations_alone_acts_as_one_that_reads_no_state(world, store):
    one, two = (
        ringfence.guard(f, world).act(store.observations[3])
        for f in (lambda seen: 0.3 * np.ones((2, 2)), lambda seen, state: 0.3 * np.ones((2, 2)))
    )
    np.testing.assert_array_equal(one, two)
    for nothing in (lambda: 0, lambda observations, state, key: 0):
        with pytest.raises(UserError, match=r"policy takes observations, or \(observations, state\)"):
            ringfence.guard(nothing, world)


@pytest.mark.parametrize(
    "function, told",
    [
        (lambda seen, care=1.0: care, 1.0),
        (lambda seen, *, care=1.0: care, 1.0),
        (lambda seen, state=None: state, "the state"),
        (lambda seen, truth: truth, "the state"),
        (lambda *given: given[1], "the state"),
    ],
)
def test_a_setting_with_a_default_is_not_the_state(function, told):
    assert of_both(function)("what is seen", "the state") == told


def test_a_memory_of_a_function_of_observations_is_copied_and_reset():
    class Counts:
        n = 0

        def reset(self):
            self.n = 0

        def step(self, observations):
            self.n += 1
            return self.n

    counts = Counts()
    first = of_both(counts.step)
    assert first(None, None) == 1
    second = copy.deepcopy(first)
    assert (first(None, None), second(None, None)) == (2, 2)
    second.reset()
    assert (first(None, None), second(None, None), counts.n) == (3, 1, 3)
    assert not hasattr(of_both(lambda observations: 0), "reset")
    assert memory_of(counts.step) is counts and memory_of(counts) is counts


def test_a_method_of_a_class_has_no_memory():
    """Whose `reset` is that of its objects, such as a simulator's that brings its driver along."""

    class Simulator:
        def reset(self):
            raise AssertionError

        @classmethod
        def driven(cls, observations):
            return 0

    assert memory_of(Simulator.driven) is None and not hasattr(of_both(Simulator.driven), "reset")


def test_a_diverged_run_does_not_act(controllers, store, monkeypatch):
    controller = controllers["run"]()
    step = controller._source._act

    def diverged(*arguments):
        carry, found = step(*arguments)
        return carry, found._replace(action=found.action * np.nan)

    controller._source._act = diverged
    with pytest.raises(NoSafeAction, match="actions that are not finite; it has diverged"):
        controller.act(store.observations[0])


def test_costs_of_agents_and_constraints():
    assert cost_given(np.float32(2), 3) == 2.0 and cost_given([0, 1, 3], 3) == 3.0
    assert cost_given({"a": 1, "b": [0.0, 2.0]}, 2) == {"a": 1.0, "b": 2.0}
    array = np.ones((2, 3), np.float32)
    assert not np.shares_memory(given_as("x", array, (2, 3)), array)


class Reusing:
    """A simulator that returns its own buffers, and writes into the actions that it is given."""

    possible_agents = ["a", "b"]

    def __init__(self):
        self.now = np.zeros((2, 3), np.float32)
        self.costs = np.zeros(2)

    def action_space(self, agent):
        from gymnasium.spaces import Box

        return Box(-1.0, 1.0, (2,))

    def reset(self, seed=None):
        self.t = 0
        self.now[:] = 0
        return self.seen(), {}

    def seen(self):
        return {"a": self.now[0], "b": self.now[1]}

    def state(self):
        return self.now.reshape(-1)

    def step(self, actions):
        self.t += 1
        self.now += 1
        self.costs += 1
        for action in actions.values():
            action *= 0
        done = {agent: self.t == 4 for agent in self.possible_agents}
        infos = {agent: {"cost": float(self.costs[0])} for agent in self.possible_agents}
        return self.seen(), dict.fromkeys(self.possible_agents, 1.0), done, dict.fromkeys(done, False), infos


def test_buffers_of_a_simulator_are_copied():
    """Every recorded state was the last one, and every action 0."""

    def policy(observations, state):
        observations[:] = 9.0
        state[:] = 9.0
        return np.full((2, 2), 0.5)

    store = collect(Reusing, policy, episodes=2)
    np.testing.assert_array_equal(store.observations[:5, 0, 0], np.arange(5))
    np.testing.assert_array_equal(store.state[:5, 0], np.arange(5))
    np.testing.assert_array_equal(store.actions, 0.5)


def test_costs_of_a_simulator_are_copied():
    env = Reusing()
    episode = Episode(env, Shape(), 0, 10)
    for _ in range(2):
        episode.step(np.zeros((2, 2)), lambda infos: env.costs)
    np.testing.assert_array_equal(episode.costs, [[1, 1], [2, 2]])


@pytest.mark.parametrize("costs", [{"near": -1.0, "far": 0.0}, {"near": 1.0, "far": np.array([0.0, -2.0])}, -1.0])
def test_nobody_is_paid_for_danger(costs):
    with pytest.raises(UserError, match="has the cost -[12]; a cost is 0 or positive"):
        Episode(Reusing(), Shape(), 0, 10).step(np.zeros((2, 2)), lambda infos: costs)


@pytest.mark.parametrize("number", [1e308, -1e31, np.inf, np.nan])
def test_rewards_beyond_all_bounds_are_refused(number):
    """Their sums, and the squares of these, would be no numbers."""
    env = Reusing()
    step = env.step
    env.step = lambda actions: (step(actions)[0], dict.fromkeys("ab", number), *step(actions)[2:])
    with pytest.raises(UserError, match="Step 1 has a reward or cost that is not finite, or beyond 1e.30"):
        Episode(env, Shape(), 0, 10).step(np.zeros((2, 2)))


class Leaving(Reusing):
    """A simulator whose second agent leaves before the first, in every third episode."""

    def reset(self, seed=None):
        self.leaves = seed % 3 == 1
        return super().reset(seed)

    def step(self, actions):
        observations, rewards, terminations, truncations, infos = super().step(actions)
        if self.leaves and self.t == 3:
            terminations["b"] = True
        if self.leaves and self.t == 4:
            raise AssertionError("nobody plays on")
        return {a: x.copy() for a, x in observations.items()}, rewards, terminations, truncations, infos


def still(observations, state):
    return np.zeros((2, 2))


def test_an_episode_that_an_agent_leaves_costs_no_other(tmp_path):
    """What was finished is kept; whoever says what is to become of such episodes goes on from there."""
    file = tmp_path / "s.h5"
    with pytest.raises(UserError, match="b ended at step 3 before its team, in the episode of Leaving with the seed 1"):
        collect(Leaving, still, episodes=6, out=file)
    assert EpisodeStore.load(file).episodes == 1
    cut = collect(Leaving, still, episodes=6, out=file, early_ends="cut")
    assert cut.lengths.tolist() == [4, 3, 4, 4, 3, 4] and cut.terminated[cut.episode_ends - 1].tolist() == [
        True,
        False,
        True,
        True,
        False,
        True,
    ]
    skipped = collect(Leaving, still, episodes=6, out=tmp_path / "t.h5", early_ends="skip")
    assert skipped.episodes == 4 and skipped.card.extra["skipped_episodes"] == 2
    assert collect(Leaving, still, episodes=6, out=tmp_path / "t.h5", early_ends="skip").content == skipped.content
    with pytest.raises(UserError, match="early_ends='drop' is none of its choices"):
        collect(Leaving, still, episodes=1, early_ends="drop")


def test_ctrl_c_keeps_what_was_collected(tmp_path):
    played = []

    def policy(observations, state):
        played.append(0)
        if len(played) > 9:
            raise KeyboardInterrupt
        return np.zeros((2, 2))

    with pytest.raises(KeyboardInterrupt, match="interrupted; 2 of 6 episodes were finished and are in"):
        collect(Reusing, policy, episodes=6, out=tmp_path / "s.h5")
    assert EpisodeStore.load(tmp_path / "s.h5").episodes == 2
    played.clear()
    with pytest.raises(Interrupted) as stopped:
        collect(Reusing, policy, episodes=6)
    assert stopped.value.finished.episodes == 2


@pytest.fixture(scope="module")
def pilot(tmp_path_factory):
    """A function under guard in that simulator."""
    g = np.random.default_rng(0)
    x = g.normal(size=(20, 11, 2, 3)).astype(np.float32)
    a = np.tanh(g.normal(size=(20, 10, 2, 2)))
    store = EpisodeStore.from_episodes(x, a, a.sum(-1), (g.random((20, 10)) < 0.2) * 1.0, card={"task": "leaving"})
    return ringfence.guard(still, worlds.fit(store, **QUICK_WORLD), anyway=True)


def test_playing_keeps_what_was_finished(pilot):
    with pytest.raises(UserError, match="b ended at step 3 before its team.*episodes were finished") as refused:
        ringfence.play(pilot, Leaving, episodes=6, num_envs=1)
    assert refused.value.finished["episodes"] in (1, 2)
    cut = ringfence.play(pilot, Leaving, episodes=6, num_envs=4, early_ends="cut")
    assert cut["episodes"] == 6 and cut["cut_episodes"] == 2 and cut["steps_mean"] == (4 * 4 + 2 * 3) / 6
    skipped = ringfence.play(pilot, Leaving, episodes=6, num_envs=4, early_ends="skip")
    assert skipped["episodes"] == 4 and skipped["skipped_episodes"] == 2 and skipped["steps_mean"] == 4


def test_ctrl_c_keeps_what_was_played(pilot):
    """All of 250 finished episodes were lost, with those that ended beside the one that was interrupted."""

    class Stopped(Reusing):
        def reset(self, seed=None):
            self.seed = seed % 10
            return super().reset(seed)

        def step(self, actions):
            observations, rewards, terminations, truncations, infos = super().step(actions)
            if self.seed == 4 and self.t == 2:
                raise KeyboardInterrupt
            over = dict.fromkeys(self.possible_agents, self.seed == 3)  # at its first step
            return observations, rewards, over if self.seed == 3 else terminations, truncations, infos

    with pytest.raises(Interrupted, match="3 of 6 episodes were finished") as stopped:
        ringfence.play(pilot, Stopped, episodes=6, num_envs=2)
    assert stopped.value.finished["episodes"] == 3 and "cost_interval" in stopped.value.finished


class Unplayed(Reusing):
    def step(self, actions):
        raise KeyboardInterrupt


def test_ctrl_c_before_anything_was_played(pilot):
    with pytest.raises(Interrupted, match="0 of 6 episodes were finished") as stopped:
        ringfence.play(pilot, Unplayed, episodes=6, num_envs=1)
    assert stopped.value.finished is None


@pytest.mark.parametrize("flag", ["False", None, [], {}])
def test_text_is_no_flag(flag):
    """Though Python takes "False" for true."""

    class Odd(Reusing):
        def step(self, actions):
            observations, rewards, _, truncations, infos = super().step(actions)
            return observations, rewards, dict.fromkeys(self.possible_agents, flag), truncations, infos

    with pytest.raises(UserError, match="neither true nor false"):
        collect(Odd, still, episodes=1)
