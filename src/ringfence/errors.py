"""Errors that are a user's to mend: one sentence that names the offender, the rule and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path


class UserError(ValueError):
    """Bad input, refused before work starts. The command line prints the message alone, without a traceback."""


class StoreError(UserError):
    """An episode store breaks its contract."""


class CheckpointError(UserError):
    """A checkpoint is truncated, foreign or incomplete."""


class RunConflict(UserError):
    """A run folder holds another job than the one that is to be trained there."""

    def __init__(self, message: str, folder: Path):
        super().__init__(message)
        self.folder = folder


def unknown(kind: str, name: str, known: Iterable[str]) -> UserError:
    """`UserError` for a name that is not in `known`, suggesting the nearest one."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    hint = f"did you mean '{near[0]}'? Known:" if near else "choose one of:"
    return UserError(f"Unknown {kind} '{name}'; {hint} {', '.join(known)}.")
