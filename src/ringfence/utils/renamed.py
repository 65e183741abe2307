"""Names of before: they work for one release, with a warning that says the new one; files keep theirs for ever."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from ringfence.errors import UserError


def renamed(given: Mapping[str, Any], names: Mapping[str, str], of: str, *, warn: bool = True) -> dict[str, Any]:
    """`given` under today's names; `names` maps old ones to new ones.

    `of` says whose names they are, e.g. "option of guards". A caller's old name is warned about; what an older version
    wrote (`warn=False`) is read in silence. Both names of one thing are refused.
    """
    found: dict[str, Any] = {}
    for name, value in given.items():
        new = names.get(name, name)
        if new != name and new in given:
            raise UserError(f"{name}= and {new}= are the same {of}; give {new}= alone.")
        if new != name and warn:
            deprecated(f"The {of} '{name}'", f"'{new}'")
        found[new] = value
    return found


def deprecated(what: str, instead: str) -> None:
    """Warn that something goes with the next release."""
    warnings.warn(f"{what} is called {instead} now; the old name goes with the next release.", FutureWarning, 3)
