"""Episodes as small animated pictures, drawn without a display: EGL or OSMesa on Linux, what the system has elsewhere.

A simulator that has `frames` draws them (envs/film.py). MuJoCo decides how to draw when it is imported,
so drawing happens in a process of its own.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.datasets.task import Task
from ringfence.envs.base import Filmed
from ringfence.envs.film import DRAWN
from ringfence.errors import UserError, needs
from ringfence.evaluation import recordings
from ringfence.loading.resolve import load_job
from ringfence.training.runs import Run
from ringfence.utils.files import whole

EVERY = 2  # steps per frame, at least
LONGEST = 200  # frames
COLOURS = 64  # of a film
# MUJOCO_GL's values that can work on a platform (others are Linux), and what to do where none does.
BACKENDS = {"darwin": ("cgl",), "win32": ("wgl",)}
HELP = "install EGL (Debian: libegl1 libgl1-mesa-dri) or OSMesa (libosmesa6)"


def backend() -> str:
    """The value of MUJOCO_GL that works here; `UserError` where nothing can draw."""
    wanted = os.environ.get("MUJOCO_GL")
    reasons = []
    trial = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 16, 16).render()"
    with needs("sim", "Films of robots"):
        import mujoco  # noqa: F401
    for name in (wanted,) if wanted else BACKENDS.get(sys.platform, ("egl", "osmesa")):
        made = _run([sys.executable, "-c", trial], name)
        if made.returncode == 0:
            return name
        reasons.append(f"{name}: {(made.stderr.strip().splitlines() or ['no reason given'])[-1]}")
    remedy = "log in with a display" if sys.platform in BACKENDS else HELP
    raise UserError(f"Robots cannot be drawn here ({'; '.join(reasons)}); {remedy}.")


def check(task: Task) -> None:
    """`UserError` where no film of a task's episodes can be made."""
    if _opengl(_filmed(task)):
        backend()


def _filmed(task: Task) -> Any:
    """A task's simulator, which draws its episodes."""
    if not isinstance(task.env, Filmed):
        raise UserError(f"The simulator of '{task.name}' draws no films; `ringfence report` animates its episodes.")
    return task.env


def _opengl(env: Any) -> bool:
    return getattr(env, "opengl", False)


def film(run: Run, variant: str) -> Path:
    """Make the GIF of the first episode that an evaluation recorded, beside its recording."""
    task = load_job(run, run.results.get(variant, {}).get("agents")).task
    check(task)
    kept = recorded(run, variant)
    return animate(_filmed(task), kept["states"][0], kept["costs"][0], run.path / f"rollout-{variant}.gif")


def recorded(run: Run, variant: str) -> recordings.Recording:
    """An evaluation's recording; `UserError` where it kept none."""
    kept = recordings.read(run.path, variant)
    if kept is None or "states" not in kept:
        raise UserError(f"'{run.path}' holds no recording of {variant}; evaluate it with --num-recorded 1 or more.")
    return kept


def animate(env: Any, states: np.ndarray, costs: np.ndarray, out: str | Path) -> Path:
    """Write an animated GIF of one episode: states (T+1, S), costs (T,), drawn by its simulator. The film ends with a
    fall, after which the last state is repeated.

    `UserError` where nothing can draw.
    """
    out = Path(out)
    name = backend() if _opengl(env) else ""
    moved = np.flatnonzero((states[1:] != states[:-1]).any(1))
    steps = int(moved[-1]) + 1 if len(moved) else len(costs)
    with tempfile.TemporaryDirectory() as folder, whole(out) as temporary:
        file = Path(folder) / "episode.npz"
        picture = Path(folder) / "episode.gif"
        kind = f"{type(env).__module__}:{type(env).__qualname__}"
        made_of = json.dumps([kind, dataclasses.asdict(env)])
        np.savez(file, states=states[: steps + 1], costs=costs[:steps], env=made_of)
        made = _run([sys.executable, "-m", "ringfence.report.video", str(file), str(picture)], name)
        if made.returncode:
            said = (made.stderr.strip().splitlines() or ["nothing"])[-1]
            raise UserError(
                f"'{out}' could not be drawn: the process that draws ended with status {made.returncode} and said: "
                f"{said}; free some memory and try again."
            )
        temporary.write_bytes(picture.read_bytes())
    return out


def _run(command: list[str], name: str) -> subprocess.CompletedProcess:
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, "MUJOCO_GL": name or "egl"})


def stride(steps: int) -> int:
    """Steps per picture; long episodes are thinned out."""
    return max(EVERY, -(-(steps + 1) // LONGEST))


def moments(costs: np.ndarray) -> list[tuple[int, bool]]:
    """When an episode of costs (T,) is pictured, and whether a step since the picture before was above the limit; the
    last state T is pictured, too."""
    every = stride(len(costs))
    times = sorted({*range(0, len(costs) + 1, every), len(costs)})
    return [(t, bool(costs[max(0, t - every) : t].any())) for t in times]


def with_one_palette(pictures: list) -> list:
    """RGB pictures in the same few colours, those of bars and words among them: nothing flickers, nothing is lost."""
    from PIL import Image

    some = pictures[:: max(1, len(pictures) // 4)]
    width, height = some[0].size
    stripe = height // 8  # of each drawn colour, high enough to keep a place of its own
    sample = Image.new("RGB", (width, len(some) * height + len(DRAWN) * stripe))
    for k, picture in enumerate(some):
        sample.paste(picture, (0, k * height))
    for k, colour in enumerate(DRAWN):
        top = len(some) * height + k * stripe
        sample.paste(colour, (0, top, width, top + stripe))
    palette = sample.quantize(COLOURS)
    return [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]


def main() -> None:
    """Draw the episode in a file that `animate` wrote."""
    with np.load(sys.argv[1]) as file:
        kind, fields = json.loads(str(file["env"]))
        states = file["states"]
        costs = file["costs"]
    env = getattr(importlib.import_module(kind.partition(":")[0]), kind.partition(":")[2])(**fields)
    pictures = with_one_palette(list(env.frames(states, moments(costs))))
    shown = round(1000 * env.dt * stride(len(costs)))  # ms
    pictures[0].save(sys.argv[2], save_all=True, append_images=pictures[1:], duration=shown, loop=0)


if __name__ == "__main__":
    main()
