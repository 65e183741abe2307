"""Files and values from strangers: what is broken in them, generated from a seed.

`tests/test_hostile.py` tries some of it at every run, `benchmarks/hostile.py` more.
"""

from __future__ import annotations

import copy
import json
import random
import shutil
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from ringfence.bench.packed import ARCHIVES, unpack
from ringfence.evaluation import recordings
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints

TASK = "simple_spread-expert"
RESULTS = Path(__file__).resolve().parent.parent / "results" / "guards"
Broken = tuple[str, bytes]  # what was done, and the contents
_GONE = object()
JUNK = [
    None, True, -1, 0, 3, 2**70, 1e300, "", "x", "../../x", "/etc/passwd", "\ud800", "a\nb", "<script>", "$x^$", "=1+1",
    "[/red]", "x" * 300, [], [1], {}, {"kind": ["x"]}, float("nan"), float("inf"), [[]], _GONE,
]  # fmt: skip
RAW = (
    b"",
    b"[" * 100_000,
    b'{"a":' * 50_000,
    b'{"seed":' + b"9" * 5000 + b"}",
    b"\xff\xfe",
    b"null",
    b"NaN",
    b'"\\ud800"',
)


def places(told, depth: int = 3) -> Iterator[tuple]:
    """Paths to the fields of a JSON object, and to the entries of its short lists."""
    for key, value in told.items() if isinstance(told, dict) else enumerate(told):
        yield (key,)
        if depth > 1 and (isinstance(value, dict) or (isinstance(value, list) and len(value) < 5)):
            yield from ((key, *rest) for rest in places(value, depth - 1))


def with_junk(told: dict, place: tuple, junk) -> bytes:
    told = inner = copy.deepcopy(told)
    for key in place[:-1]:
        inner = inner[key]
    if junk is _GONE:
        del inner[place[-1]]
    else:
        inner[place[-1]] = junk
    return json.dumps(told).encode()


def broken_json(raw: bytes, rng: random.Random, each: int = 2) -> Iterator[Broken]:
    """Junk in every field, and files that are no JSON."""
    told = json.loads(raw)
    for place in places(told):
        for junk in rng.sample(JUNK, each):
            yield f"{place} is {'gone' if junk is _GONE else repr(junk)[:20]}", with_junk(told, place, junk)
    yield from (("raw", content) for content in RAW)
    yield from broken_bytes(raw, rng, 10 * each)


