"""Read ROS bags into one table: a row for every agent and message of its odometry, with the command at that time.

ROS 1 bags (`.bag`), ROS 2 bags (a folder with metadata.yaml, sqlite3 or mcap inside) and bare `.mcap` and `.db3` files
are read by the library rosbags. Fields and units are those of ROS's common interfaces (nav_msgs, geometry_msgs,
sensor_msgs, std_msgs): metres, radians, seconds, and a twist that Odometry gives in the frame of the robot.

A bag carries the definitions of its types. They are compared with the standard ones and never compiled: bytes are read
by rosbags' own definitions, so what a stranger's file defines runs nowhere, and types of other topics do not matter.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.errors import StoreError, UserError

POSE = ("x", "y", "yaw")
TWIST = ("vx", "vy", "wz")
COMMAND = ("cmd_vx", "cmd_vy", "cmd_wz")
CLOCK = 1.0  # s; stamps further from the times of recording come from another clock than the recorder's
JOINTS = 1000  # names of joints that a topic may hold
DEFINITION = 2**16  # characters of a type's definition
LARGEST = 1e30  # of any number; a store holds float32
MOVING = 0.05  # m/s; slower rows do not tell in which frame a twist is
SHOWN = 8  # topics that a refusal lists


@dataclass(frozen=True, eq=False)
class Bag:
    """The table of a bag: R rows, agent by agent and in the order of time.

    `columns` holds arrays (R,): `time` (s), `agent` (str), `x`, `y` (m), `yaw` (rad, in [-pi, pi]), `cos_yaw`,
    `sin_yaw`; of Odometry `vx`, `vy` (m/s, in the world frame) and `wz` (rad/s); `cmd_vx`, `cmd_vy` (m/s) and `cmd_wz`
    (rad/s) as commanded, in the robot's frame; `<joint>.position`, `<joint>.velocity` and `cost` where asked for.
    `state` and `action` name the columns that are natural as such: no angle that wraps, no command that is always 0.
    `notes` say what was dropped or is doubtful.
    """

    columns: dict[str, np.ndarray]
    state: tuple[str, ...]
    action: tuple[str, ...]
    agents: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Topic:
    """M messages of a topic, in the order of recording."""

    name: str
    type: str
    logged: np.ndarray  # (M,) ns, when the recorder received them
    stamps: np.ndarray | None  # (M,) ns in their headers, 0 where unset; None of types without a header
    values: list  # what the type's entry in `ROLES` makes of each
    frames: tuple[str, ...]  # frames that their headers name


@dataclass(frozen=True, eq=False)
class Clock:
    """One time for every message: its stamp, and where there is none the time of recording."""

    times: dict[str, np.ndarray]  # (M,) ns, by topic
    stamped: frozenset[str]
    foreign: bool  # stamps come from another clock than the recorder's, for example a simulator's
    origin: int  # ns

    def align(self, rows: Topic, other: Topic) -> tuple[np.ndarray, np.ndarray]:
        """Times of two topics that can be compared with each other."""
        if self.foreign and other.name not in self.stamped:
            return rows.logged, other.logged
        return self.times[rows.name], self.times[other.name]


def read_bag(
    path: str | os.PathLike,
    agents: str | Sequence[str],
    *,
    odom: str = "odom",
    cmd: str = "cmd_vel",
    joints: str | None = None,
    cost: str | None = None,
    stamps: bool = True,
    twist: str = "child",
) -> Bag:
    """The table of a bag; nothing is resampled.

    `agents` is a pattern such as `/robot_{i}`, where {i} is any number or word under which the topic `odom` exists, or
    a list of prefixes. An agent's topics are prefix/odom and so on:

    * `odom`: nav_msgs Odometry, or geometry_msgs PoseStamped, PoseWithCovarianceStamped or TransformStamped, which have
      no velocities. Odometry's twist is in the robot's frame (child_frame_id) and is turned by its yaw into the world;
      `twist="world"` takes it as it stands, for publishers that break this rule.
    * `cmd`: geometry_msgs Twist or TwistStamped. A row holds the last command at or before it; rows before the first
      are dropped, and a note counts them.
    * `joints`: sensor_msgs JointState, held likewise, joint by joint. Where all names of an agent's joints begin with
      its own name, that is left out, so that agents have the same columns. What is NaN throughout was not measured.
    * `cost`: std_msgs Bool, Float32, Float64 or Int32 of each agent, or of the team if it begins with a slash or exists
      without prefix only. A row's cost is the largest since the agent's row before; if none came, the last one stands.

    `time` counts from the bag's first message. It is the header's stamp, and where that is missing or zero the time of
    recording; `stamps=False` takes the latter throughout. Where stamps come from another clock than the recorder's,
    they count from the first of them, and messages without stamps are placed among rows by the times of recording.

    Refuses with `UserError` what cannot be read so, before anything is made of it.
    """
    path = Path(path)
    if twist not in ("child", "world"):
        raise UserError(f"twist='{twist}' is unknown; choose child (the robot's frame, ROS's rule) or world.")
    with _opened(path) as bag:
        prefixes = _prefixes(bag, agents, odom)
        names = [prefix.strip("/") or "robot" for prefix in prefixes]
        asked = {
            "odom": [_join(prefix, odom) for prefix in prefixes],
            "cmd": [_join(prefix, cmd) for prefix in prefixes],
        }
        for name, seen, topic in zip(names, asked["odom"], asked["cmd"]):
            if seen in bag.topics and topic not in bag.topics:
                raise StoreError(
                    f"The agent '{name}' has no commands: {bag.lacks(topic)}; pass another cmd or fewer agents."
                )
        if joints is not None:
            asked["joints"] = [_join(prefix, joints) for prefix in prefixes]
        if cost is not None:
            asked["cost"] = _cost_topics(bag, prefixes, cost)
        read = bag.read({topic: role for role, topics in asked.items() for topic in topics})
        start = bag.start(read)

    notes: list[str] = []
    odometry = [read[topic] for topic in asked["odom"]]
    clock = _clock(path, odometry, [t for name, t in read.items() if name not in asked["odom"]], start, stamps, notes)
    _frames(odometry, notes)
    if len({t.type == "nav_msgs/msg/Odometry" for t in odometry}) > 1:
        raise StoreError(
            f"'{path}': '{odometry[0].name}' is {odometry[0].type} and others are not, so only some agents have "
            "velocities; pass fewer agents or another odom."
        )

    parts = []
    for k, name in enumerate(names):
        rows = odometry[k]
        again = int((np.diff(clock.times[rows.name]) == 0).sum())
        if again:
            notes.append(f"{again} rows of {name} have the time of the row before")
        columns = _poses(rows, (clock.times[rows.name] - clock.origin) / 1e9, twist, notes)
        commands = read[asked["cmd"][k]]
        latest = _latest(*clock.align(rows, commands))
        values = _numbers(commands, COMMAND)
        columns |= {c: values[latest, i] for i, c in enumerate(COMMAND)}
        known = latest >= 0
        if joints is not None:
            joint_columns = _joints(read[asked["joints"][k]], name)
            row_times, times = clock.align(rows, read[asked["joints"][k]])
            for column in sorted(joint_columns):
                which, values = joint_columns[column]
                latest = _latest(row_times, times[which])
                columns[column] = values[latest]
                known &= latest >= 0
        if cost is not None:
            topic = read[asked["cost"][k]]
            columns["cost"] = _costs(topic, *clock.align(rows, topic), name, notes)
        if not known.any():
            raise StoreError(
                f"'{path}': all {len(known)} messages of '{rows.name}' are older than the first of its commands"
                f"{' and joints' if joints is not None else ''}; pass fewer agents."
            )
        if not known.all():
            before = "command" if joints is None else "command and states of all joints"
            notes.append(f"{(~known).sum()} rows of {name} before its first {before} were dropped")
        columns = {"agent": np.full(len(known), name)} | columns
        parts.append({c: x[known] for c, x in columns.items()})

    for name, part in zip(names, parts):
        if part.keys() != parts[0].keys():
            other = min(part.keys() ^ parts[0].keys())
            having, lacking = (name, names[0]) if other in part else (names[0], name)
            raise StoreError(
                f"'{path}': '{having}' has the joint column '{other}' and '{lacking}' has not; agents need the same "
                "joints, so pass fewer agents or leave joints out."
            )
    columns = {c: np.concatenate([part[c] for part in parts]) for c in ("time", *parts[0])}
    action = tuple(c for c in COMMAND if columns[c].any()) or COMMAND
    if action != COMMAND:
        notes.append(f"no action, since zero in every row: {', '.join(c for c in COMMAND if c not in action)}")
    state = tuple(c for c in columns if c not in ("time", "agent", "yaw", "cost", *COMMAND))
    return Bag(columns, state, action, tuple(names), tuple(notes))


# --- what is in a message -------------------------------------------------------------------------------------------


def _pose(position, orientation) -> tuple[float, ...]:
    return position.x, position.y, orientation.x, orientation.y, orientation.z, orientation.w


def _odometry(m) -> tuple[float, ...]:
    moved, twist = m.pose.pose, m.twist.twist
    return *_pose(moved.position, moved.orientation), twist.linear.x, twist.linear.y, twist.angular.z


def _command(twist) -> tuple[float, ...]:
    return twist.linear.x, twist.linear.y, twist.angular.z


def _scalar(m) -> tuple[float]:
    return (m.data,)


ROLES: dict[str, dict[str, Callable]] = {
    "odom": {
        "nav_msgs/msg/Odometry": _odometry,
        "geometry_msgs/msg/PoseStamped": lambda m: _pose(m.pose.position, m.pose.orientation),
        "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _pose(m.pose.pose.position, m.pose.pose.orientation),
        "geometry_msgs/msg/TransformStamped": lambda m: _pose(m.transform.translation, m.transform.rotation),
    },
    "cmd": {
        "geometry_msgs/msg/Twist": _command,
        "geometry_msgs/msg/TwistStamped": lambda m: _command(m.twist),
    },
    "joints": {"sensor_msgs/msg/JointState": lambda m: (tuple(m.name), m.position, m.velocity)},
    "cost": {f"std_msgs/msg/{kind}": _scalar for kind in ("Bool", "Float32", "Float64", "Int32")},
}


# --- the file -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _File:
    """An open bag: its reader, the connections of every topic, and what turns bytes into messages."""

    path: Path
    reader: Any
    topics: dict[str, list]
    store: Any
    message: Callable[[bytes, str], Any]

    def lacks(self, topic: str) -> str:
        near = difflib.get_close_matches(topic, self.topics, n=SHOWN, cutoff=0.0)
        more = f" and {len(self.topics) - SHOWN} more" if len(self.topics) > SHOWN else ""
        return f"'{self.path}' has no topic '{topic}', it has {', '.join(near) or 'none at all'}{more}"

    def start(self, read: dict[str, Topic]) -> int:
        """ns of the first message of any topic; no more of a bag's own word is believed than the messages allow."""
        first = min(int(topic.logged.min()) for topic in read.values())
        claimed = self.reader.start_time
        return claimed if isinstance(claimed, int) and 0 <= claimed <= first else first

    def read(self, roles: dict[str, str]) -> dict[str, Topic]:
        """The topics by name; types are checked before messages are read."""
        parse = {topic: self._parser(topic, role) for topic, role in roles.items()}
        logged: dict[str, list[int]] = {topic: [] for topic in roles}
        stamps: dict[str, list[int]] = {topic: [] for topic in roles}
        values: dict[str, list] = {topic: [] for topic in roles}
        frames: dict[str, dict[str, None]] = {topic: {} for topic in roles}
        for topic, kind, time, raw in self._messages([c for asked in roles for c in self.topics[asked]]):
            try:
                message = self.message(raw, kind)
                values[topic].append(parse[topic](message))
                if hasattr(message, "header"):
                    stamp = message.header.stamp
                    stamps[topic].append(stamp.sec * 10**9 + stamp.nanosec)
                    frames[topic][message.header.frame_id] = None
            except Exception as error:  # bytes that are no such message raise anything
                raise StoreError(
                    f"'{self.path}': message {len(logged[topic])} of '{topic}' is damaged ({_reason(error)}); copy "
                    "the bag again."
                ) from error
            logged[topic].append(time)
        for topic in roles:
            if not logged[topic]:
                raise StoreError(
                    f"'{self.path}': the topic '{topic}' holds no messages; pass another topic or fewer agents."
                )
        try:
            return {
                topic: Topic(
                    topic,
                    self.topics[topic][0].msgtype,
                    np.array(logged[topic], np.int64),
                    np.array(stamps[topic], np.int64) if stamps[topic] else None,
                    values[topic],
                    tuple(frames[topic]),
                )
                for topic in roles
            }
        except OverflowError as error:
            raise _damaged(self.path, error) from error

    def _messages(self, connections: list) -> Iterator[tuple[str, str, int, bytes]]:
        try:
            for connection, time, raw in self.reader.messages(connections):
                yield _name(connection.topic), connection.msgtype, time, raw
        except Exception as error:  # as above
            raise _damaged(self.path, error) from error

    def _parser(self, topic: str, role: str) -> Callable:
        if topic not in self.topics:
            raise StoreError(f"{self.lacks(topic)}; pass the name of one of them as {role}.")
        for connection in self.topics[topic]:
            kind = connection.msgtype
            if kind not in ROLES[role]:
                known = ", ".join(name.replace("/msg/", "/") for name in ROLES[role])
                raise StoreError(
                    f"'{self.path}': the topic '{topic}' is of type '{kind}', and {role} is read from {known}; pass "
                    "another topic."
                )
            if kind != self.topics[topic][0].msgtype:
                raise StoreError(
                    f"'{self.path}': the topic '{topic}' is of two types, '{self.topics[topic][0].msgtype}' and "
                    f"'{kind}'; write it to a new bag as one of them."
                )
            if not self._standard(connection):
                raise StoreError(
                    f"'{self.path}': the topic '{topic}' defines '{kind}' otherwise than ROS does, so its bytes would "
                    "be misread; publish it as the standard type."
                )
        return ROLES[role][self.topics[topic][0].msgtype]

    def _standard(self, connection) -> bool:
        """Whether a topic's bytes are CDR or ROS 1's, and its type's definition, if the bag has one as text, ROS's."""
        from rosbags.interfaces import MessageDefinitionFormat
        from rosbags.typesys import get_types_from_msg

        if getattr(connection.ext, "serialization_format", "cdr") != "cdr":
            return False
        if connection.msgdef.format != MessageDefinitionFormat.MSG:
            return True
        if len(connection.msgdef.data) > DEFINITION:
            return False
        try:
            given = get_types_from_msg(connection.msgdef.data, connection.msgtype)
        except Exception:  # a text that is no definition raises anything
            return False
        return all(
            fields == self.store.fielddefs[name][1]
            for name, (_, fields) in given.items()
            if name in self.store.fielddefs
        )


