"""A policy under guard: whatever proposes, a World and its guard decide."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence import hazards, normalise
from ringfence.each import Each, apart, look, together
from ringfence.errors import UserError, unknown
from ringfence.features import translation
from ringfence.guards.danger import Danger
from ringfence.guards.guard import GUARDS, Guard, GuardOptions
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


def held(action: Array, rows: int) -> Array:
    """(B, 1, K, N, A): one action (B, N, A), held."""
    return jnp.broadcast_to(action[:, None, None], (action.shape[0], 1, rows, *action.shape[1:]))


def rolled(act: Callable[[Array], Array], own, world: World, seen: Array, present: Array, rows: int) -> Array:
    """(B, 1, K, N, A): what a policy `act`, of features in its own view `own`, does now (`seen`) and along the rows
    that the World foresees from `present`; the first action held where the views cannot be translated."""
    index = translation(own, world.map)
    first = act(seen)
    if index is None or rows == 1:
        return held(first, rows)
    x, action, actions = present, first, [first]
    for _ in range(rows - 1):
        x, _ = world.dynamics.step(x, action)
        action = act(jnp.take_along_axis(x, jnp.broadcast_to(index, (*x.shape[:-1], index.shape[1])), -1))
        actions.append(action)
    return jnp.stack(actions, 1)[:, None]


class Callback:
    """Anybody's function (observations, state) -> actions under guard, as a policy (types.Policy) outside JAX: it is
    asked with the whole batch, NumPy in, NumPy out."""

    def __init__(self, function: Callable, guarded: Guarded, agents: int):
        self.function, self.guarded, self.agents = function, guarded, agents
        self._decide = jax.jit(lambda g, memory, present, action, key: g.decided(memory, present, action, key))

    @property
    def _team(self) -> Guarded | Each:
        """Who hears of costs: one guard, or that of each agent."""
        return Each(self.guarded, self.agents) if self.guarded.guard.world.spec.alike else self.guarded

    def start(self, batch: int) -> PyTree:
        return self._team.start(batch)

    def hear(self, memory: PyTree, cost) -> PyTree:
        return self._team.hear(memory, jax.tree.map(lambda c: jnp.asarray(c, jnp.float32), cost))

    def act(self, memory: PyTree, observations, state, key: Key) -> tuple[PyTree, PolicyStep]:
        wanted = self.function(np.asarray(observations), None if state is None else np.asarray(state))
        return self.decided(memory, observations, state, wanted, key)

    def decided(self, memory: PyTree, observations, state, wanted, key: Key) -> tuple[PyTree, PolicyStep]:
        """What becomes of the function's actions (B, N, A)."""
        world = self.guarded.guard.world
        spec, batch = world.spec, len(observations)
        try:
            wanted = np.asarray(wanted, np.float32)
        except (TypeError, ValueError):
            raise UserError("The policy under guard returned no array of numbers; return actions (N, A).") from None
        expected = (batch, self.agents, spec.action_dim)
        if wanted.shape != expected:
            raise UserError(
                f"The policy under guard returned actions of shape {wanted.shape[1:]}; this World takes {expected[1:]}."
            )
        if not np.isfinite(wanted).all():
            raise UserError("The policy under guard returned actions that are not finite; it has diverged.")
        action = jnp.clip(normalise.to_unit(jnp.asarray(wanted), spec.action_low, spec.action_high), -1.0, 1.0)
        given = jnp.asarray(observations), None if state is None else jnp.asarray(state)
        present = look(world.map, spec.alike, *given)
        plan = held(apart(action) if spec.alike else action, self.guarded.guard.options.rows)
        memory, step = self._decide(self.guarded, memory, present, plan, key)
        return memory, together(step, (batch, self.agents)) if spec.alike else step


