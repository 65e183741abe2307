"""Features, rollouts and behaviour learning on the robots; what the simulator does is in test_mujoco.py."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ringfence.envs.mujoco as simulator
from benchmarks import behaviour_robots as makers
from ringfence.bench import unpack
from ringfence.datasets import matd3, registry
from ringfence.datasets.make import make
from ringfence.datasets.matd3 import MATD3Config
from ringfence.datasets.recipes import robots
from ringfence.envs import SafeMuJoCo
from ringfence.errors import UserError
from ringfence.evaluation import protocol
from ringfence.logs.schema import ARRAYS
from ringfence.problem import constraints, features
from ringfence.proposals.base import Constant
from ringfence.report import video
from ringfence.report.video import animate
from ringfence.types import PolicyStep

PARTS = ("2x3", "2x4", "4x2")


def view_of(env: SafeMuJoCo, view: str = "pruned") -> features.FeatureMap:
    return env.feature_map(view)


@pytest.mark.parametrize("parts", PARTS)
def test_views_show_every_agent_its_own_joints_first(parts):
    env = SafeMuJoCo(parts)
    state = np.random.default_rng(0).normal(size=(5, len(env.state_names)))
    seen, view = state[:, env.observed], view_of(env)
    x = view(seen, state)
    at = {name: k for k, name in enumerate(env.state_names)}
    for i in range(env.n_agents):
        for k, joint in enumerate(env.own_joints[i]):
            name = env.joints[joint]
            np.testing.assert_array_equal(x[:, i, view.names.index(f"own.joint{k}.q")], state[:, at[f"{name}.q"]])
            np.testing.assert_array_equal(x[:, i, view.names.index(f"own.joint{k}.v")], state[:, at[f"{name}.v"]])
    np.testing.assert_array_equal(x[:, -1, view.names.index("torso.vx")], state[:, at["torso.vx"]])
    assert sorted(x[0, 0]) == pytest.approx(sorted(state[0])), "nothing is lost"
    own = view_of(env, "decentralized")
    assert own(seen, None).shape == seen.shape and len(set(own.names)) == len(own.names)
    assert view_of(env, "centralized")(None, state).shape == (5, env.n_agents, len(env.state_names))
    limit = constraints.SpeedLimit(env.limit, ("torso.vx", "torso.vy") if env.ant else ("torso.vx",))
    clear = constraints.bind(limit, view.names, env.n_agents).clearance(x)
    assert clear.shape == (5, env.n_agents) and np.allclose(clear, clear[:, :1])


@pytest.mark.parametrize("parts", PARTS)
def test_plans_agree_on_the_body(parts):
    """Row 0 stays; later torsos are the mean of everybody's; others' joints are where their owners plan them."""
    env = SafeMuJoCo(parts)
    view = view_of(env)
    x = jnp.asarray(np.random.default_rng(1).normal(size=(2, 4, env.n_agents, len(view.names))))
    y = view.agreed(x)
    np.testing.assert_array_equal(y[:, 0], x[:, 0])
    torso = [k for k, name in enumerate(view.names) if name.startswith("torso.")]
    np.testing.assert_allclose(y[:, 1:, :, torso], x[:, 1:, :, torso].mean(2, keepdims=True) + 0 * y[:, 1:, :, torso])
    own = [k for k, name in enumerate(view.names) if name.startswith("own.")]
    first = [k for k, name in enumerate(view.names) if name.startswith("other0.")]
    np.testing.assert_array_equal(y[..., own], x[..., own])
    np.testing.assert_allclose(y[:, 1:, 0, first], x[:, 1:, 1, own])
    np.testing.assert_allclose(view.agreed(y), y, atol=1e-6)
    # a true state is its own agreement
    state = np.random.default_rng(2).normal(size=(1, 3, len(env.state_names)))
    np.testing.assert_allclose(view.agreed(jnp.asarray(view(None, state))), view(None, state), atol=1e-6)


def test_collected_episodes_are_whole_and_replay():
    """Twice the same; every row is a step of the simulator from the row's state."""
    env = SafeMuJoCo("2x4", episode_length=60)
    first, again = (robots.played(env, [None, None], 300, seed=7, batch=4) for _ in range(2))
    for name, x in first.items():
        np.testing.assert_array_equal(x, again[name])
    lengths = np.diff(first["episode_ends"], prepend=0)
    assert first["episode_ends"][-1] == len(first["rewards"]) >= 300 and lengths.max() <= 60
    assert (first["terminated"] == (lengths < 60)).all() and set(first["policy"]) == {0, 1}
    starts = first["episode_ends"] - lengths
    sim = env.simulate(len(starts))
    state = first["state"][starts].astype(np.float64)
    sim.restore(np.concatenate([np.zeros((len(starts), 2)), state[:, :13]], 1), state[:, 13:])
    out = sim.step(first["actions"][starts])
    np.testing.assert_allclose(out.reward, first["rewards"][starts], atol=1e-3)
    np.testing.assert_allclose(sim.state(), first["state"][starts + 1], atol=1e-2)


