"""Guidance inside sampling: what is drawn is moved to where its actions are worth more to a World.

    J(a) = v (Σ_k γ^k r̂ + γ^K V̂(ŝ_K)) + d Σ_k Σ_i min(min(ℓ_i, V_i)(ŝ_k+1) − 1, 0)      ŝ_k+1 = f_φ(ŝ_k, a_k)

v weighs what is earned, in deviations of the logs' returns, and d what steps lack of the calibrated margin. A plan's
own rows may be anywhere, so it is where its actions lead that is asked. V is left out where it leaves less than half of
the logs' safe steps their margin: it knows no way to stay safe there. Then nothing holds back values beyond K rows, and
by themselves they are not climbed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.errors import UserError
from ringfence.problem.constraints import lowest
from ringfence.proposals.base import in_bounds_of
from ringfence.types import Array, Spec
from ringfence.world import World
from ringfence.world.barrier import Barrier, MinBarrier
from ringfence.world.dynamics import Dynamics

VALUES = 1.0  # v, of a method that follows a World by itself
DANGER = 10.0  # d; guards weigh it so, too
MARGIN = 1.0  # that guidance asks of danger, in units of the calibrated one, as guards do
AHEAD_KEPT = 0.5  # share of safe steps that V has to leave their margin
ROWS = 5  # K, that are foreseen along a plan
FAR = 0.5  # that the action of the steepest slope moves in a round, where nobody knows how much can be earned
LEAST_SLOPE = 1e-6  # of a slope's square: what hardly depends on x is not chased far


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


def knows_ahead(world: World) -> bool:
    """Whether V leaves enough of the logs' safe steps their margin; else it knows no way to stay safe there."""
    scores = world.card.barrier
    return scores is None or scores.ahead_kept >= AHEAD_KEPT


class Way(NamedTuple):
    """How actions are read off what is drawn, x (B, ...)."""

    rows_of: Callable[[Array], Array]  # x -> (B, K, ...)
    act: Callable[[Array, Array], Array]  # what it is read from, and a row (B, ...) -> actions (B, N, A) in [−1, 1]
    start: Array  # (B, ...) what the first action is read from
    foreseen: bool  # later ones are read from what the World predicts, as it sees it; else from the rows themselves


class Guide(eqx.Module):
    """A World that says what actions are worth, to those who draw them."""

    world: World
    values: float = eqx.field(static=True)  # v
    danger: float = eqx.field(static=True)  # d

    def worth(self, present: Array, way: Way, rows: Array, more: Array) -> tuple[Array, tuple[Array, Array]]:
        """((B,) J from the World's view of the present (B, N, D), (actions (B, K, N, A), what these are read from)).
        What `more` (B, K, N, A) adds to actions, those after them do not make up for."""
        world, ahead = self.world, knows_ahead(self.world)

        def step(now: tuple[Array, Array], row_more: tuple[Array, Array]):
            (x, seen), (row, more) = now, row_more
            seen = jax.lax.stop_gradient(seen)
            action = way.act(seen, row) + more
            predicted = world.dynamics.step(x, action)
            short = jnp.zeros(len(x))
            if self.danger:
                assert world.barrier is not None, "checked by guided"
                short = _short(world.barrier, world.ood_threshold, x, predicted, ahead)
            after = predicted[0]
            return (after, after if way.foreseen else row), (action, seen, after, short)

        each = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), (rows, more))
        _, (*told, short) = jax.lax.scan(step, (present, way.start), each)
        actions, seen, after = (jnp.moveaxis(x, 0, 1) for x in told)
        found = self.danger * short.sum(0)
        if self.values:
            states = jnp.concatenate([present[:, None], after], 1)
            found = found + self.values * world.values.of_plan(states, actions) / world.values.value_std
        return found, (actions, seen)

    def moved(self, present: Array, way: Way, x: Array, rounds: int) -> Array:
        """x (B, ...) after `rounds` that move the actions which are read off it up the slope of what they are worth."""

        def step(x: Array, _: None) -> tuple[Array, None]:
            rows, of_x = jax.vjp(way.rows_of, x)
            team = jax.eval_shape(way.act, way.start, rows[:, 0]).shape[1:]
            nothing = jnp.zeros((*rows.shape[:2], *team))
            found, uphill, (actions, seen) = jax.vjp(partial(self.worth, present, way, rows), nothing, has_aux=True)
            move = climb(actions, found, uphill(jnp.ones_like(found))[0], FAR if self.values else None)
            of_rows = jax.vjp(lambda rows: jax.vmap(way.act, 1, 1)(seen, rows), rows)[1]
            slope = of_x(of_rows(move)[0])[0]
            return x + _beside((move**2).sum((1, 2, 3)) / _square(slope), slope) * slope, None

        return jax.lax.scan(step, x, length=rounds)[0]


def climb(actions: Array, worth: Array, up: Array, far: float | None) -> Array:
    """How actions (B, K, N, A), which are worth (B,), move up its slope (B, K, N, A), none past its bounds: that of the
    steepest by `far`, others by less. Without it nothing is worth more than 0, and they go as far as would make it 0
    (Polyak's step)."""
    if far is None:
        length = -worth / _square(up)
    else:
        length = far / jnp.sqrt(jnp.maximum((up**2).sum(-1).max((1, 2)), LEAST_SLOPE**2))
    return jnp.clip(actions + _beside(length, up) * up, -1.0, 1.0) - actions


def _square(x: Array) -> Array:
    """(B,) of x (B, ...)."""
    return jnp.maximum((x**2).sum(tuple(range(1, x.ndim))), LEAST_SLOPE)


def _beside(each: Array, x: Array) -> Array:
    """What each of x (B, ...) is multiplied by, of (B,)."""
    return each.reshape(-1, *[1] * (x.ndim - 1))


@runtime_checkable
class TakesGuidance(Protocol):
    """A policy that draws plans or actions, and can be guided while it does."""

    spec: Spec
    guide: Guide | None


P = TypeVar("P", bound=TakesGuidance)


def guided(policy: P, world: World, values: float = VALUES, danger: float = DANGER) -> P:
    """The policy, its sampling guided by what this World foresees, which weighs values and danger so."""
    if world.barrier is None and danger:
        raise UserError("barrier_guidance needs a World that knows danger; fit one on logs with costs.")
    about: dict[str, Any] = {"guide": Guide(in_bounds_of(policy.spec, world), values, danger)}
    return dataclasses.replace(policy, **about)  # type: ignore[type-var]


def guided_by(policy: Any) -> dict[str, float]:
    """What guides a policy's sampling, as results say it: the weights of values and of danger."""
    guide = policy.guide if isinstance(policy, TakesGuidance) else None
    weights = (0.0, 0.0) if guide is None else (guide.values, guide.danger)
    return dict(zip(("guided_by_values", "guided_by_danger"), weights))
