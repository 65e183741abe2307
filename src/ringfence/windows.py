"""Windows of H steps, drawn on the device from episodes that live there.

A window starts at a step t that has an action. Rows before the episode's start repeat its first state (history),
rows past its end repeat its last one and are marked invalid.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ringfence import normalise, values
from ringfence.data.store import EpisodeStore
from ringfence.types import Array, Batch, Key, PyTree

NOT_ARRIVED = -1.0  # cost of an episode's first row: nothing was charged on arriving there, so nobody knows
MIN_COHORT = 30  # return scores are ranks among at least this many steps


class WindowData:
    """Episodes on the device, with all that is needed to draw windows.

    M = T + E rows of states, T steps. `arrays` is a pytree of device arrays that jitted functions take as an
    argument, so that the data is never baked into a compiled program. `critic` is what states are worth (values.py);
    it is fitted here unless it is given, and only if an algorithm is conditioned on value or ranks plans by it.
    `dynamics` is what actions do (dynamics.py), where somebody has fitted it.
    """

    def __init__(
        self,
        store: EpisodeStore,
        features: Callable,
        discount: float,
        condition: values.Condition | None = None,
        horizon: int = 2,
        updates: int = 8000,
        critic: dict[str, Array] | None = None,
        critic_weight: tuple[float, ...] | None = None,
        quiet: bool = True,
    ):
        episode = store.episode_of_step
        starts = np.concatenate([[0], store.episode_ends[:-1]])
        step = np.arange(store.steps)
        time = step - starts[episode]
        team = store.rewards.mean(1)
        row, last = step + episode, store.episode_ends[episode] + episode
        x = jnp.asarray(np.asarray(features(store.observations, store.state), np.float32))
        bounds = store.card["action_low"], store.card["action_high"]
        self.steps = store.steps
        self.critic = critic
        self.dynamics: PyTree = None
        scores = np.zeros(store.steps)
        if condition is not None:
            togo = returns_to_go(team, store.lengths, discount)
            if critic is None:
                arrived, ahead = np.zeros(len(x), np.float32), np.zeros(len(x), np.float32)
                arrived[row + 1], ahead[row] = team, togo
                # First rows were not arrived in: they take the reward of their own first step, a fair stand-in.
                arrived[starts + np.arange(store.episodes)] = team[starts]
                arrived, ahead = jnp.asarray(arrived), jnp.asarray(ahead)
                longest = int(store.lengths.max()) + 1
                told = {"updates": updates, "period": longest, "weight": critic_weight, "quiet": quiet}
                self.critic = values.fit_critic(x, arrived, ahead, jax.random.key(0), **told)
            if condition == "advantage":
                value = values.values_of(self.critic, x)
                scores = values.normal_scores(values.advantages(value, team, row, last, horizon, discount))
            else:
                scores = return_scores(togo, time)
        self.arrays = {
            "features": x,  # (M, N, D)
            "actions": normalise.to_unit(jnp.asarray(store.actions), *bounds),  # (T, N, A)
            "rewards": jnp.asarray(store.rewards),  # (T, N)
            "terminated": jnp.asarray(store.terminated),  # (T,)
            "scores": jnp.asarray(scores, jnp.float32),  # (T,)
            "costs": jnp.asarray(np.insert(store.costs, starts, NOT_ARRIVED), jnp.float32),  # (M,) charged on arriving
            "row": jnp.asarray(row, jnp.int32),  # (T,) row of the state before the step
            "first_row": jnp.asarray(starts[episode] + episode, jnp.int32),  # (T,)
            "last_row": jnp.asarray(last, jnp.int32),  # (T,)
        }


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
        score=arrays["scores"][step],
        costs=arrays["costs"][row],
        rewards=jnp.where(acted[..., None], arrays["rewards"][after], 0.0),
        terminated=acted & arrays["terminated"][after],
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
    order = np.argsort(time, kind="stable")
    counts = np.bincount(time)
    edges, start, out = [], 0, np.zeros(len(togo))
    for count in np.cumsum(counts):
        if count - start >= MIN_COHORT or count == len(togo):
            edges.append((start, count))
            start = count
    if len(edges) > 1 and edges[-1][1] - edges[-1][0] < MIN_COHORT:
        edges[-2:] = [(edges[-2][0], edges[-1][1])]
    for a, b in edges:
        cohort = order[a:b]
        out[cohort] = values.normal_scores(togo[cohort])
    return out
