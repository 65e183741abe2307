"""ROS bags: written here by rosbags in every format, read into one table, and refused where they are wrong."""

from __future__ import annotations

import re
import shutil
import sqlite3
import sys

import numpy as np
import pytest

from ringfence.cli import app
from ringfence.errors import StoreError, UserError
from ringfence.logs.io.bagfile import typestore
from ringfence.logs.io.rosbag import read_bag
from ringfence.logs.store import EpisodeStore

pytest.importorskip("rosbags", reason="rosbags writes the bags of these tests")

from rosbags import rosbag1, rosbag2  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
START = 1_700_000_000_000_000_000  # ns
FORMATS = ("bag", "lz4", "sqlite3", "mcap", "zstd", "bare")


class Header:
    """A stamp in ns and a frame; what else a header holds depends on the version of ROS."""

    def __init__(self, stamp=0, frame="odom"):
        self.stamp, self.frame = stamp, frame


def build(store, kind, **fields):
    """A message of `kind`, with zeros where nothing is given; dictionaries are messages inside it."""
    made = {}
    for name, (form, what) in store.fielddefs[kind][1]:
        value = fields.pop(name, None)
        if isinstance(value, Header):
            time = dict(sec=value.stamp // 10**9, nanosec=value.stamp % 10**9)
            made[name] = build(store, what, stamp=time, frame_id=value.frame)
        elif form.name == "NAME":
            made[name] = build(store, what, **(value or {}))
        elif form.name == "BASE":
            made[name] = ("" if what[0] == "string" else 0) if value is None else value
        elif what[0][1][0] == "string":
            made[name] = value or []
        else:
            made[name] = np.asarray([0.0] * what[1] if value is None else value, what[0][1][0])
    assert not fields, fields
    return store.types[kind](**made)


def write(folder, messages, form="mcap", store=None):
    """The bag of `messages` (topic, type, time of recording in ns, fields); its path."""
    first = form in ("bag", "lz4")
    shutil.rmtree(folder / "log", ignore_errors=True)
    (folder / "log.bag").unlink(missing_ok=True)
    folder.mkdir(exist_ok=True)
    store = store or STORES[1 if first else 2]
    if first:
        path = folder / "log.bag"
        writer = rosbag1.Writer(path)
        if form == "lz4":
            writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
        pack = store.serialize_ros1
    else:
        path = folder / "log"
        plugin = rosbag2.StoragePlugin.SQLITE3 if form == "sqlite3" else rosbag2.StoragePlugin.MCAP
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if form == "zstd":
            writer.set_compression(rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD)
        pack = store.serialize_cdr
    with writer:
        channels = {}
        for topic, kind, _, _ in messages:
            if topic not in channels:
                channels[topic] = writer.add_connection(topic, kind, typestore=store)
        for topic, kind, time, fields in sorted(messages, key=lambda m: m[2]):
            writer.write(channels[topic], time, pack(build(store, kind, **fields), kind))
    return path / "log.mcap" if form == "bare" else path


def ns(seconds):
    return START + round(seconds * 1e9)


def odometry(topic, time, x=0.0, y=0.0, q=(0.0, 0.0, 0.0, 1.0), twist=(0.0, 0.0, 0.0), stamp=None, frame="odom"):
    """Recorded 3 ms after its stamp, unless that is given; times in s after START."""
    turn = dict(zip("xyzw", q))
    moved = dict(linear=dict(x=twist[0], y=twist[1]), angular=dict(z=twist[2]))
    fields = dict(
        header=Header(ns(time) if stamp is None else stamp, frame),
        pose=dict(pose=dict(position=dict(x=x, y=y), orientation=turn)),
        twist=dict(twist=moved),
    )
    return topic, "nav_msgs/msg/Odometry", ns(time) + 3_000_000, fields


def command(topic, time, vx=0.0, vy=0.0, wz=0.0):
    return topic, "geometry_msgs/msg/Twist", ns(time), dict(linear=dict(x=vx, y=vy), angular=dict(z=wz))


def yaw_of(yaw):
    return (0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))


def scalar(topic, time, value, kind="Float64"):
    return topic, f"std_msgs/msg/{kind}", ns(time), dict(data=value)


def joint_state(topic, time, names, position=(), velocity=()):
    fields = dict(header=Header(ns(time)), name=list(names), position=position, velocity=velocity)
    return topic, "sensor_msgs/msg/JointState", ns(time) + 1_000_000, fields


def pair(**changed):
    """Two short, correct tracks of messages, by topic; for tests that spoil one of them."""
    messages = {}
    for i in range(2):
        messages[f"/r{i}/odom"] = [odometry(f"/r{i}/odom", 0.1 * k, x=k, y=i) for k in range(6)]
        messages[f"/r{i}/cmd_vel"] = [command(f"/r{i}/cmd_vel", 0.1 * k - 0.05, vx=k + 1) for k in range(6)]
    messages |= changed
    return [m for track in messages.values() for m in track]


