"""Simulators, batched and deterministic given their key."""

from ringfence.envs.crossing import Crossing
from ringfence.envs.mujoco import SafeMuJoCo
from ringfence.envs.proving import System
from ringfence.envs.simple_spread import SimpleSpread, SpreadAlike, SpreadState

__all__ = ["Crossing", "SafeMuJoCo", "SimpleSpread", "SpreadAlike", "SpreadState", "System"]
