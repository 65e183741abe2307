"""ICBF-Diffuser: a multi-agent diffusion planner shaped by one control barrier function per agent.

Losses, each with the paper's symbol:
    L^D  denoising of joint plans, conditioned on return, dropped with probability p          (paper, eq. 6)
    L^M  the mean plan that noise is diffused around                                          (nets/team.py)
    L^C  the generator follows the World's barrier by λ (`split`), or as printed (algos/algorithm1.py)      (eq. 8)
    L^P  inverse dynamics per agent: the action between two successive states                 (paper, eq. 10)
    L^E, L^Q  who drives; a plan is of one driver                                             (algos/drivers.py)

By default λ = 0, and a World guides the sampling instead (proposals/guidance.py). With `barrier = False` there is
no barrier at all, and the method is MADIFF (Zhu et al. 2024).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.algos import drivers
from ringfence.algos.algorithm1 import make_printed_update
from ringfence.errors import UserError
from ringfence.logs.windows import WindowData, at
from ringfence.nets import MLP, build_denoiser, unet
from ringfence.nets.agent_attention import HEADS
from ringfence.nets.layers import infer_action
from ringfence.nets.optim import Optimiser, fresh, stepped
from ringfence.nets.team import MeanPlan, planning_as
from ringfence.problem import features, normalise
from ringfence.problem.constraints import BoundHazard
from ringfence.proposals import conditions, diffusion
from ringfence.proposals import retention as cbf
from ringfence.proposals.planner import Generator, Planner, generator
from ringfence.types import Algorithm, Array, Batch, Key, Metrics, PyTree, Spec
from ringfence.utils.config import BatchSize, Count, Depth, Natural, NonNegative, Positive, Rows, Share, Width
from ringfence.world import World
from ringfence.world.barrier import Barrier


@dataclass(frozen=True)
class Config:
    """Every choice of the method, one line each; `docs/method.md` says where each default comes from."""

    # --- plan ---
    view: features.View = "pruned"  # what s̃_i is: pruned, centralized, decentralized
    horizon: Rows = 8  # H, rows of a plan, the present one included
    history: Natural = 0  # rows of the past that are in-painted, too
    carry: Literal["own", "all"] = "own"  # entries of s̃_i that are diffused; own: the rest follows from everybody's own
    coordinates: normalise.Coordinates = "displacement"  # of plans: displacement from the present, or state
    condition: conditions.Condition = "return"  # y: the return-to-go or the window's advantage, ranked; or raw return
    discount: Share = 0.9  # of the value that plans are conditioned on and ranked by
    observe: Literal["all", "single", "mixed"] = "all"  # agents whose present is in-painted; single: decentralised

    # --- denoiser ---
    net: Literal["residual", "attention", "unet"] = "residual"  # of the whole team, of agents, MADIFF's temporal U-Net
    width: Width = 384  # units
    depth: Depth = 3  # blocks (attention), hidden layers (residual) or resolutions (unet)
    distinguish_agents: bool = False  # attention learns a vector of each agent; of limbs of one body it does anyway
    drivers: Natural | None = None  # that the logs are searched for; a plan is of one of them. 0: for nobody; None: 8,
    # or 0 where a plan is not of the whole team, or its net cannot be told
    clone_width: Width = 192  # units of the joint clones that share the logs
    clone_depth: Depth = 2  # their hidden layers
    around: Literal["mean", "nothing"] = "mean"  # what noise is diffused around: a learned mean plan, or the origin
    noisy_input: Literal["signal", "unit"] = "signal"  # the network is shown noisy entries × √ᾱ_k, or as they are
    diffusion_steps: Width = 200  # K, cosine schedule
    prediction: diffusion.Prediction = "x0"  # what the network outputs: x0, epsilon, v
    error: Literal["output", "noise"] = "output"  # L^D's: of what the network outputs, or of the noise that follows (6)
    snr_floor: NonNegative = 1.0  # x0-prediction: least weight of a noise level
    snr_ceiling: NonNegative = 1.0  # x0-prediction: largest weight of a noise level
    clip: Positive = 5.0  # bound on clean estimates, in standard deviations
    condition_dropout: Share = 0.25  # p, share of plans that do not see the return

    # --- barrier ---
    barrier: bool = True  # L^C and guidance at all
    guided: bool = True  # a World guides the sampling, unless it is played otherwise; of `split`
    barrier_weight: NonNegative = 0.0  # λ of the generator's share of L^C
    barrier_start: Share = 0.3  # share of training at which λ starts to rise from 0
    barrier_full: Share = 0.5  # share of training at which λ is reached
    routing: Literal["split", "paper"] = "split"  # the World's barrier pulls the generator, or Algorithm 1 as printed
    delta: NonNegative = 1.0  # δ, margin of the hinges; of the World's barrier in calibrated margins
    retention: Share = 0.9  # m, largest share of h that must be kept from step to step
    relaxation: cbf.Relaxation = "signal"  # how retention is relaxed at noisy levels
    two_sided: bool = True  # relax the unsafe side towards "do not get worse"
    scaled_margin: bool = True  # margin (1−α)δ in the retention hinge instead of δ
    weigh_by_signal: bool = True  # weight ᾱ_k on the generator's hinges
    gradient: str = "x0"  # depth of ∂s̃^θ/∂θ: x0, ddim:n (whole n-step sample) or chain:n (n steps from x_k)
    gradient_batch: Count = 32  # windows per update for ddim:n and chain:n
    barrier_batch: Count = 64  # windows per update that L^C works on
    scope: Literal["individual", "shared"] = "individual"  # joint training: one h per agent, or one for all
    barrier_width: Width = 128  # joint training: units of each of h's 3 hidden layers

    # --- inverse dynamics ---
    inverse_width: Width = 128  # units of each of 2 hidden layers
    inverse_noise: NonNegative = 0.05  # noise on the standardised step that inverse dynamics reads, as plans have some

    # --- optimisation ---
    num_updates: Count = 2500  # updates
    batch: BatchSize = 128  # windows per update
    lr: Positive = 2e-3  # Adam, after warm-up, before cosine decay to a tenth
    warmup: Natural = 100  # updates
    grad_clip: NonNegative = 1.0  # global norm, per network; 0: no bound
    ema: Share = 0.995  # of all parameters; the policy uses the averages

    @property
    def searched(self) -> int:
        """How many drivers the logs are searched for."""
        if self.drivers is not None:
            return self.drivers
        return DRIVERS if self.net != "unet" and self.observe == "all" else 0

    @property
    def guides(self) -> bool:
        """Whether a World guides the sampling where nothing else is asked for."""
        return self.guided and self.barrier and self.routing == "split"

    @property
    def window_history(self) -> int:
        """Rows of the past that training draws: those of a plan, and before them those that tell who drives."""
        return self.history + (DRIVER_HISTORY if self.searched else 0)


DRIVERS = 8  # that are searched for: more than there are cost little, fewer mix some
DRIVER_HISTORY = 8  # rows before a plan's own that tell whose it is; seven steps alone tell too little
INVERSE_STEPS = 3  # steps of every window that inverse dynamics learns from


# Algorithm 1 as printed: the error is of the noise, s̃^θ is drawn by ancestral steps with gradients, and (8) as it
# stands.
_PRINTED = {
    "routing": "paper",
    "prediction": "v",
    "error": "noise",
    "noisy_input": "unit",
    "gradient": "chain:5",
    "barrier_weight": 1.0,
    "delta": 0.02,
    "two_sided": False,
    "inverse_noise": 0.0,
}
# A thousand steps forgive no outlier, so robots need a denoiser that is fitted well.
_MUJOCO = {"num_updates": 6000}
# Several policies of a level need more passes than one.
_POOLED = {"num_updates": 4000}
# MADIFF's published sizes: 64 M parameters; days, not minutes, on a CPU.
_UNET = {
    "net": "unet",
    "width": 128,
    "depth": 3,
    "around": "nothing",
    "noisy_input": "unit",
    "horizon": 24,
    "coordinates": "state",
    "prediction": "epsilon",
    "clip": 3.0,
    "condition": "raw",
    "discount": 0.99,
    "batch": 64,
    "lr": 2e-4,
    "num_updates": 1_000_000,
}
PRESETS: dict[str, dict] = {
    "default": {},
    "pooled": _POOLED,
    "mujoco": _MUJOCO,
    "long": {"num_updates": 12_000},
    "shaped": {"barrier_weight": 1.0},  # the barrier pulls the generator in training, too
    "algorithm1": _PRINTED,  # the paper gives no λ
    "algorithm1-pooled": _PRINTED | _POOLED,
    "algorithm1-mujoco": _PRINTED | _MUJOCO,
    "madiff-unet": _UNET,
}


def schedule(config: Config) -> np.ndarray:
    """ᾱ (K,)."""
    return diffusion.cosine_schedule(config.diffusion_steps)


def retention(config: Config) -> cbf.Retention:
    return cbf.Retention(config.retention, config.relaxation, config.two_sided)


def init(
    key: Key,
    spec: Spec,
    config: Config,
    data: WindowData | None,
    feature_map: features.FeatureMap,
    hazard: BoundHazard,
    world: World,
) -> PyTree:
    """Parameters, their averages, optimiser state, the normaliser, and what is read of the World, which no checkpoint
    holds; without data, zeros stand for statistics, which is all that a checkpoint's template needs."""
    kd, kb, ki, _, ks = jax.random.split(key, 5)  # the fourth was forward dynamics': others start as they always did
    n = spec.n_agents
    d = spec.feature_dim
    seen = n * d
    rows = config.horizon + config.history
    carried = tuple(int(i) for i in np.flatnonzero(carried_entries(config, feature_map)))

    def networks() -> dict:
        def denoiser(key: Key) -> Any:
            return build_denoiser(
                key,
                config.net,
                rows,
                d,
                config.width,
                config.depth,
                carried,
                agents=n if feature_map.joint or config.distinguish_agents else 0,
                team=n,
                drivers=config.searched,
            )

        params = {
            "denoiser": denoiser(kd),
            "inverse": MLP(ki, (2 * d, *[config.inverse_width] * 2, spec.action_dim), groups=n, linear=True, acts=spec),
        }
        if config.around == "mean":
            params["mean"] = MeanPlan(denoiser(jax.random.fold_in(kd, 1)), jnp.zeros((rows, 1, d)))
        if config.barrier and config.routing == "paper":
            groups = n if config.scope == "individual" else 1
            params["barrier"] = MLP(kb, (d, *[config.barrier_width] * 3, 1), groups=groups)
        if config.searched:
            acts = n * spec.action_dim
            kc, kq = jax.random.split(jax.random.fold_in(key, 1))
            sizes = (config.clone_width, config.clone_depth)
            params |= drivers.networks(kc, kq, config.searched, seen, acts, *sizes)
        return fresh(Optimiser.of(config), params, "ema")

    if data is None:
        one = jnp.zeros(d)
        moved = jnp.zeros((config.horizon - 1, d))
        norm = normalise.Normaliser(one, one, moved, moved, config.history, config.coordinates)
    else:
        norm = fit_normaliser(config, data, jax.random.split(ks)[0])
    return jax.jit(networks)() | {"frozen": {"normaliser": norm}, "world": from_world(world, config)}


