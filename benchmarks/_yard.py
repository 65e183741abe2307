"""The yard of examples/yard.py, and who drives there at full speed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))
import yard  # noqa: E402

AT = {name: k for k, name in enumerate(yard.NAMES)}


def naive(observations: np.ndarray, state: None) -> np.ndarray:
    """Full speed to the goal, past nobody."""
    gap, speed = (observations[:, [AT[f"{n}x"], AT[f"{n}y"]]] for n in ("goal.d", "own.v"))
    far = np.maximum(np.linalg.norm(gap, axis=-1, keepdims=True), 0.3)
    return np.clip(2 * (gap / far - speed), -1, 1)
