"""Logs of anybody's simulator: a policy is played through PettingZoo's parallel API and kept as an episode store."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ringfence.envs.base import Memoryless, Moment, rollout
from ringfence.envs.episode import EARLY_ENDS, Cost, Shape, SideBySide, is_vector, made
from ringfence.envs.padded import PaddedEnv
from ringfence.errors import Interrupted, StoreError, UserError, known, of_kind, whole_number
from ringfence.logs.schema import given_card
from ringfence.logs.store import EpisodeStore
from ringfence.problem.bounds import Bounds
from ringfence.problem.origins import FIELDS as ORIGINS
from ringfence.utils import interrupts
from ringfence.utils.files import writable
from ringfence.utils.functions import Streams, content_of, of_both
from ringfence.utils.given import given_as
from ringfence.utils.progress import Progress

EACH = 100  # episodes after which what is there is kept


def collect(
    make_env: Callable[[], Any],
    policy: Callable[..., np.ndarray] | None = None,
    *,
    episodes: int = 500,
    out: str | os.PathLike | None = None,
    seed: int = 0,
    cost: Cost | None = None,
    max_episode_steps: int = 100_000,
    early_ends: Literal["refuse", "cut", "skip"] = "refuse",
    card: dict | None = None,
    quiet: bool = True,
) -> EpisodeStore:
    """The logs of `episodes` episodes of `make_env()`, a PettingZoo `ParallelEnv` whose agents begin and end together.

    `policy` takes observations (N, O) and, if it has a second argument, the state (S,), or None where the simulator
    has none, and gives actions (N, A). One with `act` and `reset` (a `Controller`, a guarded callable) is reset with
    every episode. None draws actions uniformly within the action spaces' bounds. Episode k is reset with `seed` + k,
    and its draws follow from that. Costs are `cost(infos)` of the team, else each agent's `cost` in its infos; where
    there are none, 0. A dictionary of costs names constraints, whose limits per episode `card["constraints"]` holds (0
    by default).

    With `out` a store's file is written every hundred episodes, and a collection of the same simulator, policy, cost,
    card and seed goes on from there; so does one that was refused or interrupted, since what was finished is kept. The
    same are those of the same code and values, that of one's own modules included; what tells nothing of what it holds
    is never the same, and a policy that changes as it acts tells it by an attribute `made_of`.
    `max_episode_steps` without an end are refused. `early_ends` says what becomes of an episode that an agent leaves
    before its team: it is refused, cut there, or skipped and counted on the card. `card` adds fields to the store's.
    """
    known("early_ends", early_ends, EARLY_ENDS)
    whole_number("episodes", episodes, 1)
    whole_number("seed", seed, 0, 2**31)
    whole_number("max_episode_steps", max_episode_steps, 1)
    given_card(card)
    file = None if out is None else writable(out)
    of_kind("cost", cost, Callable | None, "give a function of the infos of a step")
    env = made(make_env, "action_space")
    player = _Player.of(policy)
    if file is not None:
        player.reset()  # what it remembers of other episodes is none of what it is made of
    simulated = make_env, type(env), type(getattr(env, "unwrapped", env))
    made_of = {"simulator": simulated, "policy": policy, "cost": cost, "card": sorted((card or {}).items())}
    source = {
        "simulator": _called(env),
        "policy": player.name,
        "first_seed": seed,
        "early_ends": early_ends,
        "made_of": {
            name: content_of(part, _streams(policy) if name == "policy" else "by kind")
            for name, part in made_of.items()
        },
    }
    kept = _kept_before(file, source, episodes)
    if kept is not None and _begun(kept) >= episodes:
        return kept
    space = _space(env)
    shape = Shape(state=None if _has_state(env, seed) else 0, double=True)
    simulators = SideBySide([env], shape, max_episode_steps, early_ends, cost, lambda seen, state: np.zeros(len(seen)))
    keeper = _Keeper(env, space.bounds, source, card, file, kept, _skipped(kept))
    return keeper.filled(episodes, lambda k: _played(simulators, player, space, seed, k), quiet)


@dataclass(eq=False)
class _Keeper:
    """What was collected so far: in a store, and since that was last kept."""

    env: Any
    bounds: Bounds
    source: dict[str, Any]
    card: dict | None
    file: Path | None
    kept: EpisodeStore | None
    skipped: int
    fresh: list[_Played] = field(default_factory=list)

    def add(self, played: _Played | None) -> None:
        """An episode, None of one that was skipped; every hundredth time all is written."""
        if played is None:
            self.skipped += 1
        else:
            self.fresh.append(played)
        if self.file is not None and len(self.fresh) == EACH:
            self.keep()

    def filled(self, episodes: int, play: Callable[[int], _Played | None], quiet: bool) -> EpisodeStore:
        """The store of so many episodes, of which those that are not there are played."""
        simulator = self.source["simulator"]
        begun = _begun(self.kept)
        with Progress(f"collecting {simulator}", episodes, begun, quiet) as bar:
            try:
                for k in range(begun, episodes):
                    with interrupts.held(k > begun):
                        self.add(play(k))
                    if k == 0 and "hazard" not in (self.card or {}):
                        _warn_unless_charged(simulator, self.fresh)
                    bar.advance(1)
            except KeyboardInterrupt as stopped:
                self.keep()
                raise Interrupted(self.said(episodes), self.kept) from stopped
            finally:  # a refusal costs no episode that was finished
                self.keep()
        if self.kept is None:
            raise UserError(f"All {episodes} episodes of {simulator} were skipped: agents leave each; cut them.")
        return self.kept

    def keep(self) -> None:
        """Join and write what is fresh."""
        if self.fresh:
            how = self.env, self.bounds, self.source, self.card
            # The first episode says by what all are moved, wherever a collection was interrupted.
            like = self.kept or _store(self.fresh[:1], *how, None)
            made = _store(self.fresh, *how, like)
            self.kept = made if self.kept is None else self.kept.followed_by(made)
            self.fresh = []
        if self.kept is not None and self.skipped != _skipped(self.kept):
            self.kept = replace(self.kept, card=self.kept.card.updated(skipped_episodes=self.skipped))
        if self.kept is not None and self.file is not None:
            self.kept.save(self.file)

    def said(self, episodes: int) -> str:
        """What an interruption leaves."""
        done = 0 if self.kept is None else self.kept.episodes
        where = f" and are in '{self.file}'; the same call goes on from there" if self.file and done else ""
        return f"interrupted; {done} of {episodes} episodes were finished{where}"


def _begun(store: EpisodeStore | None) -> int:
    """Episodes that were played so far, those left out included."""
    return 0 if store is None else store.episodes + _skipped(store)


def _skipped(store: EpisodeStore | None) -> int:
    """Episodes that a collection left out."""
    return 0 if store is None else int(store.card.extra.get("skipped_episodes", 0))


@dataclass(frozen=True)
class _Player:
    """What acts, and what begins an episode of it."""

    name: str
    act: Callable[..., Any] | None  # None: uniform draws
    reset: Callable[[], object]

    @classmethod
    def of(cls, policy: Any) -> _Player:
        if policy is not None and not callable(getattr(policy, "act", policy)):
            raise UserError(f"policy is a {type(policy).__name__}; give a function of observations, or what has `act`.")
        if policy is None:
            return cls("uniform", None, lambda: None)
        name = getattr(policy, "__qualname__", type(policy).__name__)
        return cls(name, of_both(getattr(policy, "act", policy)), getattr(policy, "reset", lambda: None))


@dataclass(frozen=True)
class _Space:
    """Of the agents' actions."""

    bounds: Bounds
    entries: int
    has_entry: np.ndarray | None = None  # (N, A) bool, where agents have different numbers of entries

    def clipped(self, actions: np.ndarray) -> np.ndarray:
        """Actions (N, A) within the bounds; more than a rounding outside is refused. What an agent has not stays at the
        middle."""
        if self.has_entry is not None:
            actions = np.where(self.has_entry, actions, self.bounds.middle)
        if self.bounds.outside(actions).any():
            raise UserError(
                f"The policy gave actions from {actions.min():.4g} to {actions.max():.4g}, the action space is from "
                f"{self.bounds}; clip or scale them."
            )
        clipped = np.clip(actions, self.bounds.low, self.bounds.high)
        return clipped.astype(np.float32)  # a space of single precision holds no number of double precision


