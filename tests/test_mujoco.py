"""The robots are those of safety-gymnasium: against its recorded steps, and live against gymnasium-robotics."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import mujoco
import numpy as np
import pytest

import ringfence.envs.mujoco as simulator
from ringfence.envs.mujoco import SafeMuJoCo
from ringfence.envs.pettingzoo import SafeMuJoCoParallel
from ringfence.errors import UserError

ROBOTS = {"2x3": "HalfCheetah_2x3", "2x4": "Ant_2x4", "4x2": "Ant_4x2"}
VERSION = tuple(int(x) for x in mujoco.__version__.split(".")[:2])
EXACT = VERSION < (3, 5)  # later versions differ in the last digits


@pytest.fixture(scope="module")
def golden() -> dict[str, dict[str, np.ndarray]]:
    """Single steps of safety-gymnasium 1.0.0 (mujoco 2.3.3), by robot."""
    with np.load(Path(__file__).parent / "data" / "safe_mujoco_steps.npz") as file:
        told = {k: file[k] for k in file.files}
    return {p: {k[len(n) + 1 :]: v for k, v in told.items() if k.startswith(n)} for p, n in ROBOTS.items()}


@pytest.fixture(params=["batch", "loop"])
def engine(request, monkeypatch) -> str:
    """Both ways of stepping."""
    if request.param == "loop":
        monkeypatch.setattr(simulator, "_Batch", _absent)
    elif VERSION < (3, 17):
        pytest.skip("mujoco.batch begins with 3.17")
    return request.param


def _absent(*_):
    raise ImportError


@pytest.mark.parametrize("parts", ROBOTS)
def test_one_step_is_that_of_safety_gymnasium(golden, engine, parts):
    g, env = golden[parts], SafeMuJoCo(parts)
    sim = env.simulate(len(g["act"]), threads=2)
    sim.restore(g["qpos0"], g["qvel0"], g["warm0"], g["xpos0"][:, :2] if env.ant else None)
    out = sim.step(g["act"][:, env.actuators])
    close = 1e-10 if EXACT else 1e-5
    np.testing.assert_allclose(sim.state(), g["state"], rtol=0, atol=close)
    np.testing.assert_allclose(sim.state()[:, env.observed].reshape(len(g["act"]), -1), g["obs"], rtol=0, atol=close)
    np.testing.assert_allclose(out.reward, g["rew"][:, 0], rtol=0, atol=1e-12 if EXACT else 1e-6)
    clear = abs(out.info["speed"] - env.limit) > 1e-6
    assert (out.cost == g["cost"][:, 0])[clear].all() and out.cost.sum() >= 8
    assert (out.terminated == g["term"]).all()


@pytest.mark.parametrize("parts", ROBOTS)
def test_resets_are_those_of_safety_gymnasium(golden, parts):
    sim = SafeMuJoCo(parts).simulate(3, threads=1)
    sim.reset([0, 1, 2])
    wanted = np.stack([golden[parts][f"init{i}"] for i in range(3)])
    first = 1 if parts == "2x3" else 2
    np.testing.assert_allclose(sim.state(), wanted[:, first:], rtol=0, atol=1e-12)


def test_layouts():
    cheetah, ant, spider = (SafeMuJoCo(p) for p in ROBOTS)
    assert [e.observed.shape for e in (cheetah, ant, spider)] == [(2, 12), (2, 21), (4, 18)]
    assert [len(e.state_names) for e in (cheetah, ant, spider)] == [17, 27, 27]
    assert cheetah.observation_names[:7] == (
        *("bfoot.q", "bfoot.v", "bshin.q", "bshin.v", "bthigh.q", "bthigh.v"),
        "fthigh.q",
    )
    assert ant.actuators.tolist() == [[2, 3, 4, 5], [6, 7, 0, 1]]
    assert [e.limit for e in (cheetah, ant, spider)] == [3.227, 2.522, 2.418]
    assert SafeMuJoCo("4x2", speed_limit=1.5).limit == 1.5


def test_masses_and_margins():
    cheetah, ant = SafeMuJoCo("2x3").model(), SafeMuJoCo("2x4").model()
    assert cheetah.body_mass.sum() == pytest.approx(14.0)
    assert ant.body_mass.sum() == pytest.approx(0.91088, abs=1e-4)
    assert set(ant.geom_margin) == {0.005 if VERSION >= (3, 5) else 0.01}


def test_an_ant_at_rest_stands_where_it_used_to():
    """0.382 m would mean that contact margins are added, as MuJoCo does since 3.5."""
    sim = SafeMuJoCo("4x2").simulate(2, threads=1)
    sim.reset([0, 1])
    for _ in range(200):
        sim.step(np.zeros((2, 4, 2)))
    assert sim.state()[:, 0] == pytest.approx(0.3725, abs=0.002)


def test_both_engines_agree_to_the_bit(monkeypatch):
    if VERSION < (3, 17):
        pytest.skip("mujoco.batch begins with 3.17")

    def play():
        sim = SafeMuJoCo("2x4").simulate(3, threads=2)
        sim.reset([5, 6, 7])
        rng = np.random.default_rng(0)
        return [(*sim.step(rng.uniform(-1, 1, (3, 2, 4)))[:4], sim.state()) for _ in range(30)]

    first = play()
    monkeypatch.setattr(simulator, "_Batch", _absent)
    for a, b in zip(first, play()):
        for x, y in zip(a, b):
            np.testing.assert_array_equal(x, y)


def test_a_reset_does_not_depend_on_the_batch_and_the_fallen_stay_down():
    env = SafeMuJoCo("2x4")
    one, many = env.simulate(1, threads=1), env.simulate(3, threads=2)
    one.reset([(9, 1)])
    many.reset([(9, 0), (9, 1), (9, 2)])
    np.testing.assert_array_equal(one.state()[0], many.state()[1])
    # one robot is put out of bounds: its episode ends with that step, the others go on
    qpos, qvel = many._robots.qpos.copy(), many._robots.qvel.copy()
    qpos[2, 2] = 1.5
    many.restore(qpos, qvel)
    out = many.step(np.zeros((3, 2, 4)))
    assert out.terminated.tolist() == [False, False, True] and many.running.tolist() == [True, True, False]
    assert out.reward[2] != 0  # the step itself is paid
    before = many.state()[2]
    out = many.step(np.ones((3, 2, 4)))
    assert out.reward[2] == out.cost[2] == out.info["speed"][2] == 0 and not out.terminated.any()
    np.testing.assert_array_equal(many.state()[2], before)


def test_actions_are_clipped_and_bad_input_is_refused(monkeypatch):
    env = SafeMuJoCo("2x3")
    states = []
    for size in (1.0, 7.0):
        sim = env.simulate(1)
        sim.reset([0])
        sim.step(np.full((1, 2, 3), size))
        states.append(sim.state())
    np.testing.assert_array_equal(*states)
    for wrong in ((1, 2, 1), (1, 3, 2), (2, 2, 3)):
        with pytest.raises(UserError, match=r"halfcheetah_2x3 takes \(1, 2, 3\)"):
            sim.step(np.zeros(wrong))
    with pytest.raises(UserError, match="2 seeds for 1 robots"):
        sim.reset([0, 1])
    with pytest.raises(UserError, match="did you mean"):
        SafeMuJoCo("2x5")
    with pytest.raises(UserError, match="episode_length=0 must be at least 1"):
        SafeMuJoCo("2x3", episode_length=0)
    with pytest.raises(UserError, match="speed_limit=0"):
        SafeMuJoCo("2x3", speed_limit=0)
    monkeypatch.setattr(mujoco, "__version__", "4.0.0")
    assert env.model().nu == 6
    with pytest.raises(UserError, match="MuJoCo 4.0.0 integrates free joints differently"):
        SafeMuJoCo("2x4").model()


def test_pettingzoo_face():
    from pettingzoo.test import parallel_api_test

    env = SafeMuJoCoParallel(parts="4x2", episode_length=30)
    parallel_api_test(env, num_cycles=40)
    first = env.reset(seed=4)[0]["agent_2"]
    second = env.reset()[0]["agent_2"]
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(env.reset(seed=4)[0]["agent_2"], first)
    with pytest.raises(UserError, match="seed=-1; pass one of 0 or more"):
        env.reset(seed=-1)
    np.testing.assert_array_equal(env.reset()[0]["agent_2"], second)
    actions = dict.fromkeys(env.agents, np.zeros(2, np.float32))
    for _ in range(30):
        *_, over, infos = env.step(actions)
    assert over["agent_0"] and env.agents == []
    assert infos["agent_3"]["clearance"] == pytest.approx(2.418 - infos["agent_3"]["speed"])
    with pytest.raises(UserError, match="call reset"):
        env.step(actions)
    with pytest.raises(UserError, match="no render_mode='human' of robots"):
        SafeMuJoCoParallel(render_mode="human")


def test_a_fall_is_a_termination_behind_pettingzoo(monkeypatch):
    monkeypatch.setattr(simulator, "HEALTHY_Z", (0.6, 1.0))  # it soon comes to rest below
    env = SafeMuJoCoParallel(parts="2x4")
    env.reset(seed=0)
    for _ in range(150):
        *_, fallen, over, _ = env.step(dict.fromkeys(env.agents, np.zeros(4, np.float32)))
        if not env.agents:
            break
    assert fallen == {"agent_0": True, "agent_1": True} and not any(over.values()) and env.agents == []


def test_no_log_file_is_left_where_one_works(tmp_path, monkeypatch):
    """Newer versions of MuJoCo complain of an attribute of Gymnasium's file in MUJOCO_LOG.TXT."""
    monkeypatch.chdir(tmp_path)
    for parts in ROBOTS:
        SafeMuJoCo(parts).simulate(1, threads=1)
    assert not list(tmp_path.iterdir())


