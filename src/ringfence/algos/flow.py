"""Joint flow matching for logs of many drivers.

A pooled log holds several policies. A clone of all of them answers with a mean that none would do; a generator that
draws anew at every step changes its mind at every step. Here the drivers are found first, without labels, and an
episode is played as one of them:

    L^E  windows are shared among C joint clones μ_c by who explains them best (expectation–maximisation). At first all
         clones get equal shares (the balance of Cuturi 2013 and Caron et al. 2020), so that none takes everything;
         later those that nobody needs are left with nothing
         r_c ∝ exp(−Σ_t ‖a_t − μ_c(s_t)‖² / 2σ²),   L^E = E Σ_c r_c ‖a_t − μ_c(s_t)‖²
    L^Q  who drives, given a state and the return: a categorical q(c | s, y), from which an episode's driver is drawn
    L^F  a rectified flow from noise to the joint action, given the driver c ~ r (Lipman et al. 2023; Liu et al. 2023)
         a_τ = (1 − τ) ε + τ a,   L^F = E ‖a − â(a_τ, τ, s, c, y)‖²

    L^C  once drivers are found, the actions drawn keep a World's danger at its margin, weighed by λ (`barrier_weight`):
         L^C = λ E Σ_i [1 − min(ℓ_i(s, ŝ'), V_i(ŝ'))]_+ in calibrated margins, ŝ' = f_φ(s, â)

The network answers with the clean action, from which the velocity (â − a_τ)/(1 − τ) follows; one step from noise is the
driver's mean. That is the behaviour flow of flow Q-learning (Park et al. 2025), for teams and given who drives. The
return y is optional, dropped with probability p for classifier-free guidance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp

from ringfence.algos import actor_critic as ac
from ringfence.algos import drivers
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData
from ringfence.nets.layers import ResidualMLP
from ringfence.nets.optim import Optimiser, fresh, stepped
from ringfence.problem import features
from ringfence.problem.constraints import BoundHazard
from ringfence.proposals import conditions
from ringfence.proposals.flow import WAVES, FlowPolicy, clean_action
from ringfence.proposals.guidance import short_of_margin
from ringfence.types import Algorithm, Array, Batch, Key, Metrics, PyTree, Spec
from ringfence.utils.config import (
    AtLeastOne,
    BatchSize,
    Count,
    Depth,
    Natural,
    NonNegative,
    Positive,
    Rows,
    Share,
    Width,
)
from ringfence.world import World


@dataclass(frozen=True)
class Config:
    """Every choice, one line each."""

    view: features.View = "pruned"  # what s̃_i is; everybody's is read at once
    history: Natural = 8  # rows before the present that tell who drives
    horizon: Rows = 9  # rows from the present on that do
    drivers: AtLeastOne = 8  # C; more than there are costs little, fewer mixes some
    sigma_first: Positive = 0.5  # σ of the shares at the first update, in units of action
    sigma: Positive = 0.15  # and when `settled`
    settled: Share = 0.3  # of training: σ falls until then, and drivers are used equally
    condition: Literal["none", "return", "raw", "advantage"] = "none"  # what y is
    condition_dropout: Share = 0.25  # p, share of windows that are not given y
    discount: Share = 0.9  # of what y scores
    barrier_weight: NonNegative = 0.0  # λ of danger, as a World knows it; 0: no World is read
    width: Width = 384  # units of each hidden layer, of either network
    depth: Depth = 3  # hidden layers
    num_updates: Count = 10_000  # updates
    batch: BatchSize = 32  # windows per update
    lr: Positive = 1e-3  # Adam, after warm-up, before cosine decay to a tenth
    warmup: Natural = 100  # updates
    grad_clip: NonNegative = 1.0  # global norm, per network; 0: no bound
    ema: Share = 0.998  # of the parameters; the policy uses the averages


def init(
    key: Key,
    spec: Spec,
    config: Config,
    data: WindowData | None,
    feature_map: features.FeatureMap,
    hazard: BoundHazard,
    world: World | None = None,
) -> PyTree:
    """Parameters, their averages, optimiser state, the normaliser; without data, zeros stand for its statistics."""
    kc, kf, kp, kw = jax.random.split(key, 4)
    seen = spec.n_agents * spec.feature_dim
    acts = spec.n_agents * spec.action_dim
    inputs = seen + acts + 2 * WAVES + config.drivers + 2

    def networks() -> dict:
        params = drivers.networks(kc, kp, config.drivers, seen, acts, config.width, config.depth)
        params["flow"] = ResidualMLP(kf, inputs, acts, config.width, config.depth, 0.1)
        return fresh(Optimiser.of(config), params, "ema")

    state = jax.jit(networks)() | {"frozen": {"normaliser": ac.fit_states(data, spec, kw)}}
    return state | ({"world": from_world(world, config)} if follows(config) and world is not None else {})


def follows(config: Config) -> bool:
    """Whether the flow keeps away from what a World calls dangerous."""
    return config.barrier_weight > 0


def from_world(world: World, config: Config) -> PyTree:
    """What actions do and what is dangerous, where the flow keeps away from it."""
    if not follows(config):
        return {}
    return {"dynamics": world.dynamics, "barrier": world.barrier, "ood_threshold": world.ood_threshold}


def world_settings(config: Config) -> dict | None:
    """The World that training reads: for an advantage its values, for its danger all of it."""
    if follows(config):
        return {"view": config.view, "discount": config.discount}
    return conditions.world_settings(config)


def check(config: Config, hazard: BoundHazard) -> None:
    """Refuse settings that cannot work, before anything is computed."""
    drivers.check(config.drivers, config.batch)


def make_windows(
    store: EpisodeStore, config: Config, feature_map: features.FeatureMap, world: World | None
) -> WindowData:
    """Windows, with their scores where the flow is given those."""
    if config.condition == "none":
        return WindowData(store, feature_map)
    return conditions.scored_windows(store, feature_map, world, config.condition, config.horizon, config.discount)


def search(config: Config) -> drivers.Search:
    return drivers.Search(config.drivers, config.num_updates, config.sigma_first, config.sigma, config.settled)


def make_loss(config: Config):
    """loss(params, normaliser, batch, step, key, world) -> (L^E + L^F + L^Q + λ L^C, metrics)."""

    def loss(params: PyTree, normaliser, batch: Batch, step: Array, key: Key, world: PyTree) -> tuple[Array, Metrics]:
        k_driver, k_noise, k_time, k_keep = jax.random.split(key, 4)
        windows, steps = batch.actions.shape[:2]
        kept = jax.random.bernoulli(k_keep, 1.0 - config.condition_dropout, (windows,)) & (config.condition != "none")
        whose = drivers.driven(search(config), params, normaliser, batch, kept, step, k_driver)
        there = drivers.steps_there(batch)
        seen = normaliser.state(batch.features[:, :-1]).reshape(windows * steps, -1)
        actions = batch.actions.reshape(windows * steps, -1)
        which = jnp.repeat(jax.nn.one_hot(whose.driver, config.drivers), steps, 0)
        score = jnp.repeat(batch.score, steps)
        noise = jax.random.normal(k_noise, actions.shape)
        tau = jax.random.uniform(k_time, (windows * steps,))
        noised = (1.0 - tau)[:, None] * noise + tau[:, None] * actions
        clean = clean_action(params["flow"], seen, noised, tau, which, score, jnp.repeat(kept, steps))
        flow_loss = (((clean - actions) ** 2).sum(-1) * there.reshape(-1)).sum() / jnp.maximum(there.sum(), 1)

        metrics = {**whose.metrics, "loss/flow": flow_loss}
        total = whose.loss + flow_loss
        if follows(config):
            present = batch.features[:, :-1].reshape(windows * steps, *batch.features.shape[2:])
            taken = clean.reshape(windows * steps, *batch.actions.shape[2:])
            short = -short_of_margin(**world, present=present, action=taken) * there.reshape(-1)
            metrics["loss/danger"] = short.sum() / jnp.maximum(there.sum(), 1)
            settled = step >= config.settled * config.num_updates
            total = total + config.barrier_weight * settled * metrics["loss/danger"]
        return total, metrics

    return loss


def make_update(config: Config, spec: Spec, feature_map: features.FeatureMap, hazard: BoundHazard):
    """update(state, batch, key) -> state, metrics; pure, one Adam step on both networks."""
    loss, opt = make_loss(config), Optimiser.of(config)

    def update(state: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
        normaliser = state["frozen"]["normaliser"]
        world = state.get("world")
        grads, metrics = jax.grad(loss, has_aux=True)(state["params"], normaliser, batch, state["step"], key, world)
        state, norms = stepped(state, grads, opt, config.ema)
        return state, metrics | norms

    return update


def make_policy(state: PyTree, config: Config, spec: Spec, feature_map, hazard: BoundHazard, options) -> FlowPolicy:
    """The flow on the averaged parameters; `options` are the evaluation-time choices."""
    return FlowPolicy(
        networks={name: state["ema"][name] for name in ("flow", "prior")},
        normaliser=state["frozen"]["normaliser"],
        drivers=config.drivers,
        conditioned=config.condition != "none",
        spec=spec,
        feature_map=feature_map,
        options=options,
    )


FLOW = Algorithm(
    "flow",
    Config,
    check,
    init,
    make_update,
    ac.no_diagnosis,
    make_policy,
    {
        "default": {},
        "return": {"condition": "return"},
        "mujoco": {"condition": "return", "num_updates": 4_000},  # a robot's logs are of better and worse policies
    },
    cost_source=lambda config: "world" if follows(config) else "nothing",
    make_windows=make_windows,
    world_settings=world_settings,
    from_world=from_world,
)
