"""Teams of agents of different sizes: one array for all, and back."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv
from quick import QUICK_WORLD

import ringfence
from ringfence import Layout
from ringfence.datasets.audit import odd_actions
from ringfence.errors import StoreError, UserError

NAMES = {
    "battery": ["own.charge", "bus.load"],
    "diesel": ["own.fuel", "bus.load", "own.heat"],
}


class Grid(ParallelEnv):
    """A battery of one command and a diesel engine of two; an engine that is pushed runs hot."""

    metadata = {"name": "grid"}
    possible_agents = ["battery", "diesel"]

    def action_space(self, agent):
        return Box(-1.0, 1.0, (1,)) if agent == "battery" else Box(np.float32([0, -2]), np.float32([1, 2]))

    def observation_space(self, agent):
        return Box(-np.inf, np.inf, (len(NAMES[agent]),))

    def reset(self, seed=None, options=None):
        self.charge, self.fuel, self.load, self.heat = np.random.default_rng(seed).uniform(0.2, 0.8, 4)
        self.t = 0
        self.agents = list(self.possible_agents)
        return self.shown(), {a: {} for a in self.agents}

    def shown(self):
        return {
            "battery": np.array([self.charge, self.load], np.float32),
            "diesel": np.array([self.fuel, self.load, self.heat], np.float32),
        }

    def step(self, actions):
        assert {agent: action.shape for agent, action in actions.items()} == {"battery": (1,), "diesel": (2,)}
        self.charge += 0.1 * actions["battery"][0]
        self.heat += 0.2 * (actions["diesel"][0] - 0.5)
        self.fuel -= 0.01 * abs(actions["diesel"][1])
        self.load = 0.9 * self.load + 0.1 * self.charge
        self.t += 1
        both = dict.fromkeys(self.possible_agents)
        infos = {a: {"cost": float(self.heat > 0.9)} for a in both}
        over = dict.fromkeys(both, self.t == 8)
        if self.t == 8:
            self.agents = []
        return self.shown(), dict.fromkeys(both, float(self.load)), dict.fromkeys(both, False), over, infos


@pytest.fixture(scope="module")
def make():
    return ringfence.padded(Grid, NAMES)


@pytest.fixture(scope="module")
def logs(make):
    return ringfence.collect(make, episodes=40, card={"task": "grid"})


def layout():
    return Layout(NAMES, {"battery": [-1], "diesel": [0, -2]}, {"battery": [1], "diesel": [1, 2]})


def test_entries_of_one_name_share_a_place():
    made = layout()
    seen = {"battery": np.array([[1.0, 2.0]]), "diesel": np.array([[3.0, 2.0, 4.0]])}
    rows = made.rows(seen)
    assert made.entries == ("own.charge", "bus.load", "own.fuel", "own.heat")
    np.testing.assert_array_equal(rows, [[[1, 2, 0, 0], [0, 2, 3, 4]]])
    for agent, back in made.own(rows).items():
        np.testing.assert_array_equal(back, seen[agent])


def test_actions_stand_first_and_the_rest_is_nothing():
    made = layout()
    done = {"battery": np.array([0.5]), "diesel": np.array([1.0, -2.0])}
    joint = made.joint(done)
    np.testing.assert_array_equal(joint, [[0.5, 0], [1, -2]])
    assert {agent: action.tolist() for agent, action in made.actions(joint).items()} == {
        agent: action.tolist() for agent, action in done.items()
    }
    assert made.card == {
        "agents": ["battery", "diesel"],
        "action_low": ((-1.0, -1.0), (0.0, -2.0)),
        "action_high": ((1.0, 1.0), (1.0, 2.0)),
        "observation_names": ["own.charge", "bus.load", "own.fuel", "own.heat"],
        "action_sizes": [1, 2],
    }


def test_without_names_agents_of_one_size_share_their_places():
    made = Layout({"a": 2, "b": 3, "c": 2}, {x: [-1] for x in "abc"}, {x: [1] for x in "abc"})
    rows = made.rows({"a": [1, 2], "b": [3, 4, 5], "c": [6, 7]})
    np.testing.assert_array_equal(rows, [[1, 2, 0, 0, 0], [0, 0, 3, 4, 5], [6, 7, 0, 0, 0]])
    assert "observation_names" not in made.card and "action_sizes" not in made.card


def test_a_collection_has_every_agents_own_numbers(make, logs):
    env = Grid()
    seen, _ = env.reset(seed=0)
    np.testing.assert_array_equal(logs.observations[0], make.layout.rows(seen))
    assert logs.card.observation_names == list(make.layout.entries) and logs.card.action_sizes == [1, 2]
    assert logs.card.simulator == "Grid"
    assert (logs.actions[:, 0, 1] == 0).all(), "a battery has no second command"
    assert logs.actions[:, 1, 0].min() >= 0 and np.abs(logs.actions[:, 1, 1]).max() > 1
    after = np.arange(logs.steps) + logs.episode_of_step + 1
    np.testing.assert_array_equal(logs.costs, logs.observations[after, 1, 3] > 0.9)


def test_a_policy_of_every_agents_own_vector(make):
    def policy(observations):
        own = make.layout.own(observations)
        return make.layout.joint({"battery": -own["battery"][:1], "diesel": np.array([0.25, own["diesel"][2]])})

    store = ringfence.collect(make, policy, episodes=2)
    seen = store.observations[0]
    np.testing.assert_allclose(store.actions[0], [[-seen[0, 0], 0], [0.25, seen[1, 3]]])


def test_a_run_and_a_guarded_function_play_the_same_simulator(make, logs, tmp_path):
    run = ringfence.train("bc", logs, changes={"num_updates": 20}, out=tmp_path, quiet=True)[0]
    world = ringfence.fit(logs, **QUICK_WORLD)
    played = ringfence.play(run, make, episodes=2, guard="shield", world=world, anyway=True)
    assert played["episodes"] == 2

    pilot = ringfence.guard(
        lambda observations: make.layout.joint({"battery": [0.3], "diesel": [1.0, 0.0]}), world, anyway=True
    )
    env = Grid()
    seen, _ = env.reset(seed=1)
    action = make.layout.actions(pilot.act(make.layout.rows(seen)))
    env.step(action)
    assert ringfence.play(pilot, make, episodes=2)["episodes"] == 2


def test_what_does_not_fit_is_refused(make):
    with pytest.raises(UserError, match=r"Grid has action spaces of \[1, 2\] entries, .* pass ringfence.padded"):
        ringfence.collect(Grid, episodes=1)

    class Even(Grid):
        def action_space(self, agent):
            return Box(-1.0, 1.0, (2,))

    with pytest.raises(UserError, match=r"Agents of Even observe 2 to 3 entries, .* ringfence.padded\(make_env\)"):
        ringfence.collect(Even, episodes=1)

    class Choosy(Grid):
        def action_space(self, agent):
            return Discrete(3)

    with pytest.raises(UserError, match="battery of Choosy has the action space Discrete.*a Box of one axis"):
        ringfence.padded(Choosy)
    with pytest.raises(UserError, match="observation_names has 1 names of diesel, which observes 3 entries in Grid"):
        ringfence.padded(Grid, NAMES | {"diesel": ["own.fuel"]})
    with pytest.raises(UserError, match="observation_names has names of solar, who is not in Grid"):
        ringfence.padded(Grid, NAMES | {"solar": ["own.sun"]})
    with pytest.raises(UserError, match="make_env is a Grid and not what makes one; give Grid"):
        ringfence.padded(Grid(), NAMES)
    with pytest.raises(StoreError, match="one list of words for all agents.*ringfence.Layout makes such arrays"):
        ringfence.collect(make, episodes=1, card={"observation_names": [["a"], ["b"]]})


def test_a_card_that_contradicts_its_arrays_is_refused_or_warned_of(logs):
    for agents in (["battery"], ["battery", "battery"], ["battery", "diesel", "solar"]):
        with pytest.raises(StoreError, match=r"The card names the agents \[.*\], the data has 2; give each its own"):
            dataclasses.replace(logs, card=logs.card.updated(agents=agents))
    (said,) = odd_actions(dataclasses.replace(logs, card=logs.card.updated(action_sizes=[1, 1])))
    assert said.startswith("Entry 1 of agent 1's action is used, and by action_sizes it has 1: keep what it lacks at")
    assert odd_actions(logs) == []


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"battery": [1, 2]}, "observations has nothing of diesel"),
        ([[1, 2], [3, 2, 4]], "observations has nothing of battery"),
        ({"battery": [1, 2], "diesel": [3, 2]}, r"observations of diesel has shape \(2,\); .* its 3 entries"),
        ({"battery": [1, 2], "diesel": [[3, 2, 4]]}, r"observations of diesel has shape \(1, 3\), the first agent's"),
        ({"battery": ["a", "b"], "diesel": [3, 2, 4]}, r"observations of battery has shape \(2,\)"),
    ],
)
def test_rows_of_the_wrong_shape_are_refused(given, said):
    with pytest.raises(UserError, match=said):
        layout().rows(given)


@pytest.mark.parametrize(
    ("observations", "low", "said"),
    [
        (NAMES, {"battery": [-1]}, r"observations and action_low of different agents \(diesel\)"),
        (NAMES, {"battery": [-1, 0], "diesel": [0, -2]}, "bounds battery's action by lists of two lengths"),
        (NAMES | {"battery": "charge"}, {"battery": [-1], "diesel": [0, -2]}, "Layout has 'charge' of battery"),
        (NAMES | {"battery": ["x", "x"]}, {"battery": [-1], "diesel": [0, -2]}, "each once, or their number"),
        (NAMES | {"battery": 2}, {"battery": [-1], "diesel": [0, -2]}, "names the entries of some agents alone"),
    ],
)
def test_a_layout_that_says_two_things_is_refused(observations, low, said):
    with pytest.raises(UserError, match=said):
        Layout(observations, low, {"battery": [1], "diesel": [1, 2]})
