"""Compiled programs are kept from one process to the next, so that a command's second run starts at once.

JAX can keep what XLA compiled in a folder. `keep_programs` gives it one below `cache_dir()`, bounded in size and shared
safely by processes. It is called where work begins (commands, `Controller`, `train`, `fit`, `play`, `evaluate`), never
on `import ringfence`.

    RINGFENCE_COMPILATION_CACHE=0          nothing is kept
    RINGFENCE_COMPILATION_CACHE=FOLDER     kept there
    JAX_COMPILATION_CACHE_DIR, or jax.config's: whoever has chosen a folder, or none, keeps to it
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import jax

from ringfence.errors import UserError
from ringfence.utils.files import cache_dir

VARIABLE = "RINGFENCE_COMPILATION_CACHE"
# JAX's options: what they are by default, and here. What was not used for longest goes first. JAX looks through
# the folder whenever it adds a program, so it is kept small, and programs that compile at once are left out.
OPTIONS = {
    "compilation_cache_max_size": (-1, 2**28),  # bytes
    "persistent_cache_min_compile_time_secs": (1.0, 0.1),
}
OFF = ("0", "off", "false", "no")
ON = ("", "1", "on", "true", "yes")

_log = logging.getLogger(__name__)


@cache
def keep_programs() -> Path | None:
    """Keep compiled programs from here on; the folder, or None where nothing is kept or the user has chosen one.

    A folder that cannot be written to is passed over: it costs time and nothing else.
    """
    if _option("compilation_cache_dir") is not None or not _option("enable_compilation_cache"):
        return None
    folder = _folder()
    if folder is None:
        return None
    for name, (usual, ours) in OPTIONS.items():
        if _option(name) == usual:  # else the user has chosen
            jax.config.update(f"jax_{name}", ours)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    with suppress(ImportError, AttributeError):  # of a later version: it counts from the next process's first program
        from jax.experimental.compilation_cache import compilation_cache

        # JAX looks at its settings once, at the first program; one may have been compiled already.
        compilation_cache.reset_cache()
    return folder


def _option(name: str) -> Any:
    """Of JAX's configuration; None where this version has no such option."""
    return getattr(jax.config, f"jax_{name}", None)


def _folder() -> Path | None:
    """Where programs are kept, made and tried; None where they are not."""
    chosen = os.environ.get(VARIABLE, "").strip()
    if chosen.lower() in OFF:
        return None
    try:
        root = cache_dir() / "compiled" if chosen.lower() in ON else Path(chosen)
        folder = root / _machine()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, UserError, ValueError) as error:
        _log.debug("compiled programs are not kept: %s", error)
        return None
    if not os.access(folder, os.W_OK | os.X_OK):
        _log.debug("compiled programs are not kept: '%s' may not be written to", folder)
        return None
    return folder


def _machine() -> str:
    """A name for processors of this kind: programs are compiled for its instructions, and a home folder may be shared
    by several machines."""
    flags = ""
    try:
        with open("/proc/cpuinfo") as lines:
            flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:
        pass
    words = " ".join(sorted(flags.split()))
    return hashlib.blake2b(f"{platform.machine()} {words}".encode(), digest_size=6).hexdigest()
