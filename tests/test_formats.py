"""Logs in the formats that people bring: each is written by the format's own library and read as it is."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from ringfence.cli import app
from ringfence.errors import StoreError, UserError
from ringfence.logs.io.columns import read_columns
from ringfence.logs.io.lerobot import read_lerobot
from ringfence.logs.io.observe import observe
from ringfence.logs.io.rows import utm, zone_of
from ringfence.logs.store import EpisodeStore
from ringfence.problem.constraints import Separation
from ringfence.problem.entries import Entries
from tests.test_tables import NAMES, entry, fleet

JOINTS = ["waist", "elbow", "gripper"]


# --- JSON lines ---
def test_json_lines_are_read_with_their_objects_and_lists(tmp_path):
    table = fleet()
    file = tmp_path / "fleet.jsonl"
    with file.open("w") as out:
        for k in range(len(table["t"])):
            row = {name: column[k].item() for name, column in table.items()}
            row["pose"] = {"at": [row.pop("x"), row.pop("y")]}
            out.write(json.dumps(row) + "\n\n")
    state = ["pose.at", "vx", "vy"]
    rename = {"pose.at": "at"}
    store = EpisodeStore.from_table(file, **NAMES | {"state": ["at", "vx", "vy"]}, rename=rename)
    whole = EpisodeStore.from_table(table, **NAMES)
    assert store.card.observation_names[2:4] == ["own.at.0", "own.at.1"]
    np.testing.assert_allclose(entry(store, "own.at.1"), entry(whole, "own.y"))
    np.testing.assert_array_equal(store.actions, whole.actions)
    assert EpisodeStore.from_table(file, **NAMES | {"state": state}).card.observation_names[2] == "own.pose.at.0"
    rename |= {"at.0": "x", "at.1": "y"}
    places = EpisodeStore.from_table(file, **NAMES | {"state": ["at", "vx", "vy"]}, rename=rename)
    assert places.content == whole.content and "other0.dx" in places.card.observation_names


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"t": 1}\n{"t": \n', "Line 2 of .* is no JSON"),
        ("[1, 2]\n", "Line 1 of .* is no object"),
        ('{"t": 1, "t": 2}\n', "Line 1 of .* names a field twice"),
        ('{"a":' * 9 + "1" + "}" * 9, "objects in objects 8 deep"),
        ("[" * 10**5, "Line 1 of .* is no JSON"),
        ('{"t": 1, "id": 1, "x": 2}\n{"t": 2, "id": 1}\n', "row 1: x is 'None', no number"),
        ('{"t": 1, "id": 1, "x": [1, 2]}\n{"t": 2, "id": 1, "x": [1]}\n', r"row 1: x is no list of 2 numbers"),
        ('{"t": 1, "id": 1, "x": [1, "a"]}\n{"t": 2, "id": 1, "x": [1, 3]}\n', "row 0: x.1 is 'a', no number"),
        ('{"t": 1, "id": 1, "x": [[1]]}\n', "row 0: x is no list"),
        ("", "column of the table"),
    ],
)
def test_json_lines_that_cannot_be_are_refused(tmp_path, text, said):
    (tmp_path / "a.jsonl").write_text(text)
    with pytest.raises(UserError, match=said):
        EpisodeStore.from_table(tmp_path / "a.jsonl", time="t", agent="id", state=["x"], action=["t"])


# --- names ---
def wide() -> dict[str, np.ndarray]:
    """Columns of a leader and a follower, who is there from the fourth row on."""
    rng = np.random.default_rng(4)
    table = {"stamp": 0.2 * np.arange(30), "crash": (rng.random(30) < 0.3).astype(float)}
    for agent in ("leader", "follower"):
        velocity = rng.uniform(-1, 1, (30, 2))
        place = np.cumsum(velocity, 0) * 0.2
        table |= {f"{agent}_{name}": column for name, column in zip(("X", "Y"), place.T)}
        table |= {f"{agent}_{name}": column for name, column in zip(("vx", "vy"), velocity.T)}
    for name in ("X", "Y", "vx", "vy"):
        table[f"follower_{name}"][:3] = np.nan
    return table


def test_wide_tables_and_other_names(tmp_path):
    import pandas as pd

    table = wide()
    pd.DataFrame(table).to_csv(tmp_path / "pair.csv", index=False)
    command = ["data", "import-table", str(tmp_path / "pair.csv"), "--out", str(tmp_path / "pair.h5")]
    command += ["--state", "x", "y", "vx", "vy", "--cost", "hit", "--wide", "{agent}_{column}"]
    app.main([*command, "--rename", "stamp=time", "X=x", "Y=y", "crash=hit"])
    store = EpisodeStore.load(tmp_path / "pair.h5")
    assert (store.n_agents, store.steps) == (2, 26)
    np.testing.assert_allclose(entry(store, "own.x")[:, 1], table["leader_X"][3:], atol=1e-5)  # in the names' order
    np.testing.assert_allclose(entry(store, "own.y")[:, 0], table["follower_Y"][3:], atol=1e-5)
    np.testing.assert_array_equal(store.costs, table["crash"][4:])
    names = dict(time="stamp", agent="who", state=["X", "vx"], rename={}, wide="{agent}_{column}")
    assert EpisodeStore.from_table(table, **names).n_agents == 2


def test_the_longest_name_says_whose_a_column_is():
    table = {"t": np.arange(20.0)}
    for agent in ("a", "b"):
        table |= {f"{agent}{name}": np.arange(20.0) for name in ("x", "vx")}
    store = EpisodeStore.from_table(table, time="t", agent="who", state=["x", "vx"], wide="{agent}{column}")
    assert store.n_agents == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"wide": "{agent}"}, "must hold {agent} and {column} once"),
        ({"wide": "{agent}-{column}"}, "fits no column of x, y"),
        ({"state": ["x", "y", "z"], "wide": "{agent}_{column}"}, "The agent 'leader' has no column 'leader_z'"),
        ({"rename": {"X": "x", "Y": "x"}}, "rename calls two columns 'x'"),
        ({"rename": {"XX": "x"}, "agent": "leader_X"}, "column of the table.*XX"),
    ],
)
def test_names_that_cannot_be_are_refused(options, said):
    table = wide() | {"follower_z": np.zeros(30)}
    usual = dict(time="stamp", agent="who", state=["x", "y"], rename={"X": "x", "Y": "y"})
    with pytest.raises(UserError, match=said):
        EpisodeStore.from_table(table, **usual | options)


def test_pairs_of_names_on_the_command_line(tmp_path, capsys):
    for pair in ("x", "=x", "x=", "x=y"):
        with pytest.raises(SystemExit):
            app.main(["data", "import-table", "f.csv", "--out", str(tmp_path / "f.h5"), "--rename", "x=z", pair])
        assert "THEIRS=OURS" in capsys.readouterr().err


# --- SUMO ---
def fcd(kind: str = "vehicle", steps: int = 20, **left_out: None) -> ElementTree.Element:
    """Two cars, one east and one north, at 10 and 5 m/s."""
    root = ElementTree.Element("fcd-export")
    for k in range(steps):
        step = ElementTree.SubElement(root, "timestep", time=f"{0.5 * k:.2f}")
        cars = {"east": (5.0 * k, 0.0, 90.0, 10.0), "north": (0.0, 2.5 * k, 0.0, 5.0)}
        for name, (x, y, angle, speed) in cars.items():
            given = dict(id=name, x=x, y=y, angle=angle, type="DEFAULT_VEHTYPE", speed=speed, pos=1.0, lane="a_0")
            given = {key: str(value) for key, value in given.items() if key not in left_out}
            ElementTree.SubElement(step, kind, given)
    return root


@pytest.mark.parametrize("kind", ["vehicle", "person"])
def test_sumos_output_is_read_as_it_is(tmp_path, kind):
    root = fcd(kind)
    if kind == "vehicle":  # a passenger is where the car is
        for step in root:
            ElementTree.SubElement(step, "person", id="p", x="0", y="0", angle="0", speed="0")
    ElementTree.ElementTree(root).write(tmp_path / "fcd.xml", encoding="UTF-8", xml_declaration=True)
    command = ["data", "import-table", str(tmp_path / "fcd.xml"), "--layout", "sumo", "--separation", "3"]
    app.main([*command, "--out", str(tmp_path / "fcd.h5")])
    store = EpisodeStore.load(tmp_path / "fcd.h5")
    assert (store.n_agents, store.steps, store.card.dt) == (2, 19, 0.5)
    np.testing.assert_allclose(entry(store, "own.vx"), np.tile([10.0, 0.0], (20, 1)), atol=1e-5)
    np.testing.assert_allclose(entry(store, "own.vy"), np.tile([0.0, 5.0], (20, 1)), atol=1e-5)
    assert not store.actions.any() and not any("times what" in note for note in store.card.warnings)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<fcd-export><timestep", "damaged or no XML"),
        ("<routes/>", "begins with <routes>"),
        ("<fcd-export/>", "holds no vehicle"),
        ('<fcd-export><vehicle id="a"/></fcd-export>', "outside of any <timestep>"),
        ('<fcd-export><timestep time="a"/></fcd-export>', "time='a', which is no number"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><fcd-export/>', "declares a document type"),
        (ElementTree.tostring(fcd(angle=None), "unicode"), "vehicles without angle"),
        (ElementTree.tostring(fcd(), "unicode").replace('"10.0"', '"fast"'), "no number"),
        (ElementTree.tostring(fcd(), "unicode").replace('angle="', 'angle="north '), "says angle='north"),
    ],
)
def test_xml_that_cannot_be_is_refused(tmp_path, text, said):
    (tmp_path / "fcd.xml").write_text(text)
    with pytest.raises(UserError, match=said):
        EpisodeStore.from_layout(tmp_path / "fcd.xml", "sumo")


# --- a swarm ---

SYNDRONE = (
    "ScenarioID,DroneID,Frame,Time,X,Y,Z,Vel,VelX,VelY,VelZ,AngVelX,AngVelY,AngVelZ,Roll,Pitch,Yaw,Role,Intent,Target,"
    "IsObserver,TimeStr"
)


def test_a_swarm_flies_in_space_by_the_places_of_its_telemetry(tmp_path):
    """Velocities of these files are of another clock than their times."""
    lines = [SYNDRONE]
    for k in range(12):
        for who, role, x, speed in (("Drone1", "EGO", 0.0, 1.0), ("AttackDrone", "ADV", 9.0, -1.0)):
            place = f"{x + 0.5 * k * speed:.3f},2.000,{-10 - 0.25 * k:.3f}"
            moves = f"9.9,{1.5 * speed},0.000,-0.750,0.0,0.0,0.0,0.0,0.0,0.0"
            when = f"{k + 1},{0.266 + 0.5 * k:.3f}"
            lines.append(f"A-DEN,{who},{when},{place},{moves},{role},Patrolling,N/A,0,2025-06-20")
    (tmp_path / "telemetry.csv").write_text("\n".join(lines) + "\n")
    command = ["data", "import-table", str(tmp_path / "telemetry.csv"), "--layout", "syndrone", "--separation", "2"]
    app.main([*command, "--neighbours", "1", "--out", str(tmp_path / "swarm.h5")])
    store = EpisodeStore.load(tmp_path / "swarm.h5")
    assert (store.episodes, store.steps, store.card.dt) == (2, 22, 0.5)
    np.testing.assert_allclose(entry(store, "own.vz"), -0.5, atol=1e-3)
    np.testing.assert_allclose(np.abs(entry(store, "own.vx")), 1.0, atol=1e-3)
    assert abs(entry(store, "other0.dx")[0, 0]) == pytest.approx(9.0, abs=1e-3)
    assert store.costs.sum() == 2 * 3, "nearer than 2 m after eight, nine and ten steps"


# --- pedestrians ---
def test_pedestrians_have_a_line_every_two_fifths_of_a_second(tmp_path):
    rows = []
    for k in range(12):
        for who, speed in ((1, 1.25), (2, -1.0)):
            rows.append([780 + 6 * k, who, 0.4 * k * speed, 0, who, speed, 0, 0])
    np.savetxt(tmp_path / "obsmat.txt", rows)
    command = ["data", "import-table", str(tmp_path / "obsmat.txt"), "--layout", "obsmat", "--neighbours", "1"]
    app.main([*command, "--out", str(tmp_path / "people.h5")])
    store = EpisodeStore.load(tmp_path / "people.h5")
    assert (store.episodes, store.card.dt) == (2, 0.4) and not store.actions.any()
    np.testing.assert_allclose(entry(store, "own.vx")[:12, 0], 1.25, atol=1e-6)
    assert not any("times what" in note for note in store.card.warnings)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 2 3\n4 5 6\n", "2 lines of 3 numbers"),
        ("", "0 lines"),
        ("frame id x\n", "is no obsmat"),
        ("1 1.5 0 0 0 0 0 0\n2 1.5 0 0 0 0 0 0\n", "whole numbers"),
        ("1 1 0 0 0 0 0 0\n", "no pedestrian at two frames"),
    ],
)
def test_obsmats_that_cannot_be_are_refused(tmp_path, text, said):
    (tmp_path / "obsmat.txt").write_text(text)
    with pytest.raises(UserError, match=said):
        EpisodeStore.from_layout(tmp_path / "obsmat.txt", "obsmat")


# --- LeRobot ---
def lerobot(folder, version="v3.0", names=None, arms=("left_", "right_"), lengths=(12, 9), shared=(), **changed):
    """A data set's folder as LeRobot writes it: one file for all episodes (v3) or one each (v2)."""
    import pyarrow as pa
    from pyarrow import parquet

    rng = np.random.default_rng(7)
    entries = [arm + joint for arm in arms for joint in JOINTS]
    names = entries if names is None else names
    feature = {"dtype": "float32", "shape": [len(entries)], "names": names}
    features = {"observation.state": feature, "action": feature, "next.reward": {"dtype": "float32", "shape": [1]}}
    if shared:
        features["observation.state"] = {"dtype": "float32", "shape": [7], "names": [*entries, *shared]}
    features["observation.images.top"] = {"dtype": "video", "shape": [2, 2, 3], "names": ["height", "width", "channel"]}
    info = {"codebase_version": version, "fps": 30, "total_frames": sum(lengths), "features": features} | changed
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "data" / "chunk-000").mkdir(parents=True)
    frame = np.concatenate([np.arange(n) for n in lengths])
    columns = {
        "observation.state": rng.normal(size=(len(frame), len(entries) + len(shared))).astype(np.float32),
        "action": rng.normal(size=(len(frame), len(entries))).astype(np.float32),
    }
    lists = {
        name: pa.array(list(x), pa.list_(pa.float32(), x.shape[1] if version == "v3.0" else -1))
        for name, x in columns.items()
    }
    table = pa.table(
        lists
        | {"timestamp": (frame / 30).astype(np.float32), "frame_index": frame, "next.reward": frame.astype(np.float32)}
        | {"episode_index": np.repeat(np.arange(len(lengths)), lengths), "task_index": np.zeros(len(frame), int)}
    )
    if version == "v3.0":
        parquet.write_table(table, folder / "data" / "chunk-000" / "file-000.parquet")
    else:
        for k, (stop, n) in enumerate(zip(np.cumsum(lengths), lengths)):
            parquet.write_table(table.slice(stop - n, n), folder / "data" / "chunk-000" / f"episode_{k:06d}.parquet")
    return columns


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("nested", [False, True])
def test_both_arms_of_a_lerobot_data_set_are_agents(tmp_path, version, nested):
    entries = [arm + joint for arm in ("left_", "right_") for joint in JOINTS]
    columns = lerobot(tmp_path / "set", version, {"motors": [entries]} if nested else None)
    app.main(["data", "import-lerobot", str(tmp_path / "set"), "--out", str(tmp_path / "arms.h5")])
    store = EpisodeStore.load(tmp_path / "arms.h5")
    assert (store.n_agents, store.episodes, store.steps) == (2, 2, 19) and store.card.dt == pytest.approx(1 / 30)
    assert store.card.observation_names[:3] == [f"own.{joint}" for joint in JOINTS]
    stays = np.r_[0:11, 12:20]
    np.testing.assert_allclose(store.actions, columns["action"][stays].reshape(-1, 2, 3), atol=1e-6)
    np.testing.assert_allclose(entry(store, "own.elbow")[:, 1], columns["observation.state"][:, 4], atol=1e-6)
    np.testing.assert_array_equal(store.rewards[:, 0], stays - np.where(stays >= 12, 12, 0))  # of the frame that acted


