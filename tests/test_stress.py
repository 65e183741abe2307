"""Faults of a closed loop, and guards that know them."""

import dataclasses
import hashlib
import json
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
from scipy.stats import beta

import ringfence
from ringfence.cli.app import main
from ringfence.deploy import zoo
from ringfence.deploy.controller import Controller
from ringfence.deploy.watch import Stamps
from ringfence.envs import Crossing
from ringfence.envs.mujoco import SafeMuJoCo
from ringfence.envs.pettingzoo import CrossingParallel
from ringfence.errors import NoSafeAction, UserError
from ringfence.evaluation.certificate import Certificate, Monitor, digest
from ringfence.evaluation.certify import certify, conformal, judged, shortfalls
from ringfence.evaluation.compensation import compensated, compensation, own_acceleration
from ringfence.evaluation.evaluate import evaluate
from ringfence.evaluation.protocol import rollout
from ringfence.evaluation.statistics import upper_bound
from ringfence.evaluation.stress import FILE
from ringfence.faults import Faults
from ringfence.faults.policy import Faulty, under_faults
from ringfence.guards.options import GuardOptions
from ringfence.guards.policy import build
from ringfence.guards.wrap import Nothing, guarded_of
from ringfence.loading.resolve import load, resolve
from ringfence.loading.spec import PolicySpec
from ringfence.training.runs import Run, add_entry
from ringfence.types import PolicyStep
from ringfence.utils import schemas
from ringfence.utils.chained import records
from ringfence.utils.precision import full_products

LIGHT = {"correction_steps": 1, "correction_restarts": 0, "horizon": 1, "terminal_value": False}  # compiles soon


class Counts(eqx.Module):
    """Sends the number of the step, and keeps what it sees; knows how old that is."""

    def initial_state(self, batch):
        return {"step": jnp.zeros(()), "age": jnp.zeros((batch, 2), jnp.int32), "sent": jnp.zeros((batch, 2, 2))}

    def observe_age(self, carry, age):
        return {**carry, "age": age}

    def observe_sent(self, carry, action):
        return {**carry, "sent": action}

    def act(self, carry, observations, state, key):
        action = jnp.full((*observations.shape[:2], 2), 0.01 * (carry["step"] + 1))
        info = {"seen": jnp.asarray(observations), "age": carry["age"]}
        return {**carry, "step": carry["step"] + 1}, PolicyStep(action, info)


def task(steps=12):
    env = Crossing(n_agents=2, episode_length=steps)
    return SimpleNamespace(simulator=env, env=env, action_low=-1.0, action_high=1.0)


def walk(faults, steps=12):
    """Actions (T, N) that are done, what is seen and how old it is, what the policy is told was sent; observations of
    step t are t."""
    policy = under_faults(Counts(), Faults(**faults), task())
    carry, found = policy.initial_state(1), []
    for t in range(steps):
        observations = jnp.full((1, 2, task().simulator.observation_dim), float(t))
        carry, step = policy.act(carry, observations, None, jax.random.key(t))
        found.append((step.action[0, :, 0], step.info["seen"][0], step.info["age"][0], carry["inner"]["sent"][0, :, 0]))
    return [np.asarray(x) for x in zip(*found)]


def test_a_late_action_is_done_so_many_steps_later_and_none_before():
    done, _, _, sent = walk({"delay": 3})
    np.testing.assert_allclose(done[:3], 0.0)
    np.testing.assert_allclose(done[3:], sent[:-3])
    np.testing.assert_allclose(sent[:, 0], 0.01 * np.arange(1, 13), rtol=1e-5)


def test_a_lost_observation_is_the_last_one_again_and_its_age_is_told():
    _, seen, age, _ = walk({"drop": 0.6}, 40)
    assert (age[0] == 0).all() and age.max() > 1 and (age[:, 0] != age[:, 1]).any()
    np.testing.assert_allclose(seen[..., 0], np.arange(40)[:, None] - age)
    assert 0.45 < (age[1:] > 0).mean() < 0.75


def test_noise_gain_and_turns():
    _, seen, _, _ = walk({"noise": 0.1}, 40)
    off = seen - np.arange(40)[:, None, None]
    names = task().simulator.observation_names
    flags = np.array([name.endswith(".seen") for name in names])
    assert 0.08 < off[..., ~flags].std() < 0.12
    np.testing.assert_array_equal(off[..., flags], 0.0)
    done, _, _, sent = walk({"gain": 0.5})
    np.testing.assert_allclose(done, 0.5 * sent, rtol=1e-5)
    done, _, _, _ = walk({"asynchrony": 0.5})
    changes = np.diff(done, axis=0) > 0
    assert (changes.sum(1) == 1).all(), "one of two agents acts at a time, in turn"
    np.testing.assert_array_equal(changes[::2], changes[:1].repeat(len(changes[::2]), 0))


