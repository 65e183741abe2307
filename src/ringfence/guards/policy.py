"""A policy under guard: whatever proposes, a World and its guard decide."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError, unknown
from ringfence.guards.danger import Danger
from ringfence.guards.filter import Guard
from ringfence.guards.options import GUARDS, GuardOptions
from ringfence.problem import constraints, normalise
from ringfence.proposals.base import held
from ringfence.types import Array, Key, PolicyStep, PyTree
from ringfence.world import World

LITTLE = 0.9  # of what could be avoided: where three rows avoid less, V sees in time what they do not
KEPT = 0.9  # of the safe steps: cars and discs are at 0.94 and more, robots, whose logs are too fast, at 0 to 0.8

Paid = float | Mapping[str, float]  # what a step cost, in all or by each constraint's name


class Guarded(eqx.Module):
    """A proposal under guard; itself a policy (types.Policy).

    What proposes several steps has a method `propose`; of what gives one action at a time the next ones are asked along
    foreseen rows, where its view can be read from the World's, and the last action is held where it cannot.
    """

    proposal: Any
    guard: Guard

    def start(self, batch: int) -> PyTree:
        o, spec = self.guard.options, self.guard.world.spec
        several = max(1, len(self.guard.danger.limits))
        shape = (batch, spec.n_agents, several) if self.guard.world.alone else (batch, several)
        told = {"costs": jnp.full((batch, several), jnp.nan)} if several > 1 else {}
        return told | {
            "inner": self.proposal.start(batch),
            "margin": jnp.full(shape, o.margin),
            "last": jnp.zeros((batch, o.rows, spec.n_agents, spec.action_dim)),
            "before": jnp.zeros((batch, spec.n_agents, spec.feature_dim)),
            "cost": jnp.full(batch, jnp.nan),
            "age": jnp.zeros((), jnp.int32),
        }

    def hear(self, memory: PyTree, cost: Array | dict[str, Array]) -> PyTree:
        """The memory with the cost that the last step had, (B,) or (B, N), or of each constraint by its name: what an
        adapting margin follows. Where none is told, it follows its own judgement of the step; a cost of nobody knows
        which of several constraints is charged to those that judge the step unsafe, or to all."""
        if isinstance(cost, dict):
            each, names = {k: _of_team(c) for k, c in cost.items()}, self.guard.danger.limits
            if "costs" in memory:
                if strangers := [k for k in each if k not in names]:
                    raise unknown("constraint", strangers[0], names)
                heard = [each.get(k, jnp.full_like(memory["cost"], jnp.nan)) for k in names]
                return {**memory, "costs": jnp.stack(heard, -1)}
            cost = functools.reduce(jnp.maximum, each.values())
        return {**memory, "cost": _of_team(cost)}

    def act(self, memory: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        kp, kd = jax.random.split(key)
        inner, actions, info = self.proposed(memory["inner"], observations, state, kp)
        present = self.guard.world.map(observations, state)
        memory, step = self.decided({**memory, "inner": inner}, present, actions, kd)
        return memory, step._replace(info=info | step.info)

    def decided(self, memory: PyTree, present: Array, actions: Array, key: Key) -> tuple[PyTree, PolicyStep]:
        """What becomes of proposals (B, P, K, N, A) in the present (B, N, D)."""
        g = self.guard
        margin = jnp.full_like(memory["margin"], g.options.margin)  # known to the compiler unless it moves
        if g.options.adapt:
            judged = g.danger.now(memory["before"], present) < 0
            judged = judged if g.world.alone else judged.any(-2)
            wide = lambda x: x.reshape(-1, *[1] * (judged.ndim - 2), x.shape[-1])  # noqa: E731
            cost = wide(memory["cost"][:, None])
            blamed = (cost > 0) & (judged | ~judged.any(-1, keepdims=True))
            unsafe = jnp.where(jnp.isnan(cost), judged, blamed)
            if "costs" in memory:
                unsafe = jnp.where(jnp.isnan(costs := wide(memory["costs"])), unsafe, costs > 0)
            margin = jnp.where(memory["age"] == 0, margin, g.adapted(memory["margin"], unsafe))
        found = g.decide(present, actions, memory["last"], margin, key)
        info = {
            "plans": found.rows,
            "chosen": found.chosen,
            "clearance": found.safety.min(-1),
            "infeasible": found.short.any(-1),
            "strange": found.strange.any(-1),
        }
        spec = g.world.spec
        action = normalise.from_unit(found.plan[:, 0], spec.action_low, spec.action_high)
        memory = {
            **memory,
            "margin": margin,
            "last": found.plan,
            "before": present,
            **{k: jnp.full_like(memory[k], jnp.nan) for k in ("cost", "costs") if k in memory},
            "age": memory["age"] + 1,
        }
        return memory, PolicyStep(action, info)

    def proposed(self, inner: PyTree, observations: Array, state: Array | None, key: Key):
        """(memory, actions (B, P, K, N, A) in [−1, 1], info) of the proposal."""
        g = self.guard
        if hasattr(self.proposal, "propose"):
            return self.proposal.propose(inner, observations, state, key, g.options.plans, g.options.rows, g.world)
        spec = g.world.spec
        memory, step = self.proposal.act(inner, observations, state, key)
        action = normalise.to_unit(step.action, spec.action_low, spec.action_high)
        return memory, held(action, g.options.rows), {}


def costs_of_one(cost: Paid) -> np.ndarray | dict[str, np.ndarray]:
    """What one environment's step cost, as `hear` takes it."""
    one = lambda c: np.full(1, c, np.float32)  # noqa: E731
    return {k: one(c) for k, c in cost.items()} if isinstance(cost, Mapping) else one(cost)