def test_arms_by_other_names_and_what_both_see(tmp_path):
    columns = lerobot(tmp_path / "set", arms=("a.", "b."), shared=["tray"])
    both = read_lerobot(tmp_path / "set", ["a.", "b."])
    assert both.agents == ("a", "b") and both.state == (*JOINTS, "tray")
    np.testing.assert_array_equal(both.columns["tray"][21:], columns["observation.state"][:, 6])
    np.testing.assert_array_equal(both.columns["action.elbow"][21:], columns["action"][:, 4])
    one = read_lerobot(tmp_path / "set")
    assert one.agents == ("robot",) and one.state[3] == "b.waist" and len(one.action) == 6


def test_a_file_of_a_data_set_is_a_table_of_named_lists(tmp_path):
    lerobot(tmp_path / "set")
    file = tmp_path / "set" / "data" / "chunk-000" / "file-000.parquet"
    names = dict(time="timestamp", agent="task_index", episode="episode_index", state=["observation.state"])
    store = EpisodeStore.from_table(file, **names, action=["action"])
    assert store.card.observation_names[0] == "own.observation.state.left_waist" and store.actions.shape == (19, 1, 6)


@pytest.mark.parametrize(
    ("changed", "arms", "said"),
    [
        ({"codebase_version": "v1.6"}, (), "version v1.6"),
        ({"fps": 0}, (), "0.0 frames a second"),
        ({"features": 3}, (), "no info.json that LeRobot writes"),
        ({"features": {}}, (), "column of the data set 'observation.state'"),
        ({}, ("left_", "left_"), "names one twice"),
        ({}, [5], "arms is a int; give prefixes"),
        ({}, ("left_",), "The action 'right_waist' begins with none of left_"),
        ({}, ("left_", "right_waist", "right_e", "right_g"), "arms need the same entries"),
    ],
)
def test_data_sets_that_cannot_be_are_refused(tmp_path, changed, arms, said):
    lerobot(tmp_path / "set", **changed)
    with pytest.raises(UserError, match=said):
        read_lerobot(tmp_path / "set", arms)


