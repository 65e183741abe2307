"""Policies: batched, pure, normaliser inside.

The planner draws plans, picks one, and reads the action off its first step:

    time        t          t+1   t+2   ...   t+H-1
    plan        present    row1  row2  ...   row H-1       in-painted | generated
    executed    f_φ(present, row 1), then plan again (or follow the plan for `replan` steps)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence import diffusion, normalise
from ringfence.dynamics import foresee
from ringfence.errors import UserError, unknown
from ringfence.features import FeatureMap
from ringfence.hazards import BoundHazard, least
from ringfence.nets.heads import barrier_on, infer_action
from ringfence.normalise import Normaliser
from ringfence.types import Array, Key, PolicyStep, PyTree, Spec
from ringfence.values import plan_value

MAX_MARGIN = 3.0  # of an adapting margin, in the hazard's safe margins
MAX_SLOPE = 20.0  # bound on the norm of a guidance gradient, in standard deviations of the plan


@dataclass(frozen=True)
class PlanOptions:
    """Evaluation-time choices: one checkpoint gives the whole curve of safety against compute."""

    plans: int = 1  # plans drawn per step; more than one are selected among
    steps: int = 5  # sampler steps
    sampler: diffusion.Sampler = "ddim"
    guidance: float = 1.2  # ω of classifier-free guidance; 1 switches it off
    target: float = 1.5  # return condition, as a normal score: 1.5 asks for the best 7 %
    temperature: float = 1.0  # scale of the first noise
    ascent: float = 0.0  # gradient guidance: steps of x̂0 along the plan's value, in units of its deviation
    persist: float = 1.0  # gradient guidance fades as (1 − ᾱ)^persist: 1 trusts the denoiser, 0 the gradient
    repair: float = 0.0  # gradient guidance: steps of x̂0 along the safety score where it is below the margin
    select: Literal["clearance", "barrier", "both"] = "clearance"  # what a plan's safety is judged by
    margin: float = 0.02  # least safety score that is good enough (m or m/s for clearance)
    share: float = 0.0  # of the hazard's own safe margin that is added to the margin: the same for every speed limit
    adapt: float = 0.0  # the margin's step after an unsafe state, in the hazard's safe margins; 0: it stays
    rate: float = 0.00625  # share of unsafe states at which an adapting margin settles: a quarter of 25 in 1000
    prefix: int = 3  # rows of the plan that are judged
    shield: int = 0  # rounds that correct the actions which forward dynamics finds unsafe; 0: act as planned
    foresight: bool = True  # judge plans by where forward dynamics says they lead, not by what they say
    reconcile: bool = True  # make the agents of a joint plan agree on where everybody will be
    replan: int = 1  # steps that a plan is followed for
    execution: Literal["centralized", "decentralized"] = "centralized"  # decentralized: each agent plans for itself

    def __post_init__(self):
        for name, bound in (("plans", 1), ("steps", 1), ("prefix", 1), ("replan", 1), ("shield", 0)):
            if getattr(self, name) < bound:
                raise UserError(f"{name}={getattr(self, name)} must be at least {bound}.")
        if self.select not in ("clearance", "barrier", "both"):
            raise UserError(f"select='{self.select}' is unknown; choose clearance, barrier or both.")
        for name in ("temperature", "ascent", "repair", "persist", "share", "adapt"):
            if getattr(self, name) < 0:
                raise UserError(f"{name}={getattr(self, name)} must not be negative.")
        if not 0 < self.rate < 1:
            raise UserError(f"rate={self.rate} must be a share of states between 0 and 1.")
        if self.share > 0 and self.select != "clearance":
            raise UserError(
                f"share={self.share} of a margin in m or m/s means nothing to select='{self.select}', as a barrier has "
                "no unit; set share=0 or select='clearance'."
            )
        if self.adapt and (self.select != "clearance" or self.execution == "decentralized"):
            raise UserError(
                f"adapt={self.adapt} reads the clearance of the whole team; use select='clearance' and "
                "execution='centralized', or set adapt=0."
            )
        if self.sampler not in diffusion.SAMPLERS:
            raise unknown("sampler", self.sampler, diffusion.SAMPLERS)
        if self.execution not in ("centralized", "decentralized"):
            raise UserError(f"execution='{self.execution}' is unknown; choose centralized or decentralized.")
        if self.shield and (self.execution == "decentralized" or self.replan > 1):
            raise UserError("shield corrects a joint action at every step; use execution='centralized' and replan=1.")


_SHIELDED = {"temperature": 0.3, "plans": 4, "shield": 10, "margin": 0.0, "share": 0.6}

# Named sets of evaluation-time choices. `guarded` uses everything that is known at run time: value steers the samples,
# the best safe one of eight plans is followed, and what it would do is corrected until it keeps its distance.
# Chosen on validation resets; docs/evaluation.md.
PLANNERS: dict[str, dict] = {
    "plain": {},
    "guarded": {
        "plans": 8,
        "steps": 10,
        "guidance": 1.0,
        "ascent": 100.0,
        "persist": 0.5,
        "shield": 10,
        "margin": 0.03,
    },
    # For robots. Samples begin with less noise, since every outlier of a thousand steps throws the robot off; and no
    # gradient on value, which rises with the very speed that is limited.
    "steady": {"temperature": 0.3},
    "shielded": _SHIELDED,
    # The same, but the margin is only where it begins: more is kept after an unsafe state, less while there is none.
    "adaptive": _SHIELDED | {"adapt": 0.1},
}


class Planner(eqx.Module):
    """Receding-horizon diffusion planner with selection among plans."""

    networks: dict[str, Any]  # denoiser, inverse, maybe barrier
    normaliser: Normaliser
    critic: dict[str, Any]  # what states are worth
    dynamics: dict[str, Any]  # where actions lead
    alpha_bar: tuple[float, ...] = eqx.field(static=True)
    horizon: int = eqx.field(static=True)
    history: int = eqx.field(static=True)
    prediction: str = eqx.field(static=True)
    clip: float = eqx.field(static=True)
    discount: float = eqx.field(static=True)
    observe: str = eqx.field(static=True)  # whose present was known in training
    carries_own: bool = eqx.field(static=True)  # plans hold own entries only; the rest is recomputed
    spec: Spec = eqx.field(static=True)
    feature_map: FeatureMap = eqx.field(static=True)
    hazard: BoundHazard = eqx.field(static=True)
    options: PlanOptions = eqx.field(static=True)

    def __check_init__(self):
        o = self.options
        if o.replan > self.horizon - 1:
            raise UserError(
                f"replan={o.replan} outlives a plan of {self.horizon} rows; use at most {self.horizon - 1}."
            )
        judged = o.plans > 1 or o.repair > 0 or o.shield > 0
        idle = () if judged else ("margin", "share", "select", "prefix", "foresight", "adapt")
        idle += () if o.ascent or o.repair else ("persist",)
        idle += () if o.adapt else ("rate",)
        needs = {"persist": "ascent or repair", "rate": "adapt"}
        for name in idle:
            if getattr(o, name) != getattr(PlanOptions(), name):
                remedy = needs.get(name, "shield=10, or plans above 1")
                raise UserError(f"{name}={getattr(o, name)} is read by nothing that was asked for; set {remedy}.")
        if judged and o.select != "clearance" and "barrier" not in self.networks:
            raise UserError(f"select='{o.select}' needs a barrier, which this model has not; use select='clearance'.")
        if judged and o.select != "barrier" and not self.hazard.has_formula:
            raise UserError(
                f"select='{o.select}' needs a hazard formula that the model's view can read; use select='barrier'."
            )
        if self.carries_own and not o.reconcile:
            raise UserError("reconcile=False needs a model that diffuses whole states; train with carry='all'.")
        if o.execution == "decentralized" and self.observe == "all":
            raise UserError("execution='decentralized' needs a model trained with observe='single' or 'mixed'.")
        if o.execution == "centralized" and self.observe == "single":
            raise UserError("This model was trained with observe='single'; evaluate with execution='decentralized'.")
        diffusion.timesteps(len(self.alpha_bar), o.steps)

    @property
    def margin(self) -> float:
        """Least safety score that is good enough."""
        return self.options.margin + self.options.share * self.hazard.safe_margin

    def start(self, batch: int) -> PyTree:
        n, d = self.spec.n_agents, self.spec.feature_dim
        rows = self.history + self.horizon
        return {
            "past": jnp.zeros((batch, self.history, n, d)),
            "plan": jnp.zeros((batch, rows, n, d)),
            "age": jnp.zeros((), jnp.int32),
            "margin": jnp.full(batch, self.margin),
        }

    def act(self, memory: PyTree, observations: Array, state: Array, key: Key) -> tuple[PyTree, PolicyStep]:
        """observations (B, N, O), state (B, S) -> joint action (B, N, A) within the task's bounds."""
        o = self.options
        present = self.feature_map(observations, state)
        first = memory["age"] == 0
        past, margin = memory["past"], jnp.full(present.shape[0], self.margin)  # known to the compiler unless it moves
        if o.adapt:
            margin = jnp.where(first, margin, self.adapted(memory["margin"], present))
        if self.history:
            past = jnp.where(first, jnp.repeat(present[:, None], self.history, 1), past)
        if o.replan == 1:
            plan, info = self.plan(past, present, margin, key)
            ahead = plan[:, self.history + 1]
        else:
            fresh = memory["age"] % o.replan == 0
            plan, info = jax.lax.cond(
                fresh,
                lambda: self.plan(past, present, margin, key),
                lambda: (memory["plan"], self._no_news(present.shape[0])),
            )
            ahead = jnp.take(plan, self.history + 1 + memory["age"] % o.replan, axis=1)
        action = jnp.clip(infer_action(self.networks["inverse"], self.normaliser, present, ahead), -1.0, 1.0)
        if o.shield:
            action = self.shielded(plan, margin)
        if self.history:
            past = jnp.concatenate([past[:, 1:], present[:, None]], 1)
        memory = {"past": past, "plan": plan, "age": memory["age"] + 1, "margin": margin}
        return memory, PolicyStep(from_unit(action, self.spec), info)

    def adapted(self, margin: Array, present: Array) -> Array:
        """Margins (B,) after a look at where the last actions led, (B, N, D): m ← m + η (1[unsafe] − rate).

        Adaptive conformal inference (Gibbs and Candès 2021) on the planner's own foresight: whatever its errors, the
        share of unsafe states tends to `rate` as long as a margin within the bounds can prevent them.
        """
        o, unit = self.options, self.hazard.safe_margin
        unsafe = self.hazard.clearance(present).min(-1) < 0
        most = max(MAX_MARGIN * unit, self.margin)
        return jnp.clip(margin + o.adapt * unit * (unsafe - o.rate), 0.0, most)

    def plan(self, past: Array, present: Array, margin: Array, key: Key) -> tuple[Array, dict[str, Array]]:
        """Draw plans from the present (B, N, D) and pick one: (B, rows, N, D) features, and how it was picked."""
        o, (b, n, d), rows = self.options, present.shape, self.history + self.horizon
        context = jnp.concatenate([past, present[:, None]], 1)
        local = o.execution == "decentralized"
        copies = o.plans * (n if local else 1)  # every agent imagines the whole team, n times the work
        visible = jnp.ones((b, copies, n), bool)
        if local:
            visible = jnp.broadcast_to(jnp.repeat(jnp.eye(n, dtype=bool), o.plans, 0), visible.shape)
        x = self.sample(jnp.repeat(context, copies, 0), visible.reshape(-1, n), jnp.repeat(margin, copies), key)
        x = x.reshape(b, copies, rows, n, d)
        if local:  # each agent judges the team plans that it imagined itself, by its own safety, and keeps its own part
            own = x.reshape(b, n, o.plans, rows, n, d)
            parts = jnp.stack([own[:, i, :, :, i] for i in range(n)], -2)  # (B, P, rows, N, D)
            if o.plans == 1:
                return parts[:, 0], self._no_news(b) | {"plans": parts}
            safety, value = self.judge(x)
            safety = jnp.stack([safety.reshape(b, n, o.plans, n)[:, i, :, i] for i in range(n)], -1)  # (B, P, N)
            chosen = pick(safety, jnp.moveaxis(value.reshape(b, n, o.plans), 1, 2), margin[:, None, None])  # (B, N)
            plan = jnp.take_along_axis(parts, chosen[:, None, None, :, None], 1)[:, 0]
            clearance = jnp.take_along_axis(safety, chosen[:, None], 1)[:, 0].min(-1)
            return plan, {"plans": parts, "chosen": chosen, "clearance": clearance}
        if o.plans == 1:
            return x[:, 0], self._no_news(b) | {"plans": x}
        safety, value = self.judge(x)
        team = safety.min(-1)
        chosen = pick(team, value, margin[:, None])
        plan = jnp.take_along_axis(x, chosen[:, None, None, None, None], 1)[:, 0]
        return plan, {"plans": x, "chosen": chosen, "clearance": jnp.take_along_axis(team, chosen[:, None], 1)[:, 0]}

    def sample(self, context: Array, visible: Array, margin: Array, key: Key) -> Array:
        """Plans (B, rows, N, D) in physical units, given the known rows (B, history + 1, N, D)."""
        o, (b, _, n, d) = self.options, context.shape
        rows = self.history + self.horizon
        known = self.normaliser.state(context)
        mask = diffusion.known_entries(visible, self.history, rows)
        known = jnp.concatenate([known, jnp.zeros((b, self.horizon - 1, n, d))], 1)
        bar = np.asarray(self.alpha_bar)
        target = jnp.full(b, o.target)
        predict = diffusion.guided(self.networks["denoiser"], bar, target, o.guidance, self.prediction, self.clip)

        def inpaint(x: Array) -> Array:
            return jnp.where(mask, known, x)

        def steered(x: Array, k: Array) -> Array:
            clean = inpaint(predict(x, k))
            if o.ascent > 0 or o.repair > 0:
                slope = jax.grad(lambda c: self.merit(inpaint(c), margin).sum())(clean)
                size = jnp.sqrt((slope**2).sum((1, 2, 3), keepdims=True))
                slope = slope * jnp.minimum(1.0, MAX_SLOPE / jnp.maximum(size, 1e-9))
                level = (1.0 - jnp.asarray(bar, jnp.float32)[k]) ** o.persist
                clean = jnp.clip(inpaint(clean + level[:, None, None, None] * slope), -self.clip, self.clip)
            return self.normaliser.apply(self.agreed(self.normaliser.invert(clean))) if o.reconcile else clean

        shape = (b, rows, n, d)
        x = diffusion.sample(steered, inpaint, shape, bar, key, o.steps, o.sampler, o.temperature)
        return self.agreed(self.normaliser.invert(x))

    def agreed(self, x: Array) -> Array:
        """Plans (B, rows, N, D) in which all agents agree on where everybody will be, where the task knows how."""
        return self.feature_map.agreed(x, self.history) if self.options.reconcile else x

    def merit(self, clean: Array, margin: Array) -> Array:
        """(B,) what gradient guidance climbs: value in deviations of the data's, and safety up to the margin."""
        o, total = self.options, jnp.zeros(clean.shape[0])
        x = self.agreed(self.normaliser.invert(clean))
        if o.ascent > 0:
            ahead = x[:, self.history + 1 :]
            total = total + o.ascent * plan_value(self.critic, ahead, self.discount) / self.critic["value"][1, 1]
        if o.repair > 0:
            short = jnp.minimum(self.safety(self.foreseen(x)) - margin[:, None, None], 0.0)
            total = total + o.repair * short.sum((1, 2))
        return total

    def foreseen(self, x: Array) -> Array:
        """The judged rows (B, prefix, N, D) of plans (B, rows, N, D).

        With `foresight`, not as planned but as forward dynamics says they will come out when inverse dynamics tracks
        the plan within the action bounds: a plan may ask for what no action can do.
        """
        o, now = self.options, self.history
        last = min(now + 1 + o.prefix, x.shape[1])
        return self.tracked(x)[0] if o.foresight else x[:, now + 1 : last]

    def tracked(self, x: Array) -> tuple[Array, Array]:
        """States (B, P, N, D), actions (B, P, N, A) in [−1, 1]: inverse dynamics tracks P = prefix rows of plans."""
        now = self.history
        state, states, actions = x[:, now], [], []
        for row in range(now + 1, min(now + 1 + self.options.prefix, x.shape[1])):
            action = infer_action(self.networks["inverse"], self.normaliser, state, x[:, row])
            actions.append(jnp.clip(action, -1.0, 1.0))
            state = self.foreseen_step(x[:, : now + 1], state, actions[-1])
            states.append(state)
        return jnp.stack(states, 1), jnp.stack(actions, 1)

    def foreseen_step(self, known: Array, state: Array, action: Array) -> Array:
        """Where actions (B, N, A) lead from states (B, N, D), all agents agreeing; `known` (B, now+1, N, D) before."""
        state = foresee(self.dynamics, state, action, self.feature_map.joint)
        return self.agreed(jnp.concatenate([known, state[:, None]], 1))[:, -1]

    def shielded(self, plan: Array, margin: Array) -> Array:
        """Joint action (B, N, A) in [−1, 1] of the plan (B, rows, N, D), corrected until foreseen rows keep the margin.

        Polyak's steps on the shortfall f(a) = Σ min(safety − margin, 0) over agents and rows, whose goal is 0:
        a ← a − f ∇f / ‖∇f‖², within the action bounds. Where nothing falls short the plan's own action is kept.
        """
        o, known = self.options, plan[:, : self.history + 1]
        _, actions = self.tracked(plan)

        def shortfall(actions: Array) -> Array:
            state, rows = known[:, -1], []
            for p in range(actions.shape[1]):
                state = self.foreseen_step(known, state, actions[:, p])
                rows.append(state)
            return jnp.minimum(self.safety(jnp.stack(rows, 1)) - margin[:, None, None], 0.0).sum((1, 2))

        def correct(actions: Array, _) -> tuple[Array, None]:
            f, back = jax.vjp(shortfall, actions)
            slope = back(jnp.ones_like(f))[0]
            size = jnp.maximum((slope**2).sum((1, 2, 3)), 1e-6)
            moved = actions - (f / size)[:, None, None, None] * slope
            return jnp.clip(moved, -1.0, 1.0), None

        return jax.lax.scan(correct, actions, length=o.shield)[0][:, 0]

    def safety(self, rows: Array) -> Array:
        """(..., N) the configured safety score of states (..., N, D): clearance, barrier or the least of both."""
        scores = []
        if self.options.select in ("clearance", "both"):
            scores.append(self.hazard.clearance(rows))
        if self.options.select in ("barrier", "both"):
            scores.append(barrier_on(self.networks["barrier"], self.normaliser, rows))
        return least(scores)

    def judge(self, x: Array) -> tuple[Array, Array]:
        """Plans (B, P, rows, N, D) -> safety (B, P, N), the least over the judged rows, and value (B, P).

        Value: Σ_h γ^h r̂(row) along the plan, then γ^H V̂(last row), in the data's units.
        """
        b, p, rows, n, d = x.shape
        seen = self.foreseen(x.reshape(b * p, rows, n, d))
        safety = self.safety(seen).min(1).reshape(b, p, n)
        ahead = x[:, :, self.history + 1 :]
        if self.options.foresight:
            kept = self.options.prefix
            ahead = jnp.concatenate([seen.reshape(b, p, *seen.shape[1:]), ahead[:, :, kept:]], 2)
        return safety, plan_value(self.critic, ahead, self.discount)

    def _no_news(self, batch: int) -> dict[str, Array]:
        n, d, rows = self.spec.n_agents, self.spec.feature_dim, self.history + self.horizon
        return {
            "plans": jnp.zeros((batch, self.options.plans, rows, n, d)),
            "chosen": jnp.zeros((batch, n) if self.options.execution == "decentralized" else batch, jnp.int32),
            "clearance": jnp.full(batch, jnp.nan),
        }


