"""How a trained denoiser draws plans: the same in training, with gradients, as at run time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from ringfence.nets.mean_plan import Centre
from ringfence.nets.team import planning_as
from ringfence.proposals import diffusion
from ringfence.types import Array


@dataclass(frozen=True)
class Generator:
    """Draws the unknown entries of plans (B, H, N, D), in the normaliser's coordinates x. Noise is diffused in z, what
    is left of x around the mean plan where there is one."""

    predict: diffusion.Predict  # of z
    mask: Array  # (B, H, N, 1) which entries are known
    known: Array  # (B, H, N, D) their values
    centre: Centre | None

    def inpaint(self, x: Array) -> Array:
        return jnp.where(self.mask, self.known, x)

    def plan(self, z: Array) -> Array:
        """x of z, with what is known."""
        return self.inpaint(z if self.centre is None else self.centre.plan(z))

    def rest(self, x: Array) -> Array:
        """z of x."""
        return x if self.centre is None else self.centre.rest(x, self.mask)


def generator(
    networks: Mapping[str, Any],
    known: Array,
    mask: Array,
    y: Array,
    driver: Array | None,
    alpha_bar: np.ndarray,
    prediction: diffusion.Prediction,
    clip: float,
    dim: bool,
    guidance: float = 1.0,
) -> Generator:
    """Plans for y (B,), of drivers (B,), by `networks`: a `denoiser`, and `mean` where there is one. `dim`: noisy
    entries are shown × √ᾱ_k."""
    net = planning_as(networks["denoiser"], driver)
    predict = diffusion.guided(net, alpha_bar, y, guidance, prediction, clip, mask if dim else None)
    centre = None
    if "mean" in networks:
        centre = networks["mean"](known, mask, y, jnp.ones(y.shape, bool), driver, guidance)
    return Generator(predict, mask, known, centre)