def from_world(world: World, config: Config) -> dict[str, PyTree]:
    """The barrier, where the generator follows it."""
    return {"barrier": world.barrier} if follows(config) else {}


def fit_normaliser(config: Config, data: WindowData, key: Key, windows: int = 8192) -> normalise.Normaliser:
    step = jax.random.randint(key, (min(windows, 4 * data.steps),), 0, data.steps)
    batch = at(data.arrays, step, config.horizon, config.history)
    return normalise.fit(np.asarray(batch.features), np.asarray(batch.valid), config.history, config.coordinates)


def follows(config: Config) -> bool:
    """Whether the generator follows the World's barrier."""
    return config.barrier and config.routing == "split"


def check(config: Config, hazard: BoundHazard) -> None:
    """Refuse settings that cannot work, before anything is computed."""
    retention(config)
    schedule(config)
    kind, depth = gradient_depth(config.gradient)
    if depth >= config.diffusion_steps:
        raise UserError(f"gradient='{config.gradient}' goes deeper than the {config.diffusion_steps} diffusion steps.")
    if config.barrier and config.routing == "paper" and not hazard.has_formula:
        raise UserError("routing='paper' labels generated states, which CostColumn cannot; give a hazard formula.")
    if config.routing == "paper" and (kind == "x0" or not config.barrier):
        raise UserError(
            "routing='paper' draws plans with gradients for barriers of its own; leave barrier=True, and set gradient "
            f"to chain:n or ddim:n, e.g. chain:5 (barrier={config.barrier}, gradient='{config.gradient}')."
        )
    if config.net == "attention" and config.width % (4 * HEADS):
        raise UserError(f"width={config.width} must be a multiple of {4 * HEADS}, for {HEADS} heads of equal width.")
    if config.net == "unet":
        unet.check_sizes(config.history + config.horizon, config.width, config.depth)
    if config.distinguish_agents and config.net != "attention":
        raise UserError(f"distinguish_agents is of the net attention; leave it out with net='{config.net}'.")
    if config.searched:
        drivers.check(config.searched, config.batch)
        if config.net == "unet" or config.observe != "all":
            raise UserError(
                f"drivers={config.drivers} are given to a plan of the whole team by the nets attention and residual; "
                "leave observe='all' and choose one of these, or set drivers=0."
            )
    if config.horizon < 2:
        raise UserError(f"horizon={config.horizon} holds no step to act on; use 2 or more.")
    for low, high in (("snr_floor", "snr_ceiling"), ("barrier_start", "barrier_full")):
        if getattr(config, low) > getattr(config, high):
            raise UserError(
                f"{low}={getattr(config, low)} is above {high}={getattr(config, high)}; lower it or raise {high}."
            )


