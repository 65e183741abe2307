"""Statistics that a table is believed by: exact bounds for violations, intervals for means, tail risk, comparisons.

Aggregates over tasks follow Agarwal et al. 2021 ("Deep reinforcement learning at the edge of the statistical
precipice"): a matrix of scores (R runs, M tasks), whose intervals resample runs within every task.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from ringfence.errors import UserError

BLOCK = 4_000_000  # numbers drawn at once
Interval = tuple[float, float]


class PairedTest(TypedDict):
    """One sample against another on the same resets."""

    difference: float  # of the means
    interval: Interval
    p: float


def clopper_pearson(violations: int, episodes: int, level: float = 0.95) -> Interval:
    """Exact two-sided interval for a probability from independent episodes (Clopper & Pearson 1934)."""
    tail = (1.0 - level) / 2
    return _lower(violations, episodes, tail), _upper(violations, episodes, 1 - tail)


def upper_bound(violations: int, episodes: int, level: float = 0.95) -> float:
    """Exact one-sided upper bound: with 0 of 1000, 0.30 % at 95 %."""
    return _upper(violations, episodes, level)


def _lower(violations: int, episodes: int, quantile: float) -> float:
    """scipy's `binomtest(...).proportion_ci("exact")` gives the same, to nine digits, by a search."""
    return float(special.betaincinv(violations, episodes - violations + 1, quantile)) if violations else 0.0


def _upper(violations: int, episodes: int, quantile: float) -> float:
    if violations == episodes:
        return 1.0
    return float(special.betaincinv(violations + 1, episodes - violations, quantile))


def bootstrap_mean(x: ArrayLike, level: float = 0.95, draws: int = 2000, seed: int = 0) -> Interval:
    """Percentile bootstrap interval of the mean."""
    x = np.asarray(x, np.float64)
    rng = np.random.default_rng(seed)
    block = max(1, BLOCK // len(x))  # 2000 draws of 40 000 episodes at once would take more than a gigabyte
    sizes = [min(block, draws - first) for first in range(0, draws, block)]
    means = [x[rng.integers(0, len(x), (size, len(x)))].mean(1) for size in sizes]
    low, high = _percentiles(np.concatenate(means), level)
    return float(low), float(high)


def mean_of_runs(
    x: ArrayLike, counted: ArrayLike | None = None, least: float = -np.inf, level: float = 0.95, draws: int = 2000
) -> Interval:
    """Interval of the mean of x (R, E): R training runs that all played the same E resets. `counted` (R, E) leaves
    entries out; no value can be below `least`.

    Two sources of chance are added in quadrature: which resets were drawn (percentile bootstrap, a reset drawn for all
    runs at once) and which runs were trained (Student's t of the runs' means, R − 1 degrees of freedom). A bootstrap
    over two or three runs would cover a half or three quarters where it says 95 %. One run leaves the second part out:
    it is unknown.
    """
    x = np.asarray(x, np.float64)
    counted = np.ones_like(x) if counted is None else np.asarray(counted, np.float64)
    total = (x * counted).sum(0)
    number = counted.sum(0)
    mean = total.sum() / number.sum()
    drawn = _drawn(x.shape[1], draws)
    weight = drawn @ number
    low, high = _percentiles((drawn @ total)[weight > 0] / weight[weight > 0], level)
    some = counted.sum(1) > 0  # runs that have any entry
    between = _half_width((x * counted).sum(1)[some] / counted.sum(1)[some], level)
    return max(float(mean - np.hypot(mean - low, between)), least), float(mean + np.hypot(high - mean, between))


def _half_width(means: np.ndarray, level: float) -> float:
    """Of Student's interval of the mean of runs' means; 0 of one run."""
    if len(means) < 2:
        return 0.0
    return float(special.stdtrit(len(means) - 1, (1 + level) / 2) * means.std(ddof=1) / len(means) ** 0.5)


@functools.lru_cache(maxsize=8)
def _drawn(n: int, draws: int) -> np.ndarray:
    """(draws, n): how often each draw takes each of n resets; all rows of a table share them."""
    return np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), draws).astype(float)


def cvar(x: ArrayLike, share: float = 0.1) -> float:
    """Mean of the worst (largest) `share` of x: conditional value at risk."""
    worst_first = np.sort(np.asarray(x, np.float64))[::-1]
    number = max(1, int(np.ceil(share * len(worst_first))))
    return float(worst_first[:number].mean())


def iqm(scores: ArrayLike) -> np.ndarray:
    """Interquartile mean of (..., R, M) scores: the mean of the middle half of all R·M of them."""
    x = np.asarray(scores, np.float64)
    from scipy import stats  # slow to import, and no evaluation needs it

    return stats.trim_mean(x.reshape(*x.shape[:-2], -1), 0.25, axis=-1)


