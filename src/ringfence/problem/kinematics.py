"""How logged places follow from logged velocities."""

from __future__ import annotations

import numpy as np

TURNS = 0.01  # of the largest velocity: a smaller change tells nothing
FEW = 20  # changes, below which nothing is said
AGREE = 0.025  # of a share
USUAL = 0.2  # share of the changes that has to agree


def late_share(moved: np.ndarray, before: np.ndarray, after: np.ndarray, dt: float) -> float | None:
    """The share c of a step of `dt` seconds that bodies go with their next velocity, as logged: a place moves by
    ((1 − c) v + c v′) dt. Logs differ: a velocity is what a simulator goes on with, the mean of a step, or the
    difference to the place before. All three of any shape; None where the logs do not say.

    It is the most frequent share and no mean: where others are listed by distance, a place in the list may change its
    owner from one row to the next.
    """
    change = ((after - before) * dt).ravel()
    rest = (moved - before * dt).ravel()
    turns = np.abs(change) > TURNS * max(float(np.abs(before).max(initial=0.0)) * dt, 1e-9)
    if turns.sum() < FEW:
        return None
    share = rest[turns] / change[turns]
    tried = np.linspace(0, 1, 21)
    agree = np.array([(np.abs(share - one) < AGREE).mean() for one in tried])
    return float(round(tried[agree.argmax()], 2)) if agree.max() > USUAL else None
