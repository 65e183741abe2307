"""What a simulator is: pure JAX (`PureEnv`), or one that steps outside JAX (`NativeEnv`); and episodes under way, of
whatever steps outside JAX (`Env`). And the loops that play it: `rollout` over whatever steps outside JAX, `scanned`
within it.

Tasks, data sets, evaluation and films ask nothing else of a simulator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.problem.features import FeatureMap
from ringfence.types import Array, Key, Policy, PolicyStep, PyTree, Transition, act_with, with_cost
from ringfence.utils import interrupts

if TYPE_CHECKING:
    from PIL.Image import Image

Seed = int | Sequence[int]


class Simulator(Protocol):
    """What every simulator says of itself. It is a frozen dataclass: it can be compared, hashed, written down, and
    copied with another number of agents."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def n_agents(self) -> int: ...

    @property
    def action_dim(self) -> int: ...

    @property
    def observation_dim(self) -> int: ...

    @property
    def episode_length(self) -> int:
        """The time limit, in steps."""
        ...

    @property
    def terminates(self) -> bool:
        """Whether the task itself may end an episode before the time limit."""
        ...

    @property
    def state_names(self) -> tuple[str, ...]:
        """S entries of the global state."""
        ...

    @property
    def world(self) -> Mapping[str, Any]:
        """Settings that its World needs, where they differ from the defaults."""
        ...

    @property
    def guard(self) -> Mapping[str, Mapping[str, Any]]:
        """Options of named guards, where they differ from the defaults."""
        ...

    def feature_map(self, view: str) -> FeatureMap:
        """s̃_i in a view (problem/features.py)."""
        ...


class Defaults:
    """What most simulators say of themselves."""

    @property
    def terminates(self) -> bool:
        """Nothing but the time limit ends an episode."""
        return False

    @property
    def world(self) -> Mapping[str, Any]:
        """Its World needs no settings of its own."""
        return {}

    @property
    def guard(self) -> Mapping[str, Mapping[str, Any]]:
        """Named guards are as everywhere."""
        return {}


class PureEnv(Simulator, Protocol):
    """A simulator in JAX. States are pytrees with a leading B axis; all methods are pure and may be jitted."""

    def reset(self, key: Key, batch: int) -> PyTree: ...

    def step(self, state: PyTree, action: Array) -> tuple[PyTree, Transition]:
        """Advance by one step; `action` is (B, N, A) in the bounds of the task and is clipped to them."""
        ...

    def observe(self, state: PyTree) -> Array:
        """(B, N, O) local observations."""
        ...

    def global_state(self, state: PyTree) -> Array:
        """(B, S) what a centralised planner may see."""
        ...

    def from_global_state(self, flat: Array) -> PyTree:
        """Inverse of `global_state`."""
        ...


@runtime_checkable
class Measured(Protocol):
    """A simulator that knows how far everybody is from danger."""

    def from_global_state(self, flat: Array) -> PyTree: ...

    def clearance(self, state: PyTree) -> Array:
        """(..., N) signed distance, negative where it costs."""
        ...


class Seen(NamedTuple):
    """What is observed of B episodes."""

    observations: np.ndarray  # (B, N, O)
    state: np.ndarray | None  # (B, S); None: there is none


class Outcome(NamedTuple):
    """What came of a step of B episodes; of one that was not running it does not count."""

    reward: np.ndarray  # (B,) shared, or (B, N)
    cost: Any  # (B,) shared, (B, N), or such by constraint, as policies observe it
    terminated: np.ndarray  # (B,) bool: the task itself ended
    shown: np.ndarray  # (B,) bool: was running, and what is observed now is where the step led
    info: Mapping[str, np.ndarray] = {}  # (B,) each: what else there is to know, e.g. a robot's `speed` (m/s)


class Env(Protocol):
    """B episodes under way, side by side, outside JAX. Not pure: `reset` and `step` change it."""

    @property
    def running(self) -> np.ndarray:
        """(B,) bool: not ended."""
        ...

    def reset(self, seeds: Sequence[Any]) -> None:
        """Begin an episode for each seed, which fixes its start, whatever the others are."""
        ...

    def observe(self) -> Seen:
        """What policies see now; of an episode that has ended, what was last seen."""
        ...

    def step(self, action: np.ndarray) -> Outcome:
        """Advance what is running by joint actions (B, N, A)."""
        ...


@runtime_checkable
class NativeEnv(Simulator, Protocol):
    """A simulator that steps outside JAX."""

    def simulate(self, batch: int, threads: int | None = None) -> Env:
        """`batch` episodes side by side."""
        ...


@runtime_checkable
class Filmed(Protocol):
    """A simulator that draws its episodes."""

    @property
    def film_shows(self) -> str:
        """What a film's colours and lines mean, in a sentence."""
        ...

    @property
    def opengl(self) -> bool:
        """Whether drawing needs OpenGL."""
        ...

    def frames(self, states: np.ndarray, moments: list[tuple[int, bool]]) -> Iterator[Image]:
        """Pictures of an episode, states (T+1, S), at `moments`: (step, whether there was a cost since the last)."""
        ...


class Moment(NamedTuple):
    """A step of B episodes."""

    running: np.ndarray  # (B,) bool: which of them took it
    before: Seen
    decided: PolicyStep
    outcome: Outcome
    after: Seen


Watch = Callable[[Moment], None]


def nobody(now: Moment) -> None:
    """Watches."""


def rollout(policy: Policy, env: Env, watch: Watch, keys: Iterator[Any]) -> None:
    """Play the episodes that have begun in `env` to their end, and show every step to `watch`.

    keys: what the policy draws from, one for each step; where they end, so does the rollout.
    """
    carry = policy.initial_state(len(env.running))
    before = env.observe()
    while env.running.any() and (key := next(keys, None)) is not None:
        interrupts.check()
        running = env.running.copy()
        carry, decided = act_with(policy, carry, *before, key)
        outcome = env.step(np.asarray(decided.action))
        after = env.observe()
        watch(Moment(running, before, decided, outcome, after))
        carry = with_cost(policy, carry, outcome.cost)
        before = after


def scanned(
    env: PureEnv, first: PyTree, choose: Callable[[PyTree, Any], Array], xs: PyTree
) -> tuple[PyTree, Array, Transition]:
    """(states (B, L+1, ...), actions (B, L, N, A), what came of them (B, L, ...)) of episodes from the states `first`,
    under actions `choose(state, x)`, x along the first axis of `xs`."""

    def step(state: PyTree, x: Any) -> tuple[PyTree, tuple[PyTree, Array, Transition]]:
        action = choose(state, x)
        after, transition = env.step(state, action)
        return after, (after, action, transition)

    _, (after, actions, transitions) = jax.lax.scan(step, first, xs)
    states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, after)
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (states, actions, transitions))


@dataclass(frozen=True)
class Memoryless:
    """A function of observations, the state and a key as a policy."""

    function: Callable[[Any, Any, Any], Any]

    def initial_state(self, batch: int) -> PyTree:
        return None

    def act(self, carry: PyTree, observations: Any, state: Any, key: Any) -> tuple[PyTree, PolicyStep]:
        return carry, PolicyStep(self.function(observations, state, key), {})


def split_off(key: Key) -> Iterator[Key]:
    """Keys without end, each split off from what the last one left."""
    while True:
        key, now = jax.random.split(key)
        yield now
