"""A multi-agent FISOR: the largest feasible set from logs, then feasibility-weighted cloning (Zheng et al. 2024).

Every agent learns for itself, from its own observation, its own reward and its own danger h_i (25 unsafe, −1 safe):

    Q^h_i = (1−γ) h_i + γ max(h_i, V^h_i(s̃'))     V^h_i: lower expectile of Q^h_i, its least over logged actions;
                                                  {V^h_i ≤ 0} is where some logged action keeps the agent safe
    Q^r_i = r_i + γ V^r_i(s̃')                     V^r_i: upper expectile of Q^r_i (Kostrikov et al. 2022)
    L_π   = E w_i ‖a_i − â_i(a_i^k, k, s̃_i)‖²     w_i = exp(β_r A^r_i) [Q^h_i ≤ 0] where feasible, else exp(−β_h A^h_i)

The actor is a diffusion model over one agent's action. At run time it proposes several and the one with the least
Q^h_i is taken. Differences from the single-agent original: decentralised values, x̂0- instead of ε-prediction,
rewards scaled by their deviation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from msgspec import Meta

from ringfence.algos import actor_critic as ac
from ringfence.errors import UserError
from ringfence.logs.windows import WindowData
from ringfence.nets import MLP
from ringfence.nets.layers import sinusoidal
from ringfence.nets.optim import Optimiser, follow
from ringfence.problem import features
from ringfence.problem.constraints import BoundHazard
from ringfence.problem.normalise import Normaliser
from ringfence.proposals import diffusion
from ringfence.proposals.base import from_unit
from ringfence.types import Algorithm, Array, Batch, Key, Metrics, PolicyStep, PyTree, Spec
from ringfence.utils.config import AtLeastOne, BatchSize, Count, Natural, NonNegative, Positive, Rows, Share, Width

DANGER = 25.0  # h of an unsafe state; a safe one has −1
LEVEL_WIDTH = 16  # entries of the embedding of k
WEIGHT_MAX = 100.0  # bound on w
Expectile = Annotated[float, Meta(ge=0.5, lt=1, description="lie in [0.5, 1); FISOR uses 0.9")]


@dataclass(frozen=True)
class Config:
    """FISOR's values where it prints them; sizes and updates are for a CPU."""

    view: features.View = "decentralized"  # what an agent sees: its own observation
    horizon: Rows = 2  # rows of a window: now and next
    history: Natural = 0  # rows of the past; none is read
    discount: Share = 0.99  # γ
    expectile_reward: Expectile = 0.9  # of Q^r that V^r follows
    expectile_danger: Expectile = 0.9  # of −Q^h that −V^h follows
    temperature_reward: NonNegative = 3.0  # β_r
    temperature_danger: NonNegative = 5.0  # β_h
    diffusion_steps: Width = 5  # K of the actor
    candidates: AtLeastOne = 16  # actions proposed per agent and step
    target_rate: Share = 0.005  # τ
    width: Width = 64  # units of both hidden layers
    num_updates: Count = 5_000  # updates
    batch: BatchSize = 512  # transitions per update
    lr: Positive = 1e-3  # Adam, cosine decay to a tenth
    warmup: Natural = 100  # updates
    grad_clip: NonNegative = 1.0  # global norm, per network; 0: no bound


def check(config: Config, hazard: BoundHazard) -> None:
    """Refuse settings that cannot work, before anything is computed."""
    if config.history or config.horizon != 2:
        raise UserError("fisor learns from single transitions; leave history=0 and horizon=2.")
    diffusion.cosine_schedule(config.diffusion_steps)


def init(
    key: Key,
    spec: Spec,
    config: Config,
    data: WindowData | None,
    feature_map: features.FeatureMap,
    hazard: BoundHazard,
) -> PyTree:
    """Values, critics, actors, target critics, optimiser state, the normaliser and the scale of rewards."""
    kr, kh, kv, kw, ka, kn = jax.random.split(key, 6)
    n = spec.n_agents
    d = spec.feature_dim
    a = spec.action_dim

    def networks() -> dict:
        value = lambda k: MLP(k, (d, config.width, config.width, 1), groups=n)  # noqa: E731
        return {
            "reward": ac.Critics(kr, n, 2, d, a, config.width),
            "danger": ac.Critics(kh, n, 2, d, a, config.width),
            "reward_value": value(kv),
            "danger_value": value(kw),
            "actor": MLP(ka, (d + a + LEVEL_WIDTH, config.width, config.width, a), groups=n),
        }

    scale = 1.0 if data is None else float(jnp.maximum(data.arrays["rewards"].std(), 1e-6))
    frozen = {"normaliser": ac.fit_states(data, spec, kn), "reward_scale": jnp.float32(scale)}
    return ac.start(networks, ("reward", "danger", "actor"), Optimiser.of(config), frozen)


def expectile(error: Array, tau: float) -> Array:
    """Asymmetric squared error: positive ones count τ, negative ones 1 − τ."""
    return jnp.where(error > 0, tau, 1.0 - tau) * error**2


def proposed(actor: MLP, x: Array, noisy: Array, k: Array) -> Array:
    """â (B, N, A) in [−1, 1] coordinates from standardised states, noisy actions and diffusion steps k (B,)."""
    level = jnp.broadcast_to(sinusoidal(k * 100.0, LEVEL_WIDTH)[:, None], (*x.shape[:2], LEVEL_WIDTH))
    return actor(jnp.concatenate([x, noisy, level], -1))