@pytest.mark.parametrize(
    "given, words",
    [
        ({"delay": -1}, "delay=-1 of the faults must be between 0 and 1000"),
        ({"drop": 1.0}, "nothing would ever arrive"),
        ({"noise": float("nan")}, "noise=nan of the faults must"),
        ({"noise": -0.1}, "noise=-0.1"),
        ({"gain": 0.0}, "gain=0.0 of the faults must be positive"),
        ({"asynchrony": float("inf")}, "asynchrony=inf"),
        ({"delay": 1.5}, "must be a whole number"),
        ({"spread": 1.0}, "an action could have no effect"),
        ({"jitter": -1}, "jitter=-1"),
        ({"stop": 1.0}, "lie in [0, 1)"),
        ({"latency": 1}, "Unknown config field of the faults 'latency'"),
    ],
)
def test_what_is_no_fault_is_refused(given, words):
    with pytest.raises(UserError, match=re.escape(words)):
        Faults.of(given)


def test_an_episode_in_which_nothing_would_be_done_is_refused():
    with pytest.raises(UserError, match="delay=12 steps is no less than an episode of 12"):
        under_faults(Counts(), Faults(delay=12), task())


def test_simulators_outside_jax_have_faults_too():
    """Robots, by a policy that is no pytree and sees NumPy."""
    env = dataclasses.replace(SafeMuJoCo("2x3"), episode_length=6)
    robot = SimpleNamespace(simulator=env, env=env, action_low=-1.0, action_high=1.0)

    class Foreign:
        def __init__(self, push):
            self.push = push

        def initial_state(self, batch):
            return None

        def act(self, carry, observations, state, key):
            assert isinstance(observations, np.ndarray) and isinstance(state, np.ndarray)
            return carry, PolicyStep(np.full((len(observations), 2, 3), self.push, np.float32), {})

    faults = Faults(delay=3, drop=0.5, noise=0.01)
    late = rollout(under_faults(Foreign(1.0), faults, robot), env, 2)["states"]
    idle = rollout(Foreign(0.0), env, 2)["states"]
    np.testing.assert_allclose(late[:, :4], idle[:, :4], atol=1e-6)
    assert np.abs(late[:, 4] - idle[:, 4]).max() > 1e-3


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return zoo.pretrained("crossing-hasty/bc", tmp_path_factory.mktemp("runs"))


def test_without_faults_all_is_as_evaluated(run):
    plain = evaluate(run, episodes=4)
    there = ringfence.stress(run, episodes=4)
    assert there["per_episode"] == plain["per_episode"] and there["faults"] == dataclasses.asdict(Faults())
    job, policy = load(run)
    env = job.task.simulator
    behind = Faulty(policy, jnp.array(-1.0), jnp.array(1.0), Faults(), (8, env.observation_dim, 64, 2), ((), ()))
    played = [rollout(one, env, 4)["states"] for one in (policy, behind)]
    np.testing.assert_array_equal(*played)


def test_a_guard_decides_for_the_time_when_its_action_takes_effect(run):
    """What was observed is moved on by the actions sent since, as many as are due."""
    policy = load(run, guard="shield", delay=2, max_age=3)[1].one
    world = policy.guard.world
    key_present, key_sent = jax.random.split(jax.random.key(0))
    env = Crossing()
    present = env.observe(env.reset(key_present, 1))[0][:, None]
    carry = policy.initial_state(8)
    sent = jax.random.uniform(key_sent, carry["sent"].shape, minval=-1.0, maxval=1.0)
    age = jnp.arange(8)[:, None]  # beyond 3: as if 3
    carry = policy.observe_age({**carry, "sent": sent}, age)
    with full_products():
        then = policy.when_it_acts(carry, present)
    for i, due in enumerate([2, 3, 4, 5, 5, 5, 5, 5]):
        x = present[i]
        for k in range(5 - due, 5):
            with full_products():
                x, _ = world.dynamics.step(x, sent[i, k])
        np.testing.assert_allclose(then[i], x, atol=1e-6)
    at = {name: d for d, name in enumerate(world.map.names)}
    moved = np.abs(then - present)[..., at["own.vx"]]
    assert moved.max() > 0.05


