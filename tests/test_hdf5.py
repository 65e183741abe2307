"""DSRL's, D4RL's and Minari's HDF5 files, written here by h5py and by Minari itself: read back number by number, shared
out among agents, and refused where they contradict themselves."""

from __future__ import annotations

import json
import random
import sys
import warnings

import gymnasium
import h5py
import numpy as np
import pytest

from ringfence.cli.app import main
from ringfence.datasets.importers import import_hdf5
from ringfence.errors import StoreError, UserError
from ringfence.logs.io.common import read_agents
from ringfence.logs.store import EpisodeStore
from ringfence.training import loop
from ringfence.utils import arrays
from tests import corpus

LENGTHS = (5, 3, 7, 2)
PAIR = {"a": {"observation": [0, 1, 2], "action": [0, 2]}, "b": {"observation": [3, 2], "action": [1]}}


def recorded(layout="DSRL", lengths=LENGTHS, dtype=np.float32, seed=0) -> dict[str, np.ndarray]:
    """Flat arrays of episodes, four observation entries and three of actions; every second episode terminates."""
    rng, rows = np.random.default_rng(seed), sum(lengths)
    walks = [np.cumsum(rng.normal(size=(n + 1, 4)), 0).astype(dtype) for n in lengths]
    last = np.cumsum(lengths) - 1
    flags = np.zeros((2, rows), bool)
    flags[np.arange(len(last)) % 2, last] = True
    data = {
        "observations": np.concatenate([w[:-1] for w in walks]),
        "next_observations": np.concatenate([w[1:] for w in walks]),
        "actions": rng.uniform(-1, 1, (rows, 3)).astype(dtype),
        "rewards": rng.normal(size=rows).astype(dtype),
        "costs": (rng.random(rows) < 0.4).astype(dtype),
        "terminals": flags[0],
        "timeouts": flags[1],
    }
    dropped = {"DSRL": (), "D4RL": ("costs",), "D4RL, short": ("costs", "next_observations")}[layout]
    return {name: x for name, x in data.items() if name not in dropped}


def write(path, data, **options):
    with h5py.File(path, "w") as f:
        for name, x in data.items():
            f.create_dataset(name, data=x, **options)
    return path


def as_rows(data) -> np.ndarray:
    """Observations as a store keeps them: every episode's, and the one it ended in."""
    ends = np.flatnonzero(data["terminals"] | data["timeouts"]) + 1
    parts = zip(np.split(data["observations"], ends[:-1]), data["next_observations"][ends - 1])
    return np.concatenate([np.concatenate([own, end[None]]) for own, end in parts])


# --- DSRL ---
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_dsrl_equals_what_was_written(tmp_path, dtype):
    data = recorded(dtype=dtype)
    file = write(tmp_path / "OfflinePoint-v0-20-4.hdf5", data, compression="gzip", chunks=True)
    store = import_hdf5(file, cost_limit=25)
    assert (store.episodes, store.steps, store.n_agents) == (4, 17, 1) and store.lengths.tolist() == list(LENGTHS)
    np.testing.assert_array_equal(store.observations[:, 0], as_rows(data).astype(np.float32))
    np.testing.assert_array_equal(store.actions[:, 0], data["actions"].astype(np.float32))
    np.testing.assert_array_equal(store.rewards[:, 0], data["rewards"].astype(np.float32))
    np.testing.assert_array_equal(store.costs, data["costs"].astype(np.float32))
    np.testing.assert_array_equal(store.terminated, data["terminals"])
    np.testing.assert_array_equal(store.truncated, data["timeouts"])
    assert store.card.task == "OfflinePoint-v0-20-4" and store.card.cost_limit == 25
    assert store.card.warnings == [] and "DSRL" in store.card.provenance
    assert (store.card.action_low, store.card.action_high) == (-1, 1)
    assert {x.dtype for x in (store.observations, store.actions, store.rewards, store.costs)} == {np.dtype("f4")}