class Push(eqx.Module):
    """Every joint of the 4x2 Ant with full torque."""

    def initial_state(self, batch):
        return {}

    def act(self, carry, observations, state, key):
        return carry, PolicyStep(jnp.ones((*observations.shape[:2], 2)), {})


class Foresees(Push):
    """As a guard that foresees the same score in every step."""

    def act(self, carry, observations, state, key):
        carry, step = super().act(carry, observations, state, key)
        return carry, step._replace(info={"next_clearance": jnp.full(len(observations), 0.5)})


class Wait(Push):
    def act(self, carry, observations, state, key):
        return carry, PolicyStep(jnp.zeros((*observations.shape[:2], 4)), {})


def test_rollouts_stop_where_the_robot_falls(monkeypatch):
    monkeypatch.setattr(simulator, "HEALTHY_Z", (0.6, 1.0))  # it soon comes to rest below
    env = SafeMuJoCo("4x2", episode_length=150)
    played = protocol.rollout(Push(), env, 6)
    assert played["rewards"].shape == played["costs"].shape == (6, 150)
    assert played["states"].shape == (6, 151, len(env.state_names))
    again = protocol.rollout(Push(), env, 3)
    np.testing.assert_array_equal(again["rewards"], played["rewards"][:3])  # a reset is the same in any batch
    other = protocol.rollout(Push(), env, 3, split="validation")
    assert not np.array_equal(other["states"][:, 0], played["states"][:3, 0])
    ends = [int(np.flatnonzero(r)[-1]) + 1 for r in played["rewards"]]
    assert max(ends) < 150 and len(set(ends)) > 1
    assert played["steps"].tolist() == ends and played["terminated"].all()
    foreseen = protocol.rollout(Foresees(), env, 6, foreseen=True)["next_clearance"]
    np.testing.assert_array_equal(foreseen, np.where(np.arange(150) < played["steps"][:, None], 0.5, -np.inf))
    told = protocol.summarise(played, registry.get("ant_4x2-good"), np.zeros(6, bool))
    assert told["termination_rate"] == 1 and told["steps_mean"] == np.mean(ends)
    assert told["cost_rate"] == pytest.approx(played["costs"].sum() / sum(ends))
    for end, rewards, states in zip(ends, played["rewards"], played["states"]):
        assert states[end, 0] < 0.6 and (states[:end, 0] >= 0.6).all()
        assert (rewards[end:] == 0).all() and (states[end:] == states[end]).all()
    task = registry.get("halfcheetah_2x3-poor")
    idle = Constant(task.spec(task.feature_map("pruned")))
    cheetah = protocol.rollout(idle, replace(task.env, episode_length=5), 2)
    assert cheetah["steps"].tolist() == [5, 5] and not cheetah["terminated"].any()


