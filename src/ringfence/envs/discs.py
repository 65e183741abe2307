"""Crossing as pictures: discs with their tails, what each of them heads for, and who touches."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from ringfence.envs.film import BLUE, DARK, EMPTY, PAPER, RED

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

SIZE = 480  # pixels of a side
FINE = 2  # drawn so many times larger
LABEL = 20  # pixels of the words' height
TAIL = 12  # steps
COUNT = 8  # colours of agents
HUES = [tuple(int(255 * c) for c in colorsys.hsv_to_rgb(0.5 + 0.35 * k / COUNT, 0.55, 0.85)) for k in range(COUNT)]


class Filmed(Protocol):
    """What of the simulator its pictures need."""

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
class Scene:
    """An episode's bodies, and how metres become pixels."""

    place: np.ndarray  # (T+1, N, 2) m
    goal: np.ndarray  # (T+1, N, 2) m
    ahead: np.ndarray  # (T+1, N, 2) unit vectors
    touching: np.ndarray  # (T+1, N) bool
    obstacle: np.ndarray  # (T+1, M, 3) place and radius, m
    radius: float  # m, of a disc
    reach: float  # m from the middle to the picture's end

    @classmethod
    def of(cls, env: Filmed, states: np.ndarray) -> Scene:
        """Of states (T+1, S)."""
        import jax.numpy as jnp

        state = env.from_global_state(jnp.asarray(states))
        place = np.asarray(state.position)
        farthest = float(np.abs(place).max()) + 2 * env.radius
        reach = max(env.side / 2 if env.walls else 0.0, farthest)
        return cls(
            place=place,
            goal=np.asarray(state.goal),
            ahead=np.stack([np.cos(state.heading), np.sin(state.heading)], -1),
            touching=np.asarray(env.clearance(state) < 0),
            obstacle=np.asarray(state.obstacle),
            radius=env.radius,
            reach=reach / (1 - 2 * LABEL / SIZE),  # nobody passes beneath the words
        )

    @property
    def scale(self) -> float:
        """Pixels of a metre."""
        return SIZE * FINE / (2 * self.reach)

    def at(self, point: np.ndarray) -> tuple[float, float]:
        """Pixels of a place (2,) in m."""
        return (point[0] + self.reach) * self.scale, (self.reach - point[1]) * self.scale

    def disc(self, draw: ImageDraw, point: np.ndarray, radius: float, **style: Any) -> None:
        """A filled disc of a radius in m."""
        x, y = self.at(point)
        r = radius * self.scale
        draw.ellipse((x - r, y - r, x + r, y + r), **style)

    def draw(self, draw: ImageDraw, step: int, headings: bool) -> None:
        """Everything but words."""
        place = self.place[step]
        goal = self.goal[step]
        agents = range(len(place))
        for obstacle in self.obstacle[step]:
            self.disc(draw, obstacle[:2], obstacle[2], fill=EMPTY)
        for i in agents:
            draw.line([self.at(place[i]), self.at(goal[i])], fill=EMPTY, width=FINE)
        for i in agents:
            hue = HUES[i % len(HUES)]
            pale = tuple((c + 2 * 255) // 3 for c in hue)
            tail = [self.at(p) for p in self.place[max(0, step - TAIL) : step + 1, i]]
            if len(tail) > 1:
                draw.line(tail, fill=pale, width=max(FINE, int(0.5 * self.radius * self.scale)))
            self.disc(draw, goal[i], 0.3 * self.radius, fill=pale)
        for i in agents:
            colour = RED if self.touching[step, i] else HUES[i % len(HUES)]
            self.disc(draw, place[i], self.radius, fill=colour, outline=DARK)
            if headings:
                front = place[i] + self.radius * self.ahead[step, i]
                draw.line([self.at(place[i]), self.at(front)], fill=DARK, width=2 * FINE)


def frames(env: Filmed, states: np.ndarray, moments: list[tuple[int, bool]]) -> Iterator[Image]:
    """Pictures of an episode, states (T+1, S), at `moments`: (step, whether somebody touched since the one before)."""
    scene = Scene.of(env, states)

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
