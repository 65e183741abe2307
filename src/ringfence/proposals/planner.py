"""Policies: batched, pure, normaliser inside.

The planner draws plans and reads the action off the first step of one:

    time        t          t+1   t+2   ...   t+H-1
    plan        present    row1  row2  ...   row H-1       in-painted | generated
    executed    f_φ(present, row 1), then plan again (or follow the plan for `replan` steps)

What becomes of several plans, and of what they would do, is a guard's (guards/).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError
from ringfence.nets.layers import infer_action
from ringfence.nets.team import Centre, planning_as
from ringfence.problem.features import FeatureMap
from ringfence.problem.normalise import Normaliser
from ringfence.proposals import diffusion
from ringfence.proposals.base import from_unit
from ringfence.proposals.drivers import classifier_free, draw, several
from ringfence.proposals.guidance import ROWS, Guide, Way
from ringfence.proposals.options import PlanOptions
from ringfence.types import Array, Key, PolicyStep, PyTree, Spec
from ringfence.world import World

ROUNDS = 6  # of guidance in every sampling step: three earn less (results/tuning/value_guidance.csv)


class Planner(eqx.Module):
    """Receding-horizon diffusion planner."""

    networks: dict[str, Any]  # denoiser, inverse; mean, prior and barrier where there are such
    normaliser: Normaliser
    alpha_bar: tuple[float, ...] = eqx.field(static=True)
    horizon: int = eqx.field(static=True)
    history: int = eqx.field(static=True)
    prediction: diffusion.Prediction = eqx.field(static=True)
    dim: bool = eqx.field(static=True)  # the denoiser is shown noisy entries × √ᾱ_k
    clip: float = eqx.field(static=True)
    observe: str = eqx.field(static=True)  # whose present was known in training
    drivers: int = eqx.field(static=True)  # that it may plan as, one for an episode; 0: nobody in particular
    carries_own: bool = eqx.field(static=True)  # plans hold own entries only; the rest is recomputed
    spec: Spec = eqx.field(static=True)
    feature_map: FeatureMap = eqx.field(static=True)
    options: PlanOptions = eqx.field(static=True)
    guide: Guide | None = None  # of the sampling

    @property
    def rows_planned(self) -> int:
        """Rows of a plan beside the present one."""
        return self.horizon - 1

    def __check_init__(self):
        o = self.options
        if o.replan > self.rows_planned:
            raise UserError(
                f"replan={o.replan} outlives a plan of {self.horizon} rows; use at most {self.rows_planned}."
            )
        if self.carries_own and not o.reconcile:
            raise UserError("reconcile=False needs a model that diffuses whole states; train with carry='all'.")
        for name in ("barrier_guidance", "value_guidance"):
            if getattr(o, name) and o.execution == "decentralized":
                raise UserError(
                    f"{name}={getattr(o, name)} asks a World that sees the whole team, which "
                    "execution='decentralized' does not; leave one of them out."
                )
        if o.execution == "decentralized" and self.observe == "all":
            raise UserError("execution='decentralized' needs a model trained with observe='single' or 'mixed'.")
        if o.execution == "centralized" and self.observe == "single":
            raise UserError("execution='centralized' needs a model trained with observe='all' or 'mixed'.")
        diffusion.timesteps(len(self.alpha_bar), o.sampling_steps)

    def initial_state(self, batch: int) -> PyTree:
        n, d = self.spec.n_agents, self.spec.feature_dim
        rows = self.history + self.horizon
        driver = {"driver": jnp.zeros(batch, jnp.int32)} if self.drivers else {}
        return driver | {
            "past": jnp.zeros((batch, self.history, n, d)),
            "plan": jnp.zeros((batch, rows, n, d)),
            "age": jnp.zeros((), jnp.int32),
        }

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        """observations (B, N, O), state (B, S) -> joint action (B, N, A) within the task's bounds, of one plan."""
        o, (past, present) = self.options, self._context(carry, observations, state)
        carry = self._with_driver(carry, present, key)
        driver = carry["driver"] if self.drivers else None
        judged = self._judged(observations, state)
        if o.replan == 1:
            plan = self.plans(past, present, key, 1, driver, judged)[:, 0]
            ahead = plan[:, self.history + 1]
        else:
            fresh = carry["age"] % o.replan == 0
            anew = lambda: self.plans(past, present, key, 1, driver, judged)[:, 0]  # noqa: E731
            plan = jax.lax.cond(fresh, anew, lambda: carry["plan"])
            ahead = jnp.take(plan, self.history + 1 + carry["age"] % o.replan, axis=1)
        action = self.towards(present, ahead)
        info = {"plans": plan[:, None], "chosen": jnp.zeros(plan.shape[0], jnp.int32)}
        return self._kept(carry, past, present, plan), PolicyStep(from_unit(action, self.spec), info)

    def propose(
        self, carry: PyTree, observations: Array, state: Array, key: Key, count: int, rows: int, world: World
    ) -> tuple[PyTree, Array, dict[str, Array]]:
        """(carry, actions (B, `count`, `rows`, N, A) in [−1, 1], info): what inverse dynamics does to track plans."""
        if self.options.replan > 1:
            raise UserError("A guard decides at every step; use replan=1.")
        if rows > self.rows_planned:
            raise UserError(
                f"horizon={rows} rows are judged, but plans hold {self.rows_planned} steps; use at most as many, or a "
                "longer horizon."
            )
        past, present = self._context(carry, observations, state)
        carry = self._with_driver(carry, present, key)
        who = self._several(carry, present, key, count)
        plans = self.plans(past, present, key, count, who, self._judged(observations, state))
        flat = plans.reshape(-1, *plans.shape[2:])
        actions = self.tracked(flat[:, self.history], flat[:, self.history + 1 : self.history + 1 + rows], world)
        actions = actions.reshape(*plans.shape[:2], *actions.shape[1:])
        return self._kept(carry, past, present, plans[:, 0]), actions, {}

    def _context(self, carry: PyTree, observations: Array, state: Array | None) -> tuple[Array, Array]:
        """Past rows (B, history, N, D) and the present (B, N, D)."""
        present, past = self.feature_map(observations, state), carry["past"]
        if self.history:
            past = jnp.where(carry["age"] == 0, jnp.repeat(present[:, None], self.history, 1), past)
        return past, present

    def _judged(self, observations: Array, state: Array | None) -> Array | None:
        """The present (B, N, D') as the World sees it that guides, where one does."""
        return None if self.guide is None else self.guide.world.map(observations, state)

    def _kept(self, carry: PyTree, past: Array, present: Array, plan: Array) -> PyTree:
        if self.history:
            past = jnp.concatenate([past[:, 1:], present[:, None]], 1)
        return {**carry, "past": past, "plan": plan, "age": carry["age"] + 1}

    def _with_driver(self, carry: PyTree, present: Array, key: Key) -> PyTree:
        """What is carried, with the driver that this episode's first state (B, N, D) draws."""
        if not self.drivers:
            return carry
        driver = jnp.where(carry["age"] == 0, self._drawn(present, jax.random.fold_in(key, 1)), carry["driver"])
        return {**carry, "driver": driver}

    def _several(self, carry: PyTree, present: Array, key: Key, count: int) -> Array | None:
        """(B · count,) whose plans to make: the episode's own driver's first, then of such as may drive here."""
        if not self.drivers:
            return None
        return several(
            carry["driver"],
            count,
            lambda more: self._drawn(jnp.repeat(present, more, 0), jax.random.fold_in(key, 2)),
        )

    def _drawn(self, present: Array, key: Key) -> Array:
        """(B,) who drives at states (B, N, D), drawn, for the return that is asked for."""
        batch = present.shape[0]
        seen = self.normaliser.state(present).reshape(batch, -1)
        target = jnp.full(batch, self.options.target_return)
        return draw(self.networks["prior"], seen, key, lambda ask: classifier_free(ask, target, self.options.cfg_scale))

    def plans(
        self,
        past: Array,
        present: Array,
        key: Key,
        count: int,
        driver: Array | None = None,
        judged: Array | None = None,
    ) -> Array:
        """(B, count, rows, N, D) plans from the present (B, N, D), of drivers (B · count,) where there are some, guided
        from the present as a World sees it (B, N, D') where one is given. Decentralised, every agent imagines the whole
        team, n times the work, and keeps its own part."""
        (b, n, d), rows = present.shape, self.history + self.horizon
        context = jnp.concatenate([past, present[:, None]], 1)
        local = self.options.execution == "decentralized"
        copies = count * (n if local else 1)
        visible = jnp.ones((b, copies, n), bool)
        if local:
            visible = jnp.broadcast_to(jnp.repeat(jnp.eye(n, dtype=bool), count, 0), visible.shape)
        judged = None if judged is None else jnp.repeat(judged, copies, 0)
        heat = jnp.tile(self.options.temperatures(count), b * (n if local else 1))
        x = self.sample(jnp.repeat(context, copies, 0), visible.reshape(-1, n), key, heat, driver, judged)
        if not local:
            return x.reshape(b, count, rows, n, d)
        own = x.reshape(b, n, count, rows, n, d)
        return jnp.stack([own[:, i, :, :, i] for i in range(n)], -2)

    def sample(
        self,
        context: Array,
        visible: Array,
        key: Key,
        temperature: Array,
        driver: Array | None = None,
        judged: Array | None = None,
    ) -> Array:
        """Plans (B, rows, N, D) in physical units, given the known rows (B, history + 1, N, D), from noise of
        `temperature` (B,), of drivers (B,), guided from the present as a World sees it (B, N, D')."""
        o, (b, _, n, d) = self.options, context.shape
        rows = self.history + self.horizon
        mask = diffusion.known_entries(visible, self.history, rows)
        known = self.normaliser.state(context)
        known = jnp.concatenate([known, jnp.zeros((b, self.horizon - 1, n, d))], 1)
        bar = np.asarray(self.alpha_bar)
        target = jnp.full(b, o.target_return)
        trained = (bar, self.prediction, self.clip, self.dim)
        made = generator(self.networks, known, mask, target, driver, *trained, o.cfg_scale)

        def steered(z: Array, k: Array) -> Array:
            clean = made.plan(made.predict(z, k))
            if judged is not None:
                clean = self._steered(made, context[:, -1], judged, clean)
            if o.reconcile:
                clean = self.normaliser.apply(self.agreed(self.normaliser.invert(clean)))
            return made.rest(clean)

        how = (o.sampling_steps, o.sampler, temperature[:, None, None, None])
        z = diffusion.sample(steered, made.inpaint, (b, rows, n, d), bar, key, *how)
        return self.agreed(self.normaliser.invert(made.plan(z)))

    def _steered(self, made: Generator, present: Array, judged: Array, clean: Array) -> Array:
        """Plans (B, rows, N, D) whose actions are worth more to the World that guides."""
        guide, first = self.guide, self.history + 1
        assert guide is not None, "or nothing is judged"

        def rows_of(x: Array) -> Array:
            return self.agreed(self.normaliser.invert(made.inpaint(x)))[:, first : first + ROWS]

        foreseen = guide.world.map.names == self.feature_map.names
        return guide.moved(judged, Way(rows_of, self.towards, present, foreseen), clean, ROUNDS)

    def tracked(self, present: Array, rows: Array, world: World) -> Array:
        """Actions (B, K, N, A) in [−1, 1] by which inverse dynamics tracks `rows` (B, K, N, D) of plans from the
        present (B, N, D): along what the World foresees, if it reads the same view, else along the plans."""
        same = world.map.names == self.feature_map.names

        def step(x: Array, row: Array) -> tuple[Array, Array]:
            action = self.towards(x, row)
            return world.dynamics.step(x, action)[0] if same else row, action

        return jnp.moveaxis(jax.lax.scan(step, present, jnp.moveaxis(rows, 1, 0))[1], 0, 1)

    def towards(self, x: Array, row: Array) -> Array:
        """Actions (B, N, A) in [−1, 1] that inverse dynamics reads off a step from features (B, N, D) to others."""
        return jnp.clip(infer_action(self.networks["inverse"], self.normaliser, x, row), -1.0, 1.0)

    def agreed(self, x: Array) -> Array:
        """Plans (B, rows, N, D) in which all agents agree on where everybody will be, where the task knows how."""
        return self.feature_map.agreed(x, self.history) if self.options.reconcile else x


