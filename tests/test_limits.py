"""Each constraint has its own limit everywhere; the unit of costs changes nothing that is learned, played or said."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import ringfence
from ringfence.algos import td3bc
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.report import build_report
from ringfence.report.table import pool
from ringfence.training import loop, worlds
from tests.quick import QUICK_WORLD
from tests.test_report import CONSTANTS, folder, result

LIMITS = {"contact": 0.0, "fast": 20.0}


def measured(contact: float, fast: float) -> dict:
    """What a result says of both constraints."""
    costs = {"contact": contact, "fast": fast}
    return {
        name: {
            "cost_mean": cost,
            "cost_interval": (0.9 * cost, 1.1 * cost),
            "violation_rate": float(cost > 0),
            "limit": LIMITS[name],
            "limit_satisfied_rate": float(cost <= LIMITS[name]),
        }
        for name, cost in costs.items()
    }


def of_costs(contact: float, fast: float) -> dict:
    constants = CONSTANTS | {"cost_limit": 20.0}
    summary = result(np.full(20, 300.0), np.full(20, contact + fast), constants=constants)
    return summary | {"constraints": measured(contact, fast)}


@pytest.mark.parametrize("contact, fast, safe", [(10, 0, False), (0, 10, True), (0, 19, False), (0, 0, True)])
def test_what_one_limit_leaves_another_does_not_use_up(contact, fast, safe):
    """Ten contacts where none is allowed are not within a sum of limits of 20; nor is an interval that passes one."""
    numbers = pool([of_costs(contact, fast)])
    assert numbers.safe == safe and numbers.limits == LIMITS
    assert numbers.cost_norm == (np.inf if contact else fast / 20)
    several = pool([of_costs(contact, fast)] * 2)
    assert several.safe == safe


def test_a_page_speaks_of_each_limit(tmp_path):
    run = folder(tmp_path, "bc", "default", 0, {"default": of_costs(10, 0)})
    text = build_report([run], tmp_path / "r.html").read_text()
    assert "within the limit of 20" not in text and "No method keeps its costs within the limit of each" in text
    assert "over limit" in text and "contact 0, fast 20" in text
    (run.path / "results.json").write_text(json.dumps({"default": of_costs(0, 5)}))
    text = build_report([run], tmp_path / "r.html").read_text()
    assert "within the limit of each constraint (contact 0, fast 20 per episode)" in text


def charged(scale: float) -> EpisodeStore:
    """Logs with two constraints, in any unit."""
    g = np.random.default_rng(0)
    x = g.normal(size=(20, 21, 2, 3)).astype(np.float32)
    a = np.tanh(g.normal(size=(20, 20, 2, 2)))
    hit = (g.random((20, 20)) < 0.1) * 1.0
    costs = {"hit": scale * hit, "fast": scale * hit * (g.random(hit.shape) < 0.5)}
    card = {"task": "toy", "constraints": {"hit": scale, "fast": scale}}
    return EpisodeStore.from_episodes(x, a, a.sum(-1), costs, card=card)


def adapted(scale: float) -> tuple[np.ndarray, np.ndarray]:
    """(actions, margins) of a guard that hears of a cost at every step."""
    store = charged(scale)
    pilot = ringfence.guard(lambda o, s: np.zeros((2, 2)), worlds.fit(store, **QUICK_WORLD), guard="adapt")
    actions, margins = [], []
    for t in range(10):
        actions.append(pilot.act(store.observations[t], cost={"hit": scale, "fast": scale}))
        margins.append(np.asarray(pilot._carry["margin"]))
    return np.array(actions), np.array(margins)


def test_an_adapting_guard_does_not_know_the_unit_of_costs():
    """In units of 60 its margin fell while every step cost something."""
    actions, margins = adapted(1.0)
    assert (np.diff(margins[1:], axis=0) > 0).all(), "every step costs something"
    for scale in (60.0, 0.01):
        again = adapted(scale)
        np.testing.assert_allclose(again[0], actions, atol=1e-4)
        np.testing.assert_allclose(again[1], margins, atol=1e-4)


def test_a_multiplier_does_not_know_the_unit_of_costs(tmp_path):
    states = []
    for scale in (1.0, 13.0, 0.01):
        changes = {"num_updates": 30, "batch": 64, "width": 8}
        (run,) = loop.train("ma-td3bc-lag", charged(scale), changes=changes, quiet=True, out=tmp_path / str(scale))
        from ringfence.training.runs import sound_arrays

        states.append(sound_arrays(*run.checkpoints()[-1][::-1]))
    for state in states[1:]:
        for name, array in states[0].items():
            np.testing.assert_allclose(state[name], array, rtol=5e-3, atol=5e-3, err_msg=name)


def test_a_step_costs_the_multiplier_what_it_takes_of_its_own_limit():
    """An episode that keeps `limit` in this cost keeps the limit of each constraint."""
    store = charged(1.0)
    config = td3bc.Config(lagrange=True, limit=store.card.cost_limit)
    windows = td3bc.make_windows(store, config, store_view(store), None)
    costs = np.asarray(windows.arrays["costs"])
    arrived = costs[costs >= 0]
    worst = np.max([store.of_constraint(name) / limit for name, limit in store.limits.items()], 0)
    np.testing.assert_allclose(arrived, config.limit * worst, rtol=1e-6)
    strict = EpisodeStore.from_episodes(
        *[np.zeros((2, 3, 1, 1)), np.zeros((2, 2, 1, 1)), np.zeros((2, 2, 1))],
        {"a": np.full((2, 2), 0.5), "b": np.full((2, 2), 1.0)},
        card={"constraints": {"a": 0.0, "b": 4.0}},
    )
    np.testing.assert_array_equal(td3bc.share_of_limit(strict, "a"), 2.0)
    np.testing.assert_array_equal(td3bc.share_of_limit(strict, "b"), 0.25)


def store_view(store):
    from ringfence.datasets import registry

    return registry.from_store(store).feature_map("decentralized", store)


@pytest.mark.parametrize("unsafe", [1, 2])
def test_scarce_danger_is_said_and_not_calibrated(unsafe):
    """One held-out unsafe step ended in an IndexError; of three the largest score was the margin."""
    g = np.random.default_rng(0)
    x = g.normal(size=(10, 13, 2, 3)).astype(np.float32)
    a = np.tanh(g.normal(size=(10, 12, 2, 2)))
    costs = np.zeros((10, 12))
    costs[:, :unsafe] = 1
    world = worlds.fit(EpisodeStore.from_episodes(x, a, a.sum(-1), costs, card={"task": "toy"}), **QUICK_WORLD)
    assert "to say how well danger is recognised, or to set a margin" in world.card.barrier.warning
    assert "e+0" not in str(world.card)


def test_usual_numbers_have_no_exponent():
    from ringfence.utils.text import percent, significant

    assert [percent(1.0), percent(0.9999), percent(0.0), percent(0.00123)] == ["100 %", "100 %", "0 %", "0.12 %"]
    assert [significant(1500.0), significant(1234.5, 3)] == ["1500", "1230"]


def test_numbers_far_from_0_are_said():
    """UTM coordinates: names fail and errors grow, without a word."""
    from ringfence.datasets.audit import audit

    t = np.arange(60) * 0.1
    columns = {"id": np.zeros(60, int), "t": t, "x": (4.6e6 + np.sin(t)).astype(np.float32), "y": np.cos(t)}
    store = EpisodeStore.from_table(columns, time="t", agent="id", state=["x", "y"])
    assert any(note.startswith("x reaches 4.6e+06") and "double precision" in note for note in store.card.warnings)
    assert not any(note.startswith("y reaches") for note in store.card.warnings)
    far = charged(1.0)
    state = np.concatenate([4.6e6 + 0.1 * np.arange(len(far.observations))[:, None] % 1, np.zeros((420, 1))], 1)
    found = audit(EpisodeStore(**{name: getattr(far, name) for name in NAMES}, state=state.astype(np.float32)))
    assert any("State entries 0 are so far from 0" in warning for warning in found.warnings)


def test_nothing_is_learned_of_what_single_precision_blurs(tmp_path):
    """Errors were 13 to 21 times as large, without a word."""
    near = charged(1.0)
    card = near.card.updated(observation_names=["x", "vx", "other0.dx"])
    far = replace(near, observations=near.observations + np.float32([0, 0, 2e7]), card=card)
    message = r"Observation entry 2 \('other0.dx'\) of 'toy' reaches 2e\+07 and changes by 2 a step.*double precision"
    with pytest.raises(UserError, match=message):
        ringfence.fit(far)
    with pytest.raises(UserError, match=message):
        loop.train("bc", far, out=tmp_path, quiet=True)
    still = near.observations.copy()
    still[..., 2] = 2e7  # a goal that never moves
    worlds.require_resolved(replace(near, observations=still))
    worlds.require_resolved(replace(near, observations=near.observations + np.float32([0, 0, 1e5])))


NAMES = ("observations", "actions", "rewards", "costs", "terminated", "truncated", "episode_ends")


class Narrow:
    """A simulator whose actions go to 0.5."""

    possible_agents = ["a", "b"]

    def action_space(self, agent):
        from gymnasium.spaces import Box

        return Box(-0.5, 0.5, (2,))

    def reset(self, seed=None):
        raise AssertionError("it is refused before")

    step = reset


def test_a_simulator_that_does_not_take_what_a_policy_does_is_refused():
    pilot = ringfence.guard(lambda o, s: np.zeros((2, 2)), worlds.fit(charged(1.0), **QUICK_WORLD))
    with pytest.raises(UserError, match="action space of a in Narrow is from -0.5 to 0.5, the policy acts"):
        ringfence.play(pilot, Narrow, episodes=1)
