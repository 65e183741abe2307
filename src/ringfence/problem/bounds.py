"""Bounds of actions: one number for all entries, one of each entry, or these of each agent (types.Bound).

They are kept in the shortest of these forms that says the same, so that data whose entries share their bounds are what
they were before entries had bounds of their own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ringfence.errors import StoreError
from ringfence.types import LARGEST_BOUND, Bound, as_tuples

FORMS = "one number, a list of each entry's, or a list of such lists of each agent"
SLACK = 1e-4  # share of the range by which actions may be outside: bounds went through 32 bits
SHOWN = 120  # letters of a message


class Bounds(NamedTuple):
    """The least and the greatest action."""

    low: Bound
    high: Bound

    @classmethod
    def of(cls, low: Any, high: Any) -> Bounds:
        """The bounds in their shortest form, checked."""
        found = cls(_shortest("action_low", low), _shortest("action_high", high))
        least, greatest = (np.asarray(one) for one in found)
        try:
            sound = bool((least < greatest).all())
        except ValueError:
            raise StoreError(
                f"The card has action_low of shape {least.shape} and action_high of shape {greatest.shape}; give both "
                "in one shape."
            ) from None
        if not sound:
            raise StoreError(
                f"The card has action_low={_written(found.low)} and action_high={_written(found.high)}; "
                "the first must be the smaller one" + (" in every entry." if least.ndim or greatest.ndim else ".")
            )
        return found

    @property
    def middle(self) -> np.ndarray:
        return 0.5 * (np.asarray(self.low) + np.asarray(self.high))

    @property
    def slack(self) -> np.ndarray:
        """What is taken for rounding, of each entry."""
        return SLACK * (np.asarray(self.high) - np.asarray(self.low))

    def outside(self, actions: np.ndarray) -> np.ndarray:
        """(..., N, A) bool: which entries of actions (..., N, A) lie outside by more than rounding."""
        return (actions < np.asarray(self.low) - self.slack) | (actions > np.asarray(self.high) + self.slack)

    def fit(self, agents: int, entries: int) -> bool:
        """Whether these are bounds of so many agents with so many entries each."""
        return all(np.shape(one) in ((), (entries,), (agents, entries)) for one in self)

    def of_entry(self, agent: int, entry: int) -> Bounds:
        """Those of one entry."""
        shape = np.broadcast_shapes(np.shape(self.low), np.shape(self.high), (agent + 1, entry + 1))
        return Bounds(*(float(np.broadcast_to(one, shape)[agent, entry]) for one in self))

    def of_agent(self, agent: int) -> Bounds:
        """Those of one agent."""
        return Bounds(*(as_tuples(np.asarray(one)[agent].tolist()) if np.ndim(one) == 2 else one for one in self))

    @property
    def by_agent(self) -> bool:
        """Whether agents differ in their bounds."""
        return max(np.ndim(self.low), np.ndim(self.high)) > 1

    def __str__(self) -> str:
        return f"{_written(self.low)} to {_written(self.high)}"


def stored(bound: Bound) -> float | list:
    """A bound as JSON holds it."""
    return np.asarray(bound, np.float64).tolist()


def _shortest(name: str, given: Any) -> Bound:
    """A bound in its shortest form; what is none is refused."""
    try:
        if isinstance(given, np.ma.MaskedArray):
            raise TypeError
        numbers = np.asarray(given)
        if numbers.dtype.kind not in "iuf" or not numbers.size or numbers.ndim > 2:
            raise TypeError
        numbers = numbers.astype(np.float64)
        if not (np.abs(numbers) <= LARGEST_BOUND).all():  # NaN included
            raise TypeError
    except (OverflowError, TypeError, ValueError):
        raise StoreError(
            f"The card has {name}={repr(given)[:SHOWN]}; it must be {FORMS}, all of them finite."
        ) from None
    if numbers.ndim == 2 and (numbers == numbers[:1]).all():
        numbers = numbers[0]
    if (numbers == numbers.flat[0]).all():
        return float(numbers.flat[0])
    return as_tuples(numbers.tolist())


def _written(bound: Bound) -> str:
    """A bound in few letters."""
    if not isinstance(bound, tuple):
        return f"{bound:g}"
    text = "[" + ", ".join(_written(one) for one in bound) + "]"
    return text if len(text) <= SHOWN else text[: SHOWN - 1] + "…"
