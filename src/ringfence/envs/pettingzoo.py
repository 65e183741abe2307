"""The simulators behind PettingZoo's parallel API, over the same cores as the vectorised ones.

For tools that expect one environment and dictionaries of agents. Rollouts of many episodes should use
`ringfence.envs.SimpleSpread` and `SafeMuJoCo` directly: they are orders of magnitude faster.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from ringfence.envs.crossing import Crossing
from ringfence.envs.mujoco import SafeMuJoCo
from ringfence.envs.simple_spread import AGENT_RADIUS, CONTACT_DISTANCE, SimpleSpread, SpreadAlike
from ringfence.errors import UserError, needs

with needs("sim", "Simulators behind PettingZoo's API"):
    from gymnasium import spaces
    from pettingzoo import ParallelEnv

LANDMARK_RADIUS = 0.05
FRAME_SIZE = 480  # pixels, both sides

Infos = dict[str, dict[str, float]]
Reset = tuple[dict[str, np.ndarray], Infos]
Step = tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], Infos]


def parallel_env(render_mode: str | None = None, **options: Any) -> SimpleSpreadParallel:
    """A `SimpleSpreadParallel`; `options` are the fields of `SimpleSpread` (n_agents, integrator, reward, ...)."""
    return SimpleSpreadParallel(render_mode=render_mode, **options)


class _Parallel(ParallelEnv):
    """Agents `agent_0` .. `agent_{N-1}` of a simulator `core`, and their spaces."""

    def __init__(self, core: Any, kind: type):
        names = [f"agent_{i}" for i in range(core.n_agents)]
        seen = (core.observation_dim,)
        self.core = core
        self.possible_agents = names
        self.agents: list[str] = []
        self._steps = 0
        # One object per agent, made once: the API demands identity, so that seeding a space lasts.
        self.observation_spaces = {agent: spaces.Box(-np.inf, np.inf, seen, kind) for agent in names}
        self.action_spaces = {agent: spaces.Box(-1.0, 1.0, (core.action_dim,), np.float32) for agent in names}
        self.state_space = spaces.Box(-np.inf, np.inf, (len(core.state_names),), kind)

    def observation_space(self, agent: str) -> spaces.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        return self.action_spaces[agent]

    def close(self) -> None:
        """Nothing to release."""

    def _begun(self, infos: Infos) -> Reset:
        """What `reset` gives."""
        self._steps = 0
        self.agents = self.possible_agents[:]
        return self._observations(), infos

    def _stepped(self, reward: np.ndarray, terminated: bool, infos: Infos) -> Step:
        """What `step` gives, by rewards (N,)."""
        self._steps += 1
        agents = self.agents
        over = bool(self._steps >= self.core.episode_length)
        if over or terminated:
            self.agents = []
        rewards = {agent: float(r) for agent, r in zip(agents, reward)}
        return self._observations(), rewards, dict.fromkeys(agents, terminated), dict.fromkeys(agents, over), infos

    def _observations(self) -> dict[str, np.ndarray]:
        raise NotImplementedError


class _Plane(_Parallel):
    """A pure simulator `core` of agents who push themselves about in the plane. Observations are float32 (O,), actions
    (2,) in [-1, 1] (clipped), rewards floats. Every agent's info carries `cost` and `clearance` (m). Episodes are
    truncated at `episode_length` and never terminate."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, core: Any, render_mode: str | None):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserError(f"There is no render_mode='{render_mode}'; use 'rgb_array', or None to draw nothing.")
        super().__init__(core, np.float32)
        self.render_mode = render_mode
        self._key: jax.Array | None = None
        self._state: Any = None
        self._reset = jax.jit(lambda key: core.reset(key, 1))
        self._step = jax.jit(core.step)
        self._observe = jax.jit(core.observe)

    def reset(self, seed: int | None = None, options: dict | None = None) -> Reset:
        """Start an episode; a seed fixes this and all later episodes. `options` is accepted and ignored."""
        if seed is not None or self._key is None:
            # Without a seed the first episode is drawn from the system's entropy, as Gymnasium's environments do.
            entropy = np.random.SeedSequence().generate_state(1)[0] if seed is None else seed
            self._key = jax.random.key(int(entropy))
        self._key, key = jax.random.split(self._key)
        self._state = self._reset(key)
        return self._begun(self._infos(np.zeros(1)))

    def step(self, actions: dict[str, Any]) -> Step:
        """Advance by 0.1 s with one action (2,) per agent."""
        joint = _joint(self.agents, actions)
        if joint.shape[2:] != (2,) or not np.isfinite(joint).all():
            raise UserError(f"step() got actions {dict(actions)}; give every agent two finite numbers, its push.")
        self._state, transition = self._step(self._state, joint)
        return self._stepped(np.asarray(transition.reward)[0], False, self._infos(np.asarray(transition.cost[0])))

    def state(self) -> np.ndarray:
        """(S,) float32; see the simulator's `state_names`."""
        if self._state is None:
            raise UserError("There is no state before the first episode; call reset() first.")
        return np.asarray(self.core.global_state(self._state)[0], np.float32)

    def _observations(self) -> dict[str, np.ndarray]:
        observations = np.asarray(self._observe(self._state)[0], np.float32)
        return dict(zip(self.possible_agents, observations))

    def _infos(self, cost: np.ndarray) -> Infos:
        """Costs () of the team, or (N,) of each agent."""
        costs = np.broadcast_to(cost, len(self.possible_agents))
        facts = zip(self.possible_agents, costs, self._clearance())
        return {agent: {"cost": float(cost), "clearance": float(clearance)} for agent, cost, clearance in facts}

    def _clearance(self) -> np.ndarray:
        """(N,) m to what an agent must not touch."""
        raise NotImplementedError


