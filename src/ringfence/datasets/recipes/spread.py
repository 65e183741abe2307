"""Simple Spread's data sets, as OMAR describes the public ones: MATD3 at two levels, its replay, random actions; of one
learner, or pooled of five, as most of the literature reads the public ones; and in the views of each agent."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np

from ringfence.datasets import behaviour as policies
from ringfence.datasets.recipes import COLLECTION, RECIPES
from ringfence.datasets.task import Card, Recipe, Task
from ringfence.envs.simple_spread import LANDMARKS, OTHERS, SIGHT, SimpleSpread, SpreadAlike, touching
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.types import Array, Key, Policy, PolicyStep, PyTree

POOLED = "-pooled"  # ends the names of tiers of five learners
CHUNK = 2000  # episodes whose views are computed at once
TURNS = "its number in the full set modulo 5"


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

    def initial_state(self, batch: int) -> PyTree:
        return {}

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        return carry, PolicyStep(self.policy.act(observations, key), {})


def references(task: Task) -> dict[str, Policy]:
    """The policy of `medium` and `expert`."""
    if task.tier not in policies.LEVELS:
        return {}
    return {"behaviour policy": Behaviour(policies.shipped_policy(task.tier))}


def collect(task: Task, transitions: int, seed: int, card: Card) -> EpisodeStore:
    """The data set of a tier."""
    env = _env(task)
    count = transitions // env.episode_length
    drivers: Card = {}
    if task.tier.endswith(POOLED):
        episodes, how = pooled(env, task.tier.removesuffix(POOLED), count, seed)
        if task.tier.removesuffix(POOLED) != "random":
            drivers = {"drivers": [f"MATD3 seed {k}" for k in range(policies.LINEAGES)], "driver_of_episode": TURNS}
    else:
        episodes, how = played(env, task.tier, count, seed)
    return EpisodeStore.from_episodes(
        **episodes,
        card=card | {"transitions": transitions, "collected": how} | drivers,
    )


def played(env: SimpleSpread, tier: str, episodes: int, seed: int) -> tuple[dict[str, np.ndarray], str]:
    """A tier's episodes (E, L, ...), and by whom, in words."""
    if tier == "medium-replay":
        how = "the experience of an MATD3 learner from scratch up to the medium level, in order of collection"
        return policies.replay_episodes(env, episodes, seed), how
    key = jax.random.fold_in(jax.random.key(COLLECTION), seed)
    if tier in policies.LEVELS:
        policy = policies.shipped_policy(tier)
        how = f"MATD3 policy, Gaussian action noise {policy.noise:g}"
        return policies.collect(env, policy, episodes, key), how
    return policies.collect(env, "random", episodes, key), "uniform actions"


def pooled(env: SimpleSpread, tier: str, episodes: int, seed: int) -> tuple[dict[str, np.ndarray], str]:
    """As `played`, by the learners of five seeds, who take turns."""
    shares = [len(range(k, episodes, policies.LINEAGES)) for k in range(policies.LINEAGES)]
    parts = [_of_lineage(env, tier, share, seed, k) for k, share in enumerate(shares) if share]
    turn = np.argsort(np.concatenate([np.arange(share) * policies.LINEAGES + k for k, share in enumerate(shares)]))
    together = {name: np.concatenate([part[name] for part in parts])[turn] for name in parts[0]}
    how = {
        "medium-replay": "the experience of five MATD3 learners from scratch up to the medium level, thinned evenly",
        "random": "uniform actions",
    }.get(tier, f"five MATD3 policies, Gaussian action noise {policies.TIER_NOISE:g}")
    return together, f"{how}; in turn"


def _of_lineage(env: SimpleSpread, tier: str, episodes: int, seed: int, lineage: int) -> dict[str, np.ndarray]:
    """One learner's share of a pooled tier."""
    if tier == "medium-replay" and seed == 0:
        return policies.shipped_replay(env, episodes, lineage)
    if tier == "medium-replay":
        return policies.replay_episodes(env, episodes, policies.LINEAGES * seed + lineage)
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(COLLECTION), seed), lineage)
    policy = policies.shipped_policy(tier, lineage=lineage) if tier in policies.LEVELS else "random"
    return policies.collect(env, policy, episodes, key)


def _env(task: Task) -> SimpleSpread:
    assert isinstance(task.env, SimpleSpread), "only tasks of Simple Spread name this recipe"
    return task.env


def about_alike(task: Task) -> Card:
    """The simulator as each agent sees it, for the card."""
    seen = f"{LANDMARKS} landmarks and {OTHERS} others seen within {SIGHT:g} m"
    return {"simulator": f"ringfence {RECIPES} simple_spread, {seen}"}


def collect_alike(task: Task, transitions: int, seed: int, card: Card) -> EpisodeStore:
    """The same play of three in their own views: observations (E, L+1, N, O), costs (E, L, N) of arriving there."""
    env = task.env
    assert isinstance(env, SpreadAlike), "only tasks of SpreadAlike name this recipe"
    if env.n_agents != 3:
        raise UserError(f"'{task.name}' was played by 3, so agents={env.n_agents} have no data; train with 3.")
    whole, how = played(env.whole, task.tier, transitions // env.episode_length, seed)

    @jax.jit
    def view(flat: Array) -> tuple[Array, Array]:
        state = env.from_global_state(flat)
        return env.observe(state), touching(state)[:, 1:]

    states = whole["state"]
    parts = [view(states[k : k + CHUNK]) for k in range(0, len(states), CHUNK)]
    observations, costs = (np.concatenate([np.asarray(part) for part in both]) for both in zip(*parts))
    card = card | {
        "transitions": transitions,
        "collected": f"{how}, in the views of each agent",
        "observation_names": list(env.observation_names),
    }
    return EpisodeStore.from_episodes(
        observations, whole["actions"], whole["rewards"], costs, state=whole["state"], card=card
    )


RECIPE = Recipe(about=about, collect=collect, references=references)
# no reference: who collected the data sees everything, in a team of three
ALIKE = Recipe(about=about_alike, collect=collect_alike)
