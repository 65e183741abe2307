"""Bounds of actions by entry: nothing that acts, checks or writes them takes one entry's for another's."""

from __future__ import annotations

import dataclasses
import json
import zipfile

import numpy as np
import pytest
from quick import QUICK_WORLD

import ringfence
from ringfence.deploy.export import export
from ringfence.errors import StoreError, UserError
from ringfence.evaluation.play import play
from ringfence.logs.store import EpisodeStore
from ringfence.problem import normalise
from ringfence.problem.bounds import Bounds, stored
from ringfence.training import loop, worlds
from ringfence.types import Spec

LOW = [0.0, -0.57]
HIGH = [0.086, 0.57]
AGENTS = ["a", "b"]


class Slow:
    """Two bodies that go forward and turn, in a Box with bounds of each entry."""

    def __init__(self):
        gymnasium = pytest.importorskip("gymnasium")
        self.possible_agents = list(AGENTS)
        self.box = gymnasium.spaces.Box(np.float32(LOW), np.float32(HIGH))
        self.outside = 0

    def action_space(self, agent):
        return self.box

    def reset(self, seed=None):
        self.agents = list(AGENTS)
        self.t = 0
        self.x = np.random.default_rng(seed).normal(size=(2, 2))
        return self.shown(), {agent: {} for agent in AGENTS}

    def shown(self):
        return dict(zip(AGENTS, np.float32(self.x)))

    def step(self, actions):
        self.outside += sum(not self.box.contains(np.float32(action)) for action in actions.values())
        self.x = self.x + np.stack([actions[agent] for agent in AGENTS])
        self.t += 1
        over = dict.fromkeys(AGENTS, self.t == 8)
        if self.t == 8:
            self.agents = []
        infos = {agent: {"cost": float(self.x[i, 1] > 1)} for i, agent in enumerate(AGENTS)}
        return self.shown(), dict.fromkeys(AGENTS, 1.0), dict.fromkeys(AGENTS, False), over, infos


@pytest.fixture(scope="module")
def logs() -> EpisodeStore:
    return ringfence.collect(Slow, episodes=20)


@pytest.fixture(scope="module")
def world(logs):
    return worlds.fit(logs, **QUICK_WORLD)


@pytest.fixture(scope="module")
def run(logs, tmp_path_factory):
    changes = {"num_updates": 4, "width": 8, "view": "pruned"}
    return loop.train("bc", logs, out=tmp_path_factory.mktemp("slow"), changes=changes, quiet=True)[0]


def inside(actions) -> bool:
    return bool((np.float32(LOW) <= actions).all() and (actions <= np.float32(HIGH)).all())


def test_a_random_recording_stays_in_the_action_space(logs):
    """110 of 120 actions left it: all entries had the widest bounds."""
    assert inside(logs.actions) and np.ptp(logs.actions[..., 0]) > 0.07
    np.testing.assert_allclose([logs.card.action_low, logs.card.action_high], [LOW, HIGH], atol=1e-7)
    with pytest.raises(UserError, match=r"from \[0, -0.57\] to \[0.086, 0.57\]; clip"):
        ringfence.collect(Slow, lambda observations, state: np.full((2, 2), 0.5), episodes=1)


def test_agents_may_have_bounds_of_their_own():
    class Unlike(Slow):
        def action_space(self, agent):
            box = type(self.box)
            return self.box if agent == "a" else box(np.float32([-1, -2]), np.float32([1, 2]))

    store = ringfence.collect(Unlike, episodes=3)
    assert np.shape(store.card.action_low) == (2, 2) and inside(store.actions[:, 0])
    assert np.abs(store.actions[:, 1]).max() > 1
    with pytest.raises(StoreError, match="homogeneous agents have the same ones"):
        dataclasses.replace(store, card=store.card.updated(homogeneous=True))


@pytest.mark.parametrize("planner", ["bc", "mpc"])
def test_runs_act_within_each_entry(logs, world, run, planner, tmp_path):
    if planner != "bc":
        (run,) = loop.train(planner, logs, out=tmp_path, quiet=True)
    options = {"guard": "full" if planner == "mpc" else "shield", "world": world, "anyway": True}
    policy = ringfence.Controller(run, **options)
    actions = np.stack([policy.act(seen) for seen in 100 * logs.observations[:20]])
    assert inside(actions)
    env = Slow()
    play(run, lambda: env, episodes=2, num_envs=1, **options)
    assert not env.outside