def near(times, time):
    """The index of the last of `times` at or before `time`, or None."""
    best = None
    for k, t in enumerate(times):
        if t <= time:
            best = k
    return best


@pytest.mark.parametrize("form", FORMATS)
def test_three_robots_are_read_as_written(tmp_path, form):
    rng = np.random.default_rng(0)
    messages, expected, dropped = [("/clock_face", "std_msgs/msg/String", START, dict(data="first"))], [], {}
    for i, (rate, rate_of_commands, late) in enumerate(((20.0, 8.0, 0.03), (10.0, 25.0, 0.31), (7.3, 3.1, 0.12))):
        name = f"robot_{i}"
        times = [ns(0.05 * (i + 1) + k / rate) for k in range(int(3 * rate))]
        commanded = [ns(0.02 * i + late + k / rate_of_commands) for k in range(int(3 * rate_of_commands))]
        ticks = [ns(0.01 + 0.11 * k) for k in range(30)]
        commands, states, costs = rng.normal(size=(len(commanded), 3)), rng.normal(size=(len(times), 6)), rng.random(30)
        places = rng.normal(size=(30, 2, 2))
        for t, (vx, vy, wz) in zip(commanded, commands):
            messages.append(command(f"/{name}/cmd_vel", (t - START) / 1e9, vx, vy, wz))
        for t, (x, y, yaw, vx, vy, wz) in zip(times, states):
            q = tuple(0.7 * np.array(yaw_of(yaw)))  # norms cancel
            messages.append(odometry(f"/{name}/odom", (t - START) / 1e9, x, y, q, (vx, vy, wz)))
        for k, t in enumerate(ticks):
            order = [0, 1] if k % 2 else [1, 0]  # names come in any order
            names = [f"{name}_{'ab'[j]}" for j in order]
            moment = (t - START) / 1e9
            messages.append(
                joint_state(f"/{name}/joint_states", moment, names, places[k, order, 0], places[k, order, 1])
            )
            messages.append(scalar(f"/{name}/near", moment, costs[k]))
        before, dropped[name] = None, 0
        for t, (x, y, yaw, vx, vy, wz) in zip(times, states):
            c, j, n = near(commanded, t), near(ticks, t), near(ticks, t)
            cost = max(
                (costs[k] for k in range(30) if ticks[k] <= t and (before is None or ticks[k] > before)), default=0
            )
            cost = cost or costs[n]
            before = t
            if c is None or j is None:
                dropped[name] += 1
                continue
            turned = complex(vx, vy) * np.exp(1j * yaw)
            expected.append(
                {
                    "time": (t - START) / 1e9,
                    "agent": name,
                    "x": x,
                    "y": y,
                    "yaw": np.angle(np.exp(1j * yaw)),
                    "cos_yaw": np.cos(yaw),
                    "sin_yaw": np.sin(yaw),
                    "vx": turned.real,
                    "vy": turned.imag,
                    "wz": wz,
                    **dict(zip(("cmd_vx", "cmd_vy", "cmd_wz"), commands[c])),
                    **{f"{'ab'[k]}.position": places[j, k, 0] for k in range(2)},
                    **{f"{'ab'[k]}.velocity": places[j, k, 1] for k in range(2)},
                    "cost": cost,
                }
            )
    bag = read_bag(write(tmp_path, messages, form), "/robot_{i}", joints="joint_states", cost="near")
    assert set(bag.columns) == set(expected[0]) and bag.agents == ("robot_0", "robot_1", "robot_2")
    for column, found in bag.columns.items():
        wanted = np.array([row[column] for row in expected])
        if column == "agent":
            np.testing.assert_array_equal(found, wanted)
        else:
            assert found.dtype == np.float64
            np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12, err_msg=column)
    joints = ("a.position", "a.velocity", "b.position", "b.velocity")
    assert bag.state == ("x", "y", "cos_yaw", "sin_yaw", "vx", "vy", "wz", *joints)
    assert bag.action == ("cmd_vx", "cmd_vy", "cmd_wz")
    assert dropped == {"robot_0": 0, "robot_1": 3, "robot_2": 1}
    assert [n for n in bag.notes if "dropped" in n] == [
        f"{dropped[name]} rows of {name} before its first command and states of all joints were dropped"
        for name in ("robot_1", "robot_2")
    ]


