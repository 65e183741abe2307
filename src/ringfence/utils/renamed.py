"""Public names of before: they work for one release, with a warning that says today's name."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from ringfence.errors import UserError


def renamed(given: Mapping[str, Any], names: Mapping[str, str], of: str, warn: bool = True) -> dict[str, Any]:
    """What was given by name, under today's names; `names` maps those of before to them. Two names of one choice are
    refused. Without `warn` nothing is said, e.g. of a file that an older version wrote."""
    found: dict[str, Any] = {}
    for name, value in given.items():
        today = names.get(name, name)
        if today != name and today in given:
            raise UserError(f"{today} and {name} are two names of one choice; give {today} alone.")
        if today != name and warn:
            deprecated(f"{name} of {of}", today)
        found[today] = value
    return found


def deprecated(what: str, instead: str) -> None:
    """Warn that a public name goes with the next release."""
    warnings.warn(f"{what} is called {instead} now; the old name goes with the next release.", FutureWarning, 3)