def test_a_guard_whose_world_has_other_bounds_acts_as_the_run_means(logs, run):
    """Tables are bounded by their own largest action, so a World of other logs made 0.2 m/s of 0.1 m/s in silence."""
    wide = dataclasses.replace(logs, card=logs.card.updated(action_low=[-0.3, -2.0], action_high=[0.3, 2.0]))
    other = worlds.fit(wide, **QUICK_WORLD)
    alone = ringfence.Controller(run)
    beside = ringfence.Controller(run, guard="select", world=other, anyway=True, horizon=2)
    for seen in logs.observations[:5]:
        np.testing.assert_allclose(beside.act(seen), alone.act(seen), atol=1e-6)


def test_a_callable_under_guard_acts_within_each_entry(logs, world):
    policy = ringfence.guard(lambda observations, state: np.full((2, 2), 9.0), world, guard="select", anyway=True)
    np.testing.assert_allclose(policy.act(logs.observations[0]), [HIGH, HIGH], atol=1e-7)


def test_reference_policies_act_within_each_entry(logs):
    import jax

    from ringfence.proposals.base import Constant

    spec = Spec("slow", 2, 2, ("x",), (0.2, -0.57), (0.4, 0.57), 8)
    seen = np.zeros((50, 2, 2))
    _, drawn = Constant(spec, random=True).act({}, seen, None, jax.random.key(0))
    assert drawn.action[..., 0].min() >= 0.2 and drawn.action[..., 0].max() <= 0.4 and drawn.action[..., 1].min() < -0.4
    _, still = Constant(spec).act({}, seen, None, jax.random.key(0))
    np.testing.assert_allclose(still.action[0, 0], [0.2, 0.0])


def test_a_narrower_simulator_is_refused(run):
    class Narrower(Slow):
        def action_space(self, agent):
            return type(self.box)(np.float32([0, -0.57]), np.float32([0.05, 0.57]))

    with pytest.raises(UserError, match=r"is from \[0, -0.57\] to \[0.05, 0.57\], the policy acts from \[0, -0.57\]"):
        play(run, Narrower, episodes=1)


def test_an_intervention_is_counted_in_each_entrys_own_range(world):
    """A twentieth of the range is little of a turn and nearly all of a speed."""
    from ringfence.evaluation.ope_responses import CHANGED

    bounds = (world.spec.action_low, world.spec.action_high)
    difference = normalise.to_unit(np.float32([0.02, 0.3]), *bounds) - normalise.to_unit(
        np.float32([0.01, 0.3]), *bounds
    )
    assert np.abs(difference).max() > CHANGED


def test_an_export_tells_bounds_by_entry(run, tmp_path):
    file = export(run, tmp_path / "slow.zip", format="stablehlo")
    metadata = json.loads(zipfile.ZipFile(file).read("metadata.json"))
    np.testing.assert_allclose([metadata["action_low"], metadata["action_high"]], [LOW, HIGH], atol=1e-7)


def test_the_same_actions_in_other_bounds_are_other_logs(logs, world):
    """A World was taken from the cache whatever the bounds."""
    wider = dataclasses.replace(logs, card=logs.card.updated(action_low=-1.0, action_high=1.0))
    found = worlds.fit(wider, **QUICK_WORLD)
    assert (found.spec.action_low, found.spec.action_high) == (-1.0, 1.0) != world.spec.action_low
    widest = dataclasses.replace(logs, card=logs.card.updated(action_low=-2.0, action_high=2.0))
    assert worlds.fit(widest, **QUICK_WORLD).spec.action_low == -2.0


def test_a_store_keeps_its_bounds(logs, tmp_path):
    loaded = EpisodeStore.load(logs.save(tmp_path / "slow.h5"))
    assert loaded.card == logs.card and loaded.card.bounds == logs.card.bounds
    same = dataclasses.replace(logs, card=logs.card.updated(action_low=[-1, -1], action_high=[[1, 1], [1, 1.0]]))
    assert same.card.to_dict()["action_low"] == -1.0 and same.card.to_dict()["action_high"] == 1.0
    mixed = dataclasses.replace(logs, card=logs.card.updated(action_low=-1))
    assert mixed.card.action_low == -1 and np.shape(mixed.card.action_high) == (2,)


@pytest.mark.parametrize(
    "low, high, message",
    [
        ([0, 1], [1, 0], r"action_low=\[0, 1\] and action_high=\[1, 0\]; the first must be the smaller one in every"),
        ([0, float("nan")], 1, "must be one number, a list of each entry's, .* all of them finite"),
        ([-1e300, 0], 1, "all of them finite"),
        ([[[-1]]], 1, "must be one number, a list of each entry's"),
        ([[-1, -1], [-1]], 1, "must be one number, a list of each entry's"),
        (["a", "b"], 1, "must be one number, a list of each entry's"),
        ([], 1, "must be one number, a list of each entry's"),
        (True, 1, "must be one number, a list of each entry's"),
        ([-1, -2, -3], 1, "2 agents with 2 action entries each; give one number"),
        ([-1, -2], [1, 2, 3], r"of shape \(2,\) and action_high of shape \(3,\)"),
        ([0.0, -0.57], [0.05, 0.57], r"outside \[0, 0.05\]; rescale"),
    ],
)
def test_bounds_that_are_none_are_refused(logs, low, high, message):
    with pytest.raises(StoreError, match=message):
        dataclasses.replace(logs, card=logs.card.updated(action_low=low, action_high=high))


