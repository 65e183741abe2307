"""The denoisers: agents are interchangeable, their number is in no weight, and no weight is idle."""

from __future__ import annotations

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.errors import UserError
from ringfence.nets import MLP, agent_attention, build_denoiser
from ringfence.nets.team import planning_as
from ringfence.nets.unet import TemporalUNet

ROWS, FEATURES = 5, 5  # rows do not halve: the U-Net pads them


@functools.cache
def denoiser(kind):
    """A small denoiser with random numbers in every leaf (the U-Net's attention would start at zero); its leaves come
    from NumPy, because compiling the initialisation takes longer than all else here."""
    shapes = jax.eval_shape(lambda key: build_denoiser(key, kind, ROWS, FEATURES, 16, 2), jax.random.key(0))
    rng = np.random.default_rng(0)

    def fill(leaf):
        fan_in = leaf.shape[0] if len(leaf.shape) > 1 else 1
        return jnp.asarray(rng.normal(size=leaf.shape) / fan_in**0.5, jnp.float32)

    return jax.tree.map(fill, shapes)


def inputs(agents, rows=ROWS, batch=2):
    x = jax.random.normal(jax.random.key(1), (batch, rows, agents, FEATURES))
    return x, jnp.arange(batch) * 50, jnp.linspace(-1.0, 2.0, batch), jnp.arange(batch) % 2 == 0


apply = jax.jit(lambda net, *args: net(*args))


@pytest.mark.parametrize("kind", ["attention", "unet"])
def test_agents_are_interchangeable_and_their_number_is_free(kind):
    net = denoiser(kind)
    for agents in (3, 5):  # the same weights
        x, *rest = inputs(agents)
        out = apply(net, x, *rest)
        assert out.shape == x.shape and np.isfinite(out).all()
        order = np.random.default_rng(agents).permutation(agents)
        np.testing.assert_allclose(apply(net, x[:, :, order], *rest), out[:, :, order], atol=2e-5)
        other = apply(net, x.at[:, :, 0].add(1.0), *rest)
        assert (np.abs(other - out)[:, :, 1:].max((1, 3)) > 1e-5).all()  # what one does reaches the others


def test_a_team_is_read_at_once():
    """Entries that are not carried are not read; what one agent does reaches all; a driver means another plan, for
    each half of a guided batch."""
    carried = tuple(i for i in range(ROWS * FEATURES) if i != 3)
    net = build_denoiser(jax.random.key(0), "residual", ROWS, FEATURES, 16, 2, carried, team=3, drivers=4)
    x, *rest = inputs(3)
    out = apply(net, x, *rest, jnp.array([0, 1]))
    assert out.shape == x.shape and (out[:, 0, :, 3] == 0).all()
    np.testing.assert_array_equal(apply(net, x.at[:, 0, :, 3].add(1.0), *rest, jnp.array([0, 1])), out)
    moved = apply(net, x.at[:, 1, 0].add(1.0), *rest, jnp.array([0, 1]))
    assert (np.abs(moved - out)[:, 1:].max((1, 3)) > 1e-5).all()
    twice = planning_as(net, jnp.array([0, 3]))(*(jnp.concatenate([a, a]) for a in (x, *rest)))
    np.testing.assert_allclose(twice[:2], twice[2:], atol=1e-6)
    np.testing.assert_allclose(twice[0], out[0], atol=1e-6)
    assert np.abs(twice[1] - out[1]).max() > 1e-4


def test_limbs_of_one_body_are_told_apart():
    """With a vector per agent the same window means something else for another agent; while it is 0, it does not."""
    x, *rest = inputs(3)
    plain = denoiser("attention")
    for vectors, same in ((jnp.zeros((3, 16)), True), (jnp.eye(3, 16), False)):
        net = eqx.tree_at(lambda n: n.which, plain, vectors, is_leaf=lambda leaf: leaf is None)
        out = apply(net, x, *rest)
        turned = apply(net, x[:, :, ::-1], *rest)[:, :, ::-1]
        assert np.allclose(turned, out, atol=2e-5) == same


@pytest.mark.parametrize("kind", ["attention", "unet"])
def test_the_condition_is_heard_and_samples_do_not_mix(kind):
    net = denoiser(kind)
    x, k, y, keep = inputs(3)
    out = apply(net, x, k, y, keep)
    assert np.abs(apply(net, x, k + 5, y, keep) - out).max((1, 2, 3)).min() > 1e-5
    heard = np.abs(apply(net, x, k, y + 1.0, keep) - out).max((1, 2, 3))
    assert heard[0] > 1e-5 and heard[1] == 0  # a dropped return says nothing
    other = apply(net, x.at[0].add(1.0), k, y, keep)
    np.testing.assert_array_equal(other[1], out[1])


