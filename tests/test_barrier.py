"""The barrier's conditions, the retention schedule, and who gets which gradient."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.algos import icbf
from ringfence.algos.algorithm1 import loss_of_agent
from ringfence.datasets import registry
from ringfence.envs import SimpleSpread
from ringfence.errors import UserError
from ringfence.logs.windows import WindowData, at, draw
from ringfence.nets import MLP
from ringfence.nets.layers import barrier_on
from ringfence.problem import constraints, normalise
from ringfence.proposals import retention as cbf
from ringfence.proposals.diffusion import cosine_schedule
from ringfence.training import loop
from ringfence.training.job import make_job
from tests.quick import QUICK_WORLD

BAR = cosine_schedule(200)
RELAXATIONS = ("signal", "linear", "none")

# ---------------------------------------------------------------------------------------------------------------------
# retention


@pytest.mark.parametrize("m", [0.0, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("relaxation", RELAXATIONS)
def test_relaxation_stays_between_0_and_m_and_vanishes_on_clean_plans(m, relaxation):
    eta = cbf.Retention(m, relaxation).eta(BAR)
    assert eta.shape == (200,) and (eta >= 0).all() and (eta <= m).all()
    assert (np.diff(eta) >= 0).all()
    assert eta[0] <= 1e-3 * m
    assert eta[-1] == pytest.approx(0.0 if relaxation == "none" else m, abs=1e-6)


@pytest.mark.parametrize("m", [1.0, 1.5, -0.1])
def test_impossible_retention_is_refused(m):
    with pytest.raises(UserError, match=rf"retention m={m} must lie in \[0, 1\)"):
        cbf.Retention(m)
    with pytest.raises(UserError, match="Unknown relaxation 'cosine'"):
        cbf.Retention(0.9, "cosine")


@pytest.mark.parametrize("two_sided", [True, False])
def test_conservatism_grows_with_m_and_shrinks_with_noise(two_sided):
    def least(h, m, eta):
        return np.asarray(cbf.Retention(m, two_sided=two_sided).decay(jnp.asarray(h), eta))

    h = np.linspace(0.0, 2.0, 9)
    by_m = np.stack([least(h, m, 0.0) for m in (0.0, 0.3, 0.6, 0.9, 0.99)])
    assert (np.diff(by_m, axis=0) >= 0).all() and (by_m <= h).all()  # never asks a safe state to become safer
    by_eta = np.stack([least(h, 0.9, eta) for eta in (0.0, 0.3, 0.6, 0.9)])
    assert (np.diff(by_eta, axis=0) <= 1e-6).all()
    np.testing.assert_allclose(by_eta[-1], 0, atol=1e-6)  # all noise: any safe state will do
    worse = np.stack([least(-h, 0.9, eta) for eta in (0.0, 0.3, 0.6, 0.9)])
    assert (np.diff(worse, axis=0)[:, 1:] <= 0).all() == two_sided  # the trap: one-sided relaxation is stricter here
    np.testing.assert_allclose(worse[-1], -h if two_sided else 0 * h, atol=1e-6)
    assert np.isfinite(least(-h, 0.0, 0.0)).all()


def test_a_parked_agent_is_satisfied_from_the_fixed_point_on():
    everywhere = jnp.ones((1, 5, 2), bool)
    cases = [(m, delta, scaled) for m, delta in ((0.0, 0.1), (0.9, 0.02), (0.5, 0.1)) for scaled in (True, False)]

    @jax.jit
    def losses(levels):  # (cases, 3) constant barriers -> (cases, 3)
        def of(case, h):
            m, delta, scaled = case
            h = jnp.full((1, 5, 2), h)
            one = jnp.ones((1, 1, 1))
            return cbf.shaping(h, everywhere, cbf.Retention(m), 0.0, delta, scaled, one)

        return jnp.stack([jax.vmap(lambda h, c=case: of(c, h))(level) for case, level in zip(cases, levels)])

    points = np.array([delta if scaled else delta / (1 - m) for m, delta, scaled in cases])
    met = np.asarray(losses(points[:, None] * [0.99, 1.01, 10.0])) < 1e-7
    np.testing.assert_array_equal(met, [[False, True, True]] * len(cases))


# ---------------------------------------------------------------------------------------------------------------------
# hinges


def test_the_printed_loss_is_a_sum_over_the_states_of_a_plan():
    h = np.array([0.05, 0.5, -0.3, 0.2], np.float32)[None]
    safe = np.array([True, True, False, True])[None]
    of = jax.jit(lambda valid, first: loss_of_agent(h, ~safe, safe, valid, first, cbf.Retention(0.5), 0.0, 0.1))
    everywhere = np.ones((1, 4), bool)
    # pairs that start in a safe state: (0.05, 0.5), (0.5, -0.3)
    pairs = 0.1 + 0.3 + 0.25
    loss, metrics = of(everywhere, np.array([False]))
    assert float(loss) == pytest.approx(pairs)
    assert {k.removeprefix("barrier/made_"): round(float(v), 4) for k, v in metrics.items()} == {
        "accuracy_safe": 1.0,
        "accuracy_unsafe": 1.0,
        "accuracy_retention": 0.5,
        "share_unsafe": 0.25,
    }
    loss, _ = of(everywhere, np.array([True]))  # S_0: where an episode begins, and there alone
    assert float(loss) == pytest.approx(pairs + 0.1 - 0.05)
    loss, metrics = of(np.array([True, True, False, False])[None], np.array([True]))  # the last two rows are padding
    assert float(loss) == pytest.approx(0.1 - 0.05) and float(metrics["barrier/made_share_unsafe"]) == 0
    several = jax.jit(lambda h: loss_of_agent(h, h < 0, h >= 0, h < 9, h[:, 0] > -9, cbf.Retention(0.5), 0.0, 0.1)[0])
    assert float(several(np.repeat(h, 3, 0))) == pytest.approx(float(several(h)))  # a mean over plans


def test_shaping_only_ever_raises_h_and_never_blames_the_present():
    h = jax.random.normal(jax.random.key(0), (4, 6, 3))
    valid = jnp.ones((4, 6, 1), bool).at[0, 4:].set(False)
    shaped = lambda h: cbf.shaping(h, valid, cbf.Retention(0.9), 0.0, 0.1, True, jnp.ones((4, 1, 1)))  # noqa: E731
    gradient = np.asarray(jax.jit(jax.grad(shaped))(h))
    assert (gradient <= 0).all() and (gradient[:, 1:] < 0).any()
    assert not gradient[:, 0].any()  # row 0 is the present, which no plan can change
    assert not gradient[0, 4:].any()  # padded
    assert not np.asarray(jax.jit(jax.grad(shaped))(jnp.full_like(h, 0.11))).any()


# ---------------------------------------------------------------------------------------------------------------------
# routing


@pytest.fixture(scope="module")
def scene(small_store):
    """Real windows, their normaliser and hazard, and a barrier that is positive everywhere, so that all hinges of
    unsafe states bite."""
    table = SimpleSpread().feature_map("pruned")
    data = WindowData(small_store, table)
    hazard = constraints.bind(constraints.Separation(), table.names, 3)
    batch = jax.jit(at, static_argnums=(2, 3))(data.arrays, jnp.arange(0, data.steps, 40), 4, 0)
    norm = normalise.fit(np.asarray(batch.features), np.asarray(batch.valid), 0, "displacement")
    net = jax.jit(lambda key: MLP(key, (18, 8, 8, 8, 1), groups=3))(jax.random.key(0))
    net.biases[-1] = net.biases[-1] + 3.0
    frozen = {"normaliser": norm}
    return data, batch, hazard, net, frozen


def config(routing) -> icbf.Config:
    return icbf.Config(routing=routing, horizon=4, barrier_batch=8, delta=0.1)


@pytest.fixture(scope="module")
def losses(scene):
    """losses(net, x, valid) -> value of Σ_i L_i^C as printed, its gradients to (net, x)."""
    _, _, hazard, _, frozen = scene

    @jax.jit
    def everything(net, x, valid):
        def of(net, x):
            unsafe, safe = hazard.labels(jax.lax.stop_gradient(x))
            h = barrier_on(net, frozen["normaliser"], x)
            begins = jnp.ones(len(x), bool)
            return sum(
                loss_of_agent(h[..., i], unsafe[..., i], safe[..., i], valid, begins, cbf.Retention(0.9), 0.1, 0.1)[0]
                for i in range(3)
            )

        return jax.value_and_grad(of, (0, 1))(net, x)

    return everything


@pytest.fixture(scope="module")
def follow(small_world):
    """follow(x, valid) -> value of L_θ of `split`, its gradient to x, metrics."""

    @jax.jit
    def everything(x, valid):
        one = jnp.ones((len(x), 1, 1))

        def of(x):
            return icbf.followed(small_world.barrier, icbf.Generated(x, valid, 0.1 * one, one), config("split"))

        (value, metrics), pull = jax.value_and_grad(of, has_aux=True)(x)
        return value, pull, metrics

    return everything


def moves(gradient) -> bool:
    return any(np.asarray(leaf).any() for leaf in jax.tree.leaves(gradient))


@jax.jit
def rise(net, frozen, x, direction):
    """Derivative of Σ h along `direction` at states x."""
    return jax.jvp(lambda x: barrier_on(net, frozen["normaliser"], x).sum(), (x,), (direction,))[1]


def test_as_printed_the_dangerous_term_pays_the_generator_for_danger(scene, losses):
    _, batch, hazard, net, frozen = scene
    x = batch.features.at[..., 10:14].set(0.1)  # the offsets of the others
    assert hazard.labels(x)[0].all()  # only the dangerous term is left
    value, (to_net, to_x) = losses(net, x, batch.valid)
    assert value > 0 and moves(to_net) and moves(to_x)
    assert rise(net, frozen, x, -to_x) < 0  # deeper into danger


def test_split_pulls_generated_states_towards_higher_h(scene, follow, small_world):
    _, batch, _, _, _ = scene
    x = batch.features.at[..., 10:14].multiply(0.1)  # the offsets of the others: everybody is near
    value, to_x, metrics = follow(x, batch.valid)
    assert value > 0 and moves(to_x) and not moves(to_x[:, 0])  # the present
    h = lambda x: small_world.barrier.of_steps(x, x).sum()  # noqa: E731
    assert jax.jvp(h, (x,), (-to_x,))[1] > 0


@pytest.mark.parametrize("case", ["all unsafe", "all safe", "all between", "nothing valid"])
def test_empty_sets_are_finite(scene, losses, follow, case):
    _, batch, hazard, net, _ = scene
    x, valid = batch.features, batch.valid
    if case == "all unsafe":
        x = x.at[..., 10:14].set(0.1)
    elif case == "nothing valid":
        valid = jnp.zeros_like(valid)
    else:
        x = x.at[..., 10:14].set(1.0 if case == "all safe" else 0.24)  # the offsets of the others
        assert hazard.labels(x)[1].all() == (case == "all safe") and not hazard.labels(x)[0].any()
    for leaf in jax.tree.leaves((losses(net, x, valid), follow(x, valid))):
        assert np.isfinite(leaf).all()


def test_means_do_not_depend_on_the_number_of_agents():
    """The same h for every agent gives the same loss for 2 and for 6 of them."""

    def means(n):
        h = jnp.broadcast_to(jnp.linspace(-1, 1, 20).reshape(4, 5, 1), (4, 5, n))
        valid = jnp.ones((4, 5, 1), bool)
        shaped = cbf.shaping(h, valid, cbf.Retention(0.9), 0.0, 0.1, True, jnp.ones((4, 1, 1)))
        return float(shaped)

    assert means(2) == pytest.approx(means(6), rel=1e-5)


def test_paper_needs_a_formula():
    hazard = constraints.bind(constraints.CostColumn(), SimpleSpread().feature_map("pruned").names, 3)
    with pytest.raises(UserError, match="routing='paper' labels generated states"):
        icbf.check(config("paper"), hazard)


def test_the_share_of_the_barrier_rises_on_schedule():
    c = icbf.Config(num_updates=100, barrier_weight=0.4, barrier_start=0.2, barrier_full=0.6)
    shares = [float(icbf.barrier_share(c, step)) for step in (0, 20, 30, 40, 60, 100)]
    assert shares == pytest.approx([0, 0, 0.1, 0.2, 0.4, 0.4], abs=1e-6)


def test_algorithm_1_takes_steps_of_its_own(small_store, small_world):
    """θ takes a step for L^D and one for every agent; with λ = 0 those teach it nothing, and φ learns the same."""
    task = registry.from_store(small_store)
    tiny = dict(num_updates=12, batch=16, width=16, depth=1, barrier_width=8, horizon=4, diffusion_steps=20)
    kept = {}
    for weight in (0.0, 1.0):
        changes = tiny | {"inverse_width": 16, "gradient": "chain:2", "barrier_weight": weight}
        job = make_job("icbf", task, "algorithm1", changes, small_store, QUICK_WORLD)
        data = loop.windows_of(job, small_store, small_world)
        about = (data, job.feature_map, job.hazard, small_world)
        state = job.algorithm.init(jax.random.key(0), job.spec, job.config, *about)
        update = jax.jit(job.algorithm.make_update(job.config, job.spec, job.feature_map, job.hazard))
        batch = draw(data.arrays, jax.random.key(1), 16, 4, job.config.window_history)
        kept[weight], metrics = update(state, batch, jax.random.key(2))
    counts = {w: int(kept[w]["opt"]["denoiser"][1][0].count) for w in kept}
    assert counts == {0.0: 1, 1.0: 4}
    assert metrics["loss/shaping"] > 0
    for name in ("inverse", "denoiser"):
        moved = moves(jax.tree.map(lambda a, b: a - b, *(kept[w]["params"][name] for w in kept)))
        assert moved == (name == "denoiser"), name