def test_what_proposes_is_shown_that_state_and_what_was_sent_is_remembered(run):
    class Shows(eqx.Module):
        def initial_state(self, batch):
            return {}

        def act(self, carry, observations, state, key):
            return {"shown": observations}, PolicyStep(jnp.zeros((*observations.shape[:2], 2)), {})

    world = load(run, guard="shield")[1].one.guard.world
    late = build(Shows(), world, None, "shield", "learned", delay=1, **LIGHT)
    env = Crossing()
    observations = env.observe(env.reset(jax.random.key(0), 1))[0][:, None]
    carry = late.initial_state(8)
    carry, step = eqx.filter_jit(late.act)(carry, observations, None, jax.random.key(1))
    np.testing.assert_allclose(
        carry["inner"]["shown"], late.when_it_acts(late.initial_state(8), observations), atol=1e-6
    )
    np.testing.assert_allclose(carry["sent"][:, -1], step.action, atol=1e-6)
    other = jnp.full((8, 1, 2), 0.5)
    np.testing.assert_allclose(late.observe_sent(carry, other)["sent"][:, -1], other)
    usual = build(Shows(), world, None, "shield", "learned", **LIGHT)
    assert "sent" not in usual.initial_state(8)
    assert usual.observe_sent({}, other) == usual.observe_age({}, jnp.zeros((8, 1))) == {}


def test_actions_of_varying_lateness_are_done_as_they_arrive():
    """Each within its bounds, none after a newer one, and none before it was sent."""
    done, _, _, sent = walk({"delay": 1, "jitter": 3}, 60)
    number = np.rint(done / 0.01).astype(int)  # of the step that what is done was sent in, from 1; 0: nothing
    late = np.arange(60)[:, None] + 1 - number
    assert (np.diff(number, axis=0) >= 0).all() and (late[number > 0] >= 1).all()
    assert late[8:].max() <= 4 and set(late[8:].ravel()) >= {1, 2, 3, 4} and (late[:, 0] != late[:, 1]).any()


def test_what_is_drawn_for_an_episode_stays():
    """An entry is off by as much throughout, flags are not; agents differ in gain; who has stopped does nothing."""
    _, seen, _, _ = walk({"bias": 0.1}, 20)
    off = seen - np.arange(20)[:, None, None]
    np.testing.assert_allclose(off, np.broadcast_to(off[:1], off.shape), atol=1e-5)
    flags = np.array([name.endswith(".seen") for name in task().simulator.observation_names])
    assert 0.05 < off[0][:, ~flags].std() < 0.15 and not off[..., flags].any()
    done, _, _, sent = walk({"spread": 0.5})
    gain = done / sent
    np.testing.assert_allclose(gain, np.broadcast_to(gain[:1], gain.shape), rtol=1e-4)
    assert gain[0, 0] != gain[0, 1] and (np.abs(gain - 1) <= 0.5).all()
    done, _, _, sent = walk({"stop": 0.05}, 60)
    stopped = done == 0
    assert stopped[-1].any() and (np.diff(stopped.astype(int), axis=0) >= 0).all()
    np.testing.assert_allclose(done[~stopped], sent[~stopped])


def test_simulators_of_anybody_have_the_same_faults(run):
    """Two late steps: nothing is done in the first two, and a result behind faults is not kept among others."""

    class Recorded(CrossingParallel):
        def step(self, actions):
            acted.append(np.stack(list(actions.values())))
            return super().step(actions)

    played = {}
    for name, faults in (("plain", None), ("late", {"delay": 2})):
        acted = []
        played[name] = ringfence.play(run, Recorded, episodes=1, num_envs=1, faults=faults), np.stack(acted)
    plain, late = played["plain"][1], played["late"][1]
    np.testing.assert_array_equal(late[:2], 0.0)
    np.testing.assert_allclose(late[2], plain[0], atol=1e-5)
    assert played["late"][0]["faults"]["delay"] == 2 and "faults" not in played["plain"][0]
    with pytest.raises(UserError, match="no result has faults"):
        ringfence.play(run, Recorded, episodes=1, faults={"delay": 2}, keep=True)


# --- guards that know ---


def test_an_action_that_is_held_is_planned_as_held(run):
    policy = load(run, guard="shield", hold=2, **{**LIGHT, "horizon": 3})[1].one
    env = Crossing()
    present = env.observe(env.reset(jax.random.key(0), 1))[0][:, None]
    plans = jax.random.uniform(jax.random.key(1), (8, 1, 3, 1, 2), minval=-1.0, maxval=1.0)
    margin = jnp.full((8, 1, 1), 3.0)
    plan = policy.guard.decide(present, plans, plans[:, 0], margin, jax.random.key(2)).plan
    np.testing.assert_array_equal(plan[:, 0], plan[:, 1])
    assert np.abs(plan[:, 2] - plan[:, 1]).max() > 1e-3


