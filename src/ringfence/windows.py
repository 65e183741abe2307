"""Windows of H steps, drawn on the device from episodes that live there.

A window starts at a step t that has an action. Rows before the episode's start repeat its first state (history),
rows past its end repeat its last one and are marked invalid.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtri
from scipy.stats import rankdata

from ringfence.data.store import EpisodeStore
from ringfence.types import Array, Batch, Key, Spec

MIN_COHORT = 30  # return scores are ranks among at least this many steps


class WindowData:
    """Episodes on the device, with all that is needed to draw windows.

    M = T + E rows of states, T steps. `arrays` is a pytree of device arrays that jitted functions take as an
    argument, so that the data is never baked into a compiled program.
    """

    def __init__(self, store: EpisodeStore, features: Callable, discount: float):
        episode = store.episode_of_step
        starts = np.concatenate([[0], store.episode_ends[:-1]])
        step = np.arange(store.steps)
        time = step - starts[episode]
        team = store.rewards.mean(1)
        togo = returns_to_go(team, store.lengths, discount)
        rows_togo = np.insert(togo, store.episode_ends, 0.0)
        # (2, 2): mean and standard deviation of the reward, then of the return-to-go
        self.value_scale = np.array([[v.mean(), max(v.std(), 1e-6)] for v in (team, togo)], np.float32)
        rows_cost = np.insert(store.costs, starts, 0.0)  # the cost charged on arriving in a row
        x = np.asarray(features(store.observations, store.state), np.float32)
        self.steps, self.n_agents, self.feature_dim = store.steps, store.n_agents, x.shape[-1]
        self.arrays = {
            "features": jnp.asarray(x),  # (M, N, D)
            "actions": jnp.asarray(store.actions),  # (T, N, A)
            "rewards": jnp.asarray(team),  # (T,)
            "scores": jnp.asarray(return_scores(togo, time), jnp.float32),  # (T,)
            "togo": jnp.asarray(rows_togo, jnp.float32),  # (M,)
            "costs": jnp.asarray(rows_cost, jnp.float32),  # (M,)
            "time": jnp.asarray(time, jnp.int32),  # (T,)
            "row": jnp.asarray(step + episode, jnp.int32),  # (T,) row of the state before the step
            "first_row": jnp.asarray(starts[episode] + episode, jnp.int32),  # (T,)
            "last_row": jnp.asarray(store.episode_ends[episode] + episode, jnp.int32),  # (T,)
        }


def blank(spec: Spec, steps: int = 40) -> WindowData:
    """Data of the right shapes that says nothing: one episode of noise, from which a model's skeleton is built."""
    rng = np.random.default_rng(0)
    n, d = spec.n_agents, spec.feature_dim
    store = EpisodeStore.from_episodes(
        rng.normal(size=(1, steps + 1, n, d)),
        np.zeros((1, steps, n, spec.action_dim)),
        np.zeros((1, steps)),
        np.zeros((1, steps)),
        card={"action_low": min(spec.action_low, 0.0), "action_high": max(spec.action_high, 0.0)},
    )
    return WindowData(store, lambda observations, state: observations, 0.9)


def draw(arrays: dict[str, Array], key: Key, batch: int, horizon: int, history: int = 0) -> Batch:
    """`batch` windows of `history + horizon` rows, uniform over all steps of the data; row `history` is the present."""
    step = jax.random.randint(key, (batch,), 0, arrays["row"].shape[0])
    return at(arrays, step, horizon, history)


def at(arrays: dict[str, Array], step: Array, horizon: int, history: int = 0) -> Batch:
    """The windows whose present is the state before `step` (B,)."""
    offset = jnp.arange(-history, horizon)
    wanted = arrays["row"][step][:, None] + offset
    first, last = arrays["first_row"][step][:, None], arrays["last_row"][step][:, None]
    row = jnp.clip(wanted, first, last)
    valid = wanted <= last
    # Step index of the action after each row but the last; a padded one is masked out.
    after = jnp.clip(step[:, None] + offset[:-1], 0, arrays["actions"].shape[0] - 1)
    acted = valid[:, 1:] & (wanted[:, :-1] >= first)
    return Batch(
        features=arrays["features"][row],
        actions=jnp.where(acted[..., None, None], arrays["actions"][after], 0.0),
        valid=valid,
        rewards=jnp.where(acted, arrays["rewards"][after], 0.0),
        returns=arrays["scores"][step],
        togo=jnp.where(valid, arrays["togo"][row], 0.0),
        costs=arrays["costs"][row],
        time=arrays["time"][step],
    )


def returns_to_go(reward: np.ndarray, lengths: np.ndarray, discount: float) -> np.ndarray:
    """(T,) discounted sum of `reward` (T,) from every step to the end of its episode."""
    out = np.zeros(len(reward), np.float64)
    ends = np.cumsum(lengths)
    # Episodes advance together, from their last steps backwards: as many passes as the longest has steps.
    carry = np.zeros(len(lengths))
    for back in range(1, int(lengths.max()) + 1):
        alive = lengths >= back
        index = ends[alive] - back
        carry[alive] = reward[index] + discount * carry[alive]
        out[index] = carry[alive]
    return out


def return_scores(togo: np.ndarray, time: np.ndarray) -> np.ndarray:
    """(T,) normal score of each return-to-go: Φ⁻¹ of its rank among the steps at the same time.

    Ranking within the time step keeps early windows from seeing impossible targets, and the normal score keeps the
    scale the same for every data set: +2 is the best 2.3 %. Times that few episodes reach are ranked together.
    """
    out = np.zeros(len(togo))
    order = np.argsort(time, kind="stable")
    counts = np.bincount(time)
    edges, start = [], 0
    for count in np.cumsum(counts):
        if count - start >= MIN_COHORT or count == len(togo):
            edges.append((start, count))
            start = count
    if len(edges) > 1 and edges[-1][1] - edges[-1][0] < MIN_COHORT:
        edges[-2:] = [(edges[-2][0], edges[-1][1])]
    for a, b in edges:
        cohort = order[a:b]
        out[cohort] = ndtri((rankdata(togo[cohort]) - 0.5) / (b - a))
    return out
