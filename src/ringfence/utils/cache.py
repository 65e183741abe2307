"""Where regenerated data and fitted Worlds are kept."""

from __future__ import annotations

import os
from pathlib import Path

from ringfence.errors import UserError


def cache_dir() -> Path:
    """$RINGFENCE_HOME, else the user's cache folder."""
    if home := os.environ.get("RINGFENCE_HOME"):
        return Path(home)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ringfence"
    except RuntimeError:
        raise UserError("This user has no home folder to keep data in; set RINGFENCE_HOME to a folder.") from None
