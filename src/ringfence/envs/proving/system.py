"""A system of the proving ground as a simulator, and the systems of the suite.

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

from ringfence.envs.base import Defaults, scanned
from ringfence.envs.film import BLUE, COUNT, DARK, EMPTY, FINE, HUES, RED, TAIL, Scene, captioned, in_picture, pale
from ringfence.envs.proving import drivers
from ringfence.envs.proving.bodies import length
from ringfence.envs.proving.dangers import LOW_CHARGE, MARGIN, METRES, OF_PLACE, SOLID
from ringfence.envs.proving.layout import DRAWS, REACHED, Layout, SystemState, following, names, observe, starts
from ringfence.problem import features
from ringfence.types import Array, Key, Transition
from ringfence.utils.precision import in_float32

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

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
        true = names(self)
        return true if self.names == "all" else tuple(f"obs{d}" for d in range(len(true)))

    @property
    def observation_dim(self) -> int:
        return len(self.observation_names)

    def feature_map(self, view: str) -> features.FeatureMap:
        """s̃_i as it is made of anybody's data: of what drivers would log here, and of observations alone."""
        return _logged_map(self, view)

    def frames(self, states: np.ndarray, moments: list[tuple[int, bool]]) -> Iterator[Image]:
        """Pictures of an episode, states (T+1, S), at `moments`: (step, whether there was a cost since the last)."""
        state = self.from_global_state(jnp.asarray(states))
        unsafe = np.asarray(self.clearance(state) < 0)

        def caption(step: int, unsafe: int) -> str:
            costs = f"{unsafe} unsafe steps" if unsafe else "safe"
            return f"{step * self.dt:4.1f} s    {self.n_agents} x {self.body}, {', '.join(self.danger)}    {costs}"

        yield from captioned(moments, np.any(unsafe, axis=1), _Scene.of(self, state, unsafe).draw, caption)

    def reset(self, key: Key, batch: int) -> SystemState:
        """At rest, free of danger."""
        key_place, key_pose, key_draw, key_phase = jax.random.split(key, 4)
        n = self.n_agents
        body = self.made_of
        config = starts(self, key_place, batch)
        pose = jnp.zeros((batch, n, body.pose_size))
        if body.ahead(pose) is not None:
            turned = jax.random.uniform(key_pose, (batch, n), minval=-jnp.pi, maxval=jnp.pi)
            pose = pose.at[..., 0].set(turned)
        shape = (batch, 1 if self.goals == "team" else n)
        draw = jax.random.randint(key_draw, shape, 0, DRAWS).astype(jnp.float32)
        draw = jnp.broadcast_to(draw, (batch, n))
        goal, draw = following(self, config, config, draw)
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
        reached = after < REACHED
        if self.goals == "team":
            reached = jnp.broadcast_to((after < 2 * REACHED).all(-1, keepdims=True), reached.shape)
        goal, draw = following(self, motion.config, state.goal, state.draw)
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
        return observe(self, state)

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


@dataclass(frozen=True)
class _Scene(Scene):
    """Who is where, heads for what, and pays."""

    system: Layout
    joints: np.ndarray  # (T+1, N, J, 2) m
    goal: np.ndarray  # (T+1, N, 2) m
    ahead: np.ndarray | None  # (T+1, N, 2)
    unsafe: np.ndarray  # (T+1, N) bool
    mover: np.ndarray  # (T+1, 2) m

    @classmethod
    def of(cls, system: Layout, state: SystemState, unsafe: np.ndarray) -> _Scene:
        """Of the states of an episode, (T+1, ...), and who pays in each, (T+1, N)."""
        joints = np.asarray(system.made_of.joints(state.config))
        goal = np.asarray(system.made_of.joints(state.goal))[..., -1, :]
        ahead = system.made_of.ahead(state.pose)
        middle = np.zeros((len(unsafe), 2))
        if system.body == "platoon":
            middle[:, 0] = joints[:, :, 0, 0].mean(1)
        reach = float(np.abs(joints - middle[:, None, None]).max()) + 2 * system.radius
        if system.planar:
            reach = max(reach, system.side / 2 + system.radius)
        return cls(
            middle=middle,
            reach=in_picture(reach),
            system=system,
            joints=joints,
            goal=goal,
            ahead=None if ahead is None else np.asarray(ahead),
            unsafe=unsafe,
            mover=np.asarray(system.mover_at(state.phase)),
        )

    def surroundings(self, draw: ImageDraw, step: int) -> None:
        """What stands, and what goes its own way."""
        system = self.system
        if "walls" in system.danger:
            end = system.side / 2
            room = end * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
            self.line(draw, step, room, DARK, 2 * FINE)
        if "corridor" in system.danger:
            half, swing, bend = system.corridor
            x = np.linspace(-self.reach, self.reach, 120)
            middle = np.stack([x, swing * np.sin(x / bend)], -1)
            slope = swing / bend * np.cos(x / bend)
            across = np.stack([-slope, np.ones_like(x)], -1) / np.sqrt(1 + slope**2)[:, None]
            for side in (-half, half):
                self.line(draw, step, middle + side * across, DARK, 2 * FINE)
        if "posts" in system.danger:
            for x, y, radius in system.posts:
                self.disc(draw, step, np.array([x, y]), radius, fill=EMPTY, outline=DARK)
        if "mover" in system.danger:
            self.disc(draw, step, self.mover[step], system.mover[0], fill=BLUE)

    def draw(self, draw: ImageDraw, step: int) -> None:
        """Everything but words."""
        self.surroundings(draw, step)
        system = self.system
        joints = self.joints[step]
        for i in range(system.n_agents):
            hand = joints[i, -1]
            colour = pale(HUES[i % COUNT])
            self.line(draw, step, np.stack([hand, self.goal[step, i]]), EMPTY, FINE)
            tail = self.joints[max(0, step - TAIL) : step + 1, i, -1]
            if len(tail) > 1 and system.body != "motor":
                self.line(draw, step, tail, colour, 3 * FINE)
            self.disc(draw, step, self.goal[step, i], 0.4 * system.radius, fill=colour)
        for i in range(system.n_agents):
            colour = RED if self.unsafe[step, i] else HUES[i % COUNT]
            if len(joints[i]) > 1:
                self.line(draw, step, joints[i], DARK, 3 * FINE)
            for point in joints[i][1:] if len(joints[i]) > 1 else joints[i]:
                self.disc(draw, step, point, system.radius, fill=colour, outline=DARK)
            if self.ahead is not None:
                front = joints[i, 0] + system.radius * self.ahead[step, i]
                self.line(draw, step, np.stack([joints[i, 0], front]), DARK, 2 * FINE)


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


