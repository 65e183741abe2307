"""The robots' data sets, as OG-MARL describes the public ones: several MATD3 policies of a level.

Speeds are kept in double precision, so the costs of another speed limit are exactly those that a simulation would
count.
"""

from __future__ import annotations

from importlib import metadata

import numpy as np

from ringfence.datasets import robots as policies
from ringfence.datasets.recipes import COLLECTION
from ringfence.datasets.task import Card, Recipe, Task
from ringfence.datasets.version import RECIPES
from ringfence.envs.mujoco import SafeMuJoCo
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore


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
    chosen = policies.shipped_policies(env, task.tier)
    played = policies.collect(env, chosen, transitions, COLLECTION + seed)
    card = card | {
        "protocol": task.protocol,
        "size": transitions,  # asked for; episodes are whole
        "transitions": len(played["rewards"]),
        "collected": f"{len(chosen)} MATD3 policies of the level {task.tier}, Gaussian action noise "
        f"{chosen[0].noise:g}, as many steps of each",
        "policies": chosen[0].info["policies"],
        "episodes_of_policy": np.bincount(played["policy"], minlength=len(chosen)).tolist(),
        **env.describe(played["speed"], task.cost_limit),
        "observation_names": list(env.observation_names),
    }
    return EpisodeStore.from_steps(
        played["state"][:, env.observed],
        played["actions"],
        played["rewards"],
        episode_ends=played["episode_ends"],
        final_observations=played["final_state"][:, env.observed],
        costs=played["costs"],
        state=played["state"],
        final_state=played["final_state"],
        terminated=played["terminated"],
        speed=played["speed"],
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


RECIPE = Recipe(
    about=about, collect=collect, whole=as_asked, relabelled=relabelled
)  # every tier mixes several policies