def cost_source(config: Config) -> Literal["labels", "world", "nothing"]:
    """Joint training labels generated states; `split` follows the World's barrier; without one, danger matters at run
    time only."""
    if not config.barrier:
        return "nothing"
    return "labels" if config.routing == "paper" else "world"


def make_windows(store, config: Config, feature_map: features.FeatureMap, world: World) -> WindowData:
    """Windows with the condition that plans are drawn for."""
    return conditions.scored_windows(store, feature_map, world, config.condition, config.horizon, config.discount)


def world_settings(config: Config) -> dict:
    """The World that training reads: in the planner's own view, with its discount."""
    return {"view": config.view, "discount": config.discount}


def gradient_depth(text: str) -> tuple[str, int]:
    """'x0' -> ('x0', 0); 'ddim:3' -> ('ddim', 3)."""
    kind, _, count = text.partition(":")
    if kind == "x0" and not count:
        return kind, 0
    if kind in ("ddim", "chain") and count.isdigit() and int(count) > 0:
        return kind, int(count)
    raise UserError(f"gradient='{text}' is unknown; use x0, ddim:n or chain:n with n of 1 or more, e.g. ddim:3.")


# --- losses: (params, batch, key) -> scalar, metrics ---


def visible_agents(config: Config, key: Key, shape: tuple[int, int]) -> Array:
    """(B, N) bool: agents whose present is known to the planner."""
    everyone = jnp.ones(shape, bool)
    if config.observe == "all":
        return everyone
    k1, k2 = jax.random.split(key)
    one = jax.nn.one_hot(jax.random.randint(k1, shape[:1], 0, shape[1]), shape[1], dtype=bool)
    if config.observe == "single":
        return one
    return jnp.where(jax.random.bernoulli(k2, 0.5, (shape[0], 1)), everyone, one)


