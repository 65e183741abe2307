"""Systems of the proving ground as pictures: who is where, heads for what, and pays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ringfence.envs.discs import FINE, HUES, LABEL, SIZE, TAIL, captioned
from ringfence.envs.film import BLUE, DARK, EMPTY, RED
from ringfence.envs.proving.layout import Layout, SystemState

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw


@dataclass(frozen=True)
class Scene:
    """An episode's bodies, and how metres become pixels."""

    system: Layout
    joints: np.ndarray  # (T+1, N, J, 2) m
    goal: np.ndarray  # (T+1, N, 2) m
    ahead: np.ndarray | None  # (T+1, N, 2)
    unsafe: np.ndarray  # (T+1, N) bool
    mover: np.ndarray  # (T+1, 2) m
    middle: np.ndarray  # (T+1, 2) m, of the picture
    reach: float  # m from its middle to its end

    @classmethod
    def of(cls, system: Layout, state: SystemState, unsafe: np.ndarray) -> Scene:
        """Of the states of an episode, (T+1, ...), and who pays in each, (T+1, N)."""
        joints = np.asarray(system.made_of.joints(state.config))
        goal = np.asarray(system.made_of.joints(state.goal))[..., -1, :]
        ahead = system.made_of.ahead(state.pose)
        middle = np.zeros((len(unsafe), 2))
        if system.body == "platoon":
            middle[:, 0] = joints[:, :, 0, 0].mean(1)
        reach = float(np.abs(joints - middle[:, None, None]).max()) + 2 * system.radius
        if system.planar:
            reach = max(reach, system.side / 2 + system.radius)
        return cls(
            system=system,
            joints=joints,
            goal=goal,
            ahead=None if ahead is None else np.asarray(ahead),
            unsafe=unsafe,
            mover=np.asarray(system.mover_at(state.phase)),
            middle=middle,
            reach=reach / (1 - 2 * LABEL / SIZE),  # nobody passes beneath the words
        )

    def at(self, step: int, point: np.ndarray) -> tuple[float, float]:
        """Pixels of a place (2,) in m."""
        scale = SIZE * FINE / (2 * self.reach)
        x, y = point - self.middle[step]
        return (x + self.reach) * scale, (self.reach - y) * scale

    def disc(self, draw: ImageDraw, step: int, point: np.ndarray, radius: float, **style: Any) -> None:
        """A filled disc of a radius in m."""
        x, y = self.at(step, point)
        r = radius * SIZE * FINE / (2 * self.reach)
        draw.ellipse((x - r, y - r, x + r, y + r), **style)

    def line(self, draw: ImageDraw, step: int, points: np.ndarray, fill: Any, width: int) -> None:
        """A line through places (K, 2) in m."""
        draw.line([self.at(step, point) for point in points], fill=fill, width=width)

    def surroundings(self, draw: ImageDraw, step: int) -> None:
        """What stands, and what goes its own way."""
        system = self.system
        if "walls" in system.danger:
            end = system.side / 2
            room = end * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
            self.line(draw, step, room, DARK, 2 * FINE)
        if "corridor" in system.danger:
            half, swing, bend = system.corridor
            x = np.linspace(-self.reach, self.reach, 120)
            middle = np.stack([x, swing * np.sin(x / bend)], -1)
            slope = swing / bend * np.cos(x / bend)
            across = np.stack([-slope, np.ones_like(x)], -1) / np.sqrt(1 + slope**2)[:, None]
            for side in (-half, half):
                self.line(draw, step, middle + side * across, DARK, 2 * FINE)
        if "posts" in system.danger:
            for x, y, radius in system.posts:
                self.disc(draw, step, np.array([x, y]), radius, fill=EMPTY, outline=DARK)
        if "mover" in system.danger:
            self.disc(draw, step, self.mover[step], system.mover[0], fill=BLUE)

    def draw(self, draw: ImageDraw, step: int) -> None:
        """Everything but words."""
        self.surroundings(draw, step)
        system = self.system
        joints = self.joints[step]
        for i in range(system.n_agents):
            hand = joints[i, -1]
            hue = HUES[i % len(HUES)]
            pale = tuple((c + 2 * 255) // 3 for c in hue)
            self.line(draw, step, np.stack([hand, self.goal[step, i]]), EMPTY, FINE)
            tail = self.joints[max(0, step - TAIL) : step + 1, i, -1]
            if len(tail) > 1 and system.body != "motor":
                self.line(draw, step, tail, pale, 3 * FINE)
            self.disc(draw, step, self.goal[step, i], 0.4 * system.radius, fill=pale)
        for i in range(system.n_agents):
            colour = RED if self.unsafe[step, i] else HUES[i % len(HUES)]
            if len(joints[i]) > 1:
                self.line(draw, step, joints[i], DARK, 3 * FINE)
            for point in joints[i][1:] if len(joints[i]) > 1 else joints[i]:
                self.disc(draw, step, point, system.radius, fill=colour, outline=DARK)
            if self.ahead is not None:
                front = joints[i, 0] + system.radius * self.ahead[step, i]
                self.line(draw, step, np.stack([joints[i, 0], front]), DARK, 2 * FINE)


def frames(scene: Scene, moments: list[tuple[int, bool]]) -> Iterator[Image]:
    """Pictures of an episode at `moments`: (step, whether there was a cost since the last)."""
    system = scene.system

    def caption(step: int, unsafe: int) -> str:
        costs = f"{unsafe} unsafe steps" if unsafe else "safe"
        return f"{step * system.dt:4.1f} s    {system.n_agents} x {system.body}, {', '.join(system.danger)}    {costs}"

    yield from captioned(moments, np.any(scene.unsafe, axis=1), scene.draw, caption)
