"""Safe Multi-Agent MuJoCo: agents share the joints of one robot that must not run faster than a limit.

The tasks of safety-gymnasium (Ji et al. 2023), exactly: HalfCheetah cut in two, and the Ant cut in two or four.
Reward, shared: forward speed − control cost, the Ant also 1 for every step; cost, shared: 1 on every step whose mean
planar speed exceeds the limit. Facts that an own implementation has to respect, all checked by tests:

* the Ant's speed is the displacement of the *torso's* `xpos`, which RK4 leaves at its last stage, not that of `qpos`;
* MuJoCo 3.5 began to add the contact margins of two geoms where it used to take the larger one; halving the Ant's
  margins undoes it. MuJoCo 4 changed RK4 itself; nothing undoes that, so it is refused for the Ant;
* a reset normalises the Ant's quaternion; older versions of MuJoCo did so in place.

One `Simulation` holds a batch of robots and steps them natively on several threads.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from ringfence.envs import film
from ringfence.errors import UserError, unknown
from ringfence.problem.features import VIEWS, FeatureMap, others
from ringfence.types import Array
from ringfence.utils import interrupts

FRAME_SKIP = 5  # substeps of an environment step
DT = 0.05  # s of an environment step
RESET_SPREAD = 0.1  # of joint positions (uniform) and velocities (standard deviation) at reset
HEALTHY_Z = (0.2, 1.0)  # m, the Ant's torso; outside the episode ends
MARGIN = 0.01  # m, contact margin of the Ant's geoms in Gymnasium's file
LIMITS = {"2x3": 3.227, "2x4": 2.522, "4x2": 2.418}  # m/s, safety-gymnasium's
CREEPING = 0.6  # m/s: below that limit a guard pushes an Ant less
ROBOTS = {"2x3": "half_cheetah", "2x4": "ant", "4x2": "ant"}

Parts = Literal["2x3", "2x4", "4x2"]


class Outcome(NamedTuple):
    """What a step gives, for a batch of robots; what is not running has zeros."""

    reward: np.ndarray  # (B,) shared
    cost: np.ndarray  # (B,) shared: 1 where the speed exceeds the limit
    terminated: np.ndarray  # (B,) bool: fallen
    speed: np.ndarray  # (B,) m/s, mean over the step; for HalfCheetah its absolute value along x


@dataclass(frozen=True)
class SafeMuJoCo:
    """A robot and how it is divided: `2x3` HalfCheetah, `2x4` Ant, `4x2` Ant (agents x joints)."""

    parts: Parts = "2x3"
    speed_limit: float | None = None  # m/s; None: safety-gymnasium's
    episode_length: int = 1000
    dt: ClassVar[float] = DT
    # Settings of its World: contacts are hard to foresee, a speed limit to the tenth of a m/s is to tell; 25 steps of
    # 1000 above it are allowed; and ten steps before its fall an Ant runs fastest, so values look farther than that.
    world: ClassVar[dict] = {
        "discount": 0.97,
        "dynamics_updates": 40_000,
        "barrier_width": 128,
        "barrier_updates": 20_000,
        "missed": 0.02,
    }

    def __post_init__(self):
        if self.parts not in ROBOTS:
            raise unknown("division of a robot", str(self.parts), ROBOTS)
        if self.speed_limit is not None and not self.speed_limit > 0:
            raise UserError(f"speed_limit={self.speed_limit} must be positive; it is in m/s.")
        if self.episode_length < 1:
            raise UserError(f"episode_length={self.episode_length} must be at least 1; it is in steps.")

    @property
    def robot(self) -> str:
        return ROBOTS[self.parts]

    @property
    def name(self) -> str:
        """`halfcheetah_2x3`, `ant_2x4` or `ant_4x2`"""
        return f"{self.robot.replace('_', '')}_{self.parts}"

    @property
    def ant(self) -> bool:
        return self.robot == "ant"

    @property
    def terminates(self) -> bool:
        """The Ant's episode ends with its fall."""
        return self.ant

    @property
    def guard(self) -> dict[str, dict]:
        """What named guards do otherwise (guards.options_of). Three steps ahead foresight errs by a tenth of what
        changes. An Ant that is pushed or climbs far from where the logs were falls; where it is to creep, the
        margin is missing most of the time, so that it is always pushed, and less will do."""
        climb = {"rows": 3, "refine": 10, "starts": 4, "reach": 0.2 if self.ant else 0.5, "care": 30.0}
        bound = {"bound": 0.2 if self.limit < CREEPING else 0.5} if self.ant else {}
        return {"shield": bound, "adapt": bound, "refine": climb, "full": climb | bound}

    @property
    def limit(self) -> float:
        """m/s"""
        return LIMITS[self.parts] if self.speed_limit is None else self.speed_limit

    def return_ceiling(self, cost_limit: float, fastest: float) -> float:
        """No episode with at most `cost_limit` steps above the limit, none of them faster than `fastest` (m/s), can
        earn more: the reward of a step is at most the forward speed, and for the Ant 1 more."""
        over = min(cost_limit, self.episode_length)
        return (
            (self.episode_length - over) * self.limit + over * max(fastest, self.limit) + self.ant * self.episode_length
        )

    def describe(self, speed: np.ndarray, cost_limit: float) -> dict:
        """What a data card says of the limits: `speed` (T,) m/s of all steps, `cost_limit` steps above per episode."""
        return {
            "speed_limit": self.limit,
            "cost_limit": cost_limit,
            "speed_quantiles": {str(q): float(np.quantile(speed, q)) for q in (0.05, 0.25, 0.5, 0.6, 0.75, 0.95)},
            "return_ceiling": self.return_ceiling(cost_limit, float(speed.max())),
        }

    @property
    def n_agents(self) -> int:
        return int(self.parts[0])

    @property
    def action_dim(self) -> int:
        return int(self.parts[2])

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """In the order of `qpos`."""
        if self.ant:
            return tuple(f"{kind}{leg}" for leg in range(1, 5) for kind in ("hip", "ankle"))
        return ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")

    @cached_property
    def own_joints(self) -> np.ndarray:
        """(N, A) joints of every agent, in the order of its action."""
        return np.arange(len(self.joints)).reshape(self.n_agents, self.action_dim)

    @cached_property
    def actuators(self) -> np.ndarray:
        """(N, A) index in `ctrl` of every action entry. The Ant's motors begin with its fourth leg."""
        return (self.own_joints + 2) % 8 if self.ant else self.own_joints

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Entries of the global state: all of qpos but the planar position, then qvel."""
        torso, moving = ("z", "pitch"), ("vx", "vz", "vpitch")
        if self.ant:
            torso, moving = ("z", "qw", "qx", "qy", "qz"), ("vx", "vy", "vz", "wx", "wy", "wz")
        names = [f"torso.{c}" for c in torso] + [f"{j}.q" for j in self.joints]
        return tuple(names + [f"torso.{c}" for c in moving] + [f"{j}.v" for j in self.joints])

    @property
    def observation_dim(self) -> int:
        return self.observed.shape[1]

    @cached_property
    def observed(self) -> np.ndarray:
        """(N, O) entries of the global state in every agent's observation: own joints by name (position, velocity),
        positions of the neighbouring joints, the torso."""
        at = {name: k for k, name in enumerate(self.state_names)}
        rows = []
        for mine in self.own_joints:
            own = sorted((self.joints[j] for j in mine), key=lambda name: (name.rstrip("0123456789"), name))
            rows.append([at[f"{j}.{c}"] for j in own for c in "qv"])
            rows[-1] += [at[f"{j}.q"] for j in self._neighbours(mine)]
            rows[-1] += [k for name, k in at.items() if name.startswith("torso.")]
        return np.array(rows)

    def _neighbours(self, mine: np.ndarray) -> list[str]:
        """Joints next to those of an agent: the other legs' hips, or the other half's thigh."""
        others = [j for k, j in enumerate(self.joints) if k not in mine]
        return [j for j in others if j.startswith("hip") or j.endswith("thigh")]

    @cached_property
    def observation_names(self) -> tuple[str, ...]:
        """Of agent 0; other agents see their own joints in the same places."""
        return tuple(self.state_names[k] for k in self.observed[0])

    def feature_map(self, view: str) -> FeatureMap:
        """s̃_i in a view (features.py)."""
        return views(view, self)

    opengl: ClassVar[bool] = True  # its films need it
    film_shows: ClassVar[str] = "The bar is the speed, the stroke its limit, red is above it."

    def frames(self, states: np.ndarray, moments: list[tuple[int, bool]]):
        """Pictures of an episode (film.py)."""
        return film.frames(self, states, moments)

    def model(self):
        """The MuJoCo model; the Ant's is refused on versions whose physics differs."""
        import gymnasium
        import mujoco

        version = tuple(int(x) for x in re.findall(r"\d+", mujoco.__version__)[:2])
        if self.ant and version >= (4, 0):
            raise UserError(
                f"MuJoCo {mujoco.__version__} integrates free joints differently, so its Ant is another robot; "
                "install 'mujoco>=3.3,<4'."
            )
        text = (Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / f"{self.robot}.xml").read_text()
        # Newer versions warn of this attribute in a log file in the working directory.
        model = mujoco.MjModel.from_xml_string(re.sub(r'\s+settotalmass="[^"]*"', "", text))
        if self.ant and not np.allclose(model.geom_margin[1:], MARGIN):
            raise UserError(
                f"Gymnasium {gymnasium.__version__} ships an Ant with other contact margins, another robot; install "
                "'gymnasium<=1.4'."
            )
        if self.ant and version >= (3, 5):
            model.geom_margin *= 0.5
        if hasattr(mujoco.mjtDisableBit, "mjDSBL_ISLAND"):  # one robot is one island: the same bits, 5 % faster
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
        if not self.ant:
            mujoco.mj_setTotalmass(model, 14.0)
            mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def simulate(self, batch: int, threads: int | None = None) -> Simulation:
        """`batch` robots; `threads` (default: one per core) step them."""
        return Simulation(self, batch, threads)


