"""MA-TD3+BC: TD3 per agent whose actors also imitate (Fujimoto & Gu 2021), and its safe version with a cost critic.

    L_Q  = Σ_heads E (Q_i(s̃, a) − (r_i + γ min_heads Q̄_i(s̃', π̄_i(s̃'))))²
    L_π  = E −w Q_i(s̃, π_i(s̃)) + ‖π_i(s̃) − a_i‖²,   w = α / E|Q_i|

`ma-td3bc-lag` adds cost critics C_i ≥ 0, which learn the shared cost in the same way, and a multiplier λ ≥ 0:

    L_π  = E −α (Q_i/E|Q_i| − λ C_i/max(E|C_i|, d))/(1 + λ) + ‖π_i − a_i‖²,   λ ← [λ + η (E' C_i(s̃, π(s̃))/d − 1)]₊

with d the discounted form of the limit per episode, l (1 − γ^T) / ((1 − γ) T). Both values are divided by their own
size: a return of hundreds would otherwise drown a cost of one, whatever λ. A cost below what is allowed is divided by
that instead, so the penalty fades as the limit is met and λ has a level to settle at. E' is over logged states in
which nothing was charged: those of a log that breaks the limit throughout are not where a policy that keeps it goes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.algos import actor_critic as ac
from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore, team
from ringfence.logs.windows import NOT_ARRIVED, WindowData
from ringfence.nets.optim import Optimiser, follow
from ringfence.problem import features
from ringfence.problem.constraints import BoundHazard
from ringfence.types import Algorithm, Array, Batch, Key, Metrics, PyTree, Spec
from ringfence.utils.config import AtLeastOne, BatchSize, Count, Natural, NonNegative, Positive, Rows, Share, Width


@dataclass(frozen=True)
class Config:
    """The learner of OMAR's study (networks, γ, τ, rates) with TD3+BC's actor."""

    view: features.View = "decentralized"  # what an agent sees: its own observation
    horizon: Rows = 2  # rows of a window: now and next
    history: Natural = 0  # rows of the past; none is read
    centralised_critic: bool = False  # critics read everybody's observations and actions
    alpha: NonNegative = 2.5  # α, weight of Q against imitation (TD3+BC)
    discount: Share = 0.95  # γ
    target_rate: Share = 0.01  # τ
    target_noise: NonNegative = 0.0  # deviation of the noise on target actions; TD3 has 0.2, OMAR's study none
    target_noise_clip: NonNegative = 0.5  # bound on that noise
    delay: AtLeastOne = 1  # actors and targets move every so many updates; TD3 has 2, OMAR's study 1
    action_penalty: NonNegative = 1e-3  # weight of E π²
    width: Width = 64  # units of both hidden layers
    lagrange: bool = False  # learn cost critics and a multiplier
    limit: float = 1.0  # l, cost per episode that the multiplier allows
    multiplier_rate: NonNegative = 0.01  # η
    multiplier_max: NonNegative = 100.0  # bound on λ
    num_updates: Count = 2_000  # updates
    batch: BatchSize = 1024  # transitions per update
    lr: Positive = 0.01  # Adam, constant
    grad_clip: NonNegative = 0.5  # global norm, per network; 0: no bound


def check(config: Config, hazard: BoundHazard) -> None:
    """Refuse settings that cannot work, before anything is computed."""
    if config.history or config.horizon != 2:
        raise UserError("ma-td3bc learns from single transitions; leave history=0 and horizon=2.")
    if config.limit <= 0:
        raise UserError(
            f"limit={config.limit} must be positive; it is a cost per episode, that of the data's card (cost_limit) "
            "unless another is set: --set limit=1."
        )


def cost_source(config: Config) -> Literal["costs", "nothing"]:
    """What cost critics learn from, if there are any."""
    return "costs" if config.lagrange else "nothing"


def make_windows(store: EpisodeStore, config: Config, feature_map: features.FeatureMap, world: None) -> WindowData:
    """All episodes. Where the logs name several constraints and the limit is the card's, a step costs what it takes of
    the limit of the constraint that it takes most of: who keeps `limit` in this cost keeps each of theirs."""
    windows = WindowData(store, feature_map)
    if config.lagrange and store.limits and config.limit == store.card.cost_limit:
        shares = np.max([share_of_limit(store, name) for name in store.limits], 0)
        starts = np.concatenate([[0], store.episode_ends[:-1]])
        costs = np.insert(config.limit * shares, starts, NOT_ARRIVED)
        windows.arrays["costs"] = jnp.asarray(costs, jnp.float32)
    return windows


def share_of_limit(store: EpisodeStore, name: str) -> np.ndarray:
    """(T,) what every step takes of a constraint's limit; where nothing is allowed, any cost is over it."""
    cost = team(store.of_constraint(name)).astype(np.float64)
    limit = store.limits[name]
    if limit > 0:
        return cost / limit
    return 2.0 * cost / (cost[cost > 0].min() if (cost > 0).any() else 1.0)


