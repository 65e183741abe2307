"""Files appear whole or not at all; a folder belongs to one process at a time. What can be made again has its place."""

from __future__ import annotations

import errno
import glob
import os
import tempfile
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import platformdirs
from filelock import FileLock

from ringfence.errors import UserError, reading
from ringfence.utils import interrupts

NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)  # a file system without locks: one process is up to the user
LONGEST = 200  # bytes of a name: what is written beside it has a longer one
LOOSE = 100 * 2**20  # bytes that a file may claim beyond four times its size


def cache_dir() -> Path:
    """$RINGFENCE_HOME, else the user's cache folder."""
    if home := os.environ.get("RINGFENCE_HOME"):
        return Path(home)
    try:
        found = platformdirs.user_cache_path("ringfence", appauthor=False)
    except RuntimeError:
        found = Path("~")  # as older versions leave it where nobody knows the user's home
    if not found.is_absolute():
        raise UserError("This user has no home folder to keep data in; set RINGFENCE_HOME to a folder.")
    return found


def elsewhere(path: Path) -> str:
    """What helps where a file cannot be written: who chose its place chooses another."""
    with suppress(UserError):
        if path.absolute().is_relative_to(cache_dir().absolute()):
            return "set RINGFENCE_HOME to another folder"
    return "choose another place"


@contextmanager
def whole(path: str | os.PathLike) -> Iterator[Path]:
    """Yields a temporary path beside `path` that is renamed to it on success and removed on any failure.

    A full disk or a folder that cannot be written becomes a `UserError`; whatever stood at `path` stays as it was. A
    link is followed; what is no regular file (a device, a folder, a pipe) is refused. What a killed writer of the same
    file left behind is removed. Who may read it follows the umask, whatever the library that writes it thinks.
    """
    path = writable(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for part in path.parent.glob(f".{glob.escape(path.name)}.*.part"):  # whose writers may be gone
            writer = part.name.removesuffix(".part").rpartition(".")[2]
            if writer.isdigit() and not _alive(int(writer)):
                _remove(part)
        interrupts.unfinished.add(temporary)
        temporary.touch()
        mode = temporary.stat().st_mode & 0o777  # the umask itself can only be read by changing it for all threads
        yield temporary
        temporary.chmod(mode)
        os.replace(temporary, path)
    except OSError as error:
        _remove(temporary)
        why = str(error).splitlines()[0]  # some libraries say it in many lines
        raise UserError(f"'{path}' could not be written ({why}); free some space or {elsewhere(path)}.") from error
    except BaseException:
        _remove(temporary)
        raise
    finally:
        interrupts.unfinished.discard(temporary)


def place(given: str | os.PathLike) -> Path:
    """The path that somebody gave; what is none is refused."""
    try:
        return Path(given)
    except TypeError:
        raise UserError(f"{given!r:.60} is no path; give a file's or a folder's.") from None


def writable(path: str | os.PathLike) -> Path:
    """The path, links followed, if a file may be written there; refused before any work is done."""
    path = place(path)
    if not path.name or not str(path).strip() or "\0" in str(path):
        raise UserError(f"'{path}' names no file; give a file's name.")
    try:
        path = path.resolve() if path.is_symlink() else path
        there = path.exists()
        kind_fits = not there or path.is_file()
        above = path if there else next(p for p in path.absolute().parents if p.exists())
        holds = above.is_dir() or above is path
        allowed = os.access(above if above.is_dir() else above.parent, os.W_OK)
    except OSError as error:  # a name that is too long
        raise UserError(f"'{path}' could not be written ({error.strerror}); choose another name.") from None
    if not kind_fits:
        raise UserError(f"'{path}' is no regular file; choose another place.")
    if not holds:
        raise UserError(f"'{path}' could not be written: '{above}' is a file, no folder; {elsewhere(path)}.")
    if not allowed:
        raise UserError(f"'{path}' could not be written: '{above}' may not be written to; {elsewhere(path)}.")
    if any(len(os.fsencode(part)) > LONGEST for part in path.parts):
        raise UserError(f"'{path}' could not be written (File name too long); choose another name.")
    try:
        with tempfile.TemporaryFile(dir=above if above.is_dir() else above.parent):  # rights tell nothing of /proc
            return path
    except OSError as error:
        raise UserError(
            f"'{path}' could not be written: '{above}' takes no file ({error.strerror}); {elsewhere(path)}."
        ) from None


def regular(path: str | os.PathLike) -> Path:
    """The path, if a file lies there that can be read to its end; `ValueError` names what it is else. A pipe would be
    waited for, a device read for ever."""
    path = Path(path)
    if not path.exists():
        raise ValueError("it is not there")
    if not path.is_file():
        raise ValueError("it is a folder" if path.is_dir() else "it is no regular file")
    return path


def within(folder: str | os.PathLike, path: str | os.PathLike) -> Path:
    """The path, if it lies in the folder, links followed; `ValueError` otherwise: what others wrote must not show, or
    overwrite, what lies elsewhere."""
    if not Path(path).resolve().is_relative_to(Path(folder).resolve()):
        raise ValueError(f"it is a link out of '{folder}'")
    return Path(path)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True


def _remove(file: Path) -> None:
    """Where a folder of the path is a file, there is nothing to remove, and the system says so with an error."""
    with suppress(OSError):
        file.unlink()


@contextmanager
def alone(file: Path) -> Iterator[None]:
    """Wait until nobody else is between reading, changing and writing what this lock file stands for."""
    lock = FileLock(file)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except NotImplementedError:
        pass
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise UserError(
                f"'{file.parent}' could not be locked ({error}); make it a folder you may write to."
            ) from error
    try:
        yield
    finally:
        lock.release()


@contextmanager
def owned(folder: Path, taken: str) -> Iterator[int]:
    """Hold a folder's lock, or refuse with the sentence `taken` where another process does; it frees itself when its
    holder and all processes that inherited it are gone, however they went.

    The descriptor is handed to workers, which filelock neither gives nor leaves to them: it unlocks for all at once.
    """
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


def read_npy(path: Path) -> np.ndarray:
    """An array of numbers, unread until it is used; nothing is unpickled, and a header that lies is refused before it
    is believed."""
    with reading(path, ".npy file of numbers"):
        array = np.load(regular(path), mmap_mode="r", allow_pickle=False)
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
            raise ValueError(f"it holds {getattr(array, 'dtype', 'an archive')}")
    return array


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Arrays of numbers, or ValueError: nothing is unpickled, and no more is unpacked than a file of that size may
    claim."""
    regular(path)
    try:
        with zipfile.ZipFile(path) as packed:
            claimed = sum(member.file_size for member in packed.infolist())
        stored = path.stat().st_size
        if claimed > 4 * stored + LOOSE:
            raise ValueError(f"it claims {claimed / 2**20:.0f} MiB and holds {stored / 2**20:.1f}")
        with np.load(path, allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in arrays.files}
    except ValueError:
        raise
    except Exception as error:  # a damaged file raises anything: BadZipFile, zlib's error, EOFError, MemoryError, ...
        raise ValueError((str(error).splitlines() or [type(error).__name__])[0]) from error
    for name, array in found.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
            raise ValueError(f"'{name}' is no array of numbers")
    return found
