"""Read ROS bags into one table: a row for every agent and message of its odometry, with the command at that time.

Fields and units are those of ROS's common interfaces (nav_msgs, geometry_msgs, sensor_msgs, std_msgs): metres, radians,
seconds, and a twist that Odometry gives in the frame of the robot. `bagfile.py` says what is read of a stranger's file.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ringfence.errors import StoreError, UserError
from ringfence.logs.io.bagfile import ROLES, SHOWN, BagFile, Topic, joined, opened, topic_name
from ringfence.logs.io.tracks import PASSED_OVER
from ringfence.utils.files import place
from ringfence.utils.text import natural

TWIST = ("vx", "vy", "wz")
COMMAND = ("cmd_vx", "cmd_vy", "cmd_wz")
CMD = "cmd_vel"
STEERED = ("cmd_speed", "cmd_steering")
CLOCK = 1.0  # s; stamps further from the times of recording come from another clock than the recorder's
LATE = 5.0  # s; a stamp so much further from its time of recording than the topic's others is of another time
JOINTS = 1000  # names of joints that a topic may hold
LARGEST = 1e30  # of any number; a store holds float32
LEVEL = 0.5  # m; what changes its height by more does not move in a plane
MOVING = 0.05  # m/s; slower rows do not tell in which frame a twist is


@dataclass(frozen=True, eq=False)
class Bag:
    """The table of a bag: R rows, agent by agent and in the order of time.

    `columns` holds arrays (R,): `time` (s), `agent` (str), `x`, `y` (m), `yaw` (rad, in [-pi, pi]), `cos_yaw`,
    `sin_yaw`; of Odometry `vx`, `vy` (m/s, in the world frame) and `wz` (rad/s); `cmd_vx`, `cmd_vy` (m/s) and `cmd_wz`
    (rad/s) as commanded, in the robot's frame, or `cmd_speed` (m/s) and `cmd_steering` (rad) of a car;
    `<joint>.position`, `<joint>.velocity` and `cost` where asked for.
    `state` and `action` name the columns that are natural as such: no angle that wraps, no command that is always 0.
    Of a bag without commands `action` is empty, and a table's actions are accelerations then.
    `notes` say what was dropped or is doubtful.
    """

    columns: dict[str, np.ndarray]
    state: tuple[str, ...]
    action: tuple[str, ...]
    agents: tuple[str, ...]
    notes: tuple[str, ...]


def read_bag(
    path: str | os.PathLike,
    agents: str | Sequence[str],
    *,
    odom: str = "odom",
    cmd: str | None = None,
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
    * `cmd`: geometry_msgs Twist or TwistStamped, or ackermann_msgs AckermannDrive or AckermannDriveStamped; by default
      `cmd_vel`, or nothing where no agent has that topic. A row holds the last command at or before it; rows
      before the first are dropped, and a note counts them.
    * `joints`: sensor_msgs JointState, held likewise, joint by joint. Where all names of an agent's joints begin with
      its own name, that is left out, so that agents have the same columns. What is NaN throughout was not measured.
    * `cost`: std_msgs Bool, Float32, Float64 or Int32 of each agent, or of the team if it begins with a slash or exists
      without prefix only. A row's cost is the largest since the agent's row before; if none came, the last one stands.

    `time` counts from the bag's first message. It is the header's stamp, and where that is missing or zero the time of
    recording; `stamps=False` takes the latter throughout. Where stamps come from another clock than the recorder's,
    they count from the first of them, and messages without stamps are placed among rows by the times of recording.

    Refuses with `UserError` what cannot be read so, before anything is made of it.
    """
    path = place(path)
    if twist not in ("child", "world"):
        raise UserError(f"twist='{twist}' is unknown; choose child (the robot's frame, ROS's rule) or world.")
    with opened(path) as bag:
        notes: list[str] = []
        asked = _asked_of(bag, _prefixes(bag, agents, odom, cmd or CMD, notes), odom, cmd, joints, cost)
        topics = bag.read({own[role]: role for role in ROLES for _, own in asked if role in own})
        start = bag.start(topics)
    robots = [_Robot(name, **{role: topics[topic] for role, topic in own.items()}) for name, own in asked]
    clock = _clock(path, robots, topics, start, stamps, notes)
    return _table(path, robots, clock, twist, notes)


