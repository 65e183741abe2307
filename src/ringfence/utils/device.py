"""From the host to the device."""

from __future__ import annotations

import jax
import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from ringfence.types import Array


def on_device(x: ArrayLike, dtype: DTypeLike | None = None) -> Array:
    """The array on the device, of 32 bits; `jnp.asarray` compiles a program for every shape that it is given."""
    return jax.device_put(np.asarray(x, dtype))
