"""Replay: a policy judged by logs alone. One agent is driven by it, all others do what they did."""

from ringfence.evaluation.replay.judge import ReplayResult, Row, replay
from ringfence.evaluation.replay.stage import DRIVERS, KINEMATICS

__all__ = ["DRIVERS", "KINEMATICS", "ReplayResult", "Row", "replay"]
