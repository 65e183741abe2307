"""A guard for anybody's function: NumPy in, NumPy out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError, of_kind, whole_number
from ringfence.guards.policy import Guarded, build
from ringfence.problem import constraints, normalise
from ringfence.problem.homogeneous import (
    PerAgent,
    agent_policy,
    local_features,
    merge_agents,
    split_agents,
    team_policy,
)
from ringfence.problem.origins import Origins
from ringfence.proposals.base import held
from ringfence.types import Array, Key, Policy, PolicyStep, PyTree
from ringfence.utils.functions import of_both
from ringfence.utils.given import NUMBERS, given_as
from ringfence.utils.precision import in_float32
from ringfence.world import World

_LOOKS_ON = {"correction_steps": 0, "select": True}  # options of a guard that corrects nothing: of one proposal


@jax.jit
def _decided(guarded: Guarded, carry: PyTree, present: Array, action: Array, key: Key) -> tuple[PyTree, PolicyStep]:
    """One program for every guard of the same World and options."""
    return guarded.decided(carry, present, held(action, guarded.guard.options.horizon), key)


class Callback:
    """Anybody's function (observations, state) -> actions under guard, as a policy (types.Policy) outside JAX: it is
    asked with the whole batch, NumPy in, NumPy out."""

    def __init__(self, function: Callable, guarded: Guarded, agents: int):
        self.function, self.guarded, self.agents = function, guarded, agents

    @property
    def _team(self) -> Any:
        """Who observes costs: one guard, or that of each agent."""
        return team_policy(self.guarded, self.agents, self.guarded.guard.world.spec.homogeneous)

    @property
    def origins(self) -> Origins:
        """What is taken from what is given; the function is asked with what was measured."""
        return self.guarded.guard.world.origins

    @in_float32
    def initial_state(self, batch: int) -> PyTree:
        return self._team.initial_state(batch)

    @in_float32
    def observe_cost(self, carry: PyTree, cost) -> PyTree:
        return self._team.observe_cost(carry, jax.tree.map(lambda c: jnp.asarray(c, jnp.float32), cost))

    def act(self, carry: PyTree, observations, state, key: Key) -> tuple[PyTree, PolicyStep]:
        given = np.asarray(observations), None if state is None else np.asarray(state)
        wanted = self.function(*self.origins.measured(*given))
        return self.decided(carry, observations, state, wanted, key)

    def seen(self, observations: Any, state: Any) -> tuple[np.ndarray, np.ndarray | None]:
        """What one environment shows, (N, O) and (S,) or None: copies, of the widths that the World was fitted to."""
        world = self.guarded.guard.world
        width, state_width = world.widths
        reads_state = world.map.reads_state
        remedy = "pass what its logs hold"
        shape = (self.agents, width if "observations" in world.map.reads else None)
        origins = world.origins
        shown = given_as("observations", observations, shape, "this World", remedy, origins.observations)
        if reads_state and state is None:
            raise UserError(f"This World reads the global state ({state_width or 'S'} entries), and there is none.")
        whole = None
        if state is not None:
            shape = (state_width if reads_state else None,)
            whole = given_as("state", state, shape, "this World", remedy, origins.state)
        beyond = world.map.beyond(shown.shape[-1], None if whole is None else len(whole))
        if beyond is not None:
            raise UserError(f"This World reads {beyond}; {remedy}.")
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
    def decided(self, carry: PyTree, observations, state, wanted, key: Key) -> tuple[PyTree, PolicyStep]:
        """What becomes of the function's actions (B, N, A)."""
        world = self.guarded.guard.world
        spec, batch = world.spec, len(observations)
        wanted = self._wanted(wanted, batch)
        action = normalise.to_unit(wanted, spec.action_low, spec.action_high).clip(-1.0, 1.0)
        given = (None if x is None else np.asarray(x, np.float32) for x in (observations, state))
        present = local_features(world.map, spec.homogeneous, *given)
        action = split_agents(action) if spec.homogeneous else action
        carry, step = _decided(self.guarded, carry, present, action, key)
        return carry, merge_agents(jax.device_get(step), (batch, self.agents)) if spec.homogeneous else step


class Nothing(eqx.Module):
    """Stands where a callback's proposals come from outside."""

    def initial_state(self, batch: int) -> PyTree:
        return {}


def under_guard(
    policy: Any,
    world: World,
    *,
    guard: str = "shield",
    barrier: str = "learned",
    hazard: constraints.Hazard | None = None,
    agents: int | None = None,
    anyway: bool = False,
    **options: Any,
) -> Guarded | PerAgent | Callback:
    """A policy of the library, or any callable, under guard; the arguments are those of `ringfence.guard`."""
    if not isinstance(world, World):
        raise UserError(f"guard() got a {type(world).__name__} for a World; fit one with ringfence.fit(store).")
    of_kind("guard", guard, str, "give a guard's name")
    of_kind("barrier", barrier, str, "give learned, analytic or both")
    of_kind("hazard", hazard, constraints.Hazard | None, "give a Separation, SpeedLimit, CostColumn or All")
    if agents is not None:
        whole_number("agents", agents, 1)
    if isinstance(policy, PerAgent):
        return PerAgent(build(policy.one, world, hazard, guard, barrier, anyway=anyway, **options), policy.agents)
    if isinstance(policy, Policy):
        return build(policy, world, hazard, guard, barrier, anyway=anyway, **options)
    if not callable(policy):
        raise UserError(
            f"guard() got a {type(policy).__name__}; give a callable, observations -> actions, or a policy; who acts "
            "by a run is Controller(run, guard=...)."
        )
    function = of_both(policy)
    spec = world.spec
    if agents is None and spec.homogeneous:
        raise UserError("The World is of homogeneous agents; say with agents= how many of them there are.")
    if agents not in (None, spec.n_agents) and not spec.homogeneous:
        raise UserError(f"The World is of {spec.n_agents} heterogeneous agents; leave agents={agents} out.")
    if guard == "none":  # it looks on, whatever the World is worth
        guard, anyway, options = "shield", True, {**options, **_LOOKS_ON}
    guarded = build(Nothing(), world, hazard, guard, barrier, anyway=anyway, **options)
    return Callback(function, guarded, agents or spec.n_agents)


def guarded_of(policy: Any) -> Guarded | None:
    """The guard of a policy: a team's, of each agent, or of a function; None where there is none."""
    one = policy.guarded if isinstance(policy, Callback) else agent_policy(policy)
    return one if isinstance(one, Guarded) else None


def with_guarded(policy: Any, guarded: Guarded) -> Any:
    """The policy under another guard."""
    if isinstance(policy, Callback):
        return Callback(policy.function, guarded, policy.agents)
    return PerAgent(guarded, policy.agents) if isinstance(policy, PerAgent) else guarded