class SimpleSpreadParallel(_Plane):
    """Simple Spread as `agent_0` .. `agent_{N-1}`: actions are force directions, `cost` is shared by the team,
    `clearance` the own smallest centre distance to another agent minus 0.30 (infinite for a single agent)."""

    metadata = {**_Plane.metadata, "name": "ringfence_simple_spread"}
    simulator: type = SimpleSpread

    def __init__(self, render_mode: str | None = None, **options: Any):
        super().__init__(self.simulator(**options), render_mode)

    def render(self) -> np.ndarray | None:
        """(480, 480, 3) uint8 for render_mode "rgb_array": agents blue, in contact red, landmarks grey."""
        if self.render_mode is None or self._state is None:
            return None
        position = np.asarray(self._state.position[0])
        landmarks = np.asarray(self._state.landmarks[0])
        touching = self._clearance() < 0
        # Zoom out rather than lose an agent that leaves the arena.
        extent = max(1.15 * self.core.half_width, float(np.abs(position).max()) + 2 * AGENT_RADIUS)
        axis = (np.arange(FRAME_SIZE) + 0.5) / FRAME_SIZE * 2 * extent - extent
        x = axis[None, :]
        y = -axis[:, None]  # it points up
        frame = np.full((FRAME_SIZE, FRAME_SIZE, 3), 255, np.uint8)
        for place in landmarks:
            frame[(x - place[0]) ** 2 + (y - place[1]) ** 2 < LANDMARK_RADIUS**2] = (90, 90, 90)
        for place, bad in zip(position, touching):
            colour = np.array((200, 60, 50) if bad else (70, 100, 200))
            inside = (x - place[0]) ** 2 + (y - place[1]) ** 2 < AGENT_RADIUS**2
            frame[inside] = (0.25 * frame[inside] + 0.75 * colour).astype(np.uint8)  # landmarks show through
        return frame

    def _clearance(self) -> np.ndarray:
        """(N,) smallest centre distance to another agent minus 0.30."""
        position = np.asarray(self._state.position[0])
        distance = np.linalg.norm(position[:, None] - position[None], axis=-1)
        np.fill_diagonal(distance, np.inf)
        return distance.min(1) - CONTACT_DISTANCE


class SpreadAlikeParallel(SimpleSpreadParallel):
    """The same in views of homogeneous agents, any number of them; `cost` is each agent's own."""

    metadata = {**_Plane.metadata, "name": "ringfence_spread_alike"}
    simulator = SpreadAlike


