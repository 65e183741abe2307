"""The data sets of Simple Spread as each agent sees it by itself: the same play of three, told in those views."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np

from ringfence import __version__
from ringfence.datasets.recipes import spread
from ringfence.datasets.recipes.spread import relabelled, whole  # noqa: F401 a recipe's own
from ringfence.envs.spread_alike import LANDMARKS, OTHERS, SIGHT, touching
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore

if TYPE_CHECKING:
    from ringfence.datasets.task import Task

EPISODES = 2000  # whose views are told at once


def about(task: Task) -> dict:
    """The simulator, for the card."""
    seen = f"{LANDMARKS} landmarks and {OTHERS} others seen within {SIGHT:g} m"
    return {"simulator": f"ringfence {__version__} simple_spread, {seen}"}


def references(task: Task) -> dict:
    """None: whoever collected the data sees everything, in a team of three."""
    return {}


def collect(task: Task, transitions: int, seed: int, card: dict) -> EpisodeStore:
    """The data set of a tier."""
    env = task.env
    if env.n_agents != 3:
        raise UserError(f"'{task.name}' was played by 3, so agents={env.n_agents} have no data; train with 3.")
    played, how = spread.played(env.whole, task.tier, transitions // env.episode_length, seed)

    @jax.jit
    def told(flat):
        state = env.from_global_state(flat)
        return env.observe(state), touching(state)[:, 1:]

    flat = played["state"]
    parts = [told(flat[k : k + EPISODES]) for k in range(0, len(flat), EPISODES)]
    observations, costs = (np.concatenate([np.asarray(x) for x in column]) for column in zip(*parts))
    card = card | {
        "transitions": transitions,
        "collected": f"{how}, in the views of each agent",
        "observation_names": list(env.observation_names),
    }
    return EpisodeStore.from_episodes(observations, played["actions"], played["rewards"], costs, state=flat, card=card)
