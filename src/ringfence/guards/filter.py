"""What a guard does with proposals, each on its own switch and in this order: refine, select, shield; and adapt.

    refine   climb the value of every proposal's actions through the World's dynamics, away from danger
    select   the best of the safe ones, or the safest
    shield   correct the actions until danger keeps its distance along the foreseen rows
    adapt    move the margin by what happens: up after a cost, down while there is none

The shield asks the paper's condition (3) of foreseen rows, h(ŝ_{k+1}) ≥ (1 − α) h(ŝ_k), or a margin; its correction is
the supremum over actions. Where no action meets it, the least bad one found is taken, and counted.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.guards.danger import Danger
from ringfence.guards.options import GuardOptions
from ringfence.problem.constraints import lowest
from ringfence.types import Array, Key
from ringfence.world import World
from ringfence.world.dynamics import Dynamics

MAX_MARGIN = 3.0  # of an adapting margin
RATE = 0.1  # Adam's, of refined actions
TOGETHER = 32  # teams whose plans are corrected at once


class Decision(NamedTuple):
    """What a guard made of proposals."""

    plan: Array  # (B, K, N, A) actions
    chosen: Array  # (B,) index of the proposal, or (B, N) of agents that are alone
    rows: Array  # (B, P, K+1, N, D) where the proposals lead
    safety: Array  # (B, N) least score along the plan, of any constraint
    short: Array  # (B, N) bool: the condition is not met along it
    strange: Array  # (B, N) bool: the World does not know where the first action leads


class Guard(eqx.Module):
    """The four operations on proposals (B, P, K, N, A), actions in [−1, 1]. Where the World is `alone`, every agent
    judges and corrects its own actions by its own view of things, and hears of nobody."""

    danger: Danger
    options: GuardOptions = eqx.field(static=True)

    @property
    def world(self) -> World:
        return self.danger.world

    def decide(self, present: Array, proposals: Array, last: Array, margin: Array, key: Key) -> Decision:
        """From the present (B, N, D), proposals, the last plan (B, K, N, A) and margins to a plan. Margins are
        (B, C), of each constraint, or (B, N, C) of agents who are alone."""
        o = self.options
        proposals = self.world.spec.own(proposals)
        if o.refine:
            proposals = self.refined(present, *self.started(proposals, last, key), margin)
        rows, spread = self.foreseen(present, proposals)
        chosen = self.selected(rows, proposals, self.clear(rows, spread, margin))
        if self.world.alone:
            plan = jnp.take_along_axis(proposals, chosen[:, None, None, :, None], 1)[:, 0]
        else:
            plan = jnp.take_along_axis(proposals, chosen[:, None, None, None, None], 1)[:, 0]
        if o.shield:
            plan = self.shielded(present, plan, margin)
        ahead, spread = self.foreseen(present, plan[:, None])
        short = (self.missing(present, self.clear(ahead, spread, margin)[:, 0], margin) < -1e-3).any(1)
        unknown = spread[:, 0, 0] > self.world.strange
        return Decision(plan, chosen, rows, self.danger.along(ahead, spread)[:, 0].min((1, 3)), short, unknown)

    def foreseen(self, present: Array, actions: Array, dynamics: Dynamics | None = None) -> tuple[Array, Array]:
        """Rows (B, P, K+1, N, D), the present first, and disagreement (B, P, K, N) along actions (B, P, K, N, A)."""
        x = jnp.broadcast_to(present[:, None], (*actions.shape[:2], *present.shape[1:]))

        def step(x: Array, action: Array):
            after, spread = (dynamics or self.world.dynamics).step(x, action)
            return after, (after, spread)

        _, (rows, spread) = jax.lax.scan(step, x, jnp.moveaxis(actions, 2, 0), unroll=True)
        rows = jnp.concatenate([x[:, :, None], jnp.moveaxis(rows, 0, 2)], 2)
        return rows, jnp.moveaxis(spread, 0, 2)

    def imagined(self, present: Array, actions: Array) -> tuple[Array, Array]:
        """`foreseen`, each start by one member of the ensemble, in turn (TS∞, Chua et al. 2018): a third of the work.
        All of them judge what comes of it."""
        dynamics, starts = self.world.dynamics, actions.shape[1]
        nets = dynamics.members(jnp.arange(starts)[:, None] % dynamics.size)

        def by(nets, actions: Array) -> tuple[Array, Array]:
            rows, spread = self.foreseen(present, actions[:, None], dynamics.by_members(nets))
            return rows[:, 0], spread[:, 0]

        return jax.vmap(by, (0, 1), 1)(nets, actions)

    def clear(self, rows: Array, spread: Array, margin: Array) -> Array:
        """(B, P, K, N) by how much the scores of foreseen rows pass the margins; of several constraints the worst."""
        return lowest(self.danger.along(rows, spread) - _over(margin, 2))

    def missing(self, present: Array, clear: Array, margin: Array) -> Array:
        """(B, K, N) how much foreseen rows, clear of the margins by so much (B, K, N), fall short of the condition: 0
        or negative."""
        o = self.options
        if o.condition == "margin":
            return jnp.minimum(clear, 0.0)
        now = lowest(self.danger.now(present, present) - _over(margin, 0))[:, None]
        before = jnp.concatenate([now, clear[:, :-1]], 1)
        return jnp.minimum(clear - (1.0 - o.alpha) * before, 0.0)

    def started(self, proposals: Array, last: Array, key: Key) -> tuple[Array, Array, Array]:
        """(B, S, K, N, A) thrice: what is refined (the proposals, the last plan moved on by a step, and noisy copies of
        these), and the bounds of each, `reach` around the proposal that it belongs to."""
        o, many = self.options, proposals.shape[1]
        count = max(o.starts, many)
        moved = jnp.concatenate([last[:, 1:], last[:, -1:]], 1)[:, None]
        known = jnp.concatenate([proposals, moved], 1)[:, :count]
        again = jnp.arange(count) % known.shape[1]
        starts = known[:, again]
        noise = o.noise * jax.random.normal(key, starts[:, known.shape[1] :].shape)
        starts = starts.at[:, known.shape[1] :].add(noise)
        around = proposals[:, jnp.where(again < many, again, 0)]
        low, high = jnp.maximum(around - o.reach, -1.0), jnp.minimum(around + o.reach, 1.0)
        low, high = self.world.spec.own(low), self.world.spec.own(high)
        return jnp.clip(starts, low, high), low, high

    def refined(self, present: Array, actions: Array, low: Array, high: Array, margin: Array) -> Array:
        """Actions (B, S, K, N, A) after Adam's ascent of value within bounds, in deviations of the logs', less `care`
        for every margin that is missing."""

        def worth(actions: Array) -> Array:
            rows, spread = self.imagined(present, actions)
            value = self.world.values.of_plan(rows, actions) / self.world.values.usual
            short = jnp.minimum(self.clear(rows, spread, margin), 0.0).sum((2, 3))
            return value.sum() + self.options.care * short.sum()

        def climb(carry, t):
            a, m, s = carry
            g = jax.grad(worth)(a)
            m, s = 0.9 * m + 0.1 * g, 0.99 * s + 0.01 * g * g
            move = (m / (1 - 0.9 ** (t + 1))) / (jnp.sqrt(s / (1 - 0.99 ** (t + 1))) + 1e-6)
            return (jnp.clip(a + RATE * move, low, high), m, s), None

        zero = jnp.zeros_like(actions)
        rounds = jnp.arange(self.options.refine, dtype=jnp.float32)
        return jax.lax.scan(climb, (actions, zero, zero), rounds)[0][0]

    def selected(self, rows: Array, actions: Array, clear: Array) -> Array:
        """(B,) which proposal: the one of most value among those that keep the margin; where there is none, the safest.
        (B, N) where every agent chooses for itself. `clear` (B, P, K, N)."""
        if actions.shape[1] == 1 or not (self.options.select or self.options.refine):
            shape = actions.shape[:1] + ((actions.shape[3],) if self.world.alone else ())
            return jnp.zeros(shape, jnp.int32)
        value, clear = self.world.values.of_plan(rows, actions), clear.min(2)
        return pick(clear if self.world.alone else clear.min(-1), value, 0.0)

    def shielded(self, present: Array, plan: Array, margin: Array) -> Array:
        """Plans (B, K, N, A) corrected until the condition holds along the foreseen rows, and the best found otherwise.

        Polyak's steps on f(a) = Σ min(score − what is asked, 0), whose goal is 0: a ← a − f ∇f / ‖∇f‖², within `bound`
        of the plan: where the condition cannot be met, pushing with all there is throws robots over. Where nothing is
        missing the plan is kept as it is. Most plans are of that kind, so those of many teams are sorted, and corrected
        a few teams at a time as long as there is something to correct.
        """
        batch = plan.shape[0]
        if batch <= TOGETHER:
            return self._corrected(present, plan, margin)
        padded = -batch % TOGETHER
        order = jnp.argsort((self._shortfall(present, plan, margin) < 0).any(1), descending=True)
        order = jnp.concatenate([order, jnp.repeat(order[-1:], padded)])
        given = [x[order].reshape(-1, TOGETHER, *x.shape[1:]) for x in (present, plan, margin)]

        def some(given) -> Array:
            short = (self._shortfall(*given) < 0).any()
            return jax.lax.cond(short, lambda: self._corrected(*given), lambda: given[1])

        done = jax.lax.map(some, tuple(given)).reshape(-1, *plan.shape[1:])
        return plan.at[order].set(done)

    def _shortfall(self, present: Array, plan: Array, margin: Array) -> Array:
        """(B, 1) of a team, or (B, N) of agents who are alone: what is missing along plans (B, K, N, A), in all."""
        rows, spread = self.foreseen(present, plan[:, None])
        short = self.missing(present, self.clear(rows, spread, margin)[:, 0], margin)
        return short.sum(1) if self.world.alone else short.sum((1, 2))[:, None]

    def _corrected(self, present: Array, plan: Array, margin: Array) -> Array:
        """`shielded`, of all teams at once."""
        alone, bound = self.world.alone, self.options.bound
        low, high = map(self.world.spec.own, (jnp.maximum(plan - bound, -1.0), jnp.minimum(plan + bound, 1.0)))

        def shortfall(plan: Array) -> Array:
            return self._shortfall(present, plan, margin)

        def correct(carry):
            plan, best, least, _, round = carry
            f, back = jax.vjp(shortfall, plan)
            slope = back(jnp.ones_like(f))[0]
            better = (f > least)[:, None, :, None]
            best, least = jnp.where(better, plan, best), jnp.maximum(f, least)
            size = (slope**2).sum((1, 3)) if alone else (slope**2).sum((1, 2, 3))[:, None]
            moved = plan - (f / jnp.maximum(size, 1e-6))[:, None, :, None] * slope
            return jnp.clip(moved, low, high), best, least, f, round + 1

        def goes_on(carry):  # until the round after the last in which something was missing
            return (carry[4] < self.options.shield) & (carry[3] < 0).any()

        nothing = jnp.full((plan.shape[0], plan.shape[2] if alone else 1), -jnp.inf)
        plan, best, least, *_ = jax.lax.while_loop(goes_on, correct, (plan, plan, nothing, nothing, 0))
        return jnp.where((shortfall(plan) >= least)[:, None, :, None], plan, best)

    def adapted(self, margin: Array, unsafe: Array) -> Array:
        """Margins (..., C) after a step: m ← m + η (1[unsafe] − rate), between 0 and MAX_MARGIN. A named constraint has
        the rate of half its limit.

        Adaptive conformal inference (Gibbs and Candès 2021) on the guard's own foresight: whatever its errors, the
        share of unsafe steps tends to `rate` as long as a margin within the bounds can prevent them.
        """
        o, limits = self.options, self.danger.limits
        rate = jnp.array([0.5 * v / self.world.spec.episode_length for v in limits.values()]) if limits else o.rate
        return jnp.clip(margin + o.adapt * (unsafe - rate), 0.0, max(MAX_MARGIN, o.margin))


def _over(margin: Array, axes: int) -> Array:
    """Margins (B, C) or (B, N, C) with that many axes after the first, and those of agents and constraints last."""
    agents = 1 if margin.ndim == 2 else margin.shape[1]
    return margin.reshape(margin.shape[0], *[1] * axes, agents, margin.shape[-1])


def pick(safety: Array, value: Array, margin: Array | float) -> Array:
    """argmax of value among plans (axis 1) with safety ≥ margin; where there is none, argmax of safety."""
    fine = safety >= margin
    best = jnp.where(fine, value, -jnp.inf).argmax(1)
    return jnp.where(fine.any(1), best, safety.argmax(1))
