"""How fast a body that looks into a direction goes ahead, as names of entries tell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import msgspec
import numpy as np

from ringfence.problem.entries import Entries
from ringfence.types import Array

AHEAD = "own speed ahead"  # which names do not give, and which the card has a range of


class Heading(msgspec.Struct, frozen=True):
    """Entries that tell how fast a body that looks into a direction goes ahead: its velocity, or its speed, and that
    direction."""

    velocity: tuple[int, ...]  # two, or the speed
    direction: tuple[int, int]
    relative: tuple[tuple[int, int], ...] = ()  # velocities of things less one's own, and along which axis

    @classmethod
    def of(cls, names: Sequence[str]) -> Heading | None:
        """None where names tell of none."""
        known = Entries.of(names)
        if len(known.direction) < 2:
            return None
        cos, sin = known.direction
        axes = known.axes[:2]
        drifts = [e for e in known.each if e.role == "drift" and e.whose != "own" and e.axis in axes]
        relative = tuple((e.source, axes.index(e.axis)) for e in drifts)
        if velocity := known.pair("v{}"):
            return cls(velocity, (cos, sin), relative)
        return None if known.speed is None else cls((known.speed,), (cos, sin), relative)

    @property
    def about(self) -> tuple[int, ...]:
        """Entries that are relative to the velocity."""
        return tuple(entry for entry, _ in self.relative)

    def speed(self, x: Any) -> Any:
        """(...) ahead, of features (..., D), NumPy's or JAX's: negative of who goes backwards."""
        if len(self.velocity) == 1:
            return x[..., self.velocity[0]]
        cos, sin = (x[..., d] for d in self.direction)
        vx, vy = (x[..., v] for v in self.velocity)
        return (vx * cos + vy * sin) / (cos**2 + sin**2 + 1e-9) ** 0.5

    def no_slower(self, x: Array, least: float) -> Array:
        """Features (..., D) with that speed ahead at least, and what is relative to it as much less."""
        lacks = jnp.maximum(least - self.speed(x), 0.0)[..., None]
        direction = x[..., np.array(self.direction)]
        length = jnp.sqrt((direction**2).sum(-1, keepdims=True) + 1e-9)
        faster = lacks * direction / length
        x = x.at[..., np.array(self.velocity)].add(faster if len(self.velocity) == 2 else lacks)
        if not self.relative:
            return x
        axes = np.array([axis for _, axis in self.relative])
        return x.at[..., np.array(self.about)].add(-faster[..., axes])
