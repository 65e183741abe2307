"""The policies that made the data, and what they collect.

The public Simple Spread data (OMAR, Pan et al. 2022) are four tiers of one MATD3 learner; here they are

* `random`: actions uniform in [-1, 1];
* `medium-replay`: everything the learner did from scratch until it was about as good as `medium`;
* `medium`, `expert`: two snapshots of the learner, rolled out with Gaussian exploration noise.

The files under `policies/` are of five seeded learners, for pools as the public sets are; `benchmarks/behaviour.py`
makes them. The replay of another seed, or in other physics, is made by learning again, a minute or two on a core.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from ringfence.datasets import matd3
from ringfence.datasets.matd3 import Learner, MATD3Config, Mlp, Transitions
from ringfence.envs.base import PureEnv, scanned
from ringfence.envs.simple_spread import SimpleSpread, SpreadState
from ringfence.errors import CheckpointError, UserError, unknown
from ringfence.types import Array, Key, PyTree, Transition
from ringfence.utils.files import whole

POLICIES = Path(__file__).parent / "policies"
LEVELS = ("medium", "expert")  # tiers of a snapshot each
LINEAGES = 5  # seeded learners whose policies ship; pooled tiers are of all of them
TIER_NOISE = 0.1  # std of the exploration noise in the medium and expert data (OMAR's default)
FORMAT = 1  # version of the policy file
REPLAY_TRANSITIONS = 97_500  # size of the public medium-replay set
REPLAY_SHARE = 780  # episodes of the replay that ship of each lineage but the first, spread evenly over it
ACTION_STEPS = 127  # of [0, 1], in those


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


def shipped_policy(level: str, lineage: int = 0) -> BehaviourPolicy:
    """The behaviour policy of a tier, `medium` or `expert`, for three agents, from the files that ship.

    `lineage`: the seed of the learner that it is a snapshot of, 0 to 4; unpooled tiers are of 0.
    """
    if level not in LEVELS:
        raise unknown("behaviour level", level, LEVELS)
    return load_behaviour(POLICIES / f"simple_spread-{level}{suffix(lineage)}.safetensors")


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
        wanted = (env.n_agents, env.observation_dim, env.action_dim)
        found = (*actors.weights[0].shape[:2], actors.weights[-1].shape[-1])
        if found != wanted:
            raise UserError(
                f"The behaviour policy is for (agents, observation, action) = {found}, the task has {wanted}; "
                "give one of this task."
            )
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
    """Arrays (B, L, ...) of the episodes that `envs.base.scanned` plays."""
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


class BehaviourRun(NamedTuple):
    """What a learner left behind. E episodes in the order of collection, K snapshots of the actors."""

    actors: Mlp  # leading axes (K, N)
    seen: np.ndarray  # (K,) transitions collected before each snapshot
    returns: np.ndarray  # (K,) mean return of the episodes since the previous snapshot, noise included
    initial: PyTree  # simulator states at reset, leading axis E
    actions: np.ndarray  # (E, L, N, A) float16, exactly as executed


class _Memory(NamedTuple):
    """The replay buffer, by episode: it holds the whole run, so nothing is ever overwritten."""

    states: PyTree  # (E, L+1, ...)
    actions: Array  # (E, L, N, A)
    rewards: Array  # (E, L, N)
    terminated: Array  # (E, L)


def train_behaviour(
    env: PureEnv,
    config: MATD3Config,
    key: Key,
    transitions: int,
    progress: Callable[[int, float], None] | None = None,
) -> BehaviourRun:
    """Train MATD3 from scratch for at least `transitions` environment steps and keep everything it did.

    `progress(transitions_seen, mean_return)` is called after every snapshot. Memory grows with the run: about 200
    bytes per transition for three agents.
    """
    per_round = env.episode_length * config.envs
    rounds = -(-transitions // per_round)
    if rounds < 1:
        raise UserError(f"A behaviour run of {transitions} transitions is empty; ask for at least one.")
    key, key_init = jax.random.split(key)
    learner = _init_learner(env, config, key_init)
    memory = _empty_memory(env, rounds * config.envs)
    snapshots, seen, returns = [], [], []
    done = 0
    while done < rounds:
        count = min(config.snapshot_every, rounds - done)
        numbers = jnp.arange(done, done + count)
        keys = jax.vmap(partial(jax.random.fold_in, key))(numbers)
        learner, memory, scores = _train_rounds(env, config, learner, memory, numbers, keys)
        done += count
        snapshots.append(jax.tree.map(np.asarray, learner.actors))
        seen.append(done * per_round)
        returns.append(float(scores.mean()))
        if progress is not None:
            progress(seen[-1], returns[-1])
    return BehaviourRun(
        actors=jax.tree.map(lambda *x: np.stack(x), *snapshots),
        seen=np.array(seen),
        returns=np.array(returns, np.float32),
        initial=jax.tree.map(lambda x: np.asarray(x[:, 0]), memory.states),
        actions=np.asarray(memory.actions).astype(np.float16),
    )


def replay_episodes(env: SimpleSpread, episodes: int = 3900, seed: int = 0) -> dict[str, np.ndarray]:
    """`medium-replay`: what the learner did from scratch until it was about medium; same arrays as `collect`.

    Seed 0 with the shipped physics (three agents, `velocity_first`) re-simulates the shipped actions, which frees
    the data from differences of floating-point arithmetic between machines; anything else runs the learner. Fewer
    than all 3900 episodes are spread evenly over the run, in order, so a small set has the mix of the whole. The
    learner always learns from the `omar` reward; `env` decides which reward and cost are recorded.
    """
    total = REPLAY_TRANSITIONS // env.episode_length
    if not 1 <= episodes <= total:
        raise UserError(f"A medium-replay set holds 1 to {total} episodes, got {episodes}; the run is not longer.")
    shipped = SimpleSpread()
    physics = ("n_agents", "integrator", "episode_length", "half_width")
    if seed == 0 and all(getattr(env, f) == getattr(shipped, f) for f in physics):
        initial, actions = _load_replay(POLICIES / "simple_spread-medium-replay.npz")
    else:
        teacher = replace(env, reward="omar")
        run = train_behaviour(teacher, MATD3Config(), jax.random.key(seed), REPLAY_TRANSITIONS)
        initial = run.initial
        actions = run.actions
    rows = np.linspace(0, total - 1, episodes).round().astype(int)
    return resimulate(env, jax.tree.map(lambda x: x[rows], initial), actions[rows])


def shipped_replay(env: SimpleSpread, episodes: int, lineage: int) -> dict[str, np.ndarray]:
    """`episodes` of the replay that ships of a lineage, spread evenly over its learning; same arrays as `collect`."""
    if not 1 <= episodes <= REPLAY_SHARE:
        raise UserError(f"A lineage gives 1 to {REPLAY_SHARE} episodes of its replay, got {episodes}; ask for fewer.")
    initial, actions = _load_replay(POLICIES / f"simple_spread-medium-replay{suffix(lineage)}.npz")
    rows = np.linspace(0, len(actions) - 1, episodes).round().astype(int)
    return resimulate(env, jax.tree.map(lambda x: x[rows], initial), actions[rows])


def actions_of(actions: np.ndarray) -> np.ndarray:
    """Actions in [-1, 1] of a file that may hold them in steps of 1/127."""
    return actions.astype(np.float32) / ACTION_STEPS if actions.dtype == np.int8 else actions


def _load_replay(path: Path) -> tuple[SpreadState, np.ndarray]:
    try:
        with np.load(path) as file:
            position, landmarks, actions = file["position"], file["landmarks"], file["actions"]
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise CheckpointError(f"{path} is not a whole replay ({error}); install the package again.") from error
    return SpreadState(position, np.zeros_like(position), landmarks), actions_of(actions)


# --- the learner ---


@partial(jax.jit, static_argnums=(0, 1))  # dozens of small arrays: one compilation instead of one for each operation
def _init_learner(env: PureEnv, config: MATD3Config, key: Key) -> Learner:
    n = env.n_agents
    width = env.observation_dim
    return matd3.init(config, key, n, width, n * width, env.action_dim)


def _empty_memory(env: PureEnv, episodes: int) -> _Memory:
    length = env.episode_length
    n = env.n_agents
    state = jax.eval_shape(partial(env.reset, batch=1), jax.random.key(0))
    return _Memory(
        states=jax.tree.map(lambda s: jnp.zeros((episodes, length + 1, *s.shape[1:]), s.dtype), state),
        actions=jnp.zeros((episodes, length, n, env.action_dim)),
        rewards=jnp.zeros((episodes, length, n)),
        terminated=jnp.zeros((episodes, length), bool),
    )


@partial(jax.jit, static_argnums=(0, 1), donate_argnums=(2, 3))
def _train_rounds(
    env: PureEnv, config: MATD3Config, learner: Learner, memory: _Memory, rounds: Array, keys: Array
) -> tuple[Learner, _Memory, Array]:
    """For every round: one episode in each environment, then the updates. Returns the rounds' mean returns too."""

    def one_round(carry, xs):
        learner, memory = carry
        number, key = xs
        key_collect, key_update = jax.random.split(key)
        fresh = _explore(env, config, learner.actors, number < config.random_rounds, key_collect)
        memory = jax.tree.map(
            lambda all, new: jax.lax.dynamic_update_slice_in_dim(all, new, number * config.envs, 0), memory, fresh
        )
        stored = (number + 1) * config.envs

        def one_update(learner, xs):
            index, key = xs
            return _update(env, config, learner, memory, stored, index % config.delay == 0, key), None

        # The random rounds only fill the buffer; the learner starts with the first round of its own.
        steps = (jnp.arange(config.updates), jax.random.split(key_update, config.updates))
        learner = jax.lax.cond(
            number + 1 >= config.random_rounds,
            lambda learner: jax.lax.scan(one_update, learner, steps)[0],
            lambda learner: learner,
            learner,
        )
        return (learner, memory), fresh.rewards.mean(-1).sum(-1).mean()

    (learner, memory), scores = jax.lax.scan(one_round, (learner, memory), (rounds, keys))
    return learner, memory, scores