@contextmanager
def _opened(path: Path) -> Iterator[_File]:
    """The bag, whichever kind it is. rosbags' two readers are used rather than its AnyReader, which compiles what a bag
    defines, and opens none of it if a single type of a topic that nobody asked for is unknown or incomplete."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise StoreError("Reading a bag needs rosbags; run pip install 'ringfence[ros]'.") from None
    if not path.exists():
        raise StoreError(f"There is no bag '{path}'; pass a .bag or .mcap file or a ROS 2 bag's folder.")
    first = path.suffix == ".bag" and not path.is_dir()
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        files = [file.name for end in ("bag", "mcap", "db3") for file in path.glob(f"*.{end}")]
        found = sorted([*files, *(file.parent.name for file in path.glob("*/metadata.yaml"))])
        hint = (
            f"pass one of {', '.join(found[:SHOWN])} in it" if found else "run ros2 bag reindex or pass another folder"
        )
        raise StoreError(f"'{path}' holds no metadata.yaml, so it is no ROS 2 bag; {hint}.")
    if not path.is_dir() and path.suffix not in (".bag", ".mcap", ".db3"):
        raise StoreError(f"'{path}' is no bag by its name; pass a .bag, .mcap or .db3 file or a ROS 2 bag's folder.")
    for file in path.iterdir() if path.is_dir() else (path,):
        if file.exists() and not file.is_file() and not file.is_dir():
            raise StoreError(f"'{file}' is no regular file; pass a bag that was copied whole.")
    try:
        reader = Reader1(path) if first else Reader2(path)
        reader.open()
    except Exception as error:  # a damaged file raises anything
        raise _damaged(path, error) from error
    try:
        topics: dict[str, list] = {}
        for connection in reader.connections:
            if not isinstance(connection.topic, str) or not isinstance(connection.msgtype, str):
                raise _damaged(path, ValueError(f"it names a topic {connection.topic!r}"))
            topics.setdefault(_name(connection.topic), []).append(connection)
        store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
        yield _File(path, reader, topics, store, store.deserialize_ros1 if first else store.deserialize_cdr)
    finally:
        with suppress(Exception):
            reader.close()


def _damaged(path: Path, error: Exception) -> StoreError:
    return StoreError(
        f"'{path}' is truncated, damaged or no bag ({_reason(error)}); copy it again, or reindex it if its recording "
        "broke off."
    )


def _reason(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:120].rstrip('.')}" if lines else type(error).__name__


# --- names ----------------------------------------------------------------------------------------------------------


def _name(topic: str) -> str:
    return "/" + topic.strip("/")


def _join(prefix: str, topic: str) -> str:
    return _name(f"{prefix}/{topic.strip('/')}")


def _prefixes(bag: _File, agents: str | Sequence[str], odom: str) -> list[str]:
    """Agents' prefixes, "" of topics at the root; those of a pattern are sorted, numbers as numbers."""
    if not isinstance(agents, str):
        prefixes = ["/" + prefix.strip("/") if prefix.strip("/") else "" for prefix in agents]
        if not prefixes or len(set(prefixes)) < len(prefixes):
            raise UserError(f"agents={list(agents)} is empty or names one twice; list every agent's prefix once.")
        return prefixes
    if "{" not in agents:
        return _prefixes(bag, [agents], odom)
    if agents.count("{i}") != 1 or "{" in agents.replace("{i}", ""):
        raise UserError(f"agents='{agents}' must hold {{i}} once, and no other braces; write it as '/robot_{{i}}'.")
    before, after = ("/" + agents.strip("/")).split("{i}")
    pattern = re.compile(rf"{re.escape(before)}(\w+){re.escape(after)}/{re.escape(odom.strip('/'))}")
    found = {match[1] for match in map(pattern.fullmatch, bag.topics) if match}
    if not found:
        raise StoreError(
            f"The pattern '{agents}' matches no agent: {bag.lacks(_join(agents, odom))}; pass another pattern or odom."
        )
    order = sorted(found, key=lambda word: (not word.isdecimal(), int(word) if word.isdecimal() else 0, word))
    return [f"{before}{word}{after}" for word in order]


