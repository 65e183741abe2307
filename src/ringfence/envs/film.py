"""Robots as pictures, with their speed and its limit drawn in."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

WIDTH = 320  # pixels
HEIGHT = 240
EMPTY = (225, 225, 225)
RED = (190, 50, 40)
BLUE = (70, 100, 200)
DARK = (20, 20, 20)
PAPER = (255, 255, 255)
DRAWN = (EMPTY, RED, BLUE, DARK, PAPER)


class Filmed(Protocol):
    """What of a robot's simulator its pictures need."""

    dt: ClassVar[float]  # s

    @property
    def ant(self) -> bool: ...

    @property
    def limit(self) -> float:
        """m/s"""
        ...

    @property
    def state_names(self) -> tuple[str, ...]: ...

    def model(self) -> Any: ...


def frames(env: Filmed, states: np.ndarray, moments: list[tuple[int, bool]]) -> Iterator[Image]:
    """Pictures of an episode, states (T+1, S), at `moments`: (step, whether it is shown as above the limit). The planar
    position is not in the state, so it is summed up from the velocity."""
    import mujoco
    from PIL import Image, ImageDraw

    mj: Any = mujoco  # its stubs lack what its extension defines
    model = env.model()
    model.light_castshadow[:] = 0
    data = mj.MjData(model)
    planar = 2 if env.ant else 1
    velocity = states[:, [env.state_names.index(f"torso.v{c}") for c in "xy"[:planar]]]
    speed = np.linalg.norm(velocity, axis=1)
    # Robots run off the floor, so they are drawn in the same place of its pattern near the middle.
    floor = np.flatnonzero(model.geom_type == mj.mjtGeom.mjGEOM_PLANE)[0]
    tile = 2 * model.geom_size[floor, :planar] / model.mat_texrepeat[model.geom_matid[floor], :planar]
    place = (np.cumsum(velocity, 0) * env.dt) % tile
    renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
    for step, over in moments:
        data.qpos[:] = np.concatenate([place[step], states[step, : model.nq - planar]])
        mj.mj_forward(model, data)
        renderer.update_scene(data, camera="track")
        picture = Image.fromarray(renderer.render())
        _draw_speed(ImageDraw.Draw(picture), step * env.dt, speed[step], env.limit, over)
        yield picture


def _draw_speed(draw: ImageDraw, seconds: float, speed: float, limit: float, over: bool) -> None:
    """The speed in words above and as a bar below, with a stroke at its limit."""
    scale = (WIDTH - 20) / (2 * limit)
    draw.rectangle((10, HEIGHT - 16, WIDTH - 10, HEIGHT - 8), fill=EMPTY)
    end = 10 + min(speed, 2 * limit) * scale
    draw.rectangle((10, HEIGHT - 16, end, HEIGHT - 8), fill=RED if over else BLUE)
    draw.line((10 + limit * scale, HEIGHT - 20, 10 + limit * scale, HEIGHT - 4), fill=DARK, width=2)
    text = f"{seconds:4.1f} s   {speed:.2f} m/s, limit {limit:g}" + ("   over" if over else "")
    draw.rectangle((0, 0, WIDTH, 16), fill=PAPER)
    draw.text((10, 3), text, fill=RED if over else DARK)
