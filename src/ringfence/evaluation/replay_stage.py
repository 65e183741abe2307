"""Windows are played: one agent is driven, the others move as logged.

Here is how the driven one moves, by a World's dynamics or by kinematics that are named; who drives badly on purpose;
and a brake that needs no World.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.base import Memoryless, Moment, Outcome, Seed, Seen, rollout, split_off
from ringfence.errors import UserError, known
from ringfence.evaluation.protocol import FORESEEN, Acting
from ringfence.evaluation.replay_scene import Motion, Windows
from ringfence.faults import Faults
from ringfence.faults.policy import behind
from ringfence.guards import Guard
from ringfence.guards.policy import Guarded
from ringfence.logs.store import EpisodeStore
from ringfence.problem import normalise
from ringfence.problem.entries import LANE, SPACE, Entries, axes_of
from ringfence.proposals.base import held
from ringfence.types import Array, Policy, PolicyStep, PyTree
from ringfence.utils.precision import on_device
from ringfence.utils.progress import Progress
from ringfence.world import World

KINEMATICS = ("double_integrator", "holonomic", "unicycle", "bicycle", "world")
TURNING = ("unicycle", "bicycle")  # that have a heading
LINEAR = ("double_integrator", "holonomic")  # whose next velocity is a sum of this one and the action
EXPLAINED = 0.5  # of what velocities change by: kinematics that explain less are refused
WELL = 0.9  # the same of kinematics that nobody asked for
SLOW = 0.05  # m/s below which a velocity tells no heading
AHEAD = 1.0  # s that the brake looks ahead, beside the time that stopping takes
ROOM = 1.15  # radii that it keeps
TOLD = ("infeasible", "ood", "clearance", FORESEEN)  # of a guard's info
NO_FAULTS = Faults()


@dataclass(frozen=True, eq=False)
class Kinematics:
    """`name` of KINEMATICS. A double integrator's velocity becomes (1 − drag) v + gain a, a holonomic body's gain a;
    the actions of a unicycle are m/s² and rad/s, those of a bicycle m/s² and the steering angle."""

    name: str
    dt: float  # s
    low: np.ndarray  # (A,) bounds of actions
    high: np.ndarray
    max_speed: float  # m/s: the fastest of the logs
    late: float  # share of a step that is gone with the next velocity
    gain: float = 1.0
    drag: float = 0.0
    explained: float = float("nan")  # share of the logged changes of velocity
    wheelbase: float = 2.7  # m
    world: World | None = field(default=None, repr=False)

    def moved(
        self, place: np.ndarray, velocity: np.ndarray, heading: np.ndarray, action: np.ndarray, predicted: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(place, velocity, heading) after actions (W, A); `predicted` is the next velocity by the World, if asked."""
        if self.name == "world":
            after = predicted
        elif self.name in LINEAR:
            after = (1 - self.drag) * velocity + self.gain * action
        else:
            speed = (velocity * _unit(heading)).sum(-1)
            rate = action[:, 1] if self.name == "unicycle" else speed / self.wheelbase * np.tan(action[:, 1])
            heading = heading + rate * self.dt
            after = (speed + action[:, 0] * self.dt)[:, None] * _unit(heading)
        speed = np.linalg.norm(after, axis=-1, keepdims=True)
        after = after * np.minimum(1.0, self.max_speed / np.maximum(speed, 1e-9))
        if self.name in ("world", *LINEAR):
            heading = np.where(speed[:, 0] > SLOW, np.arctan2(after[:, 1], after[:, 0]), heading)
        return place + ((1 - self.late) * velocity + self.late * after) * self.dt, after, heading

    def toward(self, wanted: np.ndarray, velocity: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """(W, A) the action within bounds that leads to a velocity (W, X) soonest."""
        if self.name in ("world", *LINEAR):
            if len(self.low) != wanted.shape[1]:
                raise UserError(
                    f"Who drives badly on purpose needs an action for each of {wanted.shape[1]} axes, and these logs "
                    f"have {len(self.low)}; replay a run with drivers=()."
                )
            action = (wanted - (1 - self.drag) * velocity) / self.gain
            return np.clip(action, self.low, self.high)
        speed = (velocity * _unit(heading)).sum(-1)
        want = np.linalg.norm(wanted, axis=-1)
        error = np.arctan2(wanted[:, 1], wanted[:, 0]) - heading
        error = np.where(want > SLOW, (error + np.pi) % (2 * np.pi) - np.pi, 0.0)
        rate = error / self.dt
        if self.name == "bicycle":
            rate = np.arctan(rate * self.wheelbase / np.maximum(np.abs(speed), 0.1))
        push = (want * np.maximum(np.cos(error), 0.0) - speed) / self.dt
        return np.clip(np.stack([push, rate], -1), self.low, self.high)

    @property
    def brakes(self) -> float:
        """m/s² that it brakes by."""
        gain = 1.0 if self.name in TURNING else self.gain / self.dt
        return float(max(abs(gain) * min(abs(self.low[0]), abs(self.high[0])), 1e-3))


def foreseen_velocity(world: World) -> Any:
    """A compiled function (features (B, N, D), actions (B, N, A) in [−1, 1]) -> change of velocities (B, N, X)."""
    own = Entries.of(world.spec.feature_names).own
    at = np.array([own[f"v{axis}"] for axis in axes_of(own, "v{}")])

    @jax.jit
    def change(world: World, before: Any, action: Any) -> Any:
        after, _ = world.dynamics.step(before, action)
        return (after - before)[..., at]

    return lambda before, action: np.asarray(change(world, before, action), np.float64)


def kinematics_of(
    name: str | None, store: EpisodeStore, motion: Motion, world: World | None, dt: float, wheelbase: float
) -> Kinematics:
    """The kinematics that are named; by default a double integrator where that explains the logs, else the World's."""
    if name is not None:
        known("kinematics", name, KINEMATICS)
    size = store.actions.shape[2]
    axes = motion.offset.shape[-1]
    if name in TURNING and axes > 2:
        raise UserError(f"kinematics='{name}' moves in a plane, and these logs are of space; name another.")
    if name is not None and name != "world" and size != axes:
        raise UserError(f"kinematics='{name}' takes {axes} actions an agent, the logs have {size}.")
    bounds = store.card.bounds
    every = (store.n_agents, size)
    low = np.broadcast_to(np.asarray(bounds.low, np.float64), every).max(0)  # what every agent can do
    high = np.broadcast_to(np.asarray(bounds.high, np.float64), every).min(0)
    speeds = np.zeros(1) if motion.velocity is None else np.linalg.norm(motion.velocity, axis=-1)
    fastest = float(np.quantile(speeds, 0.999)) or 1.0
    made = Kinematics(name or KINEMATICS[0], dt, low, high, fastest, motion.late, wheelbase=wheelbase, world=world)
    if name in TURNING:
        return made
    fitted = _fitted(made, store, motion) if size == axes else made
    lane = world is not None and Entries.of(world.spec.feature_names).axes == LANE
    needed = [f"own.v{axis}" for axis in (LANE if lane else SPACE)[:axes]]
    world_can = world is not None and set(needed) <= set(world.spec.feature_names)
    if name == "world" or (name is None and not fitted.explained >= WELL and world_can):
        if not world_can:
            raise UserError(f"kinematics='world' needs a World whose view holds {' and '.join(needed)}; name another.")
        return replace(fitted, name="world")
    if not fitted.explained >= EXPLAINED:
        raise UserError(
            f"Actions of '{store.card.task}' explain {100 * np.nan_to_num(fitted.explained):.0f} % of the changes of "
            f"velocity as kinematics='{fitted.name}' would; name another: {', '.join(KINEMATICS)}."
        )
    return fitted


def _fitted(made: Kinematics, store: EpisodeStore, motion: Motion) -> Kinematics:
    """Gain and drag by least squares of the logged steps."""
    if motion.velocity is None:
        return made
    row = np.arange(store.steps) + store.episode_of_step
    before = motion.velocity[row].ravel()
    change = motion.velocity[row + 1].ravel() - before
    actions = np.asarray(store.actions, np.float64).ravel()
    if made.name == "holonomic":
        gain = float(actions @ (change + before) / max(actions @ actions, 1e-12))
        drag = 1.0
    else:
        columns = np.stack([actions, -before], 1)
        gain, drag = (float(x) for x in np.linalg.lstsq(columns, change, rcond=None)[0])
    left = change - gain * actions + drag * before
    explained = 1 - (left**2).mean() / max(change.var(), 1e-12)
    gain = gain if abs(gain) > 1e-6 else 1e-6
    return replace(made, gain=gain, drag=drag, explained=float(explained))


def in_unit(action: np.ndarray, world: World) -> Any:
    """Actions in [−1, 1], as a World takes them."""
    unit = normalise.to_unit(jnp.asarray(action, jnp.float32), world.spec.action_low, world.spec.action_high)
    return jnp.clip(unit, -1.0, 1.0)


def _unit(heading: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(heading), np.sin(heading)], -1)