def _cost_topics(bag: _File, prefixes: list[str], cost: str) -> list[str]:
    own, team = [_join(prefix, cost) for prefix in prefixes], _name(cost)
    if cost.startswith("/") or (team in bag.topics and not any(topic in bag.topics for topic in own)):
        return [team] * len(prefixes)
    return own


# --- time -----------------------------------------------------------------------------------------------------------


def _clock(path: Path, odometry: list[Topic], others: list[Topic], start: int, stamps: bool, notes: list[str]) -> Clock:
    """Times of all topics; refuses clocks that disagree and times that go backwards."""
    topics = [*odometry, *others]
    stamped = {t.name: t.stamps for t in topics if stamps and t.stamps is not None and t.stamps.any()}
    lags = {}  # of stamps behind the times of recording: (when, s)
    for t in topics:
        given = stamped[t.name] != 0 if t.name in stamped else np.ones(len(t.logged), bool)
        stamp = stamped.get(t.name, t.logged)
        lags[t.name] = t.logged[given] / 1e9, (t.logged - stamp)[given] / 1e9
    lead = next((t.name for t in odometry if t.name in stamped), odometry[0].name)
    for t in topics:
        if t in odometry or t.name in stamped:
            # compared where both were recorded, since a simulator's clock may run slower than the recorder's
            when, lag = lags[t.name]
            apart = float(np.median(np.abs(lag - np.interp(when, *lags[lead]))))
            if apart > CLOCK:
                raise StoreError(
                    f"'{path}': the stamps of '{t.name}' and '{lead}' come from clocks that are {apart:.3g} s apart "
                    f"({CLOCK:g} s are allowed); synchronise them, or pass stamps=False to take the times of recording."
                )
    foreign = float(np.median(np.abs(lags[lead][1]))) > CLOCK
    times = {}
    for t in topics:
        stamp = stamped.get(t.name, t.logged)
        times[t.name] = stamp if foreign else np.where(stamp == 0, t.logged, stamp)
        back = np.flatnonzero(np.diff(times[t.name]) < 0)
        if len(back):
            k = int(back[0]) + 1
            gap = (times[t.name][k - 1] - times[t.name][k]) / 1e9
            which = "header's stamp" if t.name in stamped else "time of recording"
            remedy = "pass stamps=False or cut the bag there" if t.name in stamped else "cut the bag there"
            raise StoreError(
                f"'{path}': the {which} of message {k} of '{t.name}' is {gap:.3g} s earlier than that of the one "
                f"before; times must not go backwards, so {remedy}."
            )
    if foreign:
        start = min(int(times[t.name][0]) for t in odometry)
        notes.append(
            f"stamps are {np.median(lags[lead][1]):.3g} s behind the times of recording, so they come from another "
            "clock; time counts from the first of them"
        )
    bare = [t.name for t in odometry if t.name not in stamped]
    if bare and stamps:
        notes.append(f"{', '.join(bare)} has no stamps, so its times are those of recording")
    return Clock(times, frozenset(stamped), foreign, start)


