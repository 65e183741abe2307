"""Simple Spread as each agent sees it by itself, so that one policy plays any number of them.

Simple Spread's own observations name every landmark and every other, and have another length for every number of
agents; and its room, once there are more than three, is four times as large. Here the room grows with the team, as
crowded as three agents have it, and everybody sees its velocity, the three landmarks nearest to it and the two others
who come nearest, as far as `SIGHT`. Nobody knows where in the room it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.base import Defaults
from ringfence.envs.simple_spread import DT, SimpleSpread, SpreadState, in_contact
from ringfence.errors import UserError
from ringfence.problem.features import FeatureMap, decentralized
from ringfence.problem.partners import approaches
from ringfence.types import Array, Key, Transition

SIGHT = 1.5  # m: in a room of 2 m a side, one thing in six is farther away, so what is not there is nothing new
SOON = 0.3  # s: full speed is lost in three steps
LANDMARKS, OTHERS = 3, 2  # that are seen


@dataclass(frozen=True)
class SpreadAlike(Defaults):
    """The room, in pure JAX: Simple Spread's movement and reward, seen and paid by each agent for itself."""

    n_agents: int = 3
    episode_length: int = 25

    def __post_init__(self):
        for field in ("n_agents", "episode_length"):
            if getattr(self, field) < 1:
                raise UserError(f"SpreadAlike {field}={getattr(self, field)} must be at least 1.")

    @property
    def action_dim(self) -> int:
        """A force's direction."""
        return 2

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
        return decentralized(view, self.observation_names, DT)

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
        n = self.n_agents
        landmarks = state.landmarks[..., None, :, :] - state.position[..., :, None, :]  # (B, N, N, 2)
        offset, speed, approach = approaches(state.position, state.velocity, SIGHT, SOON)
        parts = [
            state.velocity,
            _seen(landmarks, landmarks, (landmarks**2).sum(-1), LANDMARKS, n),
            _seen(offset, jnp.concatenate([offset, speed], -1), approach, OTHERS, n - 1),
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


def _seen(offset: Array, features: Array, order: Array, shown: int, things: int) -> Array:
    """(..., N, shown (F + 1)): the `features` (..., N, M, F) of the first of the things at `offset` (..., N, M, 2) by
    `order` (..., N, M), and whether they are in sight. Only `things` of the M are things."""
    unseen = jnp.zeros(features.shape[-1] + 1).at[0].set(SIGHT)
    count = min(shown, things)
    _, which = jax.lax.top_k(-order, count)
    rows = jnp.concatenate([features, jnp.ones_like(features[..., :1])], -1)
    rows = jnp.where((offset**2).sum(-1, keepdims=True) < SIGHT**2, rows, unseen)
    rows = jnp.take_along_axis(rows, which[..., None], -2)
    missing = jnp.broadcast_to(unseen, (*rows.shape[:-2], shown - count, unseen.shape[0]))
    rows = jnp.concatenate([rows, missing], -2)
    return rows.reshape(*rows.shape[:-2], -1)