def _table(path: Path, robots: list[_Robot], clock: Clock, twist: str, notes: list[str]) -> Bag:
    """All robots' rows, one robot after another, and which columns are natural as state and action."""
    frames = list(dict.fromkeys(frame for robot in robots for frame in robot.odom.frames))
    if len(frames) > 1:  # robots' own frames begin where each was switched on
        shown = ", ".join(f"'{f}'" for f in frames[:SHOWN]) + (" and more" if len(frames) > SHOWN else "")
        notes.append(f"poses are in {len(frames)} frames ({shown}); positions compare only if these have one origin")
    _refuse_two_kinds(path, robots)
    heights = np.concatenate([[value[6] for value in robot.odom.values] for robot in robots])
    if np.ptp(heights) > LEVEL:
        low, high = heights.min(), heights.max()
        notes.append(f"bags are read in the plane: z, which goes from {low:.4g} to {high:.4g} m, is left out")
    parts = [_columns_of(path, robot, clock, twist, notes) for robot in robots]
    _refuse_other_joints(path, robots, parts)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in ("time", *parts[0])}
    command = tuple(name for name in (*COMMAND, *STEERED) if name in columns)
    action = tuple(name for name in command if columns[name].any()) or command
    if action != command:
        still = ", ".join(name for name in command if name not in action)
        notes.append(f"no action, since zero in every row: {still}")
    if not command:
        notes.append(f"no agent has the topic '{CMD}', and no other cmd was given")
    state = tuple(name for name in columns if name not in ("time", "agent", "yaw", "cost", *command))
    return Bag(columns, state, action, tuple(robot.name for robot in robots), tuple(notes))


# --- agents ---
@dataclass(frozen=True, eq=False)
class _Robot:
    """An agent and its messages."""

    name: str
    odom: Topic
    cmd: Topic | None = None
    joints: Topic | None = None
    cost: Topic | None = None


def _asked_of(
    bag: BagFile, prefixes: list[str], odom: str, cmd: str | None, joints: str | None, cost: str | None
) -> list[tuple[str, dict[str, str]]]:
    """Every agent's name, and its topics by role; one with poses and without commands, which others have, is refused by
    its name."""
    if cmd is None and any(joined(prefix, CMD) in bag.topics for prefix in prefixes):
        cmd = CMD
    costs = [] if cost is None else [joined(prefix, cost) for prefix in prefixes]
    team = "" if cost is None else topic_name(cost)
    if cost is not None and (cost.startswith("/") or (team in bag.topics and not {*costs} & {*bag.topics})):
        costs = [team] * len(prefixes)
    found = []
    for k, prefix in enumerate(prefixes):
        name = prefix.strip("/") or "robot"
        topics = {"odom": joined(prefix, odom)}
        if cmd is not None:
            topics["cmd"] = joined(prefix, cmd)
        if topics["odom"] in bag.topics and "cmd" in topics and topics["cmd"] not in bag.topics:
            raise StoreError(
                f"The agent '{name}' has no commands: {bag.lacks(topics['cmd'])}; pass another cmd or fewer agents."
            )
        if joints is not None:
            topics["joints"] = joined(prefix, joints)
        if cost is not None:
            topics["cost"] = costs[k]
        roles = {topic: [role for role in topics if topics[role] == topic] for topic in topics.values()}
        for topic, shared in roles.items():
            if len(shared) > 1:
                raise UserError(f"{' and '.join(shared)} of '{name}' are one topic, '{topic}'; give each its own.")
        found.append((name, topics))
    return found


