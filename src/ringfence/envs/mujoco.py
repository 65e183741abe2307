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
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np

from ringfence.envs import film
from ringfence.envs.base import Outcome, Seed, Seen
from ringfence.errors import UserError, needs, unknown
from ringfence.problem.features import VIEWS, FeatureMap, Source
from ringfence.problem.partners import others
from ringfence.types import Array

if TYPE_CHECKING:
    from PIL.Image import Image

FRAME_SKIP = 5  # substeps of an environment step
DT = 0.05  # s of an environment step
RESET_SPREAD = 0.1  # of joint positions (uniform) and velocities (standard deviation) at reset
HEALTHY_Z = (0.2, 1.0)  # m, the Ant's torso; outside the episode ends
MARGIN = 0.01  # m, contact margin of the Ant's geoms in Gymnasium's file
LIMITS = {"2x3": 3.227, "2x4": 2.522, "4x2": 2.418}  # m/s, safety-gymnasium's
COST_LIMIT = 25.0  # steps above the speed limit per episode, Safety-Gymnasium's
CREEPING = 0.6  # m/s: below that limit a guard pushes an Ant less

Parts = Literal["2x3", "2x4", "4x2"]
ROBOTS: dict[Parts, str] = {"2x3": "half_cheetah", "2x4": "ant", "4x2": "ant"}


