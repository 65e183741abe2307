"""Windows are played: one agent is driven, the others move as logged."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError
from ringfence.evaluation.replay.drivers import DRIVERS, Now, braked
from ringfence.evaluation.replay.motion import Kinematics, foreseen_velocity, in_unit
from ringfence.evaluation.replay.scene import Windows
from ringfence.guards.policy import Guarded
from ringfence.proposals.base import act_with, held, with_cost
from ringfence.types import Array, Policy
from ringfence.world import World

Seen = tuple[np.ndarray, np.ndarray | None]  # observations (W, N, O) and state (W, S)
TOLD = ("infeasible", "ood", "clearance")  # of a guard's info
_act = jax.jit(act_with)


@jax.jit
def _decided(guarded: Guarded, memory: Any, present: Array, actions: Array, key: Array) -> Any:
    return guarded.decided(memory, present, actions, key)


@dataclass(frozen=True, eq=False)
class Driven:
    """What came of W windows."""

    place: np.ndarray  # (W, L+1, 2)
    contact: np.ndarray  # (W,) bool
    info: dict[str, np.ndarray] = field(default_factory=dict)  # (W, L)


@dataclass(frozen=True, eq=False)
class Stage:
    """Windows, how the driven agent moves in them, and when it touches."""

    windows: Windows
    kinematics: Kinematics
    radius: float
    seed: int

    def play(self, driver: str | Policy, guard: Guarded | None = None, brake: bool = False) -> Driven:
        """`driver`: a name of DRIVERS, or a policy; `guard` filters what it does, and so does the `brake`."""
        w = self.windows
        place = w.place[:, 0].copy()
        velocity = w.velocity[:, 0].copy()
        heading = np.arctan2(velocity[:, 1], velocity[:, 0])
        if {"own.cos", "own.sin"} <= set(w.names.observation):
            first = w.observations[np.arange(w.count), 0, w.driven]
            heading = np.arctan2(first[:, w.names.observation["own.sin"]], first[:, w.names.observation["own.cos"]])
        if guard is not None and not isinstance(driver, str):
            driver = Guarded(driver, guard.guard)
        actor = guard if isinstance(driver, str) else driver
        memory = None if actor is None else actor.initial_state(w.count)
        world = self.kinematics.world if self.kinematics.name == "world" else None
        foresee = None if world is None else foreseen_velocity(world)
        key = jax.random.key(self.seed)
        places = [place]
        contact = np.zeros(w.count, bool)
        info: dict[str, list[np.ndarray]] = {}
        for t in range(w.steps):
            seen = w.observed(t, place, velocity, heading)
            now = self._now(t, place, velocity, heading)
            key, step_key = jax.random.split(key)
            memory, action, step_info = self._action(driver, guard, memory, t, seen, now, step_key)
            if brake:
                action, step_info["braked"] = braked(now, action, self.kinematics, self.radius)
            for name, value in step_info.items():
                info.setdefault(name, []).append(np.asarray(value))
            after = None
            if world is not None and foresee is not None:
                after = velocity + foresee(*self._in_world(world, t, seen, action))[np.arange(w.count), w.driven]
            place, velocity, heading = self.kinematics.moved(place, velocity, heading, action, after)
            touches = w.distances(t + 1, place).min(-1) < self.radius
            contact |= touches
            places.append(place)
            if actor is not None:
                memory = with_cost(actor, memory, jnp.asarray(touches, jnp.float32))
        return Driven(np.stack(places, 1), contact, {k: np.stack(v, 1) for k, v in info.items()})

    def _now(self, t: int, place: np.ndarray, velocity: np.ndarray, heading: np.ndarray) -> Now:
        w = self.windows
        away = w.others_at[:, t] - place[:, None]
        return Now(
            velocity, heading, w.velocity[:, 0], w.goal - place, away, w.others_move[:, t], self.kinematics.max_speed
        )

    def _action(
        self, driver: str | Policy, guard: Guarded | None, memory: Any, t: int, seen: Seen, now: Now, key: Any
    ) -> tuple[Any, np.ndarray, dict[str, Any]]:
        """(memory, actions (W, A) of the driven agents, what the guard says)."""
        w = self.windows
        rows = np.arange(w.count)
        if isinstance(driver, str):
            action = self.kinematics.toward(DRIVERS[driver](now), now.velocity, now.heading)
            if guard is None:
                return memory, action, {}
            present, team = self._in_world(guard.guard.world, t, seen, action)
            plan = held(team, guard.guard.options.horizon)
            memory, step = _decided(guard, memory, present, plan, key)
        else:
            memory, step = _act(driver, memory, *seen, key)
        acted = np.asarray(step.action, np.float64)[rows, w.driven]
        if not np.isfinite(acted).all():
            raise UserError("The policy gave actions that are not finite; it has diverged: train or fit it again.")
        names = [n for n in TOLD if n in step.info]
        return memory, acted, {n: np.asarray(step.info[n]) for n in names}

    def _in_world(self, world: World, t: int, seen: Seen, action: np.ndarray) -> tuple[Array, Array]:
        """What a World sees (W, N, D), and everybody's actions (W, N, A) in its units: others do as they did."""
        w = self.windows
        team = w.actions[:, t].copy()
        team[np.arange(w.count), w.driven] = action
        observations, state = seen
        present = world.map(jnp.asarray(observations), None if state is None else jnp.asarray(state))
        return present, in_unit(team, world)
