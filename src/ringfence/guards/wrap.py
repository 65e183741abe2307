"""A guard for anybody's function: NumPy in, NumPy out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import LAST_SEED, UserError, whole_number
from ringfence.guards.policy import Guarded, Paid, acted, build, costs_of_one, no_safe_action
from ringfence.problem import constraints, normalise
from ringfence.problem.homogeneous import PerAgent, local_features, merge_agents, split_agents, team_policy
from ringfence.proposals.base import held
from ringfence.types import Array, Key, Policy, PolicyStep, PyTree
from ringfence.utils import stored
from ringfence.utils.given import NUMBERS, given_as
from ringfence.utils.precision import in_float32
from ringfence.utils.renamed import renamed, renamed_values
from ringfence.world import World


@jax.jit
def _decided(guarded: Guarded, memory: PyTree, present: Array, actions: Array, key: Key) -> tuple[PyTree, PolicyStep]:
    """One program for every guard of the same World and options."""
    return guarded.decided(memory, present, actions, key)


class Callback:
    """Anybody's function (observations, state) -> actions under guard, as a policy (types.Policy) outside JAX: it is
    asked with the whole batch, NumPy in, NumPy out."""

    def __init__(self, function: Callable, guarded: Guarded, agents: int):
        self.function, self.guarded, self.agents = function, guarded, agents

    @property
    def _team(self) -> Any:
        """Who observes costs: one guard, or that of each agent."""
        return team_policy(self.guarded, self.agents, self.guarded.guard.world.spec.homogeneous)

    @in_float32
    def start(self, batch: int) -> PyTree:
        return self._team.start(batch)

    @in_float32
    def observe_cost(self, memory: PyTree, cost) -> PyTree:
        return self._team.observe_cost(memory, jax.tree.map(lambda c: jnp.asarray(c, jnp.float32), cost))

    def act(self, memory: PyTree, observations, state, key: Key) -> tuple[PyTree, PolicyStep]:
        wanted = self.function(np.asarray(observations), None if state is None else np.asarray(state))
        return self.decided(memory, observations, state, wanted, key)

    def seen(self, observations: Any, state: Any) -> tuple[np.ndarray, np.ndarray | None]:
        """What one environment shows, (N, O) and (S,) or None: copies, of the widths that the World was fitted to."""
        world = self.guarded.guard.world
        width, state_width = world.widths
        needed = int(world.map.plus.max()) + 1
        reads_state = world.map.reads_state
        remedy = "pass what its logs hold"
        shape = (self.agents, None if reads_state else width)
        shown = given_as("observations", observations, shape, "this World", remedy)
        if reads_state and state is None:
            raise UserError(f"This World reads the global state ({state_width or 'S'} entries), and there is none.")
        whole = None
        if state is not None:
            whole = given_as("state", state, (state_width if reads_state else None,), "this World", remedy)
        there = len(whole) if reads_state and whole is not None else shown.shape[-1]
        if there < needed:
            name = "state" if reads_state else "observations"
            raise UserError(f"{name} has {there} entries, this World reads {needed}; {remedy}.")
        return shown, whole

    def _wanted(self, wanted: Any, batch: int) -> np.ndarray:
        """The function's actions (B, N, A), or a refusal."""
        each = wanted if isinstance(wanted, list) else [wanted]
        if any(isinstance(one, np.ma.MaskedArray) for one in each):
            raise UserError("The policy under guard returned a masked array; return actions (N, A).")
        try:
            wanted = np.asarray([np.asarray(one) for one in each] if isinstance(wanted, list) else wanted)
            if wanted.dtype.kind not in NUMBERS:
                raise TypeError
            wanted = np.array(wanted, np.float32)
        except (TypeError, ValueError):
            raise UserError("The policy under guard returned no array of numbers; return actions (N, A).") from None
        expected = (batch, self.agents, self.guarded.guard.world.spec.action_dim)
        if wanted.shape != expected:
            raise UserError(
                f"The policy under guard returned actions of shape {wanted.shape[1:]}; this World takes {expected[1:]}."
            )
        if not np.isfinite(wanted).all():
            raise UserError("The policy under guard returned actions that are not finite; it has diverged.")
        return wanted

    @in_float32
    def decided(self, memory: PyTree, observations, state, wanted, key: Key) -> tuple[PyTree, PolicyStep]:
        """What becomes of the function's actions (B, N, A)."""
        world = self.guarded.guard.world
        spec, batch = world.spec, len(observations)
        wanted = self._wanted(wanted, batch)
        action = jnp.clip(normalise.to_unit(jnp.asarray(wanted), spec.action_low, spec.action_high), -1.0, 1.0)
        given = jnp.asarray(observations), None if state is None else jnp.asarray(state)
        present = local_features(world.map, spec.homogeneous, *given)
        plan = held(split_agents(action) if spec.homogeneous else action, self.guarded.guard.options.horizon)
        memory, step = _decided(self.guarded, memory, present, plan, key)
        return memory, merge_agents(step, (batch, self.agents)) if spec.homogeneous else step


