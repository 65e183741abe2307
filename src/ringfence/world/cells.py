"""Where a cause is dangerous, counted cell by cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringfence.world.causes import Cause, Edge

CELLS = {1: 200, 2: 48, 3: 20, 4: 11}  # along each axis, by the number of entries, at most
BEYOND = 0.5  # of the range of what was seen: how far outside of it cells are taken to be like the nearest ones
APART = 1.5  # cells from the nearest visited one, from which on a place counts as never visited
NEARBY = 4.0  # cells, deviation of the places that are asked about close to visited ones
ALONG = 0.05  # weight of a distance beside what else a cause reads: what is there is known by who was so, however far
VISITED = 3  # visits that make a cell known
GAP = 0.1  # of the range of one number, unvisited: no few steps more would have filled it
TURNS = (20.0, 0.1)  # visits, and share of the dangerous ones, that have to contradict before danger begins or ends


@dataclass(frozen=True, eq=False)
class Cells:
    """Where a cause is dangerous, cell by cell."""

    cause: Cause
    cuts: (
        np.ndarray
    )  # (width, bins + 1) where cells begin and end along each axis, the shorter the more danger is there
    visits: np.ndarray  # (bins ** width,) by safe and unsafe steps
    danger: np.ndarray  # (bins ** width,) probability that being there makes a step unsafe

    @property
    def low(self) -> np.ndarray:
        """(width,) where cells begin."""
        return np.asarray(self.cuts[:, 0], float)

    @property
    def high(self) -> np.ndarray:
        """(width,) where they end."""
        return np.asarray(self.cuts[:, -1], float)

    @property
    def bins(self) -> int:
        """Along each axis."""
        return self.cuts.shape[1] - 1

    def known(self) -> tuple[np.ndarray, np.ndarray]:
        """(centres (K, width), unsafe (K,) bool) of the cells that were visited."""
        cell = np.flatnonzero(self.visits >= VISITED)
        places = np.stack(np.unravel_index(cell, (self.bins,) * len(self.low)), -1)
        middles = 0.5 * (self.cuts[:, 1:] + self.cuts[:, :-1])
        centres = np.take_along_axis(middles.T.astype(float), places, 0)
        return centres, self.danger[cell] > 0.5

    @property
    def edge(self) -> Edge:
        low = tuple(round(float(v), 4) for v in self.low)
        high = tuple(round(float(v), 4) for v in self.high)
        if len(low) > 1 or not (self.danger > 0.5).any():
            return Edge(low, high)
        unsafe = self._unsafe_along()
        turns = np.flatnonzero(unsafe[1:] != unsafe[:-1]) + 1
        bounds = [float(self.cuts[0, k]) for k in turns]
        unseen = [False] * len(bounds)
        inside = bool(unsafe[0])
        at = round(bounds[0], 4) if len(bounds) == 1 or (bounds and self.cause.goes_on) else None
        if not self.cause.goes_on and not unsafe[0]:
            bounds.insert(0, float(self.low[0] - self.size))
            unseen.insert(0, True)
            inside = True
        if not self.cause.goes_on and not unsafe[-1]:
            bounds.append(float(self.high[0] + self.size))
            unseen.append(True)
        return Edge(low, high, at, bool(unsafe[0]), tuple(bounds), inside, tuple(unseen))

    @property
    def size(self) -> float:
        """How long a cell is along the first axis, in the mean."""
        return float(self.high[0] - self.low[0]) / self.bins

    def _unsafe_along(self) -> np.ndarray:
        """(bins,) bool of a cause of one number: dangerous cells, in as few pieces as what was counted allows, since
        the edge of danger is not to flicker where few were. The likeliest pieces (Viterbi 1967)."""
        known = self.visits >= VISITED
        called_safe = np.where(known, self.visits * self.danger, 0.0)
        called_unsafe = np.where(known, self.visits * (1.0 - self.danger), 0.0)
        # What nobody visited is like the nearest, or, but of a distance, unsafe where that is far.
        middles = 0.5 * (self.cuts[0, 1:] + self.cuts[0, :-1])
        nearest = np.abs(middles[:, None] - middles[known])
        like = self.danger[np.flatnonzero(known)[nearest.argmin(1)]] > 0.5
        far = nearest.min(1) / self.size > 0.5 * GAP * self.bins + 1e-6
        most, share = TURNS
        turn = min(most, share * called_safe.sum())
        called_safe = np.where(known, called_safe, 1e-3 * like)
        called_unsafe = np.where(known, called_unsafe, 1e-3 * ~like)
        if not self.cause.goes_on:
            called_safe = np.where(far, 3 * turn, called_safe)
        return _likeliest(np.stack([called_safe, called_unsafe], -1), turn)

    def beyond(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """(values (count, width), unsafe (count,) bool) of places that were never visited.

        Along a distance each is like the nearest that was, at the same speed where a cause reads this, too: what is
        nearer than anybody came is as unsafe as that, and what is farther away as safe. Anywhere else what nobody
        visited is unsafe: nothing says that it is not a wall.
        """
        from scipy.spatial import KDTree  # slow to import, and read by fits alone

        centres, unsafe = self.known()
        scale = (self.high - self.low) / self.bins
        values = self._around(centres, scale, 4 * count, rng)
        far, nearest = (np.asarray(a) for a in KDTree(centres / scale).query(values / scale))
        new = np.flatnonzero(far > APART)[:count]
        if not len(new):
            new = np.arange(count)
        values, far, nearest = (a[np.resize(new, count)] for a in (values, far, nearest))
        if self.cause.from_zero:
            scale = scale * [1 / ALONG, *[1.0] * (self.cause.width - 1)]
            nearest = np.asarray(KDTree(centres / scale).query(values / scale)[1])
            far = np.abs((values - centres[nearest]) / scale)[:, 1:].max(1, initial=0.0)
        return values, unsafe[nearest] | (far > APART)

    def _around(self, centres: np.ndarray, scale: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
        """(count, width) values in and around what was visited: half of them anywhere, half close to it."""
        reach = BEYOND * (self.high - self.low)
        anywhere = rng.uniform(self.low - reach, self.high + reach, (count // 2, len(scale)))
        close = centres[rng.integers(len(centres), size=count - count // 2)]
        close = close + scale * rng.normal(0.0, NEARBY, close.shape)
        values = np.concatenate([anywhere, close])[rng.permutation(count)]
        if self.cause.from_zero:
            values[:, 0] = np.maximum(values[:, 0], 0.0)
        return values


def _likeliest(costs: np.ndarray, turn: float) -> np.ndarray:
    """(K,) bool: which of two states each of K cells is in, at these costs (K, 2) of each and of a turn."""
    total = costs[0].copy()
    came_from = np.zeros((len(costs), 2), int)
    for k in range(1, len(costs)):
        other = total[::-1] + turn
        came_from[k] = np.where(other < total, [1, 0], [0, 1])
        total = np.minimum(total, other) + costs[k]
    state = int(total.argmin())
    found = np.empty(len(costs), bool)
    for k in range(len(costs) - 1, -1, -1):
        found[k] = bool(state)
        state = came_from[k, state]
    return found
