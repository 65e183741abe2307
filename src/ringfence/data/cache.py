"""Where regenerated data and fitted Worlds are kept."""

from __future__ import annotations

import os
from pathlib import Path


def cache_dir() -> Path:
    """$RINGFENCE_HOME, else the user's cache folder."""
    home = os.environ.get("RINGFENCE_HOME")
    return Path(home) if home else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ringfence"
