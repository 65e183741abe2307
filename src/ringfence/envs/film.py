"""Episodes as pictures: robots with their speed and its limit, and scenes from above, of discs with their tails, what
each of them heads for, and who touches."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from ringfence.errors import needs

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

WIDTH = 320  # pixels, of robots
HEIGHT = 240
SIZE = 480  # pixels of a side, from above
FINE = 2  # drawn so many times larger
LABEL = 20  # pixels of the words' height
TAIL = 12  # steps
EMPTY = (225, 225, 225)
RED = (190, 50, 40)
BLUE = (70, 100, 200)
DARK = (20, 20, 20)
PAPER = (255, 255, 255)
DRAWN = (EMPTY, RED, BLUE, DARK, PAPER)
COUNT = 8  # colours of agents
HUES = [tuple(int(255 * c) for c in colorsys.hsv_to_rgb(0.5 + 0.35 * k / COUNT, 0.55, 0.85)) for k in range(COUNT)]


class Robot(Protocol):
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


def robot_frames(env: Robot, states: np.ndarray, moments: list[tuple[int, bool]]) -> Iterator[Image]:
    """Pictures of an episode, states (T+1, S), at `moments`: (step, whether it is shown as above the limit). The planar
    position is not in the state, so it is summed up from the velocity."""
    with needs("sim", "Films of robots"):
        import mujoco
    with needs("report", "Films"):
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
        # the speed in words above and as a bar below, with a stroke at its limit
        draw = ImageDraw.Draw(picture)
        scale = (WIDTH - 20) / (2 * env.limit)
        draw.rectangle((10, HEIGHT - 16, WIDTH - 10, HEIGHT - 8), fill=EMPTY)
        end = 10 + min(speed[step], 2 * env.limit) * scale
        draw.rectangle((10, HEIGHT - 16, end, HEIGHT - 8), fill=RED if over else BLUE)
        stroke = 10 + env.limit * scale
        draw.line((stroke, HEIGHT - 20, stroke, HEIGHT - 4), fill=DARK, width=2)
        text = f"{step * env.dt:4.1f} s   {speed[step]:.2f} m/s, limit {env.limit:g}" + ("   over" if over else "")
        draw.rectangle((0, 0, WIDTH, 16), fill=PAPER)
        draw.text((10, 3), text, fill=RED if over else DARK)
        yield picture


@dataclass(frozen=True)
class Scene:
    """An episode from above, and how its metres become pixels."""

    middle: np.ndarray  # (T+1, 2) m, of the picture
    reach: float  # m from its middle to its end

    @property
    def scale(self) -> float:
        """Pixels of a metre."""
        return SIZE * FINE / (2 * self.reach)

    def at(self, step: int, point: np.ndarray) -> tuple[float, float]:
        """Pixels of a place (2,) in m."""
        x, y = point - self.middle[step]
        return (x + self.reach) * self.scale, (self.reach - y) * self.scale

    def disc(self, draw: ImageDraw, step: int, point: np.ndarray, radius: float, **style: Any) -> None:
        """A filled disc of a radius in m."""
        x, y = self.at(step, point)
        r = radius * self.scale
        draw.ellipse((x - r, y - r, x + r, y + r), **style)

    def line(self, draw: ImageDraw, step: int, points: Any, fill: Any, width: int) -> None:
        """A line through places (K, 2) in m."""
        draw.line([self.at(step, point) for point in points], fill=fill, width=width)


def in_picture(reach: float) -> float:
    """m to the end of a picture in which nobody within `reach` passes beneath the words."""
    return reach / (1 - 2 * LABEL / SIZE)


def pale(hue: tuple[int, ...]) -> tuple[int, ...]:
    """A colour as tails and goals have it."""
    return tuple((c + 2 * 255) // 3 for c in hue)


class Crossed(Protocol):
    """What of Crossing its pictures need."""

    dt: ClassVar[float]  # s
    radius: ClassVar[float]  # m

    @property
    def n_agents(self) -> int: ...

    @property
    def body(self) -> str: ...

    @property
    def walls(self) -> bool: ...

    @property
    def side(self) -> float:
        """m"""
        ...

    def from_global_state(self, flat: Any) -> Any: ...

    def clearance(self, state: Any) -> Any: ...


@dataclass(frozen=True)
class _Discs(Scene):
    """An episode of Crossing."""

    place: np.ndarray  # (T+1, N, 2) m
    goal: np.ndarray  # (T+1, N, 2) m
    ahead: np.ndarray  # (T+1, N, 2) unit vectors
    touching: np.ndarray  # (T+1, N) bool
    obstacle: np.ndarray  # (T+1, M, 3) place and radius, m
    radius: float  # m, of a disc

    @classmethod
    def of(cls, env: Crossed, states: np.ndarray) -> _Discs:
        """Of states (T+1, S)."""
        import jax.numpy as jnp

        state = env.from_global_state(jnp.asarray(states))
        place = np.asarray(state.position)
        farthest = float(np.abs(place).max()) + 2 * env.radius
        return cls(
            middle=np.zeros((len(place), 2), place.dtype),
            reach=in_picture(max(env.side / 2 if env.walls else 0.0, farthest)),
            place=place,
            goal=np.asarray(state.goal),
            ahead=np.stack([np.cos(state.heading), np.sin(state.heading)], -1),
            touching=np.asarray(env.clearance(state) < 0),
            obstacle=np.asarray(state.obstacle),
            radius=env.radius,
        )

    def draw(self, draw: ImageDraw, step: int, headings: bool) -> None:
        """Everything but words."""
        place, goal = self.place[step], self.goal[step]
        for obstacle in self.obstacle[step]:
            self.disc(draw, step, obstacle[:2], obstacle[2], fill=EMPTY)
        for i in range(len(place)):
            self.line(draw, step, (place[i], goal[i]), EMPTY, FINE)
        for i in range(len(place)):
            tail = self.place[max(0, step - TAIL) : step + 1, i]
            colour = pale(HUES[i % COUNT])
            if len(tail) > 1:
                self.line(draw, step, tail, colour, max(FINE, int(0.5 * self.radius * self.scale)))
            self.disc(draw, step, goal[i], 0.3 * self.radius, fill=colour)
        for i in range(len(place)):
            colour = RED if self.touching[step, i] else HUES[i % COUNT]
            self.disc(draw, step, place[i], self.radius, fill=colour, outline=DARK)
            if headings:
                self.line(draw, step, (place[i], place[i] + self.radius * self.ahead[step, i]), DARK, 2 * FINE)


def disc_frames(env: Crossed, states: np.ndarray, moments: list[tuple[int, bool]]) -> Iterator[Image]:
    """Pictures of an episode, states (T+1, S), at `moments`: (step, whether somebody touched since the one before)."""
    scene = _Discs.of(env, states)

    def draw(paper: ImageDraw, step: int) -> None:
        scene.draw(paper, step, headings=env.body == "unicycle")

    def caption(step: int, touches: int) -> str:
        contact = f"{touches} steps of contact" if touches else "no contact"
        return f"{step * env.dt:4.1f} s    {env.n_agents} agents    {contact}"

    yield from captioned(moments, np.any(scene.touching, axis=1), draw, caption)


def captioned(
    moments: list[tuple[int, bool]],
    bad: np.ndarray,
    draw: Callable[[ImageDraw, int], None],
    caption: Callable[[int, int], str],
) -> Iterator[Image]:
    """Pictures that `draw` makes of steps, under a line that says how many of the steps (T+1,) bool were bad so far."""
    with needs("report", "Films"):
        from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(13 * FINE)
    count = 0
    before = 0
    for step, _ in moments:
        picture = Image.new("RGB", (SIZE * FINE, SIZE * FINE), PAPER)
        paper = ImageDraw.Draw(picture)
        draw(paper, step)
        count += int(bad[before + 1 : step + 1].sum())
        before = step
        paper.rectangle((0, 0, SIZE * FINE, LABEL * FINE), fill=PAPER)
        paper.text((10 * FINE, 3 * FINE), caption(step, count), fill=RED if count else BLUE, font=font)
        yield picture.resize((SIZE, SIZE), Image.Resampling.LANCZOS)
