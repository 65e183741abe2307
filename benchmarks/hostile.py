"""Broken files, and values of every wrong kind, by the thousand: how many are refused in a sentence, raise anything
else, are believed although they have changed, hang, or leave something behind; and the memory that they take.

    python benchmarks/hostile.py                     # results/hostile.csv; a quarter of an hour
    python benchmarks/hostile.py --parts tables run  # parts by the beginning of their names; the others keep their rows
"""

from __future__ import annotations

import argparse
import contextlib
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

import common as _rows
import numpy as np

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
from tests import corpus, strange, strange_files  # noqa: E402
from tests.corpus import TASK  # noqa: E402
from tests.quick import QUICK_WORLD  # noqa: E402

SECONDS = 20  # of a core, after which reading hangs
WAITING = 180  # seconds, likewise
OUT = ROOT / "results" / "hostile.csv"
HEAD = ("files", "tried", "refused", "read, unchanged", "traceback", "believed though changed", "hang", "left behind")
HEAD += ("MiB more",)


class Hang(BaseException):
    """It took too long."""


def late(*_):
    raise Hang


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=2, help="as many inputs as the tests try")
    parser.add_argument("--parts", nargs="*", default=[""], help="of which the names begin so")
    options = parser.parse_args()
    signal.signal(signal.SIGALRM, late)
    signal.signal(signal.SIGPROF, late)
    warnings.simplefilter("ignore")
    found = {row["files"]: row for row in _rows.read(OUT)}
    bad = False
    for name, cases in PARTS.items():
        if not name.startswith(tuple(options.parts)):
            continue
        with tempfile.TemporaryDirectory() as place:
            os.environ["RINGFENCE_HOME"] = str(Path(place) / "home")
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            counts = count(cases(Path(place), options.times), Path(place))
            grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024
        bad |= any(counts[3:])
        found[name] = dict(zip(HEAD, (name, *counts, grown)))
        print(*found[name].values(), sep=", ", flush=True)
        _rows.write(OUT, [{field: found[each].get(field, "") for field in HEAD} for each in PARTS if each in found])
    sys.exit(bad)


Case = strange.Case  # what was done, reading it, and whether what was read is what it was


def count(cases: Iterator[Case], place: Path) -> list[int]:
    counts, there = Counter(), None
    for what, read, same in cases:
        there = there or set(place.rglob("*"))
        signal.alarm(WAITING)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            kind = "unchanged" if same(read()) else "believed"
            if kind == "believed":
                print(f"{what}: is believed", file=sys.stderr)
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
            signal.setitimer(signal.ITIMER_PROF, 0)
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
    from ringfence.world import load, save

    file = save(worlds.fit(corpus.small_store(), **QUICK_WORLD), place / "world.safetensors")
    raw = file.read_bytes()
    head = 8 + int.from_bytes(raw[:8], "little")
    for what, content in corpus.broken_bytes(raw, random.Random(times), 50 * times, head):
        file.write_bytes(content)
        yield what, lambda: load(file), always


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


def of_run_time(place: Path, times: int) -> Iterator[Case]:
    """What guards and controllers are given."""
    import ringfence
    from ringfence.world import save

    rng = np.random.default_rng(0)
    seen = rng.normal(size=(20, 11, 2, 4)).astype(np.float32)
    actions = np.tanh(rng.normal(size=(20, 10, 2, 2)))
    costs = (rng.random((20, 10)) < 0.2) * 1.0
    named = {"a": costs, "b": np.roll(costs, 3)}
    store = EpisodeStore.from_episodes(seen, actions, actions.sum(-1), named, card={"task": "strange"})
    world = worlds.fit(store, **QUICK_WORLD)
    changes = {"num_updates": 4, "width": 8, "cost_limit": None}
    (run,) = loop.train("bc", store, changes=changes, quiet=True, out=place / "runs")
    file = save(world, place / "w.safetensors")
    good = store.observations[0]
    still = lambda observations, state: np.zeros((2, 2))  # noqa: E731
    controllers = {
        "a function": ringfence.guard(still, world, guard="adapt", anyway=True),
        "a run": ringfence.Controller(run, guard="adapt", world=file, anyway=True),
    }

    def fresh(controller):
        def make():
            controller.reset()
            return controller

        return make

    yield from strange.at_run_time({name: fresh(each) for name, each in controllers.items()}, good)
    guarded = ringfence.guard(still, world, anyway=True)

    def asking(function):
        guarded.policy.function = function  # one program for all of them
        guarded.reset()
        return guarded

    yield from strange.of_functions(asking, good, np.zeros((2, 2), np.float32))