def _prefixes(bag: BagFile, agents: str | Sequence[str], odom: str, cmd: str, notes: list[str]) -> list[str]:
    """Agents' prefixes, "" of topics at the root; those of a pattern in natural order, without such as have commands
    and no poses."""
    if not isinstance(agents, str):
        prefixes = ["/" + prefix.strip("/") if prefix.strip("/") else "" for prefix in agents]
        if not prefixes or len(set(prefixes)) < len(prefixes):
            raise UserError(f"agents={list(agents)} is empty or names one twice; list every agent's prefix once.")
        return prefixes
    if "{" not in agents:
        return _prefixes(bag, [agents], odom, cmd, notes)
    if agents.count("{i}") != 1 or "{" in agents.replace("{i}", ""):
        raise UserError(f"agents='{agents}' must hold {{i}} once, and no other braces; write it as '/robot_{{i}}'.")
    before, after = ("/" + agents.strip("/")).split("{i}")

    def having(topic: str) -> set[str]:
        pattern = re.compile(rf"{re.escape(before)}(\w+){re.escape(after)}/{re.escape(topic.strip('/'))}")
        return {match[1] for match in map(pattern.fullmatch, bag.topics) if match}

    found = having(odom)
    if found and (unseen := having(cmd) - found):
        names = ", ".join(f"{before}{word}{after}" for word in sorted(unseen, key=natural)[:SHOWN])
        notes.append(f"left out, since they have commands and no poses: {names}")
    if not found:
        raise StoreError(
            f"The pattern '{agents}' matches no agent: {bag.lacks(joined(agents, odom))}; pass another pattern or odom."
        )
    return [f"{before}{word}{after}" for word in sorted(found, key=natural)]


# --- time ---
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


def _clock(
    path: Path, robots: list[_Robot], read: dict[str, Topic], start: int, stamps: bool, notes: list[str]
) -> Clock:
    """Times of all topics; refuses clocks that disagree and times that go backwards."""
    odometry = [robot.odom for robot in robots]
    poses = {topic.name for topic in odometry}
    topics = [*odometry, *(topic for name, topic in read.items() if name not in poses)]
    stamped = {t.name: t.stamps for t in topics if stamps and t.stamps is not None and t.stamps.any()}
    lags = {t.name: _Lag.of(t, stamped.get(t.name)) for t in topics}
    lead = next((t.name for t in odometry if t.name in stamped), odometry[0].name)
    for topic in topics:
        if topic in odometry or topic.name in stamped:
            _refuse_another_clock(path, topic.name, lags[topic.name], lead, lags[lead])
    behind = float(np.median(lags[lead].seconds))
    foreign = float(np.median(np.abs(lags[lead].seconds))) > CLOCK
    for topic in topics:
        if topic.name in stamped and not (foreign and topic in odometry):
            _refuse_late(path, topic.name, lags[topic.name], lags[lead], foreign)
    times = {t.name: t.logged for t in topics}
    for name, given in stamped.items():  # where stamps are not set the times of recording, if both are of one clock
        times[name] = given if foreign else np.where(given == 0, times[name], given)
    for topic in topics:
        _refuse_backwards(path, topic.name, times[topic.name], topic.name in stamped)
    if foreign:
        start = min(int(times[t.name][0]) for t in odometry)
        notes.append(
            f"stamps are {behind:.3g} s behind the times of recording, so they come from another clock; time counts "
            "from the first of them"
        )
    bare_commands = {robot.odom.name for robot in robots if robot.cmd is not None and robot.cmd.name not in stamped}
    for topic in [t for t in odometry if t.name in stamped and len(t.logged) > 1 and not foreign]:
        lag = lags[topic.name].seconds
        usual, most = float(np.median(lag)), float(np.abs(lag - np.median(lag)).max())
        step = float(np.median(np.diff(topic.logged))) / 1e9
        if abs(usual) > step and (len(odometry) > 1 or topic.name in bare_commands):
            notes.append(
                f"stamps of '{topic.name}' are {usual:.3g} s behind the times of recording, more than a row, and are "
                "believed; pass stamps=False if its clock is wrong"
            )
        if most > CLOCK:
            notes.append(f"stamps of '{topic.name}' jump by up to {most:.3g} s; see whether its clock was set")
    bare = [t.name for t in odometry if t.name not in stamped]
    if bare and stamps:
        notes.append(f"{', '.join(bare)} has no stamps, so its times are those of recording")
    return Clock(times, frozenset(stamped), foreign, start)


