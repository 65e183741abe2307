"""Logs collected of anybody's simulator: what it shows is what is kept, and an interrupted collection goes on."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from functools import partial, update_wrapper
from typing import NamedTuple

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv

import ringfence
from ringfence.envs.pettingzoo import SimpleSpreadParallel
from ringfence.errors import StoreError, UserError
from ringfence.logs.store import EpisodeStore
from ringfence.utils.functions import content_of
from ringfence.utils.progress import Progress


class Drift(ParallelEnv):
    """Two points that are pushed; an episode has 3 to 6 steps, by its seed, and some end by themselves."""

    metadata = {"name": "drift"}
    possible_agents = ["a", "b"]

    def action_space(self, agent):
        return Box(-2.0, 2.0, (1,))

    def observation_space(self, agent):
        return Box(-np.inf, np.inf, (2,))

    def reset(self, seed=None, options=None):
        chance = np.random.default_rng(seed)
        self.x, self.t, self.left = chance.normal(size=2), 0, int(chance.integers(3, 7))
        self.agents = list(self.possible_agents)
        return self.shown(), {a: {} for a in self.agents}

    def shown(self):
        return {a: np.array([self.x[i], self.t], np.float32) for i, a in enumerate(self.possible_agents)}

    def step(self, actions):
        self.x = self.x + np.array([actions[a][0] for a in self.possible_agents])
        self.t += 1
        over, by_itself = self.t == self.left, self.left % 2 == 0
        both = dict.fromkeys(self.possible_agents)
        infos = {a: {"cost": float(self.x[i] > 1)} for i, a in enumerate(self.possible_agents)}
        rewards = {a: float(-abs(self.x[i])) for i, a in enumerate(self.possible_agents)}
        if over:
            self.agents = []
        return (
            self.shown(),
            rewards,
            both | dict.fromkeys(both, over and by_itself),
            dict.fromkeys(both, over and not by_itself),
            infos,
        )


def lean(observations, state):
    return 0.5 - 0.2 * observations[:, :1]


def test_what_is_shown_is_what_is_kept():
    store = ringfence.collect(Drift, lean, episodes=8, seed=5)
    env, ends = Drift(), np.concatenate([[0], store.episode_ends])
    for k in range(8):
        seen, _ = env.reset(seed=5 + k)
        steps = slice(ends[k], ends[k + 1])
        rows = store.observations[ends[k] + k : ends[k + 1] + k + 1]
        np.testing.assert_allclose(rows[0], [seen["a"], seen["b"]])
        for t in range(store.lengths[k]):
            seen, rewards, over, _, infos = env.step(dict(zip("ab", lean(rows[t], None))))
            np.testing.assert_allclose(rows[t + 1], [seen["a"], seen["b"]], atol=1e-6)
            np.testing.assert_allclose(store.rewards[steps][t], list(rewards.values()), atol=1e-6)
            np.testing.assert_array_equal(store.costs[steps][t], [infos[a]["cost"] for a in "ab"])
        assert store.episode_terminated[k] == over["a"] and not env.agents
    assert set(store.lengths) <= {3, 4, 5, 6} and len(set(store.lengths)) > 1 and store.costs.ndim == 2
    assert (store.card.action_low, store.card.action_high) == (-2, 2) and store.card.agents == ["a", "b"]
    team = ringfence.collect(Drift, lean, episodes=3, cost=lambda infos: 0.5)
    assert team.costs.ndim == 1 and (team.costs == 0.5).all()


def test_an_interrupted_collection_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr("ringfence.logs.collect.EACH", 4)
    whole = ringfence.collect(Drift, None, episodes=11, seed=1)
    advance, count = Progress.advance, []

    def stops(self, *steps):
        advance(self, *steps)
        count.append(1)
        if len(count) == 7:
            raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "advance", stops)
    with pytest.raises(KeyboardInterrupt):
        ringfence.collect(Drift, None, episodes=11, seed=1, out=tmp_path / "d.h5")
    assert EpisodeStore.load(tmp_path / "d.h5").episodes == 7
    again = ringfence.collect(Drift, None, episodes=11, seed=1, out=tmp_path / "d.h5")
    assert len(count) == 11 and again.content == whole.content == EpisodeStore.load(tmp_path / "d.h5").content
    assert ringfence.collect(Drift, None, episodes=5, seed=1, out=tmp_path / "d.h5").episodes == 5
    with pytest.raises(StoreError, match="holds another recording"):
        ringfence.collect(Drift, lean, episodes=11, seed=1, out=tmp_path / "d.h5")
    assert np.abs(whole.actions).max() > 1.5


def pushing(strength):
    return lambda observations: np.full((2, 1), strength)


class Pushing:
    def __init__(self, strength):
        self.strength = strength

    def __call__(self, observations):
        return np.full((2, 1), self.strength)

    def reset(self):
        self.steps = 0


class Softer(Pushing):
    def __call__(self, observations):
        return np.full((2, 1), self.strength / 2)


def pushed(strength, observations):
    return np.full((2, 1), strength)


def pushed_by(observations, strength):
    return pushed(strength, observations)


class Faster(Drift):
    def __init__(self, gain=1.0):
        self.gain = gain

    def step(self, actions):
        return super().step({a: self.gain * x for a, x in actions.items()})


READ = np.array([0.25])


def reading(observations):
    return np.tile(READ, (2, 1))


@pytest.mark.parametrize(
    "make", [pushing, Pushing, lambda s: partial(pushed, s), lambda s: partial(pushed_by, strength=s)]
)
def test_another_policy_of_the_same_code_is_another_recording(tmp_path, make):
    """What it captures, what it was given, and what it holds; the same values are the same policy."""
    file = tmp_path / "d.h5"
    first = ringfence.collect(Drift, make(0.25), episodes=2, out=file)
    for episodes in (2, 3):
        with pytest.raises(StoreError, match="of a policy whose code or values differ"):
            ringfence.collect(Drift, make(0.5), episodes=episodes, out=file)
    again = ringfence.collect(Drift, make(0.25), episodes=3, out=file)
    assert (again.actions == 0.25).all() and (again.episodes, first.episodes) == (3, 2)


def test_what_else_makes_another_recording(tmp_path, monkeypatch):
    """A method that differs, a value that code reads by its name, settings of the simulator, and another cost."""
    file = tmp_path / "d.h5"
    ringfence.collect(Drift, Pushing(0.25), episodes=2, out=file)
    with pytest.raises(StoreError, match="of Softer in Drift from seed 0"):
        ringfence.collect(Drift, Softer(0.25), episodes=2, out=file)
    with pytest.raises(StoreError, match="of a cost whose code"):
        ringfence.collect(Drift, Pushing(0.25), episodes=2, out=file, cost=lambda infos: 1.0)

    ringfence.collect(lambda: Faster(1.0), reading, episodes=2, out=tmp_path / "e.h5")
    with pytest.raises(StoreError, match="of a simulator whose code or values differ"):
        ringfence.collect(lambda: Faster(2.0), reading, episodes=2, out=tmp_path / "e.h5")
    ringfence.collect(partial(Faster, 1.0), reading, episodes=2, out=tmp_path / "f.h5")
    with pytest.raises(StoreError, match="of a simulator"):
        ringfence.collect(partial(Faster, 2.0), reading, episodes=2, out=tmp_path / "f.h5")
    monkeypatch.setitem(reading.__globals__, "READ", np.array([0.5]))
    with pytest.raises(StoreError, match="of a policy"):
        ringfence.collect(lambda: Faster(1.0), reading, episodes=2, out=tmp_path / "e.h5")


class Row(NamedTuple):
    strength: float

    def __call__(self, observations):
        return np.full((2, 1), self.strength)


class Listed(list):
    __call__ = Pushing.__call__


class Shown(Pushing):
    def __array__(self, dtype=None, copy=None):
        return np.zeros(2)


class Uncopied(Pushing):
    __reduce_ex__ = None


def told(kind):
    """Whose strength stands beside what it holds or wraps."""

    def make(strength):
        made = kind()
        made.strength = strength
        return made

    return make


def wrapping(strength):
    return update_wrapper(Pushing(strength), reading)


@pytest.mark.parametrize(
    "make",
    [Row, told(Listed), Shown, Uncopied, wrapping, lambda s: update_wrapper(partial(pushed, s), reading)]
    + [lambda s: {"act": np.full((2, 1), s)}.get, lambda s: np.frompyfunc(pushing(s), 1, 1)],
)
def test_whatever_holds_it_a_value_is_compared(make):
    assert content_of(make(0.25)) != content_of(make(0.5)) or " " in content_of(make(0.5))
    assert content_of(make(0.25)) == content_of(make(0.25))


def test_modules_of_ones_own_are_compared(tmp_path, monkeypatch):
    """Whatever they hold, and those that code imports as it runs; of installed ones the name counts."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_gain.py").write_text("GAIN = 0.25")
    (tmp_path / "own_control.py").write_text(
        "from math import pi\ndef act(x):\n import own_gain\n return own_gain.GAIN"
    )
    import own_control

    def policy(observations):
        return np.full((2, 1), own_control.act(observations))

    first, file = content_of(policy), tmp_path / "d.h5"
    ringfence.collect(Drift, policy, episodes=2, out=file)
    assert content_of(policy) == first
    monkeypatch.setattr(sys.modules["own_gain"], "GAIN", 0.5)
    with pytest.raises(StoreError, match="of a policy whose code or values differ"):
        ringfence.collect(Drift, policy, episodes=2, out=file)
    monkeypatch.undo()
    monkeypatch.setattr(own_control, "pi", 3)
    assert content_of(policy) != first
    monkeypatch.setattr(np, "pi", 3)
    assert content_of(lambda observations: np.pi) == content_of(lambda observations: np.pi)