def rewritten(folder, **columns):
    """The data set of `lerobot` with other columns, which meta/info.json names, too."""
    import pyarrow as pa
    from pyarrow import parquet

    lerobot(folder)
    file, info = folder / "data" / "chunk-000" / "file-000.parquet", folder / "meta" / "info.json"
    table, said = parquet.read_table(file), json.loads(info.read_text())
    for name, column in columns.items():
        table = (table.drop([name]) if name in table.column_names else table).append_column(name, pa.array(column))
        said["features"][name] = {"dtype": "float32", "shape": [1]}
    parquet.write_table(table, file)
    info.write_text(json.dumps(said))
    return folder


def test_an_end_inside_of_a_lerobot_episode_cuts_it(tmp_path):
    whole = read_lerobot(rewritten(tmp_path / "whole", **{"next.done": np.isin(np.arange(21), [11, 20])}))
    one = read_lerobot(rewritten(tmp_path / "set", **{"next.done": np.isin(np.arange(21), [4, 11, 20])}))
    assert not whole.notes and one.notes == ("next.done is set inside of episodes, which are cut there: 1 times",)
    assert np.flatnonzero(np.diff(one.columns["episode"][:21])).tolist() == [4, 11]
    np.testing.assert_array_equal(one.columns["reward"][[4, 5, 6]], [3, 0, 5])  # the last frame's leads nowhere


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"frame_index": 1000 * np.r_[0:12, 0:9]}, "frame_index goes up by 1000 from row to row"),
        ({"next.reward": [[1.0, 2.0]] * 21}, "next.reward holds lists of 2 entries"),
        ({"next.done": ["yes"] * 21}, "next.done is 'yes', no number"),
    ],
)
def test_columns_of_data_sets_that_contradict_the_format_are_refused(tmp_path, columns, said):
    with pytest.raises(UserError, match=said):
        read_lerobot(rewritten(tmp_path / "set", **columns))


