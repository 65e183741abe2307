"""Simulators, batched and deterministic given their key."""

from ringfence.envs.simple_spread import SimpleSpread, SpreadState

__all__ = ["SimpleSpread", "SpreadState"]
