"""Crossing as pictures: discs with their tails, what each of them heads for, and who touches."""

from __future__ import annotations

import colorsys
from typing import Any, Protocol

import numpy as np

from ringfence.envs.film import BLUE, DARK, EMPTY, PAPER, RED

SIZE, FINE = 480, 2  # pixels of a side, drawn so many times larger
LABEL = 20  # pixels of the words' height
TAIL = 12  # steps
HUES = 8


class Filmed(Protocol):
    """What of the simulator its pictures need."""

    n_agents: int
    body: str
    side: float  # m
    walls: bool
    dt: float  # s
    radius: float  # m

    def from_global_state(self, state: Any) -> Any: ...

    def clearance(self, state: Any) -> Any: ...


def frames(env: Filmed, states: np.ndarray, moments: list[tuple[int, bool]]):
    """Pictures of an episode, states (T+1, S), at `moments`: (step, whether somebody touched since the one before)."""
    import jax.numpy as jnp
    from PIL import Image, ImageDraw, ImageFont

    told = env.from_global_state(jnp.asarray(states))
    place, goal, touching = (np.asarray(x) for x in (told.position, told.goal, env.clearance(told) < 0))
    ahead = np.stack([np.cos(told.heading), np.sin(told.heading)], -1)
    reach = max(env.side / 2 if env.walls else 0.0, float(np.abs(place).max()) + 2 * env.radius)
    reach /= 1 - 2 * LABEL / SIZE  # nobody passes beneath the words
    scale = SIZE * FINE / (2 * reach)
    hues = [tuple(int(255 * c) for c in colorsys.hsv_to_rgb(0.5 + 0.35 * k / HUES, 0.55, 0.85)) for k in range(HUES)]

    def at(p: np.ndarray) -> tuple[float, float]:
        return (p[0] + reach) * scale, (reach - p[1]) * scale

    def disc(draw, p: np.ndarray, radius: float, **how) -> None:
        (x, y), r = at(p), radius * scale
        draw.ellipse((x - r, y - r, x + r, y + r), **how)

    font = ImageFont.load_default(13 * FINE)
    touches, before = 0, 0
    for t, _ in moments:
        picture = Image.new("RGB", (SIZE * FINE, SIZE * FINE), PAPER)
        draw = ImageDraw.Draw(picture)
        for obstacle in np.asarray(told.obstacle[t]):
            disc(draw, obstacle[:2], obstacle[2], fill=EMPTY)
        for i in range(env.n_agents):
            draw.line([at(place[t, i]), at(goal[t, i])], fill=EMPTY, width=FINE)
        for i in range(env.n_agents):
            pale = tuple((c + 2 * 255) // 3 for c in hues[i % HUES])
            tail = [at(p) for p in place[max(0, t - TAIL) : t + 1, i]]
            if len(tail) > 1:
                draw.line(tail, fill=pale, width=max(FINE, int(0.5 * env.radius * scale)))
            disc(draw, goal[t, i], 0.3 * env.radius, fill=pale)
        for i in range(env.n_agents):
            disc(draw, place[t, i], env.radius, fill=RED if touching[t, i] else hues[i % HUES], outline=DARK)
            if env.body == "unicycle":
                draw.line([at(place[t, i]), at(place[t, i] + env.radius * ahead[t, i])], fill=DARK, width=2 * FINE)
        touches += int(touching[before + 1 : t + 1].any(1).sum())
        before = t
        draw.rectangle((0, 0, SIZE * FINE, LABEL * FINE), fill=PAPER)
        told_of = f"{touches} steps of contact" if touches else "no contact"
        text = f"{t * env.dt:4.1f} s    {env.n_agents} agents    {told_of}"
        draw.text((10 * FINE, 3 * FINE), text, fill=RED if touches else BLUE, font=font)
        yield picture.resize((SIZE, SIZE), Image.Resampling.LANCZOS)
