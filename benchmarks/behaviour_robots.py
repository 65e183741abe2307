"""Trains behaviour policies of the robots on the native simulator, and chooses those that the package ships.

The learner reads the global state in its critic, which one team needs once, since everybody has the same reward.

    python benchmarks/behaviour_robots.py train 2x3 --seed 0 --out runs/behaviour    # half an hour to an hour
    python benchmarks/behaviour_robots.py pack 2x3 runs/behaviour/2x3-0              # the files that are shipped
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.datasets import matd3
from ringfence.datasets.behaviour import POLICIES, BehaviourPolicy, save_behaviour
from ringfence.datasets.matd3 import Learner, MATD3Config, Mlp, Transitions
from ringfence.datasets.recipes.robots import Numbers, choose, file_of
from ringfence.envs.base import Memoryless, rollout, split_off
from ringfence.envs.mujoco import Parts, SafeMuJoCo, Simulation
from ringfence.errors import CheckpointError, UserError
from ringfence.types import Array, Key

COMMAND = "python benchmarks/behaviour_robots.py"
# Mean returns of OG-MARL's sets (Formanek et al. 2023).
LEVELS: dict[Parts, dict[str, float]] = {
    "2x3": {"good": 6924.0, "medium": 1485.0, "poor": 400.0},
    "2x4": {"good": 2620.0, "medium": 1100.0, "poor": 440.0},
    "4x2": {"good": 2770.0, "medium": 1550.0, "poor": 540.0},
}
TIERS = ("good", "medium", "poor")
MIXED = 4  # policies per tier
NOISE = 0.2  # std of the Gaussian noise on their actions


@dataclass(frozen=True)
class RobotsConfig:
    """How long a behaviour policy is trained, and on what."""

    learner: MATD3Config = MATD3Config(
        hidden=128,  # small actors, since they are shipped
        critic_hidden=256,
        batch=128,
        actor_rate=1e-3,
        critic_rate=1e-3,
        discount=0.99,
        polyak=0.005,
        noise=0.1,
        reward_scale=1.0,
        logit_penalty=1e-3,
    )
    robots: int = 16  # stepped side by side
    stretch: int = 16  # steps of each between two bouts of learning
    updates: int = 64  # critic updates per bout
    random_steps: int = 10_000  # transitions with uniform actions at the start
    transitions: int = 2_000_000  # at most
    score_every: int = 40  # bouts between two scores
    score_episodes: int = 8
    averaged: float = 0.0  # of the actors, per bout: snapshots are of the average (0: of the actors as they are)

    @property
    def per_bout(self) -> int:
        """Transitions of a bout."""
        return self.robots * self.stretch

    @property
    def bouts(self) -> int:
        return self.transitions // self.per_bout


def config_for(env: SafeMuJoCo) -> RobotsConfig:
    """The Ant falls, so it learns under the noise of collection, and its snapshots are of averages, which fall less."""
    config = RobotsConfig()
    if not env.ant:
        return config
    return replace(config, learner=replace(config.learner, noise=NOISE), averaged=0.98)


class Memory(NamedTuple):
    """Everything the learner has seen, with room for M transitions."""

    state: Numbers  # (M, S)
    action: Numbers  # (M, N, A)
    reward: Numbers  # (M,)
    terminated: Numbers  # (M,)
    after: Numbers  # (M, S)


class Snapshot(NamedTuple):
    """An actor and what it earns."""

    actors: Mlp
    seen: int  # transitions
    score: float  # mean return with the noise of collection


@partial(jax.jit, static_argnums=(0, 1), donate_argnums=(2, 3))
def learn(
    config: RobotsConfig,
    env: SafeMuJoCo,
    learner: Learner,
    memory: Memory,
    fresh: Memory,
    at: int | Array,
    key: Key,
) -> tuple[Learner, Memory]:
    """Put fresh transitions into the memory at row `at` and make a bout of updates."""
    memory = jax.tree.map(lambda all, new: jax.lax.dynamic_update_slice_in_dim(all, new, at, 0), memory, fresh)
    stored = at + len(fresh.reward)

    def one(learner: Learner, xs) -> tuple[Learner, None]:
        index, key = xs
        key_rows, key_noise = jax.random.split(key)
        rows = jax.random.randint(key_rows, (config.learner.batch,), 0, stored)
        state, action, reward, terminated, after = (jnp.asarray(x)[rows] for x in memory)
        batch = Transitions(
            observations=state[:, env.observed],
            seen=state,
            actions=action,
            rewards=reward[:, None],
            terminated=terminated,
            next_observations=after[:, env.observed],
            next_seen=after,
        )
        return matd3.update(config.learner, learner, batch, index % config.learner.delay == 0, key_noise), None

    steps = (jnp.arange(config.updates), jax.random.split(key, config.updates))
    return jax.lax.scan(one, learner, steps)[0], memory


class Trainer:
    """A learner at work on a batch of robots."""

    def __init__(self, env: SafeMuJoCo, config: RobotsConfig, seed: int):
        self.env = env
        self.config = config
        self.seed = seed
        self.sim = env.simulate(config.robots)
        self.rng = np.random.default_rng(seed)
        self.key, key_init = jax.random.split(jax.random.key(seed))
        self.memory = _empty_memory(env, config.bouts * config.per_bout)
        states = len(env.state_names)
        self.learner = matd3.init(
            config.learner, key_init, env.n_agents, env.observation_dim, states, env.action_dim, team=True
        )
        self.average = jax.tree.map(np.array, self.learner.actors)
        self.begun = config.robots  # episodes
        self.age = np.zeros(config.robots, int)  # steps of the episodes under way
        self.sim.reset([(seed, episode) for episode in range(config.robots)])

    def bout(self, number: int) -> None:
        """A stretch of steps of every robot, then updates."""
        seen = number * self.config.per_bout
        fresh = self._explore(uniform=seen < self.config.random_steps)
        self.key, key = jax.random.split(self.key)
        self.learner, self.memory = learn(self.config, self.env, self.learner, self.memory, fresh, seen, key)
        share = self.config.averaged
        self.average = jax.tree.map(
            lambda old, new: share * old + (1 - share) * np.asarray(new), self.average, self.learner.actors
        )

    def _explore(self, uniform: bool) -> Memory:
        """Transitions of a stretch of steps."""
        rows = []
        for _ in range(self.config.stretch):
            state = self.sim.state().astype(np.float32)
            action = self._action(state, uniform)
            outcome = self.sim.step(action)
            reward = outcome.reward.astype(np.float32)
            rows.append((state, action, reward, outcome.terminated, self.sim.state().astype(np.float32)))
            self.age += 1
            self._begin_again(outcome.terminated | (self.age >= self.env.episode_length))
        return Memory(*(np.concatenate(column) for column in zip(*rows)))

    def _action(self, state: np.ndarray, uniform: bool) -> np.ndarray:
        if uniform:
            shape = (self.config.robots, self.env.n_agents, self.env.action_dim)
            return self.rng.uniform(-1, 1, shape).astype(np.float32)
        self.key, key = jax.random.split(self.key)
        observations = self.sim.observe().observations
        return np.asarray(choose(self.learner.actors, observations, self.config.learner.noise, key))

    def _begin_again(self, over: np.ndarray) -> None:
        """New episodes of the robots whose episode is `over` (B,)."""
        robots = np.flatnonzero(over)
        if not len(robots):
            return
        self.sim.reset([(self.seed, self.begun + k) for k in range(len(robots))], robots)
        self.begun += len(robots)
        self.age[robots] = 0


def _empty_memory(env: SafeMuJoCo, size: int) -> Memory:
    states = len(env.state_names)
    return Memory(
        state=jnp.zeros((size, states)),
        action=jnp.zeros((size, env.n_agents, env.action_dim)),
        reward=jnp.zeros(size),
        terminated=jnp.zeros(size, bool),
        after=jnp.zeros((size, states)),
    )


def train(
    env: SafeMuJoCo,
    config: RobotsConfig,
    seed: int,
    progress: Callable[[Snapshot], None] | None = None,
    enough: float = np.inf,
) -> list[Snapshot]:
    """Train from scratch; a snapshot every `score_every` bouts, with the return it earns under noise 0.2. Ends early
    when the last four earn `enough` on average."""
    trainer = Trainer(env, config, seed)
    judge = env.simulate(config.score_episodes)
    snapshots: list[Snapshot] = []
    for number in range(config.bouts):
        trainer.bout(number)
        done = number + 1
        if done % config.score_every and done < config.bouts:
            continue
        score = float(returns(env, trainer.average, judge, seed).mean())
        snapshots.append(Snapshot(trainer.average, done * config.per_bout, score))
        if progress is not None:
            progress(snapshots[-1])
        latest = [s.score for s in snapshots[-MIXED:]]
        if len(latest) == MIXED and np.mean(latest) > enough:
            break
    return snapshots


def returns(env: SafeMuJoCo, actors: Mlp, sim: Simulation, seed: int, noise: float = NOISE) -> np.ndarray:
    """(B,) returns of an episode of every robot."""
    rewards: list[np.ndarray] = []
    explorer = Memoryless(lambda observations, state, key: choose(actors, observations, noise, key))
    keys = itertools.islice(split_off(jax.random.key(seed + 1)), env.episode_length)
    sim.reset([(seed, 10**6 + episode) for episode in range(sim.batch)])
    rollout(explorer, sim, lambda now: rewards.append(now.outcome.reward), keys)
    return np.sum(rewards, 0)


def pack(env: SafeMuJoCo, runs: list[Path], folder: Path = POLICIES, tiers: tuple[str, ...] = TIERS) -> dict[str, dict]:
    """Choose the policies of the tiers among the snapshots of `runs` and write their files; returns their cards.

    The runs take turns: of each, the snapshot whose return is nearest to the tier's level, then the next nearest, as
    long as it is within a tenth of it. Returns are of 32 episodes of the policy as it is stored, in half precision.
    """
    judge = env.simulate(32)
    cards = {}
    for tier in tiers:
        level = LEVELS[env.parts][tier]
        candidates = [candidate for run in runs for candidate in _nearest(env, judge, run, level)]
        chosen = _in_turns(candidates, level)[:MIXED]
        if len(chosen) < MIXED:
            raise CheckpointError(
                f"The runs hold {len(chosen)} snapshots for '{tier}', {MIXED} are needed; train more."
            )
        cards[tier] = {
            "task": env.name,
            "level": tier,
            "published_level": level,
            "policies": [{"run": c.run, "transitions": c.seen, "return": round(c.earned, 1)} for c in chosen],
            "command": f"{COMMAND} pack {env.parts}",
        }
        actors = jax.tree.map(lambda *x: jnp.stack(x), *(c.actors for c in chosen))
        save_behaviour(BehaviourPolicy(actors, NOISE, cards[tier]), folder / file_of(env, tier), np.float16)
    return cards


class Candidate(NamedTuple):
    """A snapshot as it would be stored."""

    rank: int  # among those of its run, 0 is nearest to the level
    run: str
    seen: int
    earned: float
    actors: Mlp


def _in_turns(found: list[Candidate], level: float) -> list[Candidate]:
    """Those within a tenth of the level, one of every run in turn, then the others, the nearest first."""

    def place(candidate: Candidate) -> tuple[bool, int, float]:
        gap = abs(candidate.earned - level)
        return (False, candidate.rank, gap) if gap <= 0.1 * level else (True, 0, gap)

    return sorted(found, key=place)


def _nearest(env: SafeMuJoCo, judge: Simulation, run: Path, level: float) -> list[Candidate]:
    """The snapshots of a run that come nearest to a level: picked by the scores of training, which are rough, and
    judged again; of a run that never came near, the nearest few."""
    rough = sorted(_scores(run), key=lambda s: abs(s["score"] - level))
    close = sum(abs(s["score"] - level) <= 0.3 * level for s in rough)
    rough = rough[: min(max(close, MIXED), 2 * MIXED)]
    judged = []
    for s in rough:
        actors = _halved(_load_snapshot(run / f"{s['seen']:07d}.npz"))
        judged.append((float(returns(env, actors, judge, 1).mean()), s["seen"], actors))
    judged.sort(key=lambda x: (abs(x[0] - level), x[1]))
    return [Candidate(k, run.name, seen, earned, actors) for k, (earned, seen, actors) in enumerate(judged)]


def keep(snapshot: Snapshot, run: Path, seconds: float) -> None:
    """Add a snapshot to a run folder: its actors, and a line of scores.jsonl."""
    run.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {f"w{k}": weights for k, weights in enumerate(snapshot.actors.weights)}
    arrays |= {f"b{k}": biases for k, biases in enumerate(snapshot.actors.biases)}
    np.savez(run / f"{snapshot.seen:07d}.npz", **arrays)
    line = {"seen": snapshot.seen, "score": round(snapshot.score, 1), "seconds": round(seconds, 1)}
    with open(run / "scores.jsonl", "a") as f:
        f.write(json.dumps(line) + "\n")


def _scores(run: Path) -> list[dict]:
    file = run / "scores.jsonl"
    if not file.exists():
        raise CheckpointError(f"'{file}' does not exist; give a folder that `{COMMAND} train` made.")
    return [json.loads(line) for line in file.read_text().splitlines()]


def _load_snapshot(file: Path) -> Mlp:
    with np.load(file) as arrays:
        layers = range(sum(name.startswith("w") for name in arrays))
        return Mlp(
            weights=tuple(jnp.asarray(arrays[f"w{k}"]) for k in layers),
            biases=tuple(jnp.asarray(arrays[f"b{k}"]) for k in layers),
        )


def _halved(actors: Mlp) -> Mlp:
    return jax.tree.map(lambda x: x.astype(jnp.float16).astype(jnp.float32), actors)


def main() -> None:
    """Train a behaviour learner and keep its snapshots, or choose those that are shipped."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    what = parser.add_subparsers(dest="what", required=True)
    trained = what.add_parser("train")
    trained.add_argument("parts", choices=tuple(LEVELS))
    trained.add_argument("--seed", type=int, default=0)
    trained.add_argument("--transitions", type=int, default=RobotsConfig.transitions)
    trained.add_argument("--noise", type=float, help="std of the exploration noise, if it is to be another")
    trained.add_argument("--averaged", type=float, help="decay of the average that snapshots are of, likewise")
    trained.add_argument("--level", choices=TIERS, default="good", help="end when this tier's level is passed")
    trained.add_argument("--out", type=Path, default=Path("runs/behaviour"))
    packed = what.add_parser("pack")
    packed.add_argument("parts", choices=tuple(LEVELS))
    packed.add_argument("runs", type=Path, nargs="+")
    packed.add_argument("--tiers", nargs="+", choices=TIERS, default=TIERS)
    packed.add_argument("--out", type=Path, default=POLICIES)
    given = parser.parse_args()
    try:
        _run(given)
    except UserError as error:
        parser.exit(2, f"error: {error}\n")


