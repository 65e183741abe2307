"""Who makes cells: worker processes with cores, threads and memory of their own, or Ray on more machines than one.

A worker takes groups of cells as JSON lines, makes them, and tells what happened as JSON lines. One that dies takes one
attempt of its cell with it and is replaced; a cell that fails twice that way is recorded and left. It leaves when its
pipe closes or its parent is gone, so that a killed runner leaves nobody writing behind. One runner owns a results
folder at a time.

Ray needs no shared file system: a task makes its data where it runs, goes on in a temporary folder from what the
driver's holds of its cell, and returns the run folder; the driver puts it in place whole. Ray repeats a task whose
worker or node died.
"""

from __future__ import annotations

import gc
import io
import json
import logging
import os
import queue
import shutil
import socket
import subprocess
import sys
import tarfile
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import IO, Any

import jax

from ringfence.bench.cells import Cell, Grid, make_reference, record_failure, run_group, tell_lost
from ringfence.errors import UserError, needs
from ringfence.utils import interrupts
from ringfence.utils.files import owned
from ringfence.utils.progress import Progress

DEATHS = 2  # of workers on one cell, after which it is left
RETRIES = 3


def slots_of(cores: list[int], workers: int, threads: int) -> list[list[int]]:
    """The cores that each worker keeps to; none where they leave some, since two grids that were started beside each
    other with a worker each would both keep to the first core."""
    if workers * threads < len(cores):
        return [[]] * workers
    return [cores[i * threads : (i + 1) * threads] for i in range(workers)]


