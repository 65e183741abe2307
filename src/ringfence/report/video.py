"""Robots as small animated pictures, drawn without a display: EGL or OSMesa on Linux, what the system has elsewhere.

MuJoCo decides how to draw when it is imported, so drawing happens in a process of its own.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from ringfence.envs.mujoco import DT, SafeMuJoCo
from ringfence.errors import UserError
from ringfence.evaluate import load_job
from ringfence.files import whole
from ringfence.report.animation import recording
from ringfence.runs import Run
from ringfence.tasks import Task

WIDTH, HEIGHT = 320, 240  # pixels
EVERY = 2  # steps per frame, at least
LONGEST = 200  # frames
DRAWN = EMPTY, RED, BLUE, DARK, PAPER = (225, 225, 225), (190, 50, 40), (70, 100, 200), (20, 20, 20), (255, 255, 255)
# MUJOCO_GL's values that can work on a platform (others are Linux), and what to do where none does.
BACKENDS = {"darwin": ("cgl",), "win32": ("wgl",)}
HELP = "install EGL (Debian: libegl1 libgl1-mesa-dri) or OSMesa (libosmesa6)"


def backend() -> str:
    """The value of MUJOCO_GL that works here; `UserError` where nothing can draw."""
    wanted, reasons = os.environ.get("MUJOCO_GL"), []
    trial = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 16, 16).render()"
    for name in (wanted,) if wanted else BACKENDS.get(sys.platform, ("egl", "osmesa")):
        made = _run([sys.executable, "-c", trial], name)
        if made.returncode == 0:
            return name
        reasons.append(f"{name}: {(made.stderr.strip().splitlines() or ['no reason given'])[-1]}")
    remedy = "log in with a display" if sys.platform in BACKENDS else HELP
    raise UserError(f"Robots cannot be drawn here ({'; '.join(reasons)}); {remedy}.")


def check(task: Task) -> None:
    """`UserError` where no film of a task's episodes can be made."""
    if not isinstance(task.env, SafeMuJoCo):
        raise UserError(f"Films show robots, and '{task.name}' has none; `ringfence report` animates its episodes.")
    backend()


def film(run: Run, variant: str) -> Path:
    """Make the GIF of the first episode that an evaluation recorded, beside its recording."""
    task = load_job(run).task
    check(task)
    kept = recorded(run, variant)
    return animate(task.env, kept["states"][0], kept["costs"][0], run.path / f"rollout-{variant}.gif")


def recorded(run: Run, variant: str) -> dict[str, np.ndarray]:
    """An evaluation's recording; `UserError` where it kept none."""
    kept = recording(run, variant)
    if kept is None:
        raise UserError(f"'{run.path}' holds no recording of {variant}; evaluate it with --record 1 or more.")
    return kept


def animate(env: SafeMuJoCo, states: np.ndarray, costs: np.ndarray, out: str | Path) -> Path:
    """Write an animated GIF of one episode: states (T+1, S), costs (T,). The speed and its limit are drawn in.
    The film ends with a fall, after which the last state is repeated.

    `UserError` where nothing can draw.
    """
    out, name = Path(out), backend()
    moved = np.flatnonzero((states[1:] != states[:-1]).any(1))
    steps = int(moved[-1]) + 1 if len(moved) else len(costs)
    with tempfile.TemporaryDirectory() as folder, whole(out) as temporary:
        file, picture = Path(folder) / "episode.npz", Path(folder) / "episode.gif"
        np.savez(file, states=states[: steps + 1], costs=costs[:steps], env=json.dumps(dataclasses.asdict(env)))
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
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, "MUJOCO_GL": name})


def stride(steps: int) -> int:
    """Steps per picture; long episodes are thinned out."""
    return max(EVERY, -(-(steps + 1) // LONGEST))


def moments(costs: np.ndarray) -> list[tuple[int, bool]]:
    """When an episode of costs (T,) is pictured, and whether a step since the picture before was above the limit; the
    last state T is pictured, too."""
    every = stride(len(costs))
    times = sorted({*range(0, len(costs) + 1, every), len(costs)})
    return [(t, bool(costs[max(0, t - every) : t].any())) for t in times]


def frames(env: SafeMuJoCo, states: np.ndarray, costs: np.ndarray):
    """Pictures of an episode: states (T+1, S), costs (T,). The planar position is not in the state, so it is summed up
    from the velocity."""
    import mujoco
    from PIL import Image, ImageDraw

    model = env.model()
    model.light_castshadow[:] = 0
    data, planar = mujoco.MjData(model), 2 if env.ant else 1
    moving = [env.state_names.index(f"torso.v{c}") for c in "xy"[:planar]]
    # Robots run off the floor, so they are drawn in the same place of its pattern near the middle.
    floor = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)[0]
    tile = 2 * model.geom_size[floor, :planar] / model.mat_texrepeat[model.geom_matid[floor], :planar]
    place = (np.cumsum(states[:, moving], 0) * DT) % tile
    speed = np.linalg.norm(states[:, moving], axis=1)
    renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
    nq = model.nq
    for t, over in moments(costs):
        data.qpos[:] = np.concatenate([place[t], states[t, : nq - planar]])
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, camera="track")
        picture = Image.fromarray(renderer.render())
        draw = ImageDraw.Draw(picture)
        scale = (WIDTH - 20) / (2 * env.limit)
        draw.rectangle((10, HEIGHT - 16, WIDTH - 10, HEIGHT - 8), fill=EMPTY)
        end = 10 + min(speed[t], 2 * env.limit) * scale
        draw.rectangle((10, HEIGHT - 16, end, HEIGHT - 8), fill=RED if over else BLUE)
        draw.line((10 + env.limit * scale, HEIGHT - 20, 10 + env.limit * scale, HEIGHT - 4), fill=DARK, width=2)
        text = f"{t * DT:4.1f} s   {speed[t]:.2f} m/s, limit {env.limit:g}" + ("   over" if over else "")
        draw.rectangle((0, 0, WIDTH, 16), fill=PAPER)
        draw.text((10, 3), text, fill=RED if over else DARK)
        yield picture


def with_one_palette(pictures: list, colours: int = 64) -> list:
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
    palette = sample.quantize(colours)
    return [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]


def main() -> None:
    """Draw the episode in a file that `animate` wrote."""
    with np.load(sys.argv[1]) as file:
        env = SafeMuJoCo(**json.loads(str(file["env"])))
        states, costs = file["states"], file["costs"]
    pictures = with_one_palette(list(frames(env, states, costs)))
    shown = round(1000 * DT * stride(len(costs)))  # ms
    pictures[0].save(sys.argv[2], save_all=True, append_images=pictures[1:], duration=shown, loop=0)


if __name__ == "__main__":
    main()