class Outside:
    """A policy that knows nothing of JAX, like one around a network of another library."""

    def initial_state(self, batch):
        return 0

    def act(self, carry, observations, state, key):
        assert isinstance(observations, np.ndarray)
        return carry + 1, PolicyStep(np.full((*observations.shape[:2], 3), 0.1 * (carry % 2)), {})


def test_any_object_can_play_a_robot():
    task = registry.get("halfcheetah_2x3-poor")
    told, _ = protocol.evaluate_policy(Outside(), replace(task, env=replace(task.env, episode_length=4)), 2)
    assert np.isfinite(told["return_mean"]) and told["steps_mean"] == 4
    with pytest.raises(UserError, match="Outside is no pytree; make it an equinox.Module"):
        protocol.evaluate_policy(Outside(), registry.get("simple_spread-expert"), 2)


def test_behaviour_learning_is_reproducible():
    env = SafeMuJoCo("2x3", episode_length=40)
    learner = MATD3Config(hidden=8, batch=16, discount=0.9, reward_scale=1.0)
    config = makers.RobotsConfig(
        learner, robots=4, stretch=8, updates=4, random_steps=64, transitions=320, score_every=5, score_episodes=2
    )
    seen = []
    one = makers.train(env, config, 0, seen.append)
    two = makers.train(env, config, 0)
    assert [s.seen for s in one] == [160, 320] == [s.seen for s in seen]
    assert [s.score for s in one] == [s.score for s in two] and np.isfinite([s.score for s in one]).all()
    assert one[0].actors.weights[0].shape == (2, 12, 8)
    other = makers.train(env, config, 1)
    assert other[-1].score != one[-1].score
    # Averages move less than what they are averages of.
    calm = makers.train(env, replace(config, averaged=0.9), 0)
    w = lambda found, k: found[k].actors.weights[0]  # noqa: E731
    assert 0 < np.abs(w(calm, 1) - w(calm, 0)).max() < np.abs(w(one, 1) - w(one, 0)).max()


def test_tiers_are_packed_from_runs_and_read_back(tmp_path):
    """The nearest to a level, in half precision, with what they earn; within a tenth of it runs take turns."""
    env = SafeMuJoCo("4x2", episode_length=20)
    for k in range(4):
        for run in ("one", "two"):
            key = jax.random.fold_in(jax.random.key(k), len(run) + (run == "two"))
            actors = matd3.init(MATD3Config(hidden=4), key, 4, env.observed.shape[1], 27, 2).actors
            makers.keep(makers.Snapshot(actors, 100 * (k + 1), 10.0 * k), tmp_path / run, 0.1)
    cards = makers.pack(env, [tmp_path / "one", tmp_path / "two"], tmp_path / "out")
    assert set(cards) == {"good", "medium", "poor"}
    gaps = [abs(p["return"] - 2770.0) for p in cards["good"]["policies"]]
    assert gaps == sorted(gaps) and {p["run"] for p in cards["good"]["policies"]} == {"one", "two"}
    made = [
        makers.Candidate(k, run, 0, e, None)
        for run, es in (("a", (100, 101, 80)), ("b", (95,)))
        for k, e in enumerate(es)
    ]
    assert [c.earned for c in makers._in_turns(made, 100.0)] == [100, 95, 101, 80]
    policies = robots.shipped_policies(env, "good", tmp_path / "out")
    assert len(policies) == 4 and policies[0].noise == 0.2 and policies[0].info["published_level"] == 2770.0
    first = cards["good"]["policies"][0]
    earned = makers.returns(env, policies[0].actors, env.simulate(32), 1).mean()
    assert earned == pytest.approx(first["return"], abs=0.051), "the card tells what the stored policy earns"
    (tmp_path / "few").mkdir()
    line = (tmp_path / "one" / "scores.jsonl").read_text().splitlines()[0]
    (tmp_path / "few" / "scores.jsonl").write_text(line)
    shutil.copy(tmp_path / "one" / "0000100.npz", tmp_path / "few")
    with pytest.raises(UserError, match="1 snapshots for 'good', 4 are needed"):
        makers.pack(env, [tmp_path / "few"], tmp_path)
    with pytest.raises(UserError, match="--transitions 100 holds no bout of learning; give 256 or more"):
        makers._train_and_keep(env, makers.RobotsConfig(transitions=100), 0, "good", tmp_path / "short")
    assert not (tmp_path / "short").exists()
    with pytest.raises(UserError, match="scores.jsonl' does not exist"):
        makers.pack(env, [tmp_path / "none"], tmp_path)