class _Lag(NamedTuple):
    """Of stamps behind the times of recording, where there are stamps."""

    when: np.ndarray  # s, of recording
    seconds: np.ndarray

    @classmethod
    def of(cls, topic: Topic, stamps: np.ndarray | None) -> _Lag:
        if stamps is None:
            return cls(topic.logged / 1e9, np.zeros(len(topic.logged)))
        given = stamps != 0
        return cls(topic.logged[given] / 1e9, (topic.logged - stamps)[given] / 1e9)


def _refuse_another_clock(path: Path, name: str, lag: _Lag, lead: str, lag_of_lead: _Lag) -> None:
    """Compared where both were recorded, since a simulator's clock may run slower than the recorder's."""
    apart = float(np.median(np.abs(lag.seconds - np.interp(lag.when, *lag_of_lead))))
    if apart > CLOCK:
        raise StoreError(
            f"'{path}': the stamps of '{name}' and '{lead}' come from clocks that are {apart:.3g} s apart "
            f"({CLOCK:g} s are allowed); synchronise them, or pass stamps=False to take the times of recording."
        )


def _refuse_late(path: Path, name: str, lag: _Lag, lag_of_lead: _Lag, foreign: bool) -> None:
    """Single messages, as a buffer, a latched topic or a clock that was set makes them."""
    usual = np.interp(lag.when, *lag_of_lead) if foreign else np.median(lag.seconds)
    late = np.abs(lag.seconds - usual)
    if len(late) and late.max() > LATE:
        k = int(late.argmax())
        raise StoreError(
            f"'{path}': the stamp of a message of '{name}', {lag.when[k] - lag.when[0]:.3g} s after its first, is "
            f"{late[k]:.3g} s off the topic's others ({LATE:g} s are allowed); cut the bag there, or pass stamps=False "
            "to take the times of recording."
        )


def _refuse_backwards(path: Path, name: str, times: np.ndarray, stamped: bool) -> None:
    back = np.flatnonzero(np.diff(times) < 0)
    if not len(back):
        return
    k = int(back[0]) + 1
    gap = (times[k - 1] - times[k]) / 1e9
    which = "header's stamp" if stamped else "time of recording"
    remedy = "pass stamps=False or cut the bag there" if stamped else "cut the bag there"
    raise StoreError(
        f"'{path}': the {which} of message {k} of '{name}' is {gap:.3g} s earlier than that of the one before; times "
        f"must not go backwards, so {remedy}."
    )