@dataclass(frozen=True, eq=False)
class _Played:
    """An episode of L steps."""

    observations: np.ndarray  # (L+1, N, O)
    actions: np.ndarray  # (L, N, A)
    rewards: np.ndarray  # (L, N)
    costs: np.ndarray  # (L, N)
    constraints: dict[str, np.ndarray]  # (L, N) each
    by_agent: bool  # some step had a cost of each agent
    state: np.ndarray | None  # (L+1, S)
    terminated: bool
    charged: bool  # some step told a cost
    told: frozenset[str]  # what infos tell

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Of a step, which all episodes share."""
        return tuple(x.shape[1:] for x in (self.observations, self.actions, self.rewards, self.costs))

    @property
    def one_cost(self) -> bool:
        """Whether all agents have the same costs throughout."""
        return all(bool((x == x[:, :1]).all()) for x in (self.costs, *self.constraints.values()))


def _played(env: SideBySide, player: _Player, space: _Space, first_seed: int, k: int) -> _Played | None:
    """Episode k; None where it is skipped."""
    player.reset()
    env.reset([first_seed + k])
    episode = env.episodes[0]
    n_agents = len(episode.agents)
    shape = (n_agents, space.entries)
    steps: list[Moment] = []

    def act(observations: np.ndarray, state: np.ndarray | None, chance: np.random.Generator) -> np.ndarray:
        if player.act is None:
            action = chance.uniform(space.bounds.low, space.bounds.high, shape)
        else:  # it may write into what it sees
            action = player.act(observations[0].copy(), None if state is None else state[0].copy())
        action = given_as("actions", action, shape, "the simulator", "return one action for each agent")
        return space.clipped(action)[None]

    def keep(now: Moment) -> None:
        if len(episode.rewards) == len(steps):  # nobody shows where the last action led
            return
        if not now.outcome.shown[0]:
            raise UserError(
                f"step() of {episode.name} tells no observations where an episode ends; logs keep the state that the "
                "last action leads to, so return them."
            )
        steps.append(now)

    rollout(Memoryless(act), env, keep, itertools.repeat(np.random.default_rng((first_seed, k))))
    if episode.skipped:
        return None
    names = list(episode.constraints[0]) if episode.constraints else []
    observations, states = zip(steps[0].before, *(now.after for now in steps))
    return _Played(
        observations=np.concatenate(observations),
        actions=np.concatenate([now.decided.action for now in steps]),
        rewards=np.stack(episode.rewards),
        costs=_of_every_agent(episode.costs, n_agents),
        constraints={name: _of_every_agent([costs[name] for costs in episode.constraints], n_agents) for name in names},
        by_agent=any(np.ndim(cost) > 0 for cost in episode.costs),
        state=None if states[0] is None else np.concatenate(states),
        terminated=episode.terminated,
        charged=episode.charged,
        told=frozenset(episode.told),
    )


def _streams(policy: Any) -> Streams:
    """How random streams of a policy's own are compared: where they stand once it is reset. Without a reset nobody
    knows where they stood, and going on might draw the same again."""
    return "by state" if hasattr(policy, "reset") else "as unknown"


def _called(env: Any) -> str:
    """The name of a simulator: its class's, or what is within a wrapper of PettingZoo's calls itself."""
    own = getattr(env, "metadata", None) or {}
    wrapped = type(env).__module__.startswith("pettingzoo.utils.")
    return str(own["name"]) if wrapped and own.get("name") else type(env).__name__


def _warn_unless_charged(simulator: str, first: list[_Played]) -> None:
    """Say so, before hours are spent, where an episode tells no cost."""
    if not first or first[0].charged:
        return
    told = ", ".join(sorted(first[0].told)[:5])
    warnings.warn(
        f"{simulator} tells no cost{f', its infos {told}' if told else ''}: these logs have none and teach no danger; "
        "give each agent's info a 'cost', pass cost=, a function of the infos, or name a formula in card['hazard'].",
        stacklevel=3,
    )


def _of_every_agent(costs: Sequence[float | np.ndarray], n_agents: int) -> np.ndarray:
    """(L, N): a step's cost of the team is everybody's."""
    return np.stack([np.broadcast_to(cost, n_agents) for cost in costs])


def _store(
    played: list[_Played],
    env: Any,
    bounds: Bounds,
    source: dict[str, Any],
    card: dict | None,
    like: EpisodeStore | None,
) -> EpisodeStore:
    """The store of these episodes, moved `like` others; costs are of each agent where theirs are, where agents are
    homogeneous, or where agents' costs differ."""
    simulator = source["simulator"]
    if len({one.shapes for one in played}) > 1:
        raise UserError(f"{simulator} changes its agents or what they see between episodes; keep them the same.")
    names = list(played[0].constraints)
    if any(list(one.constraints) != names for one in played):
        raise UserError(f"{simulator} names other constraints in some episodes; name the same ones in all.")
    told = any(one.by_agent for one in played)
    of_each = told and (bool((card or {}).get("homogeneous")) or not all(one.one_cost for one in played))
    of_each = of_each or (like is not None and like.costs.ndim == 2)

    def charged(parts: list[np.ndarray]) -> np.ndarray:
        costs = np.concatenate(parts)
        return costs if of_each else costs[:, 0]

    card = card or {}
    if like is not None:
        said = {name: value for name in (*ORIGINS, "warnings") if (value := getattr(like.card, name))}
        card = card | said
        moved = [like.card.origins.taken(one.observations, one.state) for one in played]  # in single precision
        played = [replace(one, observations=seen, state=state) for one, (seen, state) in zip(played, moved)]

    constraints = {name: charged([one.constraints[name] for one in played]) for name in names}
    states = [one.state for one in played if one.state is not None]
    return EpisodeStore.from_steps(
        np.concatenate([one.observations[:-1] for one in played]),
        np.concatenate([one.actions for one in played]),
        np.concatenate([one.rewards for one in played]),
        costs=constraints or charged([one.costs for one in played]),
        episode_ends=np.cumsum([len(one.actions) for one in played]),
        final_observations=np.stack([one.observations[-1] for one in played]),
        state=np.concatenate([state[:-1] for state in states]) if states else None,
        final_state=np.stack([state[-1] for state in states]) if states else None,
        terminated=np.array([one.terminated for one in played]),
        card={
            "task": "recorded",
            "simulator": simulator,
            "provenance": f"recorded of {source['policy']} in {simulator}",
            "recorded": source,
            "agents": [str(agent) for agent in env.possible_agents],
            "action_low": bounds.low,
            "action_high": bounds.high,
            **(env.layout.card if isinstance(env, PaddedEnv) else {}),
            **card,
        },
    )