def carries_own(config: Config, feature_map: features.FeatureMap) -> bool:
    """Whether plans hold own entries only; needs a view that knows how the rest follows."""
    return config.carry == "own" and feature_map.reconcile is not None and config.net != "unet"


def carried_entries(config: Config, feature_map: features.FeatureMap) -> np.ndarray:
    """(H, D) bool: entries of a window that the denoiser reads and writes; the present is always read whole."""
    rows = config.history + config.horizon
    d = len(feature_map.names)
    carried = np.ones((rows, d), bool)
    if carries_own(config, feature_map) and feature_map.own is not None:
        carried[config.history + 1 :] = np.isin(np.arange(d), feature_map.own)
    return carried


def search(config: Config) -> drivers.Search:
    return drivers.Search(config.searched, config.num_updates)


class Denoised(NamedTuple):
    """What a denoiser makes of noised plans."""

    losses: Metrics  # L^D, and L^M where there is a mean plan
    clean: Array  # (B, H, N, D) the clean estimate x̂0, the known entries in-painted
    noised: diffusion.Noised
    mask: Array  # (B, H, N, 1) the known entries


def denoising(
    params: PyTree,
    batch: Batch,
    plan: Array,
    keep: Array,
    key: Key,
    config: Config,
    alpha_bar: np.ndarray,
    carried: np.ndarray,
    driver: Array | None = None,
) -> Denoised:
    """L^D of plans (B, H, N, D) of drivers (B,), given the condition where `keep` (B,) says so."""
    k1, k2 = jax.random.split(key)
    visible = visible_agents(config, k2, (plan.shape[0], plan.shape[2]))
    mask = diffusion.known_entries(visible, config.history, plan.shape[1])
    weight = (~mask & batch.valid[..., None, None] & carried[:, None]).astype(jnp.float32)
    losses = {}
    centre = None
    x0 = plan
    if config.around == "mean":
        centre = params["mean"](plan, mask, batch.score, keep, driver)
        losses["loss/mean"], losses["loss/left"] = centre.surprise(plan, weight)
        x0 = jax.lax.stop_gradient(centre).rest(plan, mask)
    noised = diffusion.add_noise(x0, mask, alpha_bar, k1)
    seen = diffusion.dimmed(noised.x, noised.signal, mask if config.noisy_input == "signal" else None)
    output = planning_as(params["denoiser"], driver)(seen, noised.k, batch.score, keep)
    clip = (config.snr_floor, config.snr_ceiling)
    of_noise = config.error == "noise"
    losses["loss/denoising"] = diffusion.denoising_loss(output, x0, noised, weight, config.prediction, clip, of_noise)
    clean = diffusion.to_clean(output, noised.x, noised.signal, noised.noise, config.prediction, config.clip)
    clean = clean if centre is None else centre.plan(clean)
    return Denoised(losses, jnp.where(mask, plan, clean), noised, mask)