@pytest.mark.parametrize("name", [t.name for t in registry.TASKS.values() if t.protocol])
def test_tasks_and_their_limits(name):
    task = registry.get(name)
    policies = robots.shipped_policies(task.env, task.tier)
    assert len(policies) == makers.MIXED and policies[0].info["level"] == task.tier
    earned = np.mean([p["return"] for p in policies[0].info["policies"]])
    rel = 0.15 if name.startswith("ant_2x4-poor") else 0.1
    assert earned == pytest.approx(task.published_return[0], rel=rel), "the levels of the public sets"
    assert task.hazard.limit == task.env.limit
    if task.protocol == "quantile":
        results = Path(__file__).parent.parent / "results" / "mujoco"
        unpack(results)
        measured = results / "reference" / name / "reference.json"
        card = json.loads(measured.read_text())["behaviour data"]["data"]  # of the full data set
        assert task.env.limit == round(card["speed_quantiles"]["0.6"], 3)


def test_a_data_set_is_made_labelled_and_described(tmp_path, monkeypatch):
    monkeypatch.setenv("RINGFENCE_HOME", str(tmp_path))
    task = registry.get("halfcheetah_2x3-poor-quantile")
    task = replace(task, env=replace(task.env, episode_length=60))
    store, path = make(task, 300)
    again, _ = make(task, 300, fresh=True)
    np.testing.assert_array_equal(store.actions, again.actions)
    assert store.steps >= 300 and path.parent == tmp_path / "data" and store.lengths.max() <= 60
    card = store.card.to_dict()
    assert (
        card["speed_limit"] == task.env.limit
        and card["protocol"] == "quantile"
        and "not the public" in card["provenance"]
    )
    assert sum(card["episodes_of_policy"]) == store.episodes and len(card["policies"]) == 4
    with pytest.raises(UserError, match="size=0"):
        make(task, 0)
    slow = replace(task, env=replace(task.env, speed_limit=0.01))
    with pytest.raises(UserError, match="has the danger .*limit=1.026.* counts above 0.01 m/s"):
        make(slow, 300)
    native, _ = make(replace(slow, hazard=replace(task.hazard, limit=0.01)), 300)  # not the one that is kept
    np.testing.assert_array_equal(native.actions, store.actions)  # limits change labels alone
    assert native.costs.mean() > store.costs.mean()
    assert card["return_ceiling"] >= 60


def test_another_limit_counts_anew_what_is_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("RINGFENCE_HOME", str(tmp_path))
    names = "halfcheetah_2x3-good", "halfcheetah_2x3-good-quantile"
    native, quantile = (replace(t, env=replace(t.env, episode_length=60)) for t in map(registry.get, names))
    make(native, 300)
    with monkeypatch.context() as m:
        m.setattr(robots, "played", lambda *_: pytest.fail("it was simulated again"))
        counted, path = make(quantile, 300)
    simulated, _ = make(quantile, 300, fresh=True)
    for name in (*ARRAYS, "state", "speed"):
        np.testing.assert_array_equal(getattr(counted, name), getattr(simulated, name), err_msg=name)
    assert counted.card == simulated.card and path.name.startswith(names[1])
    part = counted.select(np.arange(counted.episodes) == 1)
    np.testing.assert_array_equal(part.costs, part.speed > quantile.env.limit)
    path.write_bytes(b"no HDF5")
    with pytest.warns(UserWarning, match="made again") as told:
        mended, _ = make(quantile, 300)
    assert len(told) == 1, "a damaged file is read once"
    np.testing.assert_array_equal(mended.costs, counted.costs)
    path.write_bytes(b"no HDF5")
    cached = tmp_path / "data" / path.name.replace("-quantile", "")
    cached.unlink()
    with pytest.warns(UserWarning, match=f"`ringfence data make {names[1]}` makes it again"):
        make(native, 300)


