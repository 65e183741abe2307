"""Numbers as a person reads them."""

from __future__ import annotations


def significant(x: float, digits: int = 2) -> str:
    """So many significant digits, without an exponent where a number is a usual one: 100 and not 1e+02."""
    return f"{float(f'{x:.{digits}g}'):g}"


def percent(share: float, digits: int = 2) -> str:
    """A share as a percentage."""
    return f"{significant(100 * share, digits)} %"
