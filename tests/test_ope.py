"""Off-policy evaluation: numbers that are known where the truth is, and a page."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

import ringfence
from ringfence.cli import app
from ringfence.errors import UserError
from ringfence.evaluation.ope.fqe import FQE, fitted_q
from ringfence.evaluation.ope.logs import Logs
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.training import loop, worlds
from tests.quick import QUICK_WORLD

QUICK = dict(states=100, transitions=400, updates=20, num_ensemble=2, rollout_episodes=8, rollout_steps=5)


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
    changes = {"view": "pruned", "num_updates": 4, "width": 16}
    return loop.train("bc", logs, out=tmp_path_factory.mktemp("evaluated"), changes=changes, quiet=True)[0]


@pytest.mark.parametrize("action", [0.6, -0.4])
def test_fitted_q_evaluation_finds_what_an_action_is_worth(logs, world, action):
    """The reward is the action, so whoever always takes the same earns it for ever: a / (1 − γ)."""
    view = Logs(logs, world)
    steps = np.arange(logs.steps)
    always = np.full((len(steps), 2, 1), action, np.float32)
    settings = FQE(discount=0.8, num_ensemble=3, updates=1500)
    first = always[: logs.episodes]
    found = fitted_q(view, steps, always, view.starts, first, settings, jax.random.key(0))
    assert abs(found.returns.mean - action / 0.2) < 0.4
    assert found.returns.low < found.returns.mean < found.returns.high
    right = {-0.4: 0, 0.6: 1}[action]  # who drifts right pays, who drifts left does not
    assert (found.costs.mean > 2.5) == bool(right)


def test_a_result_says_what_the_policy_does(run, logs, world):
    alone = ringfence.ope(run, logs, evaluation_world=world, **QUICK)
    assert alone.trained_on and alone.behaviour.intervention_rate is None and alone.guard == "none"
    other = dataclasses.replace(logs.select(np.arange(60) < 40))
    guarded = worlds.fit(logs, seed=0, **QUICK_WORLD)
    beside = worlds.fit(other, seed=1, **QUICK_WORLD)
    how = {"evaluation_world": beside, "guard": "shield", "world": guarded, "correction_steps": 1, **QUICK}
    result = ringfence.ope(run, other, **how)
    assert not result.trained_on and result.logs.episodes == 40
    safety = result.safety
    behaviour = result.behaviour
    shares = (safety.predicted_violation_rate, safety.margin_violation_rate, behaviour.ood_rate)
    for share in (*shares, behaviour.intervention_rate, behaviour.infeasible_rate, behaviour.guard_ood_rate):
        assert 0 <= share <= 1
    assert safety.margin_violation_episodes <= safety.margin_violation_episodes_upper <= 1
    assert safety.margin_violation_rate >= safety.predicted_violation_rate
    assert ringfence.ope(run, other, **how) == result
    assert any("the guard steps in" in line for line in result.summary())


def test_the_name_of_before_gives_what_it_gave(run, logs, world):
    quick = {"states": 100, "transitions": 400, "updates": 20, "members": 2, "episodes": 8, "steps": 5}
    with pytest.warns(FutureWarning, match="ringfence.ope"):
        judged = ringfence.judge(run, logs, judge_world=world, **quick)
    result = ringfence.ope(run, logs, evaluation_world=world, **QUICK)
    assert judged["foreseen_unsafe"] == result.safety.predicted_violation_rate
    assert judged["apart"] == result.behaviour.action_rmse and judged["steps_in"] is None
    assert judged["played"]["return"]["mean"] == result.rollout.returns.mean
    assert judged["cost_of_logs"]["high"] == result.values_of_logs.costs.high


def test_others_logs_and_worlds_are_refused(run, logs, world):
    other = dataclasses.replace(logs, card=logs.card.updated(task="circle"))
    with pytest.raises(UserError, match="The run is of 'line', the logs are of 'circle'"):
        ringfence.ope(run, other)
    with pytest.raises(UserError, match="evaluation_world is of other logs"):
        ringfence.ope(run, logs.select(np.arange(60) < 30), evaluation_world=world)
    for name, value in (("discount", 1.0), ("states", 0), ("num_ensemble", 1)):
        with pytest.raises(UserError, match=f"{name}={value}"):
            ringfence.ope(run, logs, evaluation_world=world, **{name: value})


def test_pages_of_logs_and_of_policies_open_anywhere(run, logs, world, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(worlds, "fit", lambda *_, **__: world)
    file = logs.save(tmp_path / "line.h5")
    few = ["--states", "100", "--transitions", "400", "--updates", "20"]
    app.main(["judge", str(run.path), str(file), *few, "--report", str(tmp_path / "ope.html")])  # as in 0.1.0
    said, noted = capsys.readouterr()
    assert "'judge' is called 'ope' now" in noted
    assert "that it was trained on" in said and "danger is predicted within 3 steps" in said
    app.main(["fit", str(file), "--report", str(tmp_path / "fit.html")])
    for name in ("ope", "fit"):
        page = (tmp_path / f"{name}.html").read_text()
        assert "What a margin means" in page and "http" not in page and "mathdefault" not in page
        assert ("fitted Q evaluation" in page) == (name == "ope")