def test_columns_of_one_number_may_be_flat_or_not(tmp_path):
    data = recorded()
    data |= {name: data[name][:, None] for name in ("rewards", "costs", "terminals", "timeouts")}
    data |= {name: data[name][:, 0] for name in ("observations", "next_observations", "actions")}  # as np.squeeze does
    store = import_hdf5(write(tmp_path / "d.hdf5", data))
    assert store.observations.shape == (21, 1, 1) and store.actions.shape == (17, 1, 1)
    np.testing.assert_array_equal(store.costs, data["costs"][:, 0])


def test_an_unfinished_end_is_dropped_and_terminals_win(tmp_path):
    data = recorded()
    data["terminals"][-1] = data["timeouts"][-1] = False  # the last episode, of two steps
    data["timeouts"][4] = True  # the first one's last step, a terminal
    data["observations"][-1] = np.nan  # of no account
    store = import_hdf5(write(tmp_path / "d.hdf5", data | {"terminals": data["terminals"].astype(np.float32)}))
    assert store.lengths.tolist() == [5, 3, 7] and store.terminated.nonzero()[0].tolist() == [4, 14]
    assert store.card.warnings == [
        "the last 2 rows are an unfinished episode and were dropped",
        "1 steps are marked as terminals and as timeouts, too, and count as terminals",
    ]


# --- D4RL ---
def test_d4rl_with_next_observations_has_no_costs(tmp_path):
    data = recorded("D4RL")
    with h5py.File(write(tmp_path / "walker2d_medium-v2.hdf5", data), "a") as f:
        f["infos/qpos"], f["infos/cost"], f["metadata/algorithm"] = np.zeros((17, 9)), np.ones(17), b"SAC"
        f["init_qpos"] = np.zeros(9)
    store = import_hdf5(tmp_path / "walker2d_medium-v2.hdf5")
    np.testing.assert_array_equal(store.observations[:, 0], as_rows(data))
    np.testing.assert_array_equal(store.terminated, data["terminals"])
    assert not store.costs.any() and store.card.task == "walker2d_medium-v2"
    notes = store.card.warnings
    assert notes[0] == "not read: init_qpos" and "infos/cost is not read" in notes[1] and "no costs are" in notes[2]


def test_d4rl_without_them_gives_up_the_last_steps(tmp_path):
    data = recorded("D4RL, short", (5, 1, 7, 2))
    store = import_hdf5(write(tmp_path / "d.hdf5", data))
    assert store.lengths.tolist() == [4, 6, 1]
    np.testing.assert_array_equal(store.observations[:, 0], np.delete(data["observations"], 5, 0))
    inside = np.delete(np.arange(15), [4, 5, 12, 14])
    np.testing.assert_array_equal(store.actions[:, 0], data["actions"][inside])
    np.testing.assert_array_equal(store.rewards[:, 0], data["rewards"][inside])
    assert not store.terminated.any() and store.truncated.sum() == 3
    assert store.card.warnings[0] == (
        "next_observations is missing, so the last step of every episode was given up, its observation being the end; "
        "where 2 terminations led is not known, so those episodes count as truncated; 1 episodes of one step are gone"
    )


def test_steps_that_do_not_lead_to_the_next_row_are_noted_or_refused(tmp_path):
    data = recorded(lengths=(40, 40))
    data["next_observations"][7, 1] += 0.5
    store = import_hdf5(write(tmp_path / "d.hdf5", data))
    assert "1 steps inside episodes, row 7 first" in store.card.warnings[0]
    np.testing.assert_array_equal(store.observations[8, 0], data["observations"][8])
    order = np.random.default_rng(0).permutation(80)
    shuffled = {name: x[order] for name, x in data.items()}
    shuffled["timeouts"][-1] = True
    with pytest.raises(StoreError, match=r"row \d of next_observations differs from the next row"):
        import_hdf5(write(tmp_path / "d.hdf5", shuffled))


