"""What all benchmarks share: naming the machine and writing rows of measurements."""

from __future__ import annotations

import json
import os
import shlex
import sys
from pathlib import Path
from typing import Any

import jax

from ringfence.utils.environment import processor


def machine() -> str:
    """CPU model, usable cores, the accelerator if JAX runs on one, and the JAX version, in one line."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    device = jax.devices()[0]
    accelerator = "" if device.platform == "cpu" else f", {device.device_kind}"
    return f"{processor()}, {cores} cores{accelerator}, jax {jax.__version__}"


def command() -> str:
    """The command line of this run, as one would type it in the repository."""
    script = Path(sys.argv[0])
    root = Path(__file__).resolve().parent.parent
    if script.resolve().is_relative_to(root):
        script = script.resolve().relative_to(root)
    return shlex.join(["python", str(script), *sys.argv[1:]])


class Rows(list):
    """Measurements as they come: `rows(name, value, unit)` keeps one for `record` and prints it."""

    def __call__(self, name: str, value: float, unit: str) -> None:
        self.append({"name": name, "value": value, "unit": unit})
        print(f"{name}: {value:.4g} {unit}", flush=True)


def record(path: str | Path, rows: list[dict[str, Any]]) -> None:
    """Print rows {name, value, unit, ...} and write them to `path` as a JSON list; `command` and `machine` are added
    where a row lacks them."""
    common = {"command": command(), "machine": machine()}
    rows = [{**common, **row} for row in rows]
    order = ("name", "value", "unit", "command", "machine")
    rows = [{k: row[k] for k in (*order, *(k for k in row if k not in order))} for row in rows]
    for row in rows:
        print(f"{row['name']:<48} {row['value']:>14,.6g} {row['unit']}")
    print(rows[0]["machine"] if rows else common["machine"])
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows, indent=2) + "\n")