def test_folders_that_are_no_data_sets_are_refused(tmp_path):
    with pytest.raises(UserError, match="holds no meta/info.json"):
        read_lerobot(tmp_path)
    lerobot(tmp_path / "set")
    (tmp_path / "set" / "data" / "chunk-000" / "file-000.parquet").unlink()
    with pytest.raises(UserError, match="holds no data/"):
        read_lerobot(tmp_path / "set")
    (tmp_path / "set" / "meta" / "info.json").write_text("[" * 10**5)
    with pytest.raises(UserError, match="no info.json that LeRobot writes"):
        read_lerobot(tmp_path / "set")


# --- angles ---
@pytest.mark.parametrize(("name", "turn"), [("yaw", 2 * np.pi), ("compass", 360.0), ("course_deg", 360.0)])
def test_angles_are_never_interpolated_across_a_turn(name, turn):
    time = np.concatenate([0.2 * np.arange(40), 0.2 * np.arange(40) + 0.1])
    angle = (1.7 * time + 0.3) % (2 * np.pi)
    table = {"t": time, "id": np.repeat([0, 1], 40), "x": time, "y": time, name: angle * turn / (2 * np.pi)}
    store = EpisodeStore.from_table(table, time="t", agent="id", state=["x", "y", name], dt=0.1)
    assert f"own.{name}" not in store.card.observation_names
    got = np.arctan2(entry(store, f"own.sin_{name}"), entry(store, f"own.cos_{name}"))
    true = 1.7 * entry(store, "own.x") + 0.3
    np.testing.assert_allclose(np.abs(np.exp(1j * got) - np.exp(1j * true)), 0, atol=1e-4)
    assert any("cosine and sine" in note for note in store.card.warnings)
    now = {key: table[key][[3, 43]] for key in ("x", "y", name)} | dict.fromkeys(("vx", "vy"), np.ones(2))
    seen = observe(store.card, now)
    np.testing.assert_allclose(
        seen[0, store.card.observation_names.index(f"own.cos_{name}")], np.cos(angle[3]), atol=1e-5
    )


def test_angles_in_degrees_are_asked_for_by_name():
    table = fleet() | {"heading": np.linspace(0, 300, len(fleet()["t"]))}
    options = NAMES | {"state": ["x", "y", "heading"]}
    with pytest.raises(UserError, match="heading reaches 300: .*--rename heading=heading_deg"):
        EpisodeStore.from_table(table, **options)
    renamed = NAMES | {"state": ["x", "y", "heading_deg"], "rename": {"heading": "heading_deg"}}
    assert "own.cos_heading_deg" in EpisodeStore.from_table(table, **renamed).card.observation_names


@pytest.mark.parametrize("turn, unit", [(360.0, "_deg"), (2 * np.pi, "")])
def test_an_angle_that_no_name_tells_is_refused(turn, unit):
    """Between rows at 358 and 2 degrees there would be half a turn; a reading that drops to 0 is none."""
    time = np.arange(200) * 0.1
    table = dict(t=time, id=0 * time, x=np.sin(time), y=time, hdg=(0.9 + 0.013 * np.arange(200)) % 1 * turn)
    options = dict(time="t", agent="id", state=["x", "y", "hdg"])
    with pytest.raises(StoreError, match=f"row 8: hdg jumps .* a turn, .*--rename hdg=heading{unit}"):
        EpisodeStore.from_table(table, **options)
    named = options | {"state": ["x", "y", f"heading{unit}"], "rename": {"hdg": f"heading{unit}"}}
    store = EpisodeStore.from_table(table, **named)
    assert Entries.of(store.card.observation_names).direction, "it says where one looks"
    table["hdg"] = np.where(np.arange(200) % 50 == 30, 0.0, 0.95 * turn)
    assert "own.hdg" in EpisodeStore.from_table(table, **options).card.observation_names


def test_degrees_are_not_converted_twice():
    table = fleet() | {"heading_deg": np.linspace(0, 300, len(fleet()["t"]))}
    with pytest.raises(UserError, match="heading_deg is made radians of by its name; leave its scale"):
        options = NAMES | {"state": ["x", "y", "heading_deg"], "scale": {"heading_deg": np.pi / 180}}
        EpisodeStore.from_table(table, **options)


# --- what is doubtful ---
def track(rows: int = 400, dims: int = 2, seed: int = 3) -> dict[str, np.ndarray]:
    """Two agents who move smoothly."""
    rng = np.random.default_rng(seed)
    time = np.tile(0.1 * np.arange(rows), 2)
    table = {"t": time, "id": np.repeat([0, 1], rows)}
    for axis in "xyz"[:dims]:
        table[axis] = np.concatenate([np.sin(0.1 * np.arange(rows) + rng.uniform(0, 6)) for _ in range(2)])
    return table


def test_accelerations_are_bounded_by_what_is_usual():
    table = track(2000)
    jumpy = dict(table, x=table["x"].copy())
    jumpy["x"][500] += 0.5
    usual = EpisodeStore.from_table(table, time="t", agent="id", state=["x", "y"])
    store = EpisodeStore.from_table(jumpy, time="t", agent="id", state=["x", "y"])
    largest = float(np.abs(usual.actions).max())
    assert usual.card.action_high == pytest.approx(largest, rel=1e-5)
    assert store.card.action_high == pytest.approx(largest, rel=0.05) == np.abs(store.actions).max()
    notes = [note for note in store.card.warnings if "outliers" in note]
    assert len(notes) == 1 and re.match("[345] accelerations of up to 100.* are outliers", notes[0])
    assert not any("outliers" in note for note in usual.card.warnings)