def stratified_bootstrap(
    scores: ArrayLike,
    statistic: Callable[[np.ndarray], np.ndarray],
    level: float = 0.95,
    draws: int = 2000,
    seed: int = 0,
) -> np.ndarray:
    """(2, ...) percentile interval of statistic(scores) for (R, M) scores; runs are resampled within every task.

    `statistic` maps (draws, R, M) to (draws, ...), e.g. `iqm`. One run has no interval: it is refused.
    """
    x = _matrix(scores)
    if len(x) < 2:
        raise UserError("One run per task says nothing about the spread between runs; an interval needs two or more.")
    parts = [statistic(part) for part in _resamples(x, draws, np.random.default_rng(seed))]
    return _percentiles(np.concatenate(parts), level)


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> float:
    """Mean over tasks of P(X > Y) + P(X = Y)/2 for a run of X (R, M) and one of Y (R', M)."""
    ours = _matrix(x)
    theirs = _matrix(y)
    if ours.shape[1] != theirs.shape[1]:
        raise UserError(f"The two have {ours.shape[1]} and {theirs.shape[1]} tasks; compare them on the same tasks.")
    pairs = ours[:, None], theirs[None]  # (R, R', M)
    return float(np.mean(np.greater(*pairs) + 0.5 * np.equal(*pairs)))


def profile(scores: ArrayLike, thresholds: ArrayLike) -> np.ndarray:
    """(..., T) share of (..., R, M) scores above each threshold: a performance profile."""
    x = np.asarray(scores, np.float64)
    return np.stack([(x > t).mean((-2, -1)) for t in np.asarray(thresholds)], -1)


def cost_profile(costs: ArrayLike, thresholds: ArrayLike) -> np.ndarray:
    """(T,) share of episodes whose cost is at most each threshold."""
    x = np.asarray(costs, np.float64).ravel()
    return np.array([(x <= t).mean() for t in np.asarray(thresholds)])


def paired_test(x: ArrayLike, y: ArrayLike) -> PairedTest:
    """x against y on the same resets: mean difference, its bootstrap interval, Wilcoxon's signed-rank p-value."""
    from scipy import stats

    difference = np.asarray(x, np.float64) - np.asarray(y, np.float64)
    p = float(np.asarray(stats.wilcoxon(difference))[1]) if difference.any() else 1.0
    return {"difference": float(difference.mean()), "interval": bootstrap_mean(difference), "p": p}


def holm(p_values: ArrayLike) -> np.ndarray:
    """Holm's step-down adjustment: p-values of a family of tests, in the input's order."""
    p = np.asarray(p_values, np.float64)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    return adjusted


def rank(returns: ArrayLike, costs: ArrayLike, limit: float) -> np.ndarray:
    """Order of entries, best first: those whose cost is within the limit by higher return, then the rest by lower
    cost. Pass the upper ends of the costs' intervals to demand more than a point estimate."""
    safe, key = _merit(returns, costs, limit)
    return np.lexsort((key, ~safe))


def places(returns: ArrayLike, costs: ArrayLike, limit: float) -> np.ndarray:
    """The place of every entry in the order of `rank`, from 1; equal entries share the better one."""
    safe, key = _merit(returns, costs, limit)
    ahead = (safe[:, None] > safe) | ((safe[:, None] == safe) & (key[:, None] < key))
    return 1 + ahead.sum(0)


def _merit(returns: ArrayLike, costs: ArrayLike, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """(which entries are within the limit, what is least for the best among equals in that)."""
    costs = np.asarray(costs, np.float64)
    safe = costs <= limit
    return safe, np.where(safe, -np.asarray(returns, np.float64), costs)


def _matrix(scores: ArrayLike) -> np.ndarray:
    x = np.asarray(scores, np.float64)
    if x.ndim != 2 or not x.size:
        raise UserError(f"Scores of shape {x.shape} are not a table; pass (runs, tasks).")
    return x


def _resamples(x: np.ndarray, draws: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Resampled copies (block, R, M), `draws` in all."""
    block = max(1, BLOCK // x.size)
    for first in range(0, draws, block):
        rows = rng.integers(0, len(x), (min(block, draws - first), *x.shape))
        yield np.take_along_axis(x[None], rows, 1)


def _percentiles(x: np.ndarray, level: float) -> np.ndarray:
    """(2, ...) low and high of draws (draws, ...)."""
    tail = (1 - level) / 2 * 100
    return np.percentile(x, [tail, 100 - tail], axis=0)
