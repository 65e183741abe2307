"""What a guard knows danger by: one signed score per agent, from whichever source."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from ringfence.errors import UserError
from ringfence.guards.shown import STEEP, Shown
from ringfence.problem.constraints import BoundHazard
from ringfence.types import Array
from ringfence.world import World
from ringfence.world.barrier import Barrier, MinBarrier

BARRIERS = ("learned", "analytic", "both")
AHEAD = "what will be dangerous after the last row"
BEYOND = "what the logs have not shown"


class BarrierSource(eqx.Module):
    """Scores in units of a margin that is right for each source: the constraint's own safe margin for an analytic
    one, the calibrated one for what is learned. So a margin means the same to both, and the smaller can be taken.

    What is learned is lowered out of distribution, where the ensemble disagrees by more than it did on held-out
    episodes: by one margin for every time that it does. Nothing has its margin there where rows are to stay within what
    the logs have shown: a search for a way out finds actions whose effect nobody has logged, such as braking at rest,
    and a World that is wrong about them.
    """

    world: World
    source: str = eqx.field(static=True)  # one of BARRIERS
    hazard: BoundHazard | None = eqx.field(static=True)  # bound to the World's view
    terminal_value: bool = eqx.field(static=True)  # the last row is judged by what will be dangerous, too
    shown: Shown | None = None  # what the logs have shown, where rows are to stay within it

    def __check_init__(self):
        if self.source not in BARRIERS:
            raise UserError(f"barrier='{self.source}' is unknown; choose learned, analytic or both.")
        if self.source != "learned":
            self._check_analytic()
        if self.source != "analytic" and self.world.barrier is None:
            formula = self.hazard is not None and self.hazard.has_formula
            remedy = "use barrier='analytic', or " if formula else ""
            raise UserError(
                f"barrier='{self.source}' needs a barrier, but this World was fitted without labels of danger; "
                f"{remedy}fit a World on logs with costs."
            )

    def _check_analytic(self) -> None:
        if self.hazard is None or not self.hazard.has_formula:
            raise UserError(
                f"barrier='{self.source}' needs a formula that the World's view can read, and there is none; use "
                "barrier='learned'."
            )
        if not self.hazard.safe_margin > 0:
            raise UserError(
                f"barrier='{self.source}' measures its margin in safe margins, but the hazard's is 0; give it one "
                "above 0."
            )

    def along(self, rows: Array, spread: Array) -> Array:
        """(..., K, N, C) scores of predicted rows (..., K+1, N, D), the present first, by each constraint (1 unless the
        logs name several); spread (..., K, N)."""
        danger, support = self.danger_and_support(rows, spread)
        return danger if support is None else jnp.minimum(danger, support[..., None])

    def danger_and_support(self, rows: Array, spread: Array) -> tuple[Array, Array | None]:
        """The same in two: scores of danger, and (..., K, N) of staying within what the logs have shown, if rows are
        to: 1 at the end of it. A margin that moves is one of danger alone."""
        after = rows[..., 1:, :, :]
        if self.source == "analytic":
            return self._analytic(after), None if self.shown is None else self.shown.along(after)
        score = self._barrier.along(rows, self._widening)
        if self.terminal_value:
            last = jnp.minimum(score[..., -1:, :, :], self._barrier.ahead_apart(after[..., -1:, :, :]))
            score = jnp.concatenate([score[..., :-1, :, :], last], -3)
        apart = spread / self.world.ood_threshold
        beyond = jnp.maximum(apart - 1.0, 0.0)
        if self.shown is None:
            return self._with_analytic(score - beyond[..., None], after), None
        known = 1.0 + STEEP * jnp.maximum(1.0 - apart, 0.0) - beyond
        return self._with_analytic(score, after), jnp.minimum(known, self.shown.along(after))

    def now(self, before: Array, present: Array) -> Array:
        """(..., N, C) scores of the step that led from one state (..., N, D) to the present."""
        if self.source == "analytic":
            score = self._analytic(present)
        else:
            score = self._with_analytic(self._barrier.apart(before, present), present)
        return score if self.shown is None else jnp.minimum(score, self.shown.score(present)[..., None])

    def parts(self, rows: Array) -> Array:
        """(..., K, N, M) what the scores of predicted rows (..., K+1, N, D) are the least of, without what is taken off
        out of distribution."""
        after = rows[..., 1:, :, :]
        found: list[Array] = []
        if self.source != "analytic":
            found.append(self._barrier.parts(rows, self._widening))
        if self.terminal_value:
            ahead = self._barrier.ahead_apart(after).min(-1)
            last = jnp.arange(after.shape[-3])[:, None] == after.shape[-3] - 1
            found.append(jnp.where(last, ahead, jnp.inf)[..., None])
        if self.source != "learned":
            found.append(self._analytic(after))
        if self.shown is not None:
            found.append(self.shown.along(after)[..., None])
        return jnp.concatenate(found, -1)

    @property
    def part_names(self) -> tuple[tuple[str, str], ...]:
        """(what is dangerous, of which thing) of each of `parts`."""
        found: list[tuple[str, str]] = []
        if self.source != "analytic":
            found += self._barrier.part_names
        if self.terminal_value:
            found.append((AHEAD, ""))
        if self.source != "learned":
            assert self.hazard is not None, "checked when it was made"
            found.append((f"{type(self.hazard.hazard).__name__} by formula", ""))
        if self.shown is not None:
            found.append((BEYOND, ""))
        return tuple(found)

    @property
    def limits(self) -> dict[str, float]:
        """Limit per episode of each constraint that has a barrier of its own; empty where danger is one."""
        return {} if self.source == "analytic" else self.world.limits

    @property
    def _widening(self) -> tuple[Any, ...]:
        """What rows ahead ask for beyond the margin, as the World's card says; of several constraints each."""
        card = self.world.card
        barrier = self._barrier
        if not isinstance(barrier, MinBarrier):
            return () if card.barrier is None else card.barrier.widening
        of_each = card.constraints or {}
        return tuple(of_each[name].widening if name in of_each else () for name in barrier.names)

    @property
    def _barrier(self) -> Barrier | MinBarrier:
        assert self.world.barrier is not None, "checked when it was made"
        return self.world.barrier

    def _with_analytic(self, score: Array, x: Array) -> Array:
        return score if self.source == "learned" else jnp.minimum(score, self._analytic(x))

    def _analytic(self, x: Array) -> Array:
        assert self.hazard is not None and self.hazard.clearance is not None, "checked when it was made"
        return (self.hazard.clearance(x) / self.hazard.safe_margin)[..., None]