def test_others_who_were_not_seen_are_taken_to_be_nearer(run):
    """By ½ a (τ² + 2 k τ) in the direction of each; whoever was seen now is where it is."""
    policy = load(run, guard="shield", max_age=4, others_acceleration=2.0, **LIGHT)[1].one
    guard = policy.guard
    names = guard.world.map.names
    env = Crossing()
    present = env.observe(env.reset(jax.random.key(0), 1))[0][:, None]
    rows, _ = guard.predict(present, jnp.zeros((8, 1, 3, 1, 2)))
    age = jnp.array([[0], [1], [2], [3], [4], [4], [4], [4]])
    near = guard.nearer(rows, age)
    dx, dy = (np.array([names.index(f"other{j}.{d}") for j in range(6)]) for d in ("dx", "dy"))
    before, after = (np.hypot(x[..., dx], x[..., dy])[:, 0, :, 0] for x in (rows, near))
    k = np.arange(4)[:, None]
    tau = np.asarray(age)[:, :, None]
    np.testing.assert_allclose(before - after, np.broadcast_to(0.01 * (tau**2 + 2 * k * tau), before.shape), atol=1e-4)
    np.testing.assert_array_equal(guard.nearer(rows, age * 0), rows)
    rest = [d for d in range(len(names)) if d not in {*dx, *dy}]
    np.testing.assert_array_equal(near[..., rest], rows[..., rest])
    assert (after > 0).all()
    assert own_acceleration(guard.world) == pytest.approx(1.0, abs=0.1)  # a disc's, by what was learned
    with pytest.raises(UserError, match="others_acceleration needs a World"):
        build(
            Nothing(),
            dataclasses.replace(guard.world, map=dataclasses.replace(guard.world.map, dt=None)),
            None,
            "shield",
            "learned",
            others_acceleration=1.0,
        )


def test_a_guard_is_told_of_all_that_it_can_be_told(run):
    told = compensated(run, Faults(delay=1, jitter=2, drop=0.3, asynchrony=0.667), {"guard": "shield"})
    assert (told["delay"], told["max_age"], told["hold"], told["horizon"]) == (2, 6, 3, 8)
    assert compensated(run, Faults(drop=0.3), {"guard": "shield", "horizon": 4})["horizon"] == 4
    assert compensated(run, Faults(drop=0.3), {"guard": "shield"})["horizon"] == 5
    assert "horizon" not in compensated(run, Faults(delay=2), {"guard": "shield"})
    late = [compensation(Faults(jitter=j), {"guard": "shield"}).get("delay", 0) for j in range(4)]
    assert late == [0, 0, 1, 1], "a newer action overtakes, so three steps at most are one in the mean"
    assert told["others_acceleration"] == pytest.approx(1.0, abs=0.1)
    assert compensated(run, Faults(noise=0.1, gain=0.5), {"guard": "shield"}) == {"guard": "shield"}


def test_more_lateness_than_the_world_can_foresee_is_refused(run):
    with pytest.raises(UserError, match="delay=6 and max_age=3 ask the World for 9 steps .* known for 8"):
        load(run, guard="shield", delay=6, max_age=3)


def test_the_command_line_stresses(run, capsys):
    main(["stress", str(run.path), "--episodes", "2", "--delay", "2", "--async", "0.5", "--gain", "0.8"])
    shown = capsys.readouterr().out
    assert all(words in shown for words in ("delay 2", "gain 0.8", "asynchrony 0.5"))
    (name,) = [name for name in json.loads((run.path / "stress.json").read_text()) if "gain" in name]
    assert name == "default behind delay2+gain0.8+asynchrony0.5"
    assert Faults.parse(name.split()[-1]) == Faults(delay=2, gain=0.8, asynchrony=0.5)
    assert Faults.parse("none") == Faults() and Faults.parse("noise1e-05") == Faults(noise=1e-5)
    with pytest.raises(UserError, match="'dealy2' in 'drop0.3.dealy2' is no fault"):
        Faults.parse("drop0.3+dealy2")
    for wrong, words in (
        (["--compensate"], "compensate is read by nothing without a guard"),
        (["--delay", "100"], "delay=100 steps is no less than an episode"),
        (["--drop", "2"], "at 1 nothing would ever arrive"),
    ):
        with pytest.raises(SystemExit):
            main(["stress", str(run.path), "--episodes", "2", *wrong])
        assert words in " ".join(capsys.readouterr().err.split())


