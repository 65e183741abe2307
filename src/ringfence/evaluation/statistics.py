"""Statistics that a table is believed by: exact bounds for violations, intervals for means, tail risk, comparisons.

Aggregates over tasks follow Agarwal et al. 2021 ("Deep reinforcement learning at the edge of the statistical
precipice"): a matrix of scores (R runs, M tasks), whose intervals resample runs within every task.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator

import numpy as np
from scipy import stats

from ringfence.errors import UserError

BLOCK = 4_000_000  # numbers drawn at once


def clopper_pearson(violations: int, episodes: int, level: float = 0.95) -> tuple[float, float]:
    """Exact two-sided interval for a probability from independent episodes (Clopper & Pearson 1934)."""
    tail = (1.0 - level) / 2
    low = 0.0 if violations == 0 else float(stats.beta.ppf(tail, violations, episodes - violations + 1))
    high = 1.0 if violations == episodes else float(stats.beta.ppf(1 - tail, violations + 1, episodes - violations))
    return low, high


def upper_bound(violations: int, episodes: int, level: float = 0.95) -> float:
    """Exact one-sided upper bound: with 0 of 1000, 0.30 % at 95 %."""
    if violations == episodes:
        return 1.0
    return float(stats.beta.ppf(level, violations + 1, episodes - violations))


def bootstrap_mean(x: np.ndarray, level: float = 0.95, draws: int = 2000, seed: int = 0) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean."""
    x, rng = np.asarray(x, np.float64), np.random.default_rng(seed)
    block = max(1, BLOCK // len(x))  # 2000 draws of 40 000 episodes at once would take more than a gigabyte
    sizes = [min(block, draws - first) for first in range(0, draws, block)]
    return _percentiles(np.concatenate([x[rng.integers(0, len(x), (n, len(x)))].mean(1) for n in sizes]), level)


def mean_of_runs(
    x: np.ndarray, counted: np.ndarray | None = None, least: float = -np.inf, level: float = 0.95, draws: int = 2000
) -> tuple[float, float]:
    """Interval of the mean of x (R, E): R training runs that all played the same E resets. `counted` (R, E) leaves
    entries out; no value can be below `least`.

    Two sources of chance are added in quadrature: which resets were drawn (percentile bootstrap, a reset drawn for all
    runs at once) and which runs were trained (Student's t of the runs' means, R − 1 degrees of freedom). A bootstrap
    over two or three runs would cover a half or three quarters where it says 95 %. One run leaves the second part out:
    it is unknown.
    """
    x = np.asarray(x, np.float64)
    counted = np.ones_like(x) if counted is None else np.asarray(counted, np.float64)
    total, number = (x * counted).sum(0), counted.sum(0)
    mean, drawn = total.sum() / number.sum(), _drawn(x.shape[1], draws)
    weight = drawn @ number
    low, high = _percentiles((drawn @ total)[weight > 0] / weight[weight > 0], level)
    told = counted.sum(1) > 0
    runs = (x * counted).sum(1)[told] / counted.sum(1)[told]
    between = 0.0
    if len(runs) > 1:
        between = stats.t.ppf((1 + level) / 2, len(runs) - 1) * runs.std(ddof=1) / len(runs) ** 0.5
    return max(float(mean - np.hypot(mean - low, between)), least), float(mean + np.hypot(high - mean, between))


@functools.lru_cache(maxsize=8)
def _drawn(n: int, draws: int) -> np.ndarray:
    """(draws, n): how often each draw takes each of n resets; all rows of a table share them."""
    return np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), draws).astype(float)


def cvar(x: np.ndarray, share: float = 0.1) -> float:
    """Mean of the worst (largest) `share` of x: conditional value at risk."""
    x = np.sort(np.asarray(x, np.float64))[::-1]
    return float(x[: max(1, int(np.ceil(share * len(x))))].mean())


def iqm(scores: np.ndarray) -> np.ndarray:
    """Interquartile mean of (..., R, M) scores: the mean of the middle half of all R·M of them."""
    x = np.asarray(scores, np.float64)
    return stats.trim_mean(x.reshape(*x.shape[:-2], -1), 0.25, axis=-1)


