"""Windows are played: one agent is driven, the others move as logged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.base import Memoryless, Moment, Outcome, Seed, Seen, rollout, split_off
from ringfence.errors import UserError
from ringfence.evaluation.replay.drivers import DRIVERS, Now, braked
from ringfence.evaluation.replay.motion import Kinematics, foreseen_velocity, in_unit
from ringfence.evaluation.replay.scene import Windows
from ringfence.evaluation.rollout import FORESEEN, Acting
from ringfence.faults import Faults
from ringfence.faults.policy import behind
from ringfence.guards import Guard
from ringfence.guards.policy import Guarded
from ringfence.proposals.base import held
from ringfence.types import Array, Policy, PolicyStep, PyTree
from ringfence.utils.precision import on_device
from ringfence.utils.progress import Progress
from ringfence.world import World

TOLD = ("infeasible", "ood", "clearance", FORESEEN)  # of a guard's info
NO_FAULTS = Faults()


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


class Replayed:
    """Windows of logs as an `Env` (envs/base.py): one agent of each is driven, the others move as logged. With a
    `brake` the driven one stops before everybody's constant velocity leads to contact."""

    def __init__(self, windows: Windows, kinematics: Kinematics, radius: float, brake: bool):
        self.windows = windows
        self.kinematics = kinematics
        self.radius = radius
        self.brake = brake
        world = kinematics.world if kinematics.name == "world" else None
        self.foresee = None if world is None else foreseen_velocity(world)
        self.reset()

    @property
    def running(self) -> np.ndarray:
        return np.full(self.windows.count, self.step_number < self.windows.steps)

    def reset(self, seeds: Sequence[Seed] = ()) -> None:
        """To where the windows begin; nothing is drawn."""
        w = self.windows
        self.step_number = 0
        self.place = w.place[:, 0].copy()
        self.velocity = w.velocity[:, 0].copy()
        self.heading = np.arctan2(self.velocity[:, 1], self.velocity[:, 0])
        if looks := w.names.entries.direction:
            first = w.observations[w.rows, 0, w.driven][:, looks]
            self.heading = first[:, 0] if len(looks) == 1 else np.arctan2(first[:, 1], first[:, 0])
        self.seen = Seen(*w.observed(0, *self.motion))

    @property
    def motion(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Place (W, X), velocity (W, X) and heading (W,) of the driven agents."""
        return self.place, self.velocity, self.heading

    @property
    def now(self) -> Now:
        """What a driver knows."""
        w = self.windows
        t = self.step_number
        away = w.others_at[:, t] - self.place[:, None]
        goal = w.goal - self.place
        begun = w.velocity[:, 0]
        return Now(self.velocity, self.heading, begun, goal, away, w.others_move[:, t], self.kinematics.max_speed)

    def observe(self) -> Seen:
        return self.seen

    def step(self, action: np.ndarray) -> Outcome:
        """By the driven agents' actions; a contact costs 1."""
        w = self.windows
        own = np.asarray(action, np.float64)[w.rows, w.driven]
        if not np.isfinite(own).all():
            raise UserError("The policy gave actions that are not finite; it has diverged: train or fit it again.")
        info: dict[str, np.ndarray] = {}
        if self.brake:
            own, info["braked"] = braked(self.now, own, self.kinematics, self.radius)
        self.place, self.velocity, self.heading = self.kinematics.moved(*self.motion, own, self._foreseen(own))
        self.step_number += 1
        self.seen = Seen(*w.observed(self.step_number, *self.motion))
        touches = w.distances(self.step_number, self.place).min(-1) < self.radius
        nothing = np.zeros(w.count)
        return Outcome(nothing, touches.astype(np.float32), nothing.astype(bool), np.ones(w.count, bool), info)

    def team(self, own: np.ndarray) -> np.ndarray:
        """(W, N, A) everybody's actions: others do as they did, the driven agents act by (W, A)."""
        w = self.windows
        team = w.actions[:, self.step_number].copy()
        team[w.rows, w.driven] = own
        return team

    def _foreseen(self, own: np.ndarray) -> np.ndarray | None:
        """(W, X) the velocity after these actions, where a World says it."""
        world = self.kinematics.world
        if world is None or self.foresee is None:
            return None
        change = self.foresee(_present(world, *self.seen), in_unit(self.team(own), world))
        return self.velocity + change[self.windows.rows, self.windows.driven]


@dataclass(frozen=True, eq=False)
class _Filtered:
    """Somebody's actions (W, N, A) under guard, who reads none of what is observed."""

    actions: Callable[[], np.ndarray]
    guard: Guarded

    def initial_state(self, batch: int) -> PyTree:
        return self.guard.initial_state(batch)

    def observe_cost(self, carry: PyTree, cost: Any) -> PyTree:
        return self.guard.observe_cost(carry, cost)

    def observe_age(self, carry: PyTree, age: Array) -> PyTree:
        return self.guard.observe_age(carry, age)

    def observe_sent(self, carry: PyTree, action: Array) -> PyTree:
        return self.guard.observe_sent(carry, action)

    def act(self, carry: PyTree, observations: Any, state: Any, key: Array) -> tuple[PyTree, PolicyStep]:
        guard = self.guard.guard
        wanted = held(in_unit(self.actions(), guard.world), guard.options.horizon)
        return _decided(self.guard, carry, _present(guard.world, observations, state), wanted, key)


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
        env = Replayed(w, self.kinematics, self.radius, brake)
        actor = Acting(self._behind(self._guarded(driver, env, guard)))
        rows = [env.motion]
        touches: list[np.ndarray] = []
        info: list[dict[str, np.ndarray]] = []

        def keep(now: Moment) -> None:
            rows.append(env.motion)
            touches.append(now.outcome.cost > 0)
            told = {name: self._told(now.decided.info, name) for name in TOLD if name in now.decided.info}
            info.append({**told, **now.outcome.info})
            if bar is not None:
                bar.advance(1)

        rollout(actor, env, keep, split_off(jax.random.key(self.seed)))
        place, velocity, heading = (np.stack(each, 1) for each in zip(*rows))
        told = {name: np.stack([one[name] for one in info], 1) for name in info[0]}
        return Driven(place, velocity, heading, np.any(touches, 0), told)

    def scores(self, guard: Guard, driven: Driven) -> np.ndarray:
        """(W, L) of the steps that the driven agents took, as a guard's barrier has it."""
        w = self.windows
        moments = zip(*(np.moveaxis(x, 1, 0) for x in (driven.place, driven.velocity, driven.heading)))
        x = jnp.stack([_present(guard.world, *w.observed(t, *moment)) for t, moment in enumerate(moments)], 1)
        scores = _scored(guard, x[:, :-1], x[:, 1:])
        return np.asarray(scores)[w.rows, :, w.driven]

    def _guarded(self, driver: str | Policy, env: Replayed, guard: Guarded | None) -> Policy:
        """Who decides: a bad driver or a policy, under guard if there is one."""
        guard = None if guard is None else self._of_one(guard)
        if not isinstance(driver, str):
            return driver if guard is None else replace(guard, proposal=driver)

        def wanted(*observed: Any) -> np.ndarray:
            velocity = DRIVERS[driver](env.now)
            return env.team(self.kinematics.toward(velocity, env.velocity, env.heading))

        return Memoryless(wanted) if guard is None else _Filtered(wanted, guard)

    def _of_one(self, guard: Guarded) -> Guarded:
        """A team's guard, which is told whose actions it decides; agents who are alone decide their own anyway."""
        if guard.guard.world.alone:
            return guard
        w = self.windows
        return replace(guard, driven=jnp.asarray(np.arange(w.actions.shape[2]) == w.driven[:, None]))

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

    def _told(self, info: dict[str, Any], name: str) -> np.ndarray:
        """(W,) what a guard says of the driven agents, where it says it of each."""
        w = self.windows
        own = info.get(f"agent_{name}")
        return np.asarray(info[name]) if own is None else np.asarray(own)[w.rows, w.driven]
