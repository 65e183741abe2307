"""In a simulator that nobody here wrote: IR-SIM (package `ir-sim`, R. Han), omnidirectional robots with bounded
acceleration, its own integration and its own detection of contact.

    pip install ir-sim
    python benchmarks/other_simulator.py      # writes results/other_simulator.csv; half an hour

Three ways: cloning and World learned from `crossing-hasty`'s logs, played there; and logs recorded there, learned and
played like anybody's own: of robots that follow IR-SIM's reciprocal velocity obstacles and trust their brakes too much,
and of teams in which two of the eight make straight for their goals and look at nobody.
"""

from __future__ import annotations

import argparse
import logging
import os
import tempfile
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "Agg")

import irsim
import jax
import jax.numpy as jnp
import numpy as np
import yaml
from common import read, write

from ringfence import EpisodeStore, Separation
from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.envs.crossing import APART, DT, EFFORT, RADIUS, REACHED, Crossing, CrossingState
from ringfence.evaluation.play import play
from ringfence.training import loop, worlds

OUT = Path(__file__).resolve().parent.parent / "results" / "other_simulator.csv"
LENGTH = 100  # steps
BELIEVED = 2.0  # m/s² that robots of the logs count on; they have 1
LOOK = {n: jax.jit(Crossing(n_agents=n).observe) for n in (8, 16)}


class IrSim:
    """Crossing's room in IR-SIM, as a PettingZoo ParallelEnv. A push becomes the velocity that is commanded."""

    metadata: dict = {}

    def __init__(self, n: int = 8, behaviour: str | None = None, naive: int = 0):
        self.n, self.side = n, Crossing(n_agents=n).side
        self.possible_agents = [f"agent{i}" for i in range(n)]
        robots = {
            "number": n - naive,
            "kinematics": {"name": "omni"},
            "shape": {"name": "circle", "radius": RADIUS},
            "vel_max": [1.0, 1.0],
            "vel_min": [-1.0, -1.0],
            "acce": [1.0, 1.0],
            "distribution": {"name": "circle", "radius": self.side / 3, "center": [0, 0]},
        }
        if behaviour:
            robots["behavior"] = {"name": behaviour, "vxmax": 0.9, "vymax": 0.9, "acce": BELIEVED}
        groups = [robots] if not naive else [robots, robots | {"number": naive, "behavior": {"name": "dash"}}]
        size = 10 * self.side  # far enough that nobody meets its walls
        world = {"height": size, "width": size, "offset": [-size / 2, -size / 2], "step_time": DT, "sample_time": DT}
        with tempfile.NamedTemporaryFile("w", suffix=".yaml", delete=False) as file:
            yaml.safe_dump({"world": world | {"collision_mode": "unobstructed"}, "robot": groups}, file)
        self.sim = irsim.make(file.name, display=False, disable_all_plot=True, log_level="CRITICAL")
        os.unlink(file.name)
        self.velocity = np.zeros((n, 2))

    @property
    def robots(self) -> list:
        return self.sim.robot_list

    def reset(self, seed: int | None = None, options=None):
        self.rng, self.t = np.random.default_rng(seed), 0
        across = int(np.ceil(np.sqrt(self.n)))
        cells = self.rng.permutation(across**2)[: self.n]
        cell = self.side / across
        corner = np.stack(np.divmod(cells, across), -1) * cell - self.side / 2
        jitter = max(cell / 2 - RADIUS - 0.05, 0.0) * self.rng.uniform(-1, 1, (self.n, 2))
        self.place, self.velocity = corner + cell / 2 + jitter, np.zeros((self.n, 2))
        self.goal = np.array([self._new_goal(p) for p in self.place])
        for robot, p, g in zip(self.robots, self.place, self.goal):
            robot.reset()
            robot.set_state([*p, 0.0], init=True)
            robot.set_goal([*g, 0.0])
        self.sim.step([np.zeros((2, 1))] * self.n)  # contacts are found when time passes
        return self._seen(), {a: {} for a in self.possible_agents}

    def step(self, actions: dict | None):
        """Pushes (2,) by agent; None: robots follow the behaviour of their own."""
        before = np.linalg.norm(self.goal - self.place, axis=-1)
        push = None
        if actions is None:
            self.sim.step()
        else:
            push = np.stack([actions[a] for a in self.possible_agents])
            push = push / np.maximum(np.linalg.norm(push, axis=-1, keepdims=True), 1.0)
            wanted = self.velocity + DT * push
            wanted = wanted / np.maximum(np.linalg.norm(wanted, axis=-1, keepdims=True), 1.0)
            self.sim.step([w[:, None] for w in wanted])
        place = np.stack([r.state[:2, 0] for r in self.robots])
        velocity = (place - self.place) / DT
        if push is None:  # what it took
            push = (velocity - self.velocity) / DT
        self.place, self.velocity, self.push = place, velocity, push
        after = np.linalg.norm(self.goal - self.place, axis=-1)
        reward = before - after - EFFORT * (push**2).sum(-1)
        touching = [bool(r.collision_flag) for r in self.robots]
        for i in np.flatnonzero(after < REACHED):
            self.goal[i] = self._new_goal(self.place[i])
            self.robots[i].set_goal([*self.goal[i], 0.0])
        self.t += 1
        names, over = self.possible_agents, self.t >= LENGTH
        infos = {a: {"cost": float(c)} for a, c in zip(names, touching)}
        return self._seen(), dict(zip(names, reward)), dict.fromkeys(names, False), dict.fromkeys(names, over), infos

    def _new_goal(self, place: np.ndarray) -> np.ndarray:
        end = self.side / 2 - 2 * RADIUS
        tries = self.rng.uniform(-end, end, (20, 2))
        fine = np.linalg.norm(tries - place, axis=-1) >= min(APART, self.side / 2)
        return tries[int(fine.argmax())]

    def _seen(self) -> dict[str, np.ndarray]:
        arrays = (jnp.asarray(x, jnp.float32)[None] for x in (self.place, self.velocity, self.goal))
        place, velocity, goal = arrays
        zero = jnp.zeros((1, self.n))
        state = CrossingState(place, velocity, zero, goal, zero, jnp.zeros((1, 0, 3)))
        return dict(zip(self.possible_agents, np.asarray(LOOK[self.n](state))[0]))


