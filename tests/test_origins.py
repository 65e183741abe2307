"""Logs far from 0, such as coordinates of a map in metres: they are moved, and what is given at run time is, too."""

from __future__ import annotations

import dataclasses
import json
import zipfile

import jax
import msgspec
import numpy as np
import pytest

import ringfence
from ringfence.deploy import export as exporting
from ringfence.errors import StoreError, UserError
from ringfence.logs.io.observe import observe
from ringfence.logs.store import EpisodeStore
from ringfence.problem.constraints import Separation
from ringfence.training import loop
from ringfence.types import act_with
from tests.quick import QUICK_WORLD

EAST, NORTH = 500_250.0, 4_649_776.0  # UTM, in metres
NAMES = ["own.vx", "own.vy", "own.x", "own.y", "other0.dx", "other0.dy", "other0.dvx", "other0.dvy"]


def table(east: float = EAST, north: float = NORTH) -> dict[str, np.ndarray]:
    """Two vehicles on circles that meet, in rows of agent and time; all numbers are sums of powers of two."""
    rows = []
    for episode in range(12):
        for k in range(30):
            for agent in (0, 1):
                angle = (0.2 + 0.15 * agent) * k + np.pi * agent + 0.3 * episode
                x, y = np.round(2**10 * np.array([2 * np.cos(angle), (1 + agent) * np.sin(angle)])) / 2**10
                rows.append((episode, agent, k * 0.125, east + x, north + y))
    return dict(zip(("episode", "agent", "t", "x", "y"), np.array(rows).T))


def imported(columns: dict[str, np.ndarray], **options) -> EpisodeStore:
    schema = {"time": "t", "agent": "agent", "episode": "episode", "state": ["x", "y"]}
    return EpisodeStore.from_table(columns, **schema, danger=Separation(1.5, 1.0), **options)


@pytest.fixture(scope="module")
def far():
    return imported(table())


@pytest.fixture(scope="module")
def near():
    return imported(table(0.0, 0.0))


def raw(store: EpisodeStore) -> np.ndarray:
    return store.card.origins.measured(store.observations, None)[0]


def test_a_table_is_moved_and_says_so(far, near):
    origins = far.card.observation_origins
    assert far.card.observation_names == NAMES and [d for d, x in enumerate(origins) if x] == [2, 3]
    assert abs(origins[2] - EAST) <= 10 and abs(origins[3] - NORTH) <= 10
    others = [0, 1, 4, 5, 6, 7]
    np.testing.assert_array_equal(far.observations[..., others], near.observations[..., others])
    np.testing.assert_allclose(raw(far)[..., 2:4], near.observations[..., 2:4] + np.float64([EAST, NORTH]), atol=1e-6)
    assert any("is subtracted" in warning and "own.x" in warning for warning in far.card.warnings)
    assert near.card.observation_origins is None and "observation_origins" not in near.card.to_dict()


def test_origins_stay_with_a_store(far, tmp_path):
    again = EpisodeStore.load(far.save(tmp_path / "far.h5"))
    assert again.card.origins == far.card.origins and again.select(np.arange(12) < 6).card.origins == far.card.origins
    with pytest.raises(StoreError, match="moved by other origins"):
        far.followed_by(dataclasses.replace(far, card=far.card.updated(observation_origins=None)))
    with pytest.raises(StoreError, match="observation_origins='x'; it must be a list of numbers"):
        far.card.updated(observation_origins="x")
    with pytest.raises(StoreError, match="The card has 1 observation_origins, the data has 8"):
        dataclasses.replace(far, card=far.card.updated(observation_origins=[1.0]))


def test_logs_of_single_precision_are_left_as_they_are():
    """What was lost is not found again by moving it."""
    columns = table()
    columns |= {axis: columns[axis].astype(np.float32) for axis in "xy"}
    store = imported(columns)
    assert store.card.observation_origins is None and abs(store.observations[..., 3]).min() > 4e6
    assert any("write the column in double precision" in warning for warning in store.card.warnings)