@dataclass(frozen=True)
class SafeMuJoCo:
    """A robot and how it is divided: `2x3` HalfCheetah, `2x4` Ant, `4x2` Ant (agents x joints)."""

    parts: Parts = "2x3"
    speed_limit: float | None = None  # m/s; None: safety-gymnasium's
    episode_length: int = 1000
    dt: ClassVar[float] = DT
    film_shows: ClassVar[str] = "The bar is the speed, the stroke its limit, red is above it."
    opengl: ClassVar[bool] = True

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
    def world(self) -> dict[str, Any]:
        """Contacts are hard to predict, and a speed limit is to be met to a tenth of a m/s; 25 steps of 1000 above it
        are allowed. Ten steps before its fall an Ant runs fastest, so values look farther than that."""
        return {
            "discount": 0.97,
            "dynamics_updates": 40_000,
            "barrier_width": 128,
            "barrier_updates": 20_000,
            "miscoverage": 0.02,
        }

    @property
    def guard(self) -> dict[str, dict[str, Any]]:
        """What named guards do otherwise (guards.options_of). Three steps ahead predictions err by a tenth of what
        changes. An Ant that is pushed or climbs far from where the logs were falls; where it is to creep, the
        margin is missing most of the time, so that it is always pushed, and less will do."""
        climb = {
            "horizon": 3,
            "optimizer_steps": 10,
            "num_restarts": 4,
            "trust_radius": 0.2 if self.ant else 0.5,
            "safety_weight": 30.0,
        }
        bound = {"max_correction": 0.2 if self.limit < CREEPING else 0.5} if self.ant else {}
        return {"shield": bound, "adapt": bound, "refine": climb, "full": climb | bound}

    @property
    def limit(self) -> float:
        """m/s"""
        return LIMITS[self.parts] if self.speed_limit is None else self.speed_limit

    def return_ceiling(self, cost_limit: float, fastest: float) -> float:
        """No episode with at most `cost_limit` steps above the limit, none of them faster than `fastest` (m/s), can
        earn more: the reward of a step is at most the forward speed, and for the Ant 1 more."""
        over = min(cost_limit, self.episode_length)
        running = (self.episode_length - over) * self.limit + over * max(fastest, self.limit)
        standing = self.episode_length if self.ant else 0
        return running + standing

    def describe(self, speed: np.ndarray, cost_limit: float) -> dict[str, Any]:
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

    @property
    def state_names(self) -> tuple[str, ...]:
        """Entries of the global state: all of qpos but the planar position, then qvel."""
        return self._state_names

    @cached_property
    def _state_names(self) -> tuple[str, ...]:
        pose = ("z", "qw", "qx", "qy", "qz") if self.ant else ("z", "pitch")
        velocity = ("vx", "vy", "vz", "wx", "wy", "wz") if self.ant else ("vx", "vz", "vpitch")
        positions = [*(f"torso.{c}" for c in pose), *(f"{joint}.q" for joint in self.joints)]
        velocities = [*(f"torso.{c}" for c in velocity), *(f"{joint}.v" for joint in self.joints)]
        return tuple(positions + velocities)

    @property
    def observation_dim(self) -> int:
        return self.observed.shape[1]

    @cached_property
    def observed(self) -> np.ndarray:
        """(N, O) entries of the global state in every agent's observation: own joints by name (position, velocity),
        positions of the neighbouring joints, the torso."""
        at = {name: k for k, name in enumerate(self.state_names)}
        torso = [k for name, k in at.items() if name.startswith("torso.")]
        rows = []
        for joints in self.own_joints:
            own = sorted((self.joints[j] for j in joints), key=lambda name: (name.rstrip("0123456789"), name))
            moving = [at[f"{joint}.{c}"] for joint in own for c in "qv"]
            # joints next to those: the other legs' hips, or the other half's thigh
            rest = [joint for k, joint in enumerate(self.joints) if k not in joints]
            near = [at[f"{joint}.q"] for joint in rest if joint.startswith("hip") or joint.endswith("thigh")]
            rows.append(moving + near + torso)
        return np.array(rows)

    @cached_property
    def observation_names(self) -> tuple[str, ...]:
        """Of agent 0; other agents see their own joints in the same places."""
        return tuple(self.state_names[k] for k in self.observed[0])

    def feature_map(self, view: str) -> FeatureMap:
        """s̃_i in a view (features.py)."""
        return views(view, self)

    def frames(self, states: np.ndarray, moments: list[tuple[int, bool]]) -> Iterator[Image]:
        """Pictures of an episode (film.py)."""
        return film.robot_frames(self, states, moments)

    def model(self) -> Any:
        """The MuJoCo model; the Ant's is refused on versions whose physics differs."""
        with needs("sim", "Robots"):
            import gymnasium
        mujoco = _mujoco()
        version = tuple(int(x) for x in re.findall(r"\d+", mujoco.__version__)[:2])
        if self.ant and version >= (4, 0):
            raise UserError(
                f"MuJoCo {mujoco.__version__} integrates free joints differently, so its Ant is another robot; "
                "install 'mujoco>=3.3,<4'."
            )
        assets = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
        text = (assets / f"{self.robot}.xml").read_text()
        # Newer versions warn of this attribute in a log file in the working directory.
        model = mujoco.MjModel.from_xml_string(re.sub(r'\s+settotalmass="[^"]*"', "", text))
        if self.ant and not np.allclose(model.geom_margin[1:], MARGIN):
            raise UserError(
                f"Gymnasium {gymnasium.__version__} ships an Ant with other contact margins, another robot; install "
                "'gymnasium<=1.4'."
            )
        if self.ant and version >= (3, 5):
            model.geom_margin *= 0.5
        # One robot is one island: the same bits, 5 % faster. Older versions do not look for islands.
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, "mjDSBL_ISLAND", 0))
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
        self.env = env
        self.batch = batch
        self._threads = threads
        model = env.model()
        cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
        workers = max(1, min(threads or cores, batch))
        try:
            self._robots = _Batch(model, batch, workers)
        except ImportError:  # before MuJoCo 3.17
            self._robots = _Loop(model, batch, workers)
        self._rest = model.qpos0.copy()
        self._ctrl = np.zeros((batch, model.nu))
        self._place = np.zeros((batch, 2 if env.ant else 1))  # where speeds are measured from
        self.running = np.zeros(batch, bool)

    def reset(self, seeds: Sequence[Seed], ids: Sequence[int] | np.ndarray | None = None) -> None:
        """Start an episode of every robot, or of those in `ids`; a seed fixes its start, whatever the batch."""
        robots = self._ids(ids)
        if len(seeds) != len(robots):
            raise UserError(f"reset() got {len(seeds)} seeds for {len(robots)} robots; pass one for each.")
        draws = [np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed))) for seed in seeds]
        qpos = np.stack([self._rest + draw.uniform(-RESET_SPREAD, RESET_SPREAD, self._rest.size) for draw in draws])
        qvel = np.stack([RESET_SPREAD * draw.standard_normal(self._robots.qvel.shape[1]) for draw in draws])
        if self.env.ant:
            qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        self.restore(qpos, qvel, ids=robots)

    def restore(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        warmstart: np.ndarray | None = None,
        place: np.ndarray | None = None,
        ids: Sequence[int] | np.ndarray | None = None,
    ) -> None:
        """Put robots (those in `ids`, or all) into states. `place` (B, 2): the Ant's lagged position, if it is not that
        of `qpos`."""
        robots = self._ids(ids)
        self._robots.place(robots, qpos, qvel, np.zeros_like(qvel) if warmstart is None else warmstart)
        self._place[robots] = self._measured()[robots] if place is None else place
        self.running[robots] = True

    def _ids(self, ids: Sequence[int] | np.ndarray | None) -> np.ndarray:
        """Robots that are named, or all."""
        return np.arange(self.batch) if ids is None else np.asarray(ids)

    def __getstate__(self) -> dict[str, Any]:
        """What a copy or another process needs to go on from here; the simulator itself is made again there."""
        robots = self._robots
        arrays = {"qpos": robots.qpos, "qvel": robots.qvel, "warmstart": robots.warmstart, "place": self._place}
        return {
            "made": (self.env, self.batch, self._threads),
            "kept": {name: array.copy() for name, array in arrays.items()},
            "running": self.running.copy(),
        }

    def __setstate__(self, pickled: dict[str, Any]) -> None:
        self.__init__(*pickled["made"])
        self.restore(**pickled["kept"])
        self.running[:] = pickled["running"]

    def _measured(self) -> np.ndarray:
        """(B, 1 or 2) positions whose displacement is the speed."""
        return (self._robots.torso if self.env.ant else self._robots.qpos[:, :1]).copy()

    def state(self) -> np.ndarray:
        """(B, S) float64 global states."""
        first = 2 if self.env.ant else 1
        return np.concatenate([self._robots.qpos[:, first:], self._robots.qvel], 1)

    def observe(self) -> Seen:
        """What policies see, in single precision."""
        state = self.state().astype(np.float32)
        return Seen(state[:, self.env.observed], state)

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
        velocity = (place - self._place) / DT
        self._place = place
        speed = np.linalg.norm(velocity, axis=1)
        effort = (action**2).sum((1, 2))
        if self.env.ant:
            reward = velocity[:, 0] + 1.0 - 0.5 * effort
        else:
            reward = velocity[:, 0] - 0.1 * effort
        on = self.running.copy()
        sound = self._sound()
        self.running &= sound
        cost = (speed > self.env.limit).astype(np.float64)
        return Outcome(
            reward=np.where(on, reward, 0.0),
            cost=np.where(on, cost, 0.0),
            terminated=on & ~sound,
            shown=on,
            info={"speed": np.where(on, speed, 0.0)},
        )

    def _sound(self) -> np.ndarray:
        """(B,) bool: not fallen."""
        if not self.env.ant:
            return np.ones(self.batch, bool)
        height = self._robots.qpos[:, 2]
        lowest, highest = HEALTHY_Z
        return np.isfinite(self.state()).all(1) & (height >= lowest) & (height <= highest)