def _latest(rows: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(R,) which of `times` is the last at or before every row; -1 for none."""
    return np.searchsorted(times, rows, side="right") - 1


# --- columns --------------------------------------------------------------------------------------------------------


def _numbers(topic: Topic, names: Sequence[str]) -> np.ndarray:
    """(M, len(names)) float64, all of them finite."""
    values = np.array(topic.values, np.float64).reshape(-1, len(names))
    _finite(topic, np.arange(len(values)), values, names)
    return values


def _finite(topic: Topic, messages: np.ndarray, values: np.ndarray, names: Sequence[str]) -> None:
    bad = np.argwhere(~(np.abs(values) <= LARGEST))  # NaN is not, either
    if len(bad):
        row, entry = bad[0]
        raise StoreError(
            f"{names[entry]} of message {messages[row]} of '{topic.name}' is {values[row, entry]:g}; all numbers must "
            f"be finite and within {LARGEST:g}, so cut the bag there or mend its publisher."
        )


def _poses(topic: Topic, time: np.ndarray, twist: str, notes: list[str]) -> dict[str, np.ndarray]:
    """Columns (M,) of a topic's poses, and of its velocities if it is Odometry."""
    moves = topic.type == "nav_msgs/msg/Odometry"
    values = _numbers(topic, ("x", "y", "qx", "qy", "qz", "qw", *(TWIST if moves else ())))
    x, y, qx, qy, qz, qw = values[:, :6].T
    null = np.flatnonzero(np.linalg.norm(values[:, 2:6], axis=1) < 1e-6)
    if len(null):
        raise StoreError(
            f"The quaternion of message {null[0]} of '{topic.name}' has norm 0, which is no orientation; cut the bag "
            "there or let its publisher set w to 1."
        )
    # of degree two above and below, so the quaternion's norm cancels
    yaw = np.arctan2(2 * (qw * qz + qx * qy), qw**2 + qx**2 - qy**2 - qz**2)
    cos, sin = np.cos(yaw), np.sin(yaw)
    columns = {"time": time, "x": x, "y": y, "yaw": yaw, "cos_yaw": cos, "sin_yaw": sin}
    if not moves:
        return columns
    vx, vy, wz = values[:, 6:].T
    ways = {"child": np.stack([cos * vx - sin * vy, sin * vx + cos * vy], 1), "world": np.stack([vx, vy], 1)}
    _doubt(topic, time, values[:, :2], ways, twist, notes)
    return columns | {"vx": ways[twist][:, 0], "vy": ways[twist][:, 1], "wz": wz}


def _doubt(
    topic: Topic, time: np.ndarray, places: np.ndarray, ways: dict[str, np.ndarray], twist: str, notes: list[str]
) -> None:
    """Note where velocities follow clearly better from the positions if the twist is taken the other way."""
    step = np.diff(time)
    slope = np.diff(places, axis=0) / np.where(step > 0, step, np.inf)[:, None]
    moving = np.linalg.norm(slope, axis=1) > MOVING
    if moving.sum() < 20:
        return
    off = {
        way: float(np.median(np.linalg.norm((v[1:] + v[:-1]) / 2 - slope, axis=1)[moving])) for way, v in ways.items()
    }
    other = "world" if twist == "child" else "child"
    if off[twist] > MOVING and 2 * off[other] < off[twist]:
        notes.append(
            f"velocities of '{topic.name}' are {off[twist]:.2g} m/s off its positions' differences in the median, and "
            f"{off[other]:.2g} with twist='{other}'"
        )


def _frames(odometry: list[Topic], notes: list[str]) -> None:
    """Note frames that differ: robots' own frames begin where each was switched on."""
    frames = list(dict.fromkeys(f for t in odometry for f in t.frames))
    if len(frames) > 1:
        shown = ", ".join(f"'{f}'" for f in frames[:SHOWN]) + (" and more" if len(frames) > SHOWN else "")
        notes.append(f"poses are in {len(frames)} frames ({shown}); positions compare only if these have one origin")


def _joints(topic: Topic, agent: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """For every column of a topic of joint states: which messages tell it, and the values, both (K,)."""
    layouts: dict[tuple[str, ...], list[int]] = {}
    for k, (names, _, _) in enumerate(topic.values):
        layouts.setdefault(names, []).append(k)
    known = sorted({name for names in layouts for name in names})
    if not known or len(known) > JOINTS:
        raise StoreError(
            f"'{topic.name}' names {len(known)} joints, from 1 to {JOINTS} can be read; pass another joints."
        )
    leads = (f"{agent}/", f"{agent.rpartition('/')[2]}/", f"{agent.rpartition('/')[2]}_")
    lead = next((lead for lead in leads if all(name.startswith(lead) and name != lead for name in known)), "")

    pieces: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for names, messages in layouts.items():
        if len(set(names)) < len(names):
            raise StoreError(f"Message {messages[0]} of '{topic.name}' names a joint twice; mend its publisher.")
        for field, kind in ((1, "position"), (2, "velocity")):
            sizes = np.array([len(topic.values[k][field]) for k in messages])
            wrong = np.flatnonzero((sizes != 0) & (sizes != len(names)))
            if len(wrong):
                raise StoreError(
                    f"Message {messages[wrong[0]]} of '{topic.name}' names {len(names)} joints and gives "
                    f"{sizes[wrong[0]]} of {kind}; there must be none or one for each, so mend its publisher."
                )
            which = np.array(messages)[sizes > 0]
            if len(which) and names:
                values = np.stack([topic.values[k][field] for k in which]).astype(np.float64)
                for j, name in enumerate(names):
                    pieces.setdefault(f"{name.removeprefix(lead)}.{kind}", []).append((which, values[:, j]))
    columns = {}
    for column, found in pieces.items():
        which, values = (np.concatenate(part) for part in zip(*found))
        if not np.isnan(values).all():
            order = np.argsort(which)
            columns[column] = which[order], values[order]
            _finite(topic, which[order], values[order, None], [column])
    return columns


def _costs(topic: Topic, rows: np.ndarray, times: np.ndarray, agent: str, notes: list[str]) -> np.ndarray:
    """(R,) the largest cost after the row before and up to this one; where none came, the last one; 0 before any."""
    values = _numbers(topic, ["cost"])[:, 0]
    stops = np.searchsorted(times, rows, side="right")
    starts = np.concatenate([[0], stops[:-1]])
    fresh = stops > starts
    held = np.where(stops > 0, values[stops - 1], 0.0)
    costs = held.copy()
    if fresh.any():
        costs[fresh] = np.maximum.reduceat(values[: stops[-1]], starts[fresh])
    late = values[stops[-1] :]
    if late.any():
        notes.append(
            f"{len(late)} messages of '{topic.name}', of up to {late.max():g}, come after the last row of {agent} and "
            "count nowhere"
        )
    if (stops == 0).any():
        notes.append(f"{(stops == 0).sum()} rows of {agent} come before the first message of '{topic.name}' and cost 0")
    return costs