def _run(given: argparse.Namespace) -> None:
    env = SafeMuJoCo(given.parts)
    if given.what == "pack":
        for tier, card in pack(env, given.runs, given.out, tuple(given.tiers)).items():
            print(tier, json.dumps(card["policies"]))
        return
    config = replace(config_for(env), transitions=given.transitions)
    if given.noise is not None:
        config = replace(config, learner=replace(config.learner, noise=given.noise))
    if given.averaged is not None:
        config = replace(config, averaged=given.averaged)
    _train_and_keep(env, config, given.seed, given.level, given.out)


def _train_and_keep(env: SafeMuJoCo, config: RobotsConfig, seed: int, level: str, out: Path) -> None:
    folder = out / f"{env.parts}-{seed}"
    begun = time.perf_counter()
    if folder.exists():
        raise UserError(f"'{folder}' exists already; delete it or give another --seed or --out.")
    if config.bouts < 1:
        raise UserError(
            f"--transitions {config.transitions} holds no bout of learning; give {config.per_bout} or more."
        )
    enough = 1.03 * LEVELS[env.parts][level]

    def progress(snapshot: Snapshot) -> None:
        keep(snapshot, folder, time.perf_counter() - begun)
        print(f"{snapshot.seen:,} transitions, {snapshot.score:.0f}", flush=True)

    train(env, config, seed, progress, enough)


if __name__ == "__main__":
    main()