def _latest(rows: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(R,) which of `times` is the last at or before every row; -1 for none."""
    return np.searchsorted(times, rows, side="right") - 1


# --- columns ---
def _columns_of(path: Path, robot: _Robot, clock: Clock, twist: str, notes: list[str]) -> dict[str, np.ndarray]:
    """Columns (R,) of an agent: a row for every message of its poses before which there was a command."""
    rows = robot.odom
    times = clock.times[rows.name]
    again = int((np.diff(times) == 0).sum())
    if again:
        notes.append(f"{again} rows of {robot.name} have the time of the row before")
    columns = {"agent": np.full(len(times), robot.name)}
    columns |= _poses(rows, (times - clock.origin) / 1e9, twist, notes)
    known = np.ones(len(times), bool)
    if robot.cmd is not None:
        latest = _latest(*clock.align(rows, robot.cmd))
        command = _command_of(robot.cmd)
        given = _numbers(robot.cmd, command)
        commands = given[latest]
        _note_passed_over(robot.name, given, latest, notes)
        columns |= {name: commands[:, i] for i, name in enumerate(command)}
        known = latest >= 0
    if robot.joints is not None:
        row_times, joint_times = clock.align(rows, robot.joints)
        joints = _joints(robot.joints, robot.name)
        for name in sorted(joints, key=natural):
            which, values = joints[name]
            latest = _latest(row_times, joint_times[which])
            columns[name] = values[latest]
            known &= latest >= 0
    if robot.cost is not None:
        columns["cost"] = _costs(robot.cost, *clock.align(rows, robot.cost), robot.name, notes)
    _note_unknown(path, robot, known, notes)
    return {name: column[known] for name, column in columns.items()}


def _note_passed_over(name: str, given: np.ndarray, latest: np.ndarray, notes: list[str]) -> None:
    """Commands (M, C) that no row holds and that differ from the next."""
    held = np.zeros(len(given), bool)
    held[latest[latest >= 0]] = True
    between = ~held & np.append((given[1:] != given[:-1]).any(1), False) & (np.arange(len(given)) < latest.max())
    if between.sum() > PASSED_OVER * len(given):
        notes.append(f"{between.sum()} of {len(given)} commands of {name} came between its rows, and count nowhere")


def _command_of(topic: Topic) -> tuple[str, ...]:
    return STEERED if topic.type.startswith("ackermann_msgs/") else COMMAND


def _note_unknown(path: Path, robot: _Robot, known: np.ndarray, notes: list[str]) -> None:
    """Rows of which no command, or no state of some joint, is known."""
    held = [] if robot.cmd is None else ["command"]
    held += [] if robot.joints is None else ["states of all joints"]
    before = " and ".join(held)
    if not known.any():
        what = before.replace("command", "commands").replace("states of all joints", "joints")
        raise StoreError(
            f"'{path}': all {len(known)} messages of '{robot.odom.name}' are older than the first of its {what}; pass "
            "fewer agents."
        )
    if not known.all():
        notes.append(f"{(~known).sum()} rows of {robot.name} before its first {before} were dropped")


def _refuse_two_kinds(path: Path, robots: list[_Robot]) -> None:
    """Of odometry, and of commands."""
    first = robots[0].odom
    if len({robot.odom.type == "nav_msgs/msg/Odometry" for robot in robots}) > 1:
        raise StoreError(
            f"'{path}': '{first.name}' is {first.type} and others are not, so only some agents have velocities; pass "
            "fewer agents or another odom."
        )
    commands = [robot.cmd for robot in robots if robot.cmd is not None]
    other = next((topic for topic in commands if _command_of(topic) != _command_of(commands[0])), None)
    if other is not None:
        raise StoreError(
            f"'{path}': '{commands[0].name}' is {commands[0].type} and '{other.name}' is {other.type}; agents need the "
            "same commands, so pass fewer agents."
        )


def _refuse_other_joints(path: Path, robots: list[_Robot], parts: list[dict[str, np.ndarray]]) -> None:
    first = parts[0].keys()
    for robot, part in zip(robots, parts):
        if part.keys() == first:
            continue
        other = min(part.keys() ^ first)
        having, lacking = (robot.name, robots[0].name) if other in part else (robots[0].name, robot.name)
        raise StoreError(
            f"'{path}': '{having}' has the joint column '{other}' and '{lacking}' has not; agents need the same "
            "joints, so pass fewer agents or leave joints out."
        )


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
    values = _numbers(topic, ("x", "y", "qx", "qy", "qz", "qw", "z", *(TWIST if moves else ())))
    x, y, qx, qy, qz, qw, _ = values[:, :7].T
    null = np.flatnonzero(np.linalg.norm(values[:, 2:6], axis=1) < 1e-6)
    if len(null):
        raise StoreError(
            f"The quaternion of message {null[0]} of '{topic.name}' has norm 0, which is no orientation; cut the bag "
            "there or let its publisher set w to 1."
        )
    # of degree two above and below, so the quaternion's norm cancels
    yaw = np.arctan2(2 * (qw * qz + qx * qy), qw**2 + qx**2 - qy**2 - qz**2)
    cos = np.cos(yaw)
    sin = np.sin(yaw)
    columns = {"time": time, "x": x, "y": y, "yaw": yaw, "cos_yaw": cos, "sin_yaw": sin}
    if not moves:
        return columns
    vx, vy, wz = values[:, 7:].T
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
