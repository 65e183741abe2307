"""The World: everything learned from logs before and without a policy: what actions do, what states are worth, what is
dangerous. One pytree, one file, one card that says how good each part is on held-out episodes."""

from __future__ import annotations

from ringfence.world.card import Card
from ringfence.world.model import World, load, save
from ringfence.world.settings import Settings

__all__ = ["Card", "Settings", "World", "load", "save"]
