"""Off-policy evaluation: numbers that are known where the truth is, and a page."""

from __future__ import annotations

import dataclasses

import jax
import msgspec
import numpy as np
import pytest

import ringfence
from ringfence.cli import app
from ringfence.errors import UserError
from ringfence.evaluation.ope import FQE, fitted_q
from ringfence.evaluation.ope_responses import Logs
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.training import loop, worlds
from ringfence.world.card import Verdict
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
    settings = FQE(discount=0.8, num_ensemble=3, updates=800)
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
    beside = worlds.fit(other, seed=1, **QUICK_WORLD)
    how = {"evaluation_world": beside, "guard": "shield", "world": world, "correction_steps": 1, **QUICK}
    result = ringfence.ope(run, other, **how)
    assert result.trained_on and result.episodes_trained_on == result.logs.episodes == 40
    safety = result.safety
    behaviour = result.behaviour
    shares = (safety.predicted_violation_rate, safety.margin_violation_rate, behaviour.ood_rate)
    for share in (*shares, behaviour.intervention_rate, behaviour.infeasible_rate, behaviour.guard_ood_rate):
        assert 0 <= share <= 1
    assert safety.margin_violation_episodes <= safety.margin_violation_episodes_upper <= 1
    assert safety.margin_violation_rate >= safety.predicted_violation_rate
    assert ringfence.ope(run, other, **how) == result
    assert any("the guard steps in" in line for line in result.summary())


