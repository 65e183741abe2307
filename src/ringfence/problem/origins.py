"""Origins: what logs were moved by where their numbers lie so far from 0 that single precision would blur their steps.

Everything here works on numbers of logs. At run time people give what they measure, coordinates of a map in metres,
say; the same origins are taken from these in double precision, once, where they come in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

FIELDS = ("observation_origins", "state_origins")  # of a store's card and a World's


@dataclass(frozen=True)
class Origins:
    """One number of each entry, which was taken from it; None: nothing was taken."""

    observations: tuple[float, ...] | None = None  # O
    state: tuple[float, ...] | None = None  # S

    @classmethod
    def of(cls, card: Mapping[str, Any]) -> Origins:
        """Those that a card's fields hold."""
        return cls(*(tuple(map(float, card[name])) if card.get(name) else None for name in FIELDS))

    def __bool__(self) -> bool:
        return self.observations is not None or self.state is not None

    def taken(self, observations: np.ndarray, state: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        """The inverse of `measured`, in single precision."""
        if self.observations is not None:
            observations = observations - np.asarray(self.observations)
        if self.state is not None and state is not None:
            state = state - np.asarray(self.state)
        return observations.astype(np.float32), None if state is None else state.astype(np.float32)

    def measured(self, observations: np.ndarray, state: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        """Observations (..., N, O) and state (..., S) as they were measured, in double precision where they were moved:
        what a function of somebody else's is asked with."""
        if self.observations is not None:
            observations = np.asarray(observations, np.float64) + self.observations
        if self.state is not None and state is not None:
            state = np.asarray(state, np.float64) + self.state
        return observations, state


NOWHERE = Origins()
