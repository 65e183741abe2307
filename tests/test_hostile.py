"""Nothing that is read can hurt: it is refused in a sentence, or it is what it was; nothing outside is touched."""

import dataclasses
import io
import json
import lzma
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

import ringfence
from ringfence.bench import pack, rows, unpack
from ringfence.bench.cells import statuses
from ringfence.datasets import importers
from ringfence.datasets.audit import audit
from ringfence.deploy.controller import Controller
from ringfence.envs.pettingzoo import SimpleSpreadParallel
from ringfence.errors import StoreError, UserError
from ringfence.evaluation import recordings
from ringfence.evaluation.certificate import Certificate, Monitor
from ringfence.evaluation.evaluate import evaluate
from ringfence.loading import resolve
from ringfence.loading.resolve import load
from ringfence.logs.io.lerobot import read_lerobot
from ringfence.logs.io.observe import observe
from ringfence.logs.store import EpisodeStore
from ringfence.problem.constraints import All, Separation, SpeedLimit
from ringfence.report import board, build_report
from ringfence.report.table import normal_return, sections
from ringfence.training.runs import Run
from tests import corpus, strange, strange_files
from tests.corpus import TASK


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return corpus.one_cell(tmp_path_factory.mktemp("results"))


def tried(what: str, attempt) -> bool:
    """Whether it was refused; anything but a refusal in a sentence fails."""
    try:
        attempt()
    except UserError as error:
        assert str(error).isprintable() and "Traceback" not in str(error), what
        return True
    except BaseException as error:
        raise AssertionError(f"{what}: {type(error).__name__}: {error}") from error
    return False


