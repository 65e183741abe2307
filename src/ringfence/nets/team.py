"""A denoiser of whole teams: everybody's window in one vector, through a residual network.

It learns a team of a few agents faster than attention does (results/failed.md); its weights are for
one number of agents, whom it tells apart.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.nets.layers import Condition, ResidualMLP, entries, flattened, restored
from ringfence.types import Array, Key

CONDITION = 64  # units of the condition: diffusion step, return, driver


class TeamDenoiser(eqx.Module):
    """F(x_k, k, y) as `AgentAttention`."""

    condition: Condition
    net: ResidualMLP
    carried: tuple[int, ...] = eqx.field(static=True)  # entries of a flattened window (H·D) that are read and written

    def __init__(
        self,
        key: Key,
        rows: int,
        features: int,
        width: int,
        depth: int,
        carried: tuple[int, ...] | None,
        agents: int,
        drivers: int = 0,
    ):
        """For teams of `agents`; `drivers`: how many it may plan as."""
        k1, k2 = jax.random.split(key)
        self.carried = entries(rows, features, carried)
        flat = agents * len(self.carried)
        self.condition = Condition(k1, CONDITION, drivers)
        self.net = ResidualMLP(k2, flat + CONDITION, flat, width, depth, 0.1)

    def __call__(self, x: Array, k: Array, y: Array, keep: Array, driver: Array | None = None) -> Array:
        """x (B, H, N, D) noisy plan, k (B,) diffusion step, y (B,) return score, keep (B,) bool, driver (B,) of
        those it plans as -> (B, H, N, D)."""
        b, _, n, _ = x.shape
        seen = flattened(x, self.carried).reshape(b, -1)
        clean = self.net(jnp.concatenate([seen, self.condition(k, y, keep, driver)], -1))
        return restored(clean.reshape(b * n, -1), x.shape, self.carried)


def planning_as(denoiser, driver: Array | None):
    """F(x, k, y, keep) that plans as `driver` (B,), also where guidance asks it twice at once; None: as anybody."""
    if driver is None:
        return denoiser

    def net(x: Array, k: Array, y: Array, keep: Array) -> Array:
        return denoiser(x, k, y, keep, jnp.tile(driver, x.shape[0] // driver.shape[0]))

    return net


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