def _mujoco() -> Any:
    """MuJoCo, whose stubs lack what its extension defines."""
    with needs("sim", "Robots"):
        import mujoco

    return mujoco


class _Batch:
    """MuJoCo's own batched stepping (3.17 and later)."""

    def __init__(self, model: Any, batch: int, threads: int):
        from mujoco.batch import Batch

        self._batch: Any = Batch(model, batch, threads)
        self.qpos: np.ndarray = self._batch.bind("qpos")
        self.qvel: np.ndarray = self._batch.bind("qvel")
        self.warmstart: np.ndarray = self._batch.bind("qacc_warmstart")
        self._ctrl: np.ndarray = self._batch.bind("ctrl")
        self._xpos: np.ndarray = self._batch.bind("xpos")

    @property
    def torso(self) -> np.ndarray:
        return self._xpos[:, 1, :2]

    def place(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, warmstart: np.ndarray) -> None:
        self._batch.reset(ids=ids, stage=0)
        self.qpos[ids] = qpos
        self.qvel[ids] = qvel
        self._batch.forward(ids=ids)
        self.warmstart[ids] = warmstart

    def advance(self, ctrl: np.ndarray, live: np.ndarray) -> None:
        if len(live):
            self._ctrl[:] = ctrl
            self._batch.step(ids=live, nstep=FRAME_SKIP)


