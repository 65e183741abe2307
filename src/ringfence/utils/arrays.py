"""Arrays of a stranger's HDF5 file, looked at before any of them is read: plain ones, in the file itself, of no more
bytes than the file can hold and this machine can take. And files of one's own, on disks that may be full."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from ringfence.errors import StoreError
from ringfence.utils.files import LOOSE

PACKED = 20  # times its size that a compressed file may unpack to; columns of zeros pack well


def member(path: Path, group: h5py.Group, name: str, label: str | None = None) -> h5py.Group | h5py.Dataset:
    """What lies in a group under that name; `label` is what messages call it. Links are not followed."""
    label = label or name
    found = group[name] if isinstance(group.get(name, getlink=True), h5py.HardLink) else None
    elsewhere = isinstance(found, h5py.Dataset) and (found.external or found.is_virtual)
    if elsewhere or not isinstance(found, h5py.Group | h5py.Dataset):
        raise StoreError(f"'{path}' keeps '{label}' behind a link or in another file; copy it into the file itself.")
    return found


def array(path: Path, group: h5py.Group, name: str, label: str | None = None) -> h5py.Dataset:
    """An array of numbers in a group, unread."""
    label = label or name
    found = member(path, group, name, label)
    if not isinstance(found, h5py.Dataset):
        raise StoreError(f"'{path}' holds a group where the array '{label}' belongs; write the file again.")
    if found.dtype.kind not in "biuf":
        raise StoreError(f"'{path}' holds '{label}' of type {found.dtype}; it must hold numbers.")
    if found.shape is None or not found.shape:
        raise StoreError(f"'{path}' holds no array in '{label}'; write the file again.")
    return found


def affordable(path: Path, size: int, ratio: int = PACKED, stored: int | None = None, loose: int = LOOSE) -> None:
    """Refuse arrays of `size` bytes that memory cannot take, or that a file of its size (`stored` bytes, that of
    `path` by default) cannot hold though it were compressed `ratio` to one."""
    fits(path, size)
    possible(path, size, ratio, stored, loose)


def possible(path: Path, size: int, ratio: int = PACKED, stored: int | None = None, loose: int = LOOSE) -> None:
    """Refuse arrays of `size` bytes that a file cannot hold, likewise, however much memory there is."""
    stored = path.stat().st_size if stored is None else stored
    if size > ratio * stored + loose:
        raise StoreError(
            f"'{path}' claims {size / 2**20:.0f} MiB of arrays and holds {stored / 2**20:.1f}; store them uncompressed."
        )


@contextmanager
def written(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file to write. What the disk refuses is raised once the file is closed: HDF5 that meets it in the middle
    can neither go on nor close, and ends the process with a fault of memory."""
    with _Patient(path, "w+b") as disk:
        with h5py.File(disk, "w") as file:
            yield file
        if disk.refusal is not None:
            raise disk.refusal


class _Patient(io.FileIO):
    """A file that takes whatever it is given, and remembers the first thing that its disk did not take."""

    refusal: OSError | None = None

    def write(self, data) -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        while left and self.refusal is None:
            try:
                left = left[super().write(left) :]
            except OSError as error:
                self.refusal = error
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.refusal = self.refusal or error
            return size or 0


def fits(path: Path, size: int) -> None:
    """Refuse arrays of `size` bytes that memory cannot take."""
    memory = _memory()
    if size > memory:
        raise StoreError(
            f"'{path}' holds {size / 2**30:.1f} GiB of arrays, this machine has {memory / 2**30:.1f} GiB of memory; "
            "take a larger machine, or store fewer episodes."
        )


def _memory() -> float:
    """Bytes of memory, infinite where the system does not say."""
    names = getattr(os, "sysconf_names", {})
    known = "SC_PHYS_PAGES" in names and "SC_PAGE_SIZE" in names
    return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")) if known else float("inf")
