"""What came of the episodes that a certificate is made of."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from ringfence.guards import Guard
from ringfence.problem.homogeneous import local_features
from ringfence.types import Array

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


def features(guard: Guard, homogeneous: bool, observations: Any, states: Any) -> Array:
    """(B, teams, N, D) what a guard's World sees of B moments; homogeneous agents are so many teams of one."""
    x = local_features(guard.world.map, homogeneous, observations, states)
    return x.reshape(len(states if observations is None else observations), -1, *x.shape[1:])


@jax.jit
def least_score(guard: Guard, before: Array, after: Array) -> Array:
    """(B,) of the steps between features (B, teams, N, D): of all agents and constraints."""
    scores = guard.barrier.now(before, after)
    return scores.reshape(len(scores), -1).min(-1)