def stratified_bootstrap(
    scores: np.ndarray,
    statistic: Callable[[np.ndarray], np.ndarray],
    level: float = 0.95,
    draws: int = 2000,
    seed: int = 0,
) -> tuple[float | np.ndarray, float | np.ndarray]:
    """Percentile interval of statistic(scores) for (R, M) scores; runs are resampled within every task.

    `statistic` maps (draws, R, M) to (draws, ...), e.g. `iqm`. One run has no interval: it is refused.
    """
    x = _several(scores)
    parts = [statistic(part) for part in _resamples(x, draws, np.random.default_rng(seed))]
    return _percentiles(np.concatenate(parts), level)


def probability_of_improvement(x: np.ndarray, y: np.ndarray) -> float:
    """Mean over tasks of P(X > Y) + P(X = Y)/2 for a run of X (R, M) and one of Y (R', M)."""
    x, y = _matrix(x), _matrix(y)
    if x.shape[1] != y.shape[1]:
        raise UserError(f"The two have {x.shape[1]} and {y.shape[1]} tasks; compare them on the same tasks.")
    return float(_improvement(x[None], y[None])[0])


def profile(scores: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """(..., T) share of (..., R, M) scores above each threshold: a performance profile."""
    x = np.asarray(scores, np.float64)
    return np.stack([(x > t).mean((-2, -1)) for t in np.asarray(thresholds)], -1)


def cost_profile(costs: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """(T,) share of episodes whose cost is at most each threshold."""
    x = np.asarray(costs, np.float64).ravel()
    return np.array([(x <= t).mean() for t in np.asarray(thresholds)])


def paired_test(x: np.ndarray, y: np.ndarray) -> dict[str, float | tuple[float, float]]:
    """x against y on the same resets: mean difference, its bootstrap interval, Wilcoxon's signed-rank p-value."""
    difference = np.asarray(x, np.float64) - np.asarray(y, np.float64)
    p = 1.0 if not difference.any() else float(stats.wilcoxon(difference).pvalue)
    return {"difference": float(difference.mean()), "interval": bootstrap_mean(difference), "p": p}


def holm(p_values: np.ndarray) -> np.ndarray:
    """Holm's step-down adjustment: p-values of a family of tests, in the input's order."""
    p = np.asarray(p_values, np.float64)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    return adjusted


def rank(returns: np.ndarray, costs: np.ndarray, limit: float) -> np.ndarray:
    """Order of entries, best first: those whose cost is within the limit by higher return, then the rest by lower
    cost. Pass the upper ends of the costs' intervals to demand more than a point estimate."""
    safe, key = _merit(returns, costs, limit)
    return np.lexsort((key, ~safe))


def places(returns: np.ndarray, costs: np.ndarray, limit: float) -> np.ndarray:
    """The place of every entry in the order of `rank`, from 1; equal entries share the better one."""
    safe, key = _merit(returns, costs, limit)
    ahead = (safe[:, None] > safe) | ((safe[:, None] == safe) & (key[:, None] < key))
    return 1 + ahead.sum(0)


def _merit(returns: np.ndarray, costs: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """(who is within the limit, what is least for the best among equals in that)."""
    returns, costs = np.asarray(returns, np.float64), np.asarray(costs, np.float64)
    safe = costs <= limit
    return safe, np.where(safe, -returns, costs)


def _matrix(scores: np.ndarray) -> np.ndarray:
    x = np.asarray(scores, np.float64)
    if x.ndim != 2 or not x.size:
        raise UserError(f"Scores of shape {x.shape} are not a table; pass (runs, tasks).")
    return x


def _several(scores: np.ndarray) -> np.ndarray:
    x = _matrix(scores)
    if len(x) < 2:
        raise UserError("One run per task says nothing about the spread between runs; an interval needs two or more.")
    return x


def _resamples(x: np.ndarray, draws: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Resampled copies (block, R, M), `draws` in all."""
    block = max(1, BLOCK // x.size)
    for first in range(0, draws, block):
        rows = rng.integers(0, len(x), (min(block, draws - first), *x.shape))
        yield np.take_along_axis(x[None], rows, 1)


def _improvement(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(draws,) of (draws, R, M) and (draws, R', M)."""
    a, b = x[:, :, None], y[:, None]
    return ((a > b) + 0.5 * (a == b)).mean((1, 2, 3))


def _percentiles(x: np.ndarray, level: float):
    tail = (1 - level) / 2 * 100
    low, high = np.percentile(x, [tail, 100 - tail], axis=0)
    return (float(low), float(high)) if np.ndim(low) == 0 else (low, high)
