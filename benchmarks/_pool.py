"""Independent pieces of a study on all cores. Imports nothing heavy: workers are pinned to a core, then start JAX."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

T, R = TypeVar("T"), TypeVar("R")


def pin(cores) -> None:
    """Give a worker one core of its own: small networks gain nothing from more."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {cores.get()})


def finished(work: Callable[[T], R], jobs: Iterable[T]) -> Iterator[R]:
    """What `work` makes of each job, in the order of being done; a process per core."""
    spawn = multiprocessing.get_context("spawn")
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count()))
    queue = spawn.Queue()
    for core in cores:
        queue.put(core)
    with ProcessPoolExecutor(len(cores), spawn, pin, (queue,)) as pool:
        for future in as_completed([pool.submit(work, job) for job in jobs]):
            yield future.result()