@pytest.mark.parametrize("where", [0, 37, 400, 799])
def test_rows_that_jump_are_counted_and_dropped(where):
    table = track()
    table["x"][where] += 30.0
    options = dict(time="t", agent="id", state=["x", "y"], gap=1.0)
    with pytest.raises(UserError, match=r"more than max_speed=100, as [01] others did; .* give --max-speed"):
        EpisodeStore.from_table(table, **options)
    store = EpisodeStore.from_table(table, **options, max_speed=20.0)
    assert np.abs(entry(store, "own.x")).max() < 1.1 and store.steps >= 398
    assert any(note == "1 rows that moved faster than 20 m/s are dropped" for note in store.card.warnings)


def test_jumps_below_what_is_refused_are_noted():
    table = track()
    table["x"][37] += 3.0
    notes = EpisodeStore.from_table(table, time="t", agent="id", state=["x", "y"]).card.warnings
    said = next(note for note in notes if "row 37 and 1 others moved more than ten times as fast" in note)
    limit = float(re.search("--max-speed ([0-9.]+) drops such rows", said)[1])
    store = EpisodeStore.from_table(table, time="t", agent="id", state=["x", "y"], max_speed=limit)
    assert not any("moved more than" in note for note in store.card.warnings)


def test_one_dimension_is_one_dimension():
    table = track(dims=1)
    store = EpisodeStore.from_table(table, time="t", agent="id", state=["x"], danger=Separation(0.2))
    distance = np.abs(np.diff(entry(store, "own.x"), axis=1))[:, 0]
    np.testing.assert_array_equal(store.costs > 0, distance[1:] < 0.2)
    assert "other0.dx" in store.card.observation_names
    assert not any("nobody sees where others are" in note for note in store.card.warnings)
    near = EpisodeStore.from_table(table, time="t", agent="id", state=["x"], neighbours=1)
    assert "other0.dx" in near.card.observation_names


def test_separate_recordings_are_no_team():
    table = track() | {"run": np.repeat(["a", "b"], 400)}
    store = EpisodeStore.from_table(table, time="t", agent="id", episode="run", state=["x", "y"])
    assert store.n_agents == 1 and any(
        "recordings that are separate are no team" in note for note in store.card.warnings
    )


# --- parts ---
def test_a_table_is_split_by_its_time(tmp_path):
    import pandas as pd

    pd.DataFrame(track(300)).to_csv(tmp_path / "fleet.csv", index=False)
    command = ["data", "import-table", str(tmp_path / "fleet.csv"), "--out", str(tmp_path / "fleet.h5"), "--time", "t"]
    app.main([*command, "--agent", "id", "--state", "x", "y", "--split", "0.7", "--separation", "0.1"])
    learned, judged = (EpisodeStore.load(tmp_path / name) for name in ("fleet.h5", "fleet-rest.h5"))
    assert (learned.steps, judged.steps) == (209, 89)  # 210 and 90 rows of each agent
    np.testing.assert_allclose(entry(learned, "own.x")[:, 0], track(300)["x"][:210], atol=1e-5)
    np.testing.assert_allclose(entry(judged, "own.x")[:, 0], track(300)["x"][210:300], atol=1e-5)
    assert learned.card.action_high == judged.card.action_high and learned.card.dt == judged.card.dt


def test_recordings_with_times_of_their_own_stay_whole():
    table = fleet(episodes=5)
    table["t"] = table["t"] - 100.0 * table["run"]
    learned, judged = EpisodeStore.split_table(table, 0.6, **NAMES)
    assert (learned.episodes, judged.episodes) == (3, 2)
    whole = EpisodeStore.from_table(table, **NAMES)
    np.testing.assert_array_equal(np.concatenate([learned.actions, judged.actions]), whole.actions)
    learned, judged = EpisodeStore.split_table(table, 0.6, **NAMES, neighbours=1)
    assert (learned.episodes, judged.episodes) == (9, 6)


@pytest.mark.parametrize(
    ("share", "changed", "said"),
    [
        (1.5, {}, "split=1.5 must be a number between 0 and 1"),
        (float("nan"), {}, "must be a number between 0 and 1"),
        (0.01, {"run": None}, "leaves 0 episodes in front of the cut"),
        (0.1, {}, "leaves one part without rows"),
    ],
)
def test_splits_that_leave_nothing_are_refused(share, changed, said):
    table = fleet(episodes=2)
    table["t"] = table["t"] - 100.0 * table["run"]
    options = NAMES
    if "run" in changed:
        table = track()
        options = dict(time="t", agent="id", state=["x", "y"])
    with pytest.raises(UserError, match=said):
        EpisodeStore.split_table(table, share, **options)


# --- several tables ---
def test_several_files_are_recordings_of_their_own(tmp_path, capsys):
    import pandas as pd

    files = []
    for k in range(3):
        table = track(60) | {"x": track(60)["x"] + k}
        files.append(tmp_path / f"run{k}.csv")
        pd.DataFrame(table).to_csv(files[-1], index=False)
    names = ["--time", "t", "--agent", "id", "--state", "x", "y", "--separation", "0.1"]
    app.main(["data", "import-table", *map(str, files), "--out", str(tmp_path / "all.h5"), *names])
    store = EpisodeStore.load(tmp_path / "all.h5")
    one = EpisodeStore.from_table(files[0], time="t", agent="id", state=["x", "y"])
    assert store.episodes == 3 * one.episodes and store.steps == 3 * one.steps
    np.testing.assert_allclose(entry(store, "own.x")[store.lengths[0] + 1, 0], track(60)["x"][0] + 1, atol=1e-6)
    assert store.card.provenance == "table run0.csv and 2 more"
    read = [pd.read_csv(file) for file in files]
    schema = {"time": "t", "agent": "id", "state": ["x", "y"], "danger": Separation(0.1)}
    assert EpisodeStore.from_table(read, **schema).content == store.content
    learned, judged = EpisodeStore.split_table(read, 0.6, **schema)
    assert (learned.episodes, judged.episodes) == (1, 2)


