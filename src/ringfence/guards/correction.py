"""How a shield finds actions that meet its condition: by slope, and where a slope leads nowhere from fixed plans."""

from __future__ import annotations

import itertools
from collections.abc import Callable
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
    missing: Callable[[PyTree, Array, Array], Array]
    within: Callable[[Array], tuple[Array, Array]]  # bounds of what may become of plans
    alone: bool  # agents answer for themselves
    steps: int
    restarts: int

    def __call__(self, present: PyTree, plan: Array, margin: Array) -> Array:
        """Where nothing is missing a plan is kept as it is."""
        found = self._where_short(self._by_slope, TOGETHER, 0.0, (present, plan, plan, margin))
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

    def shortfall(self, present: PyTree, plan: Array, margin: Array) -> Array:
        """(B, 1) of a team, or (B, N) of agents who are alone: what is missing along plans (B, K, N, A), in all."""
        return team_sum(self.missing(present, plan[:, None], margin)[:, 0], (1,), self.alone)

    def _by_slope(self, present: PyTree, asked: Array, plan: Array, margin: Array) -> Array:
        """Polyak's steps on f(a) = Σ min(score − what is asked, 0), whose goal is 0: a ← a − f ∇f / ‖∇f‖². The best
        plan on the way, within bounds around the one that was asked for. Where the condition cannot be met, larger
        actions throw robots over."""
        low, high = self.within(asked)

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
        low, high = self.within(asked)
        starts = jnp.clip(starts, low[:, None], high[:, None])
        unmet = missing.sum(1) < -TOLERANCE
        starts = jnp.where(unmet[:, None, None, :, None], starts, found[:, None])

        def of_team(x: Array, axes: tuple[int, ...]) -> Array:  # (B, S, 1), or (B, S, N) of agents who are alone
            return jax.vmap(lambda x: team_sum(x, axes, self.alone), 1, 1)(x)

        short = of_team(self.missing(present, starts, margin), (1,))
        far = of_team((starts[:, :, :1] - asked[:, None, :1]) ** 2, (1, 3))
        fine = short >= short.max(1, keepdims=True) - TOLERANCE
        index = jnp.where(fine, -far, -jnp.inf).argmax(1)
        return jnp.take_along_axis(starts, index[:, None, None, :, None], 1)[:, 0]


def fixed_plans(rows: int, agents: int, dim: int, rounds: int) -> np.ndarray:
    """(R, S, K, N, A) plans in [−1, 1] that a correction may begin from: nothing at all, or for one, some or all of the
    rows half or all of what an agent can do, into each direction, and nothing thereafter. Every agent goes through all
    of them, in an order of its own and of each round."""
    plans = [np.zeros((rows, dim))]
    for direction, first, size in itertools.product(directions(dim), sorted({1, (rows + 1) // 2, rows}), (0.5, 1.0)):
        active = np.arange(rows)[:, None] < first
        plans.append(size * direction * active)
    random = np.random.default_rng(0)
    orders = [[random.permutation(len(plans)) for _ in range(agents)] for _ in range(rounds)]
    return np.stack(plans)[np.array(orders)].transpose(0, 2, 3, 1, 4)


def directions(dim: int) -> np.ndarray:
    """(S, A) actions of full size, into each direction; some of them, where actions have more than three numbers."""
    if dim > 3:
        return np.random.default_rng(0).choice((-1.0, 0.0, 1.0), (DIRECTIONS, dim))
    return np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=dim) if any(d)])