def test_velocities_and_flags_are_not_moved():
    """They mean what they say: a speed limit reads 30 m/s, and a replay who is seen."""
    generator = np.random.default_rng(0)
    shape = (5, 21, 1)
    names = ["own.x", "own.vx", "other0.dx", "other0.seen", "speed", "beacon"]
    fine = 1e-5 * np.cumsum(generator.normal(size=(*shape, len(names))), 1)
    fine[..., 3] = 0.0
    seen = np.array([NORTH, 30.0, 1.0, 1.0, 30.0, NORTH]) + fine
    arrays = np.zeros((5, 20, 1, 1)), np.zeros((5, 20)), np.zeros((5, 20))
    store = EpisodeStore.from_episodes(seen, *arrays, card={"observation_names": names})
    assert [bool(x) for x in store.card.observation_origins] == [True, False, False, False, False, True]
    np.testing.assert_allclose(store.observations[..., 1:5].mean((0, 1)), [30.0, 1.0, 1.0, 30.0], atol=1e-3)
    drifting = np.full((*shape, 2), NORTH) * (1 + 1e-16 * generator.normal(size=(*shape, 2)))
    drifting[..., 1] = 1e-3 * np.arange(21)[:, None]
    still = EpisodeStore.from_episodes(drifting, *arrays)
    assert still.card.observation_origins is None, "rounding is no motion"


def test_entries_that_share_a_place_share_an_origin():
    """Of arrays, too, and of a state beside observations; what stands still there moves along."""
    generator = np.random.default_rng(0)
    place = NORTH + np.cumsum(0.01 * generator.normal(size=(5, 21, 2)), 1)
    goal = np.full((5, 21), NORTH + 40.0)
    state = np.stack([place[..., 0], place[..., 1], goal, goal - place[..., 0]], -1)
    seen = np.stack([place, place[..., ::-1] - place], -1)
    arrays = np.zeros((5, 20, 2, 1)), np.zeros((5, 20)), np.zeros((5, 20))
    store = EpisodeStore.from_episodes(seen, *arrays, state=state)
    origin = store.card.observation_origins[0]
    assert store.card.observation_origins == [origin, 0.0] and store.card.state_origins == [origin, origin, origin, 0.0]
    assert np.abs(store.state).max() < 200
    np.testing.assert_allclose(store.state[:, 2] - store.state[:, 0], store.state[:, 3], atol=1e-4)
    flat = EpisodeStore.from_steps(
        seen[:, :-1].reshape(100, 2, 2), np.zeros((100, 2, 1)), np.zeros(100), state=state[:, :-1].reshape(100, 4),
        episode_ends=np.arange(1, 6) * 20, final_observations=seen[:, -1], final_state=state[:, -1],
    )  # fmt: skip
    assert flat.content == store.content and flat.card == store.card
    assert EpisodeStore.from_episodes(seen.astype(np.float32), *arrays).card.observation_origins is None


@pytest.fixture(scope="module")
def world(far):
    return ringfence.fit(far, **QUICK_WORLD)


