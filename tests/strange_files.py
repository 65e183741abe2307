"""Files of every importer with junk in their fields, other bytes in them, cut short, or larger than they say."""

from __future__ import annotations

import copy
import json
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ringfence.datasets.importers import import_hdf5, import_omar
from ringfence.logs.io.lerobot import read_lerobot
from ringfence.logs.store import EpisodeStore
from tests import corpus
from tests.strange import Case

STEPS = 20
Read = Callable[[], EpisodeStore]


def sound(store: EpisodeStore) -> bool:
    """Whether a store that came of a broken file is a whole one: what its rules cannot see, nobody can."""
    arrays = (store.observations, store.actions, store.rewards, store.costs)
    return all(np.isfinite(array).all() for array in arrays) and store.steps > 0


def files(place: Path, rng: random.Random, times: int) -> Iterator[Case]:
    """All of them, one at a time."""
    for name, make in FORMATS.items():
        folder = place / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        read = make(folder)
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            raw = file.read_bytes()
            for what, content in changes(file, raw, rng, times):
                file.write_bytes(content)
                yield f"{name} {file.name}: {what}", read, sound
            file.write_bytes(raw)
        yield f"{name}: as it is", read, sound
    yield from bombs(place / "bombs")


def changes(file: Path, raw: bytes, rng: random.Random, times: int) -> Iterator[tuple[str, bytes]]:
    if file.suffix == ".json":
        yield from corpus.broken_json(raw, rng, each=2 * times)
        for where, junk in ((p, j) for p in corpus.places(json.loads(raw)) for j in MORE_JUNK):
            yield f"{where} is {junk!r:.20}", corpus.with_junk(copy.deepcopy(json.loads(raw)), where, junk)
    else:
        yield from corpus.broken_bytes(raw, rng, 25 * times)
        yield from corpus.broken_bytes(raw, rng, 15 * times, 200)  # heads hold the claims
    if file.suffix == ".npy":
        yield "an archive", b"PK\x03\x04" + raw
        yield "objects", _npy(np.array([None, 1], object))
        yield "words", _npy(np.array(["a", "b"]))
        yield "a bomb", raw[:10] + raw[10:].replace(b"(40,", b"(4000000000,", 1)


MORE_JUNK: list[Any] = [10**30, -1, 1e-320, "zz", [10**9], [[[]]], {"type": "Box"}, [None], False]


def _npy(array: np.ndarray) -> bytes:
    import io

    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


# --- one file of each format, and what reads it ---
def _d4rl(folder: Path, more: dict[str, np.ndarray] | None = None) -> Read:
    ends = np.arange(STEPS) % 10 == 9
    arrays = {"observations": _walk(STEPS, 3), "actions": np.zeros((STEPS, 2), "f4"), "rewards": np.ones(STEPS)}
    arrays |= {"terminals": np.zeros(STEPS, bool), "timeouts": ends} | (more or {})
    with h5py.File(folder / "a.hdf5", "w") as f:
        for name, array in arrays.items():
            f[name] = array
    return lambda: import_hdf5(folder / "a.hdf5")


def _dsrl(folder: Path) -> Read:
    seen = _walk(STEPS + 1, 3)
    return _d4rl(folder, {"observations": seen[:-1], "next_observations": seen[1:], "costs": np.zeros(STEPS)})


def _minari(folder: Path) -> Read:
    with h5py.File(folder / "main_data.hdf5", "w") as f:
        for k in range(2):
            group = f.create_group(f"episode_{k}")
            group["observations"], group["actions"] = _walk(11, 3), np.zeros((10, 2), "f4")
            group["rewards"], group["terminations"] = np.ones(10), np.zeros(10, bool)
            group["truncations"] = np.arange(10) == 9
            group["infos/cost"] = np.zeros(11)
    space = {"type": "Box", "dtype": "float32", "shape": [2], "low": [-1.0], "high": [1.0]}
    told = {"total_episodes": 2, "dataset_id": "a/b-v0", "env_spec": json.dumps({"id": "A-v0"})}
    (folder / "metadata.json").write_text(json.dumps(told | {"action_space": json.dumps(space)}))
    return lambda: import_hdf5(folder)


def _lerobot(folder: Path) -> Read:
    from pyarrow import parquet, table

    (folder / "meta").mkdir()
    (folder / "data" / "chunk-000").mkdir(parents=True)
    names = {"observation.state": ["x", "y"], "action": ["a", "b"], "next.reward": ["r"]}
    features: dict[str, Any] = {k: {"dtype": "float32", "shape": [len(v)], "names": v} for k, v in names.items()}
    told = {"codebase_version": "v2.1", "fps": 10, "total_frames": 2 * STEPS}
    features |= {"episode_index": {"dtype": "int64", "shape": [1], "names": None}, "frame_index": {"dtype": "int64"}}
    (folder / "meta" / "info.json").write_text(json.dumps(told | {"features": features}))
    for k in range(2):
        rows = {"episode_index": [k] * STEPS, "frame_index": list(range(STEPS)), "action": [[0.1, 0.2]] * STEPS}
        rows |= {"observation.state": [[0.1 * i, 0.2] for i in range(STEPS)], "next.reward": [1.0] * STEPS}
        parquet.write_table(table(rows), folder / "data" / "chunk-000" / f"episode_{k:06d}.parquet")

    def read() -> EpisodeStore:
        found = read_lerobot(folder)
        names = {"time": "time", "agent": "agent", "episode": "episode"}
        names |= {"state": found.state, "action": found.action, "reward": found.reward}
        return EpisodeStore.from_table(found.columns, **names, dt=found.dt)

    return read