def test_several_files_with_episodes_of_their_own():
    parts = [track(40) | {"run": np.repeat([0, 1], 20).repeat(2)[:80]} for _ in range(2)]
    schema = {"time": "t", "agent": "id", "state": ["x", "y"]}
    whole = EpisodeStore.from_table(parts, **schema, episode="run")
    assert whole.episodes == 2 * EpisodeStore.from_table(parts[0], **schema, episode="run").episodes
    with pytest.raises(UserError, match="list of tables is empty"):
        EpisodeStore.from_table([], **schema)
    dates = parts[0] | {"t": parts[0]["t"].astype("datetime64[s]")}
    with pytest.raises(UserError, match="t is datetime64.* and float64 in tables that are given together"):
        EpisodeStore.from_table([parts[0], dates], **schema)


def test_agents_of_joined_files_are_called_after_what_tells_the_files_apart(tmp_path):
    import pandas as pd

    frame = pd.DataFrame(track(40)).query("id == 0").drop(columns="id")
    files = [tmp_path / folder / name for folder in ("r1", "r2") for name in ("pose.csv", "pose.jsonl")]
    for file in files:
        file.parent.mkdir(exist_ok=True)
        frame.to_csv(file, index=False) if file.suffix == ".csv" else frame.to_json(file, orient="records", lines=True)
    schema = {"time": "t", "agent": "id", "state": ["x", "y"], "join": True}
    for given, agents in (
        (files[::2], ["r1/pose", "r2/pose"]),
        (files[:2], ["pose.csv", "pose.jsonl"]),
        (files[:3], ["r1/pose.csv", "r1/pose.jsonl", "r2/pose.csv"]),
        ([frame, files[0]], ["0", "pose"]),
    ):
        assert EpisodeStore.from_table(given, **schema).card.agents == agents
    with pytest.raises(UserError, match="pose.csv' is given twice"):
        EpisodeStore.from_table([files[0], tmp_path / "r2" / ".." / "r1" / "pose.csv"], **schema)


def test_drones_telemetry_is_read_as_it_is(tmp_path):
    """SynDrone-Swarm: a row per drone and frame, at times that jitter; z is down."""
    head = "ScenarioID,DroneID,Frame,Time,X,Y,Z,Vel,VelX,VelY,VelZ,Roll,Pitch,Yaw,Role,Intent,Target,IsObserver,TimeStr"
    lines = []
    for frame in range(1, 40):
        time = 0.8 * frame + 0.1 * (frame % 3)
        for drone in (1, 2, 3):
            place = f"{2 * time + 5 * drone:.3f},{drone:.3f},{-15 - 0.1 * time:.3f},2.0,2.000,0.000,-0.100"
            lines.append(
                f"A-BAS,Drone{drone},{frame},{time:.3f},{place},0,0,2.6,EGO,Patrolling,N/A,0,2025-06-20T11:31Z"
            )
    (tmp_path / "telemetry.csv").write_text("\n".join([head, *lines]) + "\n")
    file = tmp_path / "telemetry.csv"
    app.main(["data", "import-table", str(file), "--layout", "syndrone", "--separation", "2", "--out", f"{file}.h5"])
    store = EpisodeStore.load(f"{file}.h5")
    assert (store.episodes, store.n_agents, store.actions.shape[2]) == (1, 3, 3)
    np.testing.assert_allclose(entry(store, "other0.dx")[:, 0], 5.0, atol=1e-2)


def written(path, *lines) -> str:
    path.write_text("\n".join(lines) + "\n")
    return str(path)


ALONE = dict(time="t", agent="id", state=["x", "y"])


def test_ids_are_text(tmp_path):
    """007 is not 7, and 1e10 not 10e9; what begins with 4e is no number that is too large."""
    ids = ["007", "7", "1e10", "10e9", "4e1234", "4e1235"]
    rows = [f"{k / 10},{name},{k},{j}" for j, name in enumerate(ids) for k in range(9)]
    store = EpisodeStore.from_table(written(tmp_path / "a.csv", "t,id,x,y", *rows), **ALONE)
    assert store.n_agents == 6 and sorted(store.card.agents) == sorted(ids)
    with pytest.raises(StoreError, match="row 4: id is missing"):
        EpisodeStore.from_table(written(tmp_path / "a.csv", "t,id,x,y", *rows[:4], "0.4,,4,0", *rows[5:]), **ALONE)
    lines = [json.dumps({"t": k / 10, "id": who, "x": k, "y": who % 2}) for who in (2**53, 2**53 + 1) for k in range(9)]
    assert EpisodeStore.from_table(written(tmp_path / "a.jsonl", *lines), **ALONE).card.agents == [
        str(2**53),
        str(2**53 + 1),
    ]


def test_utm_is_what_it_is_published_as():
    """The CN Tower as in Wikipedia's article on UTM; a quarter meridian of WGS 84; and a circle of latitude."""
    tower = utm(np.array([-(79 + 23 / 60 + 13.7 / 3600)]), np.array([43 + 38 / 60 + 33.24 / 3600]), 17, True)
    np.testing.assert_allclose(np.ravel(tower), [630084, 4833438], atol=1)
    np.testing.assert_allclose(utm(np.array([3.0]), np.array([45.0]), 31, True), [[500000], [0.9996 * 4984944.378]])
    assert utm(np.array([3.0]), np.array([-45.0]), 31, False)[1] == pytest.approx(1e7 - 0.9996 * 4984944.378)
    here, there = (np.array(utm(np.array([lon]), np.array([60.0]), 32, True)) for lon in (9.0, 9.001))
    circle = (
        np.deg2rad(0.001) * 6378137 * np.cos(np.deg2rad(60)) / np.sqrt(1 - 0.00669438 * np.sin(np.deg2rad(60)) ** 2)
    )
    assert np.linalg.norm(there - here) == pytest.approx(0.9996 * circle, rel=1e-6)
    assert zone_of(np.array([179.9, -179.9, -179.8]), np.array([-3.0, -3, -3])) == (1, False)


def degrees(**changed) -> dict[str, np.ndarray]:
    k = np.tile(np.arange(20), 2)
    table = {"t": k * 1.0, "id": np.repeat([0, 1], 20), "lon": 11 + k * 1e-4, "lat": 48 + np.repeat([0, 1e-3], 20)}
    return table | changed