def test_a_guard_without_a_world_is_refused_before_one_is_fitted(run, logs, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(worlds, "fit", lambda *_, **__: pytest.fail("a World was fitted"))
    with pytest.raises(SystemExit):
        app.main(["ope", str(run.path), str(logs.save(tmp_path / "line.h5")), "--guard", "shield"])
    assert "needs the World of its data, which is not there" in capsys.readouterr().err


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
    app.main(["ope", str(run.path), str(file), *few, "--report", str(tmp_path / "ope.html")])
    said = capsys.readouterr().out
    assert "that it was trained on" in said and "danger is predicted within 3 steps" in said
    bad = msgspec.structs.replace(world.card, verdict=Verdict("unfit", ("it errs",), ("log more",)))
    monkeypatch.setattr(worlds, "fit", lambda *_, **__: dataclasses.replace(world, card=bad))
    with pytest.raises(SystemExit, match="3"):
        app.main(["fit", str(file), "--report", str(tmp_path / "fit.html")])
    for name in ("ope", "fit"):
        page = (tmp_path / f"{name}.html").read_text()
        assert "What a margin means" in page and "http" not in page and "mathdefault" not in page
        assert ("fitted Q evaluation" in page) == (name == "ope")


def shaped(lengths, agents=2, entries=2, low=-1.0, high=1.0, **card) -> EpisodeStore:
    """Logs of episodes of several lengths, with a reward of 1 at every step."""
    rng = np.random.default_rng(1)
    steps, episodes = sum(lengths), len(lengths)
    x = rng.uniform(-1, 1, (steps, agents, entries)).astype(np.float32)
    return EpisodeStore.from_steps(
        x,
        np.clip(rng.uniform(-1, 1, (steps, agents, 1)), low, high),
        np.ones((steps, agents)),
        episode_ends=np.cumsum(lengths),
        final_observations=x[:episodes],
        costs=(x[:, 0, 0] > 0.7) * 1.0,
        card={"task": "line", "action_low": low, "action_high": high, **card},
    )


@pytest.fixture(scope="module")
def uneven(tmp_path_factory):
    """(logs of several lengths, a run of them, their World)."""
    store = shaped([5, 30] * 20)
    out = tmp_path_factory.mktemp("uneven")
    changes = {"num_updates": 4, "width": 8, "view": "pruned"}
    (run,) = loop.train("bc", store, out=out, changes=changes, quiet=True)
    return store, run, worlds.fit(store, seed=1, **QUICK_WORLD)


def test_a_policy_is_played_as_long_as_the_logs(uneven):
    """A reward of 1 a step was 'return 100, the logs 55'."""
    store, run, world = uneven
    found = ringfence.ope(run, store, evaluation_world=world, **QUICK | {"rollout_steps": 30, "rollout_episodes": 40})
    assert found.rollout.returns_of_logs == 17.5
    assert abs(found.rollout.returns.mean - 17.5) < 4


def test_episodes_that_were_trained_on_are_counted(uneven):
    """Half of its own training logs counted as new."""
    from ringfence.evaluation.ope import _trained_on

    store, run, world = uneven
    new = dataclasses.replace(store, observations=store.observations + 1)
    half = store.select(np.arange(store.episodes) < 20)
    assert _trained_on(run, store) == 40 and _trained_on(run, new) == 0
    assert _trained_on(run, half) == 20 == _trained_on(run, new.followed_by(half))
    found = ringfence.ope(run, store, evaluation_world=world, **QUICK | {"rollout_episodes": 0})
    part = dataclasses.replace(found, episodes_trained_on=20).summary()[0]
    assert "by 40 logged episodes, of which it was trained on 20: leave these out" in part
    (run.path / "episodes.json").write_text('{"a": 1}')
    with pytest.raises(UserError, match="damaged episodes.json; delete that file"):
        _trained_on(run, new)
    (run.path / "episodes.json").unlink()  # as runs of before are
    assert _trained_on(run, store) == 40 and _trained_on(run, new) is None


def test_returns_that_do_not_vary_are_not_explained(uneven):
    _, _, world = uneven
    assert np.isnan(world.card.values.reward_r2) and "Rewards of steps do not vary" in str(world.card)


@pytest.mark.parametrize(
    "other, message",
    [
        (dict(agents=3), "of 2 agents, the logs of 3"),
        (dict(entries=4), "of 2 entries of an observation, the logs of 4"),
        (dict(dt=0.5), "steps of 0.1 s, the logs of 0.5 s"),
        (dict(observation_names=["own.y", "own.x"]), "Entry 0 of observation_names is 'own.x' in the run's data"),
        (dict(agents=2, card_agents=["b", "a"]), "Entry 0 of agents is 'a' in the run's data and 'b' in the logs"),
    ],
)
def test_logs_of_another_task_are_refused_whatever_they_are_called(uneven, other, message, tmp_path):
    """Every table was called 'table'; reversed entries were judged in silence."""
    import json
    import shutil

    from ringfence.evaluation.ope import check
    from ringfence.training.runs import Run

    _, run, _ = uneven
    run = Run(shutil.copytree(run.path, tmp_path / "run"))
    config = json.loads((run.path / "config.json").read_text())
    config["data"] |= {"dt": 0.1, "observation_names": ["own.x", "own.y"], "agents": ["a", "b"]}
    (run.path / "config.json").write_text(json.dumps(config))
    card = {"dt": 0.1, "agents": other.pop("card_agents", None)} | {k: v for k, v in other.items() if k == "dt"}
    names = {k: v for k, v in other.items() if k == "observation_names"}
    sizes = {k: v for k, v in other.items() if k in ("agents", "entries")}
    with pytest.raises(UserError, match=message):
        agents = card.pop("agents")
        check(run, shaped([5] * 6, **sizes, **names, **card) if agents is None else renamed_agents(agents, **card))


def renamed_agents(names, **card) -> EpisodeStore:
    store = shaped([5] * 6, **card)
    return dataclasses.replace(store, card=store.card.updated(agents=names))


def test_an_estimate_that_diverges_is_not_told():
    """A cost of −2971 was printed."""
    from ringfence.evaluation.ope import _bounded

    always = np.array([0.0, 20.0])
    assert not _bounded(np.full(5, -2971.0), always).known and not _bounded(np.array([np.nan, 1.0]), always).known
    assert _bounded(np.linspace(1, 5, 5), always).known
    assert "not known" in str(_bounded(np.full(5, -2971.0), always))


def test_actions_are_compared_in_one_unit(uneven):
    """A guard's proposals are in the run's bounds, actions in those of the logs."""
    import jax.numpy as jnp

    from ringfence.problem.normalise import in_units_of

    _, _, world = uneven
    wide = dataclasses.replace(world.spec, action_low=-2.0, action_high=2.0)
    np.testing.assert_allclose(in_units_of(world.spec, wide, jnp.array([0.25, -0.5])), [0.5, -1.0])
    same = jnp.array([0.25])
    assert in_units_of(world.spec, world.spec, same) is same