@pytest.mark.parametrize("name", ["config", "results", "status", "env", "bench", "reference"])
def test_json_of_strangers(results, tmp_path, name):
    folder = shutil.copytree(results, tmp_path / "guards")
    run = Run(next((folder / "cells" / TASK / "bc").iterdir()))
    places = {"bench": folder / "bench.json", "reference": folder / "reference" / TASK / "reference.json"}
    file = places.get(name, run.path / f"{name}.json")
    readers = [lambda: rows(folder), lambda: board.read(folder), lambda: statuses(folder), lambda: sections([run])]
    readers += [lambda: resolve.load_job(run)] if name == "config" else []
    raw, refused, count = file.read_bytes(), 0, 0
    for what, content in corpus.broken_json(raw, random.Random(0)):
        file.write_bytes(content)
        refused += any([tried(f"{name}: {what}", read) for read in readers])
        count += 1
    assert count > 30 and (refused > count // 4 or name in ("env", "status"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["guards"], "nothing is written beside it"


def test_names_that_become_paths_stay_where_they_are(trained_run, tmp_path):
    """A preset of a run that would lead outside is refused, and what lies there stays."""
    victim = tmp_path / "victim.npz"
    victim.write_text("mine")
    run = Run(shutil.copytree(trained_run.path, tmp_path / "a" / "b" / "run"))
    config = json.loads((run.path / "config.json").read_text())
    (run.path / "config.json").write_text(json.dumps(config | {"preset": "/../../../../victim"}))
    for record in (0, 1):
        with pytest.raises(UserError, match="no run folder that can be read"):
            evaluate(run, episodes=2, num_recorded=record)
    assert victim.read_text() == "mine"


@pytest.fixture(scope="module")
def trained_run(tmp_path_factory):
    from ringfence.training import loop

    changes = {"view": "decentralized", "num_updates": 4, "width": 16}
    return loop.train("bc", corpus.small_store(), out=tmp_path_factory.mktemp("r"), changes=changes, quiet=True)[0]


def test_stores_of_strangers(tmp_path):
    """A flipped bit is refused or changes no number; what claims too much or lies elsewhere is refused unread."""
    store, file = corpus.small_store(), tmp_path / "s.h5"
    raw = store.save(file).read_bytes()
    refused = 0
    for what, content in corpus.broken_bytes(raw, random.Random(1), 500):
        file.write_bytes(content)
        if tried(what, lambda: EpisodeStore.load(file)):
            refused += 1
        else:
            found = EpisodeStore.load(file)
            assert (found.content, found.card) == (store.content, store.card), what
    assert refused > 150
    for what, path in corpus.broken_stores(raw, tmp_path):
        assert tried(what, lambda path=path: EpisodeStore.load(path)), what
    os.mkfifo(tmp_path / "pipe")
    for odd in (tmp_path / "pipe", tmp_path, tmp_path / "nothing"):
        assert tried(str(odd), lambda odd=odd: EpisodeStore.load(odd))


def test_opening_a_file_takes_no_more_than_it_holds(tmp_path):
    """20 kB that claim 5 GB; measured in a process of its own."""
    raw = corpus.small_store().save(tmp_path / "s.h5").read_bytes()
    made = dict(corpus.broken_stores(raw, tmp_path))
    (tmp_path / "edited.h5").unlink()
    for what in ("costs huge", "all huge"):
        path = next(p for w, p in corpus.broken_stores(raw, tmp_path) if w == what)
        code = (
            "import resource, sys\nfrom ringfence.logs.store import EpisodeStore\n"
            "from ringfence.errors import StoreError\n"
            "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
            "try:\n    EpisodeStore.load(sys.argv[1])\nexcept StoreError:\n"
            "    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
        )
        done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
        assert int(done.stdout) < 200 * 1024  # kB
    assert made


def test_recordings_of_strangers(tmp_path):
    file = corpus.small_recording(tmp_path)
    raw, good = file.read_bytes(), recordings.read(tmp_path, "plain")
    for what, content in corpus.broken_bytes(raw, random.Random(4), 100):
        file.write_bytes(content)
        if not tried(what, lambda: recordings.read(tmp_path, "plain")):
            found = recordings.read(tmp_path, "plain")
            assert all(np.array_equal(found[k], good[k]) for k in good), what
    for what, _ in corpus.broken_recordings(good, file):
        assert tried(what, lambda: recordings.read(tmp_path, "plain")), what


def test_checkpoints_of_strangers(trained_run, tmp_path):
    """A damaged one is never believed: the one before is used, or the run is refused."""
    run = Run(shutil.copytree(trained_run.path, tmp_path / "run"))
    file = run.checkpoints()[-1][1]
    for other in run.checkpoints()[:-1]:
        other[1].unlink()
    raw = file.read_bytes()
    head = 8 + int.from_bytes(raw[:8], "little")
    for what, content in corpus.broken_bytes(raw, random.Random(2), 120):
        file.write_bytes(content)
        refused = tried(what, lambda: load(run))
        changed = len(content) < len(raw) or content[head:] != raw[head:]
        assert refused or not changed, what


def test_archives_of_strangers(results, tmp_path):
    folder = shutil.copytree(results, tmp_path / "guards")
    good = rows(folder)
    archive = pack(folder)[0]
    raw = archive.read_bytes()
    for what, content in corpus.broken_bytes(raw, random.Random(3), 60):
        for loose in ("cells", "reference"):
            shutil.rmtree(folder / loose, ignore_errors=True)
        archive.write_bytes(content)
        assert tried(what, lambda: rows(folder)) or rows(folder) == good, what


ARRAYS = {
    "big-endian": lambda x: x.astype(">f4"),
    "long double": lambda x: x.astype(np.longdouble),
    "bool": lambda x: x > 0,
    "complex": lambda x: x.astype(complex),
    "words": lambda x: x.astype(str),
    "objects": lambda x: x.astype(object),
    "masked": lambda x: np.ma.masked_array(x, x > 0.5),
    "1e300": lambda x: x.astype(np.float64) * 1e300,
    "NaN": lambda x: np.where(x > 0, np.nan, x),
    "flat": lambda x: x.ravel(),
    "one axis more": lambda x: x[None],
    "nobody": lambda x: x[:, :, :0],
    "no step": lambda x: x[:, :0],
    "no entry": lambda x: x[..., :0],
    "list": lambda x: x.tolist(),
    "ragged": lambda x: [x[0].tolist(), x[1, :2].tolist()],
    "None": lambda x: None,
    "text": lambda x: "observations",
}


@pytest.mark.parametrize("kind", ARRAYS)
@pytest.mark.parametrize("place", ["observations", "actions", "rewards", "costs"])
def test_arrays_of_strangers(place, kind):
    """They become a store of plain numbers that can be kept, or are refused."""
    given = strange.few_episodes(np.random.default_rng(0))
    given[place] = ARRAYS[kind](given[place])

    def attempt():
        store = EpisodeStore.from_episodes(**given, card={"task": "strange"})
        for name in ("observations", "actions", "rewards", "costs"):
            array = getattr(store, name)
            assert array.dtype in (np.float32, np.float64) and array.dtype.isnative and np.isfinite(array).all()

    tried(f"{place} {kind}", attempt)


CARDS = {
    "task": ["", " ", ".", "..", ".hidden", "a/b", "a\\b", "a\nb", "a\0b", "x" * 300, 3, None, ["x"], "\ud800", "-x"],
    "hazard": [3, {"kind": ["x"]}, {"kind": "None"}, {"kind": "SpeedLimit", "limit": 1.0, "features": []}]
    + [{"kind": "Separation", "radius": r} for r in (float("inf"), float("nan"), -1, "x", None, True)]
    + [{"kind": "SpeedLimit", "limit": v, "features": ["o0"]} for v in (-1, float("inf"), "x", None)],
    "observation_names": [["x", "x", "y"], ["x"], "xyz", [1, 2, 3], ["a\nb", "b", "c"]],
    "action_low": [float("nan"), "x", None, 2.0, [0]],
    "cost_limit": [-1, float("inf"), "x", [1]],
    "homogeneous": ["yes", 3],
}


@pytest.mark.parametrize(("field", "value"), [(k, v) for k, vs in CARDS.items() for v in vs], ids=repr)
def test_cards_of_strangers(field, value):
    rng = np.random.default_rng(0)
    arrays = (
        rng.normal(size=(4, 6, 2, 3)),
        rng.uniform(-1, 1, (4, 5, 2, 2)),
        rng.normal(size=(4, 5, 2)),
        np.zeros((4, 5)),
    )
    with pytest.raises(UserError):
        EpisodeStore.from_episodes(*arrays, card={field: value})


def test_results_of_several_processes_are_all_kept(tmp_path):
    code = (
        "import sys\nfrom pathlib import Path\nfrom ringfence.training.runs import Run\nrun = Run(Path(sys.argv[1]))\n"
        "for k in range(50):\n    run.add_result(f'{sys.argv[2]}-{k}', {'episodes': 1})"
    )
    started = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path), str(k)]) for k in range(4)]
    assert [p.wait() for p in started] == [0] * 4
    assert len(Run(tmp_path).results) == 200


def test_what_is_no_regular_file_is_not_replaced(tmp_path):
    from ringfence.utils.files import whole

    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "target").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "target")
    (tmp_path / "file").write_text("x")
    for name in ("pipe", "folder", "file/below", "x" * 300, "a\0b", ""):
        with pytest.raises(UserError), whole(str(tmp_path / name) if name else "") as temporary:
            Path(temporary).write_text("new")
    with whole(tmp_path / "link") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "target").read_text() == "new"
    left = tmp_path / ".target.4194304.part"  # of a process that is no more
    left.write_text("half")
    with whole(tmp_path / "target") as temporary:
        temporary.write_text("newer")
    assert not left.exists()


