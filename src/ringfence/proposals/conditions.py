"""The condition y of plans: how well a logged window went, as a normal score among others, or raw as in MADIFF."""

from __future__ import annotations

from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from scipy.special import ndtri

from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData, returns_to_go
from ringfence.problem.features import FeatureMap
from ringfence.world import World
from ringfence.world.values import Values, values_of

Condition = Literal["advantage", "return", "raw"]
MIN_COHORT = 30  # return scores are ranks among at least this many steps


def scores_of(
    store: EpisodeStore, condition: Condition, horizon: int, discount: float, values: Values | None, features
) -> np.ndarray:
    """(T,) the score of the window that begins at each step; the advantage needs values and features (M, N, D)."""
    episode = store.episode_of_step
    starts = np.concatenate([[0], store.episode_ends[:-1]])
    step = np.arange(store.steps)
    team = store.rewards.mean(1)
    if condition == "advantage":
        if values is None:
            raise ValueError("an advantage needs the values of a World")
        row = step + episode
        last = store.episode_ends[episode] + episode
        value = values_of(values.critic, features)
        return normal_scores(advantages(value, team, row, last, horizon, discount))
    left = returns_to_go(team, store.lengths, discount)
    return raw_scores(left) if condition == "raw" else return_scores(left, step - starts[episode])


def scored_windows(
    store: EpisodeStore,
    feature_map: FeatureMap,
    world: World | None,
    condition: Condition,
    horizon: int,
    discount: float,
) -> WindowData:
    """Windows with their scores; an advantage is by the values of the World."""
    seen = None
    values = None
    if condition == "advantage" and world is not None:
        seen = jnp.asarray(feature_map(store.observations, store.state), jnp.float32)
        values = world.values
    return WindowData(store, feature_map, scores_of(store, condition, horizon, discount, values, seen))


def world_settings(config: Any) -> dict | None:
    """What an algorithm's config with a `condition` asks of a World: values alone score an advantage."""
    return {"view": config.view, "discount": config.discount} if config.condition == "advantage" else None


def advantages(
    value: np.ndarray, team: np.ndarray, row: np.ndarray, last: np.ndarray, horizon: int, discount: float
) -> np.ndarray:
    """(T,) how much better than expected the next H−1 steps went:

        A_t = Σ_{h<n} γ^h r_{t+h} + γ^n V̂(s_{t+n}) − V̂(s_t),   n = min(H − 1, steps left),

    with V̂ = 0 at the end of an episode. value (M,) of rows, team reward (T,), row and last row (T,) of every step.
    Unlike the return-to-go, which mostly says how good the state already is, it is about the window itself.
    """
    steps = np.arange(len(team))
    total = np.zeros(len(team))
    left = last - row
    for h in range(horizon - 1):
        inside = left > h
        total[inside] += discount**h * team[steps[inside] + h]
    n = np.minimum(horizon - 1, left)
    tail = np.where(left > horizon - 1, value[row + n], 0.0)
    return total + discount**n * tail - value[row]


def raw_scores(returns_to_go: np.ndarray) -> np.ndarray:
    """(T,) each return-to-go in units of the largest: what MADIFF reads (Zhu et al. 2024), whose scale is set by hand.

    Late steps have little left to earn, so one number asked for at every step soon lies outside the data.
    """
    return returns_to_go / max(float(np.abs(returns_to_go).max()), np.finfo(np.float32).tiny)


def normal_scores(x: np.ndarray) -> np.ndarray:
    """Φ⁻¹ of the rank: a scale that is the same for every data set; +2 is the best 2.3 %."""
    from scipy.stats import rankdata  # slow to import, and playing needs none

    return ndtri((rankdata(x) - 0.5) / len(x))


def return_scores(returns_to_go: np.ndarray, time: np.ndarray) -> np.ndarray:
    """(T,) normal score of each return-to-go: Φ⁻¹ of its rank among the steps at the same time.

    Ranking within the time step keeps early windows from seeing impossible targets, and the normal score keeps the
    scale the same for every data set: +2 is the best 2.3 %. Times that few episodes reach are ranked together.
    """
    order = np.argsort(time, kind="stable")
    counts = np.bincount(time)
    edges = []
    start = 0
    out = np.zeros(len(returns_to_go))
    for count in np.cumsum(counts):
        if count - start >= MIN_COHORT or count == len(returns_to_go):
            edges.append((start, count))
            start = count
    if len(edges) > 1 and edges[-1][1] - edges[-1][0] < MIN_COHORT:
        edges[-2:] = [(edges[-2][0], edges[-1][1])]
    for a, b in edges:
        cohort = order[a:b]
        out[cohort] = normal_scores(returns_to_go[cohort])
    return out
