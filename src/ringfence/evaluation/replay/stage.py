"""Windows are played: one agent is driven, the others move as logged."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError
from ringfence.evaluation.replay.drivers import DRIVERS, Now, braked
from ringfence.evaluation.replay.motion import Kinematics, foreseen_velocity, in_unit
from ringfence.evaluation.replay.scene import Windows
from ringfence.evaluation.rollout import FORESEEN
from ringfence.faults import Faults
from ringfence.faults.policy import Faulty, behind
from ringfence.guards import Guard
from ringfence.guards.policy import Guarded
from ringfence.proposals.base import act_with, held, with_cost
from ringfence.types import Array, Policy, PolicyStep, PyTree
from ringfence.utils.device import on_device
from ringfence.utils.progress import Progress
from ringfence.world import World

Seen = tuple[np.ndarray, np.ndarray | None]  # observations (W, N, O) and state (W, S)
TOLD = ("infeasible", "ood", "clearance", FORESEEN)  # of a guard's info
NO_FAULTS = Faults()
_act = jax.jit(act_with)


@jax.jit
def _decided(guarded: Guarded, memory: Any, present: Array, actions: Array, key: Array) -> Any:
    return guarded.decided(memory, present, actions, key)


@jax.jit
def _scored(guard: Guard, before: Array, after: Array) -> Array:
    return guard.barrier.now(before, after).min(-1)


def _present(world: World, observations: Any, state: Any) -> Array:
    """(W, N, D) what a World sees."""
    observations, state = (None if x is None else np.asarray(x, np.float32) for x in (observations, state))
    return on_device(world.map(observations, state))


class _Bad:
    """A bad driver as a policy, under guard or not: what it and the others do is set before every step."""

    def __init__(self, guard: Guarded | None):
        self.guard = guard
        self.team = np.zeros(0)  # (W, N, A)

    def initial_state(self, batch: int) -> PyTree:
        return {} if self.guard is None else self.guard.initial_state(batch)

    def observe_cost(self, carry: PyTree, cost: Any) -> PyTree:
        return carry if self.guard is None else self.guard.observe_cost(carry, cost)

    def observe_age(self, carry: PyTree, age: Array) -> PyTree:
        return carry if self.guard is None else self.guard.observe_age(carry, age)

    def observe_sent(self, carry: PyTree, action: Array) -> PyTree:
        return carry if self.guard is None else self.guard.observe_sent(carry, action)

    def act(self, carry: PyTree, observations: Any, state: Any, key: Array) -> tuple[PyTree, PolicyStep]:
        team: Any = self.team
        if self.guard is None:
            return carry, PolicyStep(team, {})
        world = self.guard.guard.world
        present = _present(world, observations, state)
        return _decided(self.guard, carry, present, held(in_unit(team, world), self.guard.guard.options.horizon), key)


@dataclass(frozen=True, eq=False)
class Driven:
    """What came of W windows."""

    place: np.ndarray  # (W, L+1, X) along X axes
    velocity: np.ndarray  # (W, L+1, X)
    heading: np.ndarray  # (W, L+1)
    contact: np.ndarray  # (W,) bool
    info: dict[str, np.ndarray] = field(default_factory=dict)  # (W, L)


@dataclass(frozen=True, eq=False)
class Stage:
    """Windows, how the driven agent moves in them, and when it touches."""

    windows: Windows
    kinematics: Kinematics
    radius: float
    seed: int
    faults: Faults = NO_FAULTS

    def play(
        self, driver: str | Policy, guard: Guarded | None = None, brake: bool = False, bar: Progress | None = None
    ) -> Driven:
        """`driver`: a name of DRIVERS, or a policy; `guard` filters what it does, and so does the `brake`. The `bar`
        counts steps."""
        w = self.windows
        place = w.place[:, 0].copy()
        velocity = w.velocity[:, 0].copy()
        heading = np.arctan2(velocity[:, 1], velocity[:, 0])
        if looks := w.names.entries.direction:
            first = w.observations[np.arange(w.count), 0, w.driven][:, looks]
            heading = first[:, 0] if len(looks) == 1 else np.arctan2(first[:, 1], first[:, 0])
        if guard is not None:
            guard = self._of_one(guard)
        if guard is not None and not isinstance(driver, str):
            driver = replace(guard, proposal=driver)
        bad = _Bad(guard) if isinstance(driver, str) else None
        actor: Any = self._behind(bad or driver)
        memory = actor.initial_state(w.count)
        world = self.kinematics.world if self.kinematics.name == "world" else None
        foresee = None if world is None else foreseen_velocity(world)
        key = jax.random.key(self.seed)
        rows = [(place, velocity, heading)]
        contact = np.zeros(w.count, bool)
        info: dict[str, list[np.ndarray]] = {}
        for t in range(w.steps):
            seen = w.observed(t, place, velocity, heading)
            now = self._now(t, place, velocity, heading)
            key, step_key = jax.random.split(key)
            if bad is not None:
                wanted = DRIVERS[str(driver)](now)
                bad.team = self._team(t, self.kinematics.toward(wanted, velocity, heading))
            memory, action, step_info = self._action(actor, memory, seen, step_key)
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
            rows.append((place, velocity, heading))
            memory = with_cost(actor, memory, jnp.asarray(touches, jnp.float32))
            if bar is not None:
                bar.advance(1)
        place, velocity, heading = (np.stack(each, 1) for each in zip(*rows))
        return Driven(place, velocity, heading, contact, {k: np.stack(v, 1) for k, v in info.items()})

    def scores(self, guard: Guard, driven: Driven) -> np.ndarray:
        """(W, L) of the steps that the driven agents took, as a guard's barrier has it."""
        w = self.windows
        moments = zip(*(np.moveaxis(x, 1, 0) for x in (driven.place, driven.velocity, driven.heading)))
        x = jnp.stack([_present(guard.world, *w.observed(t, *moment)) for t, moment in enumerate(moments)], 1)
        scores = _scored(guard, x[:, :-1], x[:, 1:])
        return np.asarray(scores)[np.arange(w.count), :, w.driven]

    def _of_one(self, guard: Guarded) -> Guarded:
        """A team's guard, which is told whose actions it decides; agents who are alone decide their own anyway."""
        if guard.guard.world.alone:
            return guard
        w = self.windows
        return replace(guard, driven=jnp.asarray(np.arange(w.actions.shape[2]) == w.driven[:, None]))

    def _now(self, t: int, place: np.ndarray, velocity: np.ndarray, heading: np.ndarray) -> Now:
        w = self.windows
        away = w.others_at[:, t] - place[:, None]
        return Now(
            velocity, heading, w.velocity[:, 0], w.goal - place, away, w.others_move[:, t], self.kinematics.max_speed
        )

    def _behind(self, policy: Any) -> Any:
        """The driven agent's policy behind faults; a brake is never behind them."""
        w = self.windows
        entries = w.names.observation
        observations, state = w.observed(0, w.place[:, 0], w.velocity[:, 0], np.zeros(w.count))
        width = observations.shape[-1]
        named = {index: name for name, index in entries.items()}
        names = tuple(named.get(d, "") for d in range(width))
        states = ("",) * (0 if state is None else state.shape[-1])
        actions = w.actions.shape[-1]
        bounds = (self.kinematics.low, self.kinematics.high)
        return behind(policy, self.faults, observations.shape[1], actions, names, states, bounds, w.steps)

    def _action(self, actor: Any, memory: Any, seen: Seen, key: Any) -> tuple[Any, np.ndarray, dict[str, Any]]:
        """(memory, actions (W, A) of the driven agents, what the guard says)."""
        w = self.windows
        foreign = isinstance(actor, _Bad) or (isinstance(actor, Faulty) and isinstance(actor.policy, _Bad))
        memory, step = (act_with if foreign else _act)(actor, memory, *seen, key)
        acted = np.asarray(step.action, np.float64)[np.arange(w.count), w.driven]
        if not np.isfinite(acted).all():
            raise UserError("The policy gave actions that are not finite; it has diverged: train or fit it again.")
        return memory, acted, {name: self._told(step.info, name) for name in TOLD if name in step.info}

    def _told(self, info: dict[str, Any], name: str) -> np.ndarray:
        """(W,) what a guard says of the driven agents, where it says it of each."""
        w = self.windows
        own = info.get(f"agent_{name}")
        return np.asarray(info[name]) if own is None else np.asarray(own)[np.arange(w.count), w.driven]

    def _in_world(self, world: World, t: int, seen: Seen, action: np.ndarray) -> tuple[Array, Array]:
        """What a World sees (W, N, D), and everybody's actions (W, N, A) in its units."""
        return _present(world, *seen), in_unit(self._team(t, action), world)

    def _team(self, t: int, action: np.ndarray) -> np.ndarray:
        """(W, N, A) everybody's actions in row t: others do as they did, the driven agents act by (W, A)."""
        w = self.windows
        team = w.actions[:, t].copy()
        team[np.arange(w.count), w.driven] = action
        return team