def test_specs_know_their_bounds_by_entry():
    spec = Spec("slow", 2, 2, ("x",), (0.0, -1.0), ((1.0, 2.0), (3.0, 4.0)), 8)
    assert Spec.of(json.loads(json.dumps(spec.to_dict()))) == spec and hash(spec)
    wrong = (((0.0, 3.0), (1.0, 2.0)), ((0.0, 0.0, 0.0), 1.0), ((0.0, -1.0), float("nan")), (((0.0, 0.0), (0.0,)), 1.0))
    for low, high in (*wrong, (("a", "b"), 1.0), ((), 1.0)):
        with pytest.raises(UserError, match="bounds"):
            dataclasses.replace(spec, action_low=low, action_high=high)


def test_units_are_those_of_each_entry():
    bounds = Bounds.of(LOW, HIGH)
    np.testing.assert_allclose(normalise.to_unit(np.float32([HIGH, LOW]), *bounds), [[1, 1], [-1, -1]], atol=1e-6)
    np.testing.assert_allclose(normalise.from_unit(np.float32([0.0, 0.5]), *bounds), [0.043, 0.285], atol=1e-6)
    g = np.random.default_rng(0)
    for _ in range(50):  # three quarters of such boxes were left by the last bit
        low, high = np.sort(g.normal(size=(2, 3)).astype(np.float32), 0)
        ends = normalise.from_unit(np.float32([[1, 1, 1], [-1, -1, -1]]), *Bounds.of(low, high))
        assert (ends <= high).all() and (ends >= low).all()
        np.testing.assert_allclose(ends, [high, low], atol=1e-6)
    assert stored(bounds.low) == LOW and str(bounds) == "[0, -0.57] to [0.086, 0.57]"


def test_commands_of_a_table_are_bounded_by_their_own_kind():
    """A robot that drives at 0.2 m/s and turns at 2.8 rad/s was bounded by 2.8 in both; it never drives backwards."""
    rows = [(0.1 * t, agent, 0.02 * t + agent, 0.0, 0.2, 2.8 * (-1) ** t) for agent in (0, 1) for t in range(30)]
    table = {name: np.array(column) for name, column in zip(("t", "id", "x", "y", "v", "w"), zip(*rows))}
    state = ["x", "y"]
    store = EpisodeStore.from_table(table, time="t", agent="id", state=state, action=["v", "w"])
    np.testing.assert_allclose(store.card.action_high, [0.2, 2.8])
    np.testing.assert_allclose(store.card.action_low, [0, -2.8])


def test_files_are_imported_with_bounds_of_each_entry(tmp_path):
    import h5py

    from ringfence.cli import app
    from ringfence.datasets.importers import import_hdf5

    file = tmp_path / "flat.hdf5"
    rng = np.random.default_rng(0)
    ends = np.arange(40) % 10 == 9
    with h5py.File(file, "w") as f:
        f["observations"] = rng.normal(size=(40, 3))
        f["actions"] = rng.uniform([0, -0.57, -2], [0.086, 0.57, 2], (40, 3))
        f["rewards"] = np.zeros(40)
        f["terminals"] = np.zeros(40)
        f["timeouts"] = ends * 1.0
    low, high = [0, -0.57, -2], [0.086, 0.57, 2]
    agents = {"a": {"observation": [0], "action": [0, 1]}, "b": {"observation": [1, 2], "action": [2]}}
    store = import_hdf5(file, agents=agents, action_low=low, action_high=high)
    assert store.card.action_low == [[0, -0.57], [-2, -0.57]] and store.card.action_sizes == [2, 1]
    np.testing.assert_allclose(store.actions[:, 1, 1], 0.0)
    told = ["--action-low", *map(str, low), "--action-high", *map(str, high)]
    app.main(["data", "import-hdf5", str(file), "--out", str(tmp_path / "flat.h5"), *told])
    assert EpisodeStore.load(tmp_path / "flat.h5").card.action_low == low
    with pytest.raises(StoreError, match="the file has 3 action entries in a row"):
        import_hdf5(file, action_low=[0, -1], action_high=3)
    with pytest.raises(StoreError, match=r"first outside \[0, 0.05\]"):
        import_hdf5(file, action_low=low, action_high=[0.05, 0.57, 2])
