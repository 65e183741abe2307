"""Where a cause of one number is dangerous, finer than cells are."""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace

from ringfence.world.cause_counts import Explained, Steps, counted, some_steps
from ringfence.world.causes import Cause, Edge
from ringfence.world.cells import CELLS

AROUND = 3.0  # cells to either side that an edge is looked for in


def radius(x: np.ndarray, unsafe: np.ndarray, episode: np.ndarray, cause: Cause) -> Edge:
    """Where one cause is dangerous, as steps tell it that look for no other."""
    steps = some_steps(x, unsafe, episode, np.random.default_rng(0))
    nothing = Explained.by(steps, [])
    return refined(steps, counted(steps, cause, nothing).cells.edge, cause, nothing)


def refined(steps: Steps, edge: Edge, cause: Cause, explained: Explained) -> Edge:
    """The edge with bounds between the values that parted unsafe steps from safe ones, finer than cells are."""
    if not edge.bounds:
        return edge
    agents, things = np.nonzero(cause.holds(steps.x.shape[1]))
    values = cause.of(steps.x)[:, agents, things, 0]
    value = _of_the_worst(steps, values, signed(values, edge), agents)
    left = explained.left > 0.5
    size = (edge.high[0] - edge.low[0]) / CELLS[1]
    bounds = list(edge.bounds)
    for k, bound in enumerate(edge.bounds):
        near = np.abs(value - bound) < AROUND * size
        bad, fine = value[near & left], value[near & ~steps.unsafe]
        if not edge.unseen[k] and len(bad) and len(fine):
            bounds[k] = _parting(bad, fine, low_is_bad=(k % 2 == 0) == edge.inside)
    seen = [bound for bound, unseen in zip(bounds, edge.unseen) if not unseen]
    at = None if edge.at is None else round(seen[0], 4)
    return replace(edge, bounds=tuple(sorted(bounds)), at=at)


def signed(values: np.ndarray, edge: Edge) -> np.ndarray:
    """Distances of values to where danger begins, below 0 in danger."""
    offset = values[..., None] - np.array(edge.bounds)
    safe = ((offset > 0).sum(-1) % 2 == 1) == edge.inside
    return np.where(safe, 1.0, -1.0) * np.abs(offset).min(-1)


def _of_the_worst(steps: Steps, values: np.ndarray, score: np.ndarray, agents: np.ndarray) -> np.ndarray:
    """(T,) or (T, N) the values of the things in most danger; far off where an agent has none."""
    if not steps.each:
        return np.take_along_axis(values, score.argmin(1)[:, None], 1)[:, 0]
    found = np.full(steps.unsafe.shape, np.inf)
    for agent in np.unique(agents):
        own = agents == agent
        found[:, agent] = np.take_along_axis(values[:, own], score[:, own].argmin(1)[:, None], 1)[:, 0]
    return found


def least_wrong(steps: Steps, cause: Cause) -> int:
    """How many steps a distance tells wrongly, by the edge below which danger begins that tells fewest so."""
    agents, things = np.nonzero(cause.holds(steps.x.shape[1]))
    values = cause.of(steps.x)[:, agents, things, 0]
    nearest = _of_the_worst(steps, values, values, agents)
    return int(_wrong(np.sort(nearest[steps.unsafe]), np.sort(nearest[~steps.unsafe]))[1].min())


def _wrong(bad: np.ndarray, fine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(values, how many of bad and fine ones, which are sorted, an edge at each tells wrongly where low is bad)."""
    tried = np.unique(np.concatenate([bad, fine]))
    return tried, len(bad) - np.searchsorted(bad, tried, "right") + np.searchsorted(fine, tried, "right")


def _parting(bad: np.ndarray, fine: np.ndarray, low_is_bad: bool) -> float:
    """The value that parts most unsafe steps from safe ones: in the middle of all that do as well."""
    sign = 1.0 if low_is_bad else -1.0
    tried, wrong = _wrong(np.sort(sign * bad), np.sort(sign * fine))
    best = int(wrong.argmin())
    following = tried[best + 1] if best + 1 < len(tried) else tried[best]
    return float(sign * 0.5 * (tried[best] + following))


def within(steps: Steps, cause: Cause, edge: Edge) -> np.ndarray:
    """(T,) or (T, N) bool: somebody is in danger by a cause of one number."""
    agents, things = np.nonzero(cause.holds(steps.x.shape[1]))
    score = signed(cause.of(steps.x)[:, agents, things, 0], edge)
    return _of_the_worst(steps, score, score, agents) < 0
