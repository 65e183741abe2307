"""Logs of anybody's simulator: a policy is played through PettingZoo's parallel API and kept as an episode store."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.envs.episode import Cost, Episode, Shape, check, given_as
from ringfence.errors import StoreError, UserError, whole_number
from ringfence.logs.store import EpisodeStore
from ringfence.utils.files import writable
from ringfence.utils.progress import Progress
from ringfence.utils.renamed import deprecated

EACH = 100  # episodes after which what is there is kept
KEPT = ("observations", "actions", "rewards", "costs")


def record(
    make_env: Callable[[], Any],
    policy: Callable[..., np.ndarray] | None = None,
    *,
    episodes: int = 500,
    out: str | os.PathLike | None = None,
    seed: int = 0,
    cost: Cost | None = None,
    max_episode_steps: int = 100_000,
    card: dict | None = None,
    quiet: bool = True,
    longest: int | None = None,
) -> EpisodeStore:
    """The logs of `episodes` episodes of `make_env()`, a PettingZoo `ParallelEnv` whose agents begin and end together.

    `policy` takes observations (N, O) and the state (S,), or None where the simulator tells none, and gives actions
    (N, A); what has `act` and `reset` (a `Controller`, a guarded callable) is reset with every episode. None draws
    actions uniformly within the action spaces' bounds. Episode k is reset with `seed` + k, and its draws follow from
    that. Costs are `cost(infos)` of the team, else each agent's `cost` in its infos; where there are none, 0. Told as a
    dictionary they are those of constraints, whose limits per episode `card["constraints"]` tells (0 by default).

    With `out` a store's file is written every hundred episodes, and a recording of the same simulator, policy's name
    and seed goes on from there. `max_episode_steps` without an end are refused. `card` adds fields to the store's.
    """
    if longest is not None:
        deprecated("longest of record", "max_episode_steps")
        max_episode_steps = longest
    whole_number("episodes", episodes, 1)
    whole_number("seed", seed, 0, 2**31)
    whole_number("max_episode_steps", max_episode_steps, 1)
    if not callable(make_env):
        raise UserError(f"make_env is a {type(make_env).__name__}; give a function, or the class, that makes one.")
    file = None if out is None else writable(out)
    env = make_env()
    check(env, "action_space")
    name = getattr(policy, "__qualname__", type(policy).__name__) if policy is not None else "uniform"
    if code := getattr(policy, "__code__", None):  # two lambdas have one name
        name += "-" + hashlib.blake2b(code.co_code + repr(code.co_consts).encode(), digest_size=3).hexdigest()
    told = {"simulator": type(env).__name__, "policy": name, "first_seed": seed}
    done = _before(file, told, episodes)
    if done is not None and done.episodes >= episodes:
        return done
    (low, high, width), shown = _bounds(env), Shape(state=None if _tells_state(env, seed) else 0)
    act = getattr(policy, "act", policy)
    made: list[dict] = []
    begun = 0 if done is None else done.episodes
    with Progress(f"recording {type(env).__name__}", episodes, begun, quiet) as bar:
        for k in range(begun, episodes):
            if hasattr(policy, "reset"):
                policy.reset()
            chance = np.random.default_rng((seed, k))
            made.append(_played(env, shown, act, seed + k, cost, max_episode_steps, low, high, width, chance))
            bar.advance(1)
            if file is not None and (len(made) == EACH or k + 1 == episodes):
                done, made = _grown(done, made, told, (low, high), env, card), []
                done.save(file)
    return done if not made else _grown(done, made, told, (low, high), env, card)


def _played(
    env, shown: Shape, act, seed: int, cost, max_episode_steps: int, low: float, high: float, width: int, chance
) -> dict:
    """Arrays of one episode of L steps: observations (L+1, N, O), actions (L, N, A), ..."""
    episode = Episode(env, shown, seed, max_episode_steps)
    seen, states, acted = [episode.seen], [episode.state], []
    while episode.running:
        shape = (len(episode.agents), width)
        action = chance.uniform(low, high, shape) if act is None else act(episode.seen, episode.state)
        action = given_as("actions", action, shape)
        if (action < low - 1e-4 * (high - low)).any() or (action > high + 1e-4 * (high - low)).any():
            raise UserError(
                f"The policy gave actions from {action.min():.4g} to {action.max():.4g}, the action space is from "
                f"{low:g} to {high:g}; clip or scale them."
            )
        acted.append(np.clip(action, low, high))
        episode.step(acted[-1], cost)
        episode.charge(0.0)
        if not episode.showed_end:
            raise UserError(
                f"step() of {type(env).__name__} tells no observations where an episode ends; logs keep the state that "
                "the last action leads to, so return them."
            )
        seen.append(episode.seen)
        states.append(episode.state)
    wide = lambda costs: np.stack([np.broadcast_to(c, len(episode.agents)) for c in costs])  # noqa: E731
    names = episode.constraints[0] if episode.constraints else ()
    return {
        "observations": np.stack(seen),
        "actions": np.stack(acted),
        "rewards": np.stack(episode.rewards),
        "costs": wide(episode.costs),
        "constraints": {k: wide([c[k] for c in episode.constraints]) for k in names},
        "each": any(np.ndim(c) for c in episode.costs),
        "state": None if states[0] is None else np.stack(states),
        "terminated": episode.terminated,
    }


def _grown(done: EpisodeStore | None, made: list[dict], told: dict, bounds, env, card: dict | None) -> EpisodeStore:
    """The store with these episodes behind those that it has."""
    shapes = {tuple(m[name].shape[1:] for name in KEPT) for m in made}
    if len(shapes) > 1:
        raise UserError(
            f"{type(env).__name__} changes its agents or what they see between episodes; keep them the same."
        )
    lengths = np.array([len(m["actions"]) for m in made])
    told_of = [x for m in made for x in (m["costs"], *m["constraints"].values())]
    each = any(m["each"] for m in made) and not all((x == x[:, :1]).all() for x in told_of)
    if done is not None:
        each = each or done.costs.ndim == 2
    names = list(made[0]["constraints"])
    if any(list(m["constraints"]) != names for m in made):
        raise UserError(f"{type(env).__name__} names other constraints in some episodes; name the same ones in all.")

    def charged(of: Callable[[dict], np.ndarray]) -> np.ndarray:
        costs = np.concatenate([of(m) for m in made])
        return costs if each else costs[:, 0]

    state = None if made[0]["state"] is None else [m["state"] for m in made]
    fresh = EpisodeStore.from_steps(
        np.concatenate([m["observations"][:-1] for m in made]),
        np.concatenate([m["actions"] for m in made]),
        np.concatenate([m["rewards"] for m in made]),
        costs={k: charged(lambda m, k=k: m["constraints"][k]) for k in names} or charged(lambda m: m["costs"]),
        episode_ends=np.cumsum(lengths),
        final_observations=np.stack([m["observations"][-1] for m in made]),
        state=None if state is None else np.concatenate([s[:-1] for s in state]),
        final_state=None if state is None else np.stack([s[-1] for s in state]),
        terminated=np.array([m["terminated"] for m in made]),
        card={
            "task": "recorded",
            "simulator": told["simulator"],
            "provenance": f"recorded of {told['policy']} in {told['simulator']}",
            "recorded": told,
            "agents": [str(a) for a in env.possible_agents],
            "action_low": bounds[0],
            "action_high": bounds[1],
            **(card or {}),
        },
    )
    return fresh if done is None else done.followed_by(fresh)


def _before(file: Path | None, told: dict, episodes: int) -> EpisodeStore | None:
    """What an interrupted recording has kept."""
    if file is None or not file.exists():
        return None
    store = EpisodeStore.load(file)
    if store.card.get("recorded") != told:
        raise StoreError(
            f"'{file}' holds another recording ({store.card.get('recorded')}, not {told}); delete it or name another "
            "file."
        )
    return store if store.episodes <= episodes else store.select(np.arange(store.episodes) < episodes)


def _tells_state(env, seed: int) -> bool:
    """PettingZoo's base class has a method that raises."""
    if not hasattr(env, "state"):
        return False
    try:
        env.reset(seed=seed)
        env.state()
    except NotImplementedError:
        return False
    return True


def _bounds(env) -> tuple[float, float, int]:
    """(low, high, entries) of every agent's actions."""
    spaces = [env.action_space(a) for a in env.possible_agents]
    if any(not hasattr(s, "low") or len(s.shape) != 1 for s in spaces):
        raise UserError(
            f"{type(env).__name__} has an action space {spaces[0]}; agents need a Box of one axis, since actions are "
            "numbers here."
        )
    widths = {s.shape[0] for s in spaces}
    low, high = min(float(s.low.min()) for s in spaces), max(float(s.high.max()) for s in spaces)
    if len(widths) > 1 or not np.isfinite([low, high]).all():
        raise UserError(
            f"{type(env).__name__} has action spaces of {sorted(widths)} entries from {low:g} to {high:g}; they must "
            "be alike for all agents, and bounded."
        )
    return low, high, widths.pop()
