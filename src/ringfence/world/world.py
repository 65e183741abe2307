"""The World as a value: parameters, the view that they read, and the card."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import equinox as eqx

from ringfence.features import FeatureMap
from ringfence.types import Array, Spec
from ringfence.world.barrier import Barrier, Worst
from ringfence.world.dynamics import Dynamics
from ringfence.world.values import Values


@dataclass(frozen=True, eq=False)
class Card:
    """What is known of a World: of which data, with which settings and seed, and how good on held-out episodes.
    `card["barrier"]["recall"]` and the like; `print(card)` says it in words (`card.py`)."""

    told: dict[str, Any]

    def __getitem__(self, name: str) -> Any:
        return self.told[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.told)

    def __str__(self) -> str:
        from ringfence.world.card import words

        return "\n".join(words(self.told))


class World(eqx.Module):
    """What the logs tell of a team. Features are s̃_i in the view of `map`; actions are in [−1, 1]."""

    dynamics: Dynamics
    values: Values
    barrier: Barrier | Worst | None  # None: the logs told no danger, and no formula did
    strange: Array  # () how far apart the ensemble is where the logs have not been: a conformal quantile
    map: FeatureMap = eqx.field(static=True)
    spec: Spec = eqx.field(static=True)
    alone: bool = eqx.field(static=True)  # of each agent's own view, for agents that hear of nobody
    card: Card = eqx.field(static=True)

    @property
    def limits(self) -> dict[str, float]:
        """Limit per episode of each constraint that the logs name; empty where they name none."""
        return self.card.told.get("data", {}).get("constraints") or {}
