"""The nouns of the library, with every shape.

Axis letters everywhere: B batch, E episodes, T time, H plan horizon, N agents, O observation, S global state,
D feature, A action, K diffusion steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import numpy as np

from ringfence.errors import UserError

Array = jax.Array
X = TypeVar("X", np.ndarray, Array)  # NumPy in gives NumPy out
Key = jax.Array
PyTree = Any
Metrics = dict[str, Array]
# Of actions: one number for all entries, one of each entry (A,), or these of each agent (N, A); problem/bounds.py
Bound = float | tuple[float, ...] | tuple[tuple[float, ...], ...]
LARGEST_BOUND = 1e30  # of an action: the range still has a size in float32


class Transition(NamedTuple):
    """What one environment step gives, for a batch of environments."""

    reward: Array  # (B, N) per agent; the team's reward is the mean over N
    cost: Array  # (B,) shared, or (B, N) of each agent; 0 means nothing dangerous happened
    terminated: Array  # (B,) bool: the task itself ended; the time limit is never a termination

    @property
    def team_cost(self) -> Array:
        """(B,): of agents with costs of their own, the largest one."""
        return self.cost if self.cost.ndim == 1 else self.cost.max(-1)


@dataclass(frozen=True)
class Spec:
    """What an algorithm must know of a task and its data; travels with every checkpoint."""

    task: str
    n_agents: int
    action_dim: int
    feature_names: tuple[str, ...]  # the entries of s̃_i, in order
    action_low: Bound
    action_high: Bound
    episode_length: int
    homogeneous: bool = False  # agents that share all that is learned: the spec of a team of one
    action_sizes: tuple[int, ...] | None = None  # entries that each agent's action has, where not all have action_dim

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> Spec:
        """What `to_dict` gave."""
        values: dict[str, Any] = {k: as_tuples(v) for k, v in stored.items()}
        if foreign := sorted(values.keys() - {f.name for f in fields(cls)}):
            raise UserError(f"The spec has '{foreign[0]}', unknown to this version; use the one that wrote it.")
        return cls(**values)

    def __post_init__(self):
        shapes = ((), (self.action_dim,), (self.n_agents, self.action_dim))
        try:
            low, high = np.asarray(self.action_low, np.float64), np.asarray(self.action_high, np.float64)
        except (TypeError, ValueError):
            raise UserError("Actions have bounds that are no numbers of one shape; give one, or one of each.") from None
        if low.shape not in shapes or high.shape not in shapes:
            raise UserError(
                f"Actions have bounds of shape {low.shape} and {high.shape}; give one number, or one of each of the "
                f"{self.action_dim} entries."
            )
        if not ((-LARGEST_BOUND <= low) & (low < high) & (high <= LARGEST_BOUND)).all():  # NaN included
            low, high = (f"{one:g}" if np.ndim(one) == 0 else str(one.tolist()) for one in (low, high))
            raise UserError(f"Actions from {low} to {high} are no range; give finite bounds, the lower first.")

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it; what is the same for nearly all data is left out."""
        return {k: v for k, v in asdict(self).items() if k != "action_sizes" or v is not None}

    def own(self, action: Array) -> Array:
        """Actions (..., N, A) in [−1, 1] with 0 where an agent has no such entry."""
        if self.action_sizes is None:
            return action
        return action * has_entry(self.action_sizes, self.action_dim)

    @property
    def feature_dim(self) -> int:
        return len(self.feature_names)


def has_entry(sizes: Sequence[int], widest: int) -> np.ndarray:
    """(N, A) bool: which entries of a joint action agents have, whose own actions have these sizes."""
    return np.arange(widest) < np.array(sizes)[:, None]


def as_tuples(value: Any) -> Any:
    """Lists, as JSON holds them, also within lists, as tuples, which can be hashed."""
    return tuple(as_tuples(one) for one in value) if isinstance(value, list | tuple) else value


class Batch(NamedTuple):
    """Windows of data, in physical units but for actions; with history, H counts its rows too."""

    features: Array  # (B, H, N, D) s̃_i at t .. t+H-1; the tail past the episode's end repeats the last state
    actions: Array  # (B, H-1, N, A) the action between rows h and h+1, its bounds at −1 and 1 (0 where padded)
    valid: Array  # (B, H) bool: the row is not past the episode's end; history before its start repeats the first state
    score: Array  # (B,) normal score of the window's value among the data: the condition y
    costs: Array  # (B, H) cost charged on arriving in the row; −1 in an episode's first state, where nobody arrived
    rewards: Array  # (B, H-1, N) of the step between rows h and h+1 (0 where padded)
    terminated: Array  # (B, H-1) bool: that step ended the task itself

    def rows_from(self, first: int) -> Batch:
        """The same windows without the rows before `first`."""
        score = self.score
        return Batch(*(x if x is score else x[:, first:] for x in self))