NUMBERS = (None, "x", 2.5, float("nan"), -1, True, {}, 10**30)


@pytest.mark.parametrize("value", NUMBERS, ids=repr)
def test_numbers_of_strangers(trained_run, value, tmp_path):
    """None, floats, words and what no machine can count, where a whole number belongs."""
    from ringfence import Controller, play
    from ringfence.bench import make_grid
    from ringfence.datasets import registry
    from ringfence.datasets.make import make
    from ringfence.training import loop

    store = corpus.small_store()
    for attempt in (
        lambda: evaluate(trained_run, episodes=value),
        lambda: evaluate(trained_run, num_recorded=value),
        lambda: load(value),
        lambda: Controller(trained_run, seed=value),
        lambda: Controller(trained_run, agents=value or -1),
        lambda: play(trained_run, object, episodes=value),
        lambda: loop.train("bc", store, out=tmp_path, seeds=value),
        lambda: loop.train("bc", store, out=tmp_path, seeds=(value,)),
        lambda: loop.train("bc", store, out=tmp_path, changes={"batch": value}),
        lambda: loop.train("bc", store, out=tmp_path, changes={"num_updates": value}),
        lambda: make(registry.get("simple_spread-random"), value if value is not None else 0),
        lambda: make(registry.get("simple_spread-random"), 25, value),
        lambda: make_grid("guards", tmp_path, seeds=value),
    ):
        assert tried(f"{value!r}", attempt), attempt.__code__.co_names
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("environment", [{"PYTHONIOENCODING": "ascii"}, {"PYTHONIOENCODING": "cp1252"}, {"HOME": ""}])
def test_terminals_of_few_letters_and_users_without_a_home(environment):
    inherited = {k: v for k, v in os.environ.items() if k not in ("HOME", "RINGFENCE_HOME", "XDG_CACHE_HOME")}
    code = "from ringfence.cli.app import main; main(['tasks'])"
    done = subprocess.run([sys.executable, "-c", code], env={**inherited, **environment}, capture_output=True)
    assert done.returncode == 0 and b"Traceback" not in done.stderr