@dataclass(frozen=True, eq=False)
class Now:
    """The driven agents of W windows at one moment, along X axes; others as they were logged."""

    velocity: np.ndarray  # (W, X) m/s
    heading: np.ndarray  # (W,)
    begun: np.ndarray  # (W, X) velocity at the window's beginning
    goal: np.ndarray  # (W, X) m from here
    others: np.ndarray  # (W, K, X) m from here
    others_move: np.ndarray  # (W, K, X) m/s
    max_speed: float


def _along(vector: np.ndarray, speed: np.ndarray | float) -> np.ndarray:
    far = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector / np.maximum(far, 1e-6) * np.reshape(speed, (-1, 1))


def _accelerate(now: Now) -> np.ndarray:
    ahead = np.zeros_like(now.velocity)
    ahead[:, :2] = np.stack([np.cos(now.heading), np.sin(now.heading)], -1)
    if ahead.shape[1] > 2:  # in space, where it flies; who hovers goes where it is turned to
        flies = np.linalg.norm(now.velocity, axis=-1, keepdims=True) > SLOW
        ahead = np.where(flies, now.velocity, ahead)
    return _along(ahead, now.max_speed)


def _seek(now: Now) -> np.ndarray:
    nearest = np.linalg.norm(now.others, axis=-1).argmin(-1)
    return _along(now.others[np.arange(len(nearest)), nearest], now.max_speed)


# The velocity (W, X) that each of them wants: hold speed and course; speed up ahead; to the goal, fast; to the nearest.
DRIVERS: dict[str, Callable[[Now], np.ndarray]] = {
    "straight": lambda now: now.begun,
    "accelerate": _accelerate,
    "hasty": lambda now: _along(now.goal, now.max_speed),
    "seek": _seek,
}


def braked(now: Now, action: np.ndarray, kinematics: Kinematics, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Actions (W, A), or full braking where everybody's constant velocity leads to contact before one could stop; and
    where that is (W,)."""
    still = np.zeros_like(now.velocity)
    _, after, _ = kinematics.moved(still, now.velocity, now.heading, action, now.velocity)
    closing = now.others_move - after[:, None]
    time = -(now.others * closing).sum(-1) / np.maximum((closing**2).sum(-1), 1e-9)
    ahead = AHEAD + np.linalg.norm(after, axis=-1, keepdims=True) / kinematics.brakes
    time = np.clip(time, 0.0, ahead)
    miss = np.linalg.norm(now.others + closing * time[..., None], axis=-1).min(-1)
    stop = miss < ROOM * radius
    return np.where(stop[:, None], kinematics.toward(still, now.velocity, now.heading), action), stop


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
