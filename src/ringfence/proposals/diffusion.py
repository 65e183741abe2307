"""Noise schedule, forward noising and samplers over plans, for any denoiser F(x_k, k, y, keep).

Diffusion steps are counted k = 0 .. K−1 with ᾱ_k the share of signal left in the variance; ᾱ falls with k. The
in-painted entries (the present state and its history) are put back before every evaluation and at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError, unknown
from ringfence.types import Array, Key

Prediction = Literal["x0", "epsilon", "v"]
Sampler = Literal["ddpm", "ddim", "dpm++"]
SAMPLERS = ("ddpm", "ddim", "dpm++")
Predict = Callable[[Array, Array], Array]  # (x_k (B, ...), k (B,)) -> clean estimate x̂0 (B, ...)


def cosine_schedule(steps: int) -> np.ndarray:
    """ᾱ (K,), the squared-cosine schedule with β capped at 0.999 (Nichol & Dhariwal 2021, eq. 17)."""
    if steps < 2:
        raise UserError(f"A noise schedule needs at least 2 diffusion steps, got {steps}; MADIFF uses 200.")
    bar = np.cos((np.arange(steps + 1) / steps + 0.008) / 1.008 * np.pi / 2) ** 2
    beta = np.minimum(1.0 - bar[1:] / bar[:-1], 0.999)
    return np.cumprod(1.0 - beta)


class Noised(NamedTuple):
    """A noised plan: x_k = √ᾱ_k x_0 + √(1−ᾱ_k) ε, in-painted entries clean."""

    x: Array
    k: Array
    signal: Array  # √ᾱ_k, broadcastable to x
    noise: Array  # √(1−ᾱ_k)
    epsilon: Array


def known_entries(visible: Array, history: int, rows: int) -> Array:
    """(B, H, N, 1) bool: what is in-painted into a plan: the past and present rows of visible agents (B, N)."""
    known = jnp.arange(rows) <= history
    return (known[None, :, None] & visible[:, None, :])[..., None]


def add_noise(x0: Array, mask: Array, alpha_bar: Array | np.ndarray, key: Key) -> Noised:
    """Noise plans (B, ...) to random steps; `mask` is true on in-painted entries, which stay clean."""
    k1, k2 = jax.random.split(key)
    k = jax.random.randint(k1, (x0.shape[0],), 0, alpha_bar.shape[0])
    epsilon = jax.random.normal(k2, x0.shape)
    signal, noise = _levels(alpha_bar, k, x0.ndim)
    return Noised(jnp.where(mask, x0, signal * x0 + noise * epsilon), k, signal, noise, epsilon)


def to_clean(output: Array, x: Array, signal: Array, noise: Array, prediction: Prediction, clip: float) -> Array:
    """x̂0 from the network's output: x̂0 itself, (x − √(1−ᾱ) ε)/√ᾱ, or √ᾱ x − √(1−ᾱ) v; clipped to ±`clip`.

    The clip is straight-through for gradients of x0- and v-prediction, whose Jacobian is bounded anyway.
    """
    if prediction == "x0":
        x0 = output
    elif prediction == "epsilon":
        return jnp.clip((x - noise * output) / jnp.maximum(signal, 1e-4), -clip, clip)
    else:
        x0 = signal * x - noise * output
    return x0 + jax.lax.stop_gradient(jnp.clip(x0, -clip, clip) - x0)


def denoising_loss(
    output: Array,
    x0: Array,
    noised: Noised,
    weight: Array,
    prediction: Prediction,
    snr_clip: tuple[float, float],
    of_noise: bool = False,
) -> Array:
    """L^D: masked mean of the squared error; `weight` (broadcastable) is 0 where nothing is learned.

    x0-prediction: ‖x̂0 − x0‖² weighted by clip(SNR, ·, ·). ε- and v-prediction: unweighted (Ho et al. 2020; Salimans &
    Ho 2022). `of_noise`: the error of the noise that follows from any of them, ‖ε̂ − ε‖² as Ho et al. have it.
    """
    snr = (noised.signal / noised.noise) ** 2
    if prediction == "x0":
        error = (snr if of_noise else jnp.clip(snr, *snr_clip)) * (output - x0) ** 2
    elif prediction == "epsilon":
        error = (output - noised.epsilon) ** 2
    else:
        error = (output - (noised.signal * noised.epsilon - noised.noise * x0)) ** 2
        error = noised.signal**2 * error if of_noise else error
    weight = jnp.broadcast_to(weight, error.shape)
    return (error * weight).sum() / jnp.maximum(weight.sum(), 1.0)


def dimmed(x: Array, signal: Array, mask: Array | None) -> Array:
    """What a network is shown of x_k: its noisy entries × √ᾱ_k, which are pure noise where nothing is left of the
    plan; those of `mask` are clean. Without one all is shown as it is."""
    return x if mask is None else jnp.where(mask, x, signal * x)


def guided(
    net: Callable,
    alpha_bar: Array | np.ndarray,
    y: Array,
    guidance: float,
    prediction: Prediction,
    clip: float,
    mask: Array | None = None,
) -> Predict:
    """Classifier-free guidance as one batched call: out(∅) + ω (out(y) − out(∅)); ω = 1 skips the second half. With a
    `mask` of known entries (B, ...) the others are shown dimmed."""

    def predict(x: Array, k: Array) -> Array:
        signal, noise = _levels(alpha_bar, k, x.ndim)
        keep = jnp.ones(x.shape[0], bool)
        seen = dimmed(x, signal, mask)
        if isinstance(guidance, (int, float)) and guidance == 1.0:
            output = net(seen, k, y, keep)
        else:
            both = net(jnp.concatenate([seen, seen]), jnp.tile(k, 2), jnp.tile(y, 2), jnp.concatenate([keep, ~keep]))
            conditional, free = jnp.split(both, 2)
            output = free + guidance * (conditional - free)
        return to_clean(output, x, signal, noise, prediction, clip)

    return predict


def timesteps(total: int, steps: int) -> np.ndarray:
    """Decreasing diffusion steps (n,), evenly spaced and starting at K−1 ("trailing", Lin et al. 2024): with few
    steps, none is spent on the last levels, where the clean estimate is already exact."""
    if not 1 <= steps <= total:
        raise UserError(f"A sampler can take 1 to {total} steps of this model, got {steps}; choose fewer.")
    return np.round(np.arange(steps, 0, -1) * total / steps).astype(int) - 1


def sample(
    predict: Predict,
    inpaint: Callable[[Array], Array],
    shape: tuple[int, ...],
    alpha_bar: np.ndarray,
    key: Key,
    steps: int,
    sampler: Sampler = "ddim",
    temperature: float | Array = 1.0,
    eta: float = 0.0,
    remat: bool = False,
) -> Array:
    """Draw plans of `shape` (B, ...). `inpaint` puts the known entries into a plan.

    ddpm: ancestral steps on a (sub)sequence of levels, posterior variance; ddim: Song et al. 2021, `eta` = 0 is
    deterministic given the first noise; dpm++: DPM-Solver++(2M) (Lu et al. 2022). `temperature` scales the first
    noise. `remat` recomputes each step in the backward pass, so a differentiated sample holds one step's activations.
    """
    k1, key = jax.random.split(key)
    x = temperature * jax.random.normal(k1, shape)
    return refine(predict, inpaint, x, timesteps(len(alpha_bar), steps), alpha_bar, key, sampler, eta, remat)


def refine(
    predict: Predict,
    inpaint: Callable[[Array], Array],
    x: Array,
    levels: np.ndarray,
    alpha_bar: np.ndarray,
    key: Key,
    sampler: Sampler = "ddim",
    eta: float = 0.0,
    remat: bool = False,
) -> Array:
    """Denoise x from levels[0] down the given decreasing diffusion steps and on to the clean plan."""
    if sampler not in SAMPLERS:
        raise unknown("sampler", sampler, SAMPLERS)
    eta = 1.0 if sampler == "ddpm" else eta
    schedule = _schedule(levels, alpha_bar, key)

    def step(carry, s):
        x, previous = carry
        x = inpaint(x)
        x0 = inpaint(predict(x, jnp.full(x.shape[0], s["k"])))
        estimate = x0
        if sampler == "dpm++":
            estimate = x0 + s["ratio"] * (x0 - previous)
        epsilon = (x - s["signal"] * x0) / s["noise"]
        if sampler == "dpm++":
            # exact solution of the linear part: x' = (σ'/σ) x + α' (1 − e^{−h}) D, with e^{−h} = (σ'/α')/(σ/α)
            decay = s["next_noise"] / s["noise"]
            x = decay * x + (s["next_signal"] - decay * s["signal"]) * estimate
        else:
            share = 1.0 - (s["signal"] / s["next_signal"]) ** 2
            sigma = eta * s["next_noise"] / s["noise"] * jnp.sqrt(jnp.maximum(share, 0.0))
            direction = jnp.sqrt(jnp.maximum(s["next_noise"] ** 2 - sigma**2, 0.0))
            x = s["next_signal"] * x0 + direction * epsilon
            if eta > 0:
                x = x + sigma * jax.random.normal(s["key"], x.shape)
        return (x, x0), None

    if remat:
        step = jax.checkpoint(step)
    (x, _), _ = jax.lax.scan(step, (x, jnp.zeros_like(x)), schedule)
    return inpaint(x)


def _schedule(levels: np.ndarray, alpha_bar: np.ndarray, key: Key) -> dict[str, Array]:
    """What every step down the diffusion steps `levels` reads, the last one onto the clean plan."""
    bar = np.concatenate([alpha_bar[levels], [1.0]])
    signal = np.sqrt(bar)
    noise = np.sqrt(1.0 - bar)
    return {
        "k": jnp.asarray(levels, jnp.int32),
        "signal": jnp.asarray(signal[:-1], jnp.float32),
        "noise": jnp.asarray(noise[:-1], jnp.float32),
        "next_signal": jnp.asarray(signal[1:], jnp.float32),
        "next_noise": jnp.asarray(noise[1:], jnp.float32),
        "key": jax.random.split(key, len(levels)),
        "ratio": jnp.asarray(_multistep_ratio(bar), jnp.float32),
    }


def _multistep_ratio(bar: np.ndarray) -> np.ndarray:
    """(n,) factor 1/(2r) of the second-order correction of DPM-Solver++(2M); 0 on the first and the last step."""
    with np.errstate(divide="ignore"):
        half_log_snr = 0.5 * np.log(bar / np.maximum(1.0 - bar, 1e-20))
    h = np.diff(half_log_snr)
    ratio = np.zeros(len(bar) - 1)
    for i in range(1, len(ratio) - 1):
        ratio[i] = 0.5 * h[i] / h[i - 1]
    return ratio


def _levels(alpha_bar: Array | np.ndarray, k: Array, ndim: int) -> tuple[Array, Array]:
    bar = jnp.asarray(alpha_bar, jnp.float32)[k].reshape(-1, *[1] * (ndim - 1))
    return jnp.sqrt(bar), jnp.sqrt(1.0 - bar)