def _omar(folder: Path) -> Read:
    from ringfence.envs import SimpleSpread

    env = SimpleSpread(n_agents=3)
    arrays = {"obs": np.zeros((50, env.observation_dim)), "acs": np.zeros((50, 2)), "rews": np.zeros(50)}
    for i in range(3):
        for kind, array in (arrays | {"dones": np.zeros(50)}).items():
            np.save(folder / f"{kind}_{i}.npy", array.astype(np.float32))
    return lambda: import_omar(folder)


def _walk(rows: int, width: int) -> np.ndarray:
    return np.cumsum(np.random.default_rng(0).normal(size=(rows, width)), 0).astype(np.float32)


FORMATS: dict[str, Callable[[Path], Read]] = {
    "d4rl": _d4rl,
    "dsrl": _dsrl,
    "minari": _minari,
    "lerobot": _lerobot,
    "omar": _omar,
}


# --- small files that claim a lot ---
def bombs(folder: Path) -> Iterator[Case]:
    """Files of under 10 MB, each to be refused, or read with no more memory or time than a usual one."""
    from pyarrow import DictionaryArray, array, parquet, table

    folder.mkdir(parents=True, exist_ok=True)
    names: dict[str, Any] = {"time": "t", "agent": "id", "state": ["x", "y"], "cost": "hit"}

    def from_table(name: str, **options: Any) -> Read:
        return lambda: EpisodeStore.from_table(folder / name, **names | options)

    (folder / "keys.jsonl").write_text("".join(f'{{"k{k}": 1}}\n' for k in range(20_000)))
    yield "JSON lines of 20,000 names", from_table("keys.jsonl"), lambda _: False
    wide = json.dumps({"t": 0} | {f"a{k}_{name}": 1 for k in range(2_000) for name in ("x", "y", "hit")})
    (folder / "wide.jsonl").write_text(wide + "\n" + "{}\n" * 100_000)
    yield "JSON lines of 2,000 agents", from_table("wide.jsonl", wide="{agent}_{column}"), lambda _: False
    vehicle = '<vehicle id="a" x="{0}" y="1" angle="90" speed="1"/>'
    rows = "".join(f'<timestep time="{k}">{vehicle.format(k)}</timestep>' for k in range(STEPS))
    long = rows.replace('id="a"', 'id="' + "z" * 5_000_000 + '"', 1)
    for what, text in {
        "a comment of 9 MB": f"<fcd-export><!--{'x' * 9_000_000}-->{rows}</fcd-export>",
        "an encoding that nobody knows": f"<?xml version='1.0' encoding='zz'?><fcd-export>{rows}</fcd-export>",
        "a name of 5 MB": f"<fcd-export>{long}</fcd-export>",
    }.items():
        (folder / "a.xml").write_text(text)
        yield f"SUMO with {what}", lambda: EpisodeStore.from_layout(folder / "a.xml", "sumo"), sound
    many = 200_000
    time = np.arange(many) * 0.1
    word = DictionaryArray.from_arrays(array(np.zeros(many, np.int32)), array(["z" * 1_000_000]))
    columns = {"t": time, "id": word, "x": time, "y": time, "hit": 0 * time}
    parquet.write_table(table(columns), folder / "word.parquet")
    yield "Parquet of one long word", from_table("word.parquet"), sound
    lists = DictionaryArray.from_arrays(array(np.zeros(many, np.int32)), array([1.0]))
    parquet.write_table(table(columns | {"id": lists, "x": [[0.0] * 100] * many}), folder / "lists.parquet")
    yield "Parquet of equal lists", from_table("lists.parquet"), lambda _: False
    read = _lerobot_of(folder / "lerobot", 8, 300_000)
    yield "LeRobot of equal frames", read, lambda _: False


def _lerobot_of(folder: Path, files: int, rows: int) -> Read:
    from pyarrow import parquet, table

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    read = _lerobot(folder)
    frames = {"frame_index": np.zeros(rows), "observation.state": [[0.0, 0.0]] * rows, "action": [[0.0, 0.0]] * rows}
    more = {"episode_index": np.zeros(rows), "next.reward": np.zeros(rows)}
    parquet.write_table(table(frames | more), folder / "a.parquet")
    for k in range(files):
        shutil.copyfile(folder / "a.parquet", folder / "data" / "chunk-000" / f"episode_{k:06d}.parquet")
    return read
