"""Numbers as a person reads them, and names with numbers in the order in which people count."""

from __future__ import annotations

import re

import numpy as np

_DIGITS = re.compile(r"([0-9]+)")


def natural(name: str) -> tuple[list[str | tuple[int, str]], str]:
    """What to sort names by: numbers in them by their value, the rest as text."""
    parts: list[str | tuple[int, str]] = [*_DIGITS.split(name)]
    for k in range(1, len(parts), 2):  # which are digits; of any length, as text
        value = str(parts[k]).lstrip("0")
        parts[k] = len(value), value
    return parts, name


def numbered(column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different names of a column (M,), numbers by value and text in natural order, and (M,) whose is each row."""
    names, owner = np.unique(column, return_inverse=True)
    if names.dtype.kind not in "UO":
        return names, owner
    order = sorted(range(len(names)), key=lambda k: natural(str(names[k])))
    return names[order], np.argsort(order)[owner]


def significant(x: float, digits: int = 2) -> str:
    """So many significant digits, without an exponent where a number is a usual one: 100 and not 1e+02."""
    return f"{float(f'{x:.{digits}g}'):g}"


def percent(share: float, digits: int = 2) -> str:
    """A share as a percentage."""
    return f"{significant(100 * share, digits)} %"