def inverse_dynamics(params: PyTree, batch: Batch, norm: normalise.Normaliser, key: Key, config: Config) -> Array:
    """L^P = E ‖a_i − f_φi(s̃_i,t, s̃_i,t+1)‖² on data pairs, summed over the action and averaged over agents."""
    now = config.history
    last = min(now + INVERSE_STEPS, batch.features.shape[1] - 1)
    before = batch.features[:, now:last]
    after = batch.features[:, now + 1 : last + 1]
    valid = batch.valid[:, now + 1 : last + 1, None].astype(jnp.float32)
    inferred = infer_action(params["inverse"], norm, before, after, key, config.inverse_noise)
    error = ((inferred - batch.actions[:, now:last]) ** 2).sum(-1)
    return (error * valid).sum() / (valid.sum() * error.shape[-1])


class Generated(NamedTuple):
    """Plans s̃^θ that carry gradients to θ, in physical units."""

    features: Array  # (B, H, N, D)
    valid: Array  # (B, H)
    eta: Array  # (B, 1, 1) relaxation η_k of their noise level
    weight: Array  # (B, 1, 1)


def generated(
    params: PyTree,
    norm: normalise.Normaliser,
    batch: Batch,
    made: Denoised,
    key: Key,
    config: Config,
    alpha_bar: np.ndarray,
    driver: Array | None = None,
) -> Generated:
    """s̃^θ at the configured gradient depth, of plans of drivers (B,)."""
    kind, n = gradient_depth(config.gradient)
    ret = retention(config)
    bar = alpha_bar
    etas = jnp.asarray(ret.eta(bar), jnp.float32)
    if kind == "x0":
        m = config.barrier_batch
        weight = made.noised.signal[:m, ..., 0] ** 2
        weight = weight if config.weigh_by_signal else jnp.ones_like(weight)
        eta = etas[made.noised.k[:m]][:, None, None]
        return Generated(norm.invert(made.clean[:m]), batch.valid[:m], eta, weight)
    b = min(config.gradient_batch, made.clean.shape[0])
    known = norm.apply(batch.features)[:b]
    valid = batch.valid[:b]
    one = jnp.ones((b, 1, 1))
    zero = jnp.zeros((b, 1, 1))
    whose = None if driver is None else driver[:b]
    how = (bar, config.prediction, config.clip, config.noisy_input == "signal")
    draws = generator(params, known, made.mask[:b], batch.score[:b], whose, *how)
    if kind == "ddim":
        z = diffusion.sample(draws.predict, draws.inpaint, known.shape, bar, key, n, "ddim", remat=True)
        return Generated(norm.invert(draws.plan(z)), valid, zero, one)
    bars = jnp.asarray(bar, jnp.float32)
    z, top = _chained(draws, known, bars, key, n)
    weight = bars[top - n] * one if config.weigh_by_signal else one
    return Generated(norm.invert(draws.plan(z)), valid, etas[top - n] * one, weight)