def cost_unit(config: Config, spec: Spec) -> float:
    """What cost critics count in: the limit, so that the unit of somebody's own costs changes nothing. Tasks of the
    package count steps, as their published settings do."""
    return 1.0 if spec.task in registry.TASKS else config.limit


def init(
    key: Key,
    spec: Spec,
    config: Config,
    data: WindowData | None,
    feature_map: features.FeatureMap,
    hazard: BoundHazard,
) -> PyTree:
    """Actors, twin critics, their targets, optimiser state and the normaliser."""
    ka, kq, kc, kw = jax.random.split(key, 4)
    n = spec.n_agents
    d = spec.feature_dim
    a = spec.action_dim
    sizes = (n, 2, n * d, n * a) if config.centralised_critic else (n, 2, d, a)

    def networks() -> dict:
        params = {"actor": ac.make_actor(ka, spec, config.width), "critic": ac.Critics(kq, *sizes, config.width)}
        if config.lagrange:
            params["cost"] = ac.Critics(kc, *sizes, config.width)
        return params

    targets = ("actor", "critic", "cost") if config.lagrange else ("actor", "critic")
    state = ac.start(networks, targets, Optimiser.of(config, floor=1.0), {"normaliser": ac.fit_states(data, spec, kw)})
    return state | {"multiplier": jnp.zeros(spec.n_agents)}


def threshold(config: Config, spec: Spec) -> float:
    """d: what a discounted cost value may be if `limit` is spread evenly over an episode."""
    g = config.discount
    t = spec.episode_length
    if g == 1:  # Σ γ^t / T is then 1
        return config.limit
    return config.limit * (1 - g**t) / ((1 - g) * t)


def smoothed(action: Array, key: Key, config: Config) -> Array:
    """Target actions with TD3's bounded noise."""
    if config.target_noise <= 0:
        return action
    bound = config.target_noise_clip
    noise = jnp.clip(config.target_noise * jax.random.normal(key, action.shape), -bound, bound)
    return jnp.clip(action + noise, -1.0, 1.0)


def make_actor_slope(config: Config, spec: Spec, allowed: float):
    """slope(actor, critics, t, batch, λ (N,)) -> the gradient of L_π, (metrics, by how much the cost passes
    `allowed` (N,), as a share of it)."""

    def actor_loss(
        actor, critics: PyTree, t: ac.Transitions, batch: Batch, scale: Array
    ) -> tuple[Array, tuple[Metrics, Array]]:
        own = ac.act(actor, t.x)
        x = t.x
        if config.centralised_critic:
            x = ac.joint(t.x)
            acted = ac.joint_actions(t.action, own)
        else:
            acted = own
        q = critics["critic"].first(spec.n_agents)(x, acted)[:, 0]  # (N, B)
        size = lambda v: jax.lax.stop_gradient(jnp.abs(v).mean(1, keepdims=True))  # noqa: E731
        merit = q / size(q)
        excess = jnp.zeros(spec.n_agents)
        if config.lagrange:
            c = jax.nn.relu(critics["cost"](x, acted).max(1))  # (N, B)
            merit = (merit - scale[:, None] * c / jnp.maximum(size(c), allowed)) / (1.0 + scale[:, None])
            calm = batch.costs[:, 0] <= 0  # a first state was not arrived in, so nothing was charged there
            excess = jnp.where(calm, c / allowed - 1.0, 0.0).sum(1) / jnp.maximum(calm.sum(), 1)
        imitation = ((own - t.action) ** 2).mean((0, 2)).sum()
        penalty = (own**2).mean((0, 2)).sum()
        loss = imitation - config.alpha * merit.mean(1).sum() + config.action_penalty * penalty
        return loss, ({"loss/actor": loss, "loss/cloning": imitation, "value": q.mean()}, excess)

    return jax.grad(actor_loss, has_aux=True)