@pytest.mark.parametrize("form", ["bag", "sqlite3"])
@pytest.mark.parametrize("kind", ["PoseStamped", "PoseWithCovarianceStamped", "TransformStamped"])
def test_poses_without_velocities(tmp_path, kind, form):
    place, turn = dict(x=3.0, y=-4.0, z=9.0), dict(zip("xyzw", yaw_of(2.5)))
    pose = dict(position=place, orientation=turn)
    fields = {
        "PoseStamped": dict(pose=pose),
        "PoseWithCovarianceStamped": dict(pose=dict(pose=pose)),
        "TransformStamped": dict(transform=dict(translation=place, rotation=turn)),
    }[kind]
    messages = [("/a/pose", f"geometry_msgs/msg/{kind}", ns(k), dict(header=Header(ns(k)), **fields)) for k in range(3)]
    bag = read_bag(write(tmp_path, [*messages, command("/a/cmd_vel", 0, vx=1.0)], form), ["/a"], odom="pose")
    assert bag.state == ("x", "y", "cos_yaw", "sin_yaw") and "vx" not in bag.columns
    np.testing.assert_allclose(
        np.stack([bag.columns[c] for c in ("time", "x", "y", "yaw")], 1),
        [[k, 3, -4, 2.5] for k in range(3)],
        rtol=1e-12,
    )
    with pytest.raises(UserError, match=" of 'a' are one topic"):
        read_bag(write(tmp_path, messages, "mcap"), ["/a"], odom="pose", cmd="pose")


def test_yaw_of_any_orientation(tmp_path):
    """Roll and pitch are no part of it; R_z(yaw) R_y(pitch) R_x(roll) as ROS composes them."""
    from scipy.spatial.transform import Rotation

    angles = np.random.default_rng(1).uniform([-np.pi, -1.5, -np.pi], [np.pi, 1.5, np.pi], (20, 3))
    turns = Rotation.from_euler("ZYX", angles).as_quat()
    messages = [odometry("/a/odom", 0.1 * k, q=tuple(q)) for k, q in enumerate(turns)]
    bag = read_bag(write(tmp_path, [*messages, command("/a/cmd_vel", -1)]), "/{i}")
    np.testing.assert_allclose(bag.columns["yaw"], angles[:, 0], atol=1e-12)


def test_stamped_commands_count_by_their_stamps(tmp_path):
    held = [0.2, 1.2]  # stamped long before they are recorded
    messages = [odometry("/a/odom", float(k)) for k in range(3)]
    for time in held:
        twist = dict(header=Header(ns(time)), twist=dict(linear=dict(x=time), angular=dict(z=-time)))
        messages.append(("/a/go", "geometry_msgs/msg/TwistStamped", ns(time + 0.9), twist))
    path = write(tmp_path, messages)
    by_stamp = read_bag(path, "/{i}", cmd="/go/")
    assert by_stamp.columns["cmd_vx"].tolist() == [0.2, 1.2] and by_stamp.columns["time"].tolist() == [0.997, 1.997]
    assert (
        by_stamp.action == ("cmd_vx", "cmd_wz") and by_stamp.notes[-1] == "no action, since zero in every row: cmd_vy"
    )
    by_recording = read_bag(path, "/{i}", cmd="go", stamps=False)
    assert by_recording.columns["cmd_vx"].tolist() == [0.2] and by_recording.columns["time"].tolist() == [2.0]


def test_without_stamps_the_times_of_recording_count(tmp_path):
    messages = pair(**{"/r1/odom": [odometry("/r1/odom", 0.2 * k, stamp=0) for k in range(4)]})
    bag = read_bag(write(tmp_path, messages, "bag"), ["r0", "r1"])
    time = bag.columns["time"][bag.columns["agent"] == "r1"]
    np.testing.assert_allclose(time, 0.053 + 0.2 * np.arange(4), rtol=0, atol=1e-9)  # the first command is at -0.05 s
    assert bag.notes[0] == "/r1/odom has no stamps, so its times are those of recording"
    some = [odometry("/r1/odom", 0.2 * k, stamp=None if k % 2 else 0) for k in range(4)]
    bag = read_bag(write(tmp_path, pair(**{"/r1/odom": some}), "mcap"), ["r1"])
    np.testing.assert_allclose(bag.columns["time"], [0.053, 0.25, 0.453, 0.65], rtol=0, atol=1e-9)


