"""Ctrl-C at the command line: never swallowed, and never in the middle of native work.

Python raises KeyboardInterrupt wherever it stands, and where that is inside a callback or a destructor, it is printed
and forgotten. Here it is remembered, and raised again at the next step of whatever shows progress.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

STATUS = 130  # of a process that Ctrl-C ended
_asked = False
_held = 0


def listen() -> None:
    """Take over Ctrl-C in this process; a library that is imported leaves it to its user."""
    global _asked
    _asked = False
    _handle(_heard)


def leave_when_asked() -> None:
    """Until `listen`, end this process at once: nothing was begun."""
    _handle(lambda signum, frame: leave("interrupted"))


def leave(said: str = "") -> None:
    """End this process without taking the interpreter down, under which native threads may still compute."""
    if said:
        print(said, file=sys.stderr)
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(STATUS)


def _handle(handler) -> None:
    with suppress(ValueError):  # not in the main thread
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as in the background, where nobody means us
            signal.signal(signal.SIGINT, handler)


def _heard(signum, frame) -> None:
    global _asked
    _asked = True
    if not _held:
        raise KeyboardInterrupt


def asked() -> bool:
    """Whether Ctrl-C was pressed, though somebody may have swallowed what it raised or made another error of it."""
    return _asked


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
