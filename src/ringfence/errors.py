"""Errors that are a user's to mend: one sentence that names the offender, the rule and the remedy."""

from __future__ import annotations

import difflib
import operator
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from numbers import Real
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")
LAST_SEED = 2**31 - 1  # that JAX takes everywhere
LONGEST = 4000  # letters of a message
SHOWN = 100  # names that a refusal lists
LONG = 60  # letters of each of them
FARTHEST = 1e30  # of numbers that count anything


class UserError(ValueError):
    """Bad input, refused before work starts. The command line prints the message alone, without a traceback, so what
    it quotes of a stranger's file is kept from breaking lines, speaking to the terminal or filling it."""

    def __str__(self) -> str:
        text = super().__str__()
        if len(text) > LONGEST:
            text = f"{text[: LONGEST // 2]} … {text[-LONGEST // 4 :]}"
        return plain(text)


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


class Missing(UserError, ImportError):
    """A package that the core goes without is asked for."""


class NoWorld(UserError):
    """A run is to be played with a World that is nowhere, and whose data this package can make again. `execution` is
    that of the World."""

    def __init__(self, message: str, folder: Path, execution: str):
        super().__init__(message)
        self.folder = folder
        self.execution = execution


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
    try:
        number = operator.index(value)  # NumPy's, too
    except TypeError:
        number = None
    if isinstance(value, bool) or number is None or not low <= number <= high:
        raise UserError(f"{name}={str(value)[:60]} must be a whole number from {low:,} to {high:,}.")
    return number


def above_zero(name: str, value: Any, unit: str) -> float:
    """A finite number that somebody gave, above 0; anything else is refused by its name."""
    number: Any = value if isinstance(value, Real) and not isinstance(value, bool) else 0
    if not 0 < number < FARTHEST:
        raise UserError(f"{name}={value!r:.60} must be a number of {unit} above 0.")
    return float(number)


def of_kind(name: str, value: Any, kind: Any, remedy: str) -> None:
    """Refuse a value of another kind."""
    if not isinstance(value, kind):
        raise UserError(f"{name} is a {type(value).__name__}; {remedy}.")


def known(name: str, value: Any, choices: Iterable[str]) -> None:
    """Refuse a value that is none of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise UserError(f"{name}={str(value)[:60]!r} is none of its choices; take one of: {', '.join(choices)}.")


def unknown(kind: str, name: Any, known: Iterable[str]) -> UserError:
    """`UserError` for a name that is not in `known`, suggesting the nearest one. A file may know millions."""
    known = sorted(islice(known, 10 * SHOWN))
    name = str(name)[:LONGEST]
    near = difflib.get_close_matches(name[:LONG], [one[:LONG] for one in known], n=1, cutoff=0.4)
    hint = f"did you mean '{near[0]}'? Known:" if near else "choose one of:"
    more = f" and {len(known) - SHOWN} more" if len(known) > SHOWN else ""
    return UserError(f"Unknown {kind} '{name}'; {hint} {', '.join(one[:LONG] for one in known[:SHOWN])}{more}.")


def one_of(kind: str, name: Any, known: Mapping[str, T]) -> T:
    """What is called so; a name that is not in `known`, or no name, is refused."""
    if not isinstance(name, str) or name not in known:
        raise unknown(kind, name, known)
    return known[name]


def reason(error: BaseException) -> str:
    """Why, in one line: the first of what a library says."""
    lines = str(error).strip().splitlines()
    kind = "" if isinstance(error, OSError | ValueError) and lines else type(error).__name__
    return ": ".join(part for part in (kind, lines[0][:200].rstrip(".") if lines else "") if part)


@contextmanager
def needs(extra: str, use: str) -> Iterator[None]:
    """Import packages that the core goes without: one that is missing, or does not load, becomes a refusal that says
    how to get it."""
    try:
        yield
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        if package == __package__:
            raise
        missing = isinstance(error, ModuleNotFoundError) and package
        why = f"{package}, which is missing" if missing else f"what does not load here ({reason(error)})"
        raise Missing(f"{use} need {why}; run pip install 'ringfence[{extra}]'.") from error


@contextmanager
def reading(
    path: str | Path, what: str, remedy: str = "copy it again", kind: type[UserError] = StoreError
) -> Iterator[None]:
    """Read what a stranger wrote, which is to be `what`: anything that a library raises at it, documented or not,
    becomes a refusal that names the file."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise kind(f"'{path}' is truncated, damaged or no {what} ({reason(error)}); {remedy}.") from error
