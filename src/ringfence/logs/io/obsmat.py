"""`obsmat.txt` of the pedestrians of ETH (Pellegrini et al. 2009) and UCY, as columns.

Eight numbers a line without a header: frame, pedestrian, x, z, y (m), vx, vz, vy (m/s). A pedestrian has a line every
0.4 s, whatever the frames are counted by.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from ringfence.errors import StoreError

NAMES = ("frame", "agent", "x", "z", "y", "vx", "vz", "vy")
SPACING = 0.4  # s between a pedestrian's lines


def read_obsmat(path: Path) -> dict[str, np.ndarray]:
    """Columns (M,) `time` (s), `agent`, `x`, `y` (m), `vx`, `vy` (m/s); the height is 0 throughout and left out."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of an empty file, which is refused below
            rows = np.loadtxt(path, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        reason = str(error).splitlines()[0]
        raise StoreError(f"'{path}' is no obsmat ({reason}); give lines of {len(NAMES)} numbers.") from None
    if rows.shape[1:] != (len(NAMES),) or not len(rows):
        raise StoreError(
            f"'{path}' has {len(rows)} lines of {rows.shape[-1]} numbers; an obsmat has {len(NAMES)}: "
            f"{' '.join(NAMES)}."
        )
    columns = dict(zip(NAMES, rows.T))
    return {
        "time": columns["frame"] * SPACING / _frames_between_lines(path, columns["frame"], columns["agent"]),
        "agent": _whole(path, columns["agent"]),
        **{name: columns[name] for name in ("x", "y", "vx", "vy")},
    }


def _frames_between_lines(path: Path, frame: np.ndarray, agent: np.ndarray) -> float:
    order = np.lexsort((frame, agent))
    apart = np.diff(frame[order])[np.diff(agent[order]) == 0]
    apart = apart[apart > 0]
    if not len(apart):
        raise StoreError(f"'{path}' has no pedestrian at two frames; give lines of {' '.join(NAMES)}.")
    return float(np.median(apart))


def _whole(path: Path, agent: np.ndarray) -> np.ndarray:
    if not (np.isfinite(agent) & (agent == np.round(agent))).all():
        raise StoreError(f"'{path}' numbers a pedestrian otherwise than by whole numbers; give {' '.join(NAMES)}.")
    return agent.astype(np.int64)