def test_another_clock(tmp_path):
    """A simulator's stamps, at half the speed of the recorder's clock; commands have none."""
    messages = []
    for i in range(2):
        messages += [
            odometry(f"/r{i}/odom", 0.1 * k + 0.01 * i, x=k, stamp=round(0.05e9 * k + 5e6 * i)) for k in range(100)
        ]
        messages += [command(f"/r{i}/cmd_vel", 0.1 * k + 0.05, vx=k + 1) for k in range(100)]
    bag = read_bag(write(tmp_path, messages, "sqlite3"), "/r{i}")
    for i in range(2):
        mine = bag.columns["agent"] == f"r{i}"
        np.testing.assert_allclose(bag.columns["time"][mine], 0.05 * np.arange(1, 100) + 5e-3 * i, atol=1e-9)
        np.testing.assert_array_equal(bag.columns["cmd_vx"][mine], np.arange(1, 100))
    assert re.search(r"1\.7e\+09 s behind the times of recording, so they come from another clock", bag.notes[0])
    plain = read_bag(tmp_path / "log", "/r{i}", stamps=False)
    np.testing.assert_allclose(np.diff(plain.columns["time"][:99]), 0.1, atol=1e-8)

    odd = [odometry("/r1/odom", 0.1 * k, stamp=ns(0.1 * k + 7)) for k in range(6)]
    with pytest.raises(
        StoreError, match=r"'/r1/odom' and '/r0/odom' come from clocks that are 7 s apart.*stamps=False"
    ):
        read_bag(write(tmp_path, pair(**{"/r1/odom": odd}), "bag"), "/r{i}")
    assert len(read_bag(tmp_path / "log.bag", "/r{i}", stamps=False).columns["x"]) == 12


@pytest.mark.parametrize("kind, value", [("Bool", True), ("Float32", 0.5), ("Float64", 0.1), ("Int32", 3)])
def test_costs_of_the_team(tmp_path, kind, value):
    """The largest since the row before; where none came, the last one; nothing before the first."""
    at = {0.15: 0, 0.21: value, 0.24: 0, 0.32: value, 0.55: value}
    costs = [scalar("/crash", time, type(value)(cost), kind) for time, cost in at.items()]
    for form in ("bag", "mcap"):
        path = write(tmp_path, pair(**{"/crash": costs}), form)
        for name in ("crash", "/crash"):
            bag = read_bag(path, "/r{i}", cost=name)
            want = np.float32(value) if kind == "Float32" else value
            assert bag.columns["cost"].tolist() == [0, 0, 0, want, want, want] * 2
            assert any("come after the last row of r0 and count nowhere" in n for n in bag.notes)
            assert "2 rows of r1 come before the first message of '/crash' and cost 0" in bag.notes
            assert "cost" not in bag.state


def test_costs_of_agents(tmp_path):
    costs = {f"/r{i}/hit": [scalar(f"/r{i}/hit", 0.0, i + 1.0)] for i in range(2)}
    costs["/hit"] = [scalar("/hit", 0.0, 9.0)]
    path = write(tmp_path, pair(**costs))
    assert read_bag(path, "/r{i}", cost="hit").columns["cost"].tolist() == [1.0] * 6 + [2.0] * 6
    assert read_bag(path, "/r{i}", cost="/hit").columns["cost"].tolist() == [9.0] * 12
    del costs["/r1/hit"]
    with pytest.raises(StoreError, match="has no topic '/r1/hit'"):
        read_bag(write(tmp_path, pair(**costs), "bag"), "/r{i}", cost="hit")


def test_joints_from_several_publishers(tmp_path):
    """Arm and gripper publish apart; the gripper has no velocities, one of the arm's is NaN throughout."""
    tracks = {}
    for i in range(2):
        topic = f"/r{i}/joints"
        tracks[topic] = [
            joint_state(topic, -0.01, ["lift", "arm"], [0.1, 0.2], [np.nan, i]),
            joint_state(topic, 0.15, ["grip"], [5.0]),
            joint_state(topic, 0.25, ["arm", "lift"], [0.3, 0.4], [7.0, np.nan]),
        ]
    bag = read_bag(write(tmp_path, pair(**tracks)), "/r{i}", joints="joints")
    assert bag.state[-4:] == ("arm.position", "arm.velocity", "grip.position", "lift.position")
    mine = bag.columns["agent"] == "r1"
    assert bag.columns["x"][mine].tolist() == [2, 3, 4, 5]
    for column, values in {"arm.position": [0.2, 0.3], "arm.velocity": [1, 7], "grip.position": [5, 5]}.items():
        assert bag.columns[column][mine].tolist() == [values[0]] + [values[1]] * 3
    assert bag.columns["lift.position"][mine].tolist() == [0.1, 0.4, 0.4, 0.4]
    assert "2 rows of r1 before its first command and states of all joints were dropped" in bag.notes

    def refused(message, *states):
        tracks["/r1/joints"] = [joint_state("/r1/joints", -0.01 + k, *state) for k, state in enumerate(states)]
        with pytest.raises(StoreError, match=message):
            read_bag(write(tmp_path / message[:9].replace("/", ""), pair(**tracks)), "/r{i}", joints="joints")

    refused("Message 0 of '/r1/joints' names a joint twice", (["arm", "arm"], [1.0, 2.0]))
    refused("Message 1 of .* names 2 joints and gives 1 of velo", (["arm"], [1.0]), (["arm", "lift"], [1, 2], [1]))
    refused("'/r1/joints' names 0 joints", ([],))
    refused("arm.velocity of message 1 .* is nan", (["arm"], [1.0], [1.0]), (["arm"], [1.0], [np.nan]))
    refused("'r0' has the joint column 'arm.velocity' and 'r1' has not", (["arm", "grip", "lift"], [1, 2, 3]))


