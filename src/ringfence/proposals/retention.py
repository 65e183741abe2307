"""What a plan is asked of a barrier h_i(s̃_i): the retention schedule, and the loss that raises h along plans.

    h ≥ 0 on safe states,  h < 0 on unsafe ones,  h(s̃_{t+1}) ≥ α h(s̃_t)  along transitions           (paper, eq. 7)

`retention` is the code's name of α, which the noise schedule would otherwise share. Retention 0 is one-step set
membership, 1 forbids any approach to the boundary; every value in [0, 1) keeps {h ≥ 0} invariant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError
from ringfence.types import Array

Relaxation = Literal["signal", "linear", "none"]


@dataclass(frozen=True)
class Retention:
    """α_k = m − η_k with 0 ≤ η_k ≤ m < 1 and η → 0 as k → 0 (paper, eq. 9).

    A parked agent (h constant in time) meets the unscaled condition h ≥ α h + δ only if h ≥ δ / (1 − m): 0.2 for
    m = 0.9, δ = 0.02. The scaled margin (1 − α) δ asks for h ≥ δ instead, whatever m is.

    Where h < 0, a smaller α makes the condition *stricter*. `two_sided` therefore relaxes the unsafe side the other
    way, up to "do not get worse":  α_k(h) = (m − η) max(h, 0) + (m + η (1 − m)/m) min(h, 0).
    """

    m: float = 0.9
    relaxation: Relaxation = "signal"  # η_k = m (1 − ᾱ_k) | m k/(K−1) | 0
    two_sided: bool = True

    def __post_init__(self):
        if not 0.0 <= self.m < 1.0:
            raise UserError(f"retention m={self.m} must lie in [0, 1): at 1 a barrier could never fall; try 0.9.")
        if self.relaxation not in ("signal", "linear", "none"):
            raise UserError(f"Unknown relaxation '{self.relaxation}'; choose signal, linear or none.")

    def eta(self, alpha_bar: np.ndarray) -> np.ndarray:
        """η (K,) for a noise schedule ᾱ (K,)."""
        alpha_bar = np.asarray(alpha_bar)
        if self.relaxation == "none":
            return np.zeros_like(alpha_bar)
        if self.relaxation == "linear":
            return self.m * np.arange(len(alpha_bar)) / (len(alpha_bar) - 1)
        return self.m * (1.0 - alpha_bar)

    def decay(self, h: Array, eta: Array | float) -> Array:
        """α_k(h) · h: the least value that h(s̃_{t+1}) may take; `eta` broadcasts against h."""
        kept = (self.m - eta) * h
        if not self.two_sided or self.m == 0.0:
            return kept
        return jnp.where(h >= 0, kept, (self.m + eta * (1.0 - self.m) / self.m) * h)


def shaping(
    h: Array, valid: Array, retention: Retention, eta: Array, delta: float, scaled_margin: bool, weight: Array
) -> Array:
    """L_θ of the `shaped` preset: raise h̄ along the plan, against a frozen barrier.

        mean_t max(0, δ − h̄(x̂0_t)) + mean_t max(0, (1−α) δ − h̄(x̂0_{t+1}) + α sg h̄(x̂0_t)),   t ≥ 1 in the first

    h (B, H, N) = h̄ on the clean estimate, row 0 the in-painted present; `weight` (B, 1, 1), e.g. ᾱ_k. The reference
    h̄(x̂0_t) carries no gradient, or the generator would be paid for making the present worse.
    """
    positive = mean_over(jax.nn.relu(delta - h[:, 1:]), valid[:, 1:], weight)
    floor = retention.decay(jax.lax.stop_gradient(h[:, :-1]), eta)
    margin = (1.0 - retention.m + eta) * delta if scaled_margin else delta
    drop = jax.nn.relu(margin - h[:, 1:] + floor)
    return positive + mean_over(drop, valid[:, 1:], weight)


def mean_over(x: Array, mask: Array, weight: Array | float = 1.0) -> Array:
    """Mean of x over a mask (broadcast to x), 0 where it is empty; `weight` multiplies the terms, not the count."""
    mask = jnp.broadcast_to(mask, x.shape).astype(jnp.float32)
    return (x * mask * weight).sum() / jnp.maximum(mask.sum(), 1.0)
