"""What the logs have shown: one's own entries within their range, and nobody nearer than anybody came.

A guard that turns away from a danger that it knows may drive into one that never happened: a wall that no log touches,
an empty battery. Nothing that is logged says how far beyond the logs it is safe, so a guard stays within them
(`within_logs`). This is the support constraint of offline learning, on predicted rows.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError
from ringfence.guards.correction import ASKED
from ringfence.problem.entries import Entries
from ringfence.types import Array
from ringfence.world import World, cause_candidates
from ringfence.world.causes import Cause

STEEP = 100.0  # margins for the whole range: one is a hundredth of it
SLACK = 1e-3  # of the range: predictions of what is at its end are off by so little
LOOSE = 0.05  # the same of what is no place, in rows that are far ahead
FAR = 10.0  # times the range inside it, of what has no range


class Shown(eqx.Module):
    """Ranges that the logs have shown."""

    low: tuple[float, ...] = eqx.field(static=True)  # of entries
    high: tuple[float, ...] = eqx.field(static=True)
    entries: tuple[int, ...] = eqx.field(static=True)
    places: tuple[bool, ...] = eqx.field(static=True)  # of these: what goes on by a velocity
    nearest: tuple[tuple[Cause, float, float], ...] = eqx.field(static=True)  # least length, and range of it

    @classmethod
    def by(cls, world: World) -> Shown:
        """What the logs of a World have shown, as its card says."""
        ranges = world.card.data.ranges
        if not ranges:
            raise UserError(
                "within_logs needs a World that says what its logs have shown, and this one is of an earlier version; "
                "fit it again."
            )
        names = list(world.map.names)
        known = _varying(world)
        low, high = (tuple(ranges[name][k] for name in known) for k in range(2))
        lengths = _lengths(world)
        if not known and not lengths:
            raise UserError(
                "within_logs keeps to what varies in the logs, and no entry of an agent does; leave it out."
            )
        nearest = tuple((one, ranges[one.name][0], ranges[one.name][1] - ranges[one.name][0]) for one in lengths)
        going = _going(names)
        places = tuple(names.index(name) in going for name in known)
        return cls(low, high, tuple(names.index(name) for name in known), places, nearest)

    def along(self, x: Array) -> Array:
        """(..., K, N) of predicted rows (..., K, N, D). Places count in all of them, since it may take long to brake.
        What is no place may leave its range by a little after the rows for which a proposal is held: cars that brake
        are predicted to come to less than a stop."""
        soon = self.score(x[..., :ASKED, :, :])
        slack = np.where(self.places, SLACK, LOOSE)
        later = _in_margins((self._inside(x[..., ASKED:, :, :]) + slack).min(-1, initial=FAR))
        return jnp.concatenate([soon, later], -2)

    @staticmethod
    def known(world: World) -> bool:
        """Whether a World says what its logs have shown of what is an agent's own. Without names it is any entry, goals
        among them, and nobody can keep to all."""
        return bool(_lengths(world)) or any(name.startswith("own.") for name in _varying(world))

    def score(self, x: Array) -> Array:
        """(..., N) of features (..., N, D), in margins: 1 at the end of what was shown, more inside, a half where that
        is as far outside as it is wide, and never below 0, so that danger that is known counts for more."""
        inside = [self._inside(x)]
        for cause, least, width in self.nearest:
            inside.append((cause.of(x)[..., 0] - least) / max(width, 1e-6))
        return _in_margins(jnp.concatenate(inside, -1).min(-1) + SLACK)

    def _inside(self, x: Array) -> Array:
        """(..., N, M) how far within its range every entry is, as a share of that."""
        low, high = np.array(self.low), np.array(self.high)
        read = x[..., np.array(self.entries, int)]
        return jnp.minimum(read - low, high - read) / (high - low)


def _in_margins(inside: Array) -> Array:
    """Scores of so large shares of a range inside it."""
    steps = STEEP * inside
    return jnp.where(steps >= 0, 1.0 + steps, 1.0 / (1.0 + jnp.maximum(-steps, 0.0) / STEEP))


def _going(names: list[str]) -> set[int]:
    """Entries that go on by a velocity: places, and what has a velocity of its name."""
    known = Entries.of(names)
    return {e.source for e in known.each if e.role == "place" or f"v{e.what}" in known.bodies[e.whose, e.order]}


def _varying(world: World) -> list[str]:
    """Entries that vary in the logs, of those whose ranges are known."""
    ranges = world.card.data.ranges or {}
    return [name for name in world.map.names if name in ranges and ranges[name][1] > ranges[name][0]]


def _lengths(world: World) -> list[Cause]:
    """How far things are away, of the kinds whose ranges are known."""
    ranges = world.card.data.ranges or {}
    return [one for one in cause_candidates.offsets(world.map.names) if one.name in ranges]
