"""A mean plan, and how far logged plans lie from it: noise is diffused around it, in units of what is left.

At high noise a denoiser has to answer with the mean of all plans from here, whatever noise it is shown. A network that
is shown none learns that mean much faster, and where it is good, little is left for the denoiser
(docs/results.md).
Where plans from one state differ widely, much is left, and the denoiser does what it always did.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.nets.team import planning_as
from ringfence.types import Array


class Centre(NamedTuple):
    """What plans x (B, H, N, D) are diffused around: z = (x − mean) / scale."""

    mean: Array  # (B, H, N, D)
    log_scale: Array  # (H, 1, D)

    def rest(self, plan: Array, mask: Array) -> Array:
        """z of plans; known entries, of `mask` (B, H, N, 1), are left as they are."""
        return jnp.where(mask, plan, (plan - self.mean) * jnp.exp(-self.log_scale))

    def plan(self, rest: Array) -> Array:
        """Inverse of `rest`, of what is not known."""
        return self.mean + jnp.exp(self.log_scale) * rest

    def surprise(self, plan: Array, weight: Array) -> tuple[Array, Array]:
        """(squared error of the mean, surprise of a Gaussian of that scale about the error) of logged plans, by
        `weight` (B, H, N or 1, D or 1). Each teaches its own part alone."""
        error = (plan - self.mean) ** 2
        left = jax.lax.stop_gradient(error)
        told = 0.5 * left * jnp.exp(-2.0 * self.log_scale) + self.log_scale
        weight = jnp.broadcast_to(weight, error.shape)
        count = jnp.maximum(weight.sum(), 1.0)
        return (error * weight).sum() / count, (told * weight).sum() / count


class MeanPlan(eqx.Module):
    """m(s, y): a denoiser that is shown no noise."""

    net: Any
    log_scale: Array  # (H, 1, D) of what is left, in standard deviations of the data's

    def __call__(
        self, plan: Array, mask: Array, y: Array, keep: Array, driver: Array | None = None, guidance: float = 1.0
    ) -> Centre:
        """What plans with the known entries (`mask`) of `plan` (B, H, N, D) are diffused around, given y (B,) where
        `keep` (B,) says so, of drivers (B,); with classifier-free `guidance`."""
        shown = jnp.where(mask, plan, 0.0)
        k = jnp.zeros(plan.shape[0], jnp.int32)
        net = planning_as(self.net, driver)
        mean = net(shown, k, y, keep)
        if guidance != 1.0:
            free = net(shown, k, y, ~keep)
            mean = free + guidance * (mean - free)
        return Centre(mean, self.log_scale)
