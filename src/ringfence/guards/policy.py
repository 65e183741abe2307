"""A policy under guard: whatever proposes, a World and its guard decide."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import NoSafeAction, UserError, one_of, unknown
from ringfence.guards.barrier import BarrierSource
from ringfence.guards.filter import Guard
from ringfence.guards.options import GUARDS, GuardOptions, in_steps
from ringfence.guards.proof import Prover
from ringfence.guards.shown import Shown
from ringfence.problem import constraints, normalise
from ringfence.problem.features import translation
from ringfence.problem.homogeneous import agent_policy
from ringfence.proposals.base import held, in_bounds_of
from ringfence.types import Array, Key, PolicyStep, Proposes, PyTree
from ringfence.utils.config import build_config
from ringfence.utils.given import cost_given
from ringfence.utils.precision import full_products
from ringfence.world import World
from ringfence.world.card import FARTHEST, Look
from ringfence.world.verdict import require, require_values

HORIZONS = ("horizon", "horizon_seconds")  # two ways to say how far a guard looks
BY_CARD = ("shield", "adapt", "full")  # guards that do what the card asks for

Paid = float | Mapping[str, float]  # what a step cost, in all or by each constraint's name
Cost = Array | dict[str, Array]  # the same of a batch: (B,) or (B, N), or that by constraint


class Guarded(eqx.Module):
    """A proposal under guard; itself a policy (types.Policy).

    A policy that proposes several steps has a method `propose`. One that gives one action at a time has its action
    held.
    """

    proposal: Any
    guard: Guard
    explains: bool = eqx.field(static=True, default=False)  # say of every step what was requested, and what was amiss
    driven: Array | None = None  # (B, N) bool: who does what is decided; others do what is proposed. None: all do

    def initial_state(self, batch: int) -> PyTree:
        options = self.guard.options
        spec = self.guard.world.spec
        constraints = max(1, len(self.guard.barrier.limits))
        shape = (batch, spec.n_agents, constraints) if self.guard.world.alone else (batch, constraints)
        carry = {
            "inner": self.proposal.initial_state(batch),
            # typed: a carry of other types than the one that follows is another program
            "margin": jnp.full(shape, options.margin, jnp.float32),
            "last": jnp.zeros((batch, options.horizon, spec.n_agents, spec.action_dim)),
            "before": jnp.zeros((batch, spec.n_agents, spec.feature_dim)),
            "cost": jnp.full(batch, jnp.nan, jnp.float32),
            "age": jnp.zeros((), jnp.int32),
        }
        if options.delay + options.max_age:
            low, high = (jnp.asarray(bound, jnp.float32) for bound in (spec.action_low, spec.action_high))
            nothing = normalise.to_unit(jnp.clip(0.0, low, high), spec.action_low, spec.action_high)
            shape = (batch, options.delay + options.max_age, spec.n_agents, spec.action_dim)
            carry["sent"] = jnp.broadcast_to(nothing, shape)  # the oldest first
            carry["observed_age"] = jnp.zeros((batch, spec.n_agents), jnp.int32)
        if constraints > 1:
            carry["costs"] = jnp.full((batch, constraints), jnp.nan, jnp.float32)
        return carry

    def observe_cost(self, carry: PyTree, cost: Cost) -> PyTree:
        """The carry with the cost of the last step, (B,) or (B, N), or of each constraint by its name: an adapting
        margin follows it. Without a cost the margin follows the guard's own judgement of the step. A cost that names
        none of several constraints is charged to those that judge the step unsafe, or to all."""
        if not isinstance(cost, dict):
            return {**carry, "cost": _of_team(cost)}
        costs = {name: _of_team(c) for name, c in cost.items()}
        names = self.guard.barrier.limits
        for name in costs:
            if names and name not in names:
                raise unknown("constraint", name, names)
        if not costs:
            raise UserError("cost names no constraint; give the cost of each, or None where nobody knows it.")
        if "costs" not in carry:
            return {**carry, "cost": functools.reduce(jnp.maximum, costs.values())}
        nothing = jnp.full_like(carry["cost"], jnp.nan)
        return {**carry, "costs": jnp.stack([costs.get(name, nothing) for name in names], -1)}

    def observe_age(self, carry: PyTree, age: Array) -> PyTree:
        """The carry with how many steps old the next observations (B, N) are, where the guard makes good for it."""
        if not self.guard.options.max_age:
            return carry
        return {**carry, "observed_age": jnp.clip(age, 0, self.guard.options.max_age)}

    def observe_sent(self, carry: PyTree, action: Array) -> PyTree:
        """The carry with what was sent (B, N, A) in the place of what was decided last."""
        if "sent" not in carry:
            return carry
        spec = self.guard.world.spec
        unit = normalise.to_unit(action, spec.action_low, spec.action_high)
        return {**carry, "sent": carry["sent"].at[:, -1].set(unit)}

    @full_products()
    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        key_propose, key_decide = jax.random.split(key)
        present = self.guard.world.map(observations, state)
        if "sent" in carry:
            observations, state = self._as_then(observations, state, self.when_it_acts(carry, present))
        inner, actions, info = self.proposed(carry["inner"], observations, state, key_propose)
        carry, step = self.decided({**carry, "inner": inner}, present, actions, key_decide)
        return carry, step._replace(info=info | step.info)

    def decided(self, carry: PyTree, present: Array, actions: Array, key: Key) -> tuple[PyTree, PolicyStep]:
        """What becomes of proposals (B, P, K, N, A) in the present (B, N, D)."""
        guard = self.guard
        margin = jnp.full_like(carry["margin"], guard.options.margin)  # known to the compiler unless it moves
        if guard.options.adapt:
            adapted = guard.adapted(carry["margin"], self._was_unsafe(carry, present))
            margin = jnp.where(carry["age"] == 0, margin, adapted)
        acting, unseen = present, None
        if "sent" in carry:
            acting = self.when_it_acts(carry, present)
            unseen = guard.options.delay + carry["observed_age"]
        found = guard.decide(acting, actions, carry["last"], margin, key, unseen, self.driven)
        action = found.plan[:, 0]
        proof = self._proved(acting, found.plan, unseen) if guard.options.proof else {}
        info = {
            "plans": found.rows,
            "chosen": found.chosen,
            "clearance": self._driven(found.safety, jnp.inf).min(-1),
            "next_clearance": self._driven(found.first, jnp.inf).min(-1),
            "infeasible": self._driven(found.short, False).any(-1),
            "ood": self._driven(found.ood, False).any(-1),
            "agent_clearance": found.safety,
            "agent_next_clearance": found.first,
            "agent_infeasible": found.short,
            "agent_ood": found.ood,
            **proof,
        }
        spec = guard.world.spec
        if self.explains:
            info |= reasons(guard, acting, actions[:, 0])
        if "sent" in carry:
            carry = {**carry, "sent": jnp.concatenate([carry["sent"][:, 1:], action[:, None]], 1)}
        unknown_costs = {name: jnp.full_like(carry[name], jnp.nan) for name in ("cost", "costs") if name in carry}
        carry = {
            **carry,
            **unknown_costs,
            "margin": margin,
            "last": found.plan,
            "before": present,
            "age": carry["age"] + 1,
        }
        return carry, PolicyStep(normalise.from_unit(action, spec.action_low, spec.action_high), info)

    def _driven(self, x: Array, nothing: float | bool) -> Array:
        """(B, N) of those for whom it is decided, and nothing of the others."""
        return x if self.driven is None else jnp.where(self.driven, x, nothing)

    def _proved(self, acting: Array, plan: Array, unseen: Array | None) -> dict[str, Array]:
        """Say whose plan (B, K, N, A) is proved, and of which teams everybody's is."""
        prover = prover_of(self.guard.world, self.guard.options)
        proved = prover.lower_bounds(acting, prover.continued(acting, plan), unseen).min(1) >= 0
        return {"proved": proved.all(-1), "agent_proved": proved}

    def when_it_acts(self, carry: PyTree, present: Array) -> Array:
        """(B, N, D) where the team will be when the action that is decided now takes effect: the World goes on from
        what was observed by the actions that were sent since, and by those that are on their way. An agent that is
        alone knows its own; the others go on as its World predicts."""
        sent = carry["sent"]
        due = self.guard.options.delay + carry["observed_age"]  # (B, N) the last so many
        x = present
        for k in range(sent.shape[1]):
            after, _ = self.guard.world.dynamics.step(x, sent[:, k])
            x = jnp.where((due >= sent.shape[1] - k)[..., None], after, x)
        return x

    def _as_then(self, observations: Array, state: Array | None, then: Array) -> tuple[Array, Array | None]:
        """What the proposal is shown: where the team will be (B, N, D), as far as its view can be read from it."""
        world = self.guard.world
        own = getattr(self.proposal, "feature_map", None)
        observations, state = world.map.written(observations, state, then)
        index = None if own is None else translation(own, world.map)
        if own is None or index is None:
            return observations, state
        index = jnp.broadcast_to(index, (*then.shape[:-1], index.shape[1]))
        return own.written(observations, state, jnp.take_along_axis(then, index, -1))

    def _was_unsafe(self, carry: PyTree, present: Array) -> Array:
        """(B, C) bool, or (B, N, C) of agents who are alone: what the step to the present cost, or is judged by the
        guard itself where its cost is not known."""
        judged = self.guard.barrier.now(carry["before"], present) < 0
        if not self.guard.world.alone:
            judged = judged.any(-2)
        axes = (1,) * (judged.ndim - 2)
        cost = carry["cost"].reshape(-1, *axes, 1)
        blamed = (cost > 0) & (judged | ~judged.any(-1, keepdims=True))
        unsafe = jnp.where(jnp.isnan(cost), judged, blamed)
        if "costs" in carry:
            costs = carry["costs"].reshape(-1, *axes, carry["costs"].shape[-1])
            unsafe = jnp.where(jnp.isnan(costs), unsafe, costs > 0)
        return unsafe

    def proposed(
        self, inner: PyTree, observations: Array, state: Array | None, key: Key
    ) -> tuple[PyTree, Array, dict[str, Array]]:
        """(carry, actions (B, P, K, N, A) in [−1, 1], info) of the proposal."""
        world = self.guard.world
        options = self.guard.options
        if isinstance(self.proposal, Proposes):
            own = getattr(self.proposal, "spec", world.spec)
            seen = in_bounds_of(own, world)
            count = options.num_samples
            carry, actions, info = self.proposal.propose(inner, observations, state, key, count, options.horizon, seen)
            if seen is not world:  # a World of logs with wider bounds knows what its own agents did
                actions = jnp.clip(normalise.in_units_of(world.spec, own, actions), -1.0, 1.0)
            return carry, actions, info
        carry, step = self.proposal.act(inner, observations, state, key)
        action = normalise.to_unit(step.action, world.spec.action_low, world.spec.action_high)
        return carry, held(action, options.horizon), {}