def of_older_worlds(place: Path, times: int) -> Iterator[Case]:
    """Worlds without a digest, as older versions wrote them, with junk in every field."""
    import json

    from safetensors import safe_open
    from safetensors.numpy import save_file

    from ringfence.world import load, save

    file = save(worlds.fit(corpus.small_store(), **QUICK_WORLD), place / "world.safetensors")
    with safe_open(file, "numpy") as opened:
        about = json.loads(opened.metadata()["ringfence_world"])
        arrays = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    del about["digest"]
    rng = random.Random(times)
    for place_of, junk in ((p, j) for p in corpus.places(about, 4) for j in rng.sample(corpus.JUNK, 2 * times)):
        words = corpus.with_junk(about, place_of, junk).decode()
        save_file(arrays, file, {"ringfence_world": words})
        yield f"{place_of} is {junk!r:.20}", lambda: load(file), lambda world: str(world.card) is not None
    for name, array in arrays.items():
        for what, other in (("NaN", array * np.nan), ("shorter", array.ravel()[:-1]), ("words", array.astype("S1"))):
            with contextlib.suppress(Exception):  # what safetensors itself cannot write
                save_file(arrays | {name: np.ascontiguousarray(other)}, file, {"ringfence_world": json.dumps(about)})
                empty = array.size == 0
                yield f"{name} {what}", lambda: load(file), lambda _, empty=empty: empty


def of_simulators(place: Path, times: int) -> Iterator[Case]:
    import ringfence

    yield from strange.simulators(ringfence.collect)


def of_tables(place: Path, times: int) -> Iterator[Case]:
    yield from strange.tables()
    yield from strange.files_of_tables(place, random.Random(times), times)


def of_importers(place: Path, times: int) -> Iterator[Case]:
    yield from strange_files.files(place, random.Random(times), times)


def of_archives(place: Path, times: int) -> Iterator[Case]:
    from ringfence.bench import unpack

    yield from strange.archives(place, unpack)


def of_words(place: Path, times: int) -> Iterator[Case]:
    """Words of results that a page shows, and that commands to copy are made of."""
    from ringfence.report import build_report, provenance

    folder = corpus.one_cell(place / "words")
    run = Run(next((folder / "cells" / TASK / "bc").iterdir()))

    def commands(run: Run) -> list[str]:
        return [line for section in sections([run]) for line in provenance.commands(section, place / "r.html")]

    words = random.Random(times).sample(strange.WORDS, 8 * times)
    yield from strange.words_of_results(run, lambda run, out: build_report([run], out), commands, words)


def of_commands(place: Path, times: int) -> Iterator[Case]:
    from ringfence.cli.app import main as command

    store = corpus.small_store()
    file = store.save(place / "store.h5")
    (run,) = loop.train("bc", store, changes={"num_updates": 4, "width": 8}, quiet=True, out=place / "runs")
    words = random.Random(times).sample(strange.WORDS, 15 * times)
    yield from strange.command_lines(command, file, run.path, place, words)


PARTS: dict[str, Callable[[Path, int], Iterator[Case]]] = {
    "JSON of runs and results folders": json_files,
    "stores": stores,
    "checkpoints": checkpoints,
    "Worlds": world_files,
    "Worlds of older versions": of_older_worlds,
    "archives of results": archives,
    "members and links of archives": of_archives,
    "recordings": films,
    "arrays that become a store": lambda place, times: strange.arrays_of_stores(),
    "tables": of_tables,
    "files of importers": of_importers,
    "simulators": of_simulators,
    "run time: observations, costs, actions": of_run_time,
    "words in reports and commands": of_words,
    "command lines": of_commands,
}


if __name__ == "__main__":
    main()