class Simulation:
    """A batch of robots, stepped together. Not pure: `reset` and `step` change it."""

    def __init__(self, env: SafeMuJoCo, batch: int, threads: int | None = None):
        if batch < 1:
            raise UserError(f"batch={batch} must be at least 1.")
        self.env, self.batch, self._threads = env, batch, threads
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        threads = max(1, min(threads or cores, batch))
        model = env.model()
        try:
            self._robots = _Batch(model, batch, threads)
        except ImportError:  # before MuJoCo 3.17
            self._robots = _Loop(model, batch, threads)
        self._rest = model.qpos0.copy()
        self._ctrl = np.zeros((batch, model.nu))
        self._place = np.zeros((batch, 2 if env.ant else 1))  # where speeds are measured from
        self.running = np.zeros(batch, bool)

    def reset(self, seeds: Sequence[int | Sequence[int]], ids: Sequence[int] | None = None) -> None:
        """Start an episode of every robot, or of those in `ids`; a seed fixes its start, whatever the batch."""
        ids = np.arange(self.batch) if ids is None else np.asarray(ids)
        if len(seeds) != len(ids):
            raise UserError(f"reset() got {len(seeds)} seeds for {len(ids)} robots; pass one for each.")
        draws = [np.random.Generator(np.random.PCG64(np.random.SeedSequence(s))) for s in seeds]
        nq, nv = self._rest.size, self._robots.qvel.shape[1]
        qpos = np.stack([self._rest + d.uniform(-RESET_SPREAD, RESET_SPREAD, nq) for d in draws])
        qvel = np.stack([RESET_SPREAD * d.standard_normal(nv) for d in draws])
        if self.env.ant:
            qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        self.restore(qpos, qvel, ids=ids)

    def restore(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        warmstart: np.ndarray | None = None,
        place: np.ndarray | None = None,
        ids: Sequence[int] | None = None,
    ) -> None:
        """Put robots (those in `ids`, or all) into states. `place` (B, 2): the Ant's lagged position, if it is not that
        of `qpos`."""
        ids = np.arange(self.batch) if ids is None else np.asarray(ids)
        self._robots.place(ids, qpos, qvel, np.zeros_like(qvel) if warmstart is None else warmstart)
        self._place[ids] = self._measured()[ids] if place is None else place
        self.running[ids] = True

    def __getstate__(self) -> dict:
        """What a copy or another process needs to go on from here; the simulator itself is made again there."""
        robots = self._robots
        kept = {"qpos": robots.qpos, "qvel": robots.qvel, "warmstart": robots.warmstart, "place": self._place}
        made = self.env, self.batch, self._threads
        return {"made": made, "kept": {k: v.copy() for k, v in kept.items()}, "running": self.running.copy()}

    def __setstate__(self, told: dict) -> None:
        self.__init__(*told["made"])
        self.restore(**told["kept"])
        self.running[:] = told["running"]

    def _measured(self) -> np.ndarray:
        """(B, 1 or 2) positions whose displacement is the speed."""
        return (self._robots.torso if self.env.ant else self._robots.qpos[:, :1]).copy()

    def state(self) -> np.ndarray:
        """(B, S) float64 global states."""
        first = 2 if self.env.ant else 1
        return np.concatenate([self._robots.qpos[:, first:], self._robots.qvel], 1)

    def observe(self, state: np.ndarray | None = None) -> np.ndarray:
        """(B, N, O) local observations."""
        return (self.state() if state is None else state)[:, self.env.observed]

    def step(self, action: np.ndarray) -> Outcome:
        """Advance the running robots by 0.05 s; `action` (B, N, A) is clipped to [-1, 1]."""
        wanted = (self.batch, self.env.n_agents, self.env.action_dim)
        if np.shape(action) != wanted:
            raise UserError(f"step() got actions of shape {np.shape(action)}; {self.env.name} takes {wanted}.")
        action = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        if not np.isfinite(action).all():
            raise UserError("step() got actions that are not numbers; the policy has diverged or divides by zero.")
        self._ctrl[:, self.env.actuators] = action
        live = np.flatnonzero(self.running)
        self._robots.advance(self._ctrl, live)
        place = self._measured()
        velocity, self._place = (place - self._place) / DT, place
        speed = np.linalg.norm(velocity, axis=1)
        effort = (action**2).sum((1, 2))
        if self.env.ant:
            reward = velocity[:, 0] + 1.0 - 0.5 * effort
            z = self._robots.qpos[:, 2]
            sound = np.isfinite(self.state()).all(1) & (z >= HEALTHY_Z[0]) & (z <= HEALTHY_Z[1])
        else:
            reward = velocity[:, 0] - 0.1 * effort
            sound = np.ones(self.batch, bool)
        on = self.running.copy()
        self.running &= sound
        cost = (speed > self.env.limit).astype(np.float64)
        return Outcome(*(np.where(on, x, 0.0) for x in (reward, cost)), on & ~sound, np.where(on, speed, 0.0))


