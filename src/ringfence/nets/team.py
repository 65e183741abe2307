"""A denoiser of whole teams: everybody's window in one vector, through a residual network.

It learns a team of a few agents faster than attention does (results/failed.md); its weights are for
one number of agents, whom it tells apart.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.nets.embedding import Condition
from ringfence.nets.flat import entries, flattened, restored
from ringfence.nets.residual import ResidualMLP
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