def test_what_others_keep_meanwhile_stays(run, tmp_path, monkeypatch):
    copy = Run(shutil.copytree(run.path, tmp_path / "copy"))
    file = copy.path / FILE
    file.unlink(missing_ok=True)

    def meanwhile(*_):
        add_entry(file, lambda: {}, "other", {"of": "another process"})
        return {"episodes": 1}, None

    monkeypatch.setattr("ringfence.evaluation.stress.evaluate_policy", meanwhile)
    ringfence.stress(copy, {"gain": 0.7}, episodes=1)
    assert [*json.loads(file.read_text())] == ["other", "default behind gain0.7"]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda k: copy.add_result(f"variant{k}", {"return_mean": float(k)}), range(24)))
    assert {f"variant{k}" for k in range(24)} <= copy.results.keys() and "more" not in copy.results
    with pytest.raises(UserError, match="holds finite numbers alone, and return_interval = inf is none"):
        copy.add_result("more", {"return_interval": (0.0, np.inf)})
    assert {f"variant{k}" for k in range(24)} <= copy.results.keys() and "more" not in copy.results


def test_compensating_and_saying_so_oneself_are_one_too_many(run):
    with pytest.raises(UserError, match="compensate and delay both tell the guard"):
        ringfence.stress(run, {"delay": 1}, guard="shield", delay=1, compensate=True)


def test_the_guard_is_told_in_simulators_of_anybody_too(run, monkeypatch, capsys):
    seen = {}

    def played(run, planner, split, options, faults):
        seen.update(options)
        raise UserError("enough.")

    monkeypatch.setattr("ringfence.evaluation.play.player_of", played)
    command = ["play", str(run.path), "--env", "ringfence.envs.pettingzoo:CrossingParallel", "--async", "0.5"]
    with pytest.raises(SystemExit):
        main([*command, "--guard", "shield", "--compensate"])
    assert seen["guard"] == "shield" and seen["hold"] == 2
    with pytest.raises(SystemExit):
        main([*command, "--compensate"])
    assert "compensate is read by nothing without a guard" in capsys.readouterr().err


def test_faults_are_called_so_in_the_help(capsys):
    with pytest.raises(SystemExit):
        main(["play", "--help"])
    told = capsys.readouterr().out
    assert " faults options " in told and "wrong options" not in told


# --- certificates ---


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr("ringfence.evaluation.protocol.CHUNK", 4)


def test_a_quantile_of_few_episodes_is_none():
    scores = np.arange(1.0, 21.0)
    assert conformal(scores, 0.95) == 20.0 and conformal(scores, 0.5) == 11.0
    assert conformal(scores[:18], 0.95) == np.inf


def test_what_was_foreseen_is_compared_with_the_state_that_it_was_of(run, few):
    """Of a guard that knows its delay, so many steps later; it corrects nothing, so that it foresees what it knows."""
    resolved = resolve(PolicySpec.of(run, guard="shield", delay=2, margin=-50.0, **LIGHT))
    task = resolved.job.task
    policy = under_faults(resolved.team, Faults(delay=2), task)
    played = rollout(policy, task.simulator, 4, foreseen=True)
    came = judged(resolved.guard, task, played["states"])
    error = [np.abs(played["next_clearance"][:, :90] - came[:, lag : 90 + lag]).mean() for lag in range(5)]
    assert np.argmin(error) == 2
    assert (shortfalls(resolved, played) >= 0).all()
    assert "next_clearance" not in rollout(policy, task.simulator, 4)