def run_local(
    grid: Grid, *, workers: int | None = None, threads: int = 1, memory: float | None = None, quiet: bool = False
) -> dict[str, int]:
    """Make all unfinished cells; returns how many are done, failed and to do.

    `workers` processes (default: one per `threads` cores) of `threads` threads each; one that outgrows `memory` GiB
    is killed and its cell recorded as failed.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    if threads < 1 or (workers is not None and workers < 1):
        raise UserError(f"workers={workers} and threads={threads} must be at least 1.")
    if memory is not None and not memory > 0:
        raise UserError(f"memory={memory:g} GiB must be more than 0; leave it out for no limit.")
    workers = workers or max(1, len(cores) // threads)
    grid.open()
    with owned(grid.out, grid.taken) as lock:
        groups = grid.groups()
        jobs: queue.Queue[dict] = queue.Queue()
        for task, size in grid.references().items():
            jobs.put({"reference": task, "transitions": size, "out": str(grid.out), "episodes": grid.episodes})
        for group in groups:
            jobs.put({"cells": [encode(c) for c in group], "out": str(grid.out), "episodes": grid.episodes})
        total = sum(len(g) for g in groups)
        with Progress(f"{grid.suite}: cells", total, 0, quiet) as bar:
            pool = _Pool(grid, jobs, bar, threads, memory, lock)
            slots = slots_of(cores, workers, threads)
            hands = [threading.Thread(target=pool.serve, args=(slot,), daemon=True) for slot in slots]
            for hand in hands:
                hand.start()
            try:
                for hand in hands:
                    while hand.is_alive():
                        hand.join(0.2)
                        interrupts.check()
            except KeyboardInterrupt:
                pool.stop()
                for hand in hands:
                    hand.join(30)
                raise
    return grid.count()


class _Pool:
    """What the threads that look after workers share."""

    def __init__(self, grid: Grid, jobs: queue.Queue, bar: Progress, threads: int, memory: float | None, lock: int):
        self.grid = grid
        self.jobs = jobs
        self.bar = bar
        self.threads = threads
        self.memory = memory
        self.lock = lock
        self.deaths: dict[tuple, int] = {}
        self.guard = threading.Lock()
        self.stopping = False
        self.running: set[subprocess.Popen[str]] = set()
        self.too_big: set[int] = set()  # process numbers of workers that were stopped for it

    def serve(self, cores: list[int]) -> None:
        """Keep one worker busy until no job is left."""
        worker = None
        while not self.stopping:
            try:
                job = self.jobs.get_nowait()
            except queue.Empty:
                break
            if worker is None or worker.poll() is not None:
                worker = self._start(cores)
            self._work(worker, job)
        if worker is not None and worker.poll() is None:
            _pipes(worker)[0].close()
            worker.wait(30)

    def stop(self) -> None:
        """The terminal's interrupt reached the workers, too; they save and leave."""
        self.stopping = True
        for _ in range(100):
            if all(w.poll() is not None for w in self.running):
                return
            time.sleep(0.1)
        for w in self.running:
            w.kill()

    def _start(self, cores: list[int]) -> subprocess.Popen[str]:
        environment = dict(os.environ)
        flags = environment.get("XLA_FLAGS", "")
        if self.threads == 1 and "multi_thread_eigen" not in flags:
            flags += " --xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
        environment["XLA_FLAGS"] = flags.strip()
        environment.setdefault("JAX_COMPILATION_CACHE_DIR", str(self.grid.out.resolve() / "compiled"))
        worker = subprocess.Popen(
            [sys.executable, "-c", "from ringfence.bench.engines import main; main()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            pass_fds=[self.lock] if self.lock >= 0 else [],  # the folder stays owned until the last worker has gone
        )
        if cores and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(worker.pid, cores)
        self.running.add(worker)
        threading.Thread(target=self._weigh, args=(worker,), daemon=True).start()
        return worker

    def _work(self, worker: subprocess.Popen[str], job: dict) -> None:
        """Hand a worker its job and count what it makes, until it is done with it or gone."""
        left = [decode(c) for c in job.get("cells", [])]
        current = left[0] if left else None
        jobs, messages = _pipes(worker)
        with suppress(OSError):  # of a worker that is gone, which the end of its messages tells
            jobs.write(json.dumps(job) + "\n")
            jobs.flush()
        for line in messages:
            message = json.loads(line)
            event = message["event"]
            if event == "broken":  # a cell's own failures are recorded; this is a reference's
                what = f"the reference rows of {job['reference']}" if "reference" in job else "a group of cells"
                tell_lost(what, message["error"])
            if event in ("finished", "broken"):
                return
            if event == "ready":
                continue
            current = decode(message["cell"])
            if event in ("done", "failed"):
                left = [cell for cell in left if cell != current]
                self._count()
        worker.wait()
        if self.stopping:
            return
        if current not in left:
            current = left[0] if left else None
        self._died(worker, current, left, job)

    def _died(self, worker: subprocess.Popen[str], cell: Cell | None, left: list[Cell], job: dict) -> None:
        """The worker is gone before its job was done: retry the cell once, hand the others back."""
        if cell is None:
            if "reference" not in job:
                return
            if worker.pid not in self.too_big and self._again(("reference", job["reference"])):
                self.jobs.put(job)
            else:
                tell_lost(f"the reference rows of {job['reference']}", self._cause(worker))
            return
        if worker.pid in self.too_big or not self._again((cell.task, cell.algorithm, cell.preset, cell.seed)):
            record_failure(cell, self.grid.out, self._cause(worker))
            self._count()
            left = [c for c in left if c != cell]
        if left:
            self.jobs.put({**job, "cells": [encode(c) for c in left]})

    def _cause(self, worker: subprocess.Popen[str]) -> str:
        grown = f"its worker grew beyond {self.memory or 0:g} GiB"
        why = grown if worker.pid in self.too_big else f"its worker died {DEATHS} times"
        return f"{why} (exit status {worker.returncode})"

    def _again(self, name: tuple) -> bool:
        with self.guard:
            self.deaths[name] = self.deaths.get(name, 0) + 1
            return self.deaths[name] < DEATHS

    def _count(self) -> None:
        with self.guard:
            self.bar.advance(1)

    def _weigh(self, worker: subprocess.Popen[str]) -> None:
        while self.memory and worker.poll() is None:
            if resident(worker.pid) > self.memory:
                self.too_big.add(worker.pid)
                worker.kill()
            time.sleep(0.5)


def _pipes(worker: subprocess.Popen[str]) -> tuple[IO[str], IO[str]]:
    """(where jobs go, where messages come from)."""
    assert worker.stdin is not None and worker.stdout is not None  # it was started with both
    return worker.stdin, worker.stdout


def resident(pid: int) -> float:
    """GiB of memory a process holds; 0 where the system does not say."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**30


# --- a worker ---


def encode(cell: Cell) -> dict[str, Any]:
    return dict(vars(cell))


def decode(message: dict[str, Any]) -> Cell:
    pairs = {name: tuple(tuple(pair) for pair in message[name]) for name in ("changes", "evaluations", "trials")}
    return Cell(**{**message, **pairs})


def leave_with(parent: int) -> None:
    """End this process once its parent is another one than it was."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def forget() -> None:
    """Let go of compiled programs: the next job's are others, and kept they grow a worker by 80 MiB a small job."""
    jax.clear_caches()
    gc.collect()


def main() -> None:
    leave_with(os.getppid())
    wire = sys.stdout
    sys.stdout = sys.stderr  # prints of libraries must not mix with the messages

    def say(**message: Any) -> None:
        print(json.dumps(message), file=wire, flush=True)

    interrupts.listen()
    say(event="ready")
    for line in sys.stdin:
        job = json.loads(line)
        out = Path(job["out"])
        try:
            if "reference" in job:
                make_reference(job["reference"], out, job["episodes"], job["transitions"])
            else:
                group = [decode(c) for c in job["cells"]]
                run_group(group, out, job["episodes"], lambda event, cell: say(event=event, cell=encode(cell)))
            say(event="finished")
        except KeyboardInterrupt:
            return
        except Exception as error:
            say(event="broken", error=f"{type(error).__name__}: {error}")
        forget()


# --- Ray ---


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
    with needs("ray", "Benchmarks on a cluster"):
        import ray
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
