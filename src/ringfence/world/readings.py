"""What causes read of how far things are together with something more; of NumPy's arrays and JAX's alike.

`offset` (..., k) is where things are, `also` (..., m) what else is read.
"""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

# Nothing more; as several numbers, see SEVERAL; in one, see `second`.
How = Literal["", "nearing", "beside", "turned", "vector", "both", "high", "low", "ahead", "coming", "soon"]


def nearing(offset: Any, velocity: Any) -> tuple[Any, Any]:
    """How far things are, and how fast that comes nearer."""
    far = _length(offset)
    return far, -(offset * velocity).sum(-1) / far


def beside(offset: Any, also: Any) -> tuple[Any, Any]:
    """How far things are, and another entry, or how long several are as a vector."""
    return _length(offset), also[..., 0] if also.shape[-1] == 1 else _length(also)


def turned(offset: Any, direction: Any) -> tuple[Any, Any]:
    """How far ahead of who looks into a direction, a vector or an angle, things are, and how far to the left."""
    x, y = offset[..., 0], offset[..., 1]
    cos, sin = direction[..., 0], direction[..., -1]
    if direction.shape[-1] == 1:
        numbers = _numbers_of(direction)
        cos, sin = numbers.cos(cos), numbers.sin(sin)
    else:
        long = _length(direction)
        cos, sin = cos / long, sin / long
    return x * cos + y * sin, y * cos - x * sin


def with_vector(entries: Any, also: Any) -> tuple[Any, ...]:
    """Entries, and how long others are as a vector."""
    return *(entries[..., k] for k in range(entries.shape[-1])), _length(also)


def both(offset: Any, place: Any) -> tuple[Any, ...]:
    """Where one is oneself, and where things are."""
    axes = range(place.shape[-1])
    return *(place[..., k] for k in axes), *(place[..., k] + offset[..., k] for k in axes)


SEVERAL = {"nearing": nearing, "beside": beside, "turned": turned, "vector": with_vector, "both": both}


def second(how: How, offset: Any, also: Any, end: float) -> Any:
    """(...,) the number that is read beside a distance: by how much an entry is below its highest value, or above its
    lowest, at `end`; by what angle (rad) things are off a direction, to either side; by how much slower they come
    nearer than ever; or how fast."""
    if how == "high":
        return end - beside(offset, also)[1]
    if how == "low":
        return beside(offset, also)[1] - end
    if how in ("soon", "coming"):
        fast = nearing(offset, also)[1]
        return fast if how == "soon" else end - fast
    ahead, left = turned(offset, also)
    return _numbers_of(left).arctan2((left**2 + 1e-9) ** 0.5, ahead)  # which has a slope where something is right here


def in_one(how: How, distance: Any, other: Any, ratio: float) -> Any:
    """Both as one number: the longer of them, of which the second counts so much more, so that it is low where both
    are; or how far things will be in so long a time."""
    if how == "soon":
        return distance - ratio * other
    return _numbers_of(distance).maximum(distance, ratio * other)


def shortest(lengths: Any, k: int) -> Any:
    """(...,) the k-th shortest of lengths (..., K)."""
    return _numbers_of(lengths).sort(lengths, axis=-1)[..., k - 1]


def _length(vectors: Any) -> Any:
    return ((vectors**2).sum(-1) + 1e-9) ** 0.5


def _numbers_of(array: Any) -> Any:
    return jnp if isinstance(array, jax.Array) else np
