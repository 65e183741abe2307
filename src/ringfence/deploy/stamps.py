"""Ages of observations by the clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from ringfence.errors import UserError

SLACK = 1e-3  # s by which a stamp may be ahead of the clock: clocks of two machines differ
LATELY = 20  # decisions whose time is remembered
FEW = 3  # of them, before which nothing is added: the first one compiles


class Stamps:
    """Turns the times at which observations were made into ages in steps, and refuses clocks that run backwards."""

    def __init__(self, clock: Callable[[], float]):
        self._clock = clock
        self._last: np.ndarray | float = -np.inf
        self._now = -np.inf
        self._took: deque[float] = deque(maxlen=LATELY)

    def reset(self) -> None:
        """An episode begins; a simulation's clock may begin anew."""
        self._last = self._now = -np.inf

    def ages(self, observed_at: Any, agents: int, dt: float | None) -> np.ndarray:
        """() or (N,) whole steps of `dt` seconds from `observed_at`, in seconds by this clock, until what is decided
        now is given: deciding takes as long as it did lately."""
        if dt is None:
            raise UserError(
                "observed_at needs a World that knows how long a step takes, and this one does not; give age= in steps."
            )
        stamps = np.asarray(observed_at)
        if stamps.dtype.kind not in "iuf" or stamps.shape not in ((), (agents,)) or not np.isfinite(stamps).all():
            raise UserError(f"observed_at={str(observed_at)[:60]} must be a time in seconds, or one of each agent.")
        stamps = stamps.astype(np.float64)
        now = float(self._clock())
        if now < self._now or (stamps > now + SLACK).any():
            before = max(self._now, float(stamps.max()))
            raise UserError(
                f"The clock runs backwards: it is {now:.3f} s, after {before:.3f} s; give clock=, the one that stamps "
                "observations."
            )
        if (stamps < self._last).any():
            raise UserError(
                f"observed_at={stamps.tolist()} is before {np.asarray(self._last).tolist()} of the step before; the "
                "clock of an observer runs backwards, or messages overtook one another: keep the newest."
            )
        self._now, self._last = now, stamps
        lately = float(np.median(self._took)) if len(self._took) >= FEW else 0.0
        return np.floor(np.maximum(now + lately - stamps, 0.0) / dt + 0.5).astype(np.int64)

    def acted(self) -> None:
        """What was asked for by `ages` is decided."""
        self._took.append(max(float(self._clock()) - self._now, 0.0))