def test_a_copy_goes_on_like_the_original(engine):
    """Tools that run several environments copy them, or send them to other processes."""
    env = SafeMuJoCoParallel(parts="4x2", episode_length=30)
    env.reset(seed=1)
    actions = dict.fromkeys(env.agents, np.full(2, 0.7, np.float32))
    for _ in range(5):
        env.step(actions)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for _ in range(5):
        seen, reward, *_ = env.step(actions)
        for other in copies:
            theirs, paid, *_ = other.step(actions)
            np.testing.assert_array_equal(theirs["agent_1"], seen["agent_1"])
            assert paid == reward


@pytest.mark.parametrize("parts", ROBOTS)
@pytest.mark.filterwarnings("ignore")
def test_live_against_gymnasium_robotics(parts, tmp_path, monkeypatch):
    robotics = pytest.importorskip("gymnasium_robotics.envs.multiagent_mujoco.mujoco_multi")
    import gymnasium

    monkeypatch.chdir(tmp_path)  # a warning of MuJoCo's goes to a log file
    env = SafeMuJoCo(parts)
    name = "Ant" if env.ant else "HalfCheetah"
    inner = gymnasium.make(f"{name}-v4")
    if env.ant and VERSION >= (3, 5):
        inner.unwrapped.model.geom_margin *= 0.5
    categories = [["qpos", "qvel"], ["qpos"]]
    theirs = robotics.parallel_env(name, parts, agent_obsk=1, local_categories=categories, gym_env=inner)
    theirs.reset(seed=3)
    data = inner.unwrapped.data
    ours = env.simulate(1, threads=1)
    rng = np.random.default_rng(1)
    for _ in range(40):
        place = data.xpos[1, :2][None].copy() if env.ant else None
        ours.restore(data.qpos[None], data.qvel[None], data.qacc_warmstart[None], place)
        action = rng.uniform(-1, 1, (env.n_agents, env.action_dim)).astype(np.float32)
        seen, reward, ended, _, info = theirs.step(dict(zip(theirs.possible_agents, action)))
        out = ours.step(action[None])
        told = np.stack([seen[a] for a in theirs.possible_agents])
        np.testing.assert_allclose(ours.state()[0, env.observed], told, rtol=0, atol=1e-5)
        assert out.reward[0] == pytest.approx(reward[theirs.possible_agents[0]], abs=1e-6)
        told = info[theirs.possible_agents[0]]
        assert out.info["speed"][0] == pytest.approx(
            np.hypot(told["x_velocity"], told.get("y_velocity", 0.0)), abs=1e-6
        )
        assert out.terminated[0] == ended[theirs.possible_agents[0]]
    theirs.close()


def test_actions_that_are_not_numbers_are_refused():
    sim = SafeMuJoCo("2x3").simulate(1, threads=1)
    sim.reset([0])
    with pytest.raises(UserError, match="actions that are not numbers"):
        sim.step(np.full((1, 2, 3), np.nan))
