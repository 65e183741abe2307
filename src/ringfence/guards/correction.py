"""How a shield finds actions that meet its condition: by what follows the actions that were asked for, by slope, and
where a slope leads nowhere from fixed plans.

A policy says what it does now. A guard that looks far ahead may not take that for what it does all the time: pushed for
long enough anything leaves every limit. So what was asked for is held for a few rows, and after these the plan may do
whatever is safe, as a predictive safety filter has it (Wabersich and Zeilinger 2021).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.problem.homogeneous import team_sum
from ringfence.types import Array, PyTree

TOGETHER = 32  # teams whose plans are corrected at once
AGAIN = 8  # teams for which a correction is begun again at once
DIRECTIONS = 26  # of fixed plans, where actions have more than three numbers
ASKED = 3  # rows for which a plan is what was asked for, before it may do something else
NEAR = 10.0  # times what is missing in these rows counts, beside later ones
TOLERANCE = 1e-3  # of the condition, in margins: less is not counted as infeasible


class Correction(NamedTuple):
    """Plans while they are corrected."""

    plan: Array  # (B, K, N, A)
    best: Array  # (B, K, N, A) of those so far
    least: Array  # (B, 1 or N) shortfall of the best
    short: Array  # (B, 1 or N) shortfall of the plan before the last correction
    round: Array  # () int


@dataclass(frozen=True)
class Corrector:
    """Plans (B, K, N, A) into plans that miss less of a condition, in the present (arrays) by margins (B, ...)."""

    # present, plans (B, S, K, N, A), margin -> (B, S, K, N), 0 or less
    missed: Callable[[PyTree, Array, Array], Array]
    # present, plans (B, K, N, A) that were asked for -> bounds of what may become of them
    within: Callable[[PyTree, Array], tuple[Array, Array]]
    alone: bool  # agents answer for themselves
    steps: int
    restarts: int

    def __call__(self, present: PyTree, plan: Array, margin: Array) -> Array:
        """Where nothing is missing a plan is kept as it is."""
        begun = plan
        if plan.shape[1] > ASKED and self.steps:
            begun = self._where_short(self._continued, AGAIN, 0.0, (present, plan, plan, margin))
        found = self._where_short(self._by_slope, TOGETHER, 0.0, (present, plan, begun, margin))
        if not self.restarts:
            return found
        return self._where_short(self._again, AGAIN, TOLERANCE, (present, plan, found, margin))

    def _where_short(
        self, improve: Callable[..., Array], together: int, bearable: float, given: tuple[PyTree, Array, Array, Array]
    ) -> Array:
        """`improve` of (present, plans asked, plans found, margin), a few teams at a time. Most plans miss nothing, so
        they are sorted, and it ends with the last that does."""
        _, _, found, _ = given
        batch = len(found)
        if batch <= together:
            return improve(*given)
        short = self._is_short(given, bearable)
        order = jnp.argsort(short, descending=True)
        order = jnp.concatenate([order, jnp.repeat(order[-1:], -batch % together)])
        parts = jax.tree.map(lambda x: x[order].reshape(-1, together, *x.shape[1:]), given)

        def few(part: tuple[PyTree, Array, Array, Array]) -> Array:
            return jax.lax.cond(self._is_short(part, bearable).any(), lambda: improve(*part), lambda: part[2])

        return found.at[order].set(jax.lax.map(few, parts).reshape(-1, *found.shape[1:]))

    def _is_short(self, given: tuple[PyTree, Array, Array, Array], bearable: float) -> Array:
        """(B,) bool: more than is bearable is missing of the plans found."""
        present, _, found, margin = given
        return (self.shortfall(present, found, margin) < -bearable).any(1)

    def missing(self, present: PyTree, plans: Array, margin: Array) -> Array:
        """(B, S, K, N) what is missing along plans (B, S, K, N, A), more of it in the rows that were asked for: the
        next decisions may mend what is far ahead."""
        rows = plans.shape[2]
        missed = self.missed(present, plans, margin)
        if rows <= ASKED:
            return missed
        return missed * np.where(np.arange(rows) < ASKED, NEAR, 1.0)[:, None]

    def shortfall(self, present: PyTree, plan: Array, margin: Array) -> Array:
        """(B, 1) of a team, or (B, N) of agents who are alone: what is missing along plans (B, K, N, A), in all."""
        return team_sum(self.missing(present, plan[:, None], margin)[:, 0], (1,), self.alone)

    def _continued(self, present: PyTree, asked: Array, plan: Array, margin: Array) -> Array:
        """Plans that go on after ASKED rows as they did, or by the fixed plans that miss least: all of a team by the
        same start, or each agent by its own best, whatever the others did by it."""
        _, rows, agents, dim = plan.shape
        tails = jnp.asarray(continuations(rows - ASKED, agents, dim), plan.dtype)  # (S, K - ASKED, N, A)
        begun = jnp.broadcast_to(plan[:, None, :ASKED], (len(plan), len(tails), ASKED, agents, dim))
        other = jnp.concatenate([begun, jnp.broadcast_to(tails, (len(plan), *tails.shape))], 2)
        missing = self.missing(present, plan[:, None], margin)[:, 0]
        other = jnp.concatenate([plan[:, None], self._of_unmet(present, other, asked, plan, missing, 0.0)], 1)
        missing = self.missing(present, other, margin)
        if not self.alone:
            own = _picked(other, missing.sum(2).argmax(1))[:, None]
            other = jnp.concatenate([other, own], 1)
            missing = jnp.concatenate([missing, self.missing(present, own, margin)], 1)
        return _picked(other, self._of_team(missing, (1,)).argmax(1))

    def _of_unmet(
        self, present: PyTree, plans: Array, asked: Array, kept: Array, missing: Array, bearable: float
    ) -> Array:
        """Plans (B or 1, S, K, N, A) within bounds of what was asked for; agents of whose plans `kept` (B, K, N, A) no
        more than is bearable is `missing` (B, K, N) keep these."""
        low, high = self.within(present, asked)
        unmet = missing.sum(1) < -bearable
        return jnp.where(unmet[:, None, None, :, None], jnp.clip(plans, low[:, None], high[:, None]), kept[:, None])

    def _of_team(self, x: Array, axes: tuple[int, ...]) -> Array:
        """(B, S, 1) of numbers (B, S, ...) of plans, or (B, S, N) of agents who are alone."""
        return jax.vmap(lambda x: team_sum(x, axes, self.alone), 1, 1)(x)

    def _by_slope(self, present: PyTree, asked: Array, plan: Array, margin: Array) -> Array:
        """Polyak's steps on f(a) = Σ min(score − what is asked, 0), whose goal is 0: a ← a − f ∇f / ‖∇f‖². The best
        plan on the way, within bounds around the one that was asked for. Where the condition cannot be met, larger
        actions throw robots over."""
        low, high = self.within(present, asked)

        def shortfall(plan: Array) -> Array:
            return self.shortfall(present, plan, margin)

        def correct(c: Correction) -> Correction:
            f, back = jax.vjp(shortfall, c.plan)
            slope = back(jnp.ones_like(f))[0]
            better = (f > c.least)[:, None, :, None]
            size = team_sum(slope**2, (1, 3), self.alone)
            moved = c.plan - (f / jnp.maximum(size, 1e-6))[:, None, :, None] * slope
            return Correction(
                plan=jnp.clip(moved, low, high),
                best=jnp.where(better, c.plan, c.best),
                least=jnp.maximum(f, c.least),
                short=f,
                round=c.round + 1,
            )

        def goes_on(c: Correction) -> Array:  # until the round after the last in which something was missing
            return (c.round < self.steps) & (c.short < 0).any()

        nothing = jnp.full_like(team_sum(plan, (1, 3), self.alone), -jnp.inf)
        begun = Correction(plan, plan, nothing, nothing, jnp.asarray(0))
        found = jax.lax.while_loop(goes_on, correct, begun)
        return jnp.where((shortfall(found.plan) >= found.least)[:, None, :, None], found.plan, found.best)

    def _again(self, present: PyTree, asked: Array, found: Array, margin: Array) -> Array:
        """Plans found, or better ones by corrections that begin elsewhere, in as many rounds as are allowed."""
        _, rows, agents, dim = found.shape
        starts = jnp.asarray(fixed_plans(rows, agents, dim, self.restarts), found.dtype)

        def goes_on(carry: tuple[Array, Array]) -> Array:
            found, round = carry
            return (round < self.restarts) & (self.shortfall(present, found, margin) < -TOLERANCE).any()

        def again(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            found, round = carry
            missing = self.missing(present, found[:, None], margin)[:, 0]
            start = self._start(present, asked, found, missing, starts[round], margin)
            other = self._by_slope(present, asked, start, margin)
            before = team_sum(missing, (1,), self.alone)
            better = (before < -TOLERANCE) & (self.shortfall(present, other, margin) > before)
            return jnp.where(better[:, None, :, None], other, found), round + 1

        return jax.lax.while_loop(goes_on, again, (found, jnp.asarray(0)))[0]

    def _start(
        self, present: PyTree, asked: Array, found: Array, missing: Array, starts: Array, margin: Array
    ) -> Array:
        """(B, K, N, A) the one of starts (S, K, N, A) that misses least, and among equals the one whose first action is
        nearest to what was asked. Agents of whose plans found nothing is `missing` (B, K, N) keep these."""
        starts = self._of_unmet(present, starts, asked, found, missing, TOLERANCE)
        short = self._of_team(self.missing(present, starts, margin), (1,))
        far = self._of_team((starts[:, :, :1] - asked[:, None, :1]) ** 2, (1, 3))
        fine = short >= short.max(1, keepdims=True) - TOLERANCE
        return _picked(starts, jnp.where(fine, -far, -jnp.inf).argmax(1))


def _picked(plans: Array, index: Array) -> Array:
    """(B, K, N, A) of plans (B, S, K, N, A), those at the index (B, 1) of a team or (B, N) of each agent."""
    return jnp.take_along_axis(plans, index[:, None, None, :, None], 1)[:, 0]


def fixed_plans(rows: int, agents: int, dim: int, rounds: int) -> np.ndarray:
    """(R, S, K, N, A) plans in [−1, 1] that a correction may begin from: nothing at all, or for one, some or all of the
    rows half or all of what an agent can do, into each direction, and nothing thereafter. Every agent goes through all
    of them, in an order of its own and of each round."""
    plans = [np.zeros((rows, dim))]
    for direction, first, size in itertools.product(directions(dim), sorted({1, (rows + 1) // 2, rows}), (0.5, 1.0)):
        active = np.arange(rows)[:, None] < first
        plans.append(size * direction * active)
    return _in_orders(plans, agents, rounds)


def continuations(rows: int, agents: int, dim: int) -> np.ndarray:
    """(S, K, N, A) what may follow the rows that were asked for: nothing by anybody, or all that an agent can do, into
    each direction, for half of the rows or for all of them, by every agent in an order of its own."""
    plans = []
    for direction, first in itertools.product(directions(dim), sorted({(rows + 1) // 2, rows})):
        plans.append(direction * (np.arange(rows)[:, None] < first))
    moved = _in_orders(plans, agents, 1)[0]
    return np.concatenate([np.zeros_like(moved[:1]), moved])


def _in_orders(plans: Sequence[np.ndarray], agents: int, rounds: int) -> np.ndarray:
    """(R, S, K, N, A) of plans (K, A): for every agent and round all of them, in an order of its own."""
    random = np.random.default_rng(0)
    orders = [[random.permutation(len(plans)) for _ in range(agents)] for _ in range(rounds)]
    return np.stack(plans)[np.array(orders)].transpose(0, 2, 3, 1, 4)


def directions(dim: int) -> np.ndarray:
    """(S, A) actions of full size, into each direction; some of them, where actions have more than three numbers."""
    if dim > 3:
        return np.random.default_rng(0).choice((-1.0, 0.0, 1.0), (DIRECTIONS, dim))
    return np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=dim) if any(d)])