def _chained(draws: Generator, plans: Array, bars: Array, key: Key, n: int) -> tuple[Array, Array]:
    """One noise level for all of `plans` (B, H, N, D): n ancestral steps down from it, then the clean z that is
    estimated there; and that level."""
    predict = draws.predict
    inpaint = draws.inpaint
    known = jax.lax.stop_gradient(draws.rest(plans))
    k1, k2, k3 = jax.random.split(key, 3)
    top = jax.random.randint(k1, (), n, len(bars))
    x = jnp.sqrt(bars[top]) * known + jnp.sqrt(1 - bars[top]) * jax.random.normal(k2, known.shape)

    @jax.checkpoint
    def down(x: Array, i_key):
        i, key = i_key
        k = top - i
        x = inpaint(x)
        x0 = inpaint(predict(x, jnp.full(x.shape[0], k)))
        a = bars[k]
        before = bars[k - 1]
        ratio = a / before
        mean = jnp.sqrt(before) * (1 - ratio) / (1 - a) * x0 + jnp.sqrt(ratio) * (1 - before) / (1 - a) * x
        deviation = jnp.sqrt((1 - before) / (1 - a) * (1 - ratio))
        return mean + deviation * jax.random.normal(key, x.shape), None

    x, _ = jax.lax.scan(down, x, (jnp.arange(n), jax.random.split(k3, n)))
    return inpaint(predict(inpaint(x), jnp.full(x.shape[0], top - n))), top


def followed(barrier: Barrier, made: Generated, config: Config) -> tuple[Array, Metrics]:
    """(L_θ, metrics): the generator raises the World's barrier, in calibrated margins, along the plan; the barrier is
    fixed and hears of nothing."""
    x = made.features[:, config.history :]
    before = jnp.concatenate([x[:, :1], x[:, :-1]], 1)
    h = barrier.of_steps(before, x) / barrier.unit
    rows = made.valid[:, config.history :, None]
    loss = cbf.shaping(h, rows, retention(config), made.eta, config.delta, config.scaled_margin, made.weight)
    kept = cbf.mean_over((h[:, 1:] >= 0).astype(jnp.float32), rows[:, 1:])
    return loss, {"barrier/made_safe": kept, "loss/shaping": loss}