def _kept_before(file: Path | None, source: dict[str, Any], episodes: int) -> EpisodeStore | None:
    """What an interrupted collection has kept."""
    if file is None or not file.exists():
        return None
    store = EpisodeStore.load(file)
    kept = store.card.extra.get("recorded")
    kept = kept if isinstance(kept, dict) else {}
    made_of = kept.get("made_of")
    if kept.get("early_ends") == "refuse":  # nobody left early so far
        kept = kept | {"early_ends": source["early_ends"]}
        store = replace(store, card=store.card.updated(recorded=kept))
    for part, content in source["made_of"].items():
        if " " in content:
            raise StoreError(
                f"'{file}' may hold another recording, since a {part} with a {content.split()[1]} cannot be compared; "
                "delete it or name another file, or let an attribute made_of tell what it is."
            )
        if kept.get(part) == source.get(part) and isinstance(made_of, dict) and made_of.get(part) != content:
            raise StoreError(
                f"'{file}' holds another recording, of a {part} whose code or values differ; delete it or name another "
                "file, or let an attribute made_of tell what it is, where it holds what changes (a time, say)."
            )
    if kept != source:
        raise StoreError(
            f"'{file}' holds another recording ({_said(kept)}, not {_said(source)}); delete it or name another file."
        )
    return store if store.episodes <= episodes else store.select(np.arange(store.episodes) < episodes)


