"""Files appear whole or not at all; a folder belongs to one process at a time."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ringfence.errors import UserError


@contextmanager
def whole(path: str | os.PathLike) -> Iterator[Path]:
    """Yields a temporary path beside `path` that is renamed to it on success and removed on any failure.

    A full disk or a folder that cannot be written becomes a `UserError`; whatever stood at `path` stays as it was.
    """
    path = Path(path)
    if not path.name:
        raise UserError(f"'{path}' names no file; give a file's name.")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        _remove(temporary)
        raise UserError(f"'{path}' could not be written ({error}); free some space or choose another place.") from error
    except BaseException:
        _remove(temporary)
        raise


def _remove(file: Path) -> None:
    """Where a folder of the path is a file, there is nothing to remove, and the system says so with an error."""
    with suppress(OSError):
        file.unlink()


@contextmanager
def owned(folder: Path, taken: str) -> Iterator[int]:
    """Hold a folder's lock, or refuse with the sentence `taken` where another process does; it frees itself when its
    holder and all processes that inherited it are gone, however they went."""
    try:
        import fcntl
    except ImportError:  # no such locks here: one process per folder is then up to the user
        yield -1
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT)
    except OSError as error:
        raise UserError(f"'{folder}' could not be locked ({error}); choose a folder that you may write to.") from error
    try:
        for attempt in range(20):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if attempt == 19:
                    raise UserError(taken) from None
                time.sleep(0.25)
            except OSError:  # a file system without locks: as above
                break
        yield file
    finally:
        os.close(file)
