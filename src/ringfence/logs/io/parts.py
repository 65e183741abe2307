"""The rows of a table in two parts by time: to learn by and to judge by."""

from __future__ import annotations

import dataclasses

import numpy as np

from ringfence.errors import StoreError, UserError
from ringfence.logs.io.rows import Rows, Values


def parted(rows: Rows, values: Values, share: float) -> tuple[Rows, Values]:
    """The rows with each part as recordings of its own, those of the first `share` of the rows in front, so that no
    episode is of both. Recordings whose times overlap count from a start of their own: these stay whole and are parted
    in the order of the table."""
    if not (isinstance(share, int | float) and 0 < share < 1):
        raise UserError(f"split={share!r:.60} must be a number between 0 and 1: the share of the time to learn by.")
    late = _late_recordings(rows, share) if _overlap(rows) else rows.time > np.quantile(rows.time, share)
    if late.all() or not late.any():
        raise StoreError(
            f"split={share:g} leaves one part without rows: the recordings count their own times, and there is one "
            "that holds most rows; give another share."
        )
    recording = rows.recording + late * (rows.recording.max() + 1)
    order = np.lexsort((np.arange(len(late)), rows.agent, recording))
    part = dataclasses.replace(rows.chosen(order), recording=recording[order])
    return part, values.chosen(order)


def _overlap(rows: Rows) -> bool:
    """Whether some recording begins before the one that began before it has ended."""
    begins = np.full(rows.recording.max() + 1, np.inf)
    ends = np.full(len(begins), -np.inf)
    np.minimum.at(begins, rows.recording, rows.time)
    np.maximum.at(ends, rows.recording, rows.time)
    order = np.argsort(begins, kind="stable")
    return bool((begins[order][1:] < ends[order][:-1]).any())


def _late_recordings(rows: Rows, share: float) -> np.ndarray:
    """(M,) whether a row's recording ends after the first `share` of the rows, recordings in the order of the table."""
    count = np.bincount(rows.recording)
    first = np.full(len(count), len(rows.order))
    np.minimum.at(first, rows.recording, rows.order)
    order = np.argsort(first, kind="stable")
    before = np.empty(len(count))
    before[order] = np.cumsum(count[order])
    return (before > share * len(rows.order) + 0.5)[rows.recording]
