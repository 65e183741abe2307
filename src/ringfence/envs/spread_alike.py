"""Simple Spread as each agent sees it by itself, so that one policy plays any number of them.

Simple Spread's own observations name every landmark and every other, and have another length for every number of
agents; and its room, once there are more than three, is four times as large. Here the room grows with the team, as
crowded as three agents have it, and everybody sees its velocity, the three landmarks nearest to it and the two others
who come nearest, as far as `SIGHT`. Nobody knows where in the room it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.simple_spread import DT, SimpleSpread, SpreadState, in_contact
from ringfence.errors import UserError
from ringfence.problem.features import FeatureMap, solitary
from ringfence.types import Array, Key, Transition

SIGHT = 1.5  # m: in a room of 2 m a side, one thing in six is farther away, so what is not there is nothing new
SOON = 0.3  # s: full speed is lost in three steps
LANDMARKS, OTHERS = 3, 2  # that are seen


@dataclass(frozen=True)
class SpreadAlike:
    """The room, in pure JAX: Simple Spread's movement and reward, seen and paid by each agent for itself."""

    n_agents: int = 3
    episode_length: int = 25
    action_dim: ClassVar[int] = 2
    terminates: ClassVar[bool] = False

    def __post_init__(self):
        for field in ("n_agents", "episode_length"):
            if getattr(self, field) < 1:
                raise UserError(f"SpreadAlike {field}={getattr(self, field)} must be at least 1.")

    @property
    def whole(self) -> SimpleSpread:
        """The simulator, in a room as crowded as three agents have it."""
        return SimpleSpread(self.n_agents, episode_length=self.episode_length, arena=self.half_width)

    @property
    def half_width(self) -> float:
        """m, half of the room's side."""
        return float(np.sqrt(self.n_agents / 3))

    @property
    def observation_names(self) -> tuple[str, ...]:
        names = ["own.vx", "own.vy"]
        names += [f"landmark{j}.{x}" for j in range(LANDMARKS) for x in ("dx", "dy", "seen")]
        return tuple(names + [f"other{j}.{x}" for j in range(OTHERS) for x in ("dx", "dy", "dvx", "dvy", "seen")])

    @property
    def observation_dim(self) -> int:
        return len(self.observation_names)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the entries of `global_state`, in order."""
        return self.whole.state_names

    def feature_map(self, view: str) -> FeatureMap:
        """s̃_i: what the agent sees. There is no other view."""
        return solitary(view, self.observation_names, DT)

    def reset(self, key: Key, batch: int) -> SpreadState:
        """As Simple Spread's: starts in contact are part of the task."""
        return self.whole.reset(key, batch)

    def step(self, state: SpreadState, action: Array) -> tuple[SpreadState, Transition]:
        """One step of 0.1 s; `action` (B, N, 2) in [-1, 1] is clipped. Costs are of each agent, 0 or 1: whether it
        touches another after the step."""
        after, transition = self.whole.step(state, action)
        return after, transition._replace(cost=touching(after))

    def observe(self, state: SpreadState) -> Array:
        """(B, N, O) as `observation_names` says. What is not seen stands at the end of sight, `seen` = 0."""
        p, v, n = state.position, state.velocity, self.n_agents
        landmarks = state.landmarks[..., None, :, :] - p[..., :, None, :]  # (B, N, N, 2)
        offset = p[..., None, :, :] - p[..., :, None, :]
        speed = v[..., None, :, :] - v[..., :, None, :]
        when = jnp.clip(-(offset * speed).sum(-1) / ((speed**2).sum(-1) + 1e-9), 0.0, SOON)
        nearest = ((offset + when[..., None] * speed) ** 2).sum(-1)
        nearest = jnp.where((offset**2).sum(-1) < SIGHT**2, nearest, 1e6) + 1e9 * jnp.eye(n)
        parts = [
            v,
            _seen(landmarks, landmarks, (landmarks**2).sum(-1), LANDMARKS, n),
            _seen(offset, jnp.concatenate([offset, speed], -1), nearest, OTHERS, n - 1),
        ]
        return jnp.concatenate(parts, -1)

    def global_state(self, state: SpreadState) -> Array:
        """(B, 6N) as Simple Spread's."""
        return self.whole.global_state(state)

    def from_global_state(self, flat: Array) -> SpreadState:
        """Inverse of `global_state`."""
        return self.whole.from_global_state(flat)


def touching(state: SpreadState) -> Array:
    """(..., N) 1 for who touches another, else 0."""
    return in_contact(state.position).any(-1).astype(jnp.float32)


def _seen(offset: Array, told: Array, order: Array, many: int, there: int) -> Array:
    """(..., N, many (F + 1)) of the things at `offset` (..., N, M, 2) what is `told` (..., N, M, F) of the first ones
    by `order` (..., N, M), `there` of which are things, and whether they are in sight."""
    unseen = jnp.zeros(told.shape[-1] + 1).at[0].set(SIGHT)
    took = min(many, there)
    _, which = jax.lax.top_k(-order, took)
    told = jnp.concatenate([told, jnp.ones_like(told[..., :1])], -1)
    told = jnp.where((offset**2).sum(-1, keepdims=True) < SIGHT**2, told, unseen)
    told = jnp.take_along_axis(told, which[..., None], -2)
    rest = jnp.broadcast_to(unseen, (*told.shape[:-2], many - took, unseen.shape[0]))
    told = jnp.concatenate([told, rest], -2)
    return told.reshape(*told.shape[:-2], -1)