@pytest.fixture(scope="module")
def run(far, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    return loop.train("bc", far, changes={"num_updates": 4, "width": 16}, quiet=True, out=out)[0]


def shifted(world):
    """The same World, as one of logs that were not moved."""
    data = msgspec.structs.replace(world.card.data, observation_origins=None)
    card = msgspec.structs.replace(world.card, data=data)
    return dataclasses.replace(world, card=card)


def test_a_guard_moves_what_it_is_given(far, world):
    """And asks the function with what was measured."""
    asked = []

    def function(observations, state):
        asked.append(observations)
        return np.zeros((2, 2))

    guarded = ringfence.guard(function, world, anyway=True)
    plain = ringfence.guard(lambda observations, state: np.zeros((2, 2)), shifted(world), anyway=True)
    measured = raw(far)
    for t in range(3):
        action = guarded.act(measured[t])
        np.testing.assert_array_equal(action, plain.act(far.observations[t]))
        np.testing.assert_allclose(asked[-1], measured[t], atol=1e-6)


def test_a_run_and_its_files_move_what_they_are_given(far, world, run, tmp_path):
    options = {"guard": "shield", "world": world, "horizon": 1, "correction_steps": 2, "anyway": True}
    controller = ringfence.Controller(run, **options)
    policy = ringfence.load(run, **options)[1]
    measured = raw(far)
    actions = [controller.act(measured[t]) for t in range(3)]
    step = jax.jit(act_with)
    carry = policy.initial_state(1)
    for t in range(3):
        carry, decided = step(policy, carry, far.observations[t][None], None, jax.random.key(0))
        np.testing.assert_allclose(actions[t], decided.action[0], atol=1e-6)
    file = exporting.export(run, tmp_path / "far.stablehlo", "stablehlo", **options)
    _plays(*_of_stablehlo(file), measured, actions)
    pytest.importorskip("jax2onnx")
    _plays(*_of_onnx(exporting.export(run, tmp_path / "far.onnx", **options)), measured, actions)


def _plays(call, metadata, measured, actions):
    entry = next(x for x in metadata["inputs"] if x["name"] == "observations")
    assert entry["dtype"] == "float64" and len(metadata["origins"]["observations"]) == len(NAMES)
    memory = {x["name"]: metadata["initial"].get(x["name"], 0.0) for x in metadata["inputs"]}
    shapes = {x["name"]: (x["shape"], x["dtype"]) for x in metadata["inputs"]}
    for t, action in enumerate(actions):
        given = {name: np.full(*shapes[name][:1], value, shapes[name][1]) for name, value in memory.items()}
        out = call(given | {"observations": measured[t]})
        np.testing.assert_allclose(out["action"], action, atol=1e-5)


def _of_stablehlo(file):
    from ringfence.utils.precision import float64

    with zipfile.ZipFile(file) as packed:
        metadata = json.loads(packed.read("metadata.json"))
        program = jax.export.deserialize(bytearray(packed.read("policy.jax")))

    def call(given):
        with float64():
            return dict(zip([x["name"] for x in metadata["outputs"]], program.call(*given.values())))

    return call, metadata


def _of_onnx(file):
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    metadata = json.loads(session.get_modelmeta().custom_metadata_map["ringfence"])
    names = [x["name"] for x in metadata["outputs"]]
    return lambda given: dict(zip(names, session.run(names, given))), metadata


def test_a_world_of_other_origins_is_refused(run, world):
    with pytest.raises(UserError, match="moved by other origins"):
        ringfence.Controller(run, guard="shield", world=shifted(world), anyway=True)


def test_a_simulator_shows_what_it_measures(far, world, run):
    """`play` moves what simulators show; a function under guard sees it as it is."""
    shown = raw(far)
    asked = []

    class Env:
        possible_agents = ["a", "b"]

        def reset(self, seed=None, options=None):
            self.t = 0
            return dict(zip("ab", shown[0])), {}

        def step(self, actions):
            self.t += 1
            over = {agent: self.t == 3 for agent in "ab"}
            costs = {agent: {"cost": 0.0} for agent in "ab"}
            return dict(zip("ab", shown[self.t])), dict.fromkeys("ab", 1.0), over, dict.fromkeys("ab", False), costs

    def function(observations, state):
        asked.append(observations)
        return np.zeros((2, 2))

    ringfence.play(ringfence.guard(function, world, anyway=True), Env, episodes=1)
    np.testing.assert_allclose(asked, shown[:3], atol=1e-6)
    assert ringfence.play(run, Env, episodes=1)["return_mean"] == pytest.approx(3.0)


def test_observe_tells_what_was_measured(far):
    columns = dict(zip(("vx", "vy", "x", "y"), raw(far)[0, :, :4].T))
    seen = observe(far.card, columns)
    assert seen.dtype == np.float64
    np.testing.assert_allclose(seen, raw(far)[0], atol=1e-6)