class PolicyStep(NamedTuple):
    """A joint action and what led to it."""

    action: Array  # (B, N, A)
    info: dict[str, Array]  # e.g. `clearance`, `infeasible` (B,), `agent_infeasible` (B, N), `plans` (B, P, H, N, D)


@runtime_checkable
class Policy(Protocol):
    """Acts on a batch of environments. `carry` is a pytree carried between steps (a plan in progress, a history).

    A policy may have `observe_cost(carry, cost) -> carry`: it then observes the cost (B,) of every step. One that
    knows several steps ahead has `propose(carry, observations, state, key, count, rows, world)` -> (carry, actions
    (B, P, K, N, A) in [−1, 1], info), which guards choose from.
    """

    def initial_state(self, batch: int) -> PyTree: ...

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]: ...


@runtime_checkable
class ObservesCost(Protocol):
    """A policy that observes what every step cost, (B,) or (B, N), or that by constraint, and remembers it."""

    def observe_cost(self, carry: PyTree, cost: Any) -> PyTree: ...


@runtime_checkable
class ObservesDelay(Policy, Protocol):
    """A policy that knows how old its observations (B, N) are, and what was sent of its actions (B, N, A)."""

    def observe_age(self, carry: PyTree, age: Array) -> PyTree: ...

    def observe_sent(self, carry: PyTree, action: Array) -> PyTree: ...


@runtime_checkable
class Proposes(Policy, Protocol):
    """A policy that knows several steps ahead: (carry, actions (B, P, K, N, A) in [−1, 1], info)."""

    def propose(
        self, carry: PyTree, observations: Array, state: Any, key: Key, count: int, rows: int, world: Any
    ) -> tuple[PyTree, Array, dict[str, Array]]: ...


def with_cost(policy: Policy, carry: PyTree, cost: Any) -> PyTree:
    """The carry of a policy that wants to know what its last step cost, (B,) or (B, N), or that by constraint; arrays
    of NumPy or JAX."""
    return policy.observe_cost(carry, cost) if isinstance(policy, ObservesCost) else carry


def act_with(policy: Policy, carry: PyTree, observations: Any, state: Any, key: Key) -> tuple[PyTree, PolicyStep]:
    """The policy as an argument, so that what is compiled does not hold its parameters as constants."""
    return policy.act(carry, observations, state, key)


@dataclass(frozen=True)
class Algorithm:
    """An algorithm is a value: a name, a typed config and pure functions. No base class, no registry."""

    name: str
    Config: type  # frozen dataclass; the command line is generated from it
    check: Callable[..., None]  # (config, hazard): refuses settings that cannot work
    # (key, spec, config, data, feature_map, hazard, and the world where one is needed) -> state, a pytree; what stands
    # in state["world"] is kept in the run's World, not in its checkpoints
    init: Callable[..., PyTree]
    make_update: Callable[..., Callable]  # (config, spec, feature_map, hazard) -> update(state, batch, key)
    make_diagnose: Callable[..., Callable]  # same -> diagnose(state, batch, key) -> metrics, once per chunk
    make_policy: Callable[..., Policy]  # (state, config, spec, feature_map, hazard, options) -> Policy
    presets: dict[str, dict[str, Any]]  # named differences from the config's defaults; the first is the default
    # config -> what training knows danger by: the hazard's labels of states, the World's barrier, the logged costs
    # alone, or nothing
    cost_source: Callable[[Any], Literal["labels", "world", "costs", "nothing"]] = lambda config: "labels"
    # (store, config, feature_map, world) -> WindowData, if not all of the store
    make_windows: Callable[..., Any] | None = None
    # config -> settings of the World that training reads, if it reads one
    world_settings: Callable[[Any], dict[str, Any] | None] = lambda config: None
    from_world: Callable[[Any, Any], dict[str, PyTree]] | None = None  # (world, config) -> state["world"]
    limit: str | None = None  # the config field that is a limit of the cost per episode: own data's card fills it
    revision: int = 1  # raised when the same settings come to train another policy; config.json tells it

    def preset_for(self, wanted: tuple[str, ...]) -> str:
        """The first of the wanted presets that exists, else the algorithm's first one."""
        return next((name for name in wanted if name in self.presets), next(iter(self.presets)))
