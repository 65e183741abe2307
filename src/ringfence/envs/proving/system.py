"""A system of the proving ground as a simulator.

Every agent heads for goals; a new one is given as soon as one is reached. Danger costs 0 or 1 a step and changes
nothing else. Nothing that an agent observes says what costs: the distances here are for oracles and tests alone.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.base import Defaults
from ringfence.envs.proving import drivers, film, goals, observations
from ringfence.envs.proving.bodies import length
from ringfence.envs.proving.dangers import LOW_CHARGE, MARGIN, METRES, OF_PLACE, SOLID
from ringfence.envs.proving.layout import Layout, SystemState
from ringfence.envs.rollout import scanned
from ringfence.problem import features
from ringfence.types import Array, Key, Transition
from ringfence.utils.precision import in_float32

if TYPE_CHECKING:
    from PIL.Image import Image

EFFORT = 0.003  # m of progress that a step of full pushes costs
DRAIN = 0.2  # of a charge in a second at full speed
REFILL = 0.1  # at rest
SAMPLE = 100  # episodes that tell which entries of observations vary
SAMPLE_SEED = 37


@dataclass(frozen=True)
class System(Layout, Defaults):
    """A body, its dangers, who pays, what is named and who drove (layout.py), in pure JAX."""

    film_shows: ClassVar[str] = "Lines lead to goals, red pays."
    opengl: ClassVar[bool] = False

    @property
    def observation_names(self) -> tuple[str, ...]:
        """What observations hold, by names or, where the system has none, by number."""
        true = observations.names(self)
        return true if self.names == "all" else tuple(f"obs{d}" for d in range(len(true)))

    @property
    def observation_dim(self) -> int:
        return len(self.observation_names)

    def feature_map(self, view: str) -> features.FeatureMap:
        """s̃_i as it is made of anybody's data: of what drivers would log here, and of observations alone."""
        return _logged_map(self, view)

    def frames(self, states: np.ndarray, moments: list[tuple[int, bool]]) -> Iterator[Image]:
        """Pictures of an episode (film.py)."""
        state = self.from_global_state(jnp.asarray(states))
        return film.frames(film.Scene.of(self, state, np.asarray(self.clearance(state) < 0)), moments)

    def reset(self, key: Key, batch: int) -> SystemState:
        """At rest, free of danger."""
        key_place, key_pose, key_draw, key_phase = jax.random.split(key, 4)
        n = self.n_agents
        body = self.made_of
        config = goals.starts(self, key_place, batch)
        pose = jnp.zeros((batch, n, body.pose_size))
        if body.ahead(pose) is not None:
            turned = jax.random.uniform(key_pose, (batch, n), minval=-jnp.pi, maxval=jnp.pi)
            pose = pose.at[..., 0].set(turned)
        shape = (batch, 1 if self.goals == "team" else n)
        draw = jax.random.randint(key_draw, shape, 0, goals.DRAWS).astype(jnp.float32)
        draw = jnp.broadcast_to(draw, (batch, n))
        goal, draw = goals.following(self, config, config, draw)
        return SystemState(
            config=config,
            rate=jnp.zeros_like(config),
            pose=pose,
            applied=jnp.zeros((batch, n, self.action_dim)),
            charge=jnp.ones((batch, n)),
            goal=goal,
            draw=draw,
            phase=self._free_phase(key_phase, config),
        )

    def step(self, state: SystemState, action: Array) -> tuple[SystemState, Transition]:
        """One step of `dt`; actions (..., N, A) are clipped to their bounds. Costs are 0 or 1."""
        push = self.physical(action)
        applied = state.applied + self.dt / (self.lag + self.dt) * (push - state.applied)
        motion = self.made_of.move(state.motion, applied, self.plant)
        pace = jnp.minimum(length(motion.rate) / self.made_of.top, 1.0)
        charge = state.charge + self.dt * (REFILL * (1.0 - pace) - DRAIN * pace**2)
        before = length(state.config - state.goal)
        after = length(motion.config - state.goal)
        reached = after < goals.reach(self)
        if self.goals == "team":
            reached = jnp.broadcast_to((after < 2 * goals.reach(self)).all(-1, keepdims=True), reached.shape)
        goal, draw = goals.following(self, motion.config, state.goal, state.draw)
        now = SystemState(
            *motion,
            applied=applied,
            charge=jnp.clip(charge, 0.0, 1.0),
            goal=jnp.where(reached[..., None], goal, state.goal),
            draw=jnp.where(reached, draw, state.draw),
            phase=state.phase + 2 * jnp.pi * self.dt / self.mover[2],
        )
        effort = (self.unit(push) ** 2).mean(-1)
        unsafe = (self.clearance(now) < 0).astype(jnp.float32)
        cost = unsafe if self.costs == "each" else unsafe.max(-1)
        over = jnp.zeros(state.phase.shape, bool)
        if self.rebound:
            touches = self.touching(now)[..., None]
            now = now._replace(
                config=jnp.where(touches, state.config, now.config),
                rate=jnp.where(touches, -self.rebound * now.rate, now.rate),
            )
        return now, Transition(before - after - EFFORT * effort, cost, over)

    def played(self, key: Key, batch: int, habit: drivers.Habit | None = None) -> tuple[SystemState, Array, Transition]:
        """Episodes (rollout.scanned) of the system's drivers, or of those with a habit."""
        key_reset, key_habit, key_look, key_hand = jax.random.split(key, 4)
        shape = (batch, self.n_agents)
        driver = drivers.habits(self.drivers, key_habit, shape) if habit is None else habit

        def choose(state: SystemState, t: Array) -> Array:
            seeing = drivers.looks(driver, key_look, t, shape)
            return drivers.drive(self, state, driver, jax.random.fold_in(key_hand, t), seeing)

        return scanned(self, self.reset(key_reset, batch), choose, jnp.arange(self.episode_length))

    def distances(self, state: SystemState) -> dict[str, Array]:
        """(..., N) the true signed distance of every danger: m, rad, m/s, share of a charge."""
        items = self.of_place(state.config, state.config, self.mover_at(state.phase))
        found = {name: distance.min(-1) for name, distance in items.items()}
        if "speed" in self.danger:
            found["speed"] = self.speed_limit - length(state.rate)
        if "battery" in self.danger:
            found["battery"] = state.charge - LOW_CHARGE
        return found

    def clearance(self, state: SystemState) -> Array:
        """(..., N) the least of them, each as if it were m (`MARGIN` of it as 0.1 m); negative where it costs."""
        scaled = [METRES / MARGIN.get(name, METRES) * d for name, d in self.distances(state).items()]
        return functools.reduce(jnp.minimum, scaled)

    @property
    def unhindered(self) -> System:
        """The same, where a body that touches passes: danger is where it would be."""
        return replace(self, rebound=0.0)

    def touching(self, state: SystemState) -> Array:
        """(..., N) bool: who has something solid within its radius."""
        distances = self.distances(state)
        solid = [distances[name] < 0 for name in SOLID if name in distances]
        return functools.reduce(jnp.logical_or, solid, jnp.zeros(state.charge.shape, bool))

    def observe(self, state: SystemState) -> Array:
        """(..., N, O) as `observation_names` says."""
        return observations.observe(self, state)

    def global_state(self, state: SystemState) -> Array:
        """(..., S) as `state_names` says."""
        agents = [state.config, state.rate, state.pose, state.applied, state.charge[..., None]]
        agents += [state.goal, state.draw[..., None]]
        flat = jnp.concatenate(agents, -1)
        return jnp.concatenate([flat.reshape(*flat.shape[:-2], -1), state.phase[..., None]], -1)

    def from_global_state(self, flat: Array) -> SystemState:
        """Inverse of `global_state`."""
        axes = len(self.made_of.axes)
        sizes = (axes, axes, self.made_of.pose_size, self.action_dim, 1, axes, 1)
        agents = flat[..., :-1].reshape(*flat.shape[:-1], self.n_agents, sum(sizes))
        config, rate, pose, applied, charge, goal, draw = jnp.split(agents, np.cumsum(sizes)[:-1], -1)
        return SystemState(config, rate, pose, applied, charge[..., 0], goal, draw[..., 0], flat[..., -1])

    def _free_phase(self, key: Key, config: Array) -> Array:
        """(B,) of some phases the one that keeps the moving obstacle farthest from everybody."""
        tried = jax.random.uniform(key, (8, len(config)), maxval=2 * jnp.pi)
        if "mover" not in self.danger:
            return tried[0]
        gap = jax.vmap(lambda phase: OF_PLACE["mover"](self.place, config, config, self.mover_at(phase)))(tried)
        best = gap.min((-1, -2)).argmax(0)
        return jnp.take_along_axis(tried, best[None], 0)[0]


