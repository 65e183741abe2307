"""Replay: a policy judged by logs alone. One agent is driven by it, all others do what they did."""

from ringfence.evaluation.replay.drivers import DRIVERS
from ringfence.evaluation.replay.judge import replay
from ringfence.evaluation.replay.motion import KINEMATICS
from ringfence.evaluation.replay.result import ReplayResult, Row

__all__ = ["DRIVERS", "KINEMATICS", "ReplayResult", "Row", "replay"]