def broken_bytes(raw: bytes, rng: random.Random, count: int, within: int | None = None) -> Iterator[Broken]:
    """Single flipped bits, and files cut short."""
    for _ in range(count):
        at, bit = rng.randrange(min(within or len(raw), len(raw))), 1 << rng.randrange(8)
        yield f"bit {bit} of byte {at} flipped", raw[:at] + bytes([raw[at] ^ bit]) + raw[at + 1 :]
    for at in rng.sample(range(len(raw)), min(count // 4, len(raw))):
        yield f"cut at {at}", raw[:at]


def one_cell(place: Path) -> Path:
    """A results folder of one cell and its reference rows, as they are in the repository."""
    whole, few = place / "whole", place / "few"
    whole.mkdir(parents=True)
    for name in ("bench.json", *ARCHIVES):
        shutil.copyfile(RESULTS / name, whole / name)
    unpack(whole)
    shutil.copytree(whole / "reference" / TASK, few / "reference" / TASK)
    shutil.copyfile(whole / "bench.json", few / "bench.json")
    cell = next((whole / "cells" / TASK / "bc").glob("seed-0-*"))
    shutil.copytree(cell, few / "cells" / TASK / "bc" / cell.name)
    return few


def small_store(seed: int = 0) -> EpisodeStore:
    rng = np.random.default_rng(seed)
    return EpisodeStore.from_episodes(
        rng.normal(size=(6, 6, 2, 4)).astype(np.float32),
        rng.uniform(-1, 1, (6, 5, 2, 2)).astype(np.float32),
        rng.normal(size=(6, 5, 2)),
        (rng.random((6, 5)) < 0.2).astype(float),
        card={"task": "strange", "hazard": constraints.CostColumn()},
    )


def broken_stores(raw: bytes, folder: Path) -> Iterator[tuple[str, Path]]:
    """Stores whose arrays or card are of another kind, in other files, or larger than can be."""
    other = folder / "other.h5"
    with h5py.File(other, "w") as f:
        f["x"] = np.zeros(30)
    huge = dict(observations=(60_000_001, 2, 4), actions=(60_000_000, 2, 2), rewards=(60_000_000, 2))
    huge |= dict.fromkeys(("costs", "terminated", "truncated"), (60_000_000,))
    instead = {
        "huge": lambda f: f.create_dataset("costs", shape=(1_300_000_000,), dtype="f4", chunks=(1000,)),
        "in another file": lambda f: f.__setitem__("costs", h5py.ExternalLink(str(other), "/x")),
        "linked": lambda f: f.__setitem__("costs", h5py.SoftLink("/rewards")),
        "external": lambda f: f.create_dataset("costs", shape=(30,), dtype="f8", external=[(str(other), 0, 240)]),
        "virtual": lambda f: f.create_virtual_dataset("costs", _layout(other)),
        "words": lambda f: f.__setitem__("costs", np.array([b"x"] * 30)),
        "one number": lambda f: f.__setitem__("costs", 3.0),
        "empty": lambda f: f.__setitem__("costs", h5py.Empty("f4")),
        "a group": lambda f: f.create_group("costs"),
        "records": lambda f: f.__setitem__("costs", np.zeros(30, dtype=[("a", "f4")])),
        "complex": lambda f: f.__setitem__("costs", np.zeros(30, complex)),
        "negative": lambda f: f.__setitem__("costs", np.full(30, -1.0)),
        "not finite": lambda f: f.__setitem__("costs", np.full(30, np.nan)),
        "gone": lambda f: None,
    }
    cards = (
        3,
        np.zeros(3),
        np.bytes_(b"\xff\xfe{"),
        "[" * 60_000,
        "null",
        '{"task": "../x"}',
        '{"hazard": {"kind": ["x"]}}',
    )
    edits = {f"costs {k}": (lambda f, put=put: (f.__delitem__("costs"), put(f))) for k, put in instead.items()}
    edits |= {
        f"card {str(c)[:20]}": (lambda f, c=c: (f.attrs.__delitem__("card_digest"), f.attrs.__setitem__("card", c)))
        for c in cards
    }
    edits["another limit"] = lambda f: f.attrs.__setitem__("card", json.dumps({"task": "strange", "cost_limit": 9.0}))
    edits["all huge"] = lambda f: [
        (f.__delitem__(n), f.create_dataset(n, shape=s, chunks=_chunks(s))) for n, s in huge.items()
    ]
    edits["format"] = lambda f: f.attrs.__setitem__("ringfence_store", np.zeros(3))
    edits["other numbers"] = lambda f: f["rewards"].__setitem__((0, 0), 9.0)
    for what, edit in edits.items():
        path = folder / "edited.h5"
        path.write_bytes(raw)
        with h5py.File(path, "a") as f:
            edit(f)
        yield what, path


def _layout(other: Path) -> h5py.VirtualLayout:
    layout = h5py.VirtualLayout(shape=(30,), dtype="f8")
    layout[:] = h5py.VirtualSource(str(other), "x", shape=(30,))
    return layout


def _chunks(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(min(n, 1000) for n in shape)


def small_recording(folder: Path) -> Path:
    """Of one variant, "plain", in a run's folder."""
    rng = np.random.default_rng(0)
    played = {"states": rng.normal(size=(2, 6, 12)), "costs": rng.random((2, 5)), "rewards": rng.normal(size=(2, 5))}
    recordings.write(folder, "plain", played | {"plans": rng.normal(size=(2, 5, 3, 4, 2, 8))}, 2)
    return folder / "rollout-plain.npz"


def broken_recordings(good: dict[str, np.ndarray], path: Path) -> Iterator[tuple[str, Path]]:
    """Recordings of other kinds and shapes, and one that unpacks to ten thousand times its size."""
    states = good["states"]
    for what, instead in {
        "without costs": {k: v for k, v in good.items() if k != "costs"},
        "flat": good | {"states": states.ravel()},
        "words": good | {"states": states.astype(str)},
        "objects": good | {"states": states.astype(object)},
        "too short": good | {"plans": good["plans"][:, :2]},
        "nothing": good | {"costs": np.zeros((0, 5)), "states": states[:0]},
        "a bomb": good | {"states": np.zeros((2, 6, 20_000_000), np.int8)},
    }.items():
        np.savez_compressed(path, **instead)
        yield what, path