class Pilot:
    """Anybody's function (observations, state) -> actions under guard at run time: one environment, NumPy in, NumPy
    out, as `Controller`.

    pilot.reset()                                  # at the start of every episode
    action = pilot.act(observations, state)        # (N, O), (S,) or None -> (N, A)

    `info` says of the last action what the guard knows of it. `policy` is what simulators of whole batches play.
    """

    def __init__(self, policy: Callback, seed: int = 0):
        self.policy = policy
        self._key = jax.random.key(whole_number("seed", seed, 0, LAST_SEED))
        self.info: dict[str, np.ndarray] = {}
        self.last_action: np.ndarray | None = None
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._memory = self.policy.start(1)

    def act(self, observations: np.ndarray, state: np.ndarray | None = None, cost: Paid | None = None) -> np.ndarray:
        """(N, A) joint action; the function is asked with the same arrays. `cost` is what the last step cost, in all or
        by each constraint's name, which an adapting guard follows.

        What nobody can act upon safely is refused with `NoSafeAction`, whose `last_action` is that of the step before:
        arrays of another shape than the World's, what is not finite, and what is no cost."""
        with no_safe_action(self.last_action):
            seen, whole = self.policy.seen(observations, state)
            paid = None if cost is None else costs_of_one(cost, self.policy.agents)
            # Copies: a function that writes into what it sees must not blind its guard.
            wanted = self.policy.function(seen.copy(), None if whole is None else whole.copy())
            memory = self._memory if paid is None else self.policy.observe_cost(self._memory, paid)
            key, now = jax.random.split(self._key)
            shown = seen[None], None if whole is None else whole[None]
            memory, step = self.policy.decided(memory, *shown, [wanted], now)
            action, info = acted(step, "The guard")
        self._memory, self._key, self.info, self.last_action = memory, key, info, action.copy()
        return action


class Nothing(eqx.Module):
    """Stands where a callback's proposals come from outside."""

    def start(self, batch: int) -> PyTree:
        return {}


@in_float32
def guard(
    policy: Any,
    world: World,
    *,
    guard: str = "shield",
    barrier: str = "learned",
    hazard: constraints.Hazard | None = None,
    seed: int = 0,
    agents: int | None = None,
    anyway: bool = False,
    **options,
):
    """Any policy under guard.

    policy: a policy of the library (with `start` and `act`), which gives a `Guarded`; or any callable (observations
    (N, O), state (S,) or None) -> actions (N, A) within the task's bounds, e.g. a PyTorch network or a controller,
    which gives a `Pilot`, for a team of `agents` where the World is of homogeneous agents. `guard` is a name in
    GUARDS, `barrier` learned, analytic or both, `options` fields of GuardOptions; `hazard` defines the analytic one,
    where that is to be used. A World whose verdict is unfit is refused, unless `anyway`.
    """
    if not isinstance(world, World):
        raise UserError(f"guard() got a {type(world).__name__} for a World; fit one with ringfence.fit(store).")
    options = renamed(options, stored.GUARD_OPTIONS | {"danger": "barrier"}, "the guard")
    barrier = renamed_values({"barrier": options.pop("barrier", barrier)}, stored.VALUES)["barrier"]
    if isinstance(policy, PerAgent):
        return PerAgent(build(policy.one, world, hazard, guard, barrier, anyway=anyway, **options), policy.agents)
    if isinstance(policy, Policy):
        return build(policy, world, hazard, guard, barrier, anyway=anyway, **options)
    if not callable(policy):
        raise UserError(
            f"guard() got a {type(policy).__name__}; give a callable (observations, state) -> actions, or a policy."
        )
    spec = world.spec
    if agents is None and spec.homogeneous:
        raise UserError("The World is of homogeneous agents; say with agents= how many of them there are.")
    if agents not in (None, spec.n_agents) and not spec.homogeneous:
        raise UserError(f"The World is of {spec.n_agents} heterogeneous agents; leave agents={agents} out.")
    guarded = build(Nothing(), world, hazard, guard, barrier, anyway=anyway, **options)
    return Pilot(Callback(policy, guarded, agents or spec.n_agents), seed)