def barrier_share(config: Config, step: Array) -> Array:
    """λ at an update: 0 until `barrier_start`, `barrier_weight` from `barrier_full` on, linear between."""
    progress = step / max(config.num_updates, 1)
    width = config.barrier_full - config.barrier_start
    if width <= 0:
        return config.barrier_weight * (progress >= config.barrier_start)
    return config.barrier_weight * jnp.clip((progress - config.barrier_start) / width, 0.0, 1.0)


class Plans(NamedTuple):
    """The parts of every loss."""

    loss: Array  # () L^D + L^M + L^E + L^Q
    metrics: Metrics
    batch: Batch  # without the rows that only tell who drives
    made: Denoised
    driver: Array | None  # (B,)


def make_planning(config: Config, feature_map: features.FeatureMap):
    """planning(params, norm, batch, step, key) -> Plans: what MADIFF learns, of one driver each."""
    alpha_bar = schedule(config)
    carried = carried_entries(config, feature_map)

    def planning(params: PyTree, norm: normalise.Normaliser, batch: Batch, step: Array, key: Key) -> Plans:
        k_keep, k_driver, k_noise = jax.random.split(key, 3)
        keep = jax.random.bernoulli(k_keep, 1.0 - config.condition_dropout, (batch.score.shape[0],))
        driver = None
        found = jnp.zeros(())
        metrics = {}
        if config.searched:
            whose = drivers.driven(search(config), params, norm, batch, keep, step, k_driver)
            driver = whose.driver
            found = whose.loss
            metrics = whose.metrics
            batch = batch.rows_from(DRIVER_HISTORY)
        plan = norm.apply(batch.features)
        made = denoising(params, batch, plan, keep, k_noise, config, alpha_bar, carried, driver)
        return Plans(found + sum(made.losses.values()), metrics | made.losses, batch, made, driver)

    return planning


def make_drawing(config: Config, feature_map: features.FeatureMap):
    """drawing(params, norm, plans, key) -> Generated: s̃^θ, in which all agents agree where the view knows how."""
    alpha_bar = schedule(config)

    def drawing(params: PyTree, norm: normalise.Normaliser, plans: Plans, key: Key) -> Generated:
        made = generated(params, norm, plans.batch, plans.made, key, config, alpha_bar, plans.driver)
        if not carries_own(config, feature_map):
            return made
        # Where others will be is what *they* plan: a gradient must move bodies, not one's image of them.
        return made._replace(features=feature_map.agreed(made.features, config.history))

    return drawing


def make_loss(config: Config, feature_map: features.FeatureMap):
    """loss(params, frozen, batch, step, key) -> (scalar, metrics), all terms of `split`."""
    planning = make_planning(config, feature_map)
    drawing = make_drawing(config, feature_map)

    def loss(params, frozen, batch: Batch, step, key: Key, parts: tuple[float, float] = (1.0, 1.0)):
        kd, kp, kg = jax.random.split(key, 3)
        norm = frozen["normaliser"]
        plans = planning(params, norm, batch, step, kd)
        inverse = inverse_dynamics(params, plans.batch, norm, kp, config)
        metrics = plans.metrics | {"loss/inverse": inverse}
        total = parts[0] * plans.loss + inverse
        if config.barrier and config.barrier_weight > 0:
            made = drawing(params, norm, plans, kg)
            share = barrier_share(config, step)
            theta, more = followed(frozen["barrier"], made, config)
            total = total + parts[1] * share * theta
            metrics |= more | {"barrier/weight": share}
        return total, metrics

    return loss