@dataclass(frozen=True)
class Generator:
    """Draws the unknown entries of plans (B, H, N, D), in the normaliser's coordinates x. Noise is diffused in z, what
    is left of x around the mean plan where there is one."""

    predict: diffusion.Predict  # of z
    mask: Array  # (B, H, N, 1) which entries are known
    known: Array  # (B, H, N, D) their values
    centre: Centre | None

    def inpaint(self, x: Array) -> Array:
        return jnp.where(self.mask, self.known, x)

    def plan(self, z: Array) -> Array:
        """x of z, with what is known."""
        return self.inpaint(z if self.centre is None else self.centre.plan(z))

    def rest(self, x: Array) -> Array:
        """z of x."""
        return x if self.centre is None else self.centre.rest(x, self.mask)


def generator(
    networks: Mapping[str, Any],
    known: Array,
    mask: Array,
    y: Array,
    driver: Array | None,
    alpha_bar: np.ndarray,
    prediction: diffusion.Prediction,
    clip: float,
    dim: bool,
    guidance: float = 1.0,
) -> Generator:
    """Plans for y (B,), of drivers (B,), by `networks`: a `denoiser`, and `mean` where there is one. `dim`: noisy
    entries are shown × √ᾱ_k."""
    net = planning_as(networks["denoiser"], driver)
    predict = diffusion.guided(net, alpha_bar, y, guidance, prediction, clip, mask if dim else None)
    centre = None
    if "mean" in networks:
        centre = networks["mean"](known, mask, y, jnp.ones(y.shape, bool), driver, guidance)
    return Generator(predict, mask, known, centre)