def test_what_the_limit_allows_to_earn():
    assert SafeMuJoCo("2x3").return_ceiling(0, 9.0) == pytest.approx(3227)
    assert SafeMuJoCo("2x3").return_ceiling(25, 9.0) == pytest.approx(975 * 3.227 + 25 * 9)
    assert SafeMuJoCo("4x2", 1.0).return_ceiling(0, 0.5) == pytest.approx(2000)


def test_an_episode_becomes_a_picture_or_a_reason(tmp_path):
    from PIL import Image

    env = SafeMuJoCo("2x4", episode_length=10)
    played = protocol.rollout(Wait(), env, 1)
    states, costs = played["states"][0], played["costs"][0]
    fallen = np.concatenate([states, np.repeat(states[-1:], 30, 0)])  # the film ends there
    try:
        file = animate(env, fallen, np.pad(costs, (0, 30)), tmp_path / "ant.gif")
    except UserError as error:  # no way to draw on this machine
        assert "install EGL" in str(error) and not list(tmp_path.iterdir())
        return
    with Image.open(file) as picture:
        assert picture.size == (320, 240) and picture.n_frames == 6


def test_a_film_shows_every_violation_and_the_end():
    costs = np.zeros(1001)
    costs[[5, 1000]] = 1.0
    shown = video.moments(costs)
    times, over = zip(*shown)
    assert len(shown) <= video.LONGEST + 1 and times[0] == 0 and times[-1] == 1001, "1002 states, thinned out"
    assert [t for t, o in shown if o] == [min(t for t in times if t > 5), 1001] and sum(over) == 2


def test_the_floor_goes_on_where_the_robot_runs_far(tmp_path):
    from PIL import Image

    env = SafeMuJoCo("2x3", episode_length=40)
    states = np.zeros((41, 17), np.float32)
    states[:, 0] = np.linspace(0, 0.01, 41)
    states[:, env.state_names.index("torso.vx")] = 100.0  # 200 m in all; the model's floor ends after 40
    try:
        file = animate(env, states, np.zeros(40), tmp_path / "far.gif")
    except UserError as error:
        assert "install EGL" in str(error)
        return
    with Image.open(file) as picture:
        picture.seek(picture.n_frames - 1)
        beside = np.asarray(picture.convert("L")).astype(int)[180:215, :60]
    assert beside.max() - beside.min() > 100, "light and dark tiles"


def test_a_drawing_process_that_dies_is_no_traceback(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "backend", lambda: "egl")
    killed = subprocess.CompletedProcess([], -9, "", "")
    monkeypatch.setattr(video, "_run", lambda *_: killed)
    with pytest.raises(UserError, match="x.gif' could not be drawn: .* status -9 .*free some memory"):
        animate(SafeMuJoCo("2x3"), np.zeros((3, 17)), np.zeros(2), tmp_path / "x.gif")
    assert not list(tmp_path.iterdir())


def test_without_a_way_to_draw_the_reason_is_said(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glass")
    with pytest.raises(UserError, match="cannot be drawn here .*install EGL"):
        animate(SafeMuJoCo("2x3"), np.zeros((3, 17)), np.zeros(2), tmp_path / "x.gif")
    assert not list(tmp_path.iterdir())