def test_ctrl_c_is_not_swallowed():
    """One that falls into a destructor, where Python prints and forgets it, ends the work at its next step."""
    code = (
        "import os, signal, time\nfrom ringfence.utils import interrupts\n"
        "from ringfence.utils.progress import Progress\n"
        "class Last:\n    def __del__(self):\n        os.kill(os.getpid(), signal.SIGINT)\n        time.sleep(0.01)\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a suite in the background would ignore it
        "interrupts.listen()\nx = Last()\ndel x\n"
        "try:\n    Progress('work', 2, quiet=True).advance(1)\nexcept KeyboardInterrupt:\n    print('heard')\n"
        "interrupts.listen()\ntry:\n    with interrupts.held():\n        os.kill(os.getpid(), signal.SIGINT)\n"
        "        time.sleep(0.01)\n        print('finished')\nexcept KeyboardInterrupt:\n    print('heard')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["heard", "finished", "heard"]


@pytest.mark.parametrize(
    ("within", "presses", "seconds"),
    [
        ("time.sleep(60)", 1, (1.5, 20)),
        ("np.linalg.svd(np.ones((4000, 4000)))", 1, (1.5, 40)),  # which hears no signal
        ("time.sleep(60)", 2, (0, 20)),
        ("with interrupts.held(): time.sleep(60)", 2, (0, 20)),
        ("with interrupts.held(): time.sleep(4)", 1, (3.5, 20)),
        ("with interrupts.held(False): time.sleep(60)", 1, (1.5, 20)),
        ("interrupts.check()", 1, (0, 20)),
    ],
)
def test_ctrl_c_ends_what_does_not_hear_it_and_leaves_nothing_half_written(within, presses, seconds, tmp_path):
    code = (
        "import signal, sys, threading, time\nimport numpy as np\nfrom ringfence.cli import app\n"
        "from ringfence.__main__ import main\nfrom ringfence.utils import interrupts\n"
        "from ringfence.utils.files import whole\n"
        "class Freed:\n    def __del__(self): signal.raise_signal(signal.SIGINT)\n"
        "def press():\n    time.sleep(0.7)\n    signal.raise_signal(signal.SIGINT)\n"
        f"def command():\n    with whole({str(tmp_path / 'a.txt')!r}) as part:\n        part.write_text('half')\n"
        f"        Freed()\n        if {presses} > 1: threading.Thread(target=press).start()\n"
        f"        {within}\n"
        "app.COMMANDS['tasks'] = command\nsys.argv[1:] = ['tasks']\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\nprint(flush=True)\nmain()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as asked:
        asked.stdout.readline()
        begun = time.monotonic()
        said = asked.communicate(timeout=60)[1]
    assert asked.returncode == 130 and "interrupted" in said and "Traceback" not in said
    assert "checkpoint" not in said, "that command keeps none"
    assert seconds[0] <= time.monotonic() - begun < seconds[1] and not list(tmp_path.iterdir())


SWALLOWED = """
def command():
    try:
        signal.raise_signal(signal.SIGINT)
    except BaseException:
        {then}
app.COMMANDS["tasks"] = command
sys.argv[1:] = ["tasks"]
main()
"""
EARLY = """
class Asked:
    def find_spec(self, name, *_):
        if name == "ringfence.cli.app":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Asked())
main()
"""


@pytest.mark.parametrize(
    "code",
    [
        EARLY,
        "from ringfence.cli import app" + SWALLOWED.format(then="pass"),
        "from ringfence.cli import app" + SWALLOWED.format(then="raise RuntimeError('of a library')"),
    ],
    ids=["while importing", "swallowed", "made another error"],
)
def test_ctrl_c_ends_a_command_in_a_word(code):
    """And at once: what Python does at its end, such as `atexit`, does not meet native threads that still compute."""
    start = "import atexit, signal, sys\nfrom ringfence.__main__ import main\natexit.register(print, 'torn down')\n"
    start += "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a suite in the background would ignore it
    done = subprocess.run([sys.executable, "-c", start + code], capture_output=True, text=True)
    assert done.returncode == 130 and done.stderr.startswith("interrupted") and "Traceback" not in done.stderr
    assert "torn down" not in done.stdout


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_who_may_read_a_file_follows_the_umask(umask, tmp_path):
    """Though safetensors writes 0600 whatever is asked for."""
    from safetensors.numpy import save_file

    from ringfence.utils.files import whole

    before = os.umask(umask)
    try:
        with whole(tmp_path / "w.safetensors") as temporary:
            save_file({"x": np.zeros(3)}, temporary)
    finally:
        os.umask(before)
    assert (tmp_path / "w.safetensors").stat().st_mode & 0o777 == 0o666 & ~umask


def archived(folder: Path, members: list, name: str = "runs.tar.xz") -> Path:
    """A results folder with an archive of (member, contents)."""
    folder.mkdir(parents=True, exist_ok=True)
    with tarfile.open(folder / name, "w:xz") as tar:
        for member, content in members:
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return folder


def test_a_sparse_member_of_an_archive_is_refused(tmp_path):
    """248 bytes that claim 4 GiB of zeros."""
    raw = bytearray(tarfile.TarInfo("cells/a/results.json").tobuf(tarfile.GNU_FORMAT))
    raw[124:136] = b"%011o\0" % 0
    raw[156:157] = tarfile.GNUTYPE_SPARSE
    raw[386:482] = bytes(96)
    raw[386:410] = b"%011o\0" % (4 * 2**30 - 1) + b"%011o\0" % 0  # nothing, far out
    raw[483:495] = b"%011o\0" % (4 * 2**30 - 1)  # the real size
    raw[148:156] = b" " * 8
    raw[148:156] = b"%06o\0 " % sum(raw)
    folder = tmp_path / "results"
    folder.mkdir()
    (folder / "runs.tar.xz").write_bytes(lzma.compress(bytes(raw) + bytes(1024)))
    with pytest.raises(UserError, match="holds 'cells/a/results.json', which is no file of a cell"):
        unpack(folder)
    assert not (folder / "cells").exists()


@pytest.mark.parametrize("link", ["cells", "cells/a", "cells/a/results.json"])
def test_an_archive_is_not_unpacked_through_a_link(link, tmp_path):
    """Nothing outside of the results folder is written."""
    folder = archived(tmp_path / "results", [(tarfile.TarInfo("cells/a/results.json"), b"{}")])
    (tmp_path / "outside").mkdir()
    (folder / link).parent.mkdir(parents=True, exist_ok=True)
    (folder / link).symlink_to(tmp_path / "outside" / ("new.json" if link.endswith("json") else ""))
    with pytest.raises(UserError, match="is a link out of .*; remove that link"):
        unpack(folder)
    assert not list((tmp_path / "outside").iterdir())


@pytest.mark.parametrize("content", [b"[]", b"3", b'{"x": 3}'])
def test_archived_results_of_another_kind_are_refused(content, tmp_path):
    """They are joined with those that are there."""
    folder = archived(tmp_path / "results", [(tarfile.TarInfo("cells/a/results.json"), content)])
    (folder / "cells" / "a").mkdir(parents=True)
    (folder / "cells" / "a" / "results.json").write_text("{}")
    with pytest.raises(UserError, match="is truncated, damaged"):
        unpack(folder)


@pytest.fixture
def in_time():
    """What hangs is interrupted."""

    def late(*_):
        raise AssertionError("it hangs")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("name", ["ckpt/step-00000003.safetensors", "metrics.jsonl", "rollout-default.npz", "World"])
def test_a_pipe_in_a_run_folder_is_not_waited_for(name, trained_run, tmp_path, in_time):
    from ringfence import world

    run = Run(shutil.copytree(trained_run.path, tmp_path / "run"))
    (run.path / name).unlink(missing_ok=True)
    os.mkfifo(run.path / name)
    attempts = {
        "ckpt/step-00000003.safetensors": lambda: run.load_checkpoint({}, 3),
        "metrics.jsonl": lambda: run.metrics,
        "rollout-default.npz": lambda: recordings.read(run.path, "default"),
        "World": lambda: world.load(run.path / name),
    }
    with pytest.raises(UserError, match="no regular file|no checkpoint of step 3"):
        attempts[name]()


def test_a_pipe_among_logs_is_not_waited_for(tmp_path, in_time):
    from ringfence.datasets.importers import import_omar
    from ringfence.logs.io.rosbag import read_bag

    for kind in ("obs", "acs", "rews", "dones"):
        os.mkfifo(tmp_path / f"{kind}_0.npy")
    with pytest.raises(UserError, match="no regular file"):
        import_omar(tmp_path)
    os.mkfifo(tmp_path / "a.mcap")
    with pytest.raises(UserError, match="no regular file"):
        read_bag(tmp_path / "a.mcap", "/robot_{i}")


@pytest.fixture(scope="module")
def world_file(tmp_path_factory):
    from ringfence import world
    from ringfence.training import worlds
    from tests.quick import QUICK_WORLD

    made = worlds.fit(corpus.small_store(), **QUICK_WORLD)
    return world.save(made, tmp_path_factory.mktemp("w") / "w.safetensors")


def rewritten(file: Path, out: Path, edit=lambda about: None, arrays=lambda arrays: None) -> Path:
    """A World with other metadata or arrays and no digest, as a stranger would write it."""
    with safe_open(file, "numpy") as opened:
        about = json.loads(opened.metadata()["ringfence_world"])
        kept = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    del about["digest"]
    edit(about)
    arrays(kept)
    save_file(kept, out, {"ringfence_world": json.dumps(about)})
    return out


def test_a_flipped_bit_of_a_world_is_refused(world_file, tmp_path):
    """Whichever: weights that are nearly right guard nobody."""
    from ringfence import world

    raw = world_file.read_bytes()
    for what, content in corpus.broken_bytes(raw, random.Random(5), 80):
        (tmp_path / "w.safetensors").write_bytes(content)
        assert tried(what, lambda: world.load(tmp_path / "w.safetensors")), what


WORLDS = {
    "spec.zz": lambda about: about["spec"].update(zz=3),
    "beyond the data": lambda about: about["map"].update(plus=[[10**6] * len(r) for r in about["map"]["plus"]]),
    "before the data": lambda about: about["map"].update(plus=[[-5] * len(r) for r in about["map"]["plus"]]),
    "bounds of 1e300": lambda about: about["spec"].update(action_low=-1e300, action_high=1e300),
    "one bound": lambda about: about["spec"].update(action_low=1, action_high=1),
    "another team": lambda about: about["spec"].update(n_agents=7),
    "steps of no time": lambda about: about["map"].update(dt=-1),
    "card.team": lambda about: about["card"]["data"].update(team=0),
}


@pytest.mark.parametrize("what", WORLDS)
def test_worlds_of_strangers(what, world_file, tmp_path):
    from ringfence import world

    with pytest.raises(UserError):
        world.load(rewritten(world_file, tmp_path / "w.safetensors", WORLDS[what]))
    world.load(rewritten(world_file, tmp_path / "old.safetensors"))  # without a digest, nothing else being wrong


def test_a_world_of_numbers_that_are_none_is_refused(world_file, tmp_path):
    """NaN in weights let everything pass."""
    from ringfence import world

    def spoil(arrays):
        name = next(name for name in arrays if name.startswith("barrier") and arrays[name].ndim > 1)
        arrays[name].flat[0] = np.nan

    with pytest.raises(UserError, match="holds numbers in 'barrier.* that are not finite"):
        world.load(rewritten(world_file, tmp_path / "w.safetensors", arrays=spoil))


RUNS = {
    "spec.zz": lambda config: config["spec"].update(zz=3),
    "team": lambda config: config["data"].update(team=0),
    "cost_limit": lambda config: config["data"].update(cost_limit=[]),
    "beyond the data": lambda config: config["feature_map"].update(
        plus=[[10**6] * len(r) for r in config["feature_map"]["plus"]]
    ),
    "bounds": lambda config: config["spec"].update(action_low=5.0, action_high=1.0),
    "bounds that cross in an entry": lambda config: config["spec"].update(action_low=[-1.0, 2.0]),
    "bounds of no shape": lambda config: config["spec"].update(action_low=[[-1.0, -1.0], [-1.0]]),
}


@pytest.mark.parametrize("what", RUNS)
def test_configs_of_strangers(what, trained_run, tmp_path):
    run = Run(shutil.copytree(trained_run.path, tmp_path / "run"))
    config = json.loads((run.path / "config.json").read_text())
    RUNS[what](config)
    (run.path / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError):
        load(run)


def test_a_world_of_another_task_in_the_run_folder_is_refused(trained_run, world_file, tmp_path):
    run = Run(shutil.copytree(trained_run.path, tmp_path / "run"))
    shutil.copy(world_file, run.path / "world.safetensors")
    load(run, guard="shield")
    edit = lambda about: about["card"]["data"].update(task="another")  # noqa: E731
    rewritten(world_file, run.path / "world.safetensors", edit)
    with pytest.raises(UserError, match=r"is a World of 'another', the run '.*' of other data \('strange'\)"):
        load(run, guard="shield")


@pytest.mark.parametrize("team", [0, -1, 2.5, "x", True])
def test_teams_on_a_card_are_counts(team):
    with pytest.raises(UserError, match="team="):
        EpisodeStore.from_episodes(
            *[np.zeros((2, 3, 1, 1)), np.zeros((2, 2, 1, 1)), np.zeros((2, 2, 1)), np.zeros((2, 2))],
            card={"team": team},
        )


def row_table(**columns) -> dict:
    """A table of one agent, with some columns in place of its own."""
    times = np.arange(20) * 0.1
    return {"t": times, "id": np.zeros(20, int), "x": np.sin(times), "y": times, "hit": np.zeros(20)} | columns


def tabled(table, **options) -> EpisodeStore:
    return EpisodeStore.from_table(table, time="t", agent="id", state=["x", "y"], cost="hit", **options)


KINDS = {
    "masked": np.ma.masked_array(np.full(20, 7777.0), np.arange(20) == 3),
    "complex": np.zeros(20, complex),
    "text": np.full(20, "1.5"),
    "text objects": np.full(20, "1.5", object),
    "dates": np.datetime64("2024-01-01") + np.arange(20),
    "NaT": np.full(20, np.datetime64("NaT")),
    "durations": np.arange(20).astype("timedelta64[s]"),
    "400 digits": np.array([10**400] * 20, object),
    "complex objects": np.array([1j] * 20, object),
    "lists of other lengths": np.array([[1.0], [1.0, 2.0]] * 10, object),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["hit", "x"])
def test_kinds_that_are_no_numbers_become_none(kind, name):
    """A masked cost was 7777, NaT a cost in every step."""
    with pytest.raises(UserError):
        tabled(row_table(**{name: KINDS[kind]}))


def test_times_of_a_table_may_be_dates():
    dates = np.datetime64("2024-01-01T00:00:00.000") + (np.arange(20) * 100).astype("timedelta64[ms]")
    assert tabled(row_table(t=dates)).steps == tabled(row_table()).steps
    dates[3] = np.datetime64("NaT")
    with pytest.raises(UserError, match="row 3: t is missing"):
        tabled(row_table(t=dates))


def test_data_frames_of_strangers():
    import pandas as pd

    frame = pd.DataFrame(row_table())
    for spoiled in (
        frame.assign(hit=pd.array([pd.NA] * 20, dtype="object")),
        frame.assign(id=pd.array([pd.NA] * 20, dtype="object")),
        frame.rename(columns={"y": "x"}),
        frame.rename(columns={"y": 3}),
        frame.rename(columns={"y": None}),
    ):
        with pytest.raises(UserError):
            tabled(spoiled)


def test_files_of_strangers(tmp_path, in_time):
    import pyarrow as pa
    from pyarrow import parquet

    file = tmp_path / "a.csv"
    file.write_bytes(b"t,id,x,\xff\xfe,hit\n" + b"0,0,0,0,0\n" * 3)
    with pytest.raises(UserError):
        tabled(file)
    file.write_text(",".join(["same"] * 20_000) + "\n")
    with pytest.raises(UserError, match="'same' twice"):
        tabled(file)
    times = pa.array([k for k in range(20)], pa.time64("us"))
    parquet.write_table(pa.table(row_table(hit=times)), tmp_path / "a.parquet")
    with pytest.raises(UserError):
        tabled(tmp_path / "a.parquet")
    file.write_text(",".join(map(str, range(60_000))) + "\n")
    with pytest.raises(UserError, match="more than 50,000 columns; leave out"):
        tabled(file)
    runs = pa.table({name: np.zeros(20_000_000, np.float32) for name in ("t", "id", "x", "y", "hit")})
    parquet.write_table(runs, tmp_path / "runs.parquet")
    del runs
    with pytest.raises(UserError, match="claims 763 MiB of arrays and holds 0.3"):
        tabled(tmp_path / "runs.parquet")


@pytest.mark.parametrize("options", [{"dt": 1e-9}, {"neighbours": 10**6}, {"dt": 1e-300}])
def test_sizes_that_no_machine_has_are_refused_first(options, in_time):
    with pytest.raises(UserError):
        tabled(row_table(), **options)


def test_flags_and_sizes_of_strangers():
    arrays = [np.zeros((2, 3, 1, 1)), np.zeros((2, 2, 1, 1)), np.zeros((2, 2, 1)), np.zeros((2, 2))]
    for flags in (["False", "False"], [0.5, 1.0], [None, None]):
        with pytest.raises(UserError, match="terminated"):
            EpisodeStore.from_episodes(*arrays, terminated=flags)
    store = EpisodeStore.from_episodes(*arrays)
    names = ("observations", "actions", "rewards", "costs", "terminated", "truncated", "episode_ends")
    plain = {name: getattr(store, name) for name in names}
    with pytest.raises(UserError, match="rewards reaches 1e.300, beyond 1e.15"):
        EpisodeStore(**plain | {"rewards": np.full((4, 1), 1e300)}, card=store.card)
    with pytest.raises(UserError, match="costs hides entries behind a mask"):
        EpisodeStore(**plain | {"costs": np.ma.masked_array(np.zeros(4), [True, False, False, False])}, card=store.card)
    for field in ("dt", "cost_limit", "action_high"):
        with pytest.raises(UserError, match=field):
            EpisodeStore.from_episodes(*arrays, card={field: 10**400})


@pytest.mark.parametrize("kind", ["agents", "words", "files", "simulators"])
def test_some_of_what_is_tried_by_the_thousand(kind, tmp_path):
    """Every twentieth of some kinds; `benchmarks/hostile.py` tries all of them."""
    import ringfence

    cases = {
        "agents": strange.arrays_of_stores,
        "words": strange.tables,
        "files": lambda: strange.files_of_tables(tmp_path, random.Random(0), 1),
        "simulators": lambda: strange.simulators(ringfence.collect),
    }
    for k, (what, read, sound) in enumerate(cases[kind]()):
        if k % 20 == 0 or "bomb" in what or "pipe" in what:
            found = []
            assert tried(what, lambda read=read, found=found: found.append(read())) or sound(*found), what


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        ({"observations": {"a": np.ma.masked_array(np.ones(3), True), "b": np.ones(3)}}, "is a masked array"),
        ({"terminations": {"a": np.zeros(2), "b": False}}, "neither true nor false"),
        ({"terminations": {"a": 0.5, "b": False}}, "neither true nor false"),
        ({"infos": {"a": -1.0}}, "gave a the info '-1.0'; infos are a dict of each agent"),
        ({"step": np.array(1.0)}, "returned 1 things"),
        (
            {"observations": dict.fromkeys("ab", np.ones(2))},
            "has shape .2, 2., Simulator, as it began, takes .2, 3.; show",
        ),
        (
            {"observations": dict.fromkeys("ab", np.ones(4))},
            "has shape .2, 4., Simulator, as it began, takes .2, 3.; show",
        ),
        *(
            ({"infos": dict.fromkeys("ab", {"cost": {name: 1.0}})}, "name at most 100, each without slashes")
            for name in ("", "a/b", "\x1b[2J", "\ud800", "x" * 121)
        ),
    ],
)
def test_answers_of_simulators_that_are_none(odd, said):
    import ringfence

    with pytest.raises(UserError, match=said):
        ringfence.collect(lambda: strange.Simulator(odd), episodes=1)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"time": 3}, "time=3 names no column"),
        ({"agent": None}, "agent=None names no column"),
        ({"episode": ""}, "episode='' names no column"),
        ({"state": 3}, "state=3 is no list"),
        ({"cost": [1.0]}, "cost=1.0 names no column"),
        ({"wide": 1}, "wide=1 names no column"),
        ({"rename": 5}, "rename=5 is no dictionary"),
        ({"rename": {"x": 2}}, "rename=2 names no column"),
        ({"dt": 10**400}, "dt=1000.* must be a number above 0, and at most"),
    ],
)
def test_names_of_columns_are_words(options, said):
    with pytest.raises(UserError, match=said):
        strange.tabled(strange.columns(), **options)