# --- several agents ---
@pytest.mark.parametrize("how", ["dictionary", "text", "file", "ranges"])
def test_a_map_shares_the_columns_out(tmp_path, how):
    data, mine = recorded(), PAIR
    (tmp_path / "map.json").write_text(json.dumps(PAIR))
    if how == "ranges":
        mine = {"a": {"observation": range(3), "action": np.array([0, 2])}, "b": {"observation": (3, 2), "action": [1]}}
    given = {"text": json.dumps(PAIR), "file": tmp_path / "map.json"}.get(how, mine)
    store = import_hdf5(write(tmp_path / "d.hdf5", data), agents=given)
    rows, zero = as_rows(data), np.zeros((21, 1), np.float32)
    np.testing.assert_array_equal(store.observations[:, 0], rows[:, :3])
    np.testing.assert_array_equal(store.observations[:, 1], np.concatenate([rows[:, [3, 2]], zero], 1))
    np.testing.assert_array_equal(store.actions[:, 0], data["actions"][:, [0, 2]])
    np.testing.assert_array_equal(store.actions[:, 1], np.concatenate([data["actions"][:, [1]], zero[:17]], 1))
    np.testing.assert_array_equal(store.rewards, np.repeat(data["rewards"][:, None], 2, 1))
    assert store.costs.shape == (17,)
    assert store.card.agents == ["a", "b"] and store.card.extra["columns"] == PAIR
    assert store.card.action_sizes == [2, 1]
    assert store.card.warnings == [
        "agents of different sizes are filled up at the end: 'b' has 2 of 3 observation entries, 'b' has 1 of 2 "
        "action entries"
    ]


def test_what_is_filled_up_lies_within_the_bounds(tmp_path):
    data = recorded()
    data["actions"] = data["actions"] + 2.5
    store = import_hdf5(write(tmp_path / "d.hdf5", data), agents=PAIR, action_low=1.5, action_high=3.5)
    assert (store.actions[:, 1, 1] == 2.5).all() and (store.card.action_low, store.card.action_high) == (1.5, 3.5)


def one(**changes):
    return {"a": PAIR["a"] | changes, "b": PAIR["b"]}


@pytest.mark.parametrize(
    "given, said",
    [
        ("{", "agents is no map of columns"),
        ("[]", "Expected `object`"),
        ({}, "length >= 1"),
        (3, "agents is no map of columns"),
        ({"a": [0]}, "Expected `object`, got `array`"),
        ({"a": {"observation": [0]}}, "missing required field `action`"),
        (one(sees=[1]), "'a' has 'sees', which is neither"),
        (one(observation=[]), "length >= 1"),
        (one(observation=[0.5]), "Expected `int`"),
        (one(observation=[-1]), "`int` >= 0"),
        (one(observation=[4]), "Agent 'a' reads observation column 4, .* has 4, counted from 0"),
        (one(observation=[1, 1]), "Agent 'a' names observation column 1 twice"),
        (one(action=[0, 3]), "Agent 'a' reads action column 3"),
        (one(action=[0, 1, 2]), "Action column 1 belongs to 'a' and to 'b'; give it to one"),
        (one(action=[0]), "Action column 2 of .* is no agent's"),
        ("absent.json", "there is no file 'absent.json'"),
    ],
)
def test_maps_that_do_not_fit_are_refused(tmp_path, given, said):
    with pytest.raises(StoreError, match=said):
        import_hdf5(write(tmp_path / "d.hdf5", recorded()), agents=given)


def test_a_map_larger_than_any_is_not_read(tmp_path):
    (tmp_path / "map.json").write_text(" " * (2**20 + 1))
    with pytest.raises(StoreError, match="larger than 1 MiB"):
        read_agents(tmp_path / "map.json")


# --- bad flat files ---
def change(f, name, x):
    del f[name]
    f[name] = x


def nan_at(f, name, row):
    f[name][row, 1] = np.nan