class _Loop:
    """One MjData per robot, stepped by a pool of threads; MuJoCo releases the interpreter while it works."""

    def __init__(self, model: Any, batch: int, threads: int):
        self._mujoco = _mujoco()
        self._model = model
        self._data = [self._mujoco.MjData(model) for _ in range(batch)]
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self.qpos = np.zeros((batch, model.nq))
        self.qvel = np.zeros((batch, model.nv))
        self.torso = np.zeros((batch, 2))

    @property
    def warmstart(self) -> np.ndarray:
        return np.stack([data.qacc_warmstart for data in self._data])

    def place(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, warmstart: np.ndarray) -> None:
        for row, k in enumerate(ids):
            data = self._data[k]
            self._mujoco.mj_resetData(self._model, data)
            data.qpos[:] = qpos[row]
            data.qvel[:] = qvel[row]
            self._mujoco.mj_forward(self._model, data)
            data.qacc_warmstart[:] = warmstart[row]
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
            list(self._pool.map(run, np.array_split(live, self._threads)))

    def _read(self, k: int) -> None:
        data = self._data[k]
        self.qpos[k] = data.qpos
        self.qvel[k] = data.qvel
        self.torso[k] = data.xpos[1, :2]


def views(view: str, env: SafeMuJoCo) -> FeatureMap:
    """The views of one robot whose joints are shared out: torso, own joints, others' joints."""
    if view == "centralized":
        table = np.tile(np.arange(len(env.state_names)), (env.n_agents, 1))
        return _body(view, env.state_names, "state", table, origin=table)
    if view == "decentralized":
        names = _observed_names(env)
        table = np.tile(np.arange(len(names)), (env.n_agents, 1))
        return _body(view, names, "observations", table, origin=env.observed)
    if view == "pruned":
        return _pruned(env)
    raise unknown("view", view, VIEWS)


def _body(view: str, names: tuple[str, ...], source: Source, table: np.ndarray, origin: np.ndarray) -> FeatureMap:
    """A map of agents that are limbs of one body, whose entries are those of the source as they are."""
    minus = np.full_like(table, -1)
    return FeatureMap(view, names, source, table, minus, shared_body=True, joint=True, origin=origin)


def _observed_names(env: SafeMuJoCo) -> tuple[str, ...]:
    """Entries of an agent's observation, as any of the agents names them."""
    seen = env.observation_names
    own = {f"{env.joints[k]}.{c}": f"own.joint{p}.{c}" for p, k in enumerate(env.own_joints[0]) for c in "qv"}
    neighbours = [name for name in seen if name not in own and not name.startswith("torso.")]
    near = {name: f"near{k}.q" for k, name in enumerate(neighbours)}
    return tuple((own | near).get(name, name) for name in seen)


def _pruned(env: SafeMuJoCo) -> FeatureMap:
    """Torso, own joints, others' joints, which are where their owners plan to have them."""
    n, joints = env.own_joints.shape
    at = {name: k for k, name in enumerate(env.state_names)}
    torso = [name for name in env.state_names if name.startswith("torso.")]
    whose = ["own", *(f"other{j}" for j in range(n - 1))]
    names = [*torso, *(f"{who}.joint{k}.{c}" for who in whose for k in range(joints) for c in "qv")]
    rows = []
    for i, others_of in enumerate(others(n)):
        moved = [env.joints[k] for agent in (i, *others_of) for k in env.own_joints[agent]]
        rows.append([at[name] for name in torso] + [at[f"{joint}.{c}"] for joint in moved for c in "qv"])
    table = np.array(rows)
    own = tuple(range(len(torso) + 2 * joints))
    plain = _body("pruned", tuple(names), "state", table, origin=table)
    return replace(plain, own=own, reconcile=_reconcile_shared(len(torso), 2 * joints, n))


@cache
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
