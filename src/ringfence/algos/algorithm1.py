"""Algorithm 1 as printed (routing `paper`), to be read beside it: steps of their own for every loss and agent.

    for every batch:
        θ    by L^D                                                                     (6)
        for every agent i:
            ω_i, θ  by L_i^C of s̃^θ, drawn anew by ancestral steps with gradients       (8)
            φ_i     by L_i^P                                                            (10)

    L_i^C = Σ_{S0} [δ − h]₊ + Σ_{Sd} [δ + h]₊ + Σ_{Ss} [δ − h(s̃(t+1)) + α h(s̃(t))]₊     on s̃^θ

Two of the three terms send θ the wrong way (docs/method.md), and they stand here as they are printed. λ, which the
paper does not have, weighs θ's gradient of L_i^C. Networks of agents share no weights unless `scope=shared`, so one
step of Adam on all of ω, and one on all of φ, are the steps of each; θ takes N + 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from ringfence.logs.windows import NOT_ARRIVED
from ringfence.nets.layers import barrier_on
from ringfence.nets.optim import Optimiser, average
from ringfence.problem.constraints import BoundHazard
from ringfence.proposals.retention import Retention
from ringfence.types import Array, Batch, Key, Metrics, PyTree, Spec

THETA = ("denoiser", "mean")  # what draws plans
DRIVERS = ("clones", "prior")  # whom they are of


def loss_of_agent(
    h: Array,
    unsafe: Array,
    safe: Array,
    valid: Array,
    initial: Array,
    retention: Retention,
    eta: Array | float,
    delta: float,
) -> tuple[Array, Metrics]:
    """(L_i^C, shares that hold) of an agent's plans: sums over the states of a plan, a mean over plans.

    h, unsafe, safe, valid (B, H); `initial` (B,) plans that begin where an episode does, whose first state is S_0's;
    `eta` (B, 1) or a number, of α = m − η.
    """
    safe = safe & valid
    unsafe = unsafe & valid
    first = safe[:, 0] & initial
    pair = safe[:, :-1] & valid[:, 1:]
    slack = h[:, 1:] - retention.decay(h[:, :-1], eta)

    def over(x: Array, mask: Array) -> Array:
        return (x * mask).sum() / h.shape[0]

    def share(held: Array, mask: Array) -> Array:
        return (held & mask).sum() / jnp.maximum(mask.sum(), 1)

    loss = over(jax.nn.relu(delta - h[:, 0]), first) + over(jax.nn.relu(delta + h), unsafe)
    loss = loss + over(jax.nn.relu(delta - slack), pair)
    return loss, {
        "barrier/made_accuracy_safe": share(h >= 0, safe),
        "barrier/made_accuracy_unsafe": share(h < 0, unsafe),
        "barrier/made_accuracy_retention": share(slack >= 0, pair),
        "barrier/made_share_unsafe": unsafe.sum() / jnp.maximum(valid.sum(), 1),
    }


def make_printed_update(
    config: Any,
    spec: Spec,
    hazard: BoundHazard,
    planning: Callable,
    drawing: Callable,
    inverse_dynamics: Callable,
    optimiser: Optimiser,
):
    """update(state, batch, key) -> state, metrics."""
    retention = Retention(config.retention, config.relaxation, config.two_sided)
    agents = spec.n_agents
    # θ takes a step for L^D and, where λ is not 0, one for every agent, along the same schedule.
    turns = agents + 1 if config.barrier_weight > 0 else 1
    of_theta = replace(optimiser, steps=turns * optimiser.steps, warmup=turns * optimiser.warmup)

    def update(state: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
        kd, kp, kg = jax.random.split(key, 3)
        norm = state["frozen"]["normaliser"]
        params = dict(state["params"])
        moments = dict(state["opt"])
        theta = [name for name in THETA if name in params]
        drivers = [name for name in DRIVERS if name in params]

        def of_plans(learned: PyTree) -> tuple[Array, Any]:
            plans = planning(params | learned, norm, batch, state["step"], kd)
            return plans.loss, plans

        def step(names: list[str], grads: PyTree, how: Optimiser) -> Metrics:
            new, kept, norms = how.update(grads, moments, {name: params[name] for name in names})
            params.update(new)
            moments.update(kept)
            return norms

        grads, plans = jax.grad(of_plans, has_aux=True)({name: params[name] for name in theta + drivers})
        metrics = plans.metrics | {"barrier/weight": jnp.asarray(config.barrier_weight)}
        for names, how in ((theta, of_theta), (drivers, optimiser)):
            metrics |= step(names, {name: grads[name] for name in names}, how)
        initial = plans.batch.costs[:, config.history] == NOT_ARRIVED

        teaches: list[PyTree] = []
        for agent in range(agents):

            def of_agent(learned: PyTree, omega: PyTree, agent: int = agent) -> tuple[Array, Metrics]:
                made = drawing(params | learned, norm, plans, jax.random.fold_in(kg, agent))
                x = made.features[:, config.history :]
                unsafe, safe = hazard.labels(jax.lax.stop_gradient(x))
                h = barrier_on(omega, norm, x)
                return loss_of_agent(
                    h[..., agent],
                    unsafe[..., agent],
                    safe[..., agent],
                    made.valid[:, config.history :],
                    initial[: x.shape[0]],
                    retention,
                    made.eta[..., 0],
                    config.delta,
                )

            learned = {name: params[name] for name in theta}
            (loss, more), (pull, omega) = jax.value_and_grad(of_agent, (0, 1), has_aux=True)(learned, params["barrier"])
            teaches.append(omega)
            metrics = metrics | more | {"loss/shaping": metrics.get("loss/shaping", 0.0) + loss}
            if config.barrier_weight > 0:
                step(theta, jax.tree.map(lambda g: config.barrier_weight * g, pull), of_theta)
        omega = jax.tree.map(lambda *g: sum(g), *teaches)
        metrics |= step(["barrier"], {"barrier": omega}, optimiser)

        def of_inverse(inverse: PyTree) -> Array:
            return agents * inverse_dynamics(params | {"inverse": inverse}, plans.batch, norm, kp, config)

        lost, phi = jax.value_and_grad(of_inverse)(params["inverse"])
        metrics |= step(["inverse"], {"inverse": phi}, optimiser) | {"loss/inverse": lost / agents}
        ema = average(state["ema"], params, config.ema, state["step"])
        return {**state, "params": params, "ema": ema, "opt": moments, "step": state["step"] + 1}, metrics

    return update
