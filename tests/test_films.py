"""Films of simulators that nobody here knows: where agents were, as their entries' names tell."""

from __future__ import annotations

import html
import json
import re

import numpy as np
import pytest
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from ringfence import collect, play
from ringfence.errors import UserError
from ringfence.evaluation import recordings
from ringfence.problem import constraints
from ringfence.problem.entries import Names
from ringfence.report import build_report
from ringfence.report.video import recorded
from ringfence.training import loop

FAR = 5000.0  # m: where the field lies
NAMES = ["own.x", "own.y", "goal.dx", "goal.dy", "wind"]


class Field(ParallelEnv):
    """Three carts that go where they are told, for as many steps as the seed says; who is left of the middle pays."""

    metadata = {"name": "field"}
    possible_agents = ["a", "b", "c"]
    shows_end = True

    def action_space(self, agent):
        return Box(-1.0, 1.0, (2,))

    def reset(self, seed=None, options=None):
        self.place = np.random.default_rng(seed).uniform(-40, 40, (3, 2)) + FAR
        self.t, self.ends = 0, 5 + seed % 3
        self.agents = list(self.possible_agents)
        return self.seen(), {a: {} for a in self.agents}

    def seen(self):
        goal = np.array([FAR, FAR - 90.0])
        return {
            a: np.float32([*self.place[i], *(goal - self.place[i]), 0.5]) for i, a in enumerate(self.possible_agents)
        }

    def step(self, actions):
        self.place = self.place + np.array([actions[a] for a in self.possible_agents])
        self.t += 1
        infos = {a: {"cost": float(self.place[i, 0] < FAR)} for i, a in enumerate(self.possible_agents)}
        flags = dict.fromkeys(self.possible_agents, self.t == self.ends)
        seen = self.seen() if self.shows_end or self.t < self.ends else {}
        return seen, dict.fromkeys(flags, 1.0), flags, dict.fromkeys(flags, False), infos


class Unshown(Field):
    shows_end = False


def trained(tmp_path, names):
    def roam(observations, state):
        return np.random.default_rng(int(observations.sum()) % 2**31).uniform(-1, 1, (3, 2))

    card = {"task": "field", "dt": 0.2} | ({"observation_names": names} if names else {})
    logs = collect(Field, roam, episodes=12, card=card)
    changes = {"num_updates": 2, "batch": 16, "width": 16, "depth": 1}
    return loop.train("bc", logs, out=tmp_path, changes=changes, quiet=True)[0]


def shown(page: str) -> dict:
    return json.loads(re.search(r'-players">(.*?)</script>', page, re.S)[1])[0]


def test_a_report_shows_where_agents_were_in_a_simulator_of_ones_own(tmp_path):
    run = trained(tmp_path, NAMES)
    result = play(run, Field, episodes=6, num_envs=3, keep=True)
    kept = recordings.read(run.path, "default")
    lengths = [5 + seed % 3 for seed in range(7_000_001, 7_000_005)]
    assert kept["places"].shape == (4, 8, 3, 2) and np.isfinite(kept["rewards"]).sum(1).tolist() == lengths
    env = Field()
    env.reset(seed=7_000_001)
    np.testing.assert_allclose(kept["places"][0, 0], env.place, atol=1e-2)
    np.testing.assert_allclose(kept["resting"][0, 0], [FAR, FAR - 90], atol=1e-2)
    np.testing.assert_array_equal(kept["agent_costs"][0, 0] > 0, kept["places"][0, 1, :, 0] < FAR)
    assert kept["costs"].sum() == sum(result["per_episode"]["cost"][:4])

    page = build_report([run], tmp_path / "page.html").read_text()
    again = html.unescape(page)
    assert "--env THEIR.py:SIMULATOR --episodes 6 --num-envs 3" in again and "--early-ends" not in again
    film = shown(page)
    assert film["speeds"] == {"slow": 1.25, "real time": 5.0, "fast": 20.0} and film["radius"] is None
    for e, (episode, steps) in enumerate(zip(film["episodes"], lengths)):
        places = np.array(episode["positions"]) * episode["unit"]
        apart = kept["places"][e, :steps] - kept["places"][e, :1, :1]
        np.testing.assert_allclose(places[:steps] - places[:1, :1], apart[:steps], atol=2 * episode["unit"])
        assert episode["steps"] == steps == len(episode["charged"]) - 1
        assert np.abs(places).max() < episode["reach"] < 120, "in the middle of the picture, wherever the field lies"
        charged = [np.flatnonzero(cost > 0).tolist() for cost in kept["agent_costs"][e, :steps]]
        assert episode["charged"] == [[], *charged]
    with pytest.raises(UserError, match="holds no recording of default"):
        recorded(run, "default")  # a robot's film is of states


