"""What came of the episodes that a certificate is made of."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

Part = Literal["calibration", "test"]


class Trials(NamedTuple):
    """E episodes, or windows of logs."""

    violated: np.ndarray  # (E,) bool
    shortfall: np.ndarray  # (E,)
    infeasible: float  # share of steps in which the guard could not do what it should


def shortfall(foreseen: np.ndarray, came: np.ndarray, late: int) -> np.ndarray:
    """(E,) by how much what came scored less than what was foreseen, at worst; 0 where never. Scores (E, L) are of the
    states that actions lead to, which act so many steps late."""
    foreseen = foreseen[:, : foreseen.shape[1] - late]
    return np.maximum(foreseen - came[:, late:], 0.0).max(1)
