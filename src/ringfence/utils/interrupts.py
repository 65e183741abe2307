"""Ctrl-C at the command line: honoured wherever the process is, and never in the middle of something.

Python would raise KeyboardInterrupt wherever it stands. Inside a callback or a destructor that is printed and
forgotten, or ends the process in a crash, and native work that takes minutes hears nothing of it. Here it is remembered
and raised at the next `check`. Where none comes within a moment, or it is pressed again, a thread ends the process and
removes what is half written.
"""

from __future__ import annotations

import os
import select
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from socket import socket, socketpair

STATUS = 130  # of a process that Ctrl-C ended
MOMENT = 2.0  # s within which it is to be honoured
BOUNCE = 0.3  # s within which it is one press that several processes tell of
unfinished: set[Path] = set()  # files and folders that are being written
given_up_by: ContextVar[threading.Event | None] = ContextVar("given_up_by", default=None)  # of work beside other work
_asked = False
_honoured = False
_held: dict[object, object] = {}  # what is kept, by who finishes something first
_told: tuple[socket, socket] | None = None  # into one of which the system writes at once, whatever Python does


def listen() -> None:
    """Take over Ctrl-C in this process; a library that is imported leaves it to its user."""
    global _asked, _honoured, _told
    _asked = _honoured = False
    if _handle(_heard) and _told is None:
        _told = socketpair()
        _told[1].setblocking(False)
        signal.set_wakeup_fd(_told[1].fileno(), warn_on_full_buffer=False)
        threading.Thread(target=_insist, args=(_told[0],), daemon=True).start()


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


def _handle(handler) -> bool:
    with suppress(ValueError):  # not in the main thread
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as in the background, where nobody means us
            signal.signal(signal.SIGINT, handler)
            return True
    return False


def _heard(signum, frame) -> None:
    global _asked
    _asked = True


def _insist(told: socket) -> None:
    """End this process where it does not end itself."""
    global _asked
    while told.recv(1)[0] != signal.SIGINT:
        pass
    _asked, begun = True, time.monotonic()
    while any(list(_held.values())) or _honoured or time.monotonic() - begun < MOMENT:
        if select.select([told], [], [], 0.05)[0]:
            again = told.recv(1)[0] == signal.SIGINT
            if again and time.monotonic() - begun > BOUNCE:
                break
    for file in list(unfinished):
        with suppress(OSError):
            shutil.rmtree(file) if file.is_dir() else file.unlink()
    shown = "\033[?25h\n" * sys.stderr.isatty()  # the cursor, which a bar hides
    with suppress(OSError):  # whoever else writes may hold the streams
        os.write(2, f"{shown}interrupted\n".encode())
    os._exit(STATUS)


def asked() -> bool:
    """Whether Ctrl-C was pressed."""
    return _asked


def check() -> None:
    """Raise what was asked for, if it has not ended this process yet; also in work that nobody waits for any more."""
    global _honoured
    if (given_up := given_up_by.get()) is not None and given_up.is_set():
        raise KeyboardInterrupt
    if _asked and threading.current_thread() is threading.main_thread():
        _honoured = True
        raise KeyboardInterrupt


@contextmanager
def held(kept: object = True) -> Iterator[None]:
    """Finish this first, or get to a check, as long as there is something to be `kept`."""
    mine = object()
    _held[mine] = kept
    try:
        yield
    finally:
        del _held[mine]
    check()
