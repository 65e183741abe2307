"""Entries that are dangerous where another one is: too few steps show them to be found by themselves.

Of vehicles in a row the second and the third touched a hundred times, the first and the second twice. Twice is little
to tell where danger begins; it is enough where another entry has told that already, and nothing contradicts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from ringfence.world.cause_candidates import candidates
from ringfence.world.cause_counts import Counted, Explained, Steps, counted
from ringfence.world.cause_edges import within
from ringfence.world.causes import Cause, Edge
from ringfence.world.cells import CELLS

ALIKE = 0.95  # share of the steps within another entry's edges that are unsafe, where they are this one's, too
EPISODES = 2  # in which they have to be: one alone may be an accident


def siblings(
    steps: Steps, chosen: Sequence[Counted], edges: Sequence[Edge], names: Sequence[str]
) -> list[tuple[Counted, Edge]]:
    """Entries, with where they are dangerous, that are no cause yet, and that tell unsafe steps which no cause tells by
    the edges of one. Only edges at which danger was seen to begin and to end are tried: they fit hardly anything by
    chance."""
    known = {one.cause for one in chosen}
    alike = [edge for one, edge in zip(chosen, edges) if _is_plain(one.cause) and _between(edge)]
    if not alike:
        return []
    explained = Explained.by(steps, chosen)
    called = [within(steps, one.cause, edge) for one, edge in zip(chosen, edges) if edge.bounds]
    left = steps.unsafe & ~np.logical_or.reduce(called)
    found = []
    for cause in candidates(names):
        if not _is_plain(cause) or cause in known:
            continue
        for edge in (_moved(edge, cause.of(steps.x)) for edge in alike):
            inside = within(steps, cause, edge)
            if _is_told(steps, inside & left, inside & ~steps.unsafe):
                found.append((counted(steps, cause, explained), edge))
                left &= ~inside
                break
    return found


def _is_plain(cause: Cause) -> bool:
    """Whether it is one entry, of all agents."""
    return cause.width == 1 and not cause.length and not cause.who


def _between(edge: Edge) -> bool:
    """Whether danger was seen to begin and to end."""
    return len(edge.bounds) - sum(edge.unseen) >= 2


def _is_told(steps: Steps, unsafe: np.ndarray, safe: np.ndarray) -> bool:
    """Whether steps, each (T,) or (T, N) bool, are unsafe nearly always, and in more than one episode."""
    in_danger = unsafe if unsafe.ndim == 1 else unsafe.any(1)
    episodes = np.unique(steps.episode[in_danger])
    return len(episodes) >= EPISODES and bool(unsafe.sum() >= ALIKE * (unsafe.sum() + safe.sum()))


def _moved(edge: Edge, values: np.ndarray) -> Edge:
    """The edge for another entry: where the logs end is that one's own affair."""
    low, high = float(values.min()), float(values.max())
    beyond = (high - low) / CELLS[1]
    bounds = list(edge.bounds)
    if edge.unseen[0]:
        bounds[0] = min(low - beyond, bounds[1])
    if edge.unseen[-1]:
        bounds[-1] = max(high + beyond, bounds[-2])
    return replace(edge, low=(round(low, 4),), high=(round(high, 4),), bounds=tuple(bounds))