def _said(source: Mapping[str, Any]) -> str:
    """Of whom a recording is, in words."""
    who = f"of {source.get('policy')} in {source.get('simulator')} from seed {source.get('first_seed')}"
    return f"{who} with early_ends='{source.get('early_ends')}'"


def _has_state(env: Any, seed: int) -> bool:
    """PettingZoo's base class has a method that raises."""
    read = getattr(env, "state", None)
    if read is None:
        return False
    try:
        env.reset(seed=seed)
        read()
    except NotImplementedError:
        return False
    return True


def _space(env: Any) -> _Space:
    name = type(env).__name__
    spaces = [env.action_space(agent) for agent in env.possible_agents]
    if not all(map(is_vector, spaces)):
        raise UserError(
            f"{name} has an action space {spaces[0]}; agents need a Box of one axis, since actions are numbers here."
        )
    widths = {space.shape[0] for space in spaces}
    low = min(float(space.low.min()) for space in spaces)
    high = max(float(space.high.max()) for space in spaces)
    if not np.isfinite([low, high]).all():
        raise UserError(f"{name} has action spaces from {low:g} to {high:g}; they must be finite, and bounded.")
    if len(widths) > 1:
        raise UserError(
            f"{name} has action spaces of {sorted(widths)} entries, and all agents must have as many; pass "
            "ringfence.padded(make_env), in which they have."
        )
    bounds = Bounds.of(np.stack([space.low for space in spaces]), np.stack([space.high for space in spaces]))
    return _Space(bounds, widths.pop(), env.layout.has_entry if isinstance(env, PaddedEnv) else None)
