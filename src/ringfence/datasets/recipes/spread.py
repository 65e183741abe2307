"""Simple Spread's data sets, as OMAR describes the public ones: MATD3 at two levels, its replay, random actions."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np

from ringfence.datasets import behaviour as policies
from ringfence.datasets.recipes import COLLECTION
from ringfence.datasets.task import Card, Recipe, Task
from ringfence.datasets.version import RECIPES
from ringfence.envs.simple_spread import SimpleSpread
from ringfence.logs.store import EpisodeStore
from ringfence.types import Array, Key, Policy, PolicyStep, PyTree


def about(task: Task) -> Card:
    """The simulator, for the card."""
    env = _env(task)
    return {
        "simulator": f"ringfence {RECIPES} simple_spread",
        "integrator": env.integrator,
        "reward": env.reward,
    }


class Behaviour(eqx.Module):
    """A shipped behaviour policy, played with the noise that it collected data with."""

    policy: policies.BehaviourPolicy

    def start(self, batch: int) -> PyTree:
        return {}

    def act(self, memory: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        return memory, PolicyStep(self.policy.act(observations, key), {})


def references(task: Task) -> dict[str, Policy]:
    """The policy of `medium` and `expert`."""
    if task.tier not in policies.TARGETS:
        return {}
    return {"behaviour policy": Behaviour(policies.shipped_policy(task.tier))}


def collect(task: Task, transitions: int, seed: int, card: Card) -> EpisodeStore:
    """The data set of a tier."""
    env = _env(task)
    episodes, how = played(env, task.tier, transitions // env.episode_length, seed)
    return EpisodeStore.from_episodes(
        episodes["observations"],
        episodes["actions"],
        episodes["rewards"],
        episodes["costs"],
        state=episodes["state"],
        card=card | {"transitions": transitions, "collected": how},
    )


def played(env: SimpleSpread, tier: str, episodes: int, seed: int) -> tuple[dict[str, np.ndarray], str]:
    """A tier's episodes (E, L, ...), and by whom, in words."""
    if tier == "medium-replay":
        how = "the experience of an MATD3 learner from scratch up to the medium level, in order of collection"
        return policies.replay_episodes(env, episodes, seed), how
    key = jax.random.fold_in(jax.random.key(COLLECTION), seed)
    if tier in policies.TARGETS:
        policy = policies.shipped_policy(tier)
        how = f"MATD3 policy, Gaussian action noise {policy.noise:g}"
        return policies.collect(env, policy, episodes, key), how
    return policies.collect(env, "random", episodes, key), "uniform actions"


def _env(task: Task) -> SimpleSpread:
    assert isinstance(task.env, SimpleSpread), "only tasks of Simple Spread name this recipe"
    return task.env


RECIPE = Recipe(about=about, collect=collect, references=references)
