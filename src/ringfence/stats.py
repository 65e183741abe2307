"""Statistics that a table is believed by: exact bounds for violations, intervals for means, tail risk."""

from __future__ import annotations

import numpy as np
from scipy import stats


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


def bootstrap_mean(
    x: np.ndarray, level: float = 0.95, draws: int = 2000, seed: int = 0, strata: np.ndarray | None = None
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean; `strata` (same shape) resamples within each stratum, e.g. a seed."""
    x, rng = np.asarray(x, np.float64), np.random.default_rng(seed)
    groups = [x] if strata is None else [x[strata == s] for s in np.unique(strata)]
    total = np.zeros(draws)
    for g in groups:
        total += g[rng.integers(0, len(g), (draws, len(g)))].sum(1)
    tail = (1 - level) / 2 * 100
    low, high = np.percentile(total / len(x), [tail, 100 - tail])
    return float(low), float(high)


def cvar(x: np.ndarray, share: float = 0.1) -> float:
    """Mean of the worst (largest) `share` of x: conditional value at risk."""
    x = np.sort(np.asarray(x, np.float64))[::-1]
    return float(x[: max(1, int(np.ceil(share * len(x))))].mean())