def make_update(config: Config, spec: Spec, feature_map: features.FeatureMap, hazard: BoundHazard):
    """update(state, batch, key) -> state, metrics: critics, then actors, then targets and multiplier."""
    opt = Optimiser.of(config, floor=1.0)
    unit = cost_unit(config, spec)
    allowed = threshold(config, spec) / unit
    actor_slope = make_actor_slope(config, spec, allowed)

    def critic_inputs(x: Array, action: Array) -> tuple[Array, Array]:
        return (ac.joint(x), ac.joint(action)) if config.centralised_critic else (x, action)

    def update(state: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
        t = ac.transitions(batch, state["frozen"]["normaliser"])
        params = state["params"]
        target = state["target"]
        next_action = smoothed(ac.act(target["actor"], t.ahead), key, config)
        here = critic_inputs(t.x, t.action)
        there = critic_inputs(t.ahead, next_action)
        goal = t.reward.T + config.discount * t.bootstrap.T * target["critic"](*there).min(1)

        def critic_loss(p: PyTree) -> tuple[Array, Metrics]:
            error = ((p["critic"](*here) - goal[:, None]) ** 2).mean(2).sum()
            metrics = {"loss/critic": error}
            if config.lagrange:
                later = jax.nn.relu(target["cost"](*there).max(1))
                cost = batch.costs[:, 1][None] / unit + config.discount * t.bootstrap.T * later
                metrics["loss/cost"] = ((p["cost"](*here) - cost[:, None]) ** 2).mean(2).sum()
            return sum(metrics.values(), jnp.zeros(())), metrics

        critics = {k: v for k, v in params.items() if k != "actor"}
        grads, metrics = jax.grad(critic_loss, has_aux=True)(critics)
        critics, moments, norms = opt.update(grads, state["opt"], critics)
        scale = state["multiplier"]
        slope, (more, excess) = actor_slope(params["actor"], critics, t, batch, scale)
        actor, actor_moments, actor_norms = opt.update({"actor": slope}, state["opt"], {"actor": params["actor"]})
        new = {"actor": actor["actor"], **critics}
        moved = follow(target, {k: new[k] for k in target}, config.target_rate)
        opts = {"actor": actor_moments["actor"], **moments}
        if config.delay > 1:  # in between, actors and targets stay where they are
            go = state["step"] % config.delay == 0
            keep = lambda a, b: jax.tree.map(lambda x, y: jnp.where(go, x, y), a, b)  # noqa: E731
            new["actor"], moved = keep(new["actor"], params["actor"]), keep(moved, target)
            opts["actor"] = keep(opts["actor"], state["opt"]["actor"])
        if config.lagrange:
            scale = jnp.clip(scale + config.multiplier_rate * excess, 0.0, config.multiplier_max)
            more |= {"multiplier": scale.mean(), "cost_value": (unit * allowed * (excess + 1.0)).mean()}
        state = {**state, "params": new, "target": moved, "opt": opts, "step": state["step"] + 1, "multiplier": scale}
        return state, metrics | more | norms | actor_norms

    return update


# TD3+BC's own values (Fujimoto & Gu 2021), but for layers, rate and updates, which are for a CPU; Safety-Gymnasium's
# cost limit.
_MUJOCO = {
    "width": 128,
    "batch": 256,
    "lr": 1e-3,
    "discount": 0.99,
    "target_rate": 0.005,
    "delay": 2,
    "target_noise": 0.2,
    "action_penalty": 0.0,
    "limit": 25.0,
    "num_updates": 10_000,
}
MA_TD3BC = Algorithm(
    "ma-td3bc",
    Config,
    check,
    init,
    make_update,
    ac.no_diagnosis,
    ac.make_policy,
    {
        "default": {},
        "centralised": {"centralised_critic": True},
        "random": {"num_updates": 6_000},
        "mujoco": _MUJOCO,
        "mujoco-long": {**_MUJOCO, "num_updates": 40_000},  # ant_2x4-good: 3.1 k, published 2.9 k; 1.1 k before
    },
    cost_source=cost_source,
    make_windows=make_windows,
)
MA_TD3BC_LAG = replace(
    MA_TD3BC,
    name="ma-td3bc-lag",
    # 1: costs could be negative, the penalty had the same size at the limit as far above it, λ was read on all states
    revision=2,
    presets={
        name: {"lagrange": True, "multiplier_max": 10.0, **MA_TD3BC.presets[name]}
        for name in ("default", "random", "mujoco")
    },
    limit="limit",
)