def test_a_margin_is_calibrated_and_its_promise_kept_to_whom_it_was_made(run, few, tmp_path):
    made = certify(run, {"delay": 1}, quantile=0.5, calibration=4, episodes=4, **LIGHT)
    assert made.guard["delay"] == 1 and made.faults["delay"] == 1 and made.episodes == 4
    assert made.bound == pytest.approx(upper_bound(made.violations, 4))
    margins = [one["margin"] for one in made.rounds]
    assert margins == sorted(margins) and made.guard["margin"] == margins[-1]
    assert made.agreed == (made.rounds[-1]["quantile"] <= margins[-1])
    file = made.save(tmp_path / "cert.json")
    assert Certificate.load(file) == made
    how = {"guard": "shield", **LIGHT}
    controller = Controller(run, certificate=file, delay=1, **how)
    assert controller.policy.one.guard.options.margin == made.guard["margin"]
    env = Crossing()
    controller.act(np.asarray(env.observe(env.reset(jax.random.key(0), 1)))[0])
    info = controller.info
    assert info["covered"] == ~(info["infeasible"] | info["ood"])
    for wrong, words in (
        ({"delay": 2}, "of a guard with delay=1, and this one has 2"),
        ({"delay": 1, "agents": 5}, "is of 8 agents, and 5 play"),
        ({"delay": 1, "margin": 0.1}, "of a guard with margin="),
    ):
        with pytest.raises(UserError, match=words):
            Controller(run, certificate=file, **how, **wrong)
    looks = {"horizon": 5, "terminal_value": False}  # as a guard does that is told of faults
    farther = dataclasses.replace(made, guard=made.guard | looks).save(tmp_path / "farther.json")
    unsaid = {name: value for name, value in how.items() if name not in looks}
    looking = Controller(run, certificate=farther, delay=1, **unsaid).policy.one.guard.options
    assert (looking.horizon, looking.terminal_value) == (5, False)
    with pytest.raises(UserError, match="of a guard with horizon=5, and this one has 2"):
        Controller(run, certificate=farther, delay=1, **(unsaid | {"horizon": 2, "terminal_value": False}))
    with pytest.raises(UserError, match="A certificate is of a guarded run"):
        Controller(run, certificate=file)
    for field, words in (("policy", "another run"), ("world", "another World")):
        other = dataclasses.replace(made, **{field: "0"}).save(tmp_path / "other.json")
        with pytest.raises(UserError, match=words):
            Controller(run, certificate=other, delay=1, **how)
    (tmp_path / "broken.json").write_text("[]")
    with pytest.raises(UserError, match="is no certificate"):
        Certificate.load(tmp_path / "broken.json")
    assert any("95" in line for line in made.summary())


def _promised(**changes):
    """What a certificate's file holds, with its digest made anew, as whoever forges one would."""
    found = {
        "policy": "a",
        "world": "b",
        "task": "t",
        "agents": 2,
        "guard": dataclasses.asdict(GuardOptions(margin=1.0)),
        "barrier": "learned",
        "faults": dataclasses.asdict(Faults()),
        "confidence": 0.95,
        "bound": float(beta.ppf(0.95, 21, 10)),  # Clopper and Pearson's, by another function
        "episodes": 30,
        "violations": 20,
        "rounds": [{"margin": 1.0, "quantile": 0.5, "episodes": 19}],
        "agreed": True,
        "held": 1.0,
        "infeasible_rate": 0.0,
        "replayed": None,
        "simulator": "",
        "format": 2,
    }
    found |= {"says": list(schemas.check(found, Certificate).summary())} | changes
    words = json.dumps(found, sort_keys=True)
    return found | {"digest": hashlib.blake2b(words.encode(), digest_size=16).hexdigest()}


def test_a_certificate_is_believed_only_where_its_counts_say_so(tmp_path):
    file = tmp_path / "cert.json"
    file.write_text(json.dumps(_promised()))
    assert Certificate.load(file).violations == 20
    options = _promised()["guard"]
    last = {"margin": 1.0, "quantile": 0.5, "episodes": 19}
    for changes, words in (
        ({"bound": 0.0067}, "20 of 30 violations are a bound of 0.8"),
        ({"bound": "0.03"}, "Expected `float`"),
        ({"bound": None}, "Expected `float`"),
        ({"violations": -5}, ">= 0"),
        ({"violations": 31}, "31 of 30"),
        ({"confidence": 7}, "< 1.0"),
        ({"episodes": 0}, ">= 1"),
        ({"guard": {}}, "does not say"),
        ({"guard": options | {"margin": -5.0}}, "margin=-5.0 is not the one"),
        ({"guard": options | {"margin": -5.0}, "rounds": [last | {"margin": -5.0}]}, ">= 0"),
        ({"guard": options | {"horizon": 10**9}}, "horizon"),
        ({"guard": options | {"horizon": "3"}}, "other types"),
        ({"guard": options | {"turbo": 1}}, "turbo"),
        ({"guard": [[]]}, "Expected `object`"),
        ({"barrier": "hope"}, "which there is not"),
        ({"faults": {"delay": 1}}, "does not say"),
        ({"rounds": []}, "length"),
        ({"agreed": False}, "last batch"),
        ({"replayed": {"seconds": 1.0}}, "missing required field"),
        ({"format": 1}, "format 1"),
        ({"held": 2.0}, "<= 1.0"),
        ({"says": ["It is safe."]}, "says another thing than its own counts"),
        ({"safe": True}, "holds safe, which no certificate has"),
    ):
        file.write_text(json.dumps(_promised(**changes)))
        with pytest.raises(UserError, match=words):
            Certificate.load(file)
    for name in _promised():  # without its digest made anew, whatever is changed
        file.write_text(json.dumps(_promised() | {name: ["changed"]}))
        with pytest.raises(UserError, match="is no certificate"):
            Certificate.load(file)
    for content in (b"[" * 10**5, b"[]", b"null", b"\xff", b"", b'{"format": NaN}'):
        file.write_bytes(content)
        with pytest.raises(UserError, match="is no certificate"):
            Certificate.load(file)
    with open(file, "wb") as large:
        large.truncate(2**40)
    with pytest.raises(UserError, match="is larger than 1 MiB"):
        Certificate.load(file)


