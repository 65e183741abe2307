"""Who drives badly on purpose, and a brake that needs no World."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ringfence.evaluation.replay.motion import SLOW, Kinematics

AHEAD = 1.0  # s that the brake looks ahead, beside the time that stopping takes
ROOM = 1.15  # radii that it keeps


@dataclass(frozen=True, eq=False)
class Now:
    """The driven agents of W windows at one moment, along X axes; others as they were logged."""

    velocity: np.ndarray  # (W, X) m/s
    heading: np.ndarray  # (W,)
    begun: np.ndarray  # (W, X) velocity at the window's beginning
    goal: np.ndarray  # (W, X) m from here
    others: np.ndarray  # (W, K, X) m from here
    others_move: np.ndarray  # (W, K, X) m/s
    max_speed: float


def _along(vector: np.ndarray, speed: np.ndarray | float) -> np.ndarray:
    far = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector / np.maximum(far, 1e-6) * np.reshape(speed, (-1, 1))


def _straight(now: Now) -> np.ndarray:
    return now.begun


def _accelerate(now: Now) -> np.ndarray:
    ahead = np.zeros_like(now.velocity)
    ahead[:, :2] = np.stack([np.cos(now.heading), np.sin(now.heading)], -1)
    if ahead.shape[1] > 2:  # in space, where it flies; who hovers goes where it is turned to
        flies = np.linalg.norm(now.velocity, axis=-1, keepdims=True) > SLOW
        ahead = np.where(flies, now.velocity, ahead)
    return _along(ahead, now.max_speed)


def _hasty(now: Now) -> np.ndarray:
    return _along(now.goal, now.max_speed)


def _seek(now: Now) -> np.ndarray:
    nearest = np.linalg.norm(now.others, axis=-1).argmin(-1)
    return _along(now.others[np.arange(len(nearest)), nearest], now.max_speed)


# The velocity (W, X) that each of them wants: hold speed and course; speed up ahead; to the goal, fast; to the nearest.
DRIVERS: dict[str, Callable[[Now], np.ndarray]] = {
    "straight": _straight,
    "accelerate": _accelerate,
    "hasty": _hasty,
    "seek": _seek,
}


def braked(now: Now, action: np.ndarray, kinematics: Kinematics, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Actions (W, A), or full braking where everybody's constant velocity leads to contact before one could stop; and
    where that is (W,)."""
    still = np.zeros_like(now.velocity)
    _, after, _ = kinematics.moved(still, now.velocity, now.heading, action, now.velocity)
    closing = now.others_move - after[:, None]
    time = -(now.others * closing).sum(-1) / np.maximum((closing**2).sum(-1), 1e-9)
    ahead = AHEAD + np.linalg.norm(after, axis=-1, keepdims=True) / kinematics.brakes
    time = np.clip(time, 0.0, ahead)
    miss = np.linalg.norm(now.others + closing * time[..., None], axis=-1).min(-1)
    stop = miss < ROOM * radius
    return np.where(stop[:, None], kinematics.toward(still, now.velocity, now.heading), action), stop