def test_agents_by_pattern_and_by_list(tmp_path):
    tracks = {}
    for prefix in ("/bot10", "/bot9", "/botx", "/fleet/a1/base", "/other"):
        tracks[f"{prefix}/odom"] = [odometry(f"{prefix}/odom", 0.0)]
        tracks[f"{prefix}/cmd_vel"] = [command(f"{prefix}/cmd_vel", 0.0, vx=1.0)]
    tracks["/bot7/cmd_vel"] = [command("/bot7/cmd_vel", 0.0)]  # no agent, since it has no odometry
    path = write(tmp_path, [m for track in tracks.values() for m in track])
    assert read_bag(path, "/bot{i}").agents == ("bot9", "bot10", "botx")
    assert "left out, since they have commands and no poses: /bot7" in read_bag(path, "/bot{i}").notes
    assert read_bag(path, "fleet/{i}/base/").agents == ("fleet/a1/base",)
    assert read_bag(path, ["/other", "bot9"]).columns["agent"].tolist() == ["other", "bot9"]
    assert read_bag(path, "/other").agents == ("other",)
    with pytest.raises(
        StoreError, match=r"pattern '/rover_\{i\}' matches no agent: .* has no topic '/rover_\{i\}/odom', it"
    ):
        read_bag(path, "/rover_{i}")
    for wrong in ("/{i}/{i}", "/bot_{n}", "/bot{i}{"):
        with pytest.raises(UserError, match="must hold {i} once"):
            read_bag(path, wrong)
    for wrong in ([], ["a", "/a/"]):
        with pytest.raises(UserError, match="is empty or names one twice"):
            read_bag(path, wrong)
    with pytest.raises(UserError, match="twist='body' is unknown"):
        read_bag(path, "/bot{i}", twist="body")
    root = write(tmp_path, [odometry("/odom", 0.0), command("/cmd_vel", 0.0)], "bag")
    assert read_bag(root, "/").agents == ("robot",)


def test_heights_late_clocks_and_commands_between_rows_are_noted(tmp_path):
    """A bag is read in the plane; a clock that is off by rows shifts commands; a command between two rows is lost."""

    def notes(messages):
        return "; ".join(read_bag(write(tmp_path, messages), "/a").notes)

    times = np.arange(20) * 0.5
    poses = [odometry("/a/odom", t, x=t) for t in times]
    each = [command("/a/cmd_vel", t, vx=1.0) for t in times]
    assert not any(word in notes(poses + each) for word in ("plane", "stamps", "between"))
    for k, (_, _, _, fields) in enumerate(poses):
        fields["pose"]["pose"]["position"]["z"] = 0.1 * k
    assert "z, which goes from 0 to 1.9 m, is left out" in notes(poses + each)
    fast = [command("/a/cmd_vel", t, vx=float(k % 5 == 0)) for k, t in enumerate(np.arange(100) * 0.1)]
    assert "of 100 commands of a came between its rows" in notes(poses + fast)
    late = [odometry("/a/odom", t, x=t, stamp=ns(t - 0.9)) for t in times]
    assert "stamps of '/a/odom' are 0.903 s behind the times of recording, more than a row" in notes(late + each)
    jump = [odometry("/a/odom", t, x=t, stamp=ns(t + 3.0 * (t > 7.0))) for t in times]
    assert "stamps of '/a/odom' jump by up to 3 s" in notes(jump + each)


def test_doubts_are_noted(tmp_path):
    """Odometry whose twist is in the world's frame, and robots whose frames have origins of their own."""
    angle = 0.1 * np.arange(60)
    tracks = {"/a/cmd_vel": [command("/a/cmd_vel", -1.0, vx=1.0)], "/b/cmd_vel": [command("/b/cmd_vel", -1.0, vx=1.0)]}
    for name in "ab":  # on a circle of 1 m, at 1 m/s
        twists = [(1.0, 0.0, 1.0) if name == "a" else (-np.sin(u), np.cos(u), 1.0) for u in angle]
        tracks[name] = [
            odometry(f"/{name}/odom", u, np.cos(u), np.sin(u), yaw_of(u + np.pi / 2), v, frame=f"{name}/odom")
            for u, v in zip(angle, twists)
        ]
    path = write(tmp_path, [m for track in tracks.values() for m in track])
    bag = read_bag(path, ["a", "b"])
    mine = bag.columns["agent"] == "a"
    np.testing.assert_allclose(bag.columns["vx"][mine], -np.sin(angle), atol=1e-12)
    assert "poses are in 2 frames ('a/odom', 'b/odom'); positions compare only if these have one origin" in bag.notes
    doubts = [n for n in bag.notes if n.startswith("velocities of")]
    assert len(doubts) == 1 and re.match(r"velocities of '/b/odom' are 1.* 0.00.* with twist='world'", doubts[0])
    bag = read_bag(path, ["b"], twist="world")
    np.testing.assert_allclose(bag.columns["vy"], np.cos(angle), atol=1e-12)
    assert not any(n.startswith("velocities of") for n in bag.notes)