BAD = {
    "shorter rewards": (lambda f: change(f, "rewards", np.zeros(16)), "16 rows of 'rewards' and 17 of 'actions'"),
    "wide costs": (lambda f: change(f, "costs", np.zeros((17, 2))), r"'costs' of shape \(17, 2\)"),
    "other width": (
        lambda f: change(f, "next_observations", np.zeros((17, 5))),
        r"next_observations \(17, 5\) and observations \(17, 4\)",
    ),
    "nan": (lambda f: nan_at(f, "observations", 6), "holds nan in row 6 of 'observations'"),
    "nan reached": (lambda f: nan_at(f, "next_observations", 3), "holds nan in row 3 of 'next_observations'"),
    "too large": (lambda f: change(f, "rewards", np.full(17, 1e200)), "holds 1e.200 in row 0 of 'rewards'"),
    "bounds": (lambda f: f["actions"].__setitem__((9, 2), 1.5), r"row 9 first outside \[-1, 1\]; pass action_low and"),
    "whole actions": (lambda f: change(f, "actions", np.zeros((17, 3), int)), "type int64, choices among few"),
    "words": (lambda f: change(f, "actions", np.array([b"x"] * 17)), r"'actions' of type \|S1; it must hold numbers"),
    "flags": (lambda f: change(f, "timeouts", np.arange(17)), "holds 2 in row 2 of 'timeouts'; it must be 0 or 1"),
    "nan flags": (lambda f: change(f, "terminals", np.full(17, np.nan)), "holds nan in row 0 of 'terminals'"),
    "no ends": (
        lambda f: (change(f, "terminals", np.zeros(17)), change(f, "timeouts", np.zeros(17))),
        "marks no end of an episode in its 17 rows",
    ),
    "negative costs": (lambda f: change(f, "costs", np.full(17, -1.0)), "d.hdf5': costs holds negative entries"),
    "nothing wide": (lambda f: change(f, "actions", np.zeros((17, 0))), r"'actions' of shape \(17, 0\)"),
    "a scalar": (lambda f: change(f, "rewards", 3.0), "holds no array in 'rewards'"),
    "a group": (lambda f: (f.__delitem__("rewards"), f.create_group("rewards")), "holds a group where the array"),
    "a link": (lambda f: change(f, "costs", h5py.SoftLink("/rewards")), "keeps 'costs' behind a link"),
    "elsewhere": (
        lambda f: change(f, "costs", h5py.ExternalLink("other.hdf5", "/costs")),
        "keeps 'costs' behind a link or in another file",
    ),
    "a bomb": (
        lambda f: (f.__delitem__("costs"), f.create_dataset("costs", (2**28,), "f8", chunks=(1000,))),
        "268435456 rows of 'costs'",
    ),
    "no timeouts": (lambda f: f.__delitem__("timeouts"), "lacks 'timeouts', which DSRL's layout has"),
    "costs alone": (lambda f: f.__delitem__("next_observations"), "lacks 'next_observations', which DSRL's"),
    "two layouts": (lambda f: f.create_group("episode_0"), "mixes layouts: 'actions' lies beside Minari's 'episode_0'"),
    "Minari's names": (lambda f: f.__setitem__("truncations", np.zeros(17)), "mixes layouts: Minari's 'truncations'"),
}


@pytest.mark.parametrize("what", BAD)
def test_flat_files_that_do_not_fit_are_refused(tmp_path, what):
    edit, said = BAD[what]
    with h5py.File(write(tmp_path / "d.hdf5", recorded()), "a") as f:
        edit(f)
    with pytest.raises(StoreError, match=said) as refused:
        import_hdf5(tmp_path / "d.hdf5")
    assert str(refused.value).isprintable() and "\n" not in str(refused.value)


def test_no_rows_long_enough_are_refused(tmp_path):
    with pytest.raises(StoreError, match="no episode of two steps"):
        import_hdf5(write(tmp_path / "d.hdf5", recorded("D4RL, short", (1, 1, 1))))


