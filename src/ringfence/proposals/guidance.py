"""Guidance inside sampling: what is drawn is moved to where a World's danger keeps its margin, and to where it earns.

    f(a) = Σ_i min(min(ℓ_i(s, ŝ'), V_i(ŝ')) − 1, 0) in calibrated margins,  ŝ' = f_φ(s, a)
    x ← x − w f ∇f / ‖∇f‖²      Polyak's step, of what the action a is read from

V is left out where it leaves less than half of the logs' safe steps their margin: it knows no way to stay safe there.
What a plan earns is asked of where its actions lead by the World's dynamics, and not of the plan, whose rows may be
anywhere: J(a) = Σ_k γ^k r̂ + γ^K V̂(ŝ_K) + 10 Σ_k f(a_k). Steps towards ∇J are as long as makes the actions move by what
is asked for.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp

from ringfence.errors import UserError
from ringfence.problem.constraints import lowest
from ringfence.proposals.base import in_bounds_of
from ringfence.types import Array, Spec
from ringfence.world import World
from ringfence.world.barrier import Barrier, MinBarrier
from ringfence.world.dynamics import Dynamics

WHOLE = 1.0  # share of a step by which a method that follows a barrier is guided by default
MARGIN = 1.0  # that guidance asks of danger, in units of the calibrated one, as guards do
AHEAD_KEPT = 0.5  # share of safe steps that V has to leave their margin
LEAST_SLOPE = 1e-6  # of a slope's square: what hardly depends on x is not chased far
AHEAD_ROWS = 5  # that are foreseen for what actions earn
DANGER = 10.0  # deviations of value that a missing margin weighs, as guards weigh it


def short_of_margin(
    dynamics: Dynamics,
    barrier: Barrier | MinBarrier,
    ood_threshold: Array,
    present: Array,
    action: Array,
    ahead: bool = True,
) -> Array:
    """(B,) what the states after actions (B, N, A) lack of the margin, in all agents: 0 or negative. `ahead`: V is
    asked, too."""
    return _short(barrier, ood_threshold, present, dynamics.step(present, action), ahead)


def _short(
    barrier: Barrier | MinBarrier, ood_threshold: Array, present: Array, step: tuple[Array, Array], ahead: bool
) -> Array:
    """The same of a predicted step, the states after it and how far the ensemble disagrees; as guards do, it trusts
    less where that is much."""
    after, spread = step
    score = barrier.apart(present, after)
    score = jnp.minimum(score, barrier.ahead_apart(after)) if ahead else score
    doubt = jnp.maximum(spread / ood_threshold - 1.0, 0.0)
    return jnp.minimum(lowest(score) - doubt - MARGIN, 0.0).sum(-1)


@runtime_checkable
class TakesGuidance(Protocol):
    """A policy that draws plans or actions, and can be guided by danger while it does."""

    spec: Spec
    world: World | None  # whose danger guides
    guidance: float  # by what share of a step
    ahead: bool  # and by V, too


P = TypeVar("P", bound=TakesGuidance)


def guided(policy: P, world: World, share: float) -> P:
    """The policy, its sampling guided by the danger that this World has learned, or (`share` of 0) its values alone."""
    if world.barrier is None and share:
        raise UserError("barrier_guidance needs a World that knows danger; fit one on logs with costs.")
    scores = world.card.barrier
    ahead = scores is None or scores.ahead_kept >= AHEAD_KEPT
    about: dict[str, Any] = {"world": in_bounds_of(policy.spec, world), "guidance": share, "ahead": ahead}
    return dataclasses.replace(policy, **about)  # type: ignore[type-var]


def lacking(policy: TakesGuidance, present: Array, action: Array) -> Array:
    """(B,) what the World that guides a policy says that actions (B, N, A) from its view of the present (B, N, D) lack
    of the margin: 0 or negative."""
    world = policy.world
    assert world is not None and world.barrier is not None, "checked by guided"
    return short_of_margin(world.dynamics, world.barrier, world.ood_threshold, present, action, policy.ahead)


def cleared(short_of: Callable[[Array], Array], x: Array, share: float, rounds: int = 1) -> Array:
    """x (B, ...) after `rounds` of `share` of Polyak's step to where `short_of` (B,), 0 or negative, is 0."""
    axes = tuple(range(1, x.ndim))
    for _ in range(rounds):
        short, back = jax.vjp(short_of, x)
        slope = back(jnp.ones_like(short))[0]
        size = jnp.maximum((slope**2).sum(axes), LEAST_SLOPE)
        x = x - share * (short / size).reshape(-1, *[1] * len(axes)) * slope
    return x


def worth(policy: TakesGuidance, present: Array, actions: Array) -> Array:
    """What the World that guides a policy says that actions (B, K, N, A) earn from its view of the present (B, N, D):
    deviations of the logs' returns, less DANGER for every margin that they lack; summed over B."""
    world = policy.world
    assert world is not None, "set by guided"

    def step(x: Array, action: Array) -> tuple[Array, tuple[Array, Array]]:
        predicted = world.dynamics.step(x, action)
        short = jnp.zeros(len(x))
        if world.barrier is not None:
            short = _short(world.barrier, world.ood_threshold, x, predicted, policy.ahead)
        return predicted[0], (predicted[0], short)

    _, (rows, short) = jax.lax.scan(step, present, jnp.moveaxis(actions, 1, 0))
    rows = jnp.concatenate([present[:, None], jnp.moveaxis(rows, 0, 1)], 1)
    return (world.values.of_plan(rows, actions) / world.values.value_std).sum() + DANGER * short.sum()


def climbed(
    actions_of: Callable[[Array], Array], worth_of: Callable[[Array], Array], x: Array, far: float, rounds: int
) -> Array:
    """x (B, ...) after `rounds` that move the actions (B, K, N, A) which are read from it up the slope of what they are
    worth: those of the steepest slope by `far`, others by less, none past its bounds."""
    axes = tuple(range(1, x.ndim))

    def moved(x: Array, _: None) -> tuple[Array, None]:
        actions, back = jax.vjp(actions_of, x)
        up = jax.grad(worth_of)(actions)
        steepest = jnp.sqrt((up**2).sum(-1, keepdims=True)).max((1, 2), keepdims=True)
        move = jnp.clip(actions + far * up / jnp.maximum(steepest, LEAST_SLOPE), -1.0, 1.0) - actions
        slope = back(move)[0]
        size = jnp.maximum((slope**2).sum(axes), LEAST_SLOPE)
        return x + ((move**2).sum((1, 2, 3)) / size).reshape(-1, *[1] * len(axes)) * slope, None

    return jax.lax.scan(moved, x, length=rounds)[0]
