"""Ctrl-C at the command line: never swallowed, and never in the middle of native work.

Python raises KeyboardInterrupt wherever it stands, and where that is inside a callback or a destructor, it is printed
and forgotten. Here it is remembered, and raised again at the next step of whatever shows progress.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_asked = False
_held = 0


def listen() -> None:
    """Take over Ctrl-C in this process; a library that is imported leaves it to its user."""
    global _asked
    _asked = False
    with suppress(ValueError):  # not in the main thread
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as in the background, where nobody means us
            signal.signal(signal.SIGINT, _heard)


def _heard(signum, frame) -> None:
    global _asked
    _asked = True
    if not _held:
        raise KeyboardInterrupt


def check() -> None:
    """Raise what was asked for, if it has not ended this process yet."""
    if _asked:
        raise KeyboardInterrupt


@contextmanager
def held() -> Iterator[None]:
    """Finish this first: native threads that are at work must not be left when the interpreter goes."""
    global _held
    _held += 1
    try:
        yield
    finally:
        _held -= 1
    if not _held:
        check()