def test_what_cannot_be_compared_is_not_believed(tmp_path):
    endless = (np.full((2, 1), 0.25) for _ in iter(int, 1))
    ringfence.collect(Drift, lambda observations: next(endless), episodes=2, out=tmp_path / "d.h5")
    with pytest.raises(StoreError, match="since a policy with a builtins.generator cannot be compared; delete it"):
        ringfence.collect(Drift, lambda observations: next(endless), episodes=2, out=tmp_path / "d.h5")


class Drawing:
    """A policy that draws by itself, anew from its seed at every reset if it is asked to."""

    def __init__(self, seed):
        self.seed = seed
        self.reset()

    def reset(self):
        self.chance = np.random.default_rng(self.seed)

    def act(self, observations):
        return self.chance.uniform(-1, 1, (2, 1))


def test_draws_of_a_policys_own_are_compared(tmp_path):
    def drawing(seed):
        chance = np.random.default_rng(seed)
        return lambda observations: chance.uniform(-1, 1, (2, 1))

    first = ringfence.collect(Drift, Drawing(0), episodes=2, out=tmp_path / "d.h5")
    again = ringfence.collect(Drift, Drawing(0), episodes=2, out=tmp_path / "d.h5")
    assert again.content == first.content
    with pytest.raises(StoreError, match="of a policy whose code or values differ"):
        ringfence.collect(Drift, Drawing(1), episodes=2, out=tmp_path / "d.h5")
    ringfence.collect(Drift, drawing(0), episodes=2, out=tmp_path / "e.h5")
    with pytest.raises(StoreError, match="since a policy with a numpy.random.* cannot be compared"):
        ringfence.collect(Drift, drawing(1), episodes=2, out=tmp_path / "e.h5")


