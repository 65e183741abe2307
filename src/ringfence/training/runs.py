"""The run folder: everything downstream reads these files and nothing else.

config.json     algorithm, preset, config, task, spec, hazard, seed, data card
env.json        versions, hardware, git commit
episodes.json   digest of every episode that was trained on
logs.json       what these earned and cost, where the data is of no benchmark
metrics.jsonl   one line per logged chunk of updates
ckpt/           step-00004000.safetensors: whole or absent, the last two are kept
world, guard    .safetensors: the World that training read, and the one that guards (worlds.py)
results.json    what `ringfence eval` measured, one entry per variant
"""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from ringfence.errors import CheckpointError, UserError, reason
from ringfence.types import PyTree
from ringfence.utils import schemas
from ringfence.utils.files import alone, place, regular, whole
from ringfence.utils.pytrees import as_tree, digest_of, named_arrays, save_named

_log = logging.getLogger(__name__)

KEEP = 2  # checkpoints
LARGEST = 1e30  # size of a metric that is drawn
LOGS = "logs.json"


@dataclass(frozen=True)
class Run:
    """A run folder on disk."""

    path: Path

    def __post_init__(self):
        object.__setattr__(self, "path", place(self.path))

    @classmethod
    def of(cls, run: Run | str | Path) -> Run:
        """A run, the one in the folder that is named, or the only one below it."""
        if callable(run):
            raise UserError(
                f"{getattr(run, '__name__', type(run).__name__)} is a function and no run; give "
                "ringfence.guard(function, world), with guard='none' to see what it does alone."
            )
        if not isinstance(run, Run | str | Path) or not str(getattr(run, "path", run)).strip():
            raise UserError(f"{str(run)[:60]!r} is no run; give the folder that `ringfence train` made.")
        if isinstance(run, Run):
            return run
        below = runs_below(Path(run))
        if len(below) > 1:
            names = ", ".join(f"'{one.path}'" for one in below[:3])
            raise UserError(f"'{run}' holds {len(below)} runs; name one of them: {names}{', …' * (len(below) > 3)}.")
        return below[0] if below else cls(Path(run))

    @property
    def config(self) -> dict[str, Any]:
        """Contents of config.json."""
        remedy = "is no run folder that can be read; give the one that `ringfence train` made, or train it again"
        return dict(schemas.read(self.path / "config.json", schemas.Config, remedy))

    @property
    def agents(self) -> list[str] | None:
        """Names of the agents that it was trained on, in order; None where any number plays, or nobody named them."""
        config = self.config
        names = config["data"].get("agents")
        return names if names and len(names) == config.get("team") and not config["spec"].get("homogeneous") else None

    @property
    def results(self) -> dict[str, dict[str, Any]]:
        """Evaluations by variant; empty before the first `ringfence eval`."""
        file = self.path / "results.json"
        remedy = "holds a damaged results.json; delete that file and evaluate the run again"
        if not file.exists():
            return {}
        return {variant: dict(result) for variant, result in schemas.read(file, schemas.Results, remedy).items()}

    @property
    def episodes(self) -> set[str] | None:
        """Digests of the episodes that it was trained on; None of runs of before, which do not tell."""
        file = self.path / "episodes.json"
        remedy = "holds a damaged episodes.json; delete that file"
        return set(schemas.read(file, list[str], remedy)) if file.exists() else None

    @property
    def logs(self) -> schemas.Outcomes | None:
        """What the episodes that it was trained on earned and cost; None where nobody kept it."""
        file = self.path / LOGS
        if not file.exists():
            return None
        remedy = f"holds a damaged {LOGS}; delete that file"
        logs = schemas.read(file, schemas.Outcomes, remedy)
        columns = [logs["returns"], logs["costs"], logs["steps"], logs["terminated"], *logs["constraints"].values()]
        lengths = {len(column) for column in columns}
        if len(lengths) > 1 or 0 in lengths:
            raise UserError(f"'{file}' {remedy}.")
        return logs

    @property
    def metrics(self) -> list[dict]:
        """Logged training metrics, oldest first; a line that an interruption cut short is dropped."""
        file = self.path / "metrics.jsonl"
        rows: list[dict] = []
        if not file.exists():
            return rows
        try:
            lines = regular(file).read_text(errors="replace").splitlines()
        except (OSError, ValueError) as error:
            raise UserError(f"'{file}' cannot be read ({error}); delete it.") from None
        for line in lines:
            with suppress(ValueError):
                row = schemas.decode(line, schemas.Row)
                numbers = {k: x for k, x in row.items() if isinstance(x, int | float) and not isinstance(x, bool)}
                rows.append({name: x for name, x in numbers.items() if abs(x) <= LARGEST})
        return rows

    def checkpoints(self) -> list[tuple[int, Path]]:
        """(step, file), oldest first."""
        found = []
        for file in (self.path / "ckpt").glob("step-*.safetensors"):
            match = re.fullmatch(r"step-(\d+)\.safetensors", file.name)
            if match and file.is_file():
                found.append((int(match[1]), file))
        return sorted(found)

    def drop_damaged(self) -> None:
        """Delete last checkpoints that are truncated or damaged, and say so: training goes on from the one before."""
        for at, file in reversed(self.checkpoints()):
            try:
                sound_arrays(file, at)
                return
            except ValueError as wrong:
                _log.warning(f"'{file}' is truncated or damaged ({wrong}); it is dropped.")
                file.unlink(missing_ok=True)

    def save_checkpoint(self, step: int, state: PyTree) -> Path:
        """Write the state's arrays; a full disk or an interruption leaves the previous checkpoint as it was."""
        final = self.path / "ckpt" / f"step-{step:08d}.safetensors"
        arrays = named_arrays(state)
        # one entry: safetensors writes several in any order, and a run is the same to the byte
        save_named(final, arrays, {"digest": digest_of(sorted(arrays.items()))})
        for _, old in self.checkpoints()[:-KEEP]:
            old.unlink(missing_ok=True)
        return final

    def load_checkpoint(self, template: PyTree, step: int | None = None) -> tuple[int, PyTree]:
        """(step, state) of the last checkpoint, or of `step`; arrays must match the template in name and shape."""
        found = self.checkpoints()
        if not found:
            raise CheckpointError(f"'{self.path}' holds no checkpoint; train it with `ringfence train` first.")
        if step is not None:
            there = ", ".join(str(at) for at, _ in found)
            found = [c for c in found if c[0] == step]
            if not found:
                raise CheckpointError(f"'{self.path}' holds no checkpoint of step {step}; take one of: {there}.")
        problem = ""
        for at, file in reversed(found):
            if problem:
                _log.warning(f"{problem}; the one before is used.")
            try:
                return at, as_tree(sound_arrays(file, at), template, file)
            except ValueError as wrong:
                if isinstance(wrong, UserError):  # sound, but of another model
                    raise
                problem = f"'{file}' is truncated or damaged ({wrong})"
        raise CheckpointError(f"{problem}; delete it and train the run again.")

    def add_result(self, variant: str, result: dict) -> None:
        """Keep a result beside the others, whoever else adds some at the same time."""
        add_entry(self.path / "results.json", lambda: self.results, variant, result)


