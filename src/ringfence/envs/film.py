"""Robots as pictures, with their speed and its limit drawn in."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np


class Filmed(Protocol):
    """What of a robot's simulator its pictures need."""

    ant: bool
    dt: float
    limit: float  # m/s
    state_names: tuple[str, ...]

    def model(self) -> Any: ...


WIDTH, HEIGHT = 320, 240  # pixels
DRAWN = EMPTY, RED, BLUE, DARK, PAPER = (225, 225, 225), (190, 50, 40), (70, 100, 200), (20, 20, 20), (255, 255, 255)


def frames(env: Filmed, states: np.ndarray, moments: list[tuple[int, bool]]):
    """Pictures of an episode, states (T+1, S), at `moments`: (step, whether it is shown as above the limit). The planar
    position is not in the state, so it is summed up from the velocity."""
    import mujoco
    from PIL import Image, ImageDraw

    model = env.model()
    model.light_castshadow[:] = 0
    data, planar = mujoco.MjData(model), 2 if env.ant else 1
    moving = [env.state_names.index(f"torso.v{c}") for c in "xy"[:planar]]
    # Robots run off the floor, so they are drawn in the same place of its pattern near the middle.
    floor = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)[0]
    tile = 2 * model.geom_size[floor, :planar] / model.mat_texrepeat[model.geom_matid[floor], :planar]
    place = (np.cumsum(states[:, moving], 0) * env.dt) % tile
    speed = np.linalg.norm(states[:, moving], axis=1)
    renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
    nq = model.nq
    for t, over in moments:
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
        text = f"{t * env.dt:4.1f} s   {speed[t]:.2f} m/s, limit {env.limit:g}" + ("   over" if over else "")
        draw.rectangle((0, 0, WIDTH, 16), fill=PAPER)
        draw.text((10, 3), text, fill=RED if over else DARK)
        yield picture
