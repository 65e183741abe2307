"""Broken files by the thousand: how many are refused in a sentence, raise anything else, are believed although they
have changed, hang, or leave something behind; and the memory that all of them take.

    python benchmarks/hostile.py            # writes results/hostile.csv and docs/security.md's table; some minutes
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from readme import put

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
from ringfence.bench import pack, rows  # noqa: E402
from ringfence.bench.cells import statuses  # noqa: E402
from ringfence.errors import UserError  # noqa: E402
from ringfence.evaluation import recordings  # noqa: E402
from ringfence.loading import resolve  # noqa: E402
from ringfence.loading.resolve import load  # noqa: E402
from ringfence.logs.store import EpisodeStore  # noqa: E402
from ringfence.report import board  # noqa: E402
from ringfence.report.table import sections  # noqa: E402
from ringfence.training import loop, worlds  # noqa: E402
from ringfence.training.runs import Run  # noqa: E402
from tests import corpus  # noqa: E402
from tests.corpus import TASK  # noqa: E402
from tests.quick import QUICK_WORLD  # noqa: E402

SECONDS = 20  # after which reading hangs
HEAD = ("files", "tried", "refused", "read, unchanged", "traceback", "believed though changed", "hang", "left behind")


class Hang(BaseException):
    """It took too long."""


def late(*_):
    raise Hang


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=2, help="as many inputs as the tests try")
    times = parser.parse_args().times
    signal.signal(signal.SIGALRM, late)
    warnings.simplefilter("ignore")
    before, found = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, []
    with tempfile.TemporaryDirectory() as place:
        os.environ["RINGFENCE_HOME"] = str(Path(place) / "home")
        for name, cases in (
            ("JSON of runs and results folders", json_files),
            ("stores", stores),
            ("checkpoints", checkpoints),
            ("Worlds", world_files),
            ("archives of results", archives),
            ("recordings", films),
        ):
            found.append([name, *count(cases(Path(place), times), Path(place))])
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    with (ROOT / "results" / "hostile.csv").open("w") as f:
        writer = csv.writer(f, lineterminator="\n")
        writer.writerows([HEAD, *found])
    lines = ["| " + " | ".join(HEAD) + " |", "|---" * len(HEAD) + "|"]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in found]
    lines.append(f"\nPeak memory grew by {grown:.0f} MiB over all of it.")
    put("docs/security.md", "hostile", "\n".join(lines))
    sys.exit(any(sum(row[4:]) for row in found))


Case = tuple[str, Callable, Callable]  # what was done, reading it, and whether what was read is what it was


def count(cases: Iterator[Case], place: Path) -> list[int]:
    counts, there = Counter(), None
    for what, read, same in cases:
        there = there or set(place.rglob("*"))
        signal.alarm(SECONDS)
        try:
            kind = "unchanged" if same(read()) else "believed"
        except UserError:
            kind = "refused"
        except Hang:
            kind = "hang"
            print(f"{what}: hangs", file=sys.stderr)
        except Exception as error:
            kind = "traceback"
            print(f"{what}: {type(error).__name__}: {error}", file=sys.stderr)
        finally:
            signal.alarm(0)
        counts[kind] += 1
        counts["tried"] += 1
    counts["left"] = len({p for p in set(place.rglob("*")) - there if p.name.endswith(".part") or p.name == "victim"})
    return [counts[k] for k in ("tried", "refused", "unchanged", "traceback", "believed", "hang", "left")]


def always(_) -> bool:
    return True


def json_files(place: Path, times: int) -> Iterator[Case]:
    folder = corpus.one_cell(place / "json")
    run = Run(next((folder / "cells" / TASK / "bc").iterdir()))
    files = [run.path / f"{n}.json" for n in ("config", "results", "status", "env")]
    files += [folder / "bench.json", folder / "reference" / TASK / "reference.json"]
    readers = [lambda: rows(folder), lambda: board.read(folder), lambda: statuses(folder), lambda: sections([run])]
    readers.append(lambda: resolve.load_job(run))
    for file in files:
        raw = file.read_bytes()
        for what, content in corpus.broken_json(raw, random.Random(times), each=times):
            file.write_bytes(content)
            for read in readers:
                yield f"{file.name}: {what}", read, always
        file.write_bytes(raw)


def stores(place: Path, times: int) -> Iterator[Case]:
    store, file = corpus.small_store(), place / "s.h5"
    raw = store.save(file).read_bytes()
    for what, content in corpus.broken_bytes(raw, random.Random(times), 500 * times):
        file.write_bytes(content)
        yield what, lambda: EpisodeStore.load(file), lambda s: (s.content, s.card) == (store.content, store.card)
    for what, path in corpus.broken_stores(raw, place):
        yield what, lambda path=path: EpisodeStore.load(path), lambda s: False


def checkpoints(place: Path, times: int) -> Iterator[Case]:
    changes = {"view": "decentralized", "num_updates": 4, "width": 16}
    run = loop.train("bc", corpus.small_store(), out=place / "runs", changes=changes, quiet=True)[0]
    for _, old in run.checkpoints()[:-1]:
        old.unlink()
    file = run.checkpoints()[-1][1]
    raw = file.read_bytes()
    head = 8 + int.from_bytes(raw[:8], "little")
    for what, content in corpus.broken_bytes(raw, random.Random(times), 50 * times):
        file.write_bytes(content)
        same = len(content) == len(raw) and content[head:] == raw[head:]
        yield what, lambda: load(run), lambda _, same=same: same


def world_files(place: Path, times: int) -> Iterator[Case]:
    from ringfence.world import save

    file = save(worlds.fit(corpus.small_store(), **QUICK_WORLD), place / "world.safetensors")
    raw = file.read_bytes()
    head = 8 + int.from_bytes(raw[:8], "little")
    for what, content in corpus.broken_bytes(raw, random.Random(times), 50 * times, head):
        file.write_bytes(content)
        yield what, lambda: worlds.load(file), always


def films(place: Path, times: int) -> Iterator[Case]:
    file = corpus.small_recording(place)
    raw, good = file.read_bytes(), recordings.read(place, "plain")
    for what, content in corpus.broken_bytes(raw, random.Random(times), 100 * times):
        file.write_bytes(content)
        yield what, lambda: recordings.read(place, "plain"), lambda r: all(np.array_equal(r[k], good[k]) for k in good)
    for what, _ in corpus.broken_recordings(good, file):
        yield what, lambda: recordings.read(place, "plain"), lambda r: False


def archives(place: Path, times: int) -> Iterator[Case]:
    folder = corpus.one_cell(place / "archives")
    good, archive = rows(folder), pack(folder)[0]
    raw = archive.read_bytes()
    for what, content in corpus.broken_bytes(raw, random.Random(times), 60 * times):
        for loose in ("cells", "reference"):
            shutil.rmtree(folder / loose, ignore_errors=True)
        archive.write_bytes(content)
        yield what, lambda: rows(folder), lambda found: found == good


if __name__ == "__main__":
    main()
