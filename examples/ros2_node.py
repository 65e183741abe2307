"""A policy that `ringfence export RUN --out policy.onnx` wrote, on N robots under ROS 2, without this library.

    python ros2_node.py policy.onnx robot0 robot1 robot2       # /robot0/odom, /robot0/goal -> /robot0/cmd_vel, ...

Needs rclpy, onnxruntime and NumPy. Everything is read in one frame, and an action is taken for a velocity (m/s) in it:
change `command` where yours is something else. Nothing is sent before every robot was heard and has a goal.

What was done is kept in evidence.log and published on /evidence, a record a step, each with a digest of the one before:
`ringfence log verify evidence.log` tells whether it is what was written.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import time
from pathlib import Path

import numpy as np
import onnxruntime

PERIOD = 0.1  # s between actions: that of the logs


class Pilot:
    """The file at run time: memory is carried from step to step, noise is drawn."""

    def __init__(self, file: str, seed: int = 0):
        self.session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
        self.facts = json.loads(self.session.get_modelmeta().custom_metadata_map["ringfence"])
        self.rng = np.random.default_rng(seed)
        self.info: dict[str, float] = {}
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        inputs = {x["name"]: x for x in self.facts["inputs"]}
        fill = lambda x, value: np.broadcast_to(np.asarray(value, x["dtype"]), x["shape"]).copy()  # noqa: E731
        self.memory = {name: fill(inputs[name], value) for name, value in self.facts["initial"].items()}

    def act(self, observations, state=None, cost: float | np.ndarray = np.nan) -> np.ndarray:
        """(N, A) from (N, O), (S,) and what the last step cost, in all or of each named constraint, where anybody knows."""
        given = {"observations": observations, "state": state, "cost": cost, **self.memory}
        draw = lambda x: self.rng.standard_normal(x["shape"])  # noqa: E731
        feed = {
            x["name"]: np.asarray(given[x["name"]] if x["name"] in given else draw(x), x["dtype"])
            for x in self.facts["inputs"]
        }
        names = [x["name"] for x in self.facts["outputs"]]
        out = dict(zip(names, self.session.run(names, feed)))
        self.memory = {f"memory.{k[5:]}": v for k, v in out.items() if k.startswith("next.")}
        self.info = {k[5:]: v.item() for k, v in out.items() if k.startswith("info.")}
        return out["action"]


class Evidence:
    """Records that show whether they were changed (docs/certificates.md): a line of "DIGEST JSON" each."""

    def __init__(self, file: str, policy: str):
        self.file, self.last, self.n = open(file, "xb", buffering=0), "ringfence log 1", 0  # never over an older one
        digest = hashlib.blake2b(Path(policy).read_bytes(), digest_size=8).hexdigest()
        self.add({"kind": "begin", "t": time.time(), "policy": digest})

    def add(self, record: dict) -> str:
        """The line that was written."""
        body = json.dumps({"n": self.n, **record}, separators=(",", ":"))
        self.last = hashlib.blake2b(f"{self.last} {body}".encode(), digest_size=16).hexdigest()
        self.file.write(f"{self.last} {body}\n".encode())
        self.n += 1
        return f"{self.last} {body}"


def observed(names: list[str], place: np.ndarray, speed: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """(N, O) what every robot sees, by the logs' names (own.vx, goal.dx, other0.dy, other1.dvx); arrays are (N, 2)."""
    n, rows = len(place), []
    for i in range(n):
        others = [j for j in range(n) if j != i]
        row = []
        for name in names:
            found = re.fullmatch(r"(own|goal|other)(\d*)\.(d?)(v?)([xy])", name)
            if found is None:
                raise SystemExit(f"The policy reads '{name}', which odometry does not tell; compute it in observed().")
            who, number, apart, fast, axis = found.groups()
            axis, table = "xy".index(axis), speed if fast else place
            there = goal[i, axis] if who == "goal" else table[others[int(number)] if who == "other" else i, axis]
            row.append(there - table[i, axis] if apart else there)
        rows.append(row)
    return np.asarray(rows, np.float32)


def check(robots: list[str], agents: list[str]) -> None:
    """Refuse robots whose rows the policy would take for others': the logs know their names in another order."""
    for robot, agent in zip(robots, agents):
        if robot != agent and robot in agents:
            raise SystemExit(f"{robot} stands where the logs have {agent}; name robots in this order: {agents}.")


def main(file: str, robots: list[str]) -> None:
    import rclpy
    from geometry_msgs.msg import PointStamped, Twist
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from std_msgs.msg import String

    class Team(Node):
        def __init__(self):
            super().__init__("ringfence")
            self.pilot, nowhere = Pilot(file), np.full((len(robots), 2), np.nan)
            check(robots, self.pilot.facts["names"].get("agents", []))
            self.place, self.speed, self.goal = nowhere, nowhere.copy(), nowhere.copy()
            self.senders = [self.create_publisher(Twist, f"/{name}/cmd_vel", 1) for name in robots]
            for i, name in enumerate(robots):
                self.create_subscription(Odometry, f"/{name}/odom", lambda m, i=i: self.heard(m, i), 1)
                self.create_subscription(PointStamped, f"/{name}/goal", lambda m, i=i: self.sent(m, i), 1)
            self.evidence = Evidence("evidence.log", file)
            self.recorder = self.create_publisher(String, "/evidence", 10)
            self.create_timer(PERIOD, self.step)

        def heard(self, m: Odometry, i: int) -> None:
            self.place[i] = m.pose.pose.position.x, m.pose.pose.position.y
            self.speed[i] = m.twist.twist.linear.x, m.twist.twist.linear.y

        def sent(self, m: PointStamped, i: int) -> None:
            self.goal[i] = m.point.x, m.point.y

        def step(self) -> None:
            if np.isfinite([self.place, self.speed, self.goal]).all():
                seen = observed(self.pilot.facts["names"]["observations"], self.place, self.speed, self.goal)
                begun, actions = time.perf_counter(), self.pilot.act(seen)
                ms = 1e3 * (time.perf_counter() - begun)
                known = {"observed": seen.tolist(), "executed": actions.tolist(), "info": self.pilot.info}
                record = self.evidence.add({"kind": "step", "t": time.time(), "ms": ms} | known)
                self.recorder.publish(String(data=record))
                for sender, action in zip(self.senders, actions):
                    sender.publish(self.command(action))

        def command(self, action: np.ndarray) -> Twist:
            command = Twist()
            command.linear.x, command.linear.y = map(float, action[:2])
            return command

    rclpy.init()
    rclpy.spin(Team())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