@pytest.mark.parametrize(
    "given, words",
    [
        ({"margin": -5.0}, "keeps no distance"),
        ({"confidence": 1.0}, "confidence=1.0 must lie between 0 and 1"),
        ({"calibration": 10}, "calibration=10 episodes tell no quantile of 0.95; give 19 or more"),
        ({"guard": "adapt"}, "An adapting margin cannot be frozen"),
        ({"guard": "none", "compensate": False}, "A certificate is of a guarded run"),
        ({"episodes": 0}, "episodes=0"),
    ],
)
def test_what_cannot_be_certified_is_refused(run, given, words):
    with pytest.raises(UserError, match=words):
        certify(run, {}, **given)


# --- monitor ---


def test_a_kept_promise_seldom_raises_an_alarm_and_a_broken_one_soon():
    rng = np.random.default_rng(0)

    def first_alarm(rate, episodes):
        monitor = Monitor(0.03)
        for k in range(episodes):
            if monitor.observe(bool(rng.random() < rate)):
                return k + 1
        return np.inf

    kept = [first_alarm(0.03, 200) for _ in range(400)]
    assert np.isfinite(kept).mean() <= 0.02  # 1 % is promised, of all episodes to come
    assert np.median([first_alarm(0.6, 50) for _ in range(200)]) <= 5
    assert np.isfinite([first_alarm(0.1, 600) for _ in range(50)]).mean() > 0.9, "little is found out, too"
    for wrong in ({"rate": 0.0}, {"rate": 0.1, "false_alarms": 1.0}, {"rate": float("nan")}, {"rate": "a"}):
        with pytest.raises(UserError, match="must lie between 0 and 1"):
            Monitor(**wrong)
    with pytest.raises(UserError, match="must be true or false"):
        Monitor(0.1).observe(0.3)


def test_what_is_done_on_an_alarm_is_an_option(run, tmp_path):
    """Reported, refused, with a wider margin, or by somebody else."""
    how = {"guard": "shield", **LIGHT}
    guard = load(run, **how)[1].one.guard
    made = Certificate(
        policy=digest(load(run)[1].one),
        world=digest(guard.world),
        task="crossing-hasty",
        agents=8,
        guard=dataclasses.asdict(guard.options),
        barrier="learned",
        faults=dataclasses.asdict(Faults()),
        confidence=0.95,
        bound=upper_bound(2, 300),
        episodes=300,
        violations=2,
        rounds=({"margin": guard.options.margin, "quantile": 0.0, "episodes": 100},),
        agreed=True,
        held=1.0,
        infeasible_rate=0.0,
    )
    file = made.save(tmp_path / "cert.json")
    env = Crossing()
    seen = np.asarray(env.observe(env.reset(jax.random.key(0), 1)))[0]

    def alarmed(**given):
        controller = Controller(run, certificate=file, log=tmp_path / f"{given}.log", **given, **how)
        first = controller.act(seen)
        info = controller.info
        assert info["covered"] == ~(info["infeasible"] | info["ood"]) and not info["alarm"]
        assert not controller.finished(False)
        alarms = [controller.finished(True) for _ in range(4)]
        assert alarms[-1] and sorted(alarms) == alarms
        return controller, first

    reports, first = alarmed()
    np.testing.assert_allclose(reports.act(seen), first, atol=1e-6)
    assert reports.info["alarm"] and not reports.info["covered"]
    reports.close()
    assert [r["kind"] for r in records(tmp_path / "{}.log")].count("finished") == 5
    stops, _ = alarmed(on_alarm="stop")
    with pytest.raises(NoSafeAction, match="More episodes violate than the certificate allows"):
        stops.act(seen)
    widens, _ = alarmed(on_alarm="widen")
    assert widens.policy.one.guard.options.margin == pytest.approx(1.5 * made.guard["margin"])
    widens.act(seen)
    for wanted, done in ((0.25, 0.25), (1e6, 1.0), (-1e6, -1.0)):
        hands_over, _ = alarmed(on_alarm="hand_over", fallback=lambda seen, wanted=wanted: np.full((8, 2), wanted))
        np.testing.assert_array_equal(hands_over.act(seen), done)
        hands_over.close()
    for wrong, words in (
        ({"on_alarm": "panic"}, "is none of its choices"),
        ({"on_alarm": "hand_over"}, "go together"),
        ({"fallback": print}, "go together"),
        ({"on_alarm": "hand_over", "fallback": 5}, "fallback is a int; give a function"),
        ({"clock": 5}, "clock is a int; give a function"),
    ):
        with pytest.raises(UserError, match=words):
            Controller(run, certificate=file, **wrong, **how)
    with pytest.raises(UserError, match="read by nothing without a certificate"):
        Controller(run, on_alarm="stop", **how)
    with pytest.raises(UserError, match="Nothing was promised"):
        Controller(run, **how).finished(True)