class _Batch:
    """MuJoCo's own batched stepping (3.17 and later)."""

    def __init__(self, model, batch: int, threads: int):
        from mujoco.batch import Batch

        self._batch = Batch(model, batch, threads)
        bind = self._batch.bind
        self.qpos, self.qvel, self._ctrl, self.warmstart = (bind(x) for x in ("qpos", "qvel", "ctrl", "qacc_warmstart"))
        self._xpos = bind("xpos")

    @property
    def torso(self) -> np.ndarray:
        return self._xpos[:, 1, :2]

    def place(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, warmstart: np.ndarray) -> None:
        self._batch.reset(ids=ids, stage=0)
        self.qpos[ids], self.qvel[ids] = qpos, qvel
        with interrupts.held():
            self._batch.forward(ids=ids)
        self.warmstart[ids] = warmstart

    def advance(self, ctrl: np.ndarray, live: np.ndarray) -> None:
        if len(live):
            self._ctrl[:] = ctrl
            with interrupts.held():
                self._batch.step(ids=live, nstep=FRAME_SKIP)


class _Loop:
    """One MjData per robot, stepped by a pool of threads; MuJoCo releases the interpreter while it works."""

    def __init__(self, model, batch: int, threads: int):
        import mujoco

        self._mujoco, self._model = mujoco, model
        self._data = [mujoco.MjData(model) for _ in range(batch)]
        self._threads, self._pool = threads, ThreadPoolExecutor(threads) if threads > 1 else None
        self.qpos, self.qvel = np.zeros((batch, model.nq)), np.zeros((batch, model.nv))
        self.torso = np.zeros((batch, 2))

    @property
    def warmstart(self) -> np.ndarray:
        return np.stack([d.qacc_warmstart for d in self._data])

    def place(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, warmstart: np.ndarray) -> None:
        for row, k in enumerate(ids):
            d = self._data[k]
            self._mujoco.mj_resetData(self._model, d)
            d.qpos[:], d.qvel[:] = qpos[row], qvel[row]
            self._mujoco.mj_forward(self._model, d)
            d.qacc_warmstart[:] = warmstart[row]
            self._read(k)

    def advance(self, ctrl: np.ndarray, live: np.ndarray) -> None:
        def run(chunk: np.ndarray) -> None:
            for k in chunk:
                self._data[k].ctrl[:] = ctrl[k]
                self._mujoco.mj_step(self._model, self._data[k], FRAME_SKIP)
                self._read(k)

        if self._pool is None:
            run(live)
        else:
            with interrupts.held():
                list(self._pool.map(run, np.array_split(live, self._threads)))

    def _read(self, k: int) -> None:
        d = self._data[k]
        self.qpos[k], self.qvel[k], self.torso[k] = d.qpos, d.qvel, d.xpos[1, :2]


