"""The robots' data sets, as OG-MARL (Formanek et al. 2023) describes the public ones: MATD3 trained to a level, rolled
out with Gaussian noise of 0.2 on the actions, and four such policies mixed. `benchmarks/behaviour_robots.py` trains
ours, from which the files under `policies/` are chosen.

Speeds are kept in double precision, so the costs of another speed limit are exactly those that a simulation would
count.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.datasets import matd3
from ringfence.datasets.behaviour import POLICIES, BehaviourPolicy, load_behaviour
from ringfence.datasets.matd3 import Mlp
from ringfence.datasets.recipes import COLLECTION, RECIPES
from ringfence.datasets.task import Card, Recipe, Task
from ringfence.envs.base import Memoryless, Moment, rollout, split_off
from ringfence.envs.mujoco import SafeMuJoCo
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.types import Array, Key

Numbers = np.ndarray | Array


@jax.jit
def choose(actors: Mlp, observations: Numbers, noise: float | Array, key: Key) -> Array:
    """(B, N, O) -> (B, N, A) with exploration noise."""
    return matd3.noisy(matd3.act(actors, jnp.asarray(observations)), noise, key)


def played(
    env: SafeMuJoCo, policies: Sequence[BehaviourPolicy | None], transitions: int, seed: int, batch: int = 256
) -> dict[str, np.ndarray]:
    """At least `transitions` steps in whole episodes, the same number from every policy (None: uniform actions).

    Flat arrays as `EpisodeStore.from_steps` takes them: state (T, S), actions, rewards, costs, speed (T,),
    episode_ends (E,), final_state (E, S), terminated (E,), policy (E,).
    """
    parts = []
    share = -(-transitions // len(policies))
    for number, policy in enumerate(policies):
        steps = 0
        while steps < share:
            episodes = -(-(share - steps) // env.episode_length)
            part = _episodes(env, policy, min(batch, episodes), (seed, number, steps))
            steps += len(part["rewards"])
            part["policy"] = np.full(len(part["lengths"]), number)
            parts.append(part)
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    arrays["episode_ends"] = np.cumsum(arrays["lengths"])
    return arrays


def _episodes(
    env: SafeMuJoCo, policy: BehaviourPolicy | None, batch: int, seed: tuple[int, ...]
) -> dict[str, np.ndarray]:
    """One episode of every robot of a batch, cut to their lengths."""
    sim = env.simulate(batch)
    rng = np.random.default_rng(seed)
    key = jax.random.key(int(rng.integers(2**31)))
    sim.reset([(*seed, k) for k in range(batch)])
    rows: list[dict[str, Any]] = []

    def act(observations: np.ndarray, state: np.ndarray | None, key: Key | None) -> Numbers:
        if policy is None:
            return rng.uniform(-1, 1, (batch, env.n_agents, env.action_dim)).astype(np.float32)
        return choose(policy.actors, observations, policy.noise, key)

    def keep(now: Moment) -> None:
        rows.append(
            {
                "state": now.before.state,
                "actions": np.asarray(now.decided.action),
                "rewards": now.outcome.reward.astype(np.float32),
                "costs": now.outcome.cost.astype(np.float32),
                "speed": now.outcome.info["speed"],
                "ended": now.outcome.terminated,
                "alive": now.running,
            }
        )

    rollout(Memoryless(act), sim, keep, itertools.islice(split_off(key), env.episode_length))
    steps = {name: np.stack([row[name] for row in rows], 1) for name in rows[0]}  # (B, T, ...)
    alive = steps.pop("alive")
    lengths = alive.sum(1)
    flat = {name: value[alive] for name, value in steps.items()}
    terminated = flat.pop("ended")[np.cumsum(lengths) - 1]
    return {**flat, "lengths": lengths, "final_state": np.asarray(sim.observe().state), "terminated": terminated}


def shipped_policies(env: SafeMuJoCo, tier: str, folder: Path = POLICIES) -> list[BehaviourPolicy]:
    """The policies whose episodes a tier mixes."""
    packed = load_behaviour(folder / file_of(env, tier))

    def one(k: int) -> BehaviourPolicy:
        return BehaviourPolicy(jax.tree.map(lambda x: x[k], packed.actors), packed.noise, packed.info)

    return [one(k) for k in range(packed.actors.weights[0].shape[0])]


def file_of(env: SafeMuJoCo, tier: str) -> str:
    """The name of a tier's file."""
    return f"{env.name}-{tier}.safetensors"


def about(task: Task) -> Card:
    """The simulator, for the card."""
    env = _env(task)
    if getattr(task.hazard, "limit", None) != env.limit:
        raise UserError(f"Task '{task.name}' has the danger {task.hazard}, its simulator counts above {env.limit} m/s.")
    return {"simulator": f"ringfence {RECIPES} {env.name}, mujoco {metadata.version('mujoco')}"}


def as_asked(task: Task, transitions: int) -> int:
    """How many steps whole episodes have is known when they are played."""
    return transitions


def collect(task: Task, transitions: int, seed: int, card: Card) -> EpisodeStore:
    """The data set of a tier."""
    env = _env(task)
    chosen = shipped_policies(env, task.tier)
    steps = played(env, chosen, transitions, COLLECTION + seed)
    card = card | {
        "protocol": task.protocol,
        "size": transitions,  # asked for; episodes are whole
        "transitions": len(steps["rewards"]),
        "collected": f"{len(chosen)} MATD3 policies of the level {task.tier}, Gaussian action noise "
        f"{chosen[0].noise:g}, as many steps of each",
        "policies": chosen[0].info["policies"],
        "episodes_of_policy": np.bincount(steps["policy"], minlength=len(chosen)).tolist(),
        **env.describe(steps["speed"], task.cost_limit),
        "observation_names": list(env.observation_names),
    }
    return EpisodeStore.from_steps(
        steps["state"][:, env.observed],
        steps["actions"],
        steps["rewards"],
        episode_ends=steps["episode_ends"],
        final_observations=steps["final_state"][:, env.observed],
        costs=steps["costs"],
        state=steps["state"],
        final_state=steps["final_state"],
        terminated=steps["terminated"],
        speed=steps["speed"],
        card=card,
    )


def relabelled(task: Task, store: EpisodeStore) -> tuple[np.ndarray, Card] | None:
    """(costs (T,), entries of the card) of kept steps under this task's limit; None where no speeds were kept."""
    if store.speed is None:
        return None
    env = _env(task)
    costs = (store.speed > env.limit).astype(np.float32)
    return costs, {"protocol": task.protocol, **env.describe(store.speed, task.cost_limit)}


def _env(task: Task) -> SafeMuJoCo:
    assert isinstance(task.env, SafeMuJoCo), "only tasks of robots name this recipe"
    return task.env


# every tier mixes several policies
RECIPE = Recipe(about=about, collect=collect, whole=as_asked, relabelled=relabelled)
