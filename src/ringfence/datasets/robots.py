"""Behaviour policies for the robots: MATD3 on the native simulator, its snapshots, and the collection of episodes.

OG-MARL's sets (Formanek et al. 2023) were made by training MATD3 to a level, rolling the policy out with Gaussian
noise of 0.2 on the actions, and mixing four such policies. The learner here reads the global state in its critic,
which one team needs once, since everybody has the same reward.

    python -m ringfence.datasets.robots train 2x3 --seed 0 --out runs/behaviour      # half an hour to an hour
    python -m ringfence.datasets.robots pack 2x3 runs/behaviour/2x3-0                # the files that are shipped
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.datasets import matd3
from ringfence.datasets.behaviour import POLICIES, BehaviourPolicy, load_behaviour, save_behaviour
from ringfence.datasets.matd3 import Learner, MATD3Config, Mlp, Transitions
from ringfence.envs.mujoco import SafeMuJoCo
from ringfence.errors import CheckpointError, UserError
from ringfence.types import Array, Key

COMMAND = "python -m ringfence.datasets.robots"
# Mean returns of OG-MARL's sets (Formanek et al. 2023).
LEVELS = {
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


def config_for(env: SafeMuJoCo) -> RobotsConfig:
    """The Ant falls, so it learns under the noise of collection, and its snapshots are of averages, which fall less."""
    config = RobotsConfig()
    return replace(config, learner=replace(config.learner, noise=NOISE), averaged=0.98) if env.ant else config


class Memory(NamedTuple):
    """Everything the learner has seen, with room for M transitions."""

    state: Array  # (M, S)
    action: Array  # (M, N, A)
    reward: Array  # (M,)
    terminated: Array  # (M,)
    after: Array  # (M, S)


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
    at: Array,
    key: Key,
) -> tuple[Learner, Memory]:
    """Put fresh transitions into the memory at row `at` and make a bout of updates."""
    memory = jax.tree.map(lambda all, new: jax.lax.dynamic_update_slice_in_dim(all, new, at, 0), memory, fresh)
    stored = at + len(fresh.reward)

    def one(learner: Learner, xs) -> tuple[Learner, None]:
        index, key = xs
        k_rows, k_noise = jax.random.split(key)
        rows = jax.random.randint(k_rows, (config.learner.batch,), 0, stored)
        m = Memory(*(x[rows] for x in memory))
        seen, later = m.state[:, env.observed], m.after[:, env.observed]
        batch = Transitions(seen, m.state, m.action, m.reward[:, None], m.terminated, later, m.after)
        return matd3.update(config.learner, learner, batch, index % config.learner.delay == 0, k_noise), None

    steps = jnp.arange(config.updates), jax.random.split(key, config.updates)
    return jax.lax.scan(one, learner, steps)[0], memory


@jax.jit
def choose(actors: Mlp, observations: Array, noise: Array, key: Key) -> Array:
    """(B, N, O) -> (B, N, A) with exploration noise."""
    return matd3.noisy(matd3.act(actors, observations), noise, key)


def train(
    env: SafeMuJoCo,
    config: RobotsConfig,
    seed: int,
    progress: Callable[[Snapshot], None] | None = None,
    enough: float = np.inf,
) -> list[Snapshot]:
    """Train from scratch; a snapshot every `score_every` bouts, with the return it earns under noise 0.2. Ends early
    when the last four earn `enough` on average."""
    b, n = config.robots, env.n_agents
    sim, judge = env.simulate(b), env.simulate(config.score_episodes)
    rng = np.random.default_rng(seed)
    key = jax.random.key(seed)
    s = len(env.state_names)
    bouts = config.transitions // (b * config.stretch)
    size = bouts * b * config.stretch
    memory = Memory(
        jnp.zeros((size, s)),
        jnp.zeros((size, n, env.action_dim)),
        jnp.zeros(size),
        jnp.zeros(size, bool),
        jnp.zeros((size, s)),
    )
    key, k = jax.random.split(key)
    learner = matd3.init(config.learner, k, n, env.observed.shape[1], s, env.action_dim, team=True)
    episode, age, average = b, np.zeros(b, int), jax.tree.map(np.array, learner.actors)
    sim.reset([(seed, e) for e in range(b)])
    found = []
    for bout in range(bouts):
        rows = []
        for _ in range(config.stretch):
            state = sim.state().astype(np.float32)
            if bout * b * config.stretch < config.random_steps:
                action = rng.uniform(-1, 1, (b, n, env.action_dim)).astype(np.float32)
            else:
                key, k = jax.random.split(key)
                action = np.asarray(choose(learner.actors, sim.observe(state), config.learner.noise, k))
            out = sim.step(action)
            age += 1
            rows.append((state, action, out.reward.astype(np.float32), out.terminated, sim.state().astype(np.float32)))
            over = np.flatnonzero(out.terminated | (age >= env.episode_length))
            if len(over):
                sim.reset([(seed, episode + e) for e in range(len(over))], over)
                episode, age[over] = episode + len(over), 0
        fresh = Memory(*(np.concatenate(x) for x in zip(*rows)))
        key, k = jax.random.split(key)
        learner, memory = learn(config, env, learner, memory, fresh, bout * b * config.stretch, k)
        fold = lambda a, w: config.averaged * a + (1 - config.averaged) * np.asarray(w)  # noqa: E731
        average = jax.tree.map(fold, average, learner.actors)
        if (bout + 1) % config.score_every == 0 or bout + 1 == bouts:
            score = float(returns(env, average, judge, seed).mean())
            found.append(Snapshot(average, (bout + 1) * b * config.stretch, score))
            if progress is not None:
                progress(found[-1])
            if len(found) >= MIXED and np.mean([s.score for s in found[-MIXED:]]) > enough:
                break
    return found


def returns(env: SafeMuJoCo, actors: Mlp, sim, seed: int, noise: float = NOISE) -> np.ndarray:
    """(B,) returns of an episode of every robot."""
    key, total = jax.random.key(seed + 1), np.zeros(sim.batch)
    sim.reset([(seed, 10**6 + e) for e in range(sim.batch)])
    for _ in range(env.episode_length):
        if not sim.running.any():
            break
        key, k = jax.random.split(key)
        total += sim.step(np.asarray(choose(actors, sim.observe().astype(np.float32), noise, k))).reward
    return total


def collect(
    env: SafeMuJoCo, policies: list[BehaviourPolicy | None], transitions: int, seed: int, batch: int = 256
) -> dict[str, np.ndarray]:
    """At least `transitions` steps in whole episodes, the same number from every policy (None: uniform actions).

    Flat arrays as `EpisodeStore.from_steps` takes them: state (T, S), actions, rewards, costs, speed (T,),
    episode_ends (E,), final_state (E, S), terminated (E,), policy (E,).
    """
    parts = []
    for number, policy in enumerate(policies):
        wanted, got = -(-transitions // len(policies)), 0
        while got < wanted:
            need = -(-(wanted - got) // env.episode_length)
            part = _episodes(env, policy, min(batch, max(need, 1)), (seed, number, got))
            got += len(part["rewards"])
            part["policy"] = np.full(len(part["lengths"]), number)
            parts.append(part)
    out = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    return {**out, "episode_ends": np.cumsum(out.pop("lengths"))}


def _episodes(env: SafeMuJoCo, policy: BehaviourPolicy | None, batch: int, seed: tuple[int, ...]) -> dict:
    """One episode of every robot of a batch, cut to their lengths."""
    sim, rng = env.simulate(batch), np.random.default_rng(seed)
    key = jax.random.key(int(rng.integers(2**31)))
    sim.reset([(*seed, k) for k in range(batch)])
    rows, running = [], []
    for _ in range(env.episode_length):
        if not sim.running.any():
            break
        state = sim.state().astype(np.float32)
        if policy is None:
            action = rng.uniform(-1, 1, (batch, env.n_agents, env.action_dim)).astype(np.float32)
        else:
            key, k = jax.random.split(key)
            action = np.asarray(choose(policy.actors, sim.observe(state), policy.noise, k))
        running.append(sim.running.copy())
        out = sim.step(action)
        counted = out.reward.astype(np.float32), out.cost.astype(np.float32)
        rows.append((state, action, *counted, out.speed, out.terminated))
    alive = np.stack(running, 1)  # (B, T)
    lengths = alive.sum(1)
    names = ("state", "actions", "rewards", "costs", "speed", "ended")
    flat = {k: np.stack(x, 1)[alive] for k, x in zip(names, zip(*rows))}
    terminated = flat.pop("ended")[np.cumsum(lengths) - 1]
    return {**flat, "lengths": lengths, "final_state": sim.state().astype(np.float32), "terminated": terminated}


# ------------------------------------------------------------------------------------------------ the shipped tiers


def shipped_policies(env: SafeMuJoCo, tier: str, folder: Path = POLICIES) -> list[BehaviourPolicy]:
    """The policies whose episodes a tier mixes."""
    packed = load_behaviour(folder / _file(env, tier))
    count = packed.actors.weights[0].shape[0]
    one = lambda k: jax.tree.map(lambda x: x[k], packed.actors)  # noqa: E731
    return [BehaviourPolicy(one(k), packed.noise, packed.info) for k in range(count)]


def pack(env: SafeMuJoCo, runs: list[Path], folder: Path = POLICIES, tiers: tuple[str, ...] = TIERS) -> dict[str, dict]:
    """Choose the policies of the tiers among the snapshots of `runs` and write their files; returns their cards.

    The runs take turns: of each, the snapshot whose return is nearest to the tier's level, then the next nearest, as
    long as it is within a tenth of it. Returns are of 32 episodes of the policy as it is stored, in half precision.
    """
    judge, cards = env.simulate(32), {}
    for tier in tiers:
        level = LEVELS[env.parts][tier]
        chosen = _in_turns([c for run in runs for c in _nearest(env, judge, run, level)], level)[:MIXED]
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
        save_behaviour(BehaviourPolicy(actors, NOISE, cards[tier]), folder / _file(env, tier), np.float16)
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

    def place(c: Candidate) -> tuple:
        gap = abs(c.earned - level)
        return (False, c.rank, gap) if gap <= 0.1 * level else (True, 0, gap)

    return sorted(found, key=place)


def _nearest(env: SafeMuJoCo, judge, run: Path, level: float) -> list[Candidate]:
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
    arrays = {f"w{k}": w for k, w in enumerate(snapshot.actors.weights)}
    arrays |= {f"b{k}": b for k, b in enumerate(snapshot.actors.biases)}
    np.savez(run / f"{snapshot.seen:07d}.npz", **arrays)
    line = {"seen": snapshot.seen, "score": round(snapshot.score, 1), "seconds": round(seconds, 1)}
    with open(run / "scores.jsonl", "a") as f:
        f.write(json.dumps(line) + "\n")


def _file(env: SafeMuJoCo, tier: str) -> str:
    return f"{env.name}-{tier}.safetensors"


def _scores(run: Path) -> list[dict]:
    file = run / "scores.jsonl"
    if not file.exists():
        raise CheckpointError(f"'{file}' does not exist; give a folder that `{COMMAND} train` made.")
    return [json.loads(line) for line in file.read_text().splitlines()]


def _load_snapshot(file: Path) -> Mlp:
    with np.load(file) as f:
        layers = sum(k.startswith("w") for k in f)
        return Mlp(*(tuple(jnp.asarray(f[f"{c}{k}"]) for k in range(layers)) for c in "wb"))


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
    a = parser.parse_args()
    try:
        _run(a)
    except UserError as error:
        parser.exit(2, f"error: {error}\n")


def _run(a: argparse.Namespace) -> None:
    env = SafeMuJoCo(a.parts)
    if a.what == "pack":
        for tier, card in pack(env, a.runs, a.out, tuple(a.tiers)).items():
            print(tier, json.dumps(card["policies"]))
    else:
        config = replace(config_for(env), transitions=a.transitions)
        if a.noise is not None:
            config = replace(config, learner=replace(config.learner, noise=a.noise))
        if a.averaged is not None:
            config = replace(config, averaged=a.averaged)
        _train_and_keep(env, config, a.seed, a.level, a.out)


def _train_and_keep(env: SafeMuJoCo, config: RobotsConfig, seed: int, level: str, out: Path) -> None:
    folder, begun = out / f"{env.parts}-{seed}", time.perf_counter()
    if folder.exists():
        raise UserError(f"'{folder}' exists already; delete it or give another --seed or --out.")
    if config.transitions < (least := config.robots * config.stretch):
        raise UserError(f"--transitions {config.transitions} holds no bout of learning; give {least} or more.")
    enough = 1.03 * LEVELS[env.parts][level]

    def progress(snapshot: Snapshot) -> None:
        keep(snapshot, folder, time.perf_counter() - begun)
        print(f"{snapshot.seen:,} transitions, {snapshot.score:.0f}", flush=True)

    train(env, config, seed, progress, enough)


if __name__ == "__main__":
    main()