# Settings of the library are chosen elsewhere, but for these: `drones` told how fast scores fall out of distribution
# where a guard stays within the logs (guards/barrier.py), `drones`, `couriers` and `convoy` which rows of a plan are to
# stay within them (guards/shown.py), `convoy` and `crowd` how much near rows count (guards/correction.py), and `gears`
# had names looked for in logs (problem/inferred_names.py).
TEST: dict[str, System] = {
    "discs": System("integrator", ("mover", "pairs"), 3, mover=(0.35, 1.0, 16.0)),
    "posts": System("integrator", ("pairs", "posts"), 4, drag=0.3),
    "flock": System(
        "integrator", ("apart", "pairs"), 4, goals="team", lag=0.2, uneven=0.5, side=7.0, episode_length=100
    ),
    "hall": System(
        "unicycle",
        ("pairs", "walls", "posts"),
        4,
        costs="each",
        side=5.0,
        posts=((1.2, 0.8, 0.3), (-1.2, 0.6, 0.4), (0.1, -1.2, 0.25)),
        episode_length=100,
    ),
    "crowd": System("unicycle", ("pairs",), 12, costs="each", drivers="careless", homogeneous=True, side=7.0, drag=0.2),
    "couriers": System("unicycle", ("battery", "pairs"), 5, costs="each", side=5.0, episode_length=100),
    "street": System("car", ("pairs",), 3, side=6.0, dt=0.08, mass=1.2, episode_length=100),
    "lane": System(
        "car", ("corridor",), 2, names="none", drivers="careful", side=8.0, corridor=(1.3, 0.6, 1.4), drag=0.3
    ),
    "drones": System("quadrotor", ("pairs", "walls"), 3, drivers="careless", side=3.4, dt=0.05, episode_length=100),
    "pillar": System(
        "quadrotor", ("posts",), 1, names="none", dt=0.05, mass=1.2, posts=((0.0, 0.0, 0.5),), episode_length=100
    ),
    "convoy": System("platoon", ("pairs",), 6, costs="each", drivers="careless", lag=0.2, drag=0.05),
    "train": System("platoon", ("apart", "pairs"), 8, goals="team", apart_limit=1.8, uneven=0.6, drivers="careless"),
    "arms": System("arm", ("pairs",), 2, drivers="careless", dt=0.05, radius=0.1, episode_length=100),
    "bench": System(
        "arm",
        ("joints", "posts"),
        3,
        costs="each",
        names="none",
        drivers="careful",
        dt=0.05,
        radius=0.08,
        joint_limit=1.3,
        posts=((-0.4, 0.6, 0.1), (0.5, 0.6, 0.1)),
        episode_length=100,
    ),
    "shafts": System("motor", ("speed",), 4, drivers="careful", lag=0.3, speed_limit=1.5),
    "gears": System(
        "motor", ("apart",), 6, names="none", goals="team", lag=0.3, drivers="careless", uneven=0.5, apart_limit=0.5
    ),
}

# For choosing settings.
DEVELOPMENT: dict[str, System] = {
    "room": System("integrator", ("pairs", "walls"), 3, costs="each", drivers="careless", side=3.4, mass=1.4),
    "path": System("unicycle", ("corridor", "pairs"), 2, drivers="careful", side=6.0, corridor=(0.9, 0.7, 0.8)),
    "swing": System(
        "arm",
        ("posts",),
        2,
        drivers="careless",
        radius=0.08,
        posts=((0.0, 0.59, 0.1),),
        dt=0.05,
        episode_length=100,
        uneven=0.3,
    ),
    "file": System("platoon", ("pairs", "speed"), 4, names="none", speed_limit=1.6),
}