def test_other_files_are_refused(tmp_path, monkeypatch):
    with pytest.raises(StoreError, match="There is no file"):
        import_hdf5(tmp_path / "absent.hdf5")
    with pytest.raises(StoreError, match="holds no main_data.hdf5"):
        import_hdf5(tmp_path)
    (tmp_path / "text").write_text("no HDF5")
    with pytest.raises(StoreError, match="truncated, damaged or no HDF5"):
        import_hdf5(tmp_path / "text")
    for held, said in (
        ({}, "holds nothing, which fits neither"),
        ({"images": np.zeros(3)}, "'images', which fits neither"),
    ):
        with pytest.raises(StoreError, match=said):
            import_hdf5(write(tmp_path / "d.hdf5", held))
    good = write(tmp_path / "d.hdf5", recorded())
    with pytest.raises(StoreError, match="is an episode store already"):
        import_hdf5(import_hdf5(good).save(tmp_path / "store.h5"))
    with pytest.raises(StoreError, match="without slashes"):
        import_hdf5(good, task="a/b")
    with pytest.raises(StoreError, match="action_low=2 and action_high=1; the first must"):
        import_hdf5(good, action_low=2)
    whole = good.read_bytes()
    for size in (100, len(whole) // 2, len(whole) - 200):
        (tmp_path / "cut.hdf5").write_bytes(whole[:size])
        with pytest.raises(StoreError, match="is truncated, damaged or no HDF5"):
            import_hdf5(tmp_path / "cut.hdf5")
    monkeypatch.setattr(arrays, "_memory", lambda: 100.0)
    with pytest.raises(StoreError, match="GiB of arrays, this machine has"):
        import_hdf5(good)


def test_flipped_bits_are_refused_in_a_sentence_or_read(tmp_path):
    raw, refused = write(tmp_path / "d.hdf5", recorded(), compression="gzip").read_bytes(), 0
    for what, content in corpus.broken_bytes(raw, random.Random(2), 200):
        (tmp_path / "broken.hdf5").write_bytes(content)
        try:
            import_hdf5(tmp_path / "broken.hdf5")
        except UserError as error:
            assert str(error).isprintable() and str(error).endswith("."), what
            refused += 1
    assert refused > 60


def test_a_file_that_claims_a_thousand_times_its_size_is_not_unpacked(tmp_path):
    rows = 2_000_000
    with h5py.File(tmp_path / "bomb.hdf5", "w") as f:
        for name, width in {"observations": 30, "next_observations": 30, "actions": 3}.items():
            f.create_dataset(name, (rows, width), "f4", chunks=(rows, 1))  # never written: zeros
        for name in ("rewards", "costs", "terminals", "timeouts"):
            f.create_dataset(name, (rows,), "f4", chunks=(rows,))
    with pytest.raises(StoreError, match="claims 5[0-9]* MiB of arrays and holds 0.0"):
        import_hdf5(tmp_path / "bomb.hdf5")


def test_a_name_of_ours_does_not_tie_foreign_data_to_a_simulator(tmp_path):
    assert import_hdf5(write(tmp_path / "simple_spread-expert.hdf5", recorded())).card.task == (
        "simple_spread-expert-imported"
    )
    assert import_hdf5(write(tmp_path / "-x.hdf5", recorded())).card.task == "imported"


# --- Minari ---
class Drift(gymnasium.Env):
    """A point that drifts: it ends by itself beyond 3, and costs beyond 1."""

    def __init__(self, several: bool = False, low=-2.0, high=2.0):
        place = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        goal = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        self.observation_space = gymnasium.spaces.Dict({"place": place, "goal": goal}) if several else place
        self.action_space = gymnasium.spaces.Box(np.float32(low), np.float32(high), (2,), np.float32)
        self.several = several

    def _seen(self):
        seen = {"place": self.x.copy(), "goal": np.float32([self.x.sum()])} if self.several else self.x.copy()
        return seen, {"cost": float(np.abs(self.x).max() > 1), "depth": {"x": self.x.copy()}}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.normal(size=2)
        return self._seen()

    def step(self, action):
        self.x = self.x + action + self.np_random.normal(size=2) / 10
        seen, info = self._seen()
        return seen, float(-np.abs(self.x).sum()), bool(np.abs(self.x).max() > 3), False, info


@pytest.fixture
def collected(tmp_path, monkeypatch):
    """A function that lets Minari record episodes of at most ten steps: their data set's folder, and its episodes."""
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))

    def make(name="drift/walk-v0", record_infos=True, episodes=6, **options):
        env = gymnasium.wrappers.TimeLimit(Drift(**options), 10)
        collector = minari.DataCollector(env, record_infos=record_infos)
        env.action_space.seed(0)
        for k in range(episodes):
            collector.reset(seed=k)
            while True:
                _, _, terminated, truncated, _ = collector.step(env.action_space.sample())
                if terminated or truncated:
                    break
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about authors and links that a test has none of
            data = collector.create_dataset(name, algorithm_name="uniform")
        collector.close()
        return tmp_path / "minari" / name, list(data.iterate_episodes())

    return make