def views(view: str, env: SafeMuJoCo) -> FeatureMap:
    """The views of one robot whose joints are shared out: torso, own joints, others' joints."""
    state_names, joints, own_joints, observed = env.state_names, env.joints, env.own_joints, env.observed
    n, a = own_joints.shape
    torso = [name for name in state_names if name.startswith("torso.")]
    if view == "centralized":
        table = np.tile(np.arange(len(state_names)), (n, 1))
        less = np.full_like(table, -1)
        return FeatureMap(view, tuple(state_names), "state", table, less, body=True, joint=True, origin=table)
    if view == "decentralized":
        own = {f"{joints[k]}.{c}": f"own.joint{p}.{c}" for p, k in enumerate(own_joints[0]) for c in "qv"}
        seen = [state_names[k] for k in observed[0]]
        near = {name: f"near{m}.q" for m, name in enumerate(x for x in seen if x not in own and x not in torso)}
        table = np.tile(np.arange(len(seen)), (n, 1))
        names = tuple((own | near).get(x, x) for x in seen)
        less = np.full_like(table, -1)
        return FeatureMap(view, names, "observations", table, less, body=True, joint=True, origin=observed)
    if view != "pruned":
        raise unknown("view", view, VIEWS)
    at = {name: k for k, name in enumerate(state_names)}
    whose = ["own", *(f"other{j}" for j in range(n - 1))]
    names = [*torso, *(f"{w}.joint{k}.{c}" for w in whose for k in range(a) for c in "qv")]
    rows = []
    for i in range(n):
        order = [i, *(j for j in range(n) if j != i)]
        rows.append([at[f"{joints[k]}.{c}"] for j in order for k in own_joints[j] for c in "qv"])
    table = np.array([[at[t] for t in torso] + row for row in rows])
    own = tuple(range(len(torso) + 2 * a))
    agree = _reconcile_shared(len(torso), 2 * a, n)
    less = np.full_like(table, -1)
    return FeatureMap(view, tuple(names), "state", table, less, own, agree, body=True, joint=True, origin=table)


def _reconcile_shared(torso: int, joints: int, n: int) -> Callable[[Array], Array]:
    """A function on plans (..., H, N, D), row 0 the present: everybody's torso is the mean of the planned ones, and
    others' joints are where their owners plan to have them."""
    whose = others(n)

    def agree(x: Array) -> Array:
        start, later = x[..., :1, :, :], x[..., 1:, :, :]
        body = jnp.broadcast_to(later[..., :torso].mean(-2, keepdims=True), later[..., :torso].shape)
        own = later[..., torso : torso + joints]
        rest = own[..., whose, :].reshape(*own.shape[:-1], (n - 1) * joints)
        return jnp.concatenate([start, jnp.concatenate([body, own, rest], -1)], -3)

    return agree
