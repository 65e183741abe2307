"""An open ROS bag: its topics, the types they must be of, and their messages as plain values.

ROS 1 bags (`.bag`), ROS 2 bags (a folder with metadata.yaml, sqlite3 or mcap inside) and bare `.mcap` and `.db3` files
are read by the library rosbags. A bag carries the definitions of its types. They are compared with the standard ones
and never compiled: bytes are read by rosbags' own definitions, so what a stranger's file defines runs nowhere, and
types of other topics do not matter.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.errors import StoreError

DEFINITION = 2**16  # characters of a type's definition
SHOWN = 8  # topics that a refusal lists


@dataclass(frozen=True, eq=False)
class Topic:
    """M messages of a topic, in the order of recording."""

    name: str
    type: str
    logged: np.ndarray  # (M,) ns, when the recorder received them
    stamps: np.ndarray | None  # (M,) ns in their headers, 0 where unset; None of types without a header
    values: list  # what the type's entry in `ROLES` makes of each
    frames: tuple[str, ...]  # frames that their headers name


# --- what is in a message ---
def _pose(position, orientation) -> tuple[float, ...]:
    return position.x, position.y, orientation.x, orientation.y, orientation.z, orientation.w, position.z


def _odometry(m) -> tuple[float, ...]:
    pose = m.pose.pose
    twist = m.twist.twist
    return *_pose(pose.position, pose.orientation), twist.linear.x, twist.linear.y, twist.angular.z


def _command(twist) -> tuple[float, ...]:
    return twist.linear.x, twist.linear.y, twist.angular.z


def _ackermann(drive) -> tuple[float, ...]:
    return drive.speed, drive.steering_angle


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
        "ackermann_msgs/msg/AckermannDrive": _ackermann,
        "ackermann_msgs/msg/AckermannDriveStamped": lambda m: _ackermann(m.drive),
    },
    "joints": {"sensor_msgs/msg/JointState": lambda m: (tuple(m.name), m.position, m.velocity)},
    "cost": {f"std_msgs/msg/{kind}": lambda m: (m.data,) for kind in ("Bool", "Float32", "Float64", "Int32")},
}


# What rosbags does not know of itself, as github.com/ros-drivers/ackermann_msgs defines it.
ACKERMANN = {
    "ackermann_msgs/msg/AckermannDrive": "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\n"
    "float32 acceleration\nfloat32 jerk\n",
    "ackermann_msgs/msg/AckermannDriveStamped": "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
}


def typestore(ros: int) -> Any:
    """Types of ROS 1 or ROS 2 that messages are read as."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for kind, definition in ACKERMANN.items():
        store.register(get_types_from_msg(definition, kind))
    return store


# --- the file ---
@dataclass
class _Gathered:
    """Messages of a topic while they are read."""

    name: str
    parse: Callable[[Any], Any]
    logged: list[int] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    frames: dict[str, None] = field(default_factory=dict)

    def take(self, time: int, message: Any) -> None:
        self.values.append(self.parse(message))
        header = getattr(message, "header", None)
        if header is not None:
            self.stamps.append(header.stamp.sec * 10**9 + header.stamp.nanosec)
            self.frames[header.frame_id] = None
        self.logged.append(time)

    def topic(self, kind: str) -> Topic:
        stamps = np.array(self.stamps, np.int64) if self.stamps else None
        logged = np.array(self.logged, np.int64)
        return Topic(self.name, kind, logged, stamps, self.values, tuple(self.frames))


@dataclass(frozen=True, eq=False)
class BagFile:
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
        gathered = {topic: _Gathered(topic, self._parser(topic, role)) for topic, role in roles.items()}
        for topic, kind, time, raw in self._messages([c for asked in roles for c in self.topics[asked]]):
            try:
                gathered[topic].take(time, self.message(raw, kind))
            except Exception as error:  # bytes that are no such message raise anything
                raise StoreError(
                    f"'{self.path}': message {len(gathered[topic].logged)} of '{topic}' is damaged "
                    f"({_reason(error)}); copy the bag again."
                ) from error
        for topic, messages in gathered.items():
            if not messages.logged:
                raise StoreError(
                    f"'{self.path}': the topic '{topic}' holds no messages; pass another topic or fewer agents."
                )
        try:
            return {topic: messages.topic(self.topics[topic][0].msgtype) for topic, messages in gathered.items()}
        except OverflowError as error:
            raise _damaged(self.path, error) from error

    def _messages(self, connections: list) -> Iterator[tuple[str, str, int, bytes]]:
        try:
            for connection, time, raw in self.reader.messages(connections):
                yield topic_name(connection.topic), connection.msgtype, time, raw
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
def opened(path: Path) -> Iterator[BagFile]:
    """The bag, whichever kind it is. rosbags' two readers are used rather than its AnyReader, which compiles what a bag
    defines, and opens none of it if a single type of a topic that nobody asked for is unknown or incomplete."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
    except ImportError:
        raise StoreError("Reading a bag needs rosbags; run pip install 'ringfence[ros]'.") from None
    _check_path(path)
    first = path.suffix == ".bag" and not path.is_dir()
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
            topics.setdefault(topic_name(connection.topic), []).append(connection)
        store = typestore(1 if first else 2)
        yield BagFile(path, reader, topics, store, store.deserialize_ros1 if first else store.deserialize_cdr)
    finally:
        with suppress(Exception):
            reader.close()


def _check_path(path: Path) -> None:
    """Refuse what is no bag by its name or its files."""
    if not path.exists():
        raise StoreError(f"There is no bag '{path}'; pass a .bag or .mcap file or a ROS 2 bag's folder.")
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


def _damaged(path: Path, error: Exception) -> StoreError:
    return StoreError(
        f"'{path}' is truncated, damaged or no bag ({_reason(error)}); copy it again, or reindex it if its recording "
        "broke off."
    )


def _reason(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:120].rstrip('.')}" if lines else type(error).__name__


# --- names ---
def topic_name(topic: str) -> str:
    return "/" + topic.strip("/")


def joined(prefix: str, topic: str) -> str:
    return topic_name(f"{prefix}/{topic.strip('/')}")