class CrossingParallel(_Plane):
    """Crossing as `agent_0` .. `agent_{N-1}`: `cost` is each agent's own, `clearance` the distance from its rim to
    what it must not touch."""

    metadata = {**_Plane.metadata, "name": "ringfence_crossing"}

    def __init__(self, render_mode: str | None = None, **options: Any):
        super().__init__(Crossing(**options), render_mode)

    def render(self) -> np.ndarray | None:
        """(480, 480, 3) uint8 for render_mode "rgb_array"; who touches is red."""
        if self.render_mode is None or self._state is None:
            return None
        now = np.asarray(self.core.global_state(self._state))
        return np.asarray(next(self.core.frames(now, [(0, False)])))

    def _clearance(self) -> np.ndarray:
        return np.asarray(self.core.clearance(self._state)[0])


class SafeMuJoCoParallel(_Parallel):
    """A robot of `SafeMuJoCo` as `agent_0` .. `agent_{N-1}`.

    Observations are float64 (O,), actions torques in [-1, 1]^A (clipped), rewards shared. Every agent's info carries
    `cost` (1 where the step's speed exceeded the limit), `speed` and `clearance` (limit minus speed, m/s).
    """

    metadata = {"render_modes": [], "name": "ringfence_safe_mujoco"}

    def __init__(self, render_mode: None = None, **options: Any):
        if render_mode is not None:
            raise UserError(f"There is no render_mode='{render_mode}' of robots; `ringfence eval --video` films them.")
        self.render_mode = None
        super().__init__(SafeMuJoCo(**options), np.float64)
        self._sim = self.core.simulate(1, threads=1)
        self._seeds: np.random.SeedSequence | None = None

    def reset(self, seed: int | None = None, options: dict | None = None) -> Reset:
        """Start an episode; a seed fixes this one, as in safety-gymnasium, and all later ones."""
        if seed is not None and seed < 0:
            raise UserError(f"reset() got seed={seed}; pass one of 0 or more, or None.")
        if seed is not None or self._seeds is None:
            self._seeds = np.random.SeedSequence(seed)
            start = self._seeds.entropy
            assert start is not None, "NumPy draws it where no seed is given"
        else:
            start = self._seeds.spawn(1)[0].generate_state(4).tolist()
        self._sim.reset([start])
        return self._begun(self._infos(cost=0.0, speed=0.0))

    def step(self, actions: dict[str, Any]) -> Step:
        """Advance by 0.05 s with one action (A,) per agent."""
        out = self._sim.step(_joint(self.agents, actions))
        infos = self._infos(cost=float(out.cost[0]), speed=float(out.info["speed"][0]))
        return self._stepped(np.broadcast_to(out.reward, self.core.n_agents), bool(out.terminated[0]), infos)

    def state(self) -> np.ndarray:
        """(S,) see `SafeMuJoCo.state_names`."""
        if self._seeds is None:
            raise UserError("There is no state before the first episode; call reset() first.")
        return self._sim.state()[0]

    def render(self) -> None:
        """Draws nothing; videos come from the report."""

    def _observations(self) -> dict[str, np.ndarray]:
        return dict(zip(self.possible_agents, self._sim.state()[0, self.core.observed]))

    def _infos(self, cost: float, speed: float) -> Infos:
        """What one body did, for every agent."""
        return {
            agent: {"cost": cost, "speed": speed, "clearance": self.core.limit - speed}
            for agent in self.possible_agents
        }


def _joint(agents: list[str], actions: dict[str, Any]) -> np.ndarray:
    """(1, N, A) from one action per live agent."""
    if not agents:
        raise UserError("The episode is over or was never started; call reset() before step().")
    missing = [agent for agent in agents if agent not in actions]
    if missing:
        raise UserError(f"step() got no action for {', '.join(missing)}; pass one entry per live agent.")
    given = [np.asarray(actions[agent], np.float32) for agent in agents]
    shapes = [action.shape for action in given]
    if len(set(shapes)) > 1:
        raise UserError(f"step() got actions of several shapes, {', '.join(map(str, shapes))}; give one.")
    return np.stack(given)[None]