def test_another_card_or_end_is_another_recording(tmp_path):
    first = {"task": "drift", "dt": 0.1}
    ringfence.collect(Drift, episodes=2, out=tmp_path / "d.h5", card=first)
    with pytest.raises(StoreError, match="of a card whose code or values differ"):
        ringfence.collect(Drift, episodes=3, out=tmp_path / "d.h5", card=first | {"dt": 0.2})
    for _ in range(2):  # a refusal of early ends leaves none, so it may go on in any way
        assert ringfence.collect(Drift, episodes=2, out=tmp_path / "d.h5", card=first, early_ends="cut").episodes == 2
        ringfence.collect(Drift, episodes=3, out=tmp_path / "d.h5", card=first, early_ends="cut")
    with pytest.raises(StoreError, match="early_ends='cut', not .* early_ends='refuse'"):
        ringfence.collect(Drift, episodes=3, out=tmp_path / "d.h5", card=first)


def test_another_process_finds_the_same_content(tmp_path):
    """Whatever addresses and the order of sets are there."""
    code = """
import functools, random, numpy as np
from ringfence.utils.functions import content_of
class Policy:
    names = {"a", "b", "c", "d"}
    def __init__(self): self.w, self.rng, self.me = np.ones(3), np.random.default_rng(), self
    def __call__(self, x): return np.tanh([y * self.w for y in x]).sum() + helper(x)
def helper(x): return [z for z in x if (lambda q: q > 1)(z)]
one = Policy(); one.rng.random(); one.lock = __import__("threading").Lock()
print(content_of(one), content_of(one.__call__), content_of(functools.partial(helper, k=np.float32(2))))
"""
    runs = [
        subprocess.run([sys.executable, "-c", code], env=os.environ | {"PYTHONHASHSEED": seed}, capture_output=True)
        for seed in ("1", "2")
    ]
    assert runs[0].stdout and len(set(runs[0].stdout.split())) == 3, runs[0].stderr
    assert runs[0].stdout == runs[1].stdout


class Mapped(Drift):
    """The same, half a million metres from 0."""

    def shown(self):
        return {a: np.array([5e5 + self.x[i], self.t], np.float64) for i, a in enumerate(self.possible_agents)}


