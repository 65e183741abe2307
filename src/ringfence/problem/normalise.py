"""Fit once, freeze, apply and invert: the coordinates in which plans are diffused.

A plan is H rows of features; row `now` is the current state. Two coordinate systems:

* `displacement` (default): row `now` and earlier are standardised states; every later row is the displacement from
  row `now`, standardised per horizon step and entry. The first step of a plan, from which the action is read, then
  has unit variance like everything else, instead of being a small difference of large numbers.
* `state`: every row is a standardised state, as in MADIFF.

Both maps are affine in the rows, differentiable, and inverted exactly.
"""

from __future__ import annotations

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ringfence.types import Array, Bound, Spec, X
from ringfence.utils.precision import on_device

Coordinates = Literal["displacement", "state"]
ROUNDING = 1e-5  # of an entry's size: less variation is rounding, and the entry is centred and left alone


class Normaliser(eqx.Module):
    """Frozen statistics, pooled over agents, so that they carry over to another number of agents."""

    mean: Array  # (D,)
    scale: Array  # (D,) standard deviation
    step_mean: Array  # (H - 1 - now, D) of the displacement from row `now`
    step_scale: Array  # (H - 1 - now, D)
    now: int = eqx.field(static=True)
    coordinates: str = eqx.field(static=True)

    def state(self, features: Array) -> Array:
        """Standardise single states (..., D)."""
        return (features - self.mean) / self.scale

    def invert_state(self, x: Array) -> Array:
        return x * self.scale + self.mean

    def apply(self, plan: Array) -> Array:
        """(..., H, N, D) features -> diffusion coordinates."""
        if self.coordinates == "state":
            return self.state(plan)
        past = plan[..., : self.now + 1, :, :]
        future = plan[..., self.now + 1 :, :, :]
        moved = future - plan[..., self.now : self.now + 1, :, :]
        x = (moved - self.step_mean[:, None]) / self.step_scale[:, None]
        return jnp.concatenate([self.state(past), x], axis=-3)

    def invert(self, x: Array) -> Array:
        """(..., H, N, D) diffusion coordinates -> features."""
        if self.coordinates == "state":
            return self.invert_state(x)
        past = self.invert_state(x[..., : self.now + 1, :, :])
        moved = x[..., self.now + 1 :, :, :] * self.step_scale[:, None] + self.step_mean[:, None]
        return jnp.concatenate([past, past[..., self.now : self.now + 1, :, :] + moved], axis=-3)

    def step(self, before: Array, after: Array) -> Array:
        """The one-step displacement (..., D), standardised: what inverse dynamics reads."""
        return (after - before - self.step_mean[0]) / self.step_scale[0]


def varying(scale, size):
    """Deviations (..., D), 1 where an entry of that size does not vary. In no unit: small ones are as good as large."""
    return np.where(scale <= ROUNDING * np.abs(size), 1.0, scale)


def fit(windows: np.ndarray, valid: np.ndarray, now: int, coordinates: str) -> Normaliser:
    """Statistics of windows (M, H, N, D) with `valid` (M, H); padded rows are left out."""
    h = windows.shape[1]
    d = windows.shape[-1]
    rows = windows[:, now].reshape(-1, d).astype(np.float64)
    means = []
    scales = []
    for s in range(now + 1, h):
        moved = (windows[:, s] - windows[:, now])[valid[:, s]].reshape(-1, d).astype(np.float64)
        means.append(moved.mean(0) if len(moved) else np.zeros(d))
        scales.append(moved.std(0) if len(moved) else np.ones(d))

    mean = rows.mean(0)
    scale = rows.std(0)

    as_array = lambda x: on_device(x, np.float32)  # noqa: E731
    return Normaliser(
        as_array(mean),
        as_array(varying(scale, mean)),
        as_array(np.reshape(means, (-1, d))),
        as_array(varying(np.reshape(scales, (-1, d)), np.abs(mean) + scale)),
        now,
        coordinates,
    )


def to_unit(action: X, low: Bound, high: Bound) -> X:
    """Actions (..., N, A) within [low, high], in units of [−1, 1], where weights, noise and searches mean the same in
    any bounds. Those bounded so anyway are left as they are, to the last bit."""
    middle, half = _middle_and_half(low, high)
    return (action - middle) / half


def from_unit(action: Array, low: Bound, high: Bound) -> Array:
    """Inverse of `to_unit`. Where entries have bounds of their own, nothing lies beyond them: simulators refuse an
    action whose last bit does."""
    middle, half = _middle_and_half(low, high)
    action = middle + half * action
    if isinstance(low, int | float) and isinstance(high, int | float):
        return action
    return action.clip(np.asarray(low, np.float32), np.asarray(high, np.float32))


def in_units_of(wanted: Spec, given: Spec, action: Array) -> Array:
    """Actions in [−1, 1] of the bounds of one spec in those of another; the same where the bounds are."""
    if (given.action_low, given.action_high) == (wanted.action_low, wanted.action_high):
        return action
    physical = from_unit(action, given.action_low, given.action_high)
    return to_unit(physical, wanted.action_low, wanted.action_high)


def _middle_and_half(low: Bound, high: Bound) -> tuple[Any, Any]:
    """The middle of the bounds and half of their range: numbers, or float32 arrays of each entry."""
    if isinstance(low, int | float) and isinstance(high, int | float):
        return (high + low) / 2, (high - low) / 2
    least = np.asarray(low)
    greatest = np.asarray(high)
    return ((greatest + least) / 2).astype(np.float32), ((greatest - least) / 2).astype(np.float32)