def test_minari_equals_what_its_library_reads(collected):
    folder, episodes = collected()
    for given in (folder, folder / "data", folder / "data" / "main_data.hdf5", "drift/walk-v0"):
        store = import_hdf5(given)
        assert store.lengths.tolist() == [len(e.rewards) for e in episodes]
        joined = {name: np.concatenate([getattr(e, name) for e in episodes]) for name in ("observations", "actions")}
        np.testing.assert_array_equal(store.observations[:, 0], joined["observations"].astype(np.float32))
        np.testing.assert_array_equal(store.actions[:, 0], joined["actions"])
        rewards = np.concatenate([e.rewards for e in episodes])
        np.testing.assert_array_equal(store.rewards[:, 0], rewards.astype(np.float32))
        np.testing.assert_array_equal(store.costs, np.concatenate([e.infos["cost"][1:] for e in episodes]))
        np.testing.assert_array_equal(store.terminated, np.concatenate([e.terminations for e in episodes]))
        np.testing.assert_array_equal(store.truncated, np.concatenate([e.truncations for e in episodes]))
    assert 0 < store.costs.mean() < 1 and 0 < store.terminated.sum() < 6
    beyond = np.abs(store.observations[:, 0]).max(1) > 1  # the cost is of the state that the step led to
    np.testing.assert_array_equal(store.costs, np.delete(beyond, np.cumsum([0, *(store.lengths + 1)[:-1]])))
    assert store.card.task == "drift-walk-v0" and store.card.warnings == []
    assert (store.card.action_low, store.card.action_high) == (-2, 2)
    assert store.card.observation_names is None and "Minari" in store.card.provenance


def test_minari_observations_in_groups_are_joined_by_name(collected):
    folder, episodes = collected(several=True, record_infos=False)
    store = import_hdf5(folder, agents={"only": {"observation": [2, 0, 1], "action": [1, 0]}})
    assert store.card.observation_names == ["place.1", "goal", "place.0"]
    seen = np.concatenate([np.column_stack([e.observations["place"], e.observations["goal"]]) for e in episodes])
    np.testing.assert_array_equal(store.observations[:, 0], seen[:, [1, 2, 0]].astype(np.float32))
    np.testing.assert_array_equal(store.actions[:, 0], np.concatenate([e.actions for e in episodes])[:, ::-1])
    assert not store.costs.any() and "no costs are recorded" in store.card.warnings[0]
    two = {"x": {"observation": [1], "action": [0]}, "y": {"observation": [2], "action": [1]}}
    assert import_hdf5(folder, agents=two).card.observation_names is None


