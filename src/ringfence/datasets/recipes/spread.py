"""Simple Spread's data sets, as OMAR describes the public ones: MATD3 at two levels, its replay, random actions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import jax
import numpy as np

from ringfence import __version__
from ringfence.datasets import behaviour as policies
from ringfence.datasets.recipes import COLLECTION
from ringfence.envs.simple_spread import SimpleSpread
from ringfence.logs.store import EpisodeStore
from ringfence.types import Array, Key, PolicyStep, PyTree

if TYPE_CHECKING:
    from ringfence.datasets.task import Task


def about(task: Task) -> dict:
    """The simulator, for the card."""
    told = {"integrator": task.env.integrator, "reward": task.env.reward}
    return {"simulator": f"ringfence {__version__} simple_spread", **told}


def whole(task: Task, transitions: int) -> int:
    """Whole episodes, all of one length."""
    return -(-transitions // task.env.episode_length) * task.env.episode_length


class Behaviour(eqx.Module):
    """A shipped behaviour policy, played with the noise that it collected data with."""

    policy: policies.BehaviourPolicy

    def start(self, batch: int) -> PyTree:
        return {}

    def act(self, memory: PyTree, observations: Array, state: Array, key: Key) -> tuple[PyTree, PolicyStep]:
        return memory, PolicyStep(self.policy.act(observations, key), {})


def references(task: Task) -> dict[str, Behaviour]:
    """The policy of `medium` and `expert`."""
    return {"behaviour policy": Behaviour(policies.shipped_policy(task.tier))} if task.tier in policies.TARGETS else {}


def relabelled(task: Task, store: EpisodeStore) -> None:
    """There is one definition of danger."""


def collect(task: Task, transitions: int, seed: int, card: dict) -> EpisodeStore:
    """The data set of a tier."""
    made, how = played(task.env, task.tier, transitions // task.env.episode_length, seed)
    arrays = (made[k] for k in ("observations", "actions", "rewards", "costs"))
    card = card | {"transitions": transitions, "collected": how}
    return EpisodeStore.from_episodes(*arrays, state=made["state"], card=card)


def played(env: SimpleSpread, tier: str, episodes: int, seed: int) -> tuple[dict[str, np.ndarray], str]:
    """A tier's episodes (E, L, ...), and by whom, in words."""
    if tier == "medium-replay":
        how = "the experience of an MATD3 learner from scratch up to the medium level, in order of collection"
        return policies.replay_episodes(env, episodes, seed), how
    policy = policies.shipped_policy(tier) if tier in policies.TARGETS else "random"
    how = "uniform actions" if policy == "random" else f"MATD3 policy, Gaussian action noise {policy.noise:g}"
    return policies.collect(env, policy, episodes, jax.random.fold_in(jax.random.key(COLLECTION), seed)), how