def test_a_controller_is_told_how_old_observations_are(run):
    env = Crossing()
    seen = np.asarray(env.observe(env.reset(jax.random.key(0), 1)))[0]
    controller = Controller(run, guard="shield", max_age=2, **LIGHT)
    fresh = controller.act(seen)
    for _ in range(3):
        controller.act(seen)
    carry = controller._aged(np.array([0, 1, 2, 0, 0, 0, 0, 0]))
    np.testing.assert_array_equal(carry["observed_age"][:, 0], [0, 1, 2, 0, 0, 0, 0, 0])
    assert controller.act(seen, age=2).shape == fresh.shape
    for age, words in ((3, "age=3 is more than max_age=2"), (-1, "must be a whole number"), (0.5, "must be a whole")):
        with pytest.raises(UserError, match=words):
            controller.act(seen, age=age)
    with pytest.raises(UserError, match="age is read by nothing here"):
        Controller(run).act(seen, age=1)


def test_what_deciding_took_lately_counts_as_age():
    """The first decision compiles, and says nothing of the next."""
    now = [0.0]
    stamps = Stamps(lambda: now[0])
    ages = []
    for took in (5.0, 0.07, 0.07, 0.07):
        ages.append(int(stamps.ages(now[0], 1, 0.1)))
        now[0] += took
        stamps.acted()
    now[0] += 0.1
    assert ages == [0, 0, 0, 1] and int(stamps.ages(now[0] - 0.1, 1, 0.1)) == 2
    stamps.reset()
    assert int(stamps.ages(now[0], 1, 0.1)) == 1


def test_ages_follow_from_times_and_clocks_that_run_backwards_are_refused(run):
    now = [100.0]
    controller = Controller(run, guard="shield", max_age=3, clock=lambda: now[0], **LIGHT)
    env = Crossing()
    seen = np.asarray(env.observe(env.reset(jax.random.key(0), 1)))[0]
    by_age = Controller(run, guard="shield", max_age=3, **LIGHT)
    ages = np.array([0, 1, 2, 3, 0, 0, 0, 0])
    for _ in range(3):
        by_time = controller.act(seen, observed_at=now[0] - 0.1 * ages - 0.01)
        np.testing.assert_allclose(by_time, by_age.act(seen, age=ages), atol=1e-6)
        now[0] += 0.1
    for stamp, words in (
        (now[0] + 1.0, "The clock runs backwards"),
        (50.0, "is before .* keep the newest"),
        (np.nan, "must be a time in seconds"),
        (np.zeros(3), "must be a time in seconds"),
    ):
        with pytest.raises(UserError, match=words):
            controller.act(seen, observed_at=stamp)
    with pytest.raises(UserError, match="give one of them"):
        controller.act(seen, age=1, observed_at=now[0])
    now[0] = 1.0
    with pytest.raises(UserError, match="The clock runs backwards"):
        controller.act(seen, observed_at=1.0)
    controller.reset()
    controller.act(seen, observed_at=1.0)
    with pytest.raises(UserError, match="observed_at needs a guard whose World"):
        Controller(run).act(seen, observed_at=0.0)
    for agents in (5, "ab", {}):
        with pytest.raises(UserError, match="agents=.* must be a list of names"):
            controller.act(seen, agents=agents)
    world = guarded_of(controller.policy).guard.world
    card = msgspec.structs.replace(world.card, data=msgspec.structs.replace(world.card.data, dt=0.1))
    unnamed = dataclasses.replace(world, card=card, map=dataclasses.replace(world.map, dt=None))  # how it moves
    by_card = Controller(run, guard="shield", world=unnamed, max_age=3, clock=lambda: now[0], **LIGHT)
    assert by_card.act(seen, observed_at=now[0]).shape == (8, 2)
