"""Where regenerated data, fitted Worlds and compiled programs are kept."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import platformdirs

from ringfence.errors import UserError


def cache_dir() -> Path:
    """$RINGFENCE_HOME, else the user's cache folder."""
    if home := os.environ.get("RINGFENCE_HOME"):
        return Path(home)
    try:
        found = platformdirs.user_cache_path("ringfence", appauthor=False)
    except RuntimeError:
        found = Path("~")  # as older versions leave it where nobody knows the user's home
    if not found.is_absolute():
        raise UserError("This user has no home folder to keep data in; set RINGFENCE_HOME to a folder.")
    return found


def elsewhere(path: Path) -> str:
    """What helps where a file cannot be written: who chose its place chooses another."""
    with suppress(UserError):
        if path.absolute().is_relative_to(cache_dir().absolute()):
            return "set RINGFENCE_HOME to another folder"
    return "choose another place"