def test_degrees_are_no_metres(tmp_path):
    names = {"lon": "x", "lat": "y"}
    with pytest.raises(UserError, match="'lon' is in degrees by its name.*--project utm"):
        EpisodeStore.from_table(degrees(), **ALONE, rename=names)
    with pytest.raises(UserError, match="'goal_lat' is in degrees"):
        EpisodeStore.from_table(
            degrees(goal_lat=0), **ALONE | dict(goal=["g", "goal_lat"], rename={"a": "x", "b": "y"})
        )
    store = EpisodeStore.from_table(degrees(), **ALONE, rename=names, project="utm")
    assert "degrees of longitude and latitude are metres of UTM zone 32N" in store.card.warnings
    speed = 1e-4 * np.deg2rad(1) * 6388e3 * np.cos(np.deg2rad(48))  # by the radius of curvature there
    east = entry(store, "own.x")[:, 0]
    assert (east[-1] - east[0]) / (0.9996 * 19) == pytest.approx(speed, rel=1e-3)
    assert EpisodeStore.from_table(degrees(), **ALONE, rename=names, project="none").n_agents == 2
    micro = degrees(lon=degrees()["lon"] * 1e7, lat=degrees()["lat"] * 1e7)
    scaled = EpisodeStore.from_table(micro, **ALONE, rename=names, project="utm", scale={"x": 1e-7, "y": 1e-7})
    np.testing.assert_allclose(scaled.observations, store.observations, atol=1e-3)
    for table, options, said in (
        (micro, {}, "row 0: x is 110000000, and degrees of UTM are within 180"),
        (degrees(), {"rename": {"lon": "y", "lat": "x"}}, "'lat' is called x for project='utm'"),
        (degrees(lon=np.linspace(0, 60, 40)), {}, "import one region at a time"),
        (degrees(), {"project": "mercator"}, "projection.*mercator"),
        (degrees(), {"scale": {"z": 2.0}}, "column of numbers.*z"),
        (degrees(), {"scale": {"x": 0}}, "scale of x=0 must be a number other than 0"),
    ):
        with pytest.raises(UserError, match=said):
            EpisodeStore.from_table(table, **{**ALONE, "rename": names, "project": "utm", **options})


@pytest.mark.parametrize(
    ("name", "said", "remedy"),
    [
        ("x_cm", r"in cm by its name.* scale of x \(--scale x=...\) 0.01, or 1", {"scale": {"x": 0.01}}),
        ("xMm", "in mm by its name", {"scale": {"x": 0.001}}),
        ("Local X (feet)", "in feet by its name.* 0.3048", {"scale": {"x": 0.3048}}),
        ("x_px", "in px by its name.* the metres of one", {"scale": {"x": 0.05}}),
        ("x_deg", "in degrees by its name.* project='utm'", {"project": "none"}),
        ("timestamp_ms", r"counts ms by its name.* time_unit \(--time-unit\) 0.001, or 1", {"time_unit": 0.001}),
        ("time [µs]", "counts µs by its name", {"time_unit": 1.0}),
        ("FrameId", "counts frame by its name.* the seconds of one", {"time_unit": 0.04}),
        ("vx_km_h", "in kmh by its name.* 0.277778", {"scale": {"vx": 1 / 3.6}}),
        ("yaw_deg", "in degrees by its name; call it yaw_deg", {"scale": {"yaw": np.pi / 180}}),
    ],
)
def test_units_that_names_tell_are_asked_for(name, said, remedy):
    table = track(40) | {"vx": track(40)["y"], "yaw": track(40)["y"]}
    ours = (
        "t" if "t" == name[0].lower() or "Frame" in name else next(x for x in ("vx", "yaw", "x") if x in name.lower())
    )
    table[name] = table.pop(ours)
    how = {"time": "t", "agent": "id", "state": ["x", "y", "vx", "yaw"], "rename": {name: ours}}
    with pytest.raises(UserError, match=said):
        EpisodeStore.from_table(table, **how)
    EpisodeStore.from_table(table, **how, **remedy, max_speed=1e6)


def test_names_that_hold_no_unit_are_left_alone():
    table = track(40)
    for x, y, t in (
        ("px", "py", "t"),
        ("robot_px", "robot_py", "Timestamp"),
        ("x_m", "y_m", "time_s"),
        ("cm", "mm", "t"),
    ):
        given = {x: table["x"], y: table["y"], t: table["t"], "id": table["id"]}
        how = {"time": t, "agent": "id", "state": ["x", "y"], "rename": {x: "x", y: "y"}}
        assert EpisodeStore.from_table(given, **how).steps == 39


@pytest.mark.parametrize(
    ("entry", "option", "wanted"),
    [
        ("13/11/2015 23:59:{:02d}", "time_format", "%d/%m/%Y %H:%M:%S"),
        ("11/13/2015 23:59:{:02d}", "time_format", "%m/%d/%Y %H:%M:%S"),
        ("13.11.2015 23:59:{:02d}.5", "time_format", "%d.%m.%Y %H:%M:%S.%f"),
        ("10:00:{:02d}", "time_format", "%H:%M:%S"),
        ("25/03/2024 11:59:{:02d} PM", "time_format", "%d/%m/%Y %I:%M:%S %p"),
        ("25/03/24 23:59:{:02d}", "time_format", "%d/%m/%y %H:%M:%S"),
        ("25/03/2024, 23:59:{:02d}", "time_format", "%d/%m/%Y, %H:%M:%S"),
        ("25/03/2024T23:59:{:02d}Z", "time_format", "%d/%m/%YT%H:%M:%S%z"),
        ("25-Mar-2024 23:59:{:02d}", "time_format", "%d-%b-%Y %H:%M:%S"),
        ("Mon Mar 25 23:59:{:02d} 2024", "time_format", "%a %b %d %H:%M:%S %Y"),
        ("1{:02d},5", "decimal", ","),
    ],
)
def test_what_is_no_number_is_told_how_to_be_one(tmp_path, entry, option, wanted):
    """The remedy that the refusal names is one that works."""
    file = written(tmp_path / "a.csv", "t;id;x;y", *(f"{entry.format(k)};0;{k};0" for k in range(20)))
    with pytest.raises(StoreError, match=f"row 0: t is .* no number; .*{option}='{re.escape(wanted)}'"):
        EpisodeStore.from_table(file, **ALONE)
    store = EpisodeStore.from_table(file, **ALONE, **{option: wanted})
    assert store.card.dt == 1.0 and store.steps == 19


@pytest.mark.parametrize("kind", [np.int64, float, str])
def test_dates_of_digits_alone_are_no_seconds(kind):
    """As seconds they would jump at every minute."""
    times = np.array([20240325235950 + k for k in range(10)] + [20240326000000 + k for k in range(10)])
    table = {"t": times.astype(kind), "id": np.zeros(20), "x": np.arange(20.0), "y": np.zeros(20)}
    with pytest.raises(StoreError, match=r"row 0: t is .*20240325235950.*, .*time_format='%Y%m%d%H%M%S'"):
        EpisodeStore.from_table(table, **ALONE)
    assert EpisodeStore.from_table(table, **ALONE, time_format="%Y%m%d%H%M%S").steps == 19


