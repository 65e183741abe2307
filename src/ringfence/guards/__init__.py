"""The guard: takes a World and proposals, gives the action. Any policy can have it."""

from __future__ import annotations

from ringfence.guards.barrier import BARRIERS, BarrierSource
from ringfence.guards.filter import Guard
from ringfence.guards.options import GUARDS, GuardOptions
from ringfence.guards.policy import Guarded, options_of

__all__ = [
    "BARRIERS",
    "GUARDS",
    "BarrierSource",
    "Guard",
    "GuardOptions",
    "Guarded",
    "options_of",
]
