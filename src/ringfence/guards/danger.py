"""How a guard knows danger: one signed score per agent, whoever tells it."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax.numpy as jnp

from ringfence.errors import UserError
from ringfence.problem.constraints import BoundHazard
from ringfence.types import Array
from ringfence.world import World

Source = Literal["formula", "learned", "both"]
DANGERS = ("formula", "learned", "both")


class Danger(eqx.Module):
    """Scores in units of a margin that is right for each source: the hazard's own safe margin for a formula, the
    calibrated one for what is learned. So a margin means the same to both, and the smaller of both can be taken.

    What is learned is lowered where the World does not know (the ensemble is apart by more than held-out episodes
    were): by one margin for every time that it is.
    """

    world: World
    source: Source = eqx.field(static=True)
    hazard: BoundHazard | None = eqx.field(static=True)  # bound to the World's view
    future: bool = eqx.field(static=True)  # judge the last row by what will be dangerous, too

    def __check_init__(self):
        if self.source not in DANGERS:
            raise UserError(f"danger='{self.source}' is unknown; choose formula, learned or both.")
        if self.source != "learned" and (self.hazard is None or not self.hazard.has_formula):
            raise UserError(
                f"danger='{self.source}' needs a formula that the World's view can read, and there is none; use "
                "danger='learned'."
            )
        if self.source != "formula" and self.world.barrier is None:
            raise UserError(
                f"danger='{self.source}' needs a barrier, but this World was fitted without labels of danger; use "
                "danger='formula', or fit a World on logs with costs."
            )
        if self.source != "learned" and not self.hazard.safe_margin > 0:
            raise UserError(
                f"danger='{self.source}' measures its margin in safe margins, but the hazard's is 0; give it one "
                "above 0."
            )

    def along(self, rows: Array, spread: Array) -> Array:
        """(..., K, N, C) scores of foreseen rows (..., K+1, N, D), the present first, by each constraint (1 unless the
        logs name several); spread (..., K, N)."""
        before, after = rows[..., :-1, :, :], rows[..., 1:, :, :]
        if self.source == "formula":
            return self._by_formula(after)
        told = self.world.barrier.apart(before, after)
        if self.future:
            ahead = self.world.barrier.ahead_apart(after[..., -1:, :, :])
            told = jnp.concatenate([told[..., :-1, :, :], jnp.minimum(told[..., -1:, :, :], ahead)], -3)
        told = told - jnp.maximum(spread / self.world.strange - 1.0, 0.0)[..., None]
        return told if self.source == "learned" else jnp.minimum(told, self._by_formula(after))

    def now(self, before: Array, present: Array) -> Array:
        """(..., N, C) scores of the step that led from one state (..., N, D) to the present."""
        if self.source == "formula":
            return self._by_formula(present)
        told = self.world.barrier.apart(before, present)
        return told if self.source == "learned" else jnp.minimum(told, self._by_formula(present))

    @property
    def limits(self) -> dict[str, float]:
        """Limit per episode of each constraint that is told apart; empty where danger is one."""
        return {} if self.source == "formula" else self.world.limits

    def _by_formula(self, x: Array) -> Array:
        return (self.hazard.clearance(x) / self.hazard.safe_margin)[..., None]
