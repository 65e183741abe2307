"""The policies that made the data, and what they collect.

The public Simple Spread data (OMAR, Pan et al. 2022) are four tiers of one MATD3 learner; here they are

* `random`: actions uniform in [-1, 1];
* `medium-replay`: everything the learner did from scratch until it was about as good as `medium` (`replay.py`);
* `medium`, `expert`: two snapshots of the learner, rolled out with Gaussian exploration noise.

The files under `policies/` are of five seeded learners, for pools as the public sets are; `benchmarks/behaviour.py`
makes them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from ringfence.datasets import matd3
from ringfence.datasets.matd3 import Mlp
from ringfence.envs.base import PureEnv
from ringfence.envs.rollout import scanned
from ringfence.errors import CheckpointError, UserError, unknown
from ringfence.types import Array, Key, PyTree, Transition
from ringfence.utils.files import whole

POLICIES = Path(__file__).parent / "policies"
LEVELS = ("medium", "expert")  # tiers of a snapshot each
LINEAGES = 5  # seeded learners whose policies ship; pooled tiers are of all of them
TIER_NOISE = 0.1  # std of the exploration noise in the medium and expert data (OMAR's default)
FORMAT = 1  # version of the policy file


class BehaviourPolicy(eqx.Module):
    """One deterministic actor per agent, plus Gaussian exploration noise."""

    actors: Mlp  # leading axis N
    noise: float = eqx.field(converter=float)  # std, in units of action
    info: dict[str, Any] = eqx.field(static=True, default_factory=dict)  # provenance; not used to act

    def act(self, observations: Array, key: Key) -> Array:
        """(B, N, O) -> (B, N, A) in [-1, 1]."""
        return matd3.noisy(matd3.act(self.actors, observations), self.noise, key)


def save_behaviour(policy: BehaviourPolicy, path: str | Path, dtype: DTypeLike = np.float32) -> None:
    """Write the policy as safetensors; the file appears whole or not at all."""
    tensors = {f"weights.{k}": np.ascontiguousarray(w, dtype) for k, w in enumerate(policy.actors.weights)}
    tensors |= {f"biases.{k}": np.ascontiguousarray(b, dtype) for k, b in enumerate(policy.actors.biases)}
    card = {**policy.info, "format": FORMAT, "noise": policy.noise}
    with whole(Path(path)) as temporary:
        save_file(tensors, temporary, {"ringfence": json.dumps(card)})


def load_behaviour(path: str | Path) -> BehaviourPolicy:
    """Read what `save_behaviour` wrote; `info` holds the metadata (task, level, noise, return, command)."""
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"There is no behaviour policy at {path}; pass a file written by save_behaviour.")
    try:
        with safe_open(path, framework="numpy") as file:
            card = json.loads((file.metadata() or {})["ringfence"])
            layers = sum(name.startswith("weights.") for name in file.keys())
            actors = Mlp(
                tuple(jnp.asarray(file.get_tensor(f"weights.{k}"), jnp.float32) for k in range(layers)),
                tuple(jnp.asarray(file.get_tensor(f"biases.{k}"), jnp.float32) for k in range(layers)),
            )
            noise = float(card["noise"])
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{path} is not a whole behaviour policy ({error}); write it again with save_behaviour."
        ) from error
    if card.get("format") != FORMAT or not layers:
        raise CheckpointError(
            f"{path} has behaviour format {card.get('format')} with {layers} layers, this version reads format "
            f"{FORMAT}; write it again with save_behaviour."
        )
    return BehaviourPolicy(actors, noise, card)


def shipped_policy(level: str, task: str = "simple_spread", lineage: int = 0) -> BehaviourPolicy:
    """The behaviour policy of a tier, `medium` or `expert`, for three agents, from the files that ship.

    `lineage`: the seed of the learner that it is a snapshot of, 0 to 4; unpooled tiers are of 0.
    """
    if level not in LEVELS:
        raise unknown("behaviour level", level, LEVELS)
    return load_behaviour(POLICIES / f"{task}-{level}{suffix(lineage)}.safetensors")


def suffix(lineage: int) -> str:
    """Of a file's name."""
    if not 0 <= lineage < LINEAGES:
        raise UserError(f"There is no lineage {lineage}; the package ships 0 to {LINEAGES - 1}.")
    return f"-{lineage}" if lineage else ""


