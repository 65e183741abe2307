"""EpisodeStore: logged episodes of several agents, validated, in one HDF5 file with a JSON card.

Time runs along the first axis, episodes one after another. T is the number of steps, E of episodes:

    observations (T+E, N, O)   one more row than steps in every episode: the last state is kept
    state        (T+E, S)      global state, when known
    actions      (T, N, A)     rewards (T, N)     costs (T,) of the team, or (T, N) of each agent
    constraints  (T, C)        or (T, N, C): the cost of each of several constraints, whose names and limits per episode
                               the card's `constraints` holds; `costs` is then the largest of them
    speed        (T,)          m/s, of robots whose simulator reports it: what another speed limit would count
    terminated   (T,) bool     truncated (T,) bool; never merged, and the last step of every episode has one of them
    episode_ends (E,)          cumulative number of steps

The cost of step t belongs to the state that step t leads to.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from ringfence.errors import StoreError, UserError, of_kind, one_of, reading, unknown
from ringfence.logs.io.columns import Tables
from ringfence.logs.io.table import read_layout, read_parts, read_table
from ringfence.logs.io.table_schema import TableSchema
from ringfence.logs.moving import moved, moved_by
from ringfence.logs.schema import ARRAYS, OPTIONAL, GivenCard, StoreCard, complete_card, given_card, validate
from ringfence.problem import constraints
from ringfence.utils import arrays, schemas
from ringfence.utils.files import place, whole
from ringfence.utils.given import refuse_other_order
from ringfence.utils.pytrees import Digest, digest_of

FORMAT = 1
HDF5_BEGINS = b"\x89HDF\r\n\x1a\n"
LEARNED = 2 * 2**30  # bytes of logs that are learned from, at most, where a command reads them
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
    card: StoreCard = field(default_factory=StoreCard)  # a dictionary of its fields may be given
    speed: np.ndarray | None = None
    constraints: np.ndarray | None = None

    def __post_init__(self):
        object.__setattr__(self, "card", complete_card(self.card))
        validate(self)

    def __repr__(self) -> str:
        named = f" ({', '.join(self.limits)})" if self.limits else ""
        return (
            f"EpisodeStore('{self.card.task}': {self.episodes:,} episodes, {self.steps:,} steps of {self.n_agents} "
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
    def first_rows(self) -> np.ndarray:
        """(E,) rows of `observations` that episodes begin with."""
        return np.concatenate([[0], self.episode_ends[:-1]]) + np.arange(self.episodes)

    @property
    def entry_names(self) -> tuple[str, ...]:
        """What entries of observations are called; numbers where nobody named them."""
        return tuple(self.card.observation_names or (f"obs{d}" for d in range(self.observations.shape[2])))

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
        return self.card.constraints or {}

    def of_constraint(self, name: str) -> np.ndarray:
        """(T,) or (T, N) cost of one constraint."""
        if self.constraints is None or name not in self.limits:
            raise unknown("constraint", name, self.limits)
        return self.constraints[..., list(self.limits).index(name)]

    def episode_costs_of(self, name: str) -> np.ndarray:
        """(E,) undiscounted episode cost of the team, of one constraint."""
        return self._per_episode(team(self.of_constraint(name)))

    def _per_episode(self, x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(x.astype(np.float64), np.concatenate([[0], self.episode_ends[:-1]]))

    @property
    def hazard(self) -> constraints.Hazard:
        """The definition of danger in the card; CostColumn when the card has none."""
        return constraints.from_dict(self.card.hazard)

    @functools.cached_property
    def content(self) -> str:
        """Digest of all arrays: other steps have another."""
        return self.digest(*ARRAYS, *OPTIONAL)

    @property
    def digests_of_episodes(self) -> list[str]:
        """Of what was seen and done in each episode, so that it is known again among others."""
        rows = np.split(self.observations, np.cumsum(self.lengths + 1)[:-1])
        steps = np.split(self.actions, self.episode_ends[:-1])
        return [digest_of((("observations", seen), ("actions", done))) for seen, done in zip(rows, steps)]

    @property
    def outcomes(self) -> dict[str, list | dict[str, list]]:
        """What each episode earned and cost, by constraint, too, how long it was and whether the task ended it."""
        return {
            "returns": [round(float(x), 4) for x in self.returns],
            "costs": [round(float(x), 4) for x in self.episode_costs],
            "steps": [int(n) for n in self.lengths],
            "terminated": [bool(x) for x in self.episode_terminated],
            "constraints": {k: [round(float(x), 4) for x in self.episode_costs_of(k)] for k in self.limits},
        }

    def digest(self, *names: str) -> str:
        """Of some of the arrays."""
        own = {name: getattr(self, name) for name in (*ARRAYS, *OPTIONAL)}
        arrays = [(name, one_of("array", name, own)) for name in names]
        return digest_of((name, array) for name, array in arrays if array is not None)

    def select(self, keep: np.ndarray) -> EpisodeStore:
        """The episodes where `keep` (E,) is true, or those that it counts, in the store's order."""
        keep = _chosen(keep, self.episodes)
        if not keep.any():
            raise StoreError("No episode is left after the selection; relax the rule that selects them.")
        steps = np.repeat(keep, self.lengths)
        rows = np.repeat(keep, self.lengths + 1)
        return self.taken(rows, steps, np.cumsum(self.lengths[keep]))

    def taken(self, rows: np.ndarray, steps: np.ndarray, episode_ends: np.ndarray) -> EpisodeStore:
        """Some rows and steps, as flags or numbers, of episodes that end after so many steps (E,)."""
        return EpisodeStore(
            self.observations[rows],
            self.actions[steps],
            self.rewards[steps],
            self.costs[steps],
            self.terminated[steps],
            self.truncated[steps],
            episode_ends,
            None if self.state is None else self.state[rows],
            self.card,
            None if self.speed is None else self.speed[steps],
            None if self.constraints is None else self.constraints[steps],
        )

    def followed_by(self, other: EpisodeStore) -> EpisodeStore:
        """These episodes and then the other's, of the same agents; the card is this one's."""
        of_kind("What follows", other, EpisodeStore, "give an EpisodeStore")
        if (self.state is None) != (other.state is None):
            raise StoreError("One of the stores holds a global state and the other none; leave it out of both.")
        if list(self.limits) != list(other.limits):
            raise StoreError("The stores name other constraints; give both the same ones, in the same order.")
        if self._shape_of_agents() != other._shape_of_agents():
            raise StoreError("The stores are of other agents (their shapes differ); keep them apart.")
        if not self.card.homogeneous:
            refuse_other_order(other.card.agents or (), self.card.agents, all_known=False)
        if self.card.action_delay != other.card.action_delay:
            raise StoreError("The stores were undelayed by other steps; join them before.")
        if self.card.origins != other.card.origins:
            raise StoreError("The stores were moved by other origins; make them of one table.")
        each = self.costs.ndim != other.costs.ndim  # the team's are everybody's, then

        def joined(name: str) -> np.ndarray:
            parts = [getattr(store, name) for store in (self, other)]
            if each and name == "costs":
                parts = [x if x.ndim == 2 else np.repeat(x[:, None], self.n_agents, 1) for x in parts]
            if each and name == "constraints":
                parts = [x if x.ndim == 3 else np.repeat(x[:, None], self.n_agents, 1) for x in parts]
            return np.concatenate(parts)

        def joined_or_none(name: str) -> np.ndarray | None:
            return None if getattr(self, name) is None or getattr(other, name) is None else joined(name)

        return EpisodeStore(
            joined("observations"),
            joined("actions"),
            joined("rewards"),
            joined("costs"),
            joined("terminated"),
            joined("truncated"),
            np.concatenate([self.episode_ends, other.episode_ends + self.steps]),
            joined_or_none("state"),
            self.card,
            joined_or_none("speed"),
            joined_or_none("constraints"),
        )

    def _shape_of_agents(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        return self.observations.shape[1:], self.actions.shape[1:]

    def split_agents(self) -> EpisodeStore:
        """Every agent's own logs, as of a team of one: first the episodes of agent 0, then those of agent 1, and so on.
        `team` of the card tells how many they were. The global state is nobody's own, so it is left out."""
        n = self.n_agents
        if self.costs.ndim == 1 and n > 1 and (self.costs.any() or self.constraints is not None):
            raise StoreError(
                f"The agents of '{self.card.task}' are homogeneous and learn from what each of them meets, but its "
                "costs are the team's; give costs (T, N)."
            )

        def own(x: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(np.moveaxis(x, 1, 0)).reshape(-1, 1, *x.shape[2:])

        return EpisodeStore(
            own(self.observations),
            own(self.actions),
            own(self.rewards),
            np.tile(self.costs, n) if self.costs.ndim == 1 else self.costs.T.reshape(-1),
            np.tile(self.terminated, n),
            np.tile(self.truncated, n),
            np.concatenate([self.episode_ends + i * self.steps for i in range(n)]),
            card=self.card.updated(
                state_names=None, state_origins=None, agents=None, action_sizes=None, team=n, content=self.content
            ),
            constraints=None
            if self.constraints is None
            else np.moveaxis(self.constraints, 1, 0).reshape(-1, len(self.limits)),
        )

    # --- making ---
    @classmethod
    def from_episodes(cls, observations, actions, rewards, costs, *, state=None, terminated=None, card=None):
        """Episodes of one length L: observations (E, L+1, N, O), actions (E, L, N, A), rewards (E, L, N) or (E, L),
        costs (E, L), (E, L, N), a dictionary of these by the constraint's name, or None, state (E, L+1, S);
        `terminated` (E,) bool says which ended by themselves (none, if it is not given)."""
        observations = _numbers("observations", observations)
        actions = _numbers("actions", actions)
        if observations.ndim != 4 or actions.ndim != 4 or observations.shape[1] != actions.shape[1] + 1:
            raise StoreError(
                f"from_episodes got observations {observations.shape} and actions {actions.shape}; they must be "
                "(E, L+1, N, O) and (E, L, N, A): keep the state that the last action leads to."
            )
        if 0 in actions.shape[:3]:
            raise StoreError(f"from_episodes got actions {actions.shape}, so nothing was done; give a step or more.")
        e, length, n = actions.shape[:3]
        rewards = _numbers("rewards", rewards)
        costs, several, card = _several(costs, (e, length), n, card)
        costs = np.zeros((e, length)) if costs is None else _numbers("costs", costs)
        state = None if state is None else _numbers("state", state)
        _check_episodes(
            (e, length, n),
            observations=observations,
            costs=costs,
            rewards=rewards,
            state=state,
            terminated=None if terminated is None else np.asarray(terminated),
        )
        if rewards.ndim == 2:
            rewards = np.repeat(rewards[..., None], n, -1)
        last = np.zeros((e, length), bool)
        last[:, -1] = True
        ended = np.zeros(e, bool) if terminated is None else _truths("terminated", terminated)
        steps = e * length
        ends = np.arange(1, e + 1) * length
        states = None if state is None else _rows(state, e * (length + 1))
        seen, states, card = moved(_rows(observations, e * (length + 1)), states, ends, given_card(card))
        return cls(
            seen,
            _flat(actions, steps),
            _flat(rewards, steps),
            _flat(costs, steps),
            (last & ended[:, None]).ravel(),
            (last & ~ended[:, None]).ravel(),
            ends,
            states,
            card,
            constraints=None if several is None else _flat(several, steps),
        )

    @classmethod
    def from_steps(
        cls,
        observations,
        actions,
        rewards,
        *,
        episode_ends,
        final_observations=None,
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
        if final_observations is None:
            raise StoreError(
                "from_steps was given no final_observations (E, N, O), the state that each episode ended in; where "
                "nobody logged it, give the last observation of each episode, and leave that step out of all arrays."
            )
        ends = _whole_ends(episode_ends)
        observations = _numbers("observations", observations, 3)
        actions = _floats("actions", actions, 3)
        final_observations = _numbers("final_observations", final_observations, 3)
        rewards = _floats("rewards", rewards)
        n_steps, n_agents = actions.shape[:2]
        costs, several, card = _several(costs, (n_steps,), n_agents, card)
        _check_ends(ends, n_steps)
        _check_rows("observations", observations, n_steps)
        _check_rows("terminated", terminated, len(ends))
        _check_last("final_observations", final_observations, (len(ends), *observations.shape[1:]))
        states = _whole_states(state, final_state, ends, n_steps)
        ended = np.zeros(len(ends), bool) if terminated is None else _truths("terminated", terminated)
        seen = np.insert(observations, ends, final_observations, axis=0)
        seen, states, card = moved(seen, states, ends, given_card(card))
        return cls._of_rows(seen, actions, rewards, costs, several, ends, ended, card, states, speed)

    @classmethod
    def _of_rows(
        cls,
        observations: np.ndarray,
        actions: np.ndarray,
        rewards: np.ndarray,
        costs: Any,
        several: np.ndarray | None,
        ends: np.ndarray,
        ended: np.ndarray,
        card: StoreCard,
        states: np.ndarray | None = None,
        speed: Any = None,
    ) -> EpisodeStore:
        """Of observations (T+E, N, O) in single precision, and what `from_steps` takes otherwise; `ended` (E,)."""
        n_steps, n_agents = actions.shape[:2]
        return cls(
            observations,
            actions,
            np.repeat(rewards[:, None], n_agents, 1) if rewards.ndim == 1 else rewards,
            np.zeros(n_steps, np.float32) if costs is None else _numbers("costs", costs).astype(np.float32),
            _flags(ends[ended], n_steps),
            _flags(ends[~ended], n_steps),
            ends,
            states,
            card,
            None if speed is None else _numbers("speed", speed),
            several,
        )

    @classmethod
    def of_read(cls, found: Mapping[str, Any]) -> EpisodeStore:
        """Of what `read_table` gives."""
        actions, rewards = (_floats(name, found[name]) for name in ("actions", "rewards"))
        costs, several, card = _several(found["costs"], actions.shape[:1], actions.shape[1], found["card"])
        card = given_card(card)
        if found["origins"] is not None:
            card = moved_by(card, "observations", found["origins"])
        ends = found["episode_ends"]
        return cls._of_rows(found["observations"], actions, rewards, costs, several, ends, found["terminated"], card)

    @classmethod
    def from_table(
        cls,
        table: Tables,
        schema: TableSchema | None = None,
        *,
        notes: Sequence[str] = (),
        card: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> EpisodeStore:
        """A row per agent and time: a data frame (pandas, polars, pyarrow), a dictionary of columns, or a CSV or
        Parquet file. A list of these holds recordings, each with episodes of its own.

        What its columns are is a `TableSchema`, or the fields of one by name: `time`, `agent`, `state` and options.
        `card` adds fields to the store's; its warnings begin with the `notes`.
        """
        if schema is None:
            schema = TableSchema.of(options)
        elif options:
            raise UserError(f"schema and {next(iter(options))} both say how the table is read; give one of them.")
        return cls.of_read(read_table(table, schema, notes=notes, card=card))

    @classmethod
    def from_layout(
        cls,
        table: Tables,
        layout: str,
        *,
        notes: Sequence[str] = (),
        card: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> EpisodeStore:
        """A table in a published format (`highd`, `interaction`, `syndrone`, `sumo`, `obsmat`), or a list of them;
        options as of `from_table`."""
        columns, schema = read_layout(table, layout, options)
        return cls.from_table(columns, schema, notes=notes, card=card)

    @classmethod
    def split_table(
        cls,
        table: Tables,
        share: float,
        *,
        layout: str | None = None,
        notes: Sequence[str] = (),
        card: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> tuple[EpisodeStore, EpisodeStore]:
        """Two stores of one table, to learn by and to judge by: the first `share` of its time, and the rest. They have
        the same entries, bounds and steps, and no episode is in both. Options as of `from_table` or `from_layout`."""
        table, schema = (table, TableSchema.of(options)) if layout is None else read_layout(table, layout, options)
        steps, early = read_parts(table, schema, share, notes=notes, card=card)
        whole = cls.of_read(steps)
        if not 0 < early < whole.episodes:
            raise StoreError(
                f"split={share!r:.60} leaves {early} episodes in front of the cut and {whole.episodes - early} behind "
                "it; give another share, or a smaller min_episode_steps."
            )
        first = np.arange(whole.episodes) < early
        return whole.select(first), whole.select(~first)

    # --- disk ---
    def save(self, path: str | os.PathLike) -> Path:
        """Write one HDF5 file, whole or not at all."""
        found = {name: getattr(self, name) for name in (*ARRAYS, *OPTIONAL)}
        there = {name: array for name, array in found.items() if array is not None}
        return write(path, self.card, {k: Pieces(x.shape, x.dtype, [x]) for k, x in there.items()})

    @classmethod
    def load(cls, path: str | os.PathLike, memory: int | None = None, seed: int = 0) -> EpisodeStore:
        """Read and validate; a foreign, truncated, damaged or invalid file is refused, never read in part.

        Of a store that takes more bytes than `memory`, some episodes are read, at random and half of them with danger,
        where there are as many; its card's warnings say so. Whether these are what was written is not told then.
        """
        path = place(path)
        if not path.exists():
            raise StoreError(f"No episode store at '{path}'; make one with `ringfence data make TASK`.")
        if not path.is_file():
            raise StoreError(f"'{path}' is no regular file; give the file of an episode store.")
        if _begins_otherwise(path):
            raise StoreError(
                f"'{path}' is no episode store, by its first bytes; import it with `ringfence data`, or give its "
                "arrays to EpisodeStore.from_steps."
            )
        with reading(path, "episode store", "make or import it again"), h5py.File(path, "r") as f:
            if f.attrs.get("ringfence_store") != FORMAT:
                raise StoreError(
                    f"'{path}' is not an episode store of format {FORMAT}; import it with `ringfence data`."
                )
            there = _checked(path, f, memory is None)
            raw = f.attrs["card"]
            digest = f.attrs.get("digest")
            if not isinstance(raw, str | bytes) or len(raw) > 2**24:
                raise StoreError(f"'{path}' has no card that can be read; make or import it again.")
            digest_of_card = _digest(raw)
            if f.attrs.get("card_digest", digest_of_card) != digest_of_card:
                raise StoreError(
                    f"'{path}' has another card than was written; make or import it again, or delete its "
                    "attribute 'card_digest' if you wrote the card yourself."
                )
            card = schemas.decode(raw, dict[str, Any])
            size = sum(array.nbytes for array in there.values())
            steps = len(there["actions"])
            some = _sampled(path, there, memory * steps // size, seed) if memory is not None and size > memory else None
            content = {name: array[()] if some is None else some.of(name, array) for name, array in there.items()}
        try:
            found = cls(**content, card=complete_card(card))
        except UserError as error:
            raise StoreError(f"'{path}': {error}") from None
        if some is not None:
            said = f"learned from {found.steps:,} of {some.steps:,} steps: {some.words}"
            return replace(found, card=found.card.updated(warnings=[*found.card.warnings, said]))
        if digest is not None and digest != found.content:
            raise StoreError(
                f"'{path}' holds other numbers than were written (its digest differs); make or import it again."
            )
        return found


class Pieces(NamedTuple):
    """An array, some rows at a time."""

    shape: tuple[int, ...]
    dtype: np.dtype
    pieces: Iterable[np.ndarray]


def write(path: str | os.PathLike, card: StoreCard, content: Mapping[str, Pieces]) -> Path:
    """Write the HDF5 file of a store, whole or not at all."""
    path = place(path)
    told = json.dumps(card.to_dict())
    digest = Digest()
    with whole(path) as temporary, arrays.written(temporary) as f:
        f.attrs["ringfence_store"] = FORMAT
        f.attrs["card"] = told
        f.attrs["card_digest"] = _digest(told)
        for name, array in content.items():
            digest.begin(name, array.shape, array.dtype)
            there, done = f.create_dataset(name, array.shape, array.dtype), 0
            for piece in array.pieces:
                there[done : done + len(piece)] = piece
                digest.add(piece)
                done += len(piece)
        f.attrs["digest"] = digest.found
    return path


def _begins_otherwise(path: Path) -> bool:
    """Whether a file can be read and is no HDF5, not even the beginning of one."""
    begins = b""
    with suppress(OSError), path.open("rb") as file:
        begins = file.read(len(HDF5_BEGINS))
    return not HDF5_BEGINS.startswith(begins)


@dataclass(frozen=True, eq=False)
class _Sample:
    """Some of the episodes of a file."""

    episodes: np.ndarray  # which
    ends: np.ndarray  # (E,) of all
    words: str

    @property
    def steps(self) -> int:
        return int(self.ends[-1])

    def of(self, name: str, array: h5py.Dataset) -> np.ndarray:
        """Their rows of an array."""
        begins = np.concatenate([[0], self.ends[:-1]])
        if name == "episode_ends":
            return np.cumsum((self.ends - begins)[self.episodes])
        more = self.episodes if name in ("observations", "state") else 0
        last = 1 if name in ("observations", "state") else 0
        first, after = begins[self.episodes] + more, self.ends[self.episodes] + more + last
        cut = np.flatnonzero(first[1:] != after[:-1]) + 1  # episodes after one another are read at once
        spans = zip(first[np.concatenate([[0], cut])], after[np.concatenate([cut - 1, [len(after) - 1]])])
        return np.concatenate([array[begin:end] for begin, end in spans])


def _sampled(path: Path, there: Mapping[str, h5py.Dataset], steps: int, seed: int) -> _Sample:
    """Episodes of so many steps at most, and one at least."""
    ends = there["episode_ends"][()].astype(np.int64)
    lengths = np.diff(ends, prepend=0)
    if (lengths <= 0).any() or ends[-1] != len(there["actions"]):
        raise StoreError(
            f"The episode_ends of '{path}' do not increase to the number of its steps; make or import it again."
        )
    count = max(1, 2**24 // max(1, int(np.prod(there["costs"].shape[1:], dtype=int))))
    costly = [team(there["costs"][begin : begin + count]) > 0 for begin in range(0, ends[-1], count)]
    danger = np.logical_or.reduceat(np.concatenate(costly), ends - lengths)
    order = np.random.default_rng(seed).permutation(len(ends))
    chosen: list[int] = []
    left = steps
    for some, room in ((order[danger[order]], steps // 2), (order[~danger[order]], steps)):
        taken = some[np.cumsum(lengths[some]) <= min(room, left)]
        left -= int(lengths[taken].sum())
        chosen += taken.tolist()
    rest = order[~np.isin(order, chosen)]
    chosen += rest[np.cumsum(lengths[rest]) <= left].tolist()
    kept = np.sort(chosen or [int(order[0])])
    kinds = [f"{which[kept].sum():,} of {which.sum():,}" for which in (danger, ~danger)]
    return _Sample(kept, ends, f"{kinds[0]} episodes with danger, and {kinds[1]} others")


def _checked(path: Path, f: h5py.File, whole: bool) -> dict[str, h5py.Dataset]:
    """The arrays of a file, looked at before any of them is read: plain ones, in the file itself, of shapes that belong
    together and of no more bytes than the file can hold."""
    missing = [name for name in ARRAYS if name not in f]
    if missing:
        raise StoreError(f"'{path}' lacks the array '{missing[0]}'; make or import the store again.")
    found = {name: arrays.array(path, f, name) for name in (*ARRAYS, *OPTIONAL) if name in f}
    steps = found["actions"].shape[0]
    episodes = found["episode_ends"].shape[0]
    rows = {"observations": steps + episodes, "state": steps + episodes, "episode_ends": episodes}
    for name, array in found.items():
        if array.shape[0] != rows.get(name, steps):
            raise StoreError(
                f"'{path}' holds {array.shape[0]} rows of '{name}' for {steps} steps of {episodes} episodes; make or "
                "import the store again."
            )
    refuse = arrays.affordable if whole else arrays.possible
    refuse(path, sum(array.nbytes for array in found.values()), PACKED)
    return found


def team(costs: np.ndarray) -> np.ndarray:
    """(T,) the largest of agents' costs (T, N), or those of the team as they are."""
    return costs if costs.ndim == 1 else costs.max(1)


def _several(
    costs: Any, lead: tuple[int, ...], agents: int, card: GivenCard | None
) -> tuple[Any, np.ndarray | None, GivenCard | None]:
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
    fields = card.to_dict() if isinstance(card, StoreCard) else dict(card or {})
    given = dict(fields.get("constraints") or {})
    for name in given:
        if name not in found:
            raise unknown("constraint with a limit", name, found)
    several = np.stack(list(found.values()), -1).astype(np.float32)
    limits = {name: given.get(name, 0.0) for name in found}
    if isinstance(card, StoreCard):
        return several.max(-1), several, card.updated(constraints=limits)
    return several.max(-1), several, {**fields, "constraints": limits}


def _chosen(keep: Any, episodes: int) -> np.ndarray:
    """(E,) flags, of flags or of numbers of episodes."""
    given = np.asarray(keep)
    flags = given.dtype == bool and given.shape == (episodes,)
    numbers = given.dtype.kind in "iu" and given.ndim == 1 and bool(((given >= 0) & (given < episodes)).all())
    if not flags and not (numbers and len(set(given.tolist())) == len(given)):  # 0 and 1 are no flags
        raise StoreError(
            f"select got {given.dtype} of shape {given.shape}; give ({episodes},) true or false, or different "
            f"numbers of episodes from 0 to {episodes - 1}."
        )
    return given if flags else np.isin(np.arange(episodes), given)


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
        if value is None:
            raise StoreError(f"{name} is None; it is needed: give an array of numbers.")
        raise StoreError(f"{name} holds entries that are no real numbers (dtype {array.dtype}); give numbers.")
    if axes is not None and array.ndim != axes:
        raise StoreError(f"{name} has shape {array.shape}, which is not {axes} axes; add or remove one.")
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _truths(name: str, value: Any) -> np.ndarray:
    """Flags; numbers but 0 and 1, and words, are none: "False" is true to Python."""
    array = _numbers(name, value)
    if not np.isin(array, (0, 1)).all():
        raise StoreError(f"{name} holds entries other than true and false; give flags.")
    return array.astype(bool)


def _floats(name: str, value, axes: int | None = None) -> np.ndarray:
    return _numbers(name, value, axes).astype(np.float32, copy=False)


def _flat(x: np.ndarray, rows: int) -> np.ndarray:
    """(E, L, ...) as (rows, ...) in single precision, episodes one after another."""
    return _rows(x, rows).astype(np.float32, copy=False)


def _rows(x: np.ndarray, rows: int) -> np.ndarray:
    return np.ascontiguousarray(x.reshape(rows, *x.shape[2:]))


def _flags(ends: np.ndarray, steps: int) -> np.ndarray:
    """(T,) bool: the last step of each of these episodes."""
    flags = np.zeros(steps, bool)
    flags[ends - 1] = True
    return flags


def _whole_ends(episode_ends) -> np.ndarray:
    ends = _numbers("episode_ends", episode_ends, 1)
    if (ends % 1 != 0).any():
        raise StoreError("episode_ends holds fractions; give cumulative step counts, whole numbers.")
    return ends.astype(np.int64)


def _check_ends(ends: np.ndarray, steps: int) -> None:
    if len(ends) == 0 or ends[-1] != steps:
        raise StoreError(
            f"episode_ends ends at {ends[-1] if len(ends) else 'nothing'}, the data has {steps} steps; "
            "it must be cumulative and end with the number of steps (drop an unfinished last episode)."
        )
    if (np.diff(ends, prepend=0) <= 0).any():
        raise StoreError("episode_ends must increase; give cumulative step counts.")


def _check_rows(name: str, value: Any, rows: int) -> None:
    if value is not None and len(value) != rows:
        raise StoreError(f"from_steps got {len(value)} rows of {name}, it takes {rows}; see its docstring.")


def _check_episodes(sizes: tuple[int, int, int], **arrays: np.ndarray | None) -> None:
    """Refuse arrays of `from_episodes` that are not of (E, L, N) episodes, steps and agents, as the actions are."""
    e, length, n = sizes
    for name, value in arrays.items():
        if value is None:
            continue
        entries = name in ("observations", "state")  # one more axis, of any size
        expected = {
            "observations": (e, length + 1, n),
            "state": (e, length + 1),
            "terminated": (e,),
        }.get(name, sizes[: max(2, value.ndim)])
        if value.shape[: len(expected)] != expected or value.ndim != len(expected) + int(entries):
            wanted = ", ".join(map(str, expected)) + (", ..." if entries else "")
            raise StoreError(
                f"from_episodes got {name} of shape {value.shape}, the actions say {e} episodes of {length} steps "
                f"and {n} agents; give ({wanted})."
            )


def _whole_states(state: Any, final_state: Any, ends: np.ndarray, n_steps: int) -> np.ndarray | None:
    """(T + E, S) the states of all steps and of the ends, in order; None where there are none."""
    state = None if state is None else _numbers("state", state, 2)
    final_state = None if final_state is None else _numbers("final_state", final_state, 2)
    if state is None:
        return None
    _check_rows("state", state, n_steps)
    if final_state is None:
        raise StoreError("state was given without final_state; pass the global state each episode ended in, too.")
    _check_last("final_state", final_state, (len(ends), *state.shape[1:]))
    return np.insert(state, ends, final_state, axis=0)


def _check_last(name: str, value: np.ndarray, expected: tuple[int, ...]) -> None:
    if value.shape != expected:
        raise StoreError(
            f"{name} has shape {value.shape}, expected {expected}: the state that each of the {expected[0]} "
            "episodes ended in."
        )
