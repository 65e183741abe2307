"""Forked processes: they have none of JAX's threads, and wait for them for ever."""

from __future__ import annotations

import os

from ringfence.errors import UserError

_at_work: int | None = None  # the process that JAX works in


def refuse_forked() -> None:
    """Refuse to work in a process that was forked from one in which JAX had worked for this package."""
    global _at_work
    process = os.getpid()
    if _at_work not in (None, process):
        raise UserError(
            "This process was forked from one that JAX had worked in, and would wait for its threads for ever; start "
            'it with multiprocessing.get_context("spawn"), or use threads.'
        )
    _at_work = process
