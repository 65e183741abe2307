"""Crossing: discs with momentum find their way through one another, any number of them.

A disc of radius 0.15 m is pushed by at most 1 m/s² and moves at most 1 m/s, so that full braking takes ten steps and
half a metre: whether two of them touch is decided long before they do. Contact costs, and changes nothing else: what
would follow it is no part of the task.

Every agent sees itself, its goal, and those of the others within sight who come nearest, so observations have the same
entries for any number of agents; the room grows with them, as crowded as before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs import film
from ringfence.envs.base import Defaults
from ringfence.errors import UserError
from ringfence.problem.features import FeatureMap, decentralized
from ringfence.problem.partners import approaches, seen_first
from ringfence.types import Array, Key, Transition

if TYPE_CHECKING:
    from PIL.Image import Image

DT = 0.1  # s
RADIUS = 0.15  # m
SPEED = 1.0  # m/s at most
PUSH = 1.0  # m/s² at most
TURN = 2.0  # rad/s at most, of a unicycle
SPACING = 1.5  # m: the room's side is that times √N
SIGHT = 3.0  # m; who is farther away is not seen
SOON = 1.0  # s, of full braking
REACHED = 0.2  # m from a goal: the next one is given
APART = 2.0  # m at least from one goal to the next, as far as the room allows
EFFORT = 0.01  # m of progress that a step of full push costs
OBSTACLE = (0.2, 0.5)  # m, radii of obstacles
DRAWS = 2**24  # whole numbers that a float32 tells apart

Body = Literal["disc", "unicycle"]
Goals = Literal["random", "across"]


class CrossingState(NamedTuple):
    position: Array  # (B, N, 2) m, the room's centre is 0
    velocity: Array  # (B, N, 2) m/s
    heading: Array  # (B, N) rad, of a unicycle
    goal: Array  # (B, N, 2) m
    draw: Array  # (B, N) what the next goal is drawn by: a whole number below 2^24
    obstacle: Array  # (B, M, 3) place and radius, m


@dataclass(frozen=True)
class Crossing(Defaults):
    """The room, in pure JAX; see the module's docstring.

    body: `disc` is pushed along x and y, `unicycle` along its heading, and turns. goals: `random` in the room, `across`
    on its far side, through the middle. walls: the room ends, and touching its end costs.
    """

    n_agents: int = 8
    body: Body = "disc"
    goals: Goals = "random"
    obstacles: int = 0
    walls: bool = False
    neighbours: int = 6  # that are seen
    episode_length: int = 100
    spacing: float = SPACING
    dt: ClassVar[float] = DT
    radius: ClassVar[float] = RADIUS
    film_shows: ClassVar[str] = "Lines lead to goals, red touches."
    opengl: ClassVar[bool] = False

    def __post_init__(self):
        for field, options in (("body", get_args(Body)), ("goals", get_args(Goals))):
            if getattr(self, field) not in options:
                raise UserError(
                    f"Crossing {field}='{getattr(self, field)}' does not exist; choose one of {', '.join(options)}."
                )
        for field, least in (("n_agents", 1), ("neighbours", 1), ("episode_length", 1), ("obstacles", 0)):
            if getattr(self, field) < least:
                raise UserError(f"Crossing {field}={getattr(self, field)} must be at least {least}.")
        if not self.spacing >= 4 * RADIUS:
            raise UserError(
                f"Crossing spacing={self.spacing} leaves no way between discs; give {4 * RADIUS:g} m or more."
            )

    @property
    def action_dim(self) -> int:
        """A push along x and y; of a unicycle a push along its heading, and a turn."""
        return 2

    @property
    def world(self) -> dict[str, Any]:
        """All that a push moves is one's own velocity."""
        return {"dynamics_width": 32}

    @property
    def guard(self) -> dict[str, dict[str, Any]]:
        """Danger is decided up to ten steps before contact, so what will be dangerous is asked of the last row. Who
        climbs drives as nobody in the logs does, all the more the farther, and others no longer go on as the World
        predicts."""
        shield = {"horizon": 3, "terminal_value": True}
        return {"shield": shield, "adapt": shield, "full": shield | {"trust_radius": 0.5, "margin": 1.5}}

    @property
    def side(self) -> float:
        """m"""
        return self.spacing * max(2.0, float(np.sqrt(self.n_agents + 2 * self.obstacles)))

    @property
    def observation_names(self) -> tuple[str, ...]:
        names = ["own.vx", "own.vy"]
        if self.body == "unicycle":
            names += ["own.cos", "own.sin"]
        names += ["goal.dx", "goal.dy"]
        for j in range(self.neighbours):
            names += [f"other{j}.{x}" for x in ("dx", "dy", "dvx", "dvy", "seen")]
        for j in range(min(2, self.obstacles)):
            names += [f"obstacle{j}.{x}" for x in ("dx", "dy", "radius")]
        if self.walls:
            names += [f"wall{j}.{x}" for j in range(4) for x in ("dx", "dy")]
        return tuple(names)

    @property
    def observation_dim(self) -> int:
        return len(self.observation_names)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the entries of `global_state`, in order."""
        fields = ("x", "y", "vx", "vy", "heading", "goal_x", "goal_y", "draw")
        agents = tuple(f"agent{i}.{f}" for i in range(self.n_agents) for f in fields)
        return agents + tuple(f"obstacle{j}.{f}" for j in range(self.obstacles) for f in ("x", "y", "radius"))

    def feature_map(self, view: str) -> FeatureMap:
        """s̃_i: what the agent sees. There is no other view, or work would grow with the square of the team."""
        return decentralized(view, self.observation_names, DT)

    def frames(self, states: np.ndarray, moments: list[tuple[int, bool]]) -> Iterator[Image]:
        """Pictures of an episode (film.py)."""
        return film.disc_frames(self, states, moments)

    def reset(self, key: Key, batch: int) -> CrossingState:
        """At rest, each in a cell of a grid of its own, so that nobody touches anything and everybody can stay away;
        obstacles take cells, too."""
        key_cells, key_place, key_draw, key_heading, key_radius = jax.random.split(key, 5)
        n = self.n_agents
        bodies = n + self.obstacles
        across = int(np.ceil(np.sqrt(bodies)))
        cell = self.side / across
        cells = jnp.tile(jnp.arange(across**2), (batch, 1))
        index = jax.random.permutation(key_cells, cells, axis=1, independent=True)
        corner = jnp.stack(jnp.divmod(index[:, :bodies], across), -1) * cell - self.side / 2
        smallest, largest = OBSTACLE
        drawn = jax.random.uniform(
            key_radius, (batch, self.obstacles), minval=smallest, maxval=min(largest, cell / 2 - 0.1)
        )
        radius = jnp.full((batch, bodies), RADIUS).at[:, n:].set(drawn)
        room = jnp.maximum(cell / 2 - radius - 0.05, 0.0)[..., None]
        place = corner + cell / 2 + room * jax.random.uniform(key_place, (batch, bodies, 2), minval=-1.0, maxval=1.0)
        draw = jax.random.randint(key_draw, (batch, n), 0, DRAWS).astype(jnp.float32)
        position = place[:, :n]
        obstacle = jnp.concatenate([place[:, n:], radius[:, n:, None]], -1)
        goal, draw = self._next_goal(position, draw, obstacle)
        heading = jnp.zeros((batch, n))
        if self.body == "unicycle":
            heading = jax.random.uniform(key_heading, (batch, n), minval=-jnp.pi, maxval=jnp.pi)
        return CrossingState(position, jnp.zeros_like(position), heading, goal, draw, obstacle)

    def step(self, state: CrossingState, action: Array) -> tuple[CrossingState, Transition]:
        """One step of 0.1 s; `action` (B, N, 2) in [-1, 1] is clipped, and the push of a disc to 1 in all. Costs are of
        each agent, 0 or 1: whether it touches another, an obstacle or a wall after the step."""
        action = jnp.clip(action, -1.0, 1.0)
        velocity, heading = self._moved(state, action)
        position = state.position + DT * velocity
        if self.walls:
            end = self.side / 2 - RADIUS
            velocity = jnp.where(jnp.abs(position) > end, 0.0, velocity)
            position = jnp.clip(position, -end, end)
        before = length(state.position - state.goal)
        after = length(position - state.goal)
        effort = (action**2).sum(-1) if self.body == "disc" else action[..., 0] ** 2
        there = after < REACHED
        goal, draw = self._next_goal(position, state.draw, state.obstacle)
        goal = jnp.where(there[..., None], goal, state.goal)
        draw = jnp.where(there, draw, state.draw)
        now = CrossingState(position, velocity, heading, goal, draw, state.obstacle)
        touching = self.clearance(now) < 0
        over = jnp.zeros(position.shape[:-2], bool)
        return now, Transition(before - after - EFFORT * effort, touching.astype(jnp.float32), over)

    def clearance(self, state: CrossingState) -> Array:
        """(B, N) m from an agent's rim to the nearest thing that it must not touch; negative in contact."""
        p = state.position
        least = jnp.full(p.shape[:-1], jnp.inf)
        if self.n_agents > 1:
            distance = length(p[..., None, :, :] - p[..., :, None, :]) + 1e9 * jnp.eye(self.n_agents)
            least = jnp.minimum(least, distance.min(-1) - 2 * RADIUS)
        if self.obstacles:
            centre = state.obstacle[..., None, :, :2]
            radius = state.obstacle[..., None, :, 2]
            least = jnp.minimum(least, (length(centre - p[..., :, None, :]) - radius).min(-1) - RADIUS)
        if self.walls:  # a disc at the end of its way touches
            least = jnp.minimum(least, (self.side / 2 - 1e-4 - jnp.abs(p)).min(-1) - RADIUS)
        return least

    def nearest(self, state: CrossingState) -> tuple[Array, Array]:
        """Offsets and relative velocities (B, N, k, 2) of the k = min(neighbours, N - 1) others who come nearest within
        `SOON` if everybody goes on as now, in that order; those in sight first. Who is nearest now would hide, in a
        crowd, who comes at full speed."""
        n = self.n_agents
        offset, speed, squared = approaches(state.position, state.velocity, SIGHT, SOON)
        _, who = jax.lax.top_k(-squared, min(self.neighbours, n - 1))
        return jnp.take_along_axis(offset, who[..., None], -2), jnp.take_along_axis(speed, who[..., None], -2)

    def observe(self, state: CrossingState) -> Array:
        """(B, N, O) as `observation_names` says. Others that are not seen stand at the end of sight, `seen` = 0."""
        parts = [state.velocity]
        if self.body == "unicycle":
            parts.append(_ahead(state.heading))
        parts.append(state.goal - state.position)
        offset, speed, squared = approaches(state.position, state.velocity, SIGHT, SOON)
        parts.append(seen_first(squared, self.neighbours, self.n_agents - 1, SIGHT, offset, speed))
        if self.obstacles:
            parts.append(self._obstacles_seen(state))
        if self.walls:
            parts.append(self._walls_seen(state))
        return jnp.concatenate(parts, -1)

    def _obstacles_seen(self, state: CrossingState) -> Array:
        """(B, N, 3) or (B, N, 6): of the nearest one or two."""
        offset = state.obstacle[..., None, :, :2] - state.position[..., :, None, :]
        radius = jnp.broadcast_to(state.obstacle[..., None, :, 2], offset.shape[:-1])
        _, which = jax.lax.top_k(radius - length(offset), min(2, self.obstacles))
        rows = jnp.concatenate([offset, radius[..., None]], -1)
        return jnp.take_along_axis(rows, which[..., None], -2).reshape(*state.position.shape[:-1], -1)

    def _walls_seen(self, state: CrossingState) -> Array:
        """(B, N, 8): offsets to the four walls."""
        end = self.side / 2
        x = state.position[..., 0]
        y = state.position[..., 1]
        zero = jnp.zeros_like(x)
        return jnp.stack([end - x, zero, -end - x, zero, zero, end - y, zero, -end - y], -1)

    def global_state(self, state: CrossingState) -> Array:
        """(B, 8N + 3M), as `state_names` says."""
        agents = [state.position, state.velocity, state.heading[..., None], state.goal, state.draw[..., None]]
        flat = jnp.concatenate(agents, -1)
        parts = [x.reshape(*x.shape[:-2], -1) for x in (flat, state.obstacle)]
        return jnp.concatenate(parts, -1)

    def from_global_state(self, flat: Array) -> CrossingState:
        """Inverse of `global_state`."""
        agents = flat[..., : 8 * self.n_agents].reshape(*flat.shape[:-1], self.n_agents, 8)
        obstacle = flat[..., 8 * self.n_agents :].reshape(*flat.shape[:-1], self.obstacles, 3)
        return CrossingState(
            agents[..., :2], agents[..., 2:4], agents[..., 4], agents[..., 5:7], agents[..., 7], obstacle
        )

    def _moved(self, state: CrossingState, action: Array) -> tuple[Array, Array]:
        """Velocities and headings after a step."""
        if self.body == "disc":
            push = action * PUSH / jnp.maximum(length(action), 1.0)[..., None]
            velocity = state.velocity + DT * push
            return velocity * (SPEED / jnp.maximum(length(velocity), SPEED))[..., None], state.heading
        ahead = _ahead(state.heading)
        speed = jnp.clip((state.velocity * ahead).sum(-1) + DT * PUSH * action[..., 0], 0.0, SPEED)
        heading = state.heading + DT * TURN * action[..., 1]
        heading = (heading + jnp.pi) % (2 * jnp.pi) - jnp.pi
        return speed[..., None] * _ahead(heading), heading

    def _next_goal(self, position: Array, draw: Array, obstacle: Array) -> tuple[Array, Array]:
        """(goals (B, N, 2), what the ones after are drawn by): of some that are drawn, the first that is far enough
        from here and free of obstacles, else the farthest."""
        end = self.side / 2 - 2 * RADIUS
        tries = 4
        number = draw.astype(jnp.uint32)[..., None] * jnp.uint32(2 * tries) + jnp.arange(2 * tries, dtype=jnp.uint32)
        unit = _mixed(number).astype(jnp.float32) / DRAWS  # (B, N, 2 tries)
        drawn = (2.0 * unit.reshape(*unit.shape[:-1], tries, 2) - 1.0) * end
        if self.goals == "across":
            drawn = jnp.clip(0.2 * drawn - position[..., None, :], -end, end)
        away = length(drawn - position[..., None, :])
        fine = away >= min(APART, self.side / 2)
        if self.obstacles:
            gap = length(drawn[..., None, :] - obstacle[..., None, None, :, :2]) - obstacle[..., None, None, :, 2]
            free = (gap > 3 * RADIUS).all(-1)
            fine = fine & free
            away = jnp.where(free, away, -1.0)
        which = jnp.where(fine.any(-1), fine.argmax(-1), away.argmax(-1))
        goal = jnp.take_along_axis(drawn, which[..., None, None], -2)[..., 0, :]
        return goal, _mixed(number[..., 0] + jnp.uint32(77)).astype(jnp.float32)


def length(x: Array) -> Array:
    """Euclidean, with a slope at 0."""
    return jnp.sqrt((x**2).sum(-1) + 1e-12)


def _ahead(heading: Array) -> Array:
    """(..., 2) the direction of a heading (...) in rad."""
    return jnp.stack([jnp.cos(heading), jnp.sin(heading)], -1)


def _mixed(x: Array) -> Array:
    """A hash of uint32 to 24 bits, so that a state says what comes next: `lowbias32` (C. Wellons, public domain)."""
    x = (x ^ (x >> 16)) * jnp.uint32(0x7FEB352D)
    x = (x ^ (x >> 15)) * jnp.uint32(0x846CA68B)
    return (x ^ (x >> 16)) >> 8