def test_an_end_that_is_not_shown_is_left_where_it_was_seen_last(tmp_path):
    run = trained(tmp_path, NAMES)
    play(run, Unshown, episodes=1, keep=True)
    kept = recordings.read(run.path, "default")["places"][0]
    assert np.isnan(kept[-1]).all() and np.isfinite(kept[:-1]).all()
    (episode,) = shown(build_report([run], tmp_path / "page.html").read_text())["episodes"]
    places = np.array(episode["positions"])
    np.testing.assert_array_equal(places[-1], places[-2])


def test_red_is_what_the_page_says_it_is(tmp_path):
    run = trained(tmp_path, NAMES)
    play(run, Field, episodes=1, keep=True)
    config = json.loads((run.path / "config.json").read_text())
    for hazard, red, radius in (
        (constraints.CostColumn(), "charged a cost", None),
        (constraints.Separation(3.0), "nearer than is allowed", 1.5),
    ):
        (run.path / "config.json").write_text(json.dumps(config | {"hazard": constraints.to_dict(hazard)}))
        film = shown(build_report([run], tmp_path / "page.html").read_text())
        assert red in film["shows"] and film["radius"] == radius
        assert ("charged" in film["episodes"][0]) == (radius is None)


@pytest.mark.parametrize(
    "name, instead, said",
    [
        ("places", np.zeros((1, 3, 2, 3)), "not pairs of numbers"),
        ("places", np.full((1, 3, 2, 2), np.nan), "nobody knows where"),
        ("places", np.zeros((1, 2, 2, 2)), "'places' begins with"),
        ("agent_costs", np.zeros((1, 2, 5)), "another number of agents"),
        ("resting", np.zeros((2, 1, 2)), "'resting' begins with"),
    ],
)
def test_damaged_places_are_refused(tmp_path, name, instead, said):
    good = {"places": np.zeros((1, 3, 2, 2)), "resting": np.zeros((1, 1, 2)), "agent_costs": np.zeros((1, 2, 2))}
    good |= {"costs": np.zeros((1, 2)), "rewards": np.zeros((1, 2))}
    recordings.write(tmp_path, "good", good, 1)
    assert recordings.read(tmp_path, "good") is not None
    np.savez_compressed(tmp_path / "rollout-bad.npz", **(good | {name: instead}))
    with pytest.raises(UserError, match=said):
        recordings.read(tmp_path, "bad")


def test_nothing_is_filmed_where_no_name_says_where_agents_are(tmp_path):
    run = trained(tmp_path, ["a", "b", "goal.dx", "goal.dy", "wind"])
    play(run, Field, episodes=1)
    (run.path / "rollout-default.npz").write_bytes(b"of another evaluation")
    play(run, Field, episodes=1, keep=True)
    assert recordings.read(run.path, "default") is None
    assert "-players" not in build_report([run], tmp_path / "page.html").read_text()


def test_places_are_read_off_names():
    x, state = np.arange(12.0).reshape(1, 2, 6), np.arange(4.0)[None]
    own = Names.of(["own.y", "own.x", "goal.dx", "goal.dy", "ball.dx", "ball.dvx"], (), 2)
    np.testing.assert_array_equal(own.place(x, None), [[[1, 0], [7, 6]]])
    assert own.resting == [[2, 3]], "a ball moves by itself"
    whole = Names.of((), ["agent0.x", "agent0.y", "agent1.x", "agent1.y"], 2)
    np.testing.assert_array_equal(whole.place(x, state), [[[0, 1], [2, 3]]])
    assert Names.of((), (), 2).place_is_unknown and Names.of(["goal.dx", "goal.dy"], (), 2).place(x, None) is None