def test_rows_are_sorted_where_that_is_asked_for(tmp_path):
    rows = [f"2020-01-01 00:00:{k * 7 % 30:02d},0,{k * 7 % 30},0" for k in range(30)]
    file = written(tmp_path / "a.csv", "t,id,x,y", *rows, *rows[3:9])
    with pytest.raises(StoreError, match=r"row 5: t=2020-01-01T00:00:05 is earlier than row 4 .* sort=True \(--sort\)"):
        EpisodeStore.from_table(file, **ALONE)
    store = EpisodeStore.from_table(file, **ALONE, sort=True)
    assert store.steps == 29 and "6 rows that repeat another are left out" in store.card.warnings
    written(tmp_path / "a.csv", "t,id,x,y", *rows, "2020-01-01 00:00:05,0,99,0")
    with pytest.raises(StoreError, match="row 30: .* is the time of row 5 of the same agent"):
        EpisodeStore.from_table(file, **ALONE, sort=True)


def test_places_that_jitter_do_not_make_velocities_doubtful():
    """Trackers: a walker at 30 frames a second whose centre is 3 cm off, and who hardly moves along y."""
    rng, t = np.random.default_rng(0), np.arange(600) / 30
    off = rng.normal(0, 0.03, (2, 600))
    walker = {"t": t, "id": 0 * t, "x": 1.2 * t + off[0], "y": off[1], "vx": 1.2 + 0 * t, "vy": 0 * t}
    options = ALONE | {"state": ["x", "y", "vx", "vy"]}
    assert not any("times what" in note for note in EpisodeStore.from_table(walker, **options).card.warnings)
    notes = EpisodeStore.from_table(walker | {"vx": 3.6 * walker["vx"]}, **options).card.warnings
    assert sum("vx is 3." in note and "times what x changes by" in note for note in notes) == 1
    slow = walker | {"x": walker["x"] / 111e3, "y": walker["y"] / 111e3}
    assert any("degrees (--project utm)" in note for note in EpisodeStore.from_table(slow, **options).card.warnings)


def test_public_sets_are_read_by_one_command_each(tmp_path, capsys):
    """Files as Trajnet++, tracks in centimetres without a head, CITR's cart and people, MRCLAM, ADS-B and AIS are
    written, by the commands of docs/import.md; a step of each is one of theirs."""
    frames = range(30)
    scene = json.dumps({"scene": {"id": 0, "p": 1, "s": 0, "e": 290, "fps": 2.5}})
    tracks = [json.dumps({"track": {"f": k * 10, "p": i, "x": k * 0.4, "y": i}}) for i in (1, 2) for k in frames]
    written(tmp_path / "crowds.ndjson", scene, *tracks)
    written(
        tmp_path / "corridor.txt",
        "# id frame x y z",
        *(f"{i} {k} {k * 4:.1f}  {i * 100} 160" for i in (1, 2) for k in frames),
    )
    cart = [f"1,{k},veh,{k * 0.1:.2f},0,0,3" for k in frames]
    people = [f"{i},{k},ped,{k * 0.05:.2f},{i},1.5,0" for i in (1, 2) for k in frames]
    written(tmp_path / "clip_veh.csv", "id,frame,label,x_est,y_est,psi_est,vel_est", *cart)
    written(tmp_path / "clip_ped.csv", "id,frame,label,x_est,y_est,vx_est,vy_est", *people)
    for i in (1, 2):
        truth = (f"{1248272272.841 + k * 0.01:.3f}\t {k * 0.001 + i}\t{i}\t 0.1" for k in frames)
        written(tmp_path / f"Robot{i}_Groundtruth.dat", "# MRCLAM", "# Time [s]   x [m]   y [m]   theta [rad]", *truth)
    states = [
        f"{1.6e9 + k * 7 % 30:.0f},4e{i},{47 + k * 7 % 30 * 1e-3:.6f},{8 + i * 0.01},216.2"
        for i in (1234, 1235)
        for k in frames
    ]
    written(tmp_path / "states.csv", "time,icao24,lat,lon,velocity", *states, *states[5:9])
    ships = [f"31/12/2015 23:{k:02d}:00,21{i},{55 + k * 1e-3},{10 + i * 0.1},3.6" for i in (0, 1) for k in frames]
    written(tmp_path / "aisdk.csv", "# Timestamp,MMSI,Latitude,Longitude,SOG", *ships)
    page = Path(__file__).resolve().parent.parent.joinpath("docs", "import.md").read_text()
    commands = re.findall(
        r"^    ringfence (data import-table (?:crowds|corridor|clip|Robot|states|aisdk).*)$", page, re.M
    )
    found = {}
    for command in commands:
        words = shlex.split(command)
        files = [sorted(map(str, tmp_path.glob(word))) if "." in word and "*" in word else [word] for word in words]
        words = [str(tmp_path / word) if (tmp_path / word).is_file() else word for each in files for word in each]
        out = tmp_path / words[words.index("--out") + 1]
        app.main([*words[: words.index("--out")], "--out", str(out)])
        store = EpisodeStore.load(out)
        found[out.stem] = (
            store.n_agents,
            store.steps // (1 if not store.card.homogeneous else 2),
            round(store.card.dt, 4),
        )
    assert found == {
        "crowds": (1, 29, 0.4),
        "corridor": (1, 29, 0.04),
        "clip": (3, 29, 0.0334),
        "robots": (2, 29, 0.01),
        "air": (2, 29, 1.0),
        "sea": (2, 29, 60.0),
    }


def test_words_of_parquet_that_are_missing_stay_missing(tmp_path):
    """Arrow's own way to NumPy gives a missing entry of a dictionary the word of the row before."""
    from pyarrow import array, parquet, table

    who = array(["a", "b", None]).dictionary_encode()
    lists, numbers = [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], [1, None, 3]
    parquet.write_table(table({"who": who, "l": lists, "n": numbers, "a.b": [1, 2, 3]}), tmp_path / "a.parquet")
    for source in (tmp_path / "a.parquet", parquet.read_table(tmp_path / "a.parquet")):
        found = read_columns(source, ["who", "l", "n", "a.b"])
        assert found["who"].tolist() == ["a", "b", None] and found["l"].tolist() == lists
        np.testing.assert_array_equal(found["n"], [1, np.nan, 3])
        np.testing.assert_array_equal(found["a.b"], [1, 2, 3])
