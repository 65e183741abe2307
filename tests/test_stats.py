"""Statistics against scipy, against hand-computed values and against what must hold for any data."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats as sp

from ringfence.errors import UserError
from ringfence.evaluation import statistics

RNG = np.random.default_rng(0)
SCORES = RNG.normal(size=(5, 4))


def test_binomial_bounds_are_scipys():
    for k, n in ((0, 200), (3, 200), (200, 200)):
        exact = sp.binomtest(k, n).proportion_ci(0.95, "exact")
        np.testing.assert_allclose(statistics.clopper_pearson(k, n), (exact.low, exact.high), atol=1e-9)
        one_sided = sp.binomtest(k, n, alternative="less").proportion_ci(0.95, "exact")
        assert statistics.upper_bound(k, n) == pytest.approx(one_sided.high, abs=1e-9)
    assert statistics.upper_bound(0, 1000) == pytest.approx(1 - 0.05 ** (1 / 1000))


def test_interquartile_mean():
    assert statistics.iqm(np.array([[0.0, 1.0], [2.0, 100.0]])) == 1.5
    assert statistics.iqm(SCORES) == pytest.approx(sp.trim_mean(SCORES.ravel(), 0.25))
    several = np.stack([SCORES, SCORES + 1])
    np.testing.assert_allclose(statistics.iqm(several), statistics.iqm(SCORES) + np.array([0, 1]))


@pytest.mark.parametrize("runs", [2, 3, 5])
def test_interval_of_few_runs_covers_what_it_says(runs):
    """Runs of deviation 1, resets of deviation 3 that all runs share, noise of 1; the true mean is 0."""
    rng, n, resets = np.random.default_rng(runs), 400, 30
    x = rng.normal(size=(n, runs, 1)) + 3 * rng.normal(size=(n, 1, resets)) + rng.normal(size=(n, runs, resets))
    found = np.array([statistics.mean_of_runs(one, draws=300) for one in x])
    covered = ((found[:, 0] <= 0) & (found[:, 1] >= 0)).mean()
    assert covered > 0.92


def test_interval_of_runs_that_agree_is_that_of_the_resets():
    x = np.random.default_rng(0).normal(size=200)
    low, high = statistics.mean_of_runs(np.stack([x, x, x]))
    assert (high - low) / 2 == pytest.approx(1.96 * x.std() / 200**0.5, rel=0.1)
    assert statistics.mean_of_runs(x[None]) == pytest.approx((low, high))  # one run: of its episodes alone
    assert statistics.mean_of_runs(np.full((3, 5), 2.0)) == (2.0, 2.0)
    costs = np.array([[0.0] * 9 + [1.0], [0.0] * 10])
    assert statistics.mean_of_runs(costs)[0] < 0 == statistics.mean_of_runs(costs, least=0.0)[0]
    only = statistics.mean_of_runs(np.array([[1.0, 99.0, 1.0]]), np.array([[True, False, True]]))
    assert only == (1.0, 1.0)


def test_bootstrap_of_the_mean_agrees_with_scipy():
    x = RNG.exponential(size=120)
    ours = statistics.bootstrap_mean(x, draws=8000)
    theirs = sp.bootstrap((x,), np.mean, n_resamples=8000, method="percentile", random_state=1).confidence_interval
    np.testing.assert_allclose(ours, theirs, atol=0.02)


def test_bootstrap_draws_in_blocks_and_says_the_same(monkeypatch):
    x = RNG.normal(size=50)
    whole = statistics.bootstrap_mean(x)
    monkeypatch.setattr(statistics, "BLOCK", 60)  # one draw at a time
    assert statistics.bootstrap_mean(x) == whole


def test_stratified_bootstrap_keeps_tasks_apart():
    """Tasks on scales of their own: resampling across them would blow the interval up."""
    scores = np.arange(4)[None] * 100.0 + RNG.normal(size=(30, 4))
    low, high = statistics.stratified_bootstrap(scores, lambda x: x.mean((-2, -1)))
    assert low < scores.mean() < high
    # Standard error of a mean of 120 with unit deviation within tasks: 0.09.
    assert 2 * 1.96 * 0.07 < high - low < 2 * 1.96 * 0.12
    band = statistics.stratified_bootstrap(scores, lambda x: statistics.profile(x, [-1e9, 1e9]))
    np.testing.assert_array_equal(band, [[1, 0], [1, 0]])


def test_stratified_bootstrap_agrees_with_scipy():
    """Every task is a sample of its own there."""
    scores = np.arange(3)[None] * 10.0 + RNG.normal(size=(8, 3))
    ours = statistics.stratified_bootstrap(scores, statistics.iqm, draws=8000)

    def iqm(*tasks, axis):
        return sp.trim_mean(np.stack(np.broadcast_arrays(*tasks), -1).reshape(*tasks[0].shape[:-1], -1), 0.25, axis)

    found = sp.bootstrap(tuple(scores.T), iqm, n_resamples=8000, method="percentile", random_state=1)
    np.testing.assert_allclose(ours, found.confidence_interval, atol=0.1)


def test_aggregates_are_rliables():
    """Agarwal et al.'s own code, where it is installed; it brings too much for the test extra."""
    library = pytest.importorskip("rliable.library")
    metrics = pytest.importorskip("rliable.metrics")
    x = RNG.normal(size=(5, 4))
    y = RNG.normal(size=(7, 4)) - 0.3
    assert statistics.iqm(x) == pytest.approx(metrics.aggregate_iqm(x))
    assert statistics.probability_of_improvement(x, y) == pytest.approx(metrics.probability_of_improvement(x, y))
    taus = np.linspace(-2, 2, 9)
    np.testing.assert_allclose(statistics.profile(x, taus), library.score_distributions(x, taus))


