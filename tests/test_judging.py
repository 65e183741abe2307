"""Judging by logs alone: numbers that are known where the truth is, and a page."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

import ringfence
from ringfence.cli import app
from ringfence.errors import UserError
from ringfence.evaluation import ope
from ringfence.evaluation.ope.fqe import worth
from ringfence.evaluation.ope.logs import Logs
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.training import loop, worlds
from tests.quick import QUICK_WORLD

QUICK = dict(states=100, transitions=400, updates=20, members=2, episodes=8, steps=5)


@pytest.fixture(scope="module")
def logs():
    """Two agents on a line who are pushed; being right of 0.5 costs."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (60, 10, 2, 1))
    x = rng.uniform(-1, 1, (60, 1, 2, 1)) + 0.2 * np.concatenate([np.zeros((60, 1, 2, 1)), actions.cumsum(1)], 1)
    costs = (x[:, 1:, :, 0] > 0.5).any(-1)
    return EpisodeStore.from_episodes(
        np.concatenate([x, x**2], -1), actions, actions[..., 0], costs.astype(float),
        card={"task": "line", "hazard": constraints.CostColumn(), "observation_names": ["own.x", "own.square"]},
    )  # fmt: skip


@pytest.fixture(scope="module")
def world(logs):
    return worlds.fit(logs, seed=1, **QUICK_WORLD)


@pytest.fixture(scope="module")
def run(logs, tmp_path_factory):
    told = {"view": "pruned", "steps": 4, "width": 16}
    return loop.train("bc", logs, out=tmp_path_factory.mktemp("judged"), changes=told, quiet=True)[0]


@pytest.mark.parametrize("action", [0.6, -0.4])
def test_fitted_q_evaluation_finds_what_an_action_is_worth(logs, world, action):
    """The reward is the action, so whoever always takes the same earns it for ever: a / (1 − γ)."""
    told = Logs(logs, world)
    steps, starts = np.arange(logs.steps), told.starts
    always = np.full((len(steps), 2, 1), action, np.float32)
    found = worth(told, steps, always, starts, always[: len(starts)], "", jax.random.key(0), 3, 1500, 0.8, True)
    assert abs(found["return"]["mean"] - action / 0.2) < 0.4
    assert found["return"]["low"] < found["return"]["mean"] < found["return"]["high"]
    right = {-0.4: 0, 0.6: 1}[action]  # who drifts right pays, who drifts left does not
    assert (found["cost"]["mean"] > 2.5) == bool(right)


def test_a_judgement_says_what_the_policy_does(run, logs, world):
    alone = ringfence.judge(run, logs, judge_world=world, **QUICK)
    assert alone["trained_on"] and alone["steps_in"] is None and alone["guard"] == "none"
    other = dataclasses.replace(logs.select(np.arange(60) < 40))
    guarded = worlds.fit(logs, seed=0, **QUICK_WORLD)
    beside = worlds.fit(other, seed=1, **QUICK_WORLD)
    told = ringfence.judge(run, other, judge_world=beside, guard="shield", world=guarded, shield=1, **QUICK)
    assert not told["trained_on"] and told["logs"]["episodes"] == 40
    for name in ("steps_in", "infeasible", "strange", "unknown", "foreseen_unsafe", "not_surely_safe"):
        assert 0 <= told[name] <= 1
    assert told["episodes_not_surely_safe"] <= told["episodes_upper"] <= 1
    assert told["not_surely_safe"] >= told["foreseen_unsafe"]
    again = ringfence.judge(run, other, judge_world=beside, guard="shield", world=guarded, shield=1, **QUICK)
    assert again == told
    assert any("the guard steps in" in line for line in ope.words(told))


def test_others_logs_and_worlds_are_refused(run, logs, world):
    other = dataclasses.replace(logs, card={**logs.card, "task": "circle"})
    with pytest.raises(UserError, match="The run is of 'line', the logs are of 'circle'"):
        ringfence.judge(run, other)
    with pytest.raises(UserError, match="judge_world is of other logs"):
        ringfence.judge(run, logs.select(np.arange(60) < 30), judge_world=world)
    for bad, said in (({"discount": 1.0}, "discount=1.0"), ({"states": 0}, "states=0"), ({"members": 1}, "members=1")):
        with pytest.raises(UserError, match=said):
            ringfence.judge(run, logs, judge_world=world, **bad)


def test_pages_of_logs_and_of_policies_open_anywhere(run, logs, world, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(worlds, "fit", lambda *_, **__: world)
    file = logs.save(tmp_path / "line.h5")
    few = ["--states", "100", "--transitions", "400", "--updates", "20"]
    app.main(["judge", str(run.path), str(file), *few, "--report", str(tmp_path / "judge.html")])
    said = capsys.readouterr().out
    assert "that it was trained on" in said and "danger is foreseen within 3 steps" in said
    app.main(["fit", str(file), "--report", str(tmp_path / "fit.html")])
    for name in ("judge", "fit"):
        page = (tmp_path / f"{name}.html").read_text()
        assert "What a margin means" in page and "http" not in page and "mathdefault" not in page
        assert ("fitted Q evaluation" in page) == (name == "judge")
