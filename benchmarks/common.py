"""What all benchmarks share: tables that grow row by row, tables of pages, measurements, and work on several cores.

Imports nothing heavy: workers are pinned to a core before they start JAX.
"""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, TypeVar

from ringfence.utils.files import whole

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "results"
T, R = TypeVar("T"), TypeVar("R")


def read(file: str | Path) -> list[dict[str, str]]:
    """All rows of a table of `results/`, none if there is no file yet."""
    path = RESULTS / file
    return list(csv.DictReader(path.open(newline=""))) if path.exists() else []


def append(file: Path, row: dict[str, Any], fields: Sequence[str] | None = None) -> None:
    """Add a row and print it, so that nothing is lost when a study is cut short."""
    fresh = not file.exists()
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a", newline="") as f:
        writer = csv.DictWriter(f, fields or row, lineterminator="\n")
        if fresh:
            writer.writeheader()
        writer.writerow(row)
    print(", ".join(f"{k} {v}" for k, v in row.items()), flush=True)


def write(file: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write the whole table in place of what was there; fields are those of its first row."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with whole(file) as temporary, temporary.open("w", newline="") as f:
        writer = csv.DictWriter(f, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def brief(row: dict[str, Any]) -> dict[str, Any]:
    """The row, its floats with five digits."""
    return {k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()}


def of_json(file: str | Path) -> Any:
    """What a file of `results/` holds, an empty dictionary where there is none."""
    path = RESULTS / file
    return json.loads(path.read_text()) if path.exists() else {}


def keep(file: Path, found: Any) -> None:
    """Write JSON, whole."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with whole(file) as temporary:
        temporary.write_text(json.dumps(found, indent=1) + "\n")


def put(page: str, mark: str, text: str) -> None:
    """Write a text between its marks of a page."""
    path = ROOT / page
    begin, end = f"<!-- {mark} -->", f"<!-- /{mark} -->"
    old = path.read_text()
    if begin not in old or end not in old:
        raise SystemExit(f"{page} lacks the markers {begin} and {end}; put them back.")
    path.write_text(old[: old.index(begin) + len(begin)] + "\n" + text + "\n" + old[old.index(end) :])
    print(f"{page}: {mark}")


def markdown(heads: Sequence[str], lines: Iterable[Sequence[Any]]) -> str:
    """Make a table of Markdown."""
    rows = [" | ".join(map(str, line)) for line in (heads, *lines)]
    return "\n".join([f"| {rows[0]} |", "|---" * len(heads) + "|", *(f"| {row} |" for row in rows[1:])])


def machine() -> str:
    """CPU model, usable cores, the accelerator if JAX runs on one, and the JAX version, in one line."""
    import jax

    from ringfence.utils.environment import processor

    device = jax.devices()[0]
    accelerator = "" if device.platform == "cpu" else f", {device.device_kind}"
    return f"{processor()}, {len(cores())} cores{accelerator}, jax {jax.__version__}"


def cores() -> list[int]:
    """Those that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def command() -> str:
    """The command line of this run, as one would type it in the repository."""
    script = Path(sys.argv[0]).resolve()
    script = script.relative_to(ROOT) if script.is_relative_to(ROOT) else script
    return shlex.join(["python", str(script), *sys.argv[1:]])


class Rows(list):
    """Measurements as they come: `rows(name, value, unit)` keeps one for `record` and prints it."""

    def __call__(self, name: str, value: float, unit: str) -> None:
        self.append({"name": name, "value": value, "unit": unit})
        print(f"{name:<48} {value:>14,.6g} {unit}", flush=True)


def record(file: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows {name, value, unit} with the command and the machine as a list of JSON; others of the file stay."""
    made = {row["name"]: row | {"command": command(), "machine": machine()} for row in rows}
    kept = [made.pop(old["name"], old) for old in (json.loads(file.read_text()) if file.exists() else [])]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps([*kept, *made.values()], indent=2) + "\n")


def _pin(free: Any) -> None:
    """Give a worker one core of its own: small networks gain nothing from more."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {free.get()})


def finished(work: Callable[[T], R], jobs: Iterable[T]) -> Iterator[R]:
    """What `work` makes of each job, in the order of being done; a process per core."""
    spawn = multiprocessing.get_context("spawn")
    free = spawn.Queue()
    for core in cores():
        free.put(core)
    with ProcessPoolExecutor(len(cores()), spawn, _pin, (free,)) as pool:
        for future in as_completed([pool.submit(work, job) for job in jobs]):
            yield future.result()


def side_by_side(commands: Iterable[Sequence[str]], jobs: int) -> None:
    """Run scripts of this folder in processes with one core each, so many at once."""
    one_core = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false", "NPROC": "1", "OPENBLAS_NUM_THREADS": "1"}
    waiting, running = list(commands), []
    while waiting or running:
        while waiting and len(running) < jobs:
            call = [sys.executable, str(ROOT / "benchmarks" / waiting[0][0]), *waiting.pop(0)[1:]]
            running.append(subprocess.Popen(call, env={**os.environ, **one_core}))
        running.pop(0).wait()