class Pilot:
    """Anybody's function (observations, state) -> actions under guard at run time: one environment, NumPy in, NumPy
    out, as `Controller`.

    pilot.reset()                                  # at the start of every episode
    action = pilot.act(observations, state)        # (N, O), (S,) or None -> (N, A)

    `info` says of the last action what the guard knows of it. `policy` is what simulators of whole batches play.
    """

    def __init__(self, policy: Callback, seed: int = 0):
        self.policy = policy
        self._key = jax.random.key(seed)
        self.info: dict[str, np.ndarray] = {}
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._memory = self.policy.start(1)

    def act(self, observations: np.ndarray, state: np.ndarray | None = None, cost: Paid | None = None) -> np.ndarray:
        """(N, A) joint action; the function is asked with the same arrays. `cost` is what the last step cost, in all or
        by each constraint's name, which an adapting guard follows."""
        wanted = self.policy.function(observations, state)
        self._key, key = jax.random.split(self._key)
        if cost is not None:
            self._memory = self.policy.hear(self._memory, costs_of_one(cost))
        shown = np.asarray(observations)[None], None if state is None else np.asarray(state)[None]
        self._memory, step = self.policy.decided(self._memory, *shown, np.asarray(wanted)[None], key)
        self.info = {k: np.asarray(v[0]) for k, v in step.info.items()}
        return np.asarray(step.action[0])


class Nothing(eqx.Module):
    """Stands where a callback's proposals come from outside."""

    def start(self, batch: int) -> PyTree:
        return {}


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
    hazard: hazards.Hazard | None,
    name: str,
    danger: str,
    usual: Mapping[str, dict] | None = None,
    **changes,
) -> Guarded:
    """A policy under the named guard with changed options; `usual` as in `options_of`, by default what the World's card
    asks for."""
    from ringfence.runs import build_config

    if name not in GUARDS:
        raise unknown("guard", name, GUARDS)
    if usual is None:
        usual = far_sighted(world) if danger == "learned" and not {"rows", "future"} & set(changes) else {}
    options = build_config(GuardOptions, options_of(name, danger, usual, **changes), "the guard")
    if not options.judges:
        raise UserError(
            f"guard='{name}' does nothing; name one that does: {', '.join(g for g in GUARDS if g != name)}."
        )
    bound = None if hazard is None else hazards.bind_or_none(hazard, world.spec.feature_names, world.spec.n_agents)
    return Guarded(proposal, Guard(Danger(world, danger, bound, options.future), options))


def guard(
    policy: Any,
    world: World,
    *,
    guard: str = "shield",
    danger: str = "learned",
    hazard: hazards.Hazard | None = None,
    seed: int = 0,
    agents: int | None = None,
    **options,
):
    """Any policy under guard.

    policy: a policy of the library (with `start` and `act`), which gives a `Guarded`; or any callable (observations
    (N, O), state (S,) or None) -> actions (N, A) within the task's bounds, e.g. a PyTorch network or a controller,
    which gives a `Pilot`, for a team of `agents` where the World is of agents who are alike. `guard` is a name in
    GUARDS, `danger` formula, learned or both, `options` fields of GuardOptions; `hazard` is the formula's definition,
    where one is to be used.
    """
    if not isinstance(world, World):
        raise UserError(f"guard() got a {type(world).__name__} for a World; fit one with ringfence.fit(store).")
    if isinstance(policy, Each):
        return Each(build(policy.one, world, hazard, guard, danger, **options), policy.agents)
    if hasattr(policy, "start") and hasattr(policy, "act"):
        return build(policy, world, hazard, guard, danger, **options)
    if not callable(policy):
        raise UserError(
            f"guard() got a {type(policy).__name__}; give a callable (observations, state) -> actions, or a policy."
        )
    spec = world.spec
    if agents is None and spec.alike:
        raise UserError("The World is of agents who are alike; say with agents= how many of them there are.")
    if agents not in (None, spec.n_agents) and not spec.alike:
        raise UserError(f"The World is of {spec.n_agents} agents who are not alike; leave agents={agents} out.")
    guarded = build(Nothing(), world, hazard, guard, danger, **options)
    return Pilot(Callback(policy, guarded, agents or spec.n_agents), seed)