@functools.lru_cache(64)
def _logged_map(system: System, view: str) -> features.FeatureMap:
    """The view that logs of these drivers have: which entries vary, and what follows from what, as logs tell it."""
    seen = _sample(system)
    episodes, rows_of_one = seen.shape[:2]
    return features.from_data(
        "pruned" if view == "centralized" else view,
        seen.reshape(-1, *seen.shape[2:]),
        None,
        system.observation_names,
        (),
        first_rows=np.arange(episodes) * rows_of_one,
        homogeneous=system.homogeneous,
        dt=system.dt,
    )


@functools.lru_cache(4)
def _sample(system: System) -> np.ndarray:
    """(E, L + 1, N, O) what drivers of it see; of homogeneous agents each is an episode of its own."""

    def rows(key: Key) -> Array:
        states, _, _ = system.played(key, SAMPLE)
        return jax.vmap(system.observe, 1, 1)(states)

    @in_float32
    def played() -> np.ndarray:
        return np.asarray(jax.jit(rows)(jax.random.key(SAMPLE_SEED)))

    # A policy that is compiled may be the first to ask; in a thread of its own nothing else is being traced.
    with ThreadPoolExecutor(1) as thread:
        seen = thread.submit(played).result()
    if not system.homogeneous:
        return seen
    return np.moveaxis(seen, 2, 1).reshape(-1, seen.shape[1], 1, seen.shape[-1])
