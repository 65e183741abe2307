"""The coordinates of plans: exact inverses, unit variance."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.envs import SimpleSpread
from ringfence.logs.windows import WindowData, at
from ringfence.problem import normalise


@pytest.fixture(scope="module", params=[0, 2], ids=["present", "history"])
def windows(request, small_store):
    """(windows (M, H, N, D), valid (M, H), row of the present)."""
    data = WindowData(small_store, SimpleSpread().feature_map("pruned"))
    batch = jax.jit(at, static_argnums=(2, 3))(data.arrays, jnp.arange(data.steps), 6, request.param)
    return np.asarray(batch.features), np.asarray(batch.valid), request.param


def test_bounds_of_actions_change_no_lesson(small_store):
    """Actions told in other units teach the same; those bounded by −1 and 1 are not touched."""
    view = SimpleSpread().feature_map("pruned")
    plain = WindowData(small_store, view).arrays["actions"]
    np.testing.assert_array_equal(plain, small_store.actions)
    np.testing.assert_array_equal(normalise.from_unit(plain, -1.0, 1.0), plain)
    card = small_store.card.updated(action_low=2.0, action_high=8.0)
    told = normalise.from_unit(small_store.actions, 2.0, 8.0)
    assert 2.0 <= told.min() < 2.1 and 7.9 < told.max() <= 8.0
    other = WindowData(replace(small_store, actions=told, card=card), view).arrays["actions"]
    np.testing.assert_allclose(other, plain, atol=1e-6)


@pytest.mark.parametrize("coordinates", ["displacement", "state"])
def test_inverse_and_unit_variance(windows, coordinates):
    x, valid, now = windows
    norm = normalise.fit(x, valid, now, coordinates)
    z = np.asarray(norm.apply(jnp.asarray(x)))
    np.testing.assert_allclose(norm.invert(jnp.asarray(z)), x, atol=1e-5)
    present = z[:, now].reshape(-1, z.shape[-1])
    np.testing.assert_allclose(present.mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(present.std(0), 1, atol=1e-3)
    if coordinates == "displacement":
        for s in range(now + 1, x.shape[1]):
            moved = z[valid[:, s], s].reshape(-1, z.shape[-1])
            np.testing.assert_allclose(moved.mean(0), 0, atol=1e-3)
            np.testing.assert_allclose(moved.std(0), 1, atol=1e-3)
    else:
        np.testing.assert_array_equal(z, norm.state(jnp.asarray(x)))
    np.testing.assert_allclose(
        np.asarray(norm.step(x[:, now], x[:, now + 1]))[valid[:, now + 1]].std((0, 1)), 1, atol=1e-3
    )


def test_any_plan_survives_the_round_trip(windows):
    x, valid, now = windows
    for coordinates in ("displacement", "state"):
        norm = normalise.fit(x, valid, now, coordinates)
        z = np.random.default_rng(0).normal(size=(2, 5, *x.shape[1:])).astype(np.float32)  # more leading axes
        np.testing.assert_allclose(norm.apply(norm.invert(jnp.asarray(z))), z, atol=2e-4)


@pytest.mark.parametrize("coordinates", ["displacement", "state"])
def test_units_do_not_matter(windows, coordinates):
    """Nanometres or kilometres, at any rate: the same coordinates; a constant of any size is none."""
    x, valid, now = windows
    z = normalise.fit(x, valid, now, coordinates).apply(jnp.asarray(x))
    for unit in (1e-6, 1e4):
        small = normalise.fit(x * np.float32(unit), valid, now, coordinates)
        np.testing.assert_allclose(small.apply(jnp.asarray(x * np.float32(unit))), z, atol=2e-3)
        still = np.concatenate([x, np.full_like(x[..., :1], 7.3)], -1) * np.float32(unit)
        norm = normalise.fit(still, valid, now, coordinates)
        assert norm.scale[-1] == 1 and (norm.step_scale[:, -1] == 1).all()


def test_constant_entries_are_left_alone():
    x = np.zeros((10, 4, 2, 3), np.float32)
    x[..., 0] = 5.0
    norm = normalise.fit(x, np.ones((10, 4), bool), 0, "displacement")
    z = norm.apply(jnp.asarray(x))
    assert np.isfinite(z).all() and not np.asarray(z).any()
    np.testing.assert_array_equal(norm.invert(z), x)
    nothing_follows = np.arange(4)[None] < np.ones((10, 1))  # only the present is valid
    assert np.isfinite(normalise.fit(x, nothing_follows, 0, "displacement").apply(jnp.asarray(x))).all()
