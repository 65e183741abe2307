"""Whose row is whose: names of agents in natural order, from logs to run time."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

import ringfence
from ringfence import Controller
from ringfence import world as world_files
from ringfence.deploy import export as exporting
from ringfence.envs.episode import Episode, Shape
from ringfence.errors import NoSafeAction, StoreError, UserError
from ringfence.evaluation.replay import check_view
from ringfence.loading.resolve import resolve
from ringfence.loading.spec import PolicySpec
from ringfence.logs.io.observe import observe
from ringfence.logs.store import EpisodeStore
from ringfence.training import loop, worlds
from ringfence.utils.text import natural, numbered
from tests.quick import QUICK_WORLD

COUNT = 12
ROBOTS = [f"robot_{i + 1}" for i in range(COUNT)]
NAMES = dict(time="t", agent="id", state=["x", "y"], cost="hit")


def table(names=ROBOTS, steps: int = 30) -> dict[str, np.ndarray]:
    """Robot i drives along x = i."""
    t = np.arange(steps) * 0.1
    n = len(names)
    columns = dict(t=np.tile(t, n), id=np.repeat(names, steps), x=np.repeat(np.arange(n) * 1.0, steps))
    return columns | dict(y=np.tile(np.sin(t), n), hit=np.zeros(n * steps))


def places(store: EpisodeStore) -> list[float]:
    return store.observations[0, :, store.card.observation_names.index("own.x")].tolist()


def test_names_are_sorted_as_people_count():
    rng = np.random.default_rng(0)
    pairs = [(word, int(n)) for word in ("", "a", "uav-") for n in rng.permutation(200)]
    sorted_by_value = [f"{word}{n}" for word, n in sorted(pairs)]
    assert sorted((f"{word}{n}" for word, n in pairs), key=natural) == sorted_by_value
    long = ["9" * 6000, "1" + "0" * 6000, "007", "7", "x"]  # more digits than Python makes a number of
    assert sorted(reversed(long), key=natural) == ["007", "7", "9" * 6000, "1" + "0" * 6000, "x"]
    column = np.array([f"{word}{n}" for word, n in pairs])
    names, owner = numbered(column)
    assert names.tolist() == sorted_by_value and (names[owner] == column).all()
    assert numbered(np.array([10, 9, 9]))[0].tolist() == [9, 10]


def test_ten_robots_or_more_stand_in_their_order_and_the_card_says_so(tmp_path):
    import pandas as pd

    rows, wide = table(), {"t": np.arange(30) * 0.1, "hit": np.zeros(30)}
    for k, name in enumerate(ROBOTS):
        wide |= {f"{name}.{axis}": rows[axis][30 * k : 30 * k + 30] for axis in "xy"}
    (tmp_path / "a.jsonl").write_text("\n".join(json.dumps(dict(zip(rows, row))) for row in zip(*_plain(rows))))
    pd.DataFrame(rows).to_csv(tmp_path / "a.csv", index=False)
    given = [rows, rows | {"id": rows["id"].astype("S")}, tmp_path / "a.jsonl", tmp_path / "a.csv"]
    stores = [EpisodeStore.from_table(one, **NAMES) for one in given]
    stores += [EpisodeStore.from_table(wide, **NAMES, wide="{agent}.{column}")]
    for store in stores:
        assert places(store) == list(range(COUNT)) and store.card.agents == ROBOTS
    stores[0].save(tmp_path / "a.h5")
    assert EpisodeStore.load(tmp_path / "a.h5").card.agents == ROBOTS
    recordings = {name: np.concatenate([rows[name]] * 11) for name in rows}
    recordings |= {"run": np.repeat([f"run{k}" for k in range(11)], len(rows["t"]))}
    recordings["x"] = recordings["x"] + np.repeat(100.0 * np.arange(11), len(rows["t"]))
    ordered = EpisodeStore.from_table(recordings, **NAMES, episode="run")
    first = ordered.observations[np.append(0, ordered.episode_ends[:-1] + np.arange(1, 11))]
    assert (first[:, 0, ordered.card.observation_names.index("own.x")] == 100 * np.arange(11)).all()


def _plain(rows: dict[str, np.ndarray]) -> list[list]:
    return [column.tolist() for column in rows.values()]


def test_a_team_whose_members_change_names_nobody():
    rows = table(["a", "b", "c"])
    early = rows["t"] < 1.5
    kept = ((rows["id"] != "c") & early) | ((rows["id"] != "a") & ~early)
    store = EpisodeStore.from_table({name: column[kept] for name, column in rows.items()}, **NAMES, team=2)
    assert store.n_agents == 2 and store.card.agents is None
    assert [places(store), places(store.select(np.arange(store.episodes) == 1))] == [[0.0, 1.0], [2.0, 1.0]]  # b stays
    said = "the team changes its members: who comes is seen where somebody left"
    assert said in store.card.warnings
    rows["run"] = (10 * rows["t"]).astype(int) // 10
    kept = rows["id"] != np.array(["c", "a", "b"])[rows["run"]]
    store = EpisodeStore.from_table({name: x[kept] for name, x in rows.items()}, **NAMES, episode="run", gap=0.2)
    assert [places(store.select(np.arange(3) == k)) for k in range(3)] == [[0.0, 1.0], [2.0, 1.0], [2.0, 0.0]]
    assert f"{said}, and so a change places" in store.card.warnings
    alone = EpisodeStore.from_table(table(["a", "b", "c"]), **NAMES, neighbours=1)
    assert alone.card.agents is None


@pytest.fixture(scope="module")
def pair() -> EpisodeStore:
    """robot_9 and robot_10 walk at random."""
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.uniform(-0.1, 0.1, (20, 11, 2, 2)), 1)
    seen = np.concatenate([x, x[:, :, ::-1] - x], -1)
    names = ["own.x", "own.y", "other0.dx", "other0.dy"]
    card = {"task": "pair", "agents": ["robot_9", "robot_10"], "observation_names": names}
    costs = (rng.random((20, 10)) < 0.2) * 1.0
    return EpisodeStore.from_episodes(seen, np.diff(x, axis=1), np.zeros((20, 10)), costs, card=card)


def test_agents_in_another_order_are_refused_at_run_time(pair, tmp_path):
    swapped = pair.card.agents[::-1]
    wrong = "Agent 0 is robot_10 here and robot_9 in the logs; bring all into the logs' order: robot_9, robot_10"
    world = worlds.fit(pair, **QUICK_WORLD)
    assert world_files.load(world_files.save(world, tmp_path / "w.safetensors")).card.data.agents == pair.card.agents
    run = loop.train("bc", pair, out=tmp_path, changes={"num_updates": 2, "width": 8}, quiet=True)[0]
    for controller in (Controller(run), ringfence.guard(lambda o: np.zeros((2, 2)), world, guard="none")):
        assert controller.agents == pair.card.agents
        controller.act(pair.observations[0], agents=pair.card.agents)
        with pytest.raises(NoSafeAction, match=wrong):
            controller.act(pair.observations[0], agents=swapped)
    resolved = resolve(PolicySpec.of(run))
    metadata = exporting.metadata_of(resolved, exporting.step_of(resolved.job, resolved.team))
    assert metadata["names"]["agents"] == pair.card.agents
    state = {"x": np.zeros(2), "y": np.ones(2)}
    assert observe(pair.card, state, agents=pair.card.agents).shape == (2, 4)
    for odd in (
        np.ma.masked_array([1.0, 2.0], [True, False]),
        np.array([1.0, 2j]),
        [1.0, np.nan],
        ["1", "2"],
        [1, None],
    ):
        with pytest.raises(UserError, match=r"state\['x'\]"):
            observe(pair.card, {**state, "x": odd}, agents=pair.card.agents)
    with pytest.raises(UserError, match=wrong):
        observe(pair.card, state, agents=swapped)
    with pytest.raises(UserError, match="Agent 1 is nobody here and robot_10 in the logs"):
        observe(pair.card, state, agents=["robot_9"])
    other = dataclasses.replace(pair, card=pair.card.updated(agents=swapped))
    with pytest.raises(UserError, match=wrong):
        check_view(world, other)
    with pytest.raises(UserError, match=wrong):
        pair.followed_by(other)
    assert pair.followed_by(pair).episodes == 40
    assert worlds.fit(other, **QUICK_WORLD).card.data.agents == swapped  # and not a cached one of the others'


def test_a_simulator_of_the_logs_agents_has_them_in_the_logs_order():
    class Sim:
        def __init__(self, agents):
            self.possible_agents = agents

        def reset(self, seed=None):
            return {agent: np.zeros(2) for agent in self.possible_agents}, {}

        def step(self, actions):
            raise NotImplementedError

    shape = Shape(2, 2, names=["robot_9", "robot_10"])
    Episode(Sim(["robot_9", "robot_10"]), shape, 0, 10)
    Episode(Sim(["left", "right"]), shape, 0, 10)  # whom the logs do not know
    with pytest.raises(UserError, match="Agent 0 is robot_10 here and robot_9 in the logs"):
        Episode(Sim(["robot_10", "robot_9"]), shape, 0, 10)


def test_the_node_refuses_robots_in_another_order():
    spec = importlib.util.spec_from_file_location("node", Path(__file__).parents[1] / "examples" / "ros2_node.py")
    node = importlib.util.module_from_spec(spec)
    pytest.importorskip("onnxruntime")
    spec.loader.exec_module(node)
    node.check(["robot_9", "robot_10"], ["robot_9", "robot_10"])
    node.check(["left", "right"], ["robot_9", "robot_10"])
    with pytest.raises(SystemExit, match="robot_10 stands where the logs have robot_9"):
        node.check(["robot_10", "robot_9"], ["robot_9", "robot_10"])


def test_names_that_cannot_be_are_refused():
    with pytest.raises(StoreError, match="The card names the agents"):
        EpisodeStore.from_table(table(["a", "b"]), **NAMES, card={"agents": ["a", "a"]})