def runs_below(folder: Path) -> list[Run]:
    """The run in a folder, or those in folders of it, in order; hidden folders are half-copied."""
    if (folder / "config.json").exists():
        return [Run(folder)]
    files = sorted(folder.rglob("config.json")) if folder.is_dir() else []
    return [Run(f.parent) for f in files if not any(p.startswith(".") for p in f.relative_to(folder).parts)]


def sound_arrays(file: Path, step: int) -> dict[str, np.ndarray]:
    """What a checkpoint of that step holds; ValueError says what is wrong with it. Those older than digests are
    believed."""
    regular(file)
    try:
        with safe_open(file, framework="np") as opened:
            metadata = opened.metadata() or {}
            arrays = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 (it is no dict)
    except (SafetensorError, OSError, ValueError, TypeError) as error:
        raise ValueError(str(error).splitlines()[0]) from error
    if arrays.get("step", np.array(step)).tolist() != step:
        raise ValueError("it is not of the step in its name")
    if "digest" in metadata and metadata["digest"] != digest_of(sorted(arrays.items())):
        raise ValueError("its contents have changed")
    return arrays


def add_entry(path: Path, read: Callable[[], dict[str, Any]], name: str, entry: dict[str, Any]) -> None:
    """One more entry of a JSON file that `read` reads, whoever else adds some at the same time."""
    with alone(path.with_name(f".{path.stem}.lock")):
        write_json(path, {**read(), name: entry})


def write_json(path: Path, data: Any) -> None:
    """Whole or not at all; what nobody could read again is refused, a number that is not finite by its name."""
    try:
        content = json.dumps(data, indent=1, allow_nan=False)
        schemas.decode(content, Any)
    except ValueError as error:
        if not any(_not_finite(data)):
            raise UserError(f"'{path}' could not be read again ({reason(error)}); nothing was added to it.") from None
        name = next(_not_finite(data), "something")
        raise UserError(f"'{path}' holds finite numbers alone, and {name} is none; nothing was added to it.") from None
    with whole(path) as temporary:
        temporary.write_text(content)


def _not_finite(data: Any, name: str = "") -> Iterator[str]:
    """Names of numbers that are not finite."""
    if isinstance(data, dict):
        for key, value in data.items():
            yield from _not_finite(value, str(key))
    if isinstance(data, list | tuple):
        for value in data:
            yield from _not_finite(value, name)
    if isinstance(data, float) and not math.isfinite(data):
        yield f"{name} = {data}"
