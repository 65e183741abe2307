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
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.base import Defaults
from ringfence.errors import UserError, unknown
from ringfence.problem.features import VIEWS, FeatureMap, decentralized, derived, following
from ringfence.problem.partners import approaches, others, seen_first
from ringfence.types import Array, Key, Transition

DT = 0.1  # s
DAMPING = 0.25  # share of velocity lost per step
SENSITIVITY = 5.0  # force per unit of action; the mass is 1
CONTACT_FORCE = 100.0
CONTACT_MARGIN = 1e-3
AGENT_RADIUS = 0.15
CONTACT_DISTANCE = 2 * AGENT_RADIUS
# m, of SpreadAlike: in a room of 2 m a side, one thing in six is farther away, so what is not there is nothing new
SIGHT = 1.5
SOON = 0.3  # s: full speed is lost in three steps
LANDMARKS, OTHERS = 3, 2  # that are seen

Integrator = Literal["velocity_first", "position_first"]
RewardName = Literal["omar", "pettingzoo", "coverage"]
CostName = Literal["any", "pairs", "per_agent"]


class SpreadState(NamedTuple):
    position: Array  # (B, N, 2)
    velocity: Array  # (B, N, 2)
    landmarks: Array  # (B, N, 2)


@dataclass(frozen=True)
class SimpleSpread(Defaults):
    """Simple Spread for any number of agents, in pure JAX; see the module's docstring for the integrators."""

    n_agents: int = 3
    integrator: Integrator = "velocity_first"
    reward: RewardName = "omar"  # what the public data has
    cost: CostName = "any"  # any: 1 if any pair touches; pairs: their number; per_agent: agents that touch
    episode_length: int = 25
    arena: float | None = None  # half-width of the square of resets; None: 1 up to 3 agents, 2 above (as OMAR's)
    action_dim: int = 2  # force direction, each entry in [-1, 1]

    def __post_init__(self):
        choices = (("integrator", Integrator), ("reward", RewardName), ("cost", CostName))
        for field, options in ((field, get_args(kind)) for field, kind in choices):
            if getattr(self, field) not in options:
                raise UserError(
                    f"SimpleSpread {field}='{getattr(self, field)}' does not exist; choose one of {', '.join(options)}."
                )
        if self.n_agents < 1:
            raise UserError(f"SimpleSpread needs at least one agent, got n_agents={self.n_agents}; pass 1 or more.")

    @property
    def half_width(self) -> float:
        """m, half of the arena's side."""
        if self.arena is not None:
            return self.arena
        return 1.0 if self.n_agents <= 3 else 2.0

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

    def feature_map(self, view: str) -> FeatureMap:
        """s̃_i in a view (features.py)."""
        return views(view, self.n_agents)

    def reset(self, key: Key, batch: int) -> SpreadState:
        """Positions and landmarks uniform in the arena, at rest; starts in contact are part of the task."""
        key_position, key_landmarks = jax.random.split(key)
        shape = (batch, self.n_agents, 2)
        width = self.half_width
        position = jax.random.uniform(key_position, shape, minval=-width, maxval=width)
        landmarks = jax.random.uniform(key_landmarks, shape, minval=-width, maxval=width)
        return SpreadState(position, jnp.zeros(shape), landmarks)

    def step(self, state: SpreadState, action: Array) -> tuple[SpreadState, Transition]:
        """One step of 0.1 s; `action` (B, N, 2) in [-1, 1] is clipped. Reward and cost are read after the step."""
        # Inside, x and y are separate arrays with the batch last: the compiler then vectorises over environments,
        # several times faster than over the two coordinates (measured at N=3 and N=24).
        x, y = _planes(state.position)
        vx, vy = _planes(state.velocity)
        ux, uy = _planes(jnp.clip(action, -1.0, 1.0))
        push_x, push_y = _repulsion(x, y)
        after_vx = (1.0 - DAMPING) * vx + DT * (SENSITIVITY * ux + push_x)
        after_vy = (1.0 - DAMPING) * vy + DT * (SENSITIVITY * uy + push_y)
        if self.integrator == "velocity_first":
            vx = after_vx
            vy = after_vy
        x = x + DT * vx
        y = y + DT * vy
        touching = _touching(x, y)
        after = SpreadState(_joined(x, y), _joined(after_vx, after_vy), state.landmarks)
        return after, Transition(
            reward=jnp.moveaxis(self._reward(x, y, *_planes(state.landmarks), touching), 0, -1),
            cost=self._cost(touching),
            terminated=jnp.zeros(state.position.shape[:-2], bool),
        )

    def observe(self, state: SpreadState) -> Array:
        """(B, N, 4 + 2N + 4(N-1)): own velocity, own position, landmarks and others relative to self, silence."""
        n = self.n_agents
        batch = state.position.shape[:-2]
        landmarks = state.landmarks[..., None, :, :] - state.position[..., :, None, :]
        offsets = state.position[..., None, :, :] - state.position[..., :, None, :]
        offsets = offsets[..., *np.nonzero(~np.eye(n, dtype=bool)), :]  # but those to oneself, in order
        silence = jnp.zeros((*batch, n, 2 * (n - 1)), state.position.dtype)
        return jnp.concatenate(
            [
                state.velocity,
                state.position,
                landmarks.reshape(*batch, n, 2 * n),
                offsets.reshape(*batch, n, 2 * (n - 1)),
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

    def _reward(self, x: Array, y: Array, landmark_x: Array, landmark_y: Array, touching: Array) -> Array:
        """(N, B) from coordinates (N, B) and contacts (N, N, B)."""
        dx = x[:, None] - landmark_x  # (agents, landmarks, B)
        dy = y[:, None] - landmark_y
        nearest = jnp.sqrt((dx**2 + dy**2).min(0))  # (landmarks, B)
        hits = touching.sum(0).astype(nearest.dtype)
        if self.reward == "omar":
            return jnp.minimum(1.0 / jnp.maximum(nearest, 1e-9), 10.0).sum(0) - 5.0 * hits
        if self.reward == "pettingzoo":
            return -0.5 * nearest.sum(0) - 0.5 * hits
        return jnp.broadcast_to(-nearest.mean(0), hits.shape)

    def _cost(self, touching: Array) -> Array:
        """(B,) float32 from contacts (N, N, B)."""
        if self.cost == "any":
            return touching.any((0, 1)).astype(jnp.float32)
        if self.cost == "pairs":
            return touching.sum((0, 1)).astype(jnp.float32) / 2.0
        return touching.any(0).sum(0).astype(jnp.float32)


def contact_force(position: Array) -> Array:
    """(..., N, 2) soft repulsion between overlapping agents at `position` (..., N, 2)."""
    return _joined(*_repulsion(*_planes(position)))


def in_contact(position: Array) -> Array:
    """(..., N, N) bool: centres nearer than 0.30, the diagonal excluded; `position` is (..., N, 2)."""
    return jnp.moveaxis(_touching(*_planes(position)), (0, 1), (-2, -1))


def _planes(vectors: Array) -> tuple[Array, Array]:
    """(..., N, 2) -> x and y, each (N, ...)."""
    return jnp.moveaxis(vectors[..., 0], -1, 0), jnp.moveaxis(vectors[..., 1], -1, 0)


def _joined(x: Array, y: Array) -> Array:
    """Inverse of `_planes`."""
    return jnp.stack([jnp.moveaxis(x, 0, -1), jnp.moveaxis(y, 0, -1)], axis=-1)


def _repulsion(x: Array, y: Array) -> tuple[Array, Array]:
    """Contact force on every agent, x and y, each (N, ...). All N^2 ordered pairs: half of them are redundant, but
    the whole fuses into one compact loop for any N."""
    dx = x[:, None] - x  # [i, j] points from j to i
    dy = y[:, None] - y
    squared = dx**2 + dy**2
    separate = squared > 0  # an agent and itself, or two agents at the very same point, have no direction to push in
    distance = jnp.sqrt(jnp.where(separate, squared, 1.0))
    depth = (CONTACT_DISTANCE - distance) / CONTACT_MARGIN
    # softplus in the form that cannot overflow, without the NaN handling of logaddexp
    overlap = CONTACT_MARGIN * (jnp.maximum(depth, 0.0) + jnp.log1p(jnp.exp(-jnp.abs(depth))))
    push = jnp.where(separate, CONTACT_FORCE * overlap / distance, 0.0)
    return (push * dx).sum(1), (push * dy).sum(1)


def _touching(x: Array, y: Array) -> Array:
    """(N, N, ...) bool from coordinates (N, ...)."""
    n = x.shape[0]
    distance = jnp.sqrt((x[:, None] - x) ** 2 + (y[:, None] - y) ** 2)
    itself = np.eye(n, dtype=bool).reshape(n, n, *[1] * (x.ndim - 1))
    return (distance < CONTACT_DISTANCE) & ~itself


def views(view: str, n_agents: int) -> FeatureMap:
    """The views of Simple Spread; state as in `SimpleSpread.global_state`, lengths in m, velocities in m/s."""
    if view == "centralized":
        return _centralized(n_agents)
    if view == "decentralized":
        return _decentralized(n_agents)
    if view == "pruned":
        return _pruned(n_agents)
    raise unknown("view", view, VIEWS)


def _centralized(n: int) -> FeatureMap:
    names = [f"agent{i}.{c}" for i in range(n) for c in "xy"]
    names += [f"agent{i}.v{c}" for i in range(n) for c in "xy"]
    names += [f"landmark{i}.{c}" for i in range(n) for c in "xy"]
    table = np.tile(np.arange(6 * n), (n, 1))
    weight = _critic_weight(names)
    return FeatureMap("centralized", tuple(names), "state", table, np.full_like(table, -1), critic_weight=weight)


def _decentralized(n: int) -> FeatureMap:
    names = _relative_names(n)  # the communication channel is always 0
    table = np.tile(np.arange(len(names)), (n, 1))
    weight = _critic_weight(names)
    plain = FeatureMap(
        "decentralized", tuple(names), "observations", table, np.full_like(table, -1), critic_weight=weight
    )
    return following(plain, derived(plain.names, n))


def _pruned(n: int) -> FeatureMap:
    names = _relative_names(n)
    names += [f"other{j}.dv{c}" for j in range(n - 1) for c in "xy"]  # makes the hazard's dynamics Markov
    position = np.arange(2 * n).reshape(n, 2)
    velocity = position + 2 * n
    landmark = position + 4 * n
    plus, minus = [], []
    for i, others_of in enumerate(others(n)):
        theirs = [*position[others_of].ravel(), *velocity[others_of].ravel()]
        plus.append([*velocity[i], *position[i], *landmark.ravel(), *theirs])
        minus.append([-1] * 4 + [*position[i]] * (2 * n - 1) + [*velocity[i]] * (n - 1))
    weight = _critic_weight(names)
    plain = FeatureMap("pruned", tuple(names), "state", np.array(plus), np.array(minus), critic_weight=weight)
    return following(plain, derived(plain.names, n))


def _relative_names(n: int) -> list[str]:
    """Oneself, and where landmarks and others are from there."""
    names = ["own.vx", "own.vy", "own.x", "own.y"]
    names += [f"landmark{j}.d{c}" for j in range(n) for c in "xy"]
    names += [f"other{j}.d{c}" for j in range(n - 1) for c in "xy"]
    return names


def _critic_weight(names: list[str]) -> tuple[float, ...]:
    """A quarter for velocities. The reward is about positions, but a plan's velocities vary more than its positions
    do, in deviations. A critic that weighs both the same steers plans to speeds that their positions do not follow."""
    kinds = [name.split(".")[1].lstrip("d")[0] for name in names]
    return tuple(0.25 if kind == "v" else 1.0 for kind in kinds)


@dataclass(frozen=True)
class SpreadAlike(Defaults):
    """Simple Spread as each agent sees it by itself, so that one policy plays any number of them, in pure JAX.

    Simple Spread's own observations name every landmark and every other, and have another length for every number of
    agents; and its room, once there are more than three, is four times as large. Here the room grows with the team, as
    crowded as three agents have it, and everybody sees its velocity, the three landmarks nearest to it and the two
    others who come nearest, as far as `SIGHT`, and is paid for itself. Nobody knows where in the room it is.
    """

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
            seen_first((landmarks**2).sum(-1), LANDMARKS, n, SIGHT, landmarks),
            seen_first(approach, OTHERS, n - 1, SIGHT, offset, speed),
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