def record(episodes: int, naive: int) -> EpisodeStore:
    """Logs of IR-SIM's robots under its reciprocal velocity obstacles, but for some; pushes are what their velocities
    did."""
    env, kept = IrSim(behaviour="rvo", naive=naive), {k: [] for k in ("observations", "actions", "rewards", "costs")}
    for e in range(episodes):
        seen, _ = env.reset(seed=e)
        rows = [list(seen.values())]
        steps = {k: [] for k in ("actions", "rewards", "costs")}
        for _ in range(LENGTH):
            seen, rewards, *_, infos = env.step(None)
            rows.append(list(seen.values()))
            steps["actions"].append(np.clip(env.push, -1, 1))
            steps["rewards"].append(list(rewards.values()))
            steps["costs"].append([i["cost"] for i in infos.values()])
        kept["observations"].append(rows)
        for k, v in steps.items():
            kept[k].append(v)
    card = {
        "task": f"irsim-rvo-{naive}-blind" if naive else "irsim-rvo",
        "provenance": "recorded in IR-SIM, robots under its reciprocal velocity obstacles"
        + (f" but for {naive} that make straight for their goals" if naive else ""),
        "simulator": f"ir-sim {irsim.__version__}",
        "observation_names": list(Crossing().observation_names),
        "hazard": Separation(0.30),
        "homogeneous": True,
    }
    return EpisodeStore.from_episodes(*(np.array(kept[k], np.float32) for k in kept), card=card)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=200, help="that are played, each way")
    parser.add_argument("--logs", type=int, default=600, help="episodes that are recorded")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--of", nargs="+", help="these sources alone, by their words; other rows stay as they are")
    a = parser.parse_args()
    logging.disable(logging.CRITICAL)
    mine = {f"{words}{more}" for words in a.of or () for more in ("", " themselves")}
    rows = [r for r in read(OUT) if a.of and r["learned from"] not in mine]

    def played(words: str, run, world, n: int, **guard) -> None:
        guarded = {} if not guard else {"world": world} | guard
        r = play(run, lambda: IrSim(n), episodes=a.episodes, agents=n, num_envs=50, **guarded)
        row = {"learned from": words, "agents": n, "guard": guard.get("guard", "none"), "seed": a.seed}
        row |= {"options": ", ".join(f"{k}={v}" for k, v in guard.items() if k != "guard")}
        row |= {"episodes": a.episodes, "return": round(r["return_mean"], 3), "steps with contact": r["cost_mean"]}
        row |= {"episodes with contact": r["violation_rate"], "bound": round(r["violation_upper"], 4)}
        rows.append(row)
        print(row, flush=True)
        write(OUT, rows)

    def recorded(words: str, naive: int) -> EpisodeStore:
        logs = record(a.logs, naive)
        rows.append(
            {
                "learned from": f"{words} themselves",
                "agents": 8,
                "guard": "none",
                "seed": a.seed,
                "options": "",
                "episodes": a.logs,
                "return": round(float(logs.returns.mean()), 3),
                "steps with contact": round(float(logs.episode_costs.mean()), 3),
                "episodes with contact": round(float((logs.episode_costs > 0).mean()), 4),
                "bound": "",
            }
        )
        print(rows[-1], flush=True)
        return logs

    sources = {
        "crossing-hasty": lambda words: make(registry.get("crossing-hasty"))[0],
        "logs of IR-SIM": lambda words: recorded(words, 0),
        "logs of IR-SIM, two of eight naive": lambda words: recorded(words, 2),
    }
    with tempfile.TemporaryDirectory() as folder:
        for words in a.of or sources:
            store = sources[words](words)
            world = worlds.fit(store, seed=a.seed, quiet=False)
            (run,) = loop.train("bc", store, seeds=(a.seed,), out=Path(folder), quiet=True)
            played(words, run, world, 8)
            for n in (8, 16):
                played(words, run, world, n, guard="shield", horizon=3, terminal_value=True)


if __name__ == "__main__":
    main()
