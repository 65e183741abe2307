"""The guard: takes a World and proposals, gives the action. Any policy can have it."""

from __future__ import annotations

from ringfence.guards.danger import DANGERS, Danger
from ringfence.guards.guard import GUARDS, Guard, GuardOptions
from ringfence.guards.policy import Guarded, Pilot, guard, options_of

__all__ = ["DANGERS", "GUARDS", "Danger", "Guard", "GuardOptions", "Guarded", "Pilot", "guard", "options_of"]