def costs_of_one(cost: Paid, agents: int) -> np.ndarray | dict[str, np.ndarray]:
    """What one environment's step cost, as `observe_cost` takes it; what is no cost is refused."""
    given = cost_given(cost, agents)
    if isinstance(given, dict):
        return {name: np.full(1, one, np.float32) for name, one in given.items()}
    return np.full(1, given, np.float32)


def acted(step: PolicyStep, who: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(action (N, A) float32, info) of one environment's step; what is not finite is refused, since nobody can act
    upon it."""
    action, info = jax.device_get((step.action, step.info))
    action = np.array(action[0], np.float32)
    info = {name: np.array(value[0]) for name, value in info.items()}
    if not np.isfinite(action).all():
        raise UserError(f"{who} gave actions that are not finite; it has diverged: train or fit it again.")
    if "clearance" in info and np.isnan(info["clearance"]).any():
        raise UserError(f"{who} cannot judge this step: its World predicts what is no number; fit it again.")
    return action, info


@contextmanager
def no_safe_action(last_action: np.ndarray | None) -> Iterator[None]:
    """A refusal at run time says what the last action was: somebody has to do something in its place."""
    try:
        yield
    except UserError as error:
        last = "there was no action before" if last_action is None else f"the last action was {last_action.tolist()}"
        raise NoSafeAction(f"{str(error).rstrip('.')} ({last}).", last_action) from error


def _of_team(cost: Array) -> Array:
    """(B,) the largest of agents' costs (B, N), or those of the team."""
    cost = jnp.asarray(cost, jnp.float32)
    return cost if cost.ndim == 1 else cost.max(-1)


# --- options ---

Named = Mapping[str, Mapping[str, Any]]  # options by a guard's name


def options_of(name: str, barrier: str, usual: Named = MappingProxyType({}), **changes: Any) -> dict[str, Any]:
    """Fields of GuardOptions that a named guard has, where `usual` holds what a task's simulator asks for by name. The
    margin, unless another is asked for, is a calibrated one of what is learned; of a formula less than its safe margin,
    which is what examples of safety have."""
    margin = {"margin": 1.0} if barrier == "learned" else {}
    return {**GUARDS[name], **margin, **usual.get(name, {}), **changes}


def by_card(world: World, name: str, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a named guard that a World's card asks for, unless they are asked for otherwise: to look farther ahead
    where the usual rows come too late, and to stay within what its logs have shown."""
    if name not in BY_CARD:
        return {}
    asked = {"within_logs": True} if Shown.known(world) else {}
    if not {*HORIZONS, "terminal_value"} & set(changes):
        asked |= _far_sighted(world.card.look or Look(), GUARDS[name].get("horizon", GuardOptions().horizon))
    return asked


def _far_sighted(look: Look, least: int) -> dict[str, Any]:
    """As many rows as what the barrier reads is predicted well for; else as many as avoiding danger takes, and at least
    so many, or the value of danger after the last row."""
    if look.rows > least:
        return {"horizon": look.rows}
    if look.avoiding:
        return {"horizon": max(look.avoiding, least)}
    return {"terminal_value": True} if look.terminal_value else {}


def build(
    proposal: Any,
    world: World,
    hazard: constraints.Hazard | None,
    name: str,
    barrier: str,
    usual: Named | None = None,
    anyway: bool = False,
    **changes: Any,
) -> Guarded:
    """A policy under the named guard with changed options; `usual` as in `options_of`, by default what the World's card
    asks for. A World that is unfit to guard by is refused unless it is insisted on with `anyway`."""
    one_of("guard", name, GUARDS)
    if barrier != "analytic":
        require(world.card, anyway)
    if usual is None:
        usual = {name: _held_by_plans(proposal, by_card(world, name, changes))} if barrier == "learned" else {}
    _refuse_two_horizons(changes)
    if world.card.data.action_delay:
        changes = {"delay": world.card.data.action_delay, **changes}
    options = build_config(GuardOptions, options_of(name, barrier, usual, **changes), "the guard")
    options = in_steps(options, world.card.data.dt)
    if not options.judges:
        raise UserError(
            f"guard='{name}' does nothing; name one that does: {', '.join(g for g in GUARDS if g != name)}."
        )
    _refuse_far(options, world)
    if options.optimizer_steps:
        require_values(world.card, anyway)
    if options.others_acceleration and world.map.dt is None:
        raise UserError(
            "others_acceleration needs a World of agents that see for themselves and know how long a step takes; leave "
            "it out."
        )
    if options.proof:
        if barrier != "learned":
            raise UserError(f"proof is of a barrier that was learned, and barrier='{barrier}'; leave one of them out.")
        prover_of(world, options)
    bound = None if hazard is None else constraints.bind_or_none(hazard, world.spec.feature_names, world.spec.n_agents)
    shown = Shown.by(world) if options.within_logs else None
    return Guarded(proposal, Guard(BarrierSource(world, barrier, bound, options.terminal_value, shown), options))


def _held_by_plans(proposal: Any, asked: dict[str, Any]) -> dict[str, Any]:
    """What a card asks for, but no more rows than plans of the proposal hold, where it plans."""
    rows = getattr(agent_policy(proposal), "rows_planned", None)
    return asked if rows is None or "horizon" not in asked else asked | {"horizon": min(asked["horizon"], rows)}


def _refuse_two_horizons(changes: Mapping[str, Any]) -> None:
    if set(HORIZONS) <= set(changes):
        both = " and ".join(f"{name}={changes[name]}" for name in HORIZONS)
        raise UserError(f"{both} both say how far the guard looks; give one of them.")


def prover_of(world: World, options: GuardOptions) -> Prover:
    """Who proves a guard's plans; Worlds that it cannot prove anything of are refused."""
    return Prover(world, options.proof, options.others_acceleration, options.proof_rows, options.proof_residual)


def rows_foreseen(world: World) -> int:
    """Rows for which a World's card tells how well they are predicted."""
    error = world.card.prediction_error
    return FARTHEST if error is None else len(error.error_of_change)


def _refuse_far(options: GuardOptions, world: World) -> None:
    """Refuse to roll actions forward for longer than anybody knows how well the World does."""
    known = rows_foreseen(world)
    late = options.delay + options.max_age
    if late > known:
        names = " and ".join(f"{n}={getattr(options, n)}" for n in ("delay", "max_age") if getattr(options, n))
        raise UserError(
            f"{names} ask the World for {late} steps before the guard decides, but its predictions are known for "
            f"{known}; give less."
        )


def reasons(guard: Guard, present: Array, plan: Array) -> dict[str, Array]:
    """Of a requested plan (B, K, N, A) in the present (B, N, D), for each agent: the action, and the part of the
    barrier that scored least along it, in which row and by how much. `guard.barrier.part_names` names the parts."""
    spec = guard.world.spec
    rows, _ = guard.predict(present, plan[:, None])
    scores = guard.barrier.parts(rows)[:, 0]  # (B, K, N, M)
    batch, steps, agents, many = scores.shape
    flat = jnp.moveaxis(scores, 2, 1).reshape(batch, agents, steps * many)
    worst = flat.argmin(-1)
    return {
        "agent_requested": normalise.from_unit(spec.own(plan[:, 0]), spec.action_low, spec.action_high),
        "agent_reason": worst % many,
        "agent_reason_row": worst // many + 1,
        "agent_reason_score": flat.min(-1),
    }