def _of_team(cost: Array) -> Array:
    """(B,) the largest of agents' costs (B, N), or those of the team."""
    cost = jnp.asarray(cost, jnp.float32)
    return cost if cost.ndim == 1 else cost.max(-1)


def options_of(name: str, danger: str, usual: Mapping[str, dict] = MappingProxyType({}), **changes) -> dict:
    """Fields of GuardOptions that a named guard has, where `usual` holds what a task's simulator asks for by name. The
    margin, unless another is asked for, is a calibrated one of what is learned; of a formula less than its safe margin,
    which is what examples of safety have."""
    margin = {"margin": 1.0} if danger == "learned" else {}
    return {**GUARDS[name], **margin, **usual.get(name, {}), **changes}


def far_sighted(world: World) -> dict[str, dict]:
    """What guards are asked for, by name, where the rows that they foresee avoid little of the danger that could have
    been avoided, says the World's card (braking takes longer), and the value of danger leaves nearly all safe steps
    their margin (of logs that are mostly unsafe it calls everything lost): to judge the last row by it, too."""
    told = world.card.told.get("barrier", {})
    if told.get("ahead_kept", 0.0) < KEPT or "avoidable" not in told:
        return {}
    shares = told["avoidable"]
    seen = [share for rows, share in zip(shares["before"], shares["avoided"]) if rows <= GuardOptions().rows]
    far = max(seen, default=0.0) < LITTLE * max(shares["avoided"])
    return {name: {"future": True} for name in ("shield", "adapt", "full")} if far else {}


def build(
    proposal: Any,
    world: World,
    hazard: constraints.Hazard | None,
    name: str,
    danger: str,
    usual: Mapping[str, dict] | None = None,
    **changes,
) -> Guarded:
    """A policy under the named guard with changed options; `usual` as in `options_of`, by default what the World's card
    asks for."""
    from ringfence.utils.config import build_config

    if name not in GUARDS:
        raise unknown("guard", name, GUARDS)
    if usual is None:
        usual = far_sighted(world) if danger == "learned" and not {"rows", "future"} & set(changes) else {}
    options = build_config(GuardOptions, options_of(name, danger, usual, **changes), "the guard")
    if not options.judges:
        raise UserError(
            f"guard='{name}' does nothing; name one that does: {', '.join(g for g in GUARDS if g != name)}."
        )
    bound = None if hazard is None else constraints.bind_or_none(hazard, world.spec.feature_names, world.spec.n_agents)
    return Guarded(proposal, Guard(Danger(world, danger, bound, options.future), options))
