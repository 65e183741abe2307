"""Trained policies that come with the package, each with the World that guards it, to be evaluated, filmed and played
without training anything.

    zoo/TASK/ALGORITHM.safetensors      what playing reads, in half precision, and the run's config
    zoo/TASK/world.safetensors          the World that guards all of the task's policies
    zoo/TASK/ALGORITHM-world.safetensors   the one that training read, where it is another

`python benchmarks/zoo.py` makes them of benchmark cells, and plays both beside each other.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path

import numpy as np
from safetensors import safe_open
from safetensors.numpy import load_file

from ringfence.errors import UserError, unknown
from ringfence.training.runs import Run, write_json
from ringfence.training.worlds import GUARD, WORLD
from ringfence.utils.files import whole, writable
from ringfence.utils.pytrees import digest_of, named_arrays, save_named
from ringfence.world import World
from ringfence.world import save as save_world

FOLDER = Path(__file__).parent


def names() -> list[str]:
    """TASK/ALGORITHM of all that there are."""
    found = (f for f in FOLDER.glob("*/*.safetensors") if not f.stem.endswith("world"))
    return sorted(f"{f.parent.name}/{f.stem}" for f in found)


def pretrained(name: str, out: str | Path = "runs") -> Run:
    """The run folder out/TASK/ALGORITHM/seed-S of a trained policy, made of the file in the package; the one that is
    there if it is the same."""
    if name not in names():
        raise unknown("trained policy", str(name), names())
    file = FOLDER / f"{name}.safetensors"
    with safe_open(file, "numpy") as opened:
        metadata = json.loads(opened.metadata()["ringfence_policy"])
    run = Run(Path(out) / name / f"seed-{metadata['config']['seed']}")
    config = run.path / "config.json"
    if config.exists():
        if run.config != metadata["config"]:
            raise UserError(f"'{run.path}' holds another run; choose another place with --out.")
        if run.checkpoints():
            return run
    writable(config)
    kept = load_file(file)
    arrays = {k: kept[k].astype(kind) for k, kind in metadata["kinds"].items()}
    arrays |= {k: arrays[other] for k, other in metadata["same"].items()}
    arrays |= {k: np.zeros(shape, kind) for k, (shape, kind) in metadata["zeros"].items()}
    arrays["step"] = np.array(metadata["step"], metadata["step_kind"])
    task = name.split("/")[0]
    own = FOLDER / f"{name}-world.safetensors"
    worlds = {WORLD: own, GUARD: FOLDER / task / "world.safetensors"}
    if not own.exists():
        worlds = {WORLD: worlds[GUARD]}
    for there, here in worlds.items():
        with whole(run.path / there) as temporary:
            temporary.write_bytes(here.read_bytes())
    write_json(run.path / "env.json", metadata["env"])
    write_json(config, metadata["config"])
    run.save_checkpoint(metadata["step"], arrays)
    return run


def put(run: Run, name: str, read: World | None, guards: World, folder: Path = FOLDER) -> list[Path]:
    """Write what playing reads of a run's last checkpoint, the World that its training read and the one that guards,
    and say which files. Of weights and their running mean the mean is kept, of optimisers nothing."""
    step, file = run.checkpoints()[-1]
    arrays = load_file(file)
    averaged = {k for k in arrays if k.startswith("params/") and f"ema/{k[7:]}" in arrays}
    drop = {k for k in arrays if k.startswith("opt/")} | averaged | {"step"}
    kept = {k: half(v, k) for k, v in arrays.items() if k not in drop}
    about = {
        "config": run.config,
        "env": json.loads((run.path / "env.json").read_text()),
        "step": step,
        "step_kind": str(arrays["step"].dtype),
        "kinds": {k: str(arrays[k].dtype) for k in kept},
        "same": {k: f"ema/{k[7:]}" for k in sorted(averaged)},
        "zeros": {k: (v.shape, str(v.dtype)) for k, v in arrays.items() if k.startswith("opt/")},
    }
    made = [folder / f"{name}.safetensors"]
    save_named(made[0], kept, {"ringfence_policy": json.dumps(about)})
    task = folder / name.split("/")[0]
    made += [_put_world(guards, task / "world.safetensors")]
    if read is not None and _content(read) != _content(guards):
        made += [_put_world(read, folder / f"{name}-world.safetensors")]
    return made


def renew(task: str, guards: World, readers: Collection[str], folder: Path = FOLDER) -> Path:
    """Have another World guard a task's policies. `readers` are the algorithms whose training read the one of before;
    they keep it."""
    file = folder / task / "world.safetensors"
    for algorithm in readers:
        own = folder / task / f"{algorithm}-world.safetensors"
        if not own.exists():
            own.write_bytes(file.read_bytes())
    return _put_world(guards, file)


def half(x: np.ndarray, name: str) -> np.ndarray:
    """In half precision, where it is of real numbers; refused where they do not fit."""
    if x.dtype != np.float32:
        return x
    with np.errstate(over="ignore"):
        short = x.astype(np.float16)
    if not np.isfinite(short).all():
        raise UserError(f"'{name}' holds numbers beyond {np.finfo(np.float16).max:g}, which half precision does not.")
    return short


def _put_world(world: World, file: Path) -> Path:
    save_world(world, file, half)
    return file


def _content(world: World) -> str:
    return digest_of(named_arrays(world).items())