def pick(safety: Array, value: Array, margin: Array | float) -> Array:
    """argmax of value among plans (axis 1) with safety ≥ margin; where there is none, argmax of safety."""
    fine = safety >= margin
    best = jnp.where(fine, value, -jnp.inf).argmax(1)
    return jnp.where(fine.any(1), best, safety.argmax(1))


class Direct(eqx.Module):
    """An actor network on the present features, one per agent, squashed into the action bounds."""

    actor: Any
    normaliser: Normaliser
    spec: Spec = eqx.field(static=True)
    feature_map: FeatureMap = eqx.field(static=True)

    def start(self, batch: int) -> PyTree:
        return {}

    def act(self, memory: PyTree, observations: Array, state: Array, key: Key) -> tuple[PyTree, PolicyStep]:
        x = self.normaliser.state(self.feature_map(observations, state))
        return memory, PolicyStep(from_unit(jnp.tanh(self.actor(x)), self.spec), {})


def from_unit(action: Array, spec: Spec) -> Array:
    """Actions in [−1, 1], as everything learns them, in the task's bounds."""
    return normalise.from_unit(action, spec.action_low, spec.action_high)


class Constant(eqx.Module):
    """Does nothing, or acts uniformly at random: the reference rows of every table."""

    spec: Spec = eqx.field(static=True)
    random: bool = eqx.field(static=True, default=False)

    def start(self, batch: int) -> PyTree:
        return {}

    def act(self, memory: PyTree, observations: Array, state: Array, key: Key) -> tuple[PyTree, PolicyStep]:
        s = self.spec
        shape = (observations.shape[0], s.n_agents, s.action_dim)
        if self.random:
            return memory, PolicyStep(jax.random.uniform(key, shape, minval=s.action_low, maxval=s.action_high), {})
        return memory, PolicyStep(jnp.zeros(shape), {})