def collect(
    env: PureEnv, policy: BehaviourPolicy | Literal["random"], episodes: int, key: Key, batch: int = 2000
) -> dict[str, np.ndarray]:
    """Roll out `episodes` whole episodes, `batch` at a time; the result depends on `key` and `batch` alone.

    Returns float32 arrays in rollout order: observations (E, L+1, N, O), state (E, L+1, S), actions (E, L, N, A) as
    executed, rewards (E, L, N), costs (E, L). Row t+1 is the state after action t; costs are of that state.
    """
    if isinstance(policy, BehaviourPolicy):
        actors = policy.actors
        noise = policy.noise
        _check_actors(env, actors)
    elif policy == "random":
        actors = None
        noise = 0.0
    else:
        raise UserError(f"Cannot collect with policy {policy!r}; pass 'random' or a BehaviourPolicy.")
    batch = min(batch, episodes)

    def chunk(k: int) -> dict[str, Array]:
        return _rollout_policy(env, actors, jnp.float32(noise), jax.random.fold_in(key, k), batch)

    return gather(chunk, episodes, batch)


def resimulate(env: PureEnv, initial: PyTree, actions: np.ndarray, batch: int = 2000) -> dict[str, np.ndarray]:
    """Play recorded actions (E, L, N, A) from recorded states (leading axis E); same arrays as `collect`."""
    episodes = len(actions)
    batch = min(batch, episodes)

    def chunk(k: int) -> dict[str, Array]:
        # The last chunk repeats its final episode up to a full batch, so that one compilation serves all chunks.
        rows = np.minimum(np.arange(k * batch, (k + 1) * batch), episodes - 1)
        start = jax.tree.map(lambda x: jnp.asarray(x[rows]), initial)
        return _rollout_actions(env, start, jnp.asarray(actions[rows], jnp.float32))

    return gather(chunk, episodes, batch)


@partial(jax.jit, static_argnums=(0, 4))
def _rollout_policy(env: PureEnv, actors: Mlp | None, noise: Array, key: Key, batch: int) -> dict[str, Array]:
    key_reset, key = jax.random.split(key)

    def choose(state, key):
        if actors is None:
            return jax.random.uniform(key, (batch, env.n_agents, env.action_dim), minval=-1.0, maxval=1.0)
        return matd3.noisy(matd3.act(actors, env.observe(state)), noise, key)

    return rollout(env, env.reset(key_reset, batch), choose, jax.random.split(key, env.episode_length))


@partial(jax.jit, static_argnums=0)
def _rollout_actions(env: PureEnv, first: PyTree, actions: Array) -> dict[str, Array]:
    return rollout(env, first, lambda _, action: action, jnp.swapaxes(actions, 0, 1))


def rollout(env: PureEnv, first: PyTree, choose: Callable, xs: PyTree) -> dict[str, Array]:
    """Arrays (B, L, ...) of the episodes that `envs.rollout.scanned` plays."""
    return logged(env, *scanned(env, first, choose, xs))


def logged(env: PureEnv, states: PyTree, actions: Array, transitions: Transition) -> dict[str, Array]:
    """What logs hold of episodes (B, L, ...)."""
    return {
        "observations": jax.vmap(env.observe, 1, 1)(states),
        "state": jax.vmap(env.global_state, 1, 1)(states),
        "actions": actions,
        "rewards": transitions.reward,
        "costs": transitions.cost,
    }


def gather(chunk: Callable[[int], dict[str, Array]], episodes: int, batch: int) -> dict[str, np.ndarray]:
    """Fill preallocated arrays chunk by chunk, so that the peak is the result plus one chunk."""
    if episodes < 1 or batch < 1:
        raise UserError(f"Cannot collect {episodes} episodes in batches of {batch}; both must be at least 1.")
    out: dict[str, np.ndarray] = {}
    for k, start in enumerate(range(0, episodes, batch)):
        part = chunk(k)
        stop = min(start + batch, episodes)
        for name, x in part.items():
            if name not in out:
                out[name] = np.empty((episodes, *x.shape[1:]), np.float32)
            out[name][start:stop] = np.asarray(x)[: stop - start]
    return out


def _check_actors(env: PureEnv, actors: Mlp) -> None:
    wanted = (env.n_agents, env.observation_dim, env.action_dim)
    found = (*actors.weights[0].shape[:2], actors.weights[-1].shape[-1])
    if found != wanted:
        raise UserError(
            f"The behaviour policy is for (agents, observation, action) = {found}, the task has {wanted}; "
            "give one of this task."
        )