def test_what_lies_far_from_0_is_kept_as_it_was_shown(tmp_path):
    """Policies are shown it in double precision, and an interrupted collection goes on from the same place."""
    shown = []

    def watch(observations, state):
        shown.append(observations)
        return lean(observations - [5e5, 0], state)

    near, far = ringfence.collect(Drift, lean, episodes=4), ringfence.collect(Mapped, watch, episodes=4)
    assert shown[0].dtype == np.float64 and far.observations.dtype == np.float32
    assert any("moved towards 0" in said for said in far.card.warnings)
    measured, _ = far.card.origins.measured(far.observations, None)
    np.testing.assert_allclose(measured - [5e5, 0], near.observations, atol=1e-5)

    def moved(observations, state):
        return lean(observations - [5e5, 0], state)

    for episodes in (2, 4):
        parts = ringfence.collect(Mapped, moved, episodes=episodes, out=tmp_path / "far.h5")
    assert parts.content == far.content and parts.card.origins == far.card.origins


def test_homogeneous_agents_have_costs_of_their_own():
    """Also where all of them happen to be charged alike, and where nobody is charged at all."""

    class Alike(Drift):
        def step(self, actions):
            seen, *rest, infos = super().step(actions)
            return seen, *rest, {a: {"cost": 1.0} for a in infos}

    store = ringfence.collect(Alike, lean, episodes=3, card={"homogeneous": True})
    assert store.costs.ndim == 2 and (store.split_agents().costs == 1).all()
    free = ringfence.collect(Alike, lean, episodes=3, cost=lambda infos: 0.0, card={"homogeneous": True})
    assert free.costs.ndim == 1 and free.split_agents().costs.shape == (2 * free.steps,)


def test_states_and_policies_with_a_memory_are_collected():
    class Counting:
        begun = 0

        def reset(self):
            self.begun += 1

        def act(self, observations, state):
            assert state is not None
            return np.zeros((3, 2))

    pilot = Counting()
    store = ringfence.collect(SimpleSpreadParallel, pilot, episodes=2)
    assert pilot.begun == 2 and store.state is not None and store.lengths.tolist() == [25, 25]


def test_simulators_and_policies_that_cannot_be_collected(tmp_path):
    class Few(Drift):
        def action_space(self, agent):
            return Discrete(5)

    class Unbounded(Drift):
        def action_space(self, agent):
            return Box(-np.inf, np.inf, (1,))

    class Silent(Drift):
        def step(self, actions):
            seen, *others = super().step(actions)
            return (seen if self.agents else {}), *others

    for make_env, policy, said in (
        (Few, lean, "agents need a Box of one axis"),
        (Unbounded, lean, "and bounded"),
        (Silent, lean, "tells no observations where an episode ends"),
        (Drift, lambda o, s: np.zeros((3, 1)), r"actions has shape \(3, 1\)"),
        (Drift, lambda o, s: np.full((2, 1), np.nan), "takes finite numbers"),
        (object, lean, "without"),
    ):
        with pytest.raises(UserError, match=said):
            ringfence.collect(make_env, policy, episodes=2, out=tmp_path / "x.h5")
    with pytest.raises(UserError, match="has not ended after 2 steps"):
        ringfence.collect(Drift, lean, episodes=2, max_episode_steps=2)
    assert not list(tmp_path.iterdir())


def test_a_mistyped_card_is_refused_before_anything_is_played():
    with pytest.raises(StoreError, match="did you mean 'observation_names'"):
        ringfence.collect(pytest.fail, episodes=1, card={"observation_name": ["x"]})


def test_a_simulator_that_tells_no_cost_is_said_so_at_once():
    class Misspelt(Drift):
        def step(self, actions):
            *rest, infos = super().step(actions)
            return *rest, {a: {"costs": info["cost"]} for a, info in infos.items()}

    with pytest.warns(UserWarning, match="Misspelt tells no cost, its infos costs: .* give each agent's info a 'cost'"):
        ringfence.collect(Misspelt, lean, episodes=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ringfence.collect(Misspelt, lean, episodes=2, cost=lambda infos: max(i["costs"] for i in infos.values()))
        formula = ringfence.SpeedLimit(limit=1.0, features=("own.vx",))
        ringfence.collect(Misspelt, lean, episodes=2, card={"hazard": formula})


def test_a_wrapper_of_pettingzoos_is_called_what_is_within_it():
    wrapper = type("aec_to_parallel_wrapper", (Drift,), {"__module__": "pettingzoo.utils.conversions"})
    wrapper.metadata = {"name": "drift_v2"}
    assert ringfence.collect(wrapper, episodes=1).card.simulator == "drift_v2"
    assert ringfence.collect(Drift, episodes=1).card.simulator == "Drift"