def _explore(env: PureEnv, config: MATD3Config, actors: Mlp, uniform: Array, key: Key) -> _Memory:
    """One episode in each of the config's environments, laid out as the buffer's rows."""
    key_reset, key = jax.random.split(key)
    first = env.reset(key_reset, config.envs)

    def choose(state: PyTree, key: Key) -> Array:
        key_noise, key_uniform = jax.random.split(key)
        action = matd3.noisy(matd3.act(actors, env.observe(state)), config.noise, key_noise)
        action = jnp.where(uniform, jax.random.uniform(key_uniform, action.shape, minval=-1.0, maxval=1.0), action)
        # Executed at half precision, so that a replay file of half the size repeats the run exactly.
        return action.astype(jnp.float16).astype(jnp.float32)

    states, actions, out = scanned(env, first, choose, jax.random.split(key, env.episode_length))
    return _Memory(states, actions, out.reward, out.terminated)


def _update(
    env: PureEnv, config: MATD3Config, learner: Learner, memory: _Memory, stored: Array, act: Array, key: Key
) -> Learner:
    """One critic update and, if `act`, one update of actors and targets."""
    key_rows, key_noise = jax.random.split(key)
    drawn = jax.random.randint(key_rows, (config.batch,), 0, stored * env.episode_length)
    episode, step = jnp.divmod(drawn, env.episode_length)
    observations = env.observe(jax.tree.map(lambda x: x[episode, step], memory.states))
    next_observations = env.observe(jax.tree.map(lambda x: x[episode, step + 1], memory.states))
    batch = Transitions(
        observations=observations,
        seen=observations.reshape(config.batch, -1),
        actions=memory.actions[episode, step],
        rewards=memory.rewards[episode, step],
        terminated=memory.terminated[episode, step],
        next_observations=next_observations,
        next_seen=next_observations.reshape(config.batch, -1),
    )
    return matd3.update(config, learner, batch, act, key_noise)