def danger_of(hazard: BoundHazard, batch: Batch) -> Array:
    """h (N, B) of the states that the steps lead to."""
    unsafe, _ = hazard.labels(batch.features[:, 1], batch.costs[:, 1])
    return jnp.where(unsafe, DANGER, -1.0).T


def make_update(config: Config, spec: Spec, feature_map: features.FeatureMap, hazard: BoundHazard):
    """update(state, batch, key) -> state, metrics; one Adam step on every network."""
    opt = Optimiser.of(config)
    alpha_bar = diffusion.cosine_schedule(config.diffusion_steps)

    def update(state: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
        frozen = state["frozen"]
        target = state["target"]
        t = ac.transitions(batch, frozen["normaliser"])
        danger = danger_of(hazard, batch)
        q_reward = target["reward"](t.x, t.action).min(1)
        q_danger = target["danger"](t.x, t.action).max(1)
        alive = t.bootstrap.T

        def loss(p: PyTree) -> tuple[Array, Metrics]:
            value = lambda name, x: p[name](x)[..., 0].T  # noqa: E731  (N, B)
            v_reward = value("reward_value", t.x)
            v_danger = value("danger_value", t.x)
            ahead_reward = jax.lax.stop_gradient(value("reward_value", t.ahead))
            ahead_danger = jax.lax.stop_gradient(value("danger_value", t.ahead))
            ahead_danger = jnp.where(alive > 0, ahead_danger, danger)  # a terminal state stays what it is
            goal_reward = t.reward.T / frozen["reward_scale"] + config.discount * alive * ahead_reward
            goal_danger = (1 - config.discount) * danger + config.discount * jnp.maximum(danger, ahead_danger)
            losses = {
                "loss/reward_value": expectile(q_reward - v_reward, config.expectile_reward).mean(1).sum(),
                "loss/danger_value": expectile(v_danger - q_danger, config.expectile_danger).mean(1).sum(),
                "loss/reward": ((p["reward"](t.x, t.action) - goal_reward[:, None]) ** 2).mean(2).sum(),
                "loss/danger": ((p["danger"](t.x, t.action) - goal_danger[:, None]) ** 2).mean(2).sum(),
            }
            feasible = v_danger <= 0
            better = jnp.exp(config.temperature_reward * (q_reward - v_reward)) * (q_danger <= 0)
            safer = jnp.exp(-config.temperature_danger * (q_danger - v_danger))
            weight = jax.lax.stop_gradient(jnp.minimum(jnp.where(feasible, better, safer), WEIGHT_MAX)).T
            noised = diffusion.add_noise(t.action, jnp.zeros(t.action.shape, bool), jnp.asarray(alpha_bar), key)
            error = ((proposed(p["actor"], t.x, noised.x, noised.k) - t.action) ** 2).sum(-1)
            losses["loss/actor"] = (weight * error).mean(0).sum()
            more = {"feasible": feasible.mean(), "weight": weight.mean(), "error": error.mean()}
            return sum(losses.values(), jnp.zeros(())), losses | more

        grads, metrics = jax.grad(loss, has_aux=True)(state["params"])
        params, moments, norms = opt.update(grads, state["opt"], state["params"])
        state = {
            **state,
            "params": params,
            "target": follow(target, {k: params[k] for k in target}, config.target_rate),
            "opt": moments,
            "step": state["step"] + 1,
        }
        return state, metrics | norms

    return update


class Proposer(eqx.Module):
    """Draws actions per agent and takes the one that its danger critics find least dangerous."""

    actor: MLP
    danger: ac.Critics
    normaliser: Normaliser
    spec: Spec = eqx.field(static=True)
    feature_map: features.FeatureMap = eqx.field(static=True)
    alpha_bar: tuple[float, ...] = eqx.field(static=True)
    candidates: int = eqx.field(static=True)

    def initial_state(self, batch: int) -> PyTree:
        return {}

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        """observations (B, N, O) -> joint action (B, N, A)."""
        x = self.normaliser.state(self.feature_map(observations, state))
        (b, n, _), s = x.shape, self.candidates
        states = jnp.repeat(x, s, 0)

        def predict(noisy: Array, k: Array) -> Array:
            return jnp.clip(proposed(self.actor, states, noisy, k), -1.0, 1.0)

        bar = np.asarray(self.alpha_bar)
        shape = (b * s, n, self.spec.action_dim)
        drawn = diffusion.sample(predict, lambda z: z, shape, bar, key, len(bar), "ddpm")
        actions = jnp.moveaxis(jnp.clip(drawn, -1.0, 1.0).reshape(b, s, n, -1), 1, 2)  # (B, N, S, A)
        q = jnp.moveaxis(self.danger(x, actions).max(1), 0, 1)  # (B, N, S)
        best = jnp.take_along_axis(actions, q.argmin(-1)[..., None, None], 2)[:, :, 0]
        return carry, PolicyStep(from_unit(best, self.spec), {})


def make_policy(state: PyTree, config: Config, spec: Spec, feature_map, hazard, options=None) -> Proposer:
    """The averaged actors and danger critics."""
    target = state["target"]
    bar = diffusion.cosine_schedule(config.diffusion_steps)
    norm = state["frozen"]["normaliser"]
    return Proposer(target["actor"], target["danger"], norm, spec, feature_map, tuple(bar.tolist()), config.candidates)


_MUJOCO = {"width": 128, "batch": 256, "num_updates": 10_000}
FISOR = Algorithm(
    "fisor", Config, check, init, make_update, ac.no_diagnosis, make_policy, {"default": {}, "mujoco": _MUJOCO}
)