def test_a_member_whose_name_no_disk_holds_is_refused(tmp_path):
    folder = archived(tmp_path / "results", [(tarfile.TarInfo(f"cells/{'x' * 300}/results.json"), b"{}")])
    with pytest.raises(UserError, match="which is no file of a cell"):
        unpack(folder)


def test_bytes_in_another_order_are_said(tmp_path):
    """JAX reads none of them."""
    store = corpus.small_store()
    with pytest.raises(UserError, match="rewards holds bytes in the order of another machine"):
        dataclasses.replace(store, rewards=store.rewards.astype(">f4"))


@pytest.mark.parametrize("place", ["/proc/x.html", "a\nb/" + "x" * 300, "x" * 220])
def test_places_that_take_no_file_are_refused_first(place):
    """Before a World is fitted for a page that nobody can write."""
    from ringfence.utils.files import writable

    with pytest.raises(UserError, match="could not be written"):
        writable(place)


def test_small_files_that_claim_a_lot(tmp_path, in_time):
    import tracemalloc

    for what, read, sound in strange_files.bombs(tmp_path / "bombs"):
        tracemalloc.start()
        found = []
        tried(what, lambda read=read, found=found: found.append(read()))
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert all(map(sound, found)) and most < 2**29, what


@pytest.mark.parametrize("name", ["minari", "lerobot"])
def test_fields_of_importers_files(name, tmp_path):
    """Junk in every field, and other bytes, of what lies beside the arrays."""
    read = strange_files.FORMATS[name](tmp_path)
    file = next(tmp_path.rglob("*.json"))
    raw = file.read_bytes()
    for what, content in strange_files.changes(file, raw, random.Random(6), 1):
        file.write_bytes(content)
        tried(what, read)
    file.write_bytes(raw)
    assert strange_files.sound(read())