def make_update(config: Config, spec: Spec, feature_map: features.FeatureMap, hazard: BoundHazard):
    """update(state, batch, key) -> state, metrics; pure, one Adam step on every network, or the steps of Algorithm 1 as
    printed."""
    if config.routing == "paper":
        return make_printed_update(
            config,
            spec,
            hazard,
            make_planning(config, feature_map),
            make_drawing(config, feature_map),
            inverse_dynamics,
            Optimiser.of(config),
        )
    loss = make_loss(config, feature_map)
    opt = Optimiser.of(config)

    def update(state: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
        (_, metrics), grads = jax.value_and_grad(loss, has_aux=True)(
            state["params"], state["frozen"] | state["world"], batch, state["step"], key
        )
        state, norms = stepped(state, grads, opt, config.ema)
        return state, metrics | norms

    return update


def make_diagnose(config: Config, spec: Spec, feature_map: features.FeatureMap, hazard: BoundHazard):
    """diagnose(state, batch, key) -> metrics that are too dear for every update: who pulls θ how hard."""
    loss = make_loss(config, feature_map)

    def diagnose(state: PyTree, batch: Batch, key: Key) -> Metrics:
        if not config.barrier or config.barrier_weight == 0 or config.routing == "paper":
            return {}

        drawn_by = {name: net for name, net in state["params"].items() if name in ("denoiser", "mean")}

        def pull(parts):
            def of(learned):
                read = state["frozen"] | state["world"]
                return loss(state["params"] | learned, read, batch, state["step"], key, parts)[0]

            return jnp.sqrt(sum((g**2).sum() for g in jax.tree.leaves(jax.grad(of)(drawn_by))))

        denoise = pull((1.0, 0.0))
        shaping = pull((0.0, 1.0))
        return {
            "gradient/denoising": denoise,
            "gradient/shaping": shaping,
            "gradient/ratio": shaping / jnp.maximum(denoise, 1e-12),
        }

    return diagnose


def make_policy(state: PyTree, config: Config, spec: Spec, feature_map, hazard: BoundHazard, options):
    """Receding-horizon planner on the averaged parameters; `options` are the evaluation-time choices."""
    return Planner(
        networks={name: net for name, net in state["ema"].items() if name != "clones"},
        normaliser=state["frozen"]["normaliser"],
        alpha_bar=tuple(schedule(config).tolist()),
        horizon=config.horizon,
        history=config.history,
        prediction=config.prediction,
        dim=config.noisy_input == "signal",
        clip=config.clip,
        observe=config.observe,
        drivers=config.searched,
        carries_own=carries_own(config, feature_map),
        spec=spec,
        feature_map=feature_map,
        options=options,
    )


# Before 5 plans were drawn by attention from noise around the origin.
ICBF = Algorithm(
    "icbf",
    Config,
    check,
    init,
    make_update,
    make_diagnose,
    make_policy,
    PRESETS,
    cost_source=cost_source,
    make_windows=make_windows,
    world_settings=world_settings,
    from_world=from_world,
    revision=5,
)
_PLAIN = {"barrier": False, "guided": False}
MADIFF = dataclasses.replace(
    ICBF,
    name="madiff",
    presets={
        "default": _PLAIN,
        "pooled": _PLAIN | _POOLED,
        "mujoco": _PLAIN | _MUJOCO,
        "long": _PLAIN | PRESETS["long"],
        # the network, weights and noise of before the mean plan
        "attention": {
            **_PLAIN,
            "net": "attention",
            "width": 128,
            "drivers": 0,
            "around": "nothing",
            "noisy_input": "unit",
            "snr_floor": 0.5,
            "snr_ceiling": 5.0,
            "clone_width": 384,
            "clone_depth": 3,
            "num_updates": 1500,
        },
        # MADIFF's condition and rows, at a size for CPUs; play it with the planner `published`
        "raw-return": {**_PLAIN, "condition": "raw", "discount": 0.99, "horizon": 24, "num_updates": 6000},
        # MADIFF-D: everybody plans for all from its own observation
        "own": {**_PLAIN, "view": "decentralized", "observe": "single"},
        "published": {**_PLAIN, **_UNET},
    },
)
