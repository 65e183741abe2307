"""A log that shows whether it was changed: one record a line, each with a digest of itself and of the record before.

    3f1c… {"n":0,"kind":"begin",…}
    a07b… {"n":1,"kind":"step",…}

Records are only added, each in one write. Whoever can write the file can make the whole chain anew, or cut off its end,
so the last digest has to be kept elsewhere where that matters (`check(file, last=)`).
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

from ringfence.errors import UserError
from ringfence.utils import schemas
from ringfence.utils.files import regular, writable

BEFORE_ALL = "ringfence log 1"  # what the first record follows
SIZE = 16  # bytes of a digest
LONGEST = 2**24  # bytes of a record: more is none of ours


class LogError(UserError):
    """A log is not what was written. `record` is the number of the first record that is not."""

    def __init__(self, message: str, record: int):
        super().__init__(message)
        self.record = record


class Record(TypedDict):
    """What every record has."""

    n: int
    kind: str


@dataclass(frozen=True)
class Checked:
    """What a whole log came to."""

    records: int
    last: str  # digest of the last record
    ended: bool  # by its writer; else it was stopped, or the end was cut off


class ChainedLog:
    """Adds records to a file, which one writer has at a time."""

    def __init__(self, path: str | Path):
        self.path = writable(path)
        there = self.path.exists()
        found = check(self.path) if there and self.path.stat().st_size > 0 else Checked(0, BEFORE_ALL, True)
        self.records = found.records
        self.last = found.last
        try:
            self._file: int | None = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        except OSError as error:
            raise UserError(f"'{path}' could not be written ({error.strerror}); choose another place.") from error
        self._fresh = False
        self._own()
        self._fresh = not there  # holds nothing of anybody's
        self._size = os.fstat(self._file).st_size  # bytes of whole records

    def _own(self) -> None:
        """Hold the file, where the system has locks."""
        try:
            import fcntl
        except ImportError:
            return
        assert self._file is not None, "it was just opened"
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            raise UserError(f"'{self.path}' is written by another process; give each a file of its own.") from None
        except OSError:
            pass  # a file system without locks: one writer is up to the user

    def add(self, record: Mapping[str, Any]) -> str:
        """Write a record; its digest."""
        if self._file is None:
            raise UserError(f"'{self.path}' was closed, and nothing is added to it; begin another log.")
        try:
            body = json.dumps({"n": self.records, **record}, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
        except (TypeError, ValueError) as error:
            raise UserError(
                f"A record of '{self.path}' is not JSON ({error}); give numbers, words and lists."
            ) from error
        digest = _digest(self.last, body)
        line = f"{digest} {body}\n".encode()
        try:
            written = os.write(self._file, line)
        except OSError as error:
            raise UserError(f"'{self.path}' could not be written ({error.strerror}); free some space.") from error
        if written < len(line):
            self._take_back()
            raise UserError(f"'{self.path}' could not be written (the disk is full); free some space.")
        self._size += written
        self.records += 1
        self.last = digest
        return digest

    def _take_back(self) -> None:
        """Cut off what was written of a record: the next one would stand behind it on its line."""
        assert self._file is not None, "it was just written"
        try:
            os.ftruncate(self._file, self._size)
        except OSError:
            self.close()  # nothing can be added any more; what stands there says so

    def close(self) -> None:
        """Give the file back; without a record nothing is left."""
        if self._file is not None:
            if self._fresh and not self.records:
                with suppress(OSError):
                    self.path.unlink()
            with suppress(OSError):
                os.close(self._file)
        self._file = None


def records(path: str | Path) -> Iterator[dict[str, Any]]:
    """The records of a log in order, each as soon as it is known to be what was written; the first that is not ends
    them with a `LogError`."""
    before = BEFORE_ALL
    try:
        file = regular(path).open("rb")
    except (ValueError, OSError) as error:
        raise UserError(f"'{path}' is no log ({error}); give a file that Controller(log=) wrote.") from error
    with file:
        for number, line in enumerate(iter(lambda: file.readline(LONGEST), b"")):
            before, record = _read(path, number, line, before)
            yield record


def check(path: str | Path, last: str | None = None) -> Checked:
    """Read a whole log. `last` is the digest of a record that it must hold: that of the last one when it was kept."""
    count = 0
    kind = ""
    digest = BEFORE_ALL
    held = last is None
    for record in records(path):
        count += 1
        kind = record["kind"]
        digest = record["digest"]
        held = held or digest == last
    if not count:
        raise UserError(f"'{path}' is empty; give a file that Controller(log=) wrote.")
    if not held:
        raise LogError(
            f"'{path}' lacks the record of digest {last}: its end was cut off, or all of it was made anew.", count
        )
    return Checked(count, digest, kind == "end")


def _read(path: str | Path, number: int, line: bytes, before: str) -> tuple[str, dict[str, Any]]:
    """(digest, record) of a line, or a refusal that names the record."""
    if not line.endswith(b"\n"):
        raise LogError(
            f"'{path}': record {number} is cut: its writer was stopped within it, or the file was cut.", number
        )
    try:
        digest, body = line[:-1].decode().split(" ", 1)
        record = schemas.decode(body, Record)
    except ValueError as error:
        raise LogError(
            f"'{path}': record {number} is none ({error}); it was changed, or this is no log.", number
        ) from None
    if record["n"] != number:
        raise LogError(f"'{path}' lacks record {number}: record {record['n']} stands in its place.", number)
    if digest != _digest(before, body):
        raise LogError(
            f"'{path}': record {number} is not what was written: it was changed, or the one before it.", number
        )
    return digest, record | {"digest": digest}


def _digest(before: str, body: str) -> str:
    return hashlib.blake2b(f"{before} {body}".encode(), digest_size=SIZE).hexdigest()
