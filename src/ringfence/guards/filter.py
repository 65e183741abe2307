"""What a guard does with proposals, each on its own switch and in this order: refine, select, shield; and adapt.

    refine   climb the value of every proposal's actions through the World's dynamics, away from danger
    select   the best of the safe ones, or the safest
    shield   correct the actions until danger keeps its distance along the predicted rows
    adapt    move the margin by what happens: up after a cost, down while there is none

The shield asks the paper's condition (3) of predicted rows, h(ŝ_{k+1}) ≥ (1 − α) h(ŝ_k), or a margin; its correction is
the supremum over actions. A slope may lead nowhere where a step aside would do, so a correction that falls short is
begun again from fixed plans. Where none meets the condition, the best one found is taken, and counted as infeasible.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from ringfence.guards.barrier import BarrierSource
from ringfence.guards.correction import TOLERANCE, Corrector
from ringfence.guards.options import GuardOptions
from ringfence.nets.layers import MLP
from ringfence.problem.constraints import lowest
from ringfence.problem.features import others_offsets
from ringfence.types import Array, Key
from ringfence.world import World
from ringfence.world.dynamics import Dynamics

NEAREST = 0.02  # share of a distance that is left of it, whatever others may have done
MAX_MARGIN = 3.0  # of an adapting margin
RATE = 0.1  # Adam's, of refined actions
WITHIN = 1.0  # score at the end of what the logs have shown


# The present (B, N, D), for how long others were not seen, and who is driven (B, N).
Given = tuple[Array, Array | None, Array | None]


class Decision(NamedTuple):
    """What a guard made of proposals."""

    plan: Array  # (B, K, N, A) actions
    chosen: Array  # (B,) index of the proposal, or (B, N) of agents that are alone
    rows: Array  # (B, P, K+1, N, D) where the proposals lead
    safety: Array  # (B, N) least score along the plan, of any constraint
    first: Array  # (B, N) score of its first row, as it is judged once it has come
    short: Array  # (B, N) bool: the condition is not met along it
    ood: Array  # (B, N) bool: the first action leads out of distribution


class Guard(eqx.Module):
    """The four operations on proposals (B, P, K, N, A), actions in [−1, 1]. Where the World is `alone`, every agent
    judges and corrects its own actions by its own view of things, and hears of nobody."""

    barrier: BarrierSource
    options: GuardOptions = eqx.field(static=True)

    @property
    def world(self) -> World:
        return self.barrier.world

    def decide(
        self,
        present: Array,
        proposals: Array,
        last: Array,
        margin: Array,
        key: Key,
        unseen: Array | None = None,
        driven: Array | None = None,
    ) -> Decision:
        """From the present (B, N, D), proposals, the last plan (B, K, N, A) and margins to a plan. Margins are
        (B, C), of each constraint, or (B, N, C) of agents who are alone. `unseen` (B, N) are the steps for which an
        agent has not seen others, or (B, N, J) each of them. `driven` (B, N) are agents who do what is decided; of the
        others what is proposed stays as it is."""
        proposals = self.held(self.world.spec.own(proposals))
        if self.options.optimizer_steps:
            proposals = self.held(self.refined(present, *self.started(proposals, last, key, driven), margin))
        rows, spreads = self.predict(present, proposals)
        clear = self.clear(rows, spreads, margin, unseen)
        chosen = self.selected(rows, proposals, clear)
        asked = self._picked(proposals, chosen)
        if self.world.alone and proposals.shape[1] > 1:  # what each agent chose for itself was not predicted together
            ahead, spread = self.predict(present, asked)
            clear = self.clear(ahead, spread, margin, unseen)
        else:
            ahead, spread, clear = (self._picked(x, chosen) for x in (rows, spreads, clear))
        plan = asked[:, 0]
        if self.options.correction_steps:
            plan = self.shielded(present, plan, self.missing(present, clear[:, 0], margin), margin, unseen, driven)
            # Most plans stay as they were asked for, and where these lead is known.
            changed = (plan != asked[:, 0]).any()
            known = ahead, spread
            ahead, spread = jax.lax.cond(changed, lambda: self.predict(present, plan[:, None]), lambda: known)
        seen = self.nearer(ahead, unseen)
        scores = self.barrier.along(seen, spread)[:, 0]
        missing = self.missing(present, self.clear(ahead, spread, margin, unseen)[:, 0], margin)
        return Decision(
            plan=plan,
            chosen=chosen,
            rows=rows,
            safety=scores.min((1, 3)),
            first=self.barrier.now(seen[:, 0, 0], seen[:, 0, 1]).min(-1),
            short=(missing < -TOLERANCE).any(1),
            ood=spread[:, 0, 0] > self.world.ood_threshold,
        )

    def predict(
        self, present: Array, actions: Array, dynamics: Dynamics | None = None, unroll: bool = False
    ) -> tuple[Array, Array]:
        """Rows (B, P, K+1, N, D), the present first, and disagreement (B, P, K, N) along actions (B, P, K, N, A).
        Unrolled, its slope is faster, and it takes longer to compile."""
        model = dynamics or self.world.dynamics
        x = jnp.broadcast_to(present[:, None], (*actions.shape[:2], *present.shape[1:]))

        def step(x: Array, action: Array) -> tuple[Array, tuple[Array, Array]]:
            after, spread = model.step(x, action)
            return after, (after, spread)

        _, (rows, spread) = jax.lax.scan(step, x, jnp.moveaxis(actions, 2, 0), unroll=unroll)
        rows = jnp.concatenate([x[:, :, None], jnp.moveaxis(rows, 0, 2)], 2)
        return rows, jnp.moveaxis(spread, 0, 2)

    def imagined(self, present: Array, actions: Array) -> tuple[Array, Array]:
        """`predict`, each start by one member of the ensemble, in turn (TS∞, Chua et al. 2018): a third of the work.
        All of them judge what comes of it."""
        dynamics = self.world.dynamics
        nets = dynamics.members(jnp.arange(actions.shape[1])[:, None] % dynamics.size)

        def of_start(nets: tuple[MLP, MLP | None], actions: Array) -> tuple[Array, Array]:
            rows, spread = self.predict(present, actions[:, None], dynamics.by_members(nets), unroll=True)
            return rows[:, 0], spread[:, 0]

        return jax.vmap(of_start, (0, 1), 1)(nets, actions)

    def held(self, plans: Array) -> Array:
        """Plans (..., K, N, A) as they are done where every action is held for `hold` steps."""
        if self.options.hold == 1:
            return plans
        index = np.arange(plans.shape[-3])
        return plans[..., index - index % self.options.hold, :, :]

    def nearer(self, rows: Array, unseen: Array | None) -> Array:
        """Predicted rows (B, P, K+1, N, D) with others moved towards each agent, by what they may have come nearer
        since they were seen: in τ steps and k further ones by ½ a (τ² + 2 k τ). What they do in these k steps after
        they were seen is a matter of the margin, late or not."""
        if unseen is None or not self.options.others_acceleration:
            return rows
        assert self.world.map.dt is not None, "refused before"
        entries = others_offsets(self.world.map.names)  # (J, 2 or 3)
        since = unseen if unseen.ndim == 3 else unseen[..., None]
        ahead = jnp.arange(rows.shape[2])[:, None, None]
        since = since[:, None, None].astype(rows.dtype)
        near = 0.5 * self.options.others_acceleration * self.world.map.dt**2 * (since**2 + 2 * ahead * since)
        offset = rows[..., entries]
        distance = jnp.sqrt((offset**2).sum(-1) + 1e-9)
        share = jnp.maximum(1.0 - near / distance, NEAREST)
        return rows.at[..., entries].set(offset * share[..., None])

    def clear(self, rows: Array, spread: Array, margin: Array, unseen: Array | None = None) -> Array:
        """(B, P, K, N) by how much the scores of predicted rows pass the margins; of several constraints the worst. The
        logs are stayed within whatever margin is kept."""
        danger, support = self.barrier.danger_and_support(self.nearer(rows, unseen), spread)
        clear = lowest(danger - _over(margin, 2))
        return clear if support is None else jnp.minimum(clear, support - WITHIN)

    def missing(self, present: Array, clear: Array, margin: Array) -> Array:
        """(B, K, N) how much predicted rows, clear of the margins by so much (B, K, N), fall short of the condition: 0
        or negative."""
        if self.options.condition == "margin":
            return jnp.minimum(clear, 0.0)
        now = lowest(self.barrier.now(present, present) - _over(margin, 0))[:, None]
        before = jnp.concatenate([now, clear[:, :-1]], 1)
        return jnp.minimum(clear - (1.0 - self.options.alpha) * before, 0.0)

    def started(
        self, proposals: Array, last: Array, key: Key, driven: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """(B, S, K, N, A) thrice: what is refined (the proposals, the last plan moved on by a step, and noisy copies of
        these), and the bounds of each, `trust_radius` around the proposal that it belongs to."""
        many = proposals.shape[1]
        count = max(self.options.num_restarts, many)
        moved = jnp.concatenate([last[:, 1:], last[:, -1:]], 1)[:, None]
        known = jnp.concatenate([proposals, moved], 1)[:, :count]
        copied = known.shape[1]
        source = jnp.arange(count) % copied
        starts = known[:, source]
        noise = self.options.noise * jax.random.normal(key, starts[:, copied:].shape)
        starts = starts.at[:, copied:].add(noise)
        around = proposals[:, jnp.where(source < many, source, 0)]
        low, high = self._within(around, self.options.trust_radius, driven)
        return jnp.clip(starts, low, high), low, high

    def _within(self, actions: Array, distance: float, driven: Array | None) -> tuple[Array, Array]:
        """The bounds of what lies no farther than that from actions (B, ..., N, A); whoever is not `driven` (B, N) does
        what is proposed."""
        far: Array | float = distance
        if driven is not None:
            far = distance * driven.reshape(len(driven), *[1] * (actions.ndim - 3), -1, 1)
        low = jnp.maximum(actions - far, -1.0)
        high = jnp.minimum(actions + far, 1.0)
        return self.world.spec.own(low), self.world.spec.own(high)

    def refined(self, present: Array, actions: Array, low: Array, high: Array, margin: Array) -> Array:
        """Actions (B, S, K, N, A) after Adam's ascent of value within bounds, in deviations of the logs', less
        `safety_weight` for every margin that is missing."""

        def loss(actions: Array) -> Array:
            rows, spread = self.imagined(present, actions)
            value = self.world.values.of_plan(rows, actions) / self.world.values.value_std
            short = jnp.minimum(self.clear(rows, spread, margin), 0.0).sum((2, 3))
            return -(value.sum() + self.options.safety_weight * short.sum())

        adam = optax.adam(RATE, b1=0.9, b2=0.99, eps=1e-6)

        def climb(carry: tuple[Array, optax.OptState], _: None) -> tuple[tuple[Array, optax.OptState], None]:
            actions, moments = carry
            move, moments = adam.update(jax.grad(loss)(actions), moments)
            actions = optax.projections.projection_box(optax.apply_updates(actions, move), low, high)
            return (actions, moments), None

        (actions, _), _ = jax.lax.scan(climb, (actions, adam.init(actions)), length=self.options.optimizer_steps)
        return actions

    def selected(self, rows: Array, actions: Array, clear: Array) -> Array:
        """(B,) which proposal: the one of most value among those that keep the margin; where there is none, the safest.
        (B, N) where every agent chooses for itself. `clear` (B, P, K, N)."""
        if actions.shape[1] == 1 or not (self.options.select or self.options.optimizer_steps):
            shape = actions.shape[:1] + ((actions.shape[3],) if self.world.alone else ())
            return jnp.zeros(shape, jnp.int32)
        value = self.world.values.of_plan(rows, actions)
        clear = clear.min(2)
        return pick(clear if self.world.alone else clear.min(-1), value, 0.0)

    def _picked(self, x: Array, chosen: Array) -> Array:
        """(B, 1, K, N, ...) of numbers along proposals (B, P, K, N, ...), those of the one that was chosen (B,), or (B,
        N) by each agent."""
        agents = 3 if self.world.alone else None
        index = jnp.expand_dims(chosen, [axis for axis in range(1, x.ndim) if axis != agents])
        return jnp.take_along_axis(x, index, 1)

    def shielded(
        self,
        present: Array,
        plan: Array,
        missed: Array,
        margin: Array,
        unseen: Array | None = None,
        driven: Array | None = None,
    ) -> Array:
        """Plans (B, K, N, A) corrected until the condition holds along the predicted rows, and the best found
        otherwise, within `max_correction` of what they were. `missed` (B, K, N) of it along them."""
        options = self.options

        def missing(given: Given, plans: Array, margin: Array) -> Array:
            return _missing_along(self, given[:2], plans, margin)

        def within(given: Given, plan: Array) -> tuple[Array, Array]:
            return self._within(plan, options.max_correction, given[2])

        correct = Corrector(missing, within, self.world.alone, options.correction_steps, options.correction_restarts)
        return self.held(correct((present, unseen, driven), plan, missed, margin))

    def adapted(self, margin: Array, unsafe: Array) -> Array:
        """Margins (..., C) after a step: m ← m + η (1[unsafe] − rate), between 0 and MAX_MARGIN. A named constraint has
        the rate of half the steps that its limit allows.

        Adaptive conformal inference (Gibbs and Candès 2021) on the guard's own predictions: whatever their errors, the
        share of unsafe steps tends to `rate` as long as a margin within the bounds can prevent them.
        """
        rate = self.options.rate
        if self.barrier.limits:
            allowed = self.world.unsafe_steps
            rate = jnp.array([0.5 * allowed[name] / self.world.spec.episode_length for name in self.barrier.limits])
        moved = margin + self.options.adapt * (unsafe - rate)
        return jnp.clip(moved, 0.0, max(MAX_MARGIN, self.options.margin))


@jax.jit  # several places ask it, and it is traced once
def _missing_along(guard: Guard, given: tuple[Array, Array | None], plans: Array, margin: Array) -> Array:
    """(B, S, K, N) what is missing along plans (B, S, K, N, A), as `Guard.missing` tells it; `given` are the present
    and for how long others were not seen."""
    present, unseen = given
    clear = guard.clear(*guard.predict(present, guard.held(plans)), margin, unseen)
    return jax.vmap(lambda clear: guard.missing(present, clear, margin), 1, 1)(clear)


def _over(margin: Array, axes: int) -> Array:
    """Margins (B, C) or (B, N, C) with that many more axes after the first, and those of agents and constraints
    last."""
    agents = 1 if margin.ndim == 2 else margin.shape[1]
    return margin.reshape(margin.shape[0], *[1] * axes, agents, margin.shape[-1])


def pick(safety: Array, value: Array, margin: Array | float) -> Array:
    """argmax of value among plans (axis 1) with safety ≥ margin; where there is none, argmax of safety."""
    fine = safety >= margin
    best = jnp.where(fine, value, -jnp.inf).argmax(1)
    return jnp.where(fine.any(1), best, safety.argmax(1))