def test_probability_of_improvement_is_mann_whitneys():
    x, y = RNG.normal(size=(6, 1)), RNG.normal(size=(9, 1)) - 0.5
    u = sp.mannwhitneyu(x[:, 0], y[:, 0]).statistic
    assert statistics.probability_of_improvement(x, y) == pytest.approx(u / 54)
    with pytest.raises(UserError, match="same tasks"):
        statistics.probability_of_improvement(x, np.ones((3, 2)))


def test_profiles():
    np.testing.assert_allclose(statistics.profile([[0.0, 1.0], [2.0, 3.0]], [-1, 0, 1.5, 3]), [1, 0.75, 0.5, 0])
    np.testing.assert_allclose(statistics.cost_profile([0, 0, 2, 5], [0, 2, 4]), [0.5, 0.75, 0.75])


def test_paired_test():
    x = RNG.normal(size=40)
    y = x - 0.5 + 0.1 * RNG.normal(size=40)
    found = statistics.paired_test(x, y)
    assert found["p"] == pytest.approx(sp.wilcoxon(x, y).pvalue)
    assert found["interval"][0] < found["difference"] < found["interval"][1]
    assert statistics.paired_test(x, x)["p"] == 1.0


def test_holm_by_hand():
    np.testing.assert_allclose(statistics.holm([0.04, 0.01, 0.03, 0.9]), [0.09, 0.04, 0.09, 0.9])


def test_ranking_is_lexicographic():
    order = statistics.rank(returns=[500, 300, 400, 100], costs=[3.0, 0.5, 0.9, 2.0], limit=1.0)
    assert order.tolist() == [2, 1, 3, 0]


def test_tables_of_another_shape_are_refused():
    with pytest.raises(UserError, match=r"\(runs, tasks\)"):
        statistics.stratified_bootstrap(np.ones(3), statistics.iqm)


MATRICES = arrays(np.float64, st.tuples(st.integers(1, 6), st.just(3)), elements=st.floats(-10, 10, width=16))


@given(MATRICES, MATRICES)
def test_improvement_of_both_sides_adds_to_one(x, y):
    total = statistics.probability_of_improvement(x, y) + statistics.probability_of_improvement(y, x)
    assert total == pytest.approx(1.0)


@given(MATRICES)
def test_interquartile_mean_lies_within_and_forgets_order(x):
    value = float(statistics.iqm(x))
    assert x.min() - 1e-9 <= value <= x.max() + 1e-9
    assert float(statistics.iqm(x[::-1])) == pytest.approx(value)


@given(arrays(np.float64, st.integers(1, 8), elements=st.floats(0, 1)))
def test_holm_is_monotone_and_never_smaller(p):
    adjusted = statistics.holm(p)
    assert (adjusted >= p - 1e-12).all() and (adjusted <= 1).all()
    assert (np.diff(adjusted[np.argsort(p, kind="stable")]) >= -1e-12).all()