def test_other_topics_do_not_matter(tmp_path):
    """Types that nobody knows, and definitions that are none, on topics that were not asked for."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("float64 volts\nint8[] cells", "acme_msgs/msg/Battery"))
    strange = ("/r0/battery", "acme_msgs/msg/Battery", ns(0.1), dict(volts=1.0, cells=[1, 2]))
    for form in ("sqlite3", "bare"):
        assert len(read_bag(write(tmp_path, [*pair(), strange], form, store), "/r{i}").columns["x"]) == 12
        with pytest.raises(StoreError, match="'/r0/battery' is of type 'acme_msgs/msg/Battery', and cost is read from"):
            read_bag(tmp_path / "log", ["/r0"], cost="battery")
        (tmp_path / "log").rename(tmp_path / form)
    with sqlite3.connect(tmp_path / "sqlite3" / "log.db3") as data:
        data.execute("UPDATE message_definitions SET encoded_message_definition = '?!' WHERE topic_type LIKE 'acme%'")
    assert len(read_bag(tmp_path / "sqlite3", "/r{i}").columns["x"]) == 12


def test_other_definitions_of_standard_types(tmp_path):
    """ROS's own text, with comments and defaults, is read; the same name with other fields is refused."""
    path = write(tmp_path, pair(), "sqlite3")
    file = path / "log.db3"

    def define(kind, change):
        with sqlite3.connect(file) as data:
            ask = "SELECT encoded_message_definition FROM message_definitions WHERE topic_type = ?"
            text = change(data.execute(ask, (kind,)).fetchone()[0])
            data.execute(
                "UPDATE message_definitions SET encoded_message_definition = ? WHERE topic_type = ?", (text, kind)
            )

    define(
        "nav_msgs/msg/Odometry", lambda text: "# Where it is.\n" + re.sub(r"float64 w\b", "float64 w 1  # unit", text)
    )
    assert len(read_bag(path, "/r{i}").columns["x"]) == 12
    define("geometry_msgs/msg/Twist", lambda text: text.replace("float64 y", "float32 y"))
    with pytest.raises(StoreError, match="'/r0/cmd_vel' defines 'geometry_msgs/msg/Twist' otherwise than ROS does"):
        read_bag(path, "/r{i}")


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    with pytest.raises(StoreError, match="There is no bag '.*absent.bag'"):
        read_bag(tmp_path / "absent.bag", "/r{i}")
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(StoreError, match="notes.txt' is no bag by its name"):
        read_bag(tmp_path / "notes.txt", "/r{i}")
    path = write(tmp_path, pair())
    with pytest.raises(StoreError, match="holds no metadata.yaml, so it is no ROS 2 bag; pass one of log in it"):
        read_bag(tmp_path, "/r{i}")
    with pytest.raises(
        StoreError, match="has no topic '/r2/odom', it has .*/r1/odom.*; pass the name of one of them as odom"
    ):
        read_bag(path, ["/r0", "/r2"])
    many = {f"/x{i}/odom": [odometry(f"/x{i}/odom", 0.0)] for i in range(20)}
    many["/x7/cmd_vel"] = [command("/x7/cmd_vel", 0.0)]
    with pytest.raises(
        StoreError, match="agent 'x0' has no commands: .* has no topic '/x0/cmd_vel', it has .* and 17 more"
    ):
        read_bag(write(tmp_path / "many", pair(**many)), "/x{i}")
    (path / "metadata.yaml").unlink()
    with pytest.raises(StoreError, match="pass one of log.mcap in it"):
        read_bag(path, "/r{i}")
    (path / "log.mcap").rename(path / "log.mcap.old")
    with pytest.raises(StoreError, match="run ros2 bag reindex"):
        read_bag(path, "/r{i}")

    late = [command("/r1/cmd_vel", 9.0)]
    with pytest.raises(StoreError, match="all 6 messages of '/r1/odom' are older than the first of its commands"):
        read_bag(write(tmp_path / "late", pair(**{"/r1/cmd_vel": late})), "/r{i}")

    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)  # as if it were not installed
    with pytest.raises(StoreError, match=r"run pip install 'ringfence\[ros\]'"):
        read_bag(path, "/r{i}")


