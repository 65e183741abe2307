"""Errors that are a user's to mend: one sentence that names the offender, the rule and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

LAST_SEED = 2**31 - 1  # that JAX takes everywhere


class UserError(ValueError):
    """Bad input, refused before work starts. The command line prints the message alone, without a traceback, so what
    it quotes of a stranger's file is kept from breaking lines or speaking to the terminal."""

    def __str__(self) -> str:
        return plain(super().__str__())


class NoSafeAction(UserError):
    """A policy at run time cannot act: what it was given, or what came of it, cannot be acted upon. `last_action` is
    the last one that was (N, A), None before the first."""

    def __init__(self, message: str, last_action: Any = None):
        super().__init__(message)
        self.last_action = last_action


class Interrupted(KeyboardInterrupt):
    """Ctrl-C while episodes were played. `finished` is what was made of those that had ended: a summary, or a store;
    None where none had."""

    def __init__(self, message: str, finished: Any = None):
        super().__init__(message)
        self.finished = finished


class StoreError(UserError):
    """An episode store breaks its contract."""


class CheckpointError(UserError):
    """A checkpoint is truncated, foreign or incomplete."""


class RunConflict(UserError):
    """A run folder holds another job than the one that is to be trained there."""

    def __init__(self, message: str, folder: Path):
        super().__init__(message)
        self.folder = folder


def plain(text: str) -> str:
    """The text on one line, with what no terminal and no file can show as escapes."""
    shown = (c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)
    return "".join(shown)


def whole_number(name: str, value, low: int = 0, high: int = 10**9) -> int:
    """A count that somebody gave, in bounds; anything else is refused by its name."""
    number = value if isinstance(value, int) else getattr(value, "item", lambda: None)()  # NumPy's, too
    if isinstance(number, bool) or not isinstance(number, int) or not low <= number <= high:
        raise UserError(f"{name}={str(value)[:60]} must be a whole number from {low:,} to {high:,}.")
    return number


def known(name: str, value: Any, choices: Iterable[str]) -> None:
    """Refuse a value that is none of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise UserError(f"{name}={str(value)[:60]!r} is none of its choices; take one of: {', '.join(choices)}.")


def unknown(kind: str, name: str, known: Iterable[str]) -> UserError:
    """`UserError` for a name that is not in `known`, suggesting the nearest one."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    hint = f"did you mean '{near[0]}'? Known:" if near else "choose one of:"
    return UserError(f"Unknown {kind} '{name}'; {hint} {', '.join(known)}.")
