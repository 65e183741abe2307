"""The World: everything learned from logs before and without a policy: what actions do, what states are worth, what is
dangerous. One pytree, one file, one card that says how good each part is on held-out episodes."""

from __future__ import annotations

from ringfence.world.fitting import Settings, load, save
from ringfence.world.world import Card, World

__all__ = ["Card", "Settings", "World", "load", "save"]
