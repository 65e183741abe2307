"""The schedule, the losses and the samplers, against tables and closed forms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.errors import UserError
from ringfence.nets.team import Centre
from ringfence.proposals import diffusion

BAR = diffusion.cosine_schedule(200)
SAMPLERS = ("ddpm", "ddim", "dpm++")


add_noise = jax.jit(diffusion.add_noise)


def free(x):
    """Nothing is known beforehand."""
    return x


def draw(predict, inpaint, shape, steps, sampler, key=0, bar=BAR, **options):
    sampled = jax.jit(lambda key: diffusion.sample(predict, inpaint, shape, bar, key, steps, sampler, **options))
    return np.asarray(sampled(jax.random.key(key)))


def test_schedule_has_the_published_values():
    # MADIFF's squared-cosine schedule with 200 steps: share of signal, and |d x0 / d epsilon|
    table = {0: (0.9997, 0.016), 20: (0.970, 0.177), 60: (0.781, 0.53), 100: (0.486, 1.03), 140: (0.197, 2.0)}
    table |= {180: (0.022, 6.7), 198: (6e-5, 128), 199: (6e-8, 4.1e3)}
    for k, (bar, slope) in table.items():
        assert BAR[k] == pytest.approx(bar, rel=0.05, abs=1e-3 if k < 198 else 0.0)
        assert np.sqrt((1 - BAR[k]) / BAR[k]) == pytest.approx(slope, rel=0.04)
    assert (np.diff(BAR) < 0).all() and BAR.shape == (200,)
    with pytest.raises(UserError, match="at least 2 diffusion steps, got 1"):
        diffusion.cosine_schedule(1)


def test_noised_plans_keep_what_is_known():
    x0 = np.random.default_rng(0).normal(size=(64, 4, 2, 3)).astype(np.float32)
    mask = np.zeros((64, 4, 2, 1), bool)
    mask[:, 0] = True
    noised = jax.tree.map(np.asarray, add_noise(x0, mask, BAR, jax.random.key(1)))
    np.testing.assert_array_equal(noised.x[:, 0], x0[:, 0])
    np.testing.assert_allclose(noised.x[:, 1:], (noised.signal * x0 + noised.noise * noised.epsilon)[:, 1:], atol=1e-5)
    np.testing.assert_allclose(noised.signal.ravel(), np.sqrt(BAR)[noised.k], rtol=1e-5)
    np.testing.assert_allclose(noised.signal**2 + noised.noise**2, 1, rtol=1e-5)


@pytest.mark.parametrize("prediction", ["x0", "epsilon", "v"])
def test_the_true_output_gives_the_clean_plan_and_no_loss(prediction):
    x0 = np.random.default_rng(0).normal(size=(64, 4, 2, 3)).clip(-4, 4).astype(np.float32)
    noised = add_noise(x0, np.zeros((64, 4, 2, 1), bool), np.append(BAR[:150], BAR[:50]), jax.random.key(1))
    noised = jax.tree.map(np.asarray, noised)
    truth = {
        "x0": x0,
        "epsilon": noised.epsilon,
        "v": noised.signal * noised.epsilon - noised.noise * x0,
    }[prediction]
    to_clean = jax.jit(diffusion.to_clean, static_argnums=4)
    clean = to_clean(truth, noised.x, noised.signal, noised.noise, prediction, 5.0)
    np.testing.assert_allclose(clean, x0, atol=2e-4)
    weight = (np.arange(4) < 2)[None, :, None, None].astype(np.float32)
    loss = jax.jit(lambda output: diffusion.denoising_loss(output, x0, noised, weight, prediction, (0.5, 5.0)))
    assert loss(truth) < 1e-9
    assert loss(truth + 3.0 * (1 - weight)) < 1e-9  # rows without weight teach nothing
    assert loss(truth + 3.0 * weight) > 4.0
    clipped = to_clean(truth, noised.x, noised.signal, noised.noise, prediction, 0.5)
    assert np.abs(clipped).max() <= 0.5 + 1e-6


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_known_entries_are_bit_exact_after_sampling(sampler):
    mask = jax.random.bernoulli(jax.random.key(0), 0.4, (3, 5, 2, 4))
    known = jax.random.normal(jax.random.key(1), mask.shape)
    seen = []

    def predict(x, k):
        jax.debug.callback(lambda x: seen.append(np.asarray(x)), x)
        return jnp.tanh(x.sum((1, 2), keepdims=True) - x) + 0.01 * k[:, None, None, None]

    x = draw(predict, lambda x: jnp.where(mask, known, x), mask.shape, 7, sampler)
    np.testing.assert_array_equal(x[mask], np.asarray(known)[mask])
    assert np.isfinite(x).all() and (x != np.asarray(known))[~mask].all()
    assert len(seen) == 7 and all((s[mask] == np.asarray(known)[mask]).all() for s in seen)


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("steps", [1, 2, 20])
def test_an_oracle_is_recovered(sampler, steps):
    truth = jax.random.normal(jax.random.key(3), (4, 5))
    x = draw(lambda x, k: truth, free, truth.shape, steps, sampler)
    np.testing.assert_allclose(x, truth, atol=1e-5)


@pytest.mark.parametrize("sampler, steps", [("ddpm", 200), ("ddim", 200), ("ddim", 50), ("dpm++", 50)])
def test_a_gaussian_is_sampled_with_its_moments(sampler, steps):
    mean, deviation, bar = 1.5, 0.4, jnp.asarray(BAR, jnp.float32)

    def predict(x, k):
        signal, noise = jnp.sqrt(bar[k])[:, None], jnp.sqrt(1 - bar[k])[:, None]
        gain = deviation**2 * signal / (signal**2 * deviation**2 + noise**2)
        return mean + gain * (x - signal * mean)  # E[x0 | x_k]

    x = draw(predict, free, (20_000, 1), steps, sampler)
    assert x.mean() == pytest.approx(mean, abs=0.01)
    assert x.std() == pytest.approx(deviation, rel=0.03)
    assert abs(((x - x.mean()) ** 3).mean() / x.std() ** 3) < 0.1


def test_ddim_is_deterministic_given_the_first_noise_and_ddpm_is_not():
    start = jax.random.normal(jax.random.key(0), (4, 3))
    levels = diffusion.timesteps(200, 10)
    for sampler, same in (("ddim", True), ("dpm++", True), ("ddpm", False)):
        refine = jax.jit(
            lambda key, s=sampler: diffusion.refine(lambda x, k: 0.5 * x, free, start, levels, BAR, key, s)
        )
        a, b = refine(jax.random.key(1)), refine(jax.random.key(2))
        assert np.array_equal(a, b) == same


def test_recomputing_steps_changes_nothing():
    def total(scale, remat):
        predict = lambda x, k: jnp.tanh(scale * x)  # noqa: E731
        return diffusion.sample(predict, free, (4, 3), BAR, jax.random.key(0), 5, remat=remat).sum()

    gradient = jax.jit(jax.grad(total), static_argnums=1)
    assert float(gradient(0.7, True)) == pytest.approx(float(gradient(0.7, False)), rel=1e-5)


@pytest.mark.parametrize("prediction", ["x0", "epsilon", "v"])
def test_batched_guidance_equals_two_passes(prediction):
    calls = []

    def net(x, k, y, keep):
        calls.append(x.shape[0])
        told = jnp.where(keep, y, 0.3) + 0.01 * k
        return jnp.sin(x) * told[:, None, None, None]

    x = jax.random.normal(jax.random.key(0), (6, 4, 2, 3))
    k, y = jnp.arange(6) * 20, jnp.linspace(-2, 2, 6)
    for omega in (1.0, 1.2):
        calls.clear()
        got = jax.jit(diffusion.guided(net, BAR, y, omega, prediction, 5.0))(x, k)
        assert calls == ([6] if omega == 1.0 else [12])

        @jax.jit
        def two_passes(omega):
            conditional, unconditional = (net(x, k, y, jnp.full(6, keep)) for keep in (True, False))
            bar = jnp.asarray(BAR, jnp.float32)[k][:, None, None, None]
            output = unconditional + omega * (conditional - unconditional)
            return diffusion.to_clean(output, x, jnp.sqrt(bar), jnp.sqrt(1 - bar), prediction, 5.0)

        np.testing.assert_allclose(got, two_passes(omega), rtol=1e-4, atol=1e-4)


def test_timesteps_start_at_the_top_and_fall():
    for total in (2, 7, 200):
        for steps in range(1, total + 1):
            levels = diffusion.timesteps(total, steps)
            assert levels[0] == total - 1 and levels[-1] >= 0 and len(levels) == steps
            assert (np.diff(levels) < 0).all()


@pytest.mark.parametrize("steps", [0, 201, -3])
def test_impossible_steps_are_refused(steps):
    with pytest.raises(UserError, match=f"can take 1 to 200 steps of this model, got {steps}"):
        diffusion.sample(lambda x, k: x, free, (1, 1), BAR, jax.random.key(0), steps)


def test_unknown_samplers_are_refused():
    with pytest.raises(UserError, match="Unknown sampler 'euler'; choose"):
        diffusion.sample(lambda x, k: x, free, (1, 1), BAR, jax.random.key(0), 3, "euler")


def test_the_mean_plan_and_what_is_left_make_the_plan():
    """z and back; the mean's error teaches the mean alone, its surprise the scale alone, which settles at the error's
    size."""
    plan = jax.random.normal(jax.random.key(0), (256, 4, 2, 3))
    mask = jnp.arange(4)[None, :, None, None] < 1
    centre = Centre(0.5 * plan, jnp.full((4, 1, 3), -1.0))
    z = centre.rest(plan, mask)
    np.testing.assert_allclose(jnp.where(mask, plan, centre.plan(z)), plan, atol=1e-5)
    np.testing.assert_array_equal(z[:, 0], plan[:, 0])
    weight = jnp.broadcast_to(~mask, plan.shape).astype(jnp.float32)

    def parts(mean, log_scale):
        return jnp.stack(Centre(mean, log_scale).surprise(plan, weight))

    to_mean, to_scale = jax.jacrev(parts, (0, 1))(centre.mean, centre.log_scale)
    assert jnp.abs(to_mean[0]).max() > 0 and not to_mean[1].any() and not to_scale[0].any()
    settled = jnp.log((0.5 * plan).std(0).mean(1, keepdims=True))
    assert jnp.abs(jax.grad(lambda s: parts(centre.mean, s)[1])(settled)).max() < 0.05


def test_what_is_known_is_not_dimmed():
    x = jnp.ones((2, 3, 1, 1))
    mask = jnp.arange(3)[None, :, None, None] < 1
    np.testing.assert_array_equal(diffusion.dimmed(x, 0.5, mask)[0, :, 0, 0], [1.0, 0.5, 0.5])
    assert diffusion.dimmed(x, 0.5, None) is x


@pytest.mark.parametrize("prediction", ["x0", "epsilon", "v"])
def test_the_error_of_the_noise_is_the_same_whatever_the_network_outputs(prediction):
    x0 = jax.random.normal(jax.random.key(2), (64, 4, 2, 3))
    guess = x0 + 0.1 * jax.random.normal(jax.random.key(3), x0.shape)
    noised = add_noise(x0, np.zeros((64, 4, 2, 1), bool), BAR[5:150], jax.random.key(1))
    epsilon = (noised.x - noised.signal * guess) / noised.noise
    output = {"x0": guess, "epsilon": epsilon, "v": noised.signal * epsilon - noised.noise * guess}[prediction]
    loss = diffusion.denoising_loss(output, x0, noised, jnp.ones_like(x0), prediction, (1.0, 1.0), of_noise=True)
    assert float(loss) == pytest.approx(float(((epsilon - noised.epsilon) ** 2).mean()), rel=1e-3)
