"""Simple Spread: N agents cover N landmarks without touching one another (multi-agent particle environment).

Two integrators exist in the world and differ in substance:

* `velocity_first`: the original environment (Lowe et al. 2017; OMAR's data, Pan et al. 2022): v <- 0.75 v + 0.1 F,
  then p <- p + 0.1 v. The first action acts on the first position.
* `position_first`: today's PettingZoo / MPE2 `simple_spread_v3`: p moves with the *old* velocity. The first action
  cannot move anything before the first cost is read, so the 17.6 % of resets with agents in contact cost one step
  under every policy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError
from ringfence.types import Array, Key, Transition

DT = 0.1  # s
DAMPING = 0.25  # share of velocity lost per step
SENSITIVITY = 5.0  # force per unit of action; the mass is 1
CONTACT_FORCE = 100.0
CONTACT_MARGIN = 1e-3
AGENT_RADIUS = 0.15
CONTACT_DISTANCE = 2 * AGENT_RADIUS

Integrator = Literal["velocity_first", "position_first"]
RewardName = Literal["omar", "pettingzoo", "coverage"]
CostName = Literal["any", "pairs", "per_agent"]


class SpreadState(NamedTuple):
    position: Array  # (B, N, 2)
    velocity: Array  # (B, N, 2)
    landmarks: Array  # (B, N, 2)


@dataclass(frozen=True)
class SimpleSpread:
    """Simple Spread for any number of agents, in pure JAX; see the module's docstring for the integrators."""

    n_agents: int = 3
    integrator: Integrator = "velocity_first"
    reward: RewardName = "omar"  # what the public data has
    cost: CostName = "any"  # any: 1 if any pair touches; pairs: their number; per_agent: agents that touch
    episode_length: int = 25
    arena: float | None = None  # half-width of the square of resets; None: 1 up to 3 agents, 2 above (as OMAR's)
    action_dim: int = 2  # force direction, each entry in [-1, 1]

    def __post_init__(self):
        for field, options in (
            ("integrator", ("velocity_first", "position_first")),
            ("reward", ("omar", "pettingzoo", "coverage")),
            ("cost", ("any", "pairs", "per_agent")),
        ):
            if getattr(self, field) not in options:
                raise UserError(
                    f"SimpleSpread {field}='{getattr(self, field)}' does not exist; choose one of {', '.join(options)}."
                )
        if self.n_agents < 1:
            raise UserError(f"SimpleSpread needs at least one agent, got n_agents={self.n_agents}; pass 1 or more.")

    @property
    def half_width(self) -> float:
        return self.arena if self.arena is not None else (1.0 if self.n_agents <= 3 else 2.0)

    @property
    def observation_dim(self) -> int:
        return 4 + 2 * self.n_agents + 4 * (self.n_agents - 1)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the entries of `global_state`, in order."""
        rows = range(self.n_agents)
        return (
            tuple(f"agent{i}.{c}" for i in rows for c in "xy")
            + tuple(f"agent{i}.v{c}" for i in rows for c in "xy")
            + tuple(f"landmark{i}.{c}" for i in rows for c in "xy")
        )

    def reset(self, key: Key, batch: int) -> SpreadState:
        """Positions and landmarks uniform in the arena, at rest; starts in contact are part of the task."""
        kp, kl = jax.random.split(key)
        shape, w = (batch, self.n_agents, 2), self.half_width
        position = jax.random.uniform(kp, shape, minval=-w, maxval=w)
        landmarks = jax.random.uniform(kl, shape, minval=-w, maxval=w)
        return SpreadState(position, jnp.zeros(shape), landmarks)

    def step(self, state: SpreadState, action: Array) -> tuple[SpreadState, Transition]:
        """One step of 0.1 s; `action` (B, N, 2) in [-1, 1] is clipped. Reward and cost are read after the step."""
        force = SENSITIVITY * jnp.clip(action, -1.0, 1.0) + contact_force(state.position)
        velocity = (1.0 - DAMPING) * state.velocity + DT * force
        moving = velocity if self.integrator == "velocity_first" else state.velocity
        after = SpreadState(state.position + DT * moving, velocity, state.landmarks)
        touching = in_contact(after.position)
        never = jnp.zeros(after.position.shape[0], bool)
        return after, Transition(self._reward(after, touching), self._cost(touching), never)

    def observe(self, state: SpreadState) -> Array:
        """(B, N, 4 + 2N + 4(N-1)): own velocity, own position, landmarks and others relative to self, silence."""
        n = self.n_agents
        batch = state.position.shape[:-2]
        landmarks = state.landmarks[..., None, :, :] - state.position[..., :, None, :]
        others = _others(state.position[..., None, :, :] - state.position[..., :, None, :])
        silence = jnp.zeros((*batch, n, 2 * (n - 1)), state.position.dtype)
        return jnp.concatenate(
            [
                state.velocity,
                state.position,
                landmarks.reshape(*batch, n, 2 * n),
                others.reshape(*batch, n, 2 * (n - 1)),
                silence,
            ],
            axis=-1,
        )

    def global_state(self, state: SpreadState) -> Array:
        """(B, 6N): positions, velocities, landmarks, each flattened agent by agent."""
        batch = state.position.shape[:-2]
        return jnp.concatenate([x.reshape(*batch, -1) for x in state], axis=-1)

    def from_global_state(self, flat: Array) -> SpreadState:
        """Inverse of `global_state`."""
        parts = jnp.split(flat, 3, axis=-1)
        return SpreadState(*(p.reshape(*flat.shape[:-1], self.n_agents, 2) for p in parts))

    def from_observations(self, observations: Array) -> SpreadState:
        """The state behind the joint observation (B, N, O); exact, since observations determine it."""
        n = self.n_agents
        position = observations[..., 2:4]
        relative = observations[..., 0, 4 : 4 + 2 * n]
        landmarks = relative.reshape(*relative.shape[:-1], n, 2) + position[..., 0:1, :]
        return SpreadState(position, observations[..., 0:2], landmarks)

    def _reward(self, state: SpreadState, touching: Array) -> Array:
        gaps = jnp.linalg.norm(state.position[..., :, None, :] - state.landmarks[..., None, :, :], axis=-1)
        nearest = gaps.min(axis=-2)  # (B, landmarks)
        hits = touching.sum(-1)  # (B, N)
        if self.reward == "omar":
            return jnp.minimum(1.0 / jnp.maximum(nearest, 1e-9), 10.0).sum(-1, keepdims=True) - 5.0 * hits
        if self.reward == "pettingzoo":
            return -0.5 * nearest.sum(-1, keepdims=True) - 0.5 * hits
        return jnp.broadcast_to(-nearest.mean(-1, keepdims=True), hits.shape)

    def _cost(self, touching: Array) -> Array:
        if self.cost == "any":
            return touching.any((-1, -2)).astype(jnp.float32)
        if self.cost == "pairs":
            return touching.sum((-1, -2)) / 2.0
        return touching.any(-1).sum(-1).astype(jnp.float32)


def contact_force(position: Array) -> Array:
    """(B, N, 2) soft repulsion between overlapping agents."""
    offset = position[..., :, None, :] - position[..., None, :, :]  # from j to i
    squared = (offset**2).sum(-1)
    apart = squared > 0
    distance = jnp.sqrt(jnp.where(apart, squared, 1.0))
    overlap = jnp.logaddexp(0.0, -(distance - CONTACT_DISTANCE) / CONTACT_MARGIN) * CONTACT_MARGIN
    push = jnp.where(apart, CONTACT_FORCE * overlap / distance, 0.0)
    return (push[..., None] * offset).sum(-2)


def in_contact(position: Array) -> Array:
    """(B, N, N) bool: centres nearer than 0.30, the diagonal excluded."""
    offset = position[..., :, None, :] - position[..., None, :, :]
    near = jnp.linalg.norm(offset, axis=-1) < CONTACT_DISTANCE
    return near & ~jnp.eye(position.shape[-2], dtype=bool)


def _others(pairs: Array) -> Array:
    """(..., N, N, F) -> (..., N, N-1, F): drop the diagonal, keeping the order of the others."""
    n = pairs.shape[-2]
    rows, columns = np.nonzero(~np.eye(n, dtype=bool))
    return pairs[..., rows, columns, :].reshape(*pairs.shape[:-2], n - 1, pairs.shape[-1])
