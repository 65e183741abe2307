"""Makes the behaviour policies of Simple Spread, and the replay, that the package ships: an MATD3 learner a seed.

    python benchmarks/behaviour.py [FOLDER]      # a minute or two a seed on a core; prints their statistics as JSON

Seed 0 is the tiers of one learner; all five are the pools, as the public sets are.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.datasets.behaviour import (
    ACTION_STEPS,
    LEVELS,
    LINEAGES,
    POLICIES,
    REPLAY_SHARE,
    REPLAY_TRANSITIONS,
    TIER_NOISE,
    BehaviourPolicy,
    BehaviourRun,
    actions_of,
    collect,
    resimulate,
    save_behaviour,
    suffix,
    train_behaviour,
)
from ringfence.datasets.matd3 import MATD3Config
from ringfence.envs.simple_spread import SimpleSpread, SpreadState
from ringfence.utils.files import whole

TARGETS = {"medium": 273.4, "expert": 531.0}  # mean returns of the public sets of seed 0
POOL_TARGETS = {"medium": 259.85, "expert": 516.76}  # and of the public sets of seeds 0 to 4 together
LINEAGE = 375_000  # transitions of the run that the shipped tiers come from; it ends beyond the expert's level
COMMAND = "python benchmarks/behaviour.py"


def target_return(level: str, lineage: int) -> float:
    """The return that a lineage's snapshot is chosen by: the public set's for seed 0; for the others what makes the
    pool's mean the public pool's."""
    first = TARGETS[level]
    return first if lineage == 0 else (LINEAGES * POOL_TARGETS[level] - first) / (LINEAGES - 1)


def train_tier_policies(
    folder: str | Path = POLICIES,
    progress: Callable[[int, float], None] | None = None,
    lineages: Sequence[int] = range(LINEAGES),
) -> dict[str, dict[str, float]]:
    """Make the shipped files: one learner for each seed; its first 97 500 transitions are the replay.

    Of its snapshots, `medium` and `expert` are those whose return, with noise `TIER_NOISE`, is nearest to
    `target_return` over 20 000 episodes. All but seed 0's are kept at half precision, and their replays as
    `REPLAY_SHARE` episodes. Returns the statistics of each tier. A minute or two a seed on a core.
    """
    tiers = {}
    for lineage in lineages:
        tiers |= _train_lineage(lineage, Path(folder), progress)
    return tiers


def _train_lineage(
    lineage: int, folder: Path, progress: Callable[[int, float], None] | None
) -> dict[str, dict[str, float]]:
    """The files of one seed, and their statistics."""
    env = SimpleSpread()
    ending = suffix(lineage)
    dtype = np.float16 if lineage else np.float32
    run = train_behaviour(env, MATD3Config(), jax.random.key(lineage), LINEAGE, progress)
    run = run._replace(actors=jax.tree.map(lambda x: x.astype(dtype).astype(np.float32), run.actors))
    policies = [snapshot(run, k, TIER_NOISE) for k in range(len(run.seen))]

    def score(k: int, episodes: int) -> dict[str, float]:
        return statistics(collect(env, policies[k], episodes, jax.random.key(1)))

    rough = np.array([score(k, 2000)["return_mean"] for k in range(len(policies))])
    tiers = {}
    for level in LEVELS:
        target = target_return(level, lineage)
        scores = {int(k): score(k, 20_000) for k in np.argsort(np.abs(rough - target))[:4]}
        best = min(scores, key=lambda k: abs(scores[k]["return_mean"] - target))
        tiers[level + ending] = {"seen": int(run.seen[best]), **scores[best]}
        card = {
            "task": "simple_spread",
            "level": level,
            "return": round(scores[best]["return_mean"], 2),
            "transitions": int(run.seen[best]),
            "command": COMMAND,
        }
        if lineage:
            card["lineage"] = lineage
        policy = replace(policies[best], info=card)
        save_behaviour(policy, folder / f"simple_spread-{level}{ending}.safetensors", dtype)
    episodes = REPLAY_TRANSITIONS // env.episode_length
    rows = np.arange(episodes)
    if lineage:
        rows = np.linspace(0, episodes - 1, REPLAY_SHARE).round().astype(int)
    initial = jax.tree.map(lambda x: x[rows], run.initial)
    actions = run.actions[rows]
    if lineage:
        actions = np.round(actions.astype(np.float32) * ACTION_STEPS).astype(np.int8)
    _save_replay(initial, actions, folder / f"simple_spread-medium-replay{ending}.npz")
    tiers[f"medium-replay{ending}"] = statistics(resimulate(env, initial, actions_of(actions)))
    return tiers


def snapshot(run: BehaviourRun, k: int, noise: float) -> BehaviourPolicy:
    """The policy of the run's snapshot `k`, acting with exploration noise of this std."""
    return BehaviourPolicy(jax.tree.map(lambda x: jnp.asarray(x[k]), run.actors), noise)


def statistics(data: dict[str, np.ndarray]) -> dict[str, float]:
    """Per-episode numbers of `collect`'s arrays: return (sum over time of the agents' mean reward) and cost.

    `avoidable_cost` is the mean cost of the episodes that do not start in contact, the only ones that a policy
    could have kept free of cost; `contact_starts` is the share of the others.
    """
    positions = data["state"][:, 0, : 2 * data["actions"].shape[2]].reshape(len(data["state"]), -1, 2)
    gaps = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
    separate = np.all(gaps + 10.0 * np.eye(gaps.shape[-1]) >= 0.3, axis=(1, 2))
    returns = data["rewards"].mean(-1).sum(-1)
    cost = data["costs"].sum(-1)
    return {
        "episodes": len(returns),
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_min": float(returns.min()),
        "return_max": float(returns.max()),
        "cost": float(cost.mean()),
        "avoidable_cost": float(cost[separate].mean()) if separate.any() else 0.0,
        "contact_starts": float(1.0 - separate.mean()),
    }


def _save_replay(initial: SpreadState, actions: np.ndarray, path: Path) -> None:
    with whole(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, position=initial.position, landmarks=initial.landmarks, actions=actions)


def main() -> None:
    """Remake the shipped files and print their statistics as JSON."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else POLICIES
    tiers = train_tier_policies(folder, lambda seen, score: print(f"{seen:7d} transitions: return {score:.1f}"))
    print(json.dumps(tiers, indent=1))


if __name__ == "__main__":
    main()