def test_minari_buffers_of_eleven_parts_and_other_spaces(tmp_path, monkeypatch):
    """A tuple's parts keep their order, arrays of two axes are flattened, and entries have bounds of their own."""
    import minari
    from gymnasium.spaces import Box, Tuple
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    rng = np.random.default_rng(0)
    parts = [rng.normal(size=(5, 1)).astype(np.float32) for _ in range(11)] + [rng.normal(size=(5, 2, 3))]
    actions = rng.uniform(0, 1, (4, 2)).astype(np.float32)
    steps = dict(rewards=[1.0] * 4, terminations=[False] * 4, truncations=[False] * 4, infos={"cost": [0.0, 1, 0, 2]})
    episode = EpisodeBuffer(observations=tuple(list(p) for p in parts), actions=list(actions), **steps)
    spaces = {
        "observation_space": Tuple([Box(-9, 9, (1,))] * 11 + [Box(-9, 9, (2, 3), np.float64)]),
        "action_space": Box(np.float32([0, -1]), np.float32([1, 3])),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers("parts-v3", [episode], **spaces)
    store = import_hdf5("parts-v3")
    np.testing.assert_array_equal(store.observations[:, 0, :11], np.concatenate(parts[:11], 1))
    np.testing.assert_array_equal(store.observations[:, 0, 11:], parts[11].reshape(5, 6).astype(np.float32))
    assert store.costs.tolist() == [0, 1, 0, 2]  # one of every step, none of the reset
    assert store.card.observation_names[9:13] == ["_index_9", "_index_10", "_index_11.0", "_index_11.1"]
    assert (store.card.action_low, store.card.action_high) == ([0, -1], [1, 3])
    assert store.truncated.tolist() == [False, False, False, True]
    assert [note.split(" and ")[0] for note in store.card.warnings] == [
        "1 episodes end without a mark",
    ]


def space(folder, changes):
    file = folder / "metadata.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


WORSE = {
    "lacks rewards": (lambda f, d: f.__delitem__("episode_3/rewards"), "lacks 'episode_3/rewards'"),
    "terminals": (lambda f, d: f.__setitem__("episode_2/terminals", [0]), "'episode_2' holds D4RL's 'terminals'"),
    "flat beside": (lambda f, d: f.__setitem__("rewards", [0.0]), "'rewards' lies beside Minari's 'episode_0'"),
    "no last row": (lambda f, d: f["episode_1/observations"].resize(4, 0), "4 rows in 'episode_1/observations', its"),
    "short costs": (lambda f, d: f["episode_1/infos/cost"].resize(1, 0), "1 rows in 'episode_1/infos/cost'"),
    "some costs": (lambda f, d: f.__delitem__("episode_4/infos/cost"), "'episode_4' with other infos/cost than"),
    "nan": (lambda f, d: f["episode_5/rewards"].__setitem__(1, np.nan), "nan in row 1 of 'episode_5/rewards'"),
    "early end": (
        lambda f, d: f["episode_0/truncations"].__setitem__(0, True),
        "marks step 0 of 'episode_0' as an end",
    ),
    "beyond": (lambda f, d: f["episode_2/actions"].__setitem__((0, 0), 9), r"row 0 first outside \[-2, 2\]"),
    "elsewhere": (
        lambda f, d: change(f, "episode_1", h5py.ExternalLink("additional_data_0.hdf5", "/episode_1")),
        "keeps 'episode_1' behind a link or in another file",
    ),
    "a link below": (
        lambda f, d: change(f["episode_1"], "infos", h5py.SoftLink("/episode_0/infos")),
        "keeps 'episode_1/infos' behind a link",
    ),
    "no group": (lambda f, d: change(f, "episode_1", [1.0]), "holds an array where the group 'episode_1' belongs"),
    "a ring": (
        lambda f, d: (f.__delitem__("episode_0/observations"), f["episode_0"].create_group("observations")).__getitem__(
            1
        ).__setitem__("again", f["episode_0/observations"]),
        "too deeply",
    ),
    "words": (
        lambda f, d: change(f["episode_0"], "observations", ["a"] * 9),
        "'episode_0/observations' of type object",
    ),
    "count": (lambda f, d: space(d, {"total_episodes": 7}), "holds 6 episodes, its metadata tells of 7"),
    "choices": (lambda f, d: space(d, {"action_space": '{"type": "Discrete", "n": 3}'}), "Discrete actions, choices"),
    "no space": (lambda f, d: space(d, {"action_space": '{"type": "Box"}'}), "action space that cannot be read"),
    "no JSON": (lambda f, d: (d / "metadata.json").write_text("{"), "metadata.json' is truncated, damaged"),
}


@pytest.mark.parametrize("what", WORSE)
def test_minari_files_that_do_not_fit_are_refused(collected, what):
    folder, _ = collected()
    edit, said = WORSE[what]
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as f:
        edit(f, folder / "data")
    with pytest.raises(StoreError, match=said) as refused:
        import_hdf5(folder)
    assert str(refused.value).isprintable()


def test_minari_without_metadata_or_with_bounds_of_the_callers(collected):
    folder, _ = collected()
    file = folder / "data" / "main_data.hdf5"
    space(folder / "data", {"action_space": '{"type": "Box"}'})
    assert import_hdf5(file, action_low=-3, action_high=4).card.action_high == 4
    (folder / "data" / "metadata.json").unlink()
    with pytest.raises(StoreError, match=r"outside \[-1, 1\]; pass action_low and action_high"):
        import_hdf5(file)
    assert import_hdf5(file, action_low=-2, action_high=2).card.task == "main_data"


def test_minari_data_that_is_not_here_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    with pytest.raises(StoreError, match="no such Minari data set in .*door/human-v2'; download it with Minari"):
        import_hdf5("D4RL/door/human-v2")
    monkeypatch.setitem(sys.modules, "minari.storage", None)
    with pytest.raises(StoreError, match=r"pip install 'ringfence\[minari\]'"):
        import_hdf5("D4RL/door/human-v2")


# --- the command line, and training ---
def test_an_imported_store_is_described_and_trained(tmp_path, capsys):
    file, out = write(tmp_path / "circle.hdf5", recorded(lengths=(20,) * 6)), tmp_path / "mine.h5"
    arguments = ["data", "import-hdf5", str(file), "--out", str(out), "--agents", json.dumps(PAIR)]
    main([*arguments, "--cost-limit", "5", "--task", "circle"])
    said = capsys.readouterr().out
    assert "6 episodes, 120 steps" in said and "'b' has 2 of 3 observation entries" in said
    main(["data", "info", str(out)])
    said = capsys.readouterr().out
    assert "3, 2 per agent" in said and "DSRL" in said and "note agents of different sizes" in said
    store = EpisodeStore.load(out)
    assert store.card.cost_limit == 5 and store.card.extra["columns"] == PAIR
    run = loop.train("bc", store, out=tmp_path / "runs", changes={"num_updates": 4, "width": 16}, quiet=True)[0]
    assert run.metrics[-1]["step"] == 4 and np.isfinite(list(run.metrics[-1].values())).all()


def test_refusals_of_the_command_line(tmp_path, capsys):
    data = recorded()
    data["actions"] *= 3
    file, out = write(tmp_path / "d.hdf5", data), tmp_path / "mine.h5"
    for arguments, said in (
        ([str(file), "--out", str(out)], "pass action_low and action_high (--action-low, --action-high)"),
        ([str(file), "--out", str(file)], "would be overwritten by its own import"),
    ):
        with pytest.raises(SystemExit):
            main(["data", "import-hdf5", *arguments])
        assert said in capsys.readouterr().err and not out.exists()
    main(["data", "import-hdf5", str(file), "--out", str(out), "--action-low", "-3", "--action-high", "3"])
    np.testing.assert_array_equal(EpisodeStore.load(out).actions[:, 0], data["actions"])


def test_a_device_is_no_file():
    with pytest.raises(StoreError, match="is no regular file"):
        import_hdf5("/dev/null")
