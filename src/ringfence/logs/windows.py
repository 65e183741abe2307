"""Windows of H steps, drawn on the device from episodes that live there.

A window starts at a step t that has an action. Rows before the episode's start repeat its first state (history),
rows past its end repeat its last one and are marked invalid.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.logs.store import EpisodeStore
from ringfence.problem import normalise
from ringfence.types import Array, Batch, Key
from ringfence.utils.precision import on_device

NOT_ARRIVED = -1.0  # cost of an episode's first row: nothing was charged on arriving there, so nobody knows


class WindowData:
    """Episodes on the device, with all that is needed to draw windows.

    M = T + E rows of states, T steps. `arrays` is a pytree of device arrays that jitted functions take as an
    argument, so that the data is never baked into a compiled program. `scores` (T,) is the condition of the window that
    begins at each step, for algorithms that read one.
    """

    def __init__(self, store: EpisodeStore, features: Callable, scores: np.ndarray | None = None):
        episode = store.episode_of_step
        starts = np.concatenate([[0], store.episode_ends[:-1]])
        row = np.arange(store.steps) + episode
        last = store.episode_ends[episode] + episode
        seen = np.asarray(features(store.observations, store.state), np.float32)
        actions = normalise.to_unit(store.actions, *store.card.bounds)
        scores = np.zeros(store.steps) if scores is None else scores
        self.steps = store.steps
        self.arrays = {
            "features": on_device(seen),  # (M, N, D)
            "actions": on_device(actions),  # (T, N, A)
            "rewards": on_device(store.rewards),  # (T, N)
            "terminated": on_device(store.terminated),  # (T,)
            "scores": on_device(scores, np.float32),  # (T,)
            # (M,) the team's, charged on arriving
            "costs": on_device(np.insert(store.team_costs, starts, NOT_ARRIVED), np.float32),
            "row": on_device(row, np.int32),  # (T,) row of the state before the step
            "first_row": on_device(starts[episode] + episode, np.int32),  # (T,)
            "last_row": on_device(last, np.int32),  # (T,)
        }


def draw(arrays: dict[str, Array], key: Key, batch: int, horizon: int, history: int = 0) -> Batch:
    """`batch` windows of `history + horizon` rows, uniform over all steps of the data; row `history` is the present."""
    step = jax.random.randint(key, (batch,), 0, arrays["row"].shape[0])
    return at(arrays, step, horizon, history)


@functools.partial(jax.jit, static_argnums=(2, 3))
def at(arrays: dict[str, Array], step: Array, horizon: int, history: int = 0) -> Batch:
    """The windows whose present is the state before `step` (B,)."""
    offset = jnp.arange(-history, horizon)
    wanted = arrays["row"][step][:, None] + offset
    first = arrays["first_row"][step][:, None]
    last = arrays["last_row"][step][:, None]
    row = jnp.clip(wanted, first, last)
    valid = wanted <= last
    # Step index of the action after each row but the last; a padded one is masked out.
    after = jnp.clip(step[:, None] + offset[:-1], 0, arrays["actions"].shape[0] - 1)
    acted = valid[:, 1:] & (wanted[:, :-1] >= first)
    return Batch(
        features=arrays["features"][row],
        actions=jnp.where(acted[..., None, None], arrays["actions"][after], 0.0),
        valid=valid,
        score=arrays["scores"][step],
        costs=arrays["costs"][row],
        rewards=jnp.where(acted[..., None], arrays["rewards"][after], 0.0),
        terminated=acted & arrays["terminated"][after],
    )


def returns_to_go(reward: np.ndarray, lengths: np.ndarray, discount: float) -> np.ndarray:
    """(T, ...) discounted sum of `reward` (T, ...) from every step to the end of its episode."""
    out = np.zeros(reward.shape, np.float64)
    ends = np.cumsum(lengths)
    # Episodes advance together, from their last steps backwards: as many passes as the longest has steps.
    carry = np.zeros((len(lengths), *reward.shape[1:]))
    for back in range(1, int(lengths.max()) + 1):
        alive = lengths >= back
        index = ends[alive] - back
        carry[alive] = reward[index] + discount * carry[alive]
        out[index] = carry[alive]
    return out
