"""EpisodeStore: logged episodes of several agents, validated, in one HDF5 file with a JSON card.

Time runs along the first axis, episodes one after another. T is the number of steps, E of episodes:

    observations (T+E, N, O)   one more row than steps in every episode: the last state is kept
    state        (T+E, S)      global state, when known
    actions      (T, N, A)     rewards (T, N)     costs (T,) of the team, or (T, N) of each agent
    constraints  (T, C)        or (T, N, C): the cost of each of several constraints, whose names and limits per episode
                               the card's `constraints` tells; `costs` is then the largest of them
    speed        (T,)          m/s, of robots whose simulator told it: what another speed limit would count
    terminated   (T,) bool     truncated (T,) bool; never merged, and the last step of every episode has one of them
    episode_ends (E,)          cumulative number of steps

The cost of step t belongs to the state that step t leads to.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ringfence import hazards, schemas
from ringfence.data import arrays
from ringfence.errors import StoreError, UserError, unknown
from ringfence.files import whole
from ringfence.trees import digest_of

FORMAT = 1
ARRAYS = ("observations", "actions", "rewards", "costs", "terminated", "truncated", "episode_ends")
OPTIONAL = ("state", "speed", "constraints")
PACKED = 4  # times its size that a store may unpack to; it is written uncompressed


@dataclass(frozen=True, eq=False)
class EpisodeStore:
    """Logged episodes in memory; see the module's docstring for shapes. Validated when made."""

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    costs: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    episode_ends: np.ndarray
    state: np.ndarray | None = None
    card: dict = field(default_factory=dict)
    speed: np.ndarray | None = None
    constraints: np.ndarray | None = None

    def __post_init__(self):
        object.__setattr__(self, "card", complete_card(self.card))
        validate(self)

    def __repr__(self) -> str:
        named = f" ({', '.join(self.limits)})" if self.limits else ""
        return (
            f"EpisodeStore('{self.card['task']}': {self.episodes:,} episodes, {self.steps:,} steps of {self.n_agents} "
            f"agents, observations {self.observations.shape[2]}, actions {self.actions.shape[2]}, state "
            f"{0 if self.state is None else self.state.shape[1]}, {100 * (self.costs > 0).mean():.3g} % of "
            f"entries with cost{named})"
        )

    # --- sizes ---
    @property
    def steps(self) -> int:
        return len(self.actions)

    @property
    def episodes(self) -> int:
        return len(self.episode_ends)

    @property
    def n_agents(self) -> int:
        return self.observations.shape[1]

    @property
    def lengths(self) -> np.ndarray:
        """(E,) steps per episode."""
        return np.diff(self.episode_ends, prepend=0)

    @property
    def episode_of_step(self) -> np.ndarray:
        """(T,) index of the episode of every step; row of step t in `observations` is t + episode_of_step[t]."""
        return np.repeat(np.arange(self.episodes), self.lengths)

    @property
    def returns(self) -> np.ndarray:
        """(E,) undiscounted episode return of the team: the sum over time of the mean over agents."""
        return self._per_episode(self.rewards.mean(1))

    @property
    def episode_terminated(self) -> np.ndarray:
        """(E,) bool: the task itself ended the episode."""
        return self.terminated[self.episode_ends - 1]

    @property
    def episode_costs(self) -> np.ndarray:
        """(E,) undiscounted episode cost of the team."""
        return self._per_episode(self.team_costs)

    @property
    def team_costs(self) -> np.ndarray:
        """(T,) cost of every step: of agents with costs of their own, the largest one."""
        return team(self.costs)

    @property
    def limits(self) -> dict[str, float]:
        """Limit per episode of each named constraint, in the order of `constraints`; empty where there are none."""
        return self.card.get("constraints") or {}

    def of_constraint(self, name: str) -> np.ndarray:
        """(T,) or (T, N) cost of one constraint."""
        return self.constraints[..., list(self.limits).index(name)]

    def episode_costs_of(self, name: str) -> np.ndarray:
        """(E,) undiscounted episode cost of the team, of one constraint."""
        return self._per_episode(team(self.of_constraint(name)))

    def _per_episode(self, x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(x.astype(np.float64), np.concatenate([[0], self.episode_ends[:-1]]))

    @property
    def hazard(self) -> hazards.Hazard:
        """The definition of danger in the card; CostColumn when the card has none."""
        return hazards.from_dict(self.card["hazard"])

    @functools.cached_property
    def content(self) -> str:
        """Digest of all arrays: other steps have another."""
        return self.digest(*ARRAYS, *OPTIONAL)

    def digest(self, *names: str) -> str:
        """Of some of the arrays."""
        arrays = ((name, getattr(self, name)) for name in names)
        return digest_of((name, array) for name, array in arrays if array is not None)

    def select(self, keep: np.ndarray) -> EpisodeStore:
        """The episodes where `keep` (E,) is true."""
        keep = np.asarray(keep, bool)
        if not keep.any():
            raise StoreError("No episode is left after the selection; relax the rule that selects them.")
        steps = np.repeat(keep, self.lengths)
        rows = np.repeat(keep, self.lengths + 1)
        return EpisodeStore(
            self.observations[rows],
            self.actions[steps],
            self.rewards[steps],
            self.costs[steps],
            self.terminated[steps],
            self.truncated[steps],
            np.cumsum(self.lengths[keep]),
            None if self.state is None else self.state[rows],
            self.card,
            None if self.speed is None else self.speed[steps],
            None if self.constraints is None else self.constraints[steps],
        )

    def followed_by(self, other: EpisodeStore) -> EpisodeStore:
        """These episodes and then the other's, of the same agents; the card is this one's."""
        if (self.state is None) != (other.state is None):
            raise StoreError("One of the stores holds a global state and the other none; leave it out of both.")
        if list(self.limits) != list(other.limits):
            raise StoreError("The stores name other constraints; give both the same ones, in the same order.")
        costs, several = ([getattr(s, name) for s in (self, other)] for name in ("costs", "constraints"))
        if costs[0].ndim != costs[1].ndim:  # the team's are everybody's
            costs = [c if c.ndim == 2 else np.repeat(c[:, None], self.n_agents, 1) for c in costs]
            several = [c if c is None or c.ndim == 3 else np.repeat(c[:, None], self.n_agents, 1) for c in several]
        told = {name: [getattr(s, name) for s in (self, other)] for name in (*ARRAYS, *OPTIONAL)}
        told |= {
            "costs": costs,
            "constraints": several,
            "episode_ends": [self.episode_ends, other.episode_ends + self.steps],
        }
        if len({x.shape[1:] for x in told["observations"]}) > 1 or len({x.shape[1:] for x in told["actions"]}) > 1:
            raise StoreError("The stores are of other agents (their shapes differ); keep them apart.")
        kept = {name: None if any(x is None for x in both) else np.concatenate(both) for name, both in told.items()}
        return EpisodeStore(**kept, card=self.card)

    def apart(self) -> EpisodeStore:
        """Every agent's own logs, as of a team of one: first the episodes of agent 0, then those of agent 1, and so on.
        `team` of the card tells how many they were. The global state is nobody's own, so it is left out."""
        n = self.n_agents
        if self.costs.ndim == 1 and n > 1:
            raise StoreError(
                f"The agents of '{self.card['task']}' are alike and learn from what each of them meets, but its costs "
                "are the team's; give costs (T, N)."
            )

        c = len(self.limits)

        def own(x: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(np.moveaxis(x, 1, 0)).reshape(-1, 1, *x.shape[2:])

        return EpisodeStore(
            own(self.observations),
            own(self.actions),
            own(self.rewards),
            self.costs if self.costs.ndim == 1 else self.costs.T.reshape(-1),
            np.tile(self.terminated, n),
            np.tile(self.truncated, n),
            np.concatenate([self.episode_ends + i * self.steps for i in range(n)]),
            card={
                **self.card,
                "state_names": None,
                "agents": None,
                "action_sizes": None,
                "team": n,
                "content": self.content,
            },
            constraints=None if self.constraints is None else np.moveaxis(self.constraints, 1, 0).reshape(-1, c),
        )

    # --- making ---
    @classmethod
    def from_episodes(cls, observations, actions, rewards, costs, *, state=None, terminated=None, card=None):
        """Episodes of one length L: observations (E, L+1, N, O), actions (E, L, N, A), rewards (E, L, N) or (E, L),
        costs (E, L), (E, L, N), a dictionary of these by the constraint's name, or None, state (E, L+1, S);
        `terminated` (E,) bool says which ended by themselves (none, if it is not given)."""
        observations, actions = _numbers("observations", observations), _numbers("actions", actions)
        if observations.ndim != 4 or actions.ndim != 4 or observations.shape[1] != actions.shape[1] + 1:
            raise StoreError(
                f"from_episodes got observations {observations.shape} and actions {actions.shape}; they must be "
                "(E, L+1, N, O) and (E, L, N, A): keep the state that the last action leads to."
            )
        e, length, n = actions.shape[:3]
        rewards = _numbers("rewards", rewards)
        costs, several, card = _several(costs, (e, length), n, card)
        costs = np.zeros((e, length)) if costs is None else _numbers("costs", costs)
        one = {
            "observations": (observations, (e, length + 1, n)),
            "costs": (costs, (e, length, n)[: max(2, costs.ndim)]),
        }
        one["rewards"] = (rewards, (e, length, n)[: max(2, rewards.ndim)])
        if state is not None:
            state = _numbers("state", state)
            one["state"] = (state, (e, length + 1))
        if terminated is not None:
            one["terminated"] = (np.asarray(terminated), (e,))
        for name, (value, expected) in one.items():
            wide = len(expected) + (name in ("observations", "state"))
            if value.shape[: len(expected)] != expected or value.ndim != wide:
                raise StoreError(
                    f"from_episodes got {name} of shape {value.shape}, the actions say {e} episodes of {length} steps "
                    f"and {n} agents; give ({', '.join(map(str, expected))}{', ...' * (wide > len(expected))})."
                )
        if rewards.ndim == 2:
            rewards = np.repeat(rewards[..., None], n, -1)
        last = np.zeros((e, length), bool)
        last[:, -1] = True
        ended = np.zeros(e, bool) if terminated is None else np.asarray(terminated, bool)
        flat = lambda x, lead: np.ascontiguousarray(np.asarray(x).reshape(lead, *np.shape(x)[2:]))  # noqa: E731
        return cls(
            flat(observations, e * (length + 1)).astype(np.float32, copy=False),
            flat(actions, e * length).astype(np.float32, copy=False),
            flat(rewards, e * length).astype(np.float32, copy=False),
            flat(costs, e * length).astype(np.float32, copy=False),
            (last & ended[:, None]).ravel(),
            (last & ~ended[:, None]).ravel(),
            np.arange(1, e + 1) * length,
            None if state is None else flat(state, e * (length + 1)).astype(np.float32, copy=False),
            {} if card is None else card,
            constraints=None if several is None else flat(several, e * length),
        )

    @classmethod
    def from_steps(
        cls,
        observations,
        actions,
        rewards,
        *,
        episode_ends,
        final_observations,
        costs=None,
        state=None,
        final_state=None,
        terminated=None,
        speed=None,
        card=None,
    ):
        """Flat logs: observations (T, N, O), actions (T, N, A), rewards (T,) or (T, N), costs (T,) or (T, N), or a
        dictionary of these by the constraint's name (the card's `constraints` gives each its limit per episode, 0 by
        default), state (T, S); `episode_ends` (E,) cumulative steps; `final_observations` (E, N, O) and `final_state`
        (E, S): the state each episode ended in; `terminated` (E,) bool, default all false (ended by a time limit);
        speed (T,)."""
        ends = _numbers("episode_ends", episode_ends, 1)
        if (ends % 1 != 0).any():
            raise StoreError("episode_ends holds fractions; give cumulative step counts, whole numbers.")
        ends = ends.astype(np.int64)
        observations = _numbers("observations", observations, 3).astype(np.float32, copy=False)
        actions = _numbers("actions", actions, 3).astype(np.float32, copy=False)
        final_observations = _numbers("final_observations", final_observations, 3).astype(np.float32, copy=False)
        rewards = _numbers("rewards", rewards).astype(np.float32, copy=False)
        costs, several, card = _several(costs, actions.shape[:1], actions.shape[1], card)
        state, final_state = (
            None if x is None else _numbers(name, x, 2).astype(np.float32, copy=False)
            for name, x in (("state", state), ("final_state", final_state))
        )
        if len(ends) == 0 or ends[-1] != len(actions):
            raise StoreError(
                f"episode_ends ends at {ends[-1] if len(ends) else 'nothing'}, the data has {len(actions)} steps; "
                "it must be cumulative and end with the number of steps (drop an unfinished last episode)."
            )
        if (np.diff(ends, prepend=0) <= 0).any():
            raise StoreError("episode_ends must increase; give cumulative step counts.")
        for name, value, rows in (
            ("observations", observations, len(actions)),
            ("state", state, len(actions)),
            ("terminated", terminated, len(ends)),
        ):
            if value is not None and len(value) != rows:
                raise StoreError(f"from_steps got {len(value)} rows of {name}, it takes {rows}; see its docstring.")
        lasts = {"final_observations": (final_observations, (len(ends), *observations.shape[1:]))}
        if state is not None and final_state is not None:
            lasts["final_state"] = (final_state, (len(ends), *np.shape(state)[1:]))
        for name, (value, expected) in lasts.items():
            if np.shape(value) != expected:
                raise StoreError(
                    f"{name} has shape {np.shape(value)}, expected {expected}: the state that each of the {len(ends)} "
                    "episodes ended in."
                )
        if rewards.ndim == 1:
            rewards = np.repeat(rewards[:, None], actions.shape[1], 1)
        ended = np.zeros(len(ends), bool) if terminated is None else np.asarray(terminated, bool)
        flags = np.zeros((2, len(actions)), bool)
        flags[0, ends[ended] - 1] = True
        flags[1, ends[~ended] - 1] = True
        if state is not None and final_state is None:
            raise StoreError("state was given without final_state; pass the global state each episode ended in, too.")
        return cls(
            np.insert(observations, ends, final_observations, axis=0),
            actions,
            rewards,
            np.zeros(len(actions), np.float32) if costs is None else _numbers("costs", costs).astype(np.float32),
            flags[0],
            flags[1],
            ends,
            None if state is None else np.insert(state, ends, final_state, axis=0),
            {} if card is None else card,
            None if speed is None else _numbers("speed", speed),
            several,
        )

    @classmethod
    def from_table(cls, table, *, time: str, agent: str, state, **options):
        """A row per agent and time: a data frame (pandas, polars, pyarrow), a dictionary of columns, or a CSV or
        Parquet file; options as of `ringfence.data.tables.from_table`."""
        from ringfence.data.tables import from_table

        return from_table(table, time=time, agent=agent, state=state, **options)

    # --- disk ---
    def save(self, path: str | os.PathLike) -> Path:
        """Write one HDF5 file, whole or not at all."""
        path = Path(path)
        with whole(path) as temporary:
            try:
                with h5py.File(temporary, "w") as f:
                    f.attrs["ringfence_store"] = FORMAT
                    f.attrs["card"] = told = json.dumps(self.card)
                    f.attrs["digest"], f.attrs["card_digest"] = self.content, _digest(told)
                    for name in (*ARRAYS, *OPTIONAL):
                        if getattr(self, name) is not None:
                            f.create_dataset(name, data=getattr(self, name))
            except RuntimeError as error:  # HDF5 on a full disk, when it closes the file
                raise OSError(str(error)) from error
        return path

    @classmethod
    def load(cls, path: str | os.PathLike) -> EpisodeStore:
        """Read and validate; a foreign, truncated, damaged or invalid file is refused, never read in part."""
        path = Path(path)
        if not path.exists():
            raise StoreError(f"No episode store at '{path}'; make one with `ringfence data make TASK`.")
        if not path.is_file():
            raise StoreError(f"'{path}' is no regular file; give the file of an episode store.")
        try:
            with h5py.File(path, "r") as f:
                if f.attrs.get("ringfence_store") != FORMAT:
                    raise StoreError(
                        f"'{path}' is not an episode store of format {FORMAT}; import it with `ringfence data`."
                    )
                there = _checked(path, f)
                raw, digest = f.attrs["card"], f.attrs.get("digest")
                if not isinstance(raw, str | bytes) or len(raw) > 2**24:
                    raise StoreError(f"'{path}' has no card that can be read; make or import it again.")
                if f.attrs.get("card_digest", of := _digest(raw)) != of:
                    raise StoreError(
                        f"'{path}' has another card than was written; make or import it again, or delete its "
                        "attribute 'card_digest' if you wrote the card yourself."
                    )
                card = schemas.decode(raw, dict[str, Any])
                content = {name: array[()] for name, array in there.items()}
        except StoreError:
            raise
        except OSError as error:
            told = str(error).splitlines()[0]
            raise StoreError(f"'{path}' is truncated or not HDF5 ({told}); make or import the store again.") from error
        except Exception as error:  # a damaged file raises anything: KeyError, RuntimeError, UnicodeDecodeError, ...
            told = (str(error).splitlines() or [type(error).__name__])[0]
            raise StoreError(f"'{path}' is damaged or has no card ({told}); make or import it again.") from error
        try:
            found = cls(**content, card=card)
        except UserError as error:
            raise StoreError(f"'{path}': {error}") from None
        if digest is not None and digest != found.content:
            raise StoreError(
                f"'{path}' holds other numbers than were written (its digest differs); make or import it again."
            )
        return found


def _checked(path: Path, f: h5py.File) -> dict[str, h5py.Dataset]:
    """The arrays of a file, looked at before any of them is read: plain ones, in the file itself, of shapes that belong
    together and of no more bytes than the file can hold."""
    missing = [name for name in ARRAYS if name not in f]
    if missing:
        raise StoreError(f"'{path}' lacks the array '{missing[0]}'; make or import the store again.")
    found = {name: arrays.array(path, f, name) for name in (*ARRAYS, *OPTIONAL) if name in f}
    steps, episodes = found["actions"].shape[0], found["episode_ends"].shape[0]
    rows = {"observations": steps + episodes, "state": steps + episodes, "episode_ends": episodes}
    for name, array in found.items():
        if array.shape[0] != rows.get(name, steps):
            raise StoreError(
                f"'{path}' holds {array.shape[0]} rows of '{name}' for {steps} steps of {episodes} episodes; make or "
                "import the store again."
            )
    arrays.affordable(path, sum(array.nbytes for array in found.values()), PACKED)
    return found


def team(costs: np.ndarray) -> np.ndarray:
    """(T,) the largest of agents' costs (T, N), or those of the team as they are."""
    return costs if costs.ndim == 1 else costs.max(1)


def _several(costs, lead: tuple[int, ...], agents: int, card: dict | None):
    """(costs, constraints, card): of a dictionary by name the largest, all of them (*lead, C) or (*lead, N, C), and the
    card with a limit of each."""
    if not isinstance(costs, dict):
        return costs, None, card
    if not costs:
        raise StoreError("costs is an empty dictionary; name a constraint, or give costs=None.")
    found = {name: _numbers(f"costs['{name}']", x) for name, x in costs.items()}
    for name, x in found.items():
        if x.shape not in (lead, (*lead, agents)):
            raise StoreError(f"costs['{name}'] has shape {x.shape}, expected {lead} or {(*lead, agents)}.")
    if any(x.ndim > len(lead) for x in found.values()):  # the team's are everybody's
        found = {k: x if x.ndim > len(lead) else np.repeat(x[..., None], agents, -1) for k, x in found.items()}
    told = dict((card or {}).get("constraints") or {})
    if strangers := [name for name in told if name not in found]:
        raise unknown("constraint with a limit", strangers[0], found)
    several = np.stack(list(found.values()), -1).astype(np.float32)
    limits = {name: told.get(name, 0.0) for name in found}
    return several.max(-1), several, {**(card or {}), "constraints": limits}


def _digest(card: str | bytes) -> str:
    return hashlib.blake2b(card.encode() if isinstance(card, str) else card, digest_size=8).hexdigest()


def _numbers(name: str, value, axes: int | None = None) -> np.ndarray:
    """An array of real numbers, with that many axes; ragged lists, words and None are refused by name."""
    if np.ma.is_masked(value):
        raise StoreError(f"{name} hides entries behind a mask; fill them in, or drop the episodes that hold them.")
    try:
        array = np.asarray(value)
    except ValueError as error:  # rows of several lengths
        raise StoreError(f"{name} is no array ({str(error).split('. ')[0]}); give every row the same length.") from None
    if array.dtype.kind not in "biuf":
        kind = "nothing" if value is None else "entries that are no real numbers"
        raise StoreError(f"{name} holds {kind} (dtype {array.dtype}); give an array of numbers.")
    if axes is not None and array.ndim != axes:
        raise StoreError(f"{name} has shape {array.shape}, which is not {axes} axes; add or remove one.")
    return array


def complete_card(card: dict) -> dict:
    """A card with every field present; unknown fields are kept, for provenance of any kind."""
    base = {
        "task": "custom",
        "simulator": None,
        "provenance": "user data",
        "action_low": -1.0,
        "action_high": 1.0,
        "observation_names": None,
        "state_names": None,
        "hazard": {"kind": "CostColumn"},
    }
    if not isinstance(card, dict):
        raise StoreError(f"The card is a {type(card).__name__}; it must be a dictionary of fields.")
    card = {**base, **card}
    _check_name(card["task"])
    for name in ("action_low", "action_high"):
        if not _is_number(card[name]):
            raise StoreError(f"The card has {name}={card[name]!r}; it must be one number, the bound of every entry.")
        card[name] = float(card[name])
    if not card["action_low"] < card["action_high"]:
        raise StoreError(
            f"The card has action_low={card['action_low']:g} and action_high={card['action_high']:g}; the first must "
            "be the smaller one."
        )
    if "cost_limit" in card and not (_is_number(card["cost_limit"]) and card["cost_limit"] >= 0):
        raise StoreError(f"The card has cost_limit={card['cost_limit']!r}; it must be one number, 0 or more.")
    limits = card.get("constraints")
    if limits is not None:
        try:
            limits = card["constraints"] = {k: _plain(v) for k, v in limits.items()}
            schemas.check(limits, schemas.Limits)
        except (AttributeError, ValueError):
            raise StoreError(
                f"The card has constraints={repr(limits)[:200]}; it must give each constraint's name a limit, the cost "
                "of an episode that is not to be passed, 0 or more."
            ) from None
        card["cost_limit"] = card.get("cost_limit", float(sum(limits.values())))
    for name in ("observation_names", "state_names", "warnings"):
        words = card.get(name)
        words = words.tolist() if isinstance(words, np.ndarray) else words
        if words is not None and not (isinstance(words, list | tuple) and all(isinstance(w, str) for w in words)):
            raise StoreError(f"The card has {name}={words!r}; it must be a list of words, or be left out.")
        if name in card:
            card[name] = words if words is None else list(words)
        told = card[name] if name != "warnings" and card.get(name) else ()
        twice = [w for k, w in enumerate(told) if w in told[:k] or not w.isprintable()]
        if twice:
            raise StoreError(
                f"The card has {name} with {twice[0]!r} twice or unprintable; give every entry its own name."
            )
    if "dt" in card and not (_is_number(card["dt"]) and card["dt"] > 0):
        raise StoreError(f"The card has dt={card['dt']!r}; it must be the seconds of a step, a number above 0.")
    if not isinstance(card.get("alike", False), bool):
        raise StoreError(f"The card has alike={card['alike']!r}; it must be true or false.")
    if isinstance(card["hazard"], hazards.Hazard):
        card["hazard"] = hazards.to_dict(card["hazard"])
    elif not isinstance(card["hazard"], dict):
        raise StoreError(
            f"The card has hazard={card['hazard']!r}; it must be a Separation, SpeedLimit, CostColumn or All (other "
            "dangers go into the costs, with CostColumn)."
        )
    try:
        told = hazards.from_dict(card["hazard"])
        sound = all(_is_sound(h) for h in getattr(told, "hazards", (told,)))
    except UserError:
        raise
    except (TypeError, ValueError):  # a field of a kind that no hazard has
        sound = False
    if not sound:
        raise StoreError(f"The card has hazard={card['hazard']!r}, which is none; see docs/data.md.")
    try:
        return json.loads(json.dumps(card, default=lambda x: x.tolist()))  # NumPy's arrays and numbers become plain
    except (AttributeError, TypeError, ValueError) as error:
        raise StoreError(f"The card cannot be kept as JSON ({error}); use words, numbers, lists and dicts.") from None


def _is_number(x) -> bool:
    return isinstance(x, int | float | np.number) and not isinstance(x, bool) and bool(np.isfinite(x))


def _plain(x):
    """A number of NumPy's as Python's."""
    return x.item() if isinstance(x, np.number) else x


def _is_sound(hazard: hazards.Hazard) -> bool:
    """Whether a hazard has the sizes that define it, and names its features with words."""
    features = getattr(hazard, "features", ())
    sizes = ("radius", "safe_margin") if isinstance(hazard, hazards.Separation) else ("limit",)
    sized = all(getattr(hazard, name, 0.0) is not None for name in sizes)
    named = isinstance(features, tuple) and all(isinstance(name, str) for name in features)
    return sized and named and (bool(features) or not isinstance(hazard, hazards.SpeedLimit))


def _is_name(word) -> bool:
    """Whether a word can become that of a folder or file."""
    try:
        schemas.check(word, schemas.Name)
    except ValueError:
        return False
    return bool(word.strip())


def _check_name(task) -> None:
    if not _is_name(task):
        raise StoreError(
            f"The card has task={repr(task)[:200]}; it must be a name without slashes, line breaks or a leading dot or "
            "dash, of at most 120 letters, since folders of runs are called so."
        )


def validate(store: EpisodeStore) -> None:
    """Raise `StoreError` naming the array, the rule it breaks and the remedy."""
    s = store

    def demand(ok: bool, message: str) -> None:
        if not ok:
            raise StoreError(message)

    for name in (*ARRAYS, *OPTIONAL):
        array = getattr(s, name)
        if array is None and name in OPTIONAL:
            continue
        demand(isinstance(array, np.ndarray), f"{name} is a {type(array).__name__}; give a NumPy array.")
        kinds, what = {"episode_ends": ("iu", "whole numbers")}.get(name, ("biuf", "real numbers"))
        if name in ("terminated", "truncated"):
            kinds, what = "b", "true or false"
        demand(array.dtype.kind in kinds, f"{name} holds entries of type {array.dtype}; it must hold {what}.")
    demand(s.actions.ndim == 3, f"actions has shape {s.actions.shape}, expected (T, N, A); add the missing axis.")
    t, n = s.actions.shape[:2]
    demand(
        n > 0 and s.actions.shape[2] > 0,
        f"actions has shape {s.actions.shape}; a store needs at least one agent and one action entry.",
    )
    ends = s.episode_ends
    demand(ends.ndim == 1 and len(ends) > 0, "episode_ends is empty; a store needs at least one whole episode.")
    demand(bool((np.diff(ends, prepend=0) > 0).all()), "episode_ends must increase; give cumulative step counts.")
    demand(ends[-1] == t, f"episode_ends ends at {ends[-1]}, actions has {t} steps; drop an unfinished episode.")
    e = len(ends)
    shapes = {
        "observations": (t + e, n),
        "rewards": (t, n),
        "costs": (t, n) if np.ndim(s.costs) == 2 else (t,),
        "terminated": (t,),
        "truncated": (t,),
    }
    for name, expected in shapes.items():
        got = getattr(s, name).shape
        demand(
            got[: len(expected)] == expected and len(got) == len(expected) + (name == "observations"),
            f"{name} has shape {got}, expected {(*expected, 'O') if name == 'observations' else expected} for "
            f"{t} steps, {e} episodes and {n} agents; every episode keeps one more observation than steps.",
        )
    demand(s.observations.shape[2] > 0, "observations has no entries; an agent must see at least one number.")
    if s.state is not None:
        demand(
            s.state.ndim == 2 and len(s.state) == t + e,
            f"state has shape {s.state.shape}, expected ({t + e}, S); keep the state each episode ended in.",
        )
    known = np.isfinite(s.costs).mean()
    demand(
        known > 0.5 or known == 1,
        f"costs is known for {100 * known:.2g} % of the steps; say 0 or 1 of every step that is kept, and drop "
        "episodes of which nobody knows.",
    )
    if s.speed is not None:
        demand(s.speed.shape == (t,), f"speed has shape {s.speed.shape}, expected ({t},); give one of every step.")
    for name in ("observations", "actions", "rewards", "costs", *OPTIONAL):
        array = getattr(s, name)
        if array is not None and not np.isfinite(array).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise StoreError(f"{name}{list(where)} is {array[where]}; remove or repair the episode that holds it.")
    demand(bool((s.costs >= 0).all()), "costs holds negative entries; a cost is 0 or positive, check its sign.")
    if s.constraints is not None or s.limits:
        shape, wanted = np.shape(s.constraints), (*s.costs.shape, len(s.limits))
        demand(
            shape == wanted,
            f"constraints has shape {shape}, its card names {len(s.limits)} ({', '.join(s.limits) or 'none'}) for "
            f"costs of {s.costs.shape}; give costs={{name: array, ...}}, and a limit for each in the card.",
        )
        demand(
            bool((s.constraints >= 0).all()),
            "constraints holds negative entries; a cost is 0 or positive, check its sign.",
        )
        demand(
            bool(np.array_equal(s.constraints.max(-1), s.costs)),
            "costs is not the largest of the constraints at every step; give costs={name: array, ...} alone.",
        )
    low, high = s.card["action_low"], s.card["action_high"]
    slack = 1e-4 * (high - low)
    outside = (s.actions < low - slack) | (s.actions > high + slack)
    if outside.any():
        where = tuple(int(i) for i in np.argwhere(outside)[0])
        raise StoreError(
            f"actions{list(where)} is {s.actions[where]:.4g}, outside [{low:g}, {high:g}]; rescale the actions or set "
            "action_low and action_high in the card."
        )
    both = s.terminated & s.truncated
    demand(not both.any(), "terminated and truncated are both set somewhere; a step ends in one way, keep terminated.")
    last = np.zeros(t, bool)
    last[ends - 1] = True
    over = s.terminated | s.truncated
    if (last & ~over).any():
        bad = int(np.flatnonzero(~over[ends - 1])[0])
        raise StoreError(
            f"Episode {bad} is unfinished: its last step is neither terminated nor truncated; set one or drop it."
        )
    demand(not (over & ~last).any(), "A step inside an episode is flagged as its end; split the episode there.")
    sizes, most = s.card.get("action_sizes"), s.actions.shape[2]
    if sizes is not None:
        told = isinstance(sizes, list | tuple) and len(sizes) == n
        demand(
            told and all(type(k) is int and 1 <= k <= most for k in sizes),
            f"The card has action_sizes={sizes!r}; it must say for each of the {n} agents how many entries its action "
            f"has, 1 to {most}.",
        )
    for key, size in (("observation_names", s.observations.shape[2]), ("state_names", s.state is not None)):
        names = s.card.get(key)
        if names and key == "observation_names":
            demand(len(names) == size, f"The card names {len(names)} observation entries, the data has {size}.")
        if names and key == "state_names" and s.state is not None:
            demand(
                len(names) == s.state.shape[1], f"The card names {len(names)} state entries, not {s.state.shape[1]}."
            )