@pytest.mark.parametrize("kind", ["attention", "unet"])
def test_no_weight_is_idle(kind):
    net, args = denoiser(kind), inputs(3)
    out = apply(net, *args)
    paths, structure = jax.tree_util.tree_flatten_with_path(net)
    leaves, rng = [leaf for _, leaf in paths], np.random.default_rng(1)
    for i, (path, leaf) in enumerate(paths):  # cheaper than a gradient, which takes longer to compile
        moved = leaf + jnp.asarray(rng.normal(size=leaf.shape), jnp.float32)
        other = apply(jax.tree.unflatten(structure, [*leaves[:i], moved, *leaves[i + 1 :]]), *args)
        assert np.abs(other - out).max() > 1e-4, jax.tree_util.keystr(path)


def test_small_and_large_teams_compute_the_same_attention(monkeypatch):
    net, (x, *rest) = denoiser("attention"), inputs(5)
    small = apply(net, x, *rest)
    monkeypatch.setattr(agent_attention, "SMALL_TEAM", 2)
    np.testing.assert_allclose(jax.jit(lambda net: net(x, *rest))(net), small, atol=1e-5)


def parameters(**sizes) -> int:
    net = jax.eval_shape(lambda key: TemporalUNet(key, **sizes), jax.random.key(0))
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(net))


def test_unet_has_madiffs_parameters_less_the_dead_ones():
    def linear(a, b):
        return a * b + b

    told = 256
    unused = 2 * linear(128, 32) + linear(128, 128) + 2 * linear(told, 32) + linear(told, 128) + 1
    cancelling = sum(c // 4 + linear(told, c // 4) for c in (1024, 1024, 512))
    assert (unused, cancelling) == (74_113, 165_120)
    assert parameters(rows=24, features=18, width=128, depth=3) + unused + cancelling == 64_342_550  # 64.3 M
    assert parameters(rows=8, features=18, width=128, depth=3) == 64_103_317  # rows are in no weight


@pytest.mark.parametrize("rows", [1, 5, 8])
@pytest.mark.parametrize("depth, width", [(1, 7), (3, 12)])
def test_unet_takes_any_rows_width_and_depth(rows, depth, width):
    key = jax.random.key(0)
    out = jax.eval_shape(lambda *args: TemporalUNet(key, rows, FEATURES, width, depth)(*args), *inputs(3, rows))
    assert out.shape == (2, rows, 3, FEATURES)


def test_unet_padding_keeps_rows_in_place():
    net, (x, *rest) = denoiser("unet"), inputs(3)
    longer = jnp.concatenate([x, x[:, -1:]], 1)  # what the network pads with
    np.testing.assert_allclose(apply(net, x, *rest), apply(net, longer, *rest)[:, :5], atol=1e-6)


def test_wrong_sizes_are_refused():
    with pytest.raises(UserError, match="depth=4 of the temporal U-Net"):
        TemporalUNet(jax.random.key(0), 8, 3, 16, 4)
    with pytest.raises(UserError, match="width=2"):
        TemporalUNet(jax.random.key(0), 8, 3, 2, 1)
    with pytest.raises(UserError, match="Unknown denoiser 'u-net'; did you mean 'unet'"):
        build_denoiser(jax.random.key(0), "u-net", 8, 3, 16, 1)


def test_grouped_mlps_are_separate_networks():
    net = jax.jit(lambda key: MLP(key, (4, 8, 2), groups=3))(jax.random.key(0))
    x = jax.random.normal(jax.random.key(1), (5, 6, 3, 4))
    out = apply(net, x)
    assert out.shape == (5, 6, 3, 2)
    for i in range(3):
        (w1, w2), (b1, b2) = ([np.asarray(leaf)[i] for leaf in part] for part in (net.weights, net.biases))
        hidden = np.maximum(np.asarray(x)[:, :, i] @ w1 + b1, 0)
        np.testing.assert_allclose(out[:, :, i], hidden @ w2 + b2, atol=1e-5)
    shared = jax.tree.map(lambda leaf: leaf[:1], net)
    np.testing.assert_allclose(apply(shared, x)[:, :, 0], out[:, :, 0], atol=1e-5)