def test_a_topic_without_messages(tmp_path):
    with rosbag2.Writer(tmp_path / "log", version=8) as writer:
        for topic, kind in (("/a/odom", "nav_msgs/msg/Odometry"), ("/a/cmd_vel", "geometry_msgs/msg/Twist")):
            channel = writer.add_connection(topic, kind, typestore=STORES[2])
        writer.write(channel, START, STORES[2].serialize_cdr(build(STORES[2], kind), kind))
    with pytest.raises(StoreError, match="the topic '/a/odom' holds no messages"):
        read_bag(tmp_path / "log", "/{i}")


def test_a_topic_of_two_types(tmp_path):
    store, kinds = STORES[1], ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")
    with rosbag1.Writer(tmp_path / "log.bag") as writer:
        for topic, kind in (("/a/odom", "nav_msgs/msg/Odometry"), *(("/a/cmd_vel", kind) for kind in kinds)):
            channel = writer.add_connection(topic, kind, typestore=store)
            writer.write(channel, START, store.serialize_ros1(build(store, kind), kind))
    with pytest.raises(StoreError, match="'/a/cmd_vel' is of two types, .*Twist' and '.*TwistStamped'"):
        read_bag(tmp_path / "log.bag", "/{i}")


def test_agents_of_different_kinds(tmp_path):
    pose = [("/r1/odom", "geometry_msgs/msg/PoseStamped", ns(0.0), dict(pose=dict(orientation=dict(w=1.0))))]
    with pytest.raises(StoreError, match="'/r0/odom' is nav_msgs/msg/Odometry and others are not"):
        read_bag(write(tmp_path, pair(**{"/r1/odom": pose})), "/r{i}")


@pytest.mark.parametrize("form", ["bag", "mcap"])
def test_bad_values_are_named(tmp_path, form):
    def refused(message, **changed):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        with pytest.raises(StoreError, match=message):
            read_bag(write(folder, pair(**changed), form), "/r{i}", cost="hit" if "/hit" in changed else None)

    back = [odometry("/r1/odom", 0.1 * k, stamp=ns(0.1 * k - 0.25 * (k == 3))) for k in range(6)]
    refused("header's stamp of message 3 of '/r1/odom' is 0.15 s earlier .* stamps=False", **{"/r1/odom": back})
    null = [odometry("/r0/odom", 0.1 * k, q=(0, 0, 0, float(k != 2))) for k in range(6)]
    refused("quaternion of message 2 of '/r0/odom' has norm 0", **{"/r0/odom": null})
    for value in (np.nan, np.inf, 1e31):
        place = [odometry("/r0/odom", 0.1 * k, y=value if k == 4 else 0.0) for k in range(6)]
        refused(re.escape(f"y of message 4 of '/r0/odom' is {value}"), **{"/r0/odom": place})
        commands = [command("/r1/cmd_vel", 0.1 * k, wz=value if k else 0.0) for k in range(6)]
        refused(re.escape(f"cmd_wz of message 1 of '/r1/cmd_vel' is {value}"), **{"/r1/cmd_vel": commands})
        refused(re.escape(f"cost of message 0 of '/hit' is {value}"), **{"/hit": [scalar("/hit", 0.0, value)]})


