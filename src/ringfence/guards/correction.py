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


class Found(NamedTuple):
    """Plans, and what is missing along them: whoever improves plans hands on what it knows of them."""

    plan: Array  # (B, K, N, A)
    missing: Array  # (B, K, N), 0 or less


class Correction(NamedTuple):
    """Plans while they are corrected."""

    plan: Array  # (B, K, N, A)
    best: Found  # of those so far
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

    def __call__(self, present: PyTree, plan: Array, missed: Array, margin: Array) -> Array:
        """Where nothing is missing a plan is kept as it is. `missed` (B, K, N) along it."""
        asked = begun = Found(plan, _weighed(missed))
        if plan.shape[1] > ASKED and self.steps:
            begun = self._where_short(self._continued, AGAIN, 0.0, (present, plan, asked, margin))
        found = self._where_short(self._by_slope, TOGETHER, 0.0, (present, plan, begun, margin))
        if self.restarts:
            found = self._where_short(self._again, AGAIN, TOLERANCE, (present, plan, found, margin))
        return found.plan

    def _where_short(
        self, improve: Callable[..., Found], together: int, bearable: float, given: tuple[PyTree, Array, Found, Array]
    ) -> Found:
        """`improve` of (present, plans asked, plans found, margin), a few teams at a time. Most plans miss nothing, so
        they are sorted, and it ends with the last that does."""
        _, _, found, _ = given

        def few(part: tuple[PyTree, Array, Found, Array]) -> Found:
            return jax.lax.cond(self._is_short(part[2], bearable).any(), lambda: improve(*part), lambda: part[2])

        batch = len(found.plan)
        if batch <= together:
            return few(given)
        order = jnp.argsort(self._is_short(found, bearable), descending=True)
        order = jnp.concatenate([order, jnp.repeat(order[-1:], -batch % together)])
        parts = jax.tree.map(lambda x: x[order].reshape(-1, together, *x.shape[1:]), given)
        improved = jax.lax.map(few, parts)
        return jax.tree.map(lambda old, new: old.at[order].set(new.reshape(-1, *old.shape[1:])), found, improved)

    def _is_short(self, found: Found, bearable: float) -> Array:
        """(B,) bool: more than is bearable is missing of the plans found."""
        return (self._shortfall(found.missing) < -bearable).any(1)

    def missing(self, present: PyTree, plans: Array, margin: Array) -> Array:
        """(B, S, K, N) what is missing along plans (B, S, K, N, A), as it is weighed."""
        return _weighed(self.missed(present, plans, margin))

    def _shortfall(self, missing: Array) -> Array:
        """(B, 1) of a team, or (B, N) of agents who are alone: what is `missing` (B, K, N), in all."""
        return team_sum(missing, (1,), self.alone)

    def _continued(self, present: PyTree, asked: Array, found: Found, margin: Array) -> Found:
        """Plans that go on after ASKED rows as they did, or by the fixed plans that miss least: all of a team by the
        same start, or each agent by its own best, whatever the others did by it."""
        plan = found.plan
        _, rows, agents, dim = plan.shape
        tails = jnp.asarray(continuations(rows - ASKED, agents, dim), plan.dtype)  # (S, K - ASKED, N, A)
        begun = jnp.broadcast_to(plan[:, None, :ASKED], (len(plan), len(tails), ASKED, agents, dim))
        other = jnp.concatenate([begun, jnp.broadcast_to(tails, (len(plan), *tails.shape))], 2)
        other = self._of_unmet(present, other, asked, found, 0.0)
        missing = jnp.concatenate([found.missing[:, None], self.missing(present, other, margin)], 1)
        other = jnp.concatenate([plan[:, None], other], 1)
        if not self.alone:
            own = _picked(other, missing.sum(2).argmax(1))[:, None]
            other = jnp.concatenate([other, own], 1)
            missing = jnp.concatenate([missing, self.missing(present, own, margin)], 1)
        best = self._of_team(missing, (1,)).argmax(1)
        return Found(_picked(other, best), _picked(missing[..., None], best)[..., 0])

    def _of_unmet(self, present: PyTree, plans: Array, asked: Array, found: Found, bearable: float) -> Array:
        """Plans (B or 1, S, K, N, A) within bounds of what was asked for; agents of whose plans found no more than is
        bearable is missing keep these."""
        low, high = self.within(present, asked)
        unmet = found.missing.sum(1) < -bearable
        kept = found.plan[:, None]
        return jnp.where(unmet[:, None, None, :, None], jnp.clip(plans, low[:, None], high[:, None]), kept)

    def _of_team(self, x: Array, axes: tuple[int, ...]) -> Array:
        """(B, S, 1) of numbers (B, S, ...) of plans, or (B, S, N) of agents who are alone."""
        return jax.vmap(lambda x: team_sum(x, axes, self.alone), 1, 1)(x)

    def _by_slope(self, present: PyTree, asked: Array, begun: Found, margin: Array) -> Found:
        """Polyak's steps on f(a) = Σ min(score − what is asked, 0), whose goal is 0: a ← a − f ∇f / ‖∇f‖². The best
        plan on the way, within bounds around the one that was asked for. Where the condition cannot be met, larger
        actions throw robots over."""
        low, high = self.within(present, asked)

        def shortfall(plan: Array) -> tuple[Array, Array]:
            missing = self.missing(present, plan[:, None], margin)[:, 0]
            return self._shortfall(missing), missing

        def correct(c: Correction) -> Correction:
            f, back, missing = jax.vjp(shortfall, c.plan, has_aux=True)
            slope = back(jnp.ones_like(f))[0]
            size = team_sum(slope**2, (1, 3), self.alone)
            moved = c.plan - (f / jnp.maximum(size, 1e-6))[:, None, :, None] * slope
            return Correction(
                plan=jnp.clip(moved, low, high),
                best=self._better(f > self._shortfall(c.best.missing), Found(c.plan, missing), c.best),
                short=f,
                round=c.round + 1,
            )

        def goes_on(c: Correction) -> Array:  # one round more than steps: it judges what the last one led to
            return (c.round <= self.steps) & (c.short < 0).any()

        start = Correction(begun.plan, begun, self._shortfall(begun.missing), jnp.asarray(0))
        return jax.lax.while_loop(goes_on, correct, start).best

    def _better(self, better: Array, new: Found, old: Found) -> Found:
        """The new plans where they are `better` (B, 1 or N), else the old ones."""
        missing = jnp.where(better[:, None], new.missing, old.missing)
        return Found(jnp.where(better[:, None, :, None], new.plan, old.plan), missing)

    def _again(self, present: PyTree, asked: Array, found: Found, margin: Array) -> Found:
        """Plans found, or better ones by corrections that begin elsewhere, in as many rounds as are allowed."""
        _, rows, agents, dim = asked.shape
        starts = jnp.asarray(fixed_plans(rows, agents, dim, self.restarts), asked.dtype)

        def goes_on(carry: tuple[Found, Array]) -> Array:
            found, round = carry
            return (round < self.restarts) & self._is_short(found, TOLERANCE).any()

        def again(carry: tuple[Found, Array]) -> tuple[Found, Array]:
            found, round = carry
            start = self._start(present, asked, found, starts[round], margin)
            other = self._by_slope(present, asked, start, margin)
            before = self._shortfall(found.missing)
            better = (before < -TOLERANCE) & (self._shortfall(other.missing) > before)
            return self._better(better, other, found), round + 1

        return jax.lax.while_loop(goes_on, again, (found, jnp.asarray(0)))[0]

    def _start(self, present: PyTree, asked: Array, found: Found, starts: Array, margin: Array) -> Found:
        """The one of starts (S, K, N, A) that misses least, and among equals the one whose first action is nearest to
        what was asked. Agents of whose plans found nothing is missing keep these."""
        starts = self._of_unmet(present, starts, asked, found, TOLERANCE)
        missing = self.missing(present, starts, margin)
        short = self._of_team(missing, (1,))
        far = self._of_team((starts[:, :, :1] - asked[:, None, :1]) ** 2, (1, 3))
        fine = short >= short.max(1, keepdims=True) - TOLERANCE
        best = jnp.where(fine, -far, -jnp.inf).argmax(1)
        return Found(_picked(starts, best), _picked(missing[..., None], best)[..., 0])


def _weighed(missed: Array) -> Array:
    """What is missing (..., K, N), more of it in the rows that were asked for: the next decisions may mend what is far
    ahead."""
    rows = missed.shape[-2]
    return missed if rows <= ASKED else missed * np.where(np.arange(rows) < ASKED, NEAR, 1.0)[:, None]


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