@pytest.mark.parametrize(
    ("agents", "options", "said"),
    [
        (1000, {}, ""),
        (3000, {}, "1.1 GiB; let agents see fewer others, .* neighbours"),
        (3000, {"neighbours": 6}, ""),
        (30_000, {}, "GiB; let agents see fewer others"),
        (30_000, {"terminated": "end"}, "No 30000 agents are together for 5 steps"),
        (30_000, {"neighbours": 2}, ""),
    ],
)
def test_a_small_table_takes_no_large_memory(agents, options, said):
    """Of everybody's observations of everybody else, which are refused where there are too many."""
    who, step = np.divmod(np.arange(8 * agents), 8)
    table = {"t": 0.1 * step, "id": who, "x": 1.0 * who, "y": 1.0 * step, "end": step % 2}
    tracemalloc.start()
    try:
        EpisodeStore.from_table(table, time="t", agent="id", state=["x", "y"], **options)
    except StoreError as error:
        assert said and re.search(said, str(error))
    finally:
        taken = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert taken < (2**27 if said else 2**29)


def test_thousands_of_agents_without_others_take_no_large_memory():
    steps, agents = 12, 3000
    seen = np.random.default_rng(0).normal(size=(2, steps // 2 + 1, agents, 4))
    names = ["own.x", "own.y", "goal.dx", "goal.dy"]
    store = EpisodeStore.from_episodes(
        seen,
        np.zeros((2, steps // 2, agents, 1)),
        np.zeros((2, steps // 2)),
        np.zeros((2, steps // 2)),
        card={"task": "many", "observation_names": names},
    )
    tracemalloc.start()
    audit(store)
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert taken < 2**26


def test_logs_of_thousands_are_looked_at(in_time):
    rng = np.random.default_rng(0)

    def logs(agents, entries, names=None):
        seen = rng.normal(size=(2, 131, agents, entries)).astype(np.float32)
        actions = rng.uniform(-1, 1, (2, 130, agents, 2))
        card = {"task": "wide", "observation_names": names}
        return EpisodeStore.from_episodes(seen, actions, np.zeros((2, 130)), np.zeros((2, 130)), card=card)

    assert audit(logs(1, 3000)).facts["observation, action"] == "3000, 2 per agent"
    assert audit(logs(1, 400, [f"person0_d{k}" for k in range(400)])).warnings
    assert audit(logs(400, 2, ["own.x", "other0.dx"])).facts["agents"] == "400"


def test_metrics_and_constants_of_strangers(trained_run, tmp_path):
    run = Run(shutil.copytree(trained_run.path, tmp_path / "bc" / "seed-0"))
    odd = [{"step": 3, "seconds": 1.0, "a": "x", "b": None, "c": -1e308, "d": [1], "e": True, "f": 2.0}]
    (run.path / "metrics.jsonl").write_text("\n".join(map(json.dumps, odd)) + "\n")
    assert run.metrics == [{"step": 3, "seconds": 1.0, "f": 2.0}]
    with pytest.raises(UserError, match="constants say that 0 and 1 are the same"):
        normal_return(1.0, {"return_min": 3.0, "return_max": 3.0})
    for _, file in run.checkpoints():
        file.unlink()
        file.mkdir()
    with pytest.raises(UserError, match="holds no checkpoint"):
        load(run)


def test_nothing_is_added_that_makes_a_file_unreadable(trained_run, tmp_path):
    run = Run(shutil.copytree(trained_run.path, tmp_path / "run"))
    before = run.results
    with pytest.raises(UserError, match="could not be read again .*nothing was added"):
        run.add_result("default", {"constraints": {"\ud800": {}}})
    assert run.results == before


THINGS = [3, None, [], {}, b"x", len, np.zeros(3)]


@pytest.mark.parametrize("value", THINGS, ids=repr)
def test_things_of_other_kinds_are_refused_by_name(value, tmp_path):
    store = corpus.small_store()
    table = {"t": np.arange(20.0), "id": np.zeros(20), "x": np.arange(20.0)}
    how = {"time": "t", "agent": "id", "state": ["x"]}
    asked = [
        lambda: EpisodeStore.load(value),
        lambda: store.save(value),
        lambda: ringfence.load_world(value),
        lambda: ringfence.undelay(value, 1),
        lambda: ringfence.replay(None, value),
        lambda: ringfence.train(value, store),
        lambda: store.followed_by(value),
        lambda: EpisodeStore.from_layout(table, value),
        lambda: build_report(value, tmp_path / "a.html"),
        lambda: importers.import_hdf5(value),
        lambda: importers.import_omar(value),
        lambda: importers.import_vault(value, "ant_2x4"),
        lambda: read_lerobot(value),
        lambda: All((value,)),
        lambda: Monitor(value),
        lambda: ringfence.collect(value, episodes=1),
        lambda: observe({"observation_names": ["own.x"], "agents": 3}, {"x": [1.0]}),
        lambda: observe({"observation_names": [value]}, {"x": [1.0]}),
    ]
    if value not in (None, {}) if not isinstance(value, np.ndarray) else True:
        asked.append(lambda: EpisodeStore.from_table(table, **how, card=value))
        asked.append(lambda: ringfence.collect(strange.Simulator, episodes=1, card=value))
    if value is not None and value is not len:
        asked.append(lambda: ringfence.collect(strange.Simulator, value, episodes=1))
        asked.append(lambda: ringfence.collect(strange.Simulator, episodes=1, cost=value))
    for ask in asked:
        with pytest.raises(UserError) as refused:
            ask()
        assert str(refused.value).isprintable()


@pytest.mark.parametrize("value", [5, 1.5, [], b"x"], ids=repr)
def test_things_of_other_kinds_are_refused_beside_a_run(value, trained_run, tmp_path):
    store, simulator, run = corpus.small_store(), SimpleSpreadParallel, trained_run
    asked = {
        **{name: lambda name=name: Controller(run, **{name: value}) for name in ("guard", "planner", "certificate")},
        "array": lambda: Controller(run, guard=np.zeros(3)),
        "world": lambda: Controller(run, guard="shield", world=value),
        "Certificate": lambda: Certificate.load(value),
        "Run": lambda: Run(value),
        "digest": lambda: store.digest(value),
        "state": lambda: observe(store.card, value),
        "card": lambda: observe(value, {"x": [1.0]}),
        "radius": lambda: Separation(value if value not in (5, 1.5) else "a"),
        "limit": lambda: SpeedLimit(value if value not in (5, 1.5) else None),
        "chunk": lambda: ringfence.train("bc", store, chunk=value if value != 5 else "a", out=tmp_path),
        "out": lambda: ringfence.train("bc", store, out=value),
        "changes": lambda: ringfence.train("bc", store, changes=value or 5, out=tmp_path),
        "ope": lambda: ringfence.ope(run, value),
        "faults": lambda: ringfence.play(run, simulator, faults=value or 5),
        "split": lambda: ringfence.play(run, simulator, split=value),
        "cost": lambda: ringfence.play(run, simulator, episodes=1, cost=value),
        **{
            f"play {name}": lambda name=name: ringfence.play(run, simulator, **{name: value})
            for name in ("guard", "world")
        },
        "stress": lambda: ringfence.stress(run, {"delay": 1}, make_env=simulator, planner=value),
        "certify": lambda: ringfence.certify(run, make_env=simulator, guard=value),
        "replay": lambda: ringfence.replay(run, store, planner=value, faults={}),
    }
    for name, ask in asked.items():
        with pytest.raises(UserError) as refused:
            ask()
        assert str(refused.value).isprintable(), name


def test_a_card_of_several_agents_is_of_no_split_team():
    store = corpus.small_store()
    with pytest.raises(UserError, match="team=7, which logs of single agents have"):
        dataclasses.replace(store, card=store.card.updated(team=7))


def test_cards_of_worlds_say_nothing_to_a_terminal():
    from ringfence.world.card import Card, Data, HeldOut

    card = Card(data=Data(task="\x1b]52;c;eA==\x07", hazard={"kind": "CostColumn"}), held_out=HeldOut(1, 2))
    assert "\x1b" not in str(card) and "\\x1b]52" in str(card)


def test_names_that_are_missing_are_no_agents():
    times = np.array(["NaT", "2020-01-01"], "datetime64[s]")
    with pytest.raises(UserError, match="row 0: id is missing"):
        strange.tabled(strange.columns(id=np.repeat(times, 20)))
    with pytest.raises(UserError, match=r"id has shape \(40, 1\); give one entry per row"):
        strange.tabled(strange.columns(id=np.repeat([[0], [1]], 20, 0)))
    for days in ("datetime64[Y]", "datetime64[M]", "datetime64[as]"):
        with pytest.raises(UserError, match="counts (years or months|attoseconds)"):
            strange.tabled(strange.columns(t=np.tile(np.arange(20), 2).astype(days)))
    with pytest.raises(UserError, match="row 0: t is"):
        strange.tabled(strange.columns(t=np.tile([f"0001-01-01T00:00:{k:02d}+14:00" for k in range(20)], 2)))