@pytest.mark.parametrize("form", ["bag", "sqlite3", "mcap", "bare"])
def test_damaged_files_are_refused(tmp_path, form):
    path = write(tmp_path, pair(), form)
    file = {"sqlite3": path / "log.db3", "mcap": path / "log.mcap"}.get(form, path)
    data = file.read_bytes()
    noise = np.random.default_rng(0).bytes(4096)
    for damaged in (b"", data[:5], data[: len(data) // 2], data[:-40], noise, data[:64] + noise):
        if form == "sqlite3" and damaged == data[:-40]:
            continue  # SQLite needs no more of it than it reads
        file.write_bytes(damaged)
        with pytest.raises(StoreError, match="is truncated, damaged or no bag"):
            read_bag(path, "/r{i}")
    file.write_bytes(data)
    if path.is_dir():
        text = (path / "metadata.yaml").read_text()
        for damaged in ("", "{", "rosbag2_bagfile_information: 3", text.replace("name: /r0/odom", "name: [1]")):
            (path / "metadata.yaml").write_text(damaged)
            with pytest.raises(StoreError, match="is truncated, damaged or no bag"):
                read_bag(path, "/r{i}")


def test_a_message_that_is_cut_is_named(tmp_path):
    path, kind = tmp_path / "log.bag", "geometry_msgs/msg/Twist"
    store = STORES[1]
    with rosbag1.Writer(path) as writer:
        seen = writer.add_connection("/a/odom", "nav_msgs/msg/Odometry", typestore=store)
        connection = writer.add_connection("/a/cmd_vel", kind, typestore=store)
        writer.write(seen, START, store.serialize_ros1(build(store, "nav_msgs/msg/Odometry"), "nav_msgs/msg/Odometry"))
        whole = store.serialize_ros1(build(store, kind), kind)
        writer.write(connection, START, whole)
        writer.write(connection, START + 1, whole[:-8])
    with pytest.raises(StoreError, match="message 1 of '/a/cmd_vel' is damaged"):
        read_bag(path, "/{i}")


# --- other commands, or none ---
def car(topic, time, speed, steering, stamped=True):
    drive = dict(speed=speed, steering_angle=steering)
    if not stamped:
        return topic, "ackermann_msgs/msg/AckermannDrive", ns(time), drive
    fields = dict(header=Header(ns(time)), drive=drive)
    return topic, "ackermann_msgs/msg/AckermannDriveStamped", ns(time) + 1_000_000, fields


@pytest.mark.parametrize("form", ["bag", "mcap"])
@pytest.mark.parametrize("stamped", [True, False])
def test_cars_are_commanded_by_speed_and_steering(tmp_path, form, stamped):
    drives = {
        f"/r{i}/drive": [car(f"/r{i}/drive", 0.1 * k - 0.05, k + 1, 0.25, stamped) for k in range(6)] for i in range(2)
    }
    messages = pair(**drives)
    bag = read_bag(write(tmp_path, messages, form, typestore(1 if form == "bag" else 2)), "/r{i}", cmd="drive")
    assert bag.action == ("cmd_speed", "cmd_steering") and "cmd_vx" not in bag.columns
    np.testing.assert_array_equal(bag.columns["cmd_speed"][:6], np.arange(1, 7))
    np.testing.assert_array_equal(bag.columns["cmd_steering"], 0.25)


def test_agents_of_different_commands(tmp_path):
    path = write(tmp_path, pair(**{"/r1/cmd_vel": [car("/r1/cmd_vel", 0.0, 1.0, 0.0)]}), store=typestore(2))
    with pytest.raises(
        StoreError, match="'/r0/cmd_vel' is geometry_msgs/msg/Twist and '/r1/cmd_vel' is ackermann_msgs"
    ):
        read_bag(path, "/r{i}")


@pytest.mark.parametrize("kind", ["Odometry", "PoseStamped"])
def test_bags_without_commands_give_accelerations(tmp_path, kind):
    messages = []
    for i in range(2):
        for k in range(12):
            at = odometry(f"/r{i}/odom", 0.1 * k, x=0.02 * k**2, y=i, twist=(0.4 * k, 0.0, 0.0))
            if kind == "PoseStamped":
                pose = dict(header=at[3]["header"], pose=at[3]["pose"]["pose"])
                at = at[0], "geometry_msgs/msg/PoseStamped", at[2], pose
            messages.append(at)
    path = write(tmp_path, messages)
    bag = read_bag(path, "/r{i}")
    assert bag.action == () and bag.notes == ("no agent has the topic 'cmd_vel', and no other cmd was given",)
    app.main(["data", "import-bag", str(path), "--agents", "/r{i}", "--out", str(tmp_path / "bag.h5")])
    store = EpisodeStore.load(tmp_path / "bag.h5")
    assert (store.n_agents, store.steps) == (2, 11)
    np.testing.assert_allclose(store.actions[1:, :, 0], 4.0, atol=1e-4)
    np.testing.assert_allclose(store.actions[..., 1], 0.0, atol=1e-5)
    with pytest.raises(StoreError, match="has no commands: .* has no topic '/r0/drive'"):
        read_bag(path, "/r{i}", cmd="drive")


def test_a_stamp_that_is_late_is_refused(tmp_path):
    late = [odometry("/r1/odom", 0.1 * k, stamp=ns(0.1 * k - (9 if k == 0 else 0))) for k in range(6)]
    with pytest.raises(StoreError, match=r"'/r1/odom', 0 s after its first, is 9 s off .*\(5 s are allowed\); cut"):
        read_bag(write(tmp_path, pair(**{"/r1/odom": late})), "/r{i}")
    assert len(read_bag(tmp_path / "log", "/r{i}", stamps=False).columns["x"]) == 12


@pytest.mark.parametrize("roles", [{"odom": "cmd_vel"}, {"cmd": "odom"}, {"cost": "odom"}, {"joints": "odom"}])
def test_one_topic_is_of_one_role(tmp_path, roles):
    path = write(tmp_path, pair())
    with pytest.raises(UserError, match="of 'r0' are one topic"):
        read_bag(path, "/r{i}", **roles)
