"""The Ray engine: the same cells as Ray tasks, for more machines than one; no shared file system is needed.

A task makes its data where it runs, goes on in a temporary folder from what the driver's holds of its cell, and returns
the run folder; the driver puts it in place whole. Ray repeats a task whose worker or node died.
"""

from __future__ import annotations

import io
import logging
import shutil
import socket
import tarfile
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

from ringfence.bench.cells import Cell, Grid, make_reference, record_failure, run_group, tell_lost
from ringfence.errors import UserError
from ringfence.utils.files import owned
from ringfence.utils.progress import Progress

RETRIES = 3


def run_ray(grid: Grid, *, address: str | None = None, threads: int = 1, quiet: bool = False) -> dict[str, int]:
    """Make all unfinished cells on a Ray cluster (`auto`, host:port or ray://host:port; None starts a local one)."""
    if threads < 1:
        raise UserError(f"threads={threads} must be at least 1.")
    ray = connect(address)
    make = packed
    grid.open()

    @ray.remote(num_cpus=threads, max_retries=RETRIES)
    def make_cell(cell: Cell, episodes: int, begun: bytes) -> bytes:
        return make(cell, episodes, begun)

    with owned(grid.out, grid.taken):
        for name, transitions in grid.references().items():
            try:
                make_reference(name, grid.out, grid.episodes, transitions)
            except Exception as error:  # cells do not need them
                tell_lost(f"the reference rows of {name}", f"{type(error).__name__}: {error}")
        cells = [c for group in grid.groups() for c in group]
        ours = set(cells)
        later = {
            c.paired(): c for c in cells if c.paired() in ours
        }  # they take what their paired cells will have learned

        def submit(cell: Cell) -> Any:
            return make_cell.remote(cell, grid.episodes, begun(cell, grid.out))

        waiting = {submit(c): c for c in cells if c.paired() not in ours}
        with Progress(f"{grid.suite}: cells on Ray", len(cells), 0, quiet) as bar:
            while waiting:
                (ready,), _ = ray.wait(list(waiting), num_returns=1)
                cell = waiting.pop(ready)
                try:
                    unpack(ray.get(ready), cell.folder(grid.out))
                except ray.exceptions.RayError as error:
                    record_failure(cell, grid.out, f"{type(error).__name__}: {str(error).splitlines()[0]}", str(error))
                if other := later.pop(cell, None):
                    waiting[submit(other)] = other
                bar.advance(1)
    return grid.count()


def connect(address: str | None) -> ModuleType:
    """The ray module, connected; in one sentence why not."""
    try:
        import ray
    except ImportError:
        raise UserError("The Ray engine needs an extra package; run pip install 'ringfence[ray]'.") from None
    if ray.is_initialized():
        return ray
    try:
        knock(address)
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False)
    except (OSError, ValueError, RuntimeError) as error:
        raise UserError(
            f"No Ray cluster answers at address '{address}' ({str(error).splitlines()[0]}); start one with `ray start "
            "--head` or leave --address out."
        ) from None
    return ray


def knock(address: str | None, seconds: float = 5.0) -> None:
    """Fail at once where nobody listens; Ray itself would try for minutes."""
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if colon and port.isdigit():
        socket.create_connection((host, int(port)), timeout=seconds).close()


def begun(cell: Cell, out: Path) -> bytes:
    """What `out` holds of a cell and of its paired cell, as a tar file."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for known in (cell, cell.paired()):
            if known is not None and found(known.folder(out)):
                tar.add(known.folder(out), arcname=str(known.folder(out).relative_to(out)))
    return buffer.getvalue()


def found(folder: Path) -> bool:
    """Whether a run folder is there; one that was moved aside when its successor was to take its place is put back."""
    aside = _beside(folder, "old")
    if aside.exists() and not folder.exists():
        aside.replace(folder)
    return folder.exists()


def _beside(folder: Path, ending: str) -> Path:
    return folder.with_name(f".{folder.name}.{ending}")


def packed(cell: Cell, episodes: int, begun: bytes) -> bytes:
    """Make a cell in a temporary folder, from what was begun, and return its run folder as a tar file."""
    with tempfile.TemporaryDirectory() as place:
        with tarfile.open(fileobj=io.BytesIO(begun)) as tar:
            tar.extractall(place, filter="data")
        run_group([cell], Path(place), episodes, lambda event, cell: None)
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
            tar.add(cell.folder(Path(place)), arcname=".")
        return buffer.getvalue()


def unpack(packed: bytes, folder: Path) -> None:
    """Put a returned run folder in place, whole or not at all."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    part = _beside(folder, "part")
    old = _beside(folder, "old")
    for left in (part, old):
        shutil.rmtree(left, ignore_errors=True)
    with tarfile.open(fileobj=io.BytesIO(packed)) as tar:
        tar.extractall(part, filter="data")
    if folder.exists():
        folder.replace(old)
    part.replace(folder)
    shutil.rmtree(old, ignore_errors=True)
