"""The data sets of Simple Spread as each agent sees it by itself: the same play of three, in those views."""

from __future__ import annotations

import jax
import numpy as np

from ringfence.datasets.recipes import spread
from ringfence.datasets.task import Card, Recipe, Task
from ringfence.datasets.version import RECIPES
from ringfence.envs.spread_alike import LANDMARKS, OTHERS, SIGHT, SpreadAlike, touching
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.types import Array

CHUNK = 2000  # episodes whose views are computed at once


def about(task: Task) -> Card:
    """The simulator, for the card."""
    seen = f"{LANDMARKS} landmarks and {OTHERS} others seen within {SIGHT:g} m"
    return {"simulator": f"ringfence {RECIPES} simple_spread, {seen}"}


def collect(task: Task, transitions: int, seed: int, card: Card) -> EpisodeStore:
    """The data set of a tier."""
    env = task.env
    assert isinstance(env, SpreadAlike), "only tasks of SpreadAlike name this recipe"
    if env.n_agents != 3:
        raise UserError(f"'{task.name}' was played by 3, so agents={env.n_agents} have no data; train with 3.")
    played, how = spread.played(env.whole, task.tier, transitions // env.episode_length, seed)
    observations, costs = _own_views(env, played["state"])
    card = card | {
        "transitions": transitions,
        "collected": f"{how}, in the views of each agent",
        "observation_names": list(env.observation_names),
    }
    return EpisodeStore.from_episodes(
        observations, played["actions"], played["rewards"], costs, state=played["state"], card=card
    )


def _own_views(env: SpreadAlike, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Observations (E, L+1, N, O) in states (E, L+1, S), and each agent's costs (E, L, N) of arriving there."""

    @jax.jit
    def view(flat: Array) -> tuple[Array, Array]:
        state = env.from_global_state(flat)
        return env.observe(state), touching(state)[:, 1:]

    parts = [view(states[k : k + CHUNK]) for k in range(0, len(states), CHUNK)]
    observations = np.concatenate([np.asarray(seen) for seen, _ in parts])
    costs = np.concatenate([np.asarray(touched) for _, touched in parts])
    return observations, costs


RECIPE = Recipe(
    about=about, collect=collect
)  # no reference: who collected the data sees everything, in a team of three
