"""From a board's lines to what compares methods: paired tests on a task, and statistics over all tasks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ringfence.datasets.registry import TASKS
from ringfence.evaluation import statistics
from ringfence.evaluation.statistics import Interval
from ringfence.evaluation.table import Result
from ringfence.report.board import Board
from ringfence.report.pooling import normal_cost, normal_return
from ringfence.report.table import Line, Method

DRAWS = 2000  # of every bootstrap


@dataclass(frozen=True)
class Contest:
    """The first of a task against another method on the same resets, every reset averaged over a method's seeds.

    Differences are first minus other, with 95 % intervals over resets; p-values are Wilcoxon's signed-rank test,
    adjusted after Holm over all contests of the task, returns and costs together.
    """

    other: Line
    returns: float
    returns_interval: Interval
    returns_p: float
    cost: float
    cost_interval: Interval
    cost_p: float


@dataclass
class Aggregate:
    """What holds over all tasks, for the methods that were measured on every one of them.

    Scores are arrays (seeds, tasks): normalised return, and normalised cost, whose limit is 1.
    """

    protocol: str  # what the tasks have in common, where a board has several
    tasks: list[str]
    methods: list[Method]
    seeds: dict[Method, tuple[int, ...]]  # those that every task has
    left_out: dict[Method, list[str]]  # method -> tasks without a result; none: no seed has all tasks
    returns: dict[Method, np.ndarray]
    costs: dict[Method, np.ndarray]
    iqm_returns: dict[Method, tuple[float, Interval | None]]  # no interval of one seed
    iqm_costs: dict[Method, tuple[float, Interval | None]]
    improves: np.ndarray  # (M, M): probability that the row's return beats the column's
    cheaper: np.ndarray  # (M, M): probability that the row's cost is below the column's
    return_thresholds: np.ndarray  # (K,)
    return_profiles: np.ndarray  # (M, K)
    return_bands: list[np.ndarray | None]  # (2, K) pointwise 95 % intervals, runs resampled within each task
    cost_thresholds: np.ndarray  # (K,)
    cost_profiles: np.ndarray  # (M, K)
    cost_bands: list[np.ndarray | None]


def contests(lines: list[Line]) -> list[Contest]:
    """The first of a task's ranked lines against each of the others."""
    if len(lines) < 2:
        return []
    first = lines[0]
    others = lines[1:]
    returns = [statistics.paired_test(_per_reset(first, "return"), _per_reset(other, "return")) for other in others]
    costs = [statistics.paired_test(_per_reset(first, "cost"), _per_reset(other, "cost")) for other in others]
    adjusted = statistics.holm([test["p"] for test in (*returns, *costs)])
    returns_p = adjusted[: len(others)]
    costs_p = adjusted[len(others) :]
    return [
        Contest(
            other=other,
            returns=returns[k]["difference"],
            returns_interval=returns[k]["interval"],
            returns_p=float(returns_p[k]),
            cost=costs[k]["difference"],
            cost_interval=costs[k]["interval"],
            cost_p=float(costs_p[k]),
        )
        for k, other in enumerate(others)
    ]


def _per_reset(line: Line, what: str) -> np.ndarray:
    return np.mean([row.result["per_episode"][what] for row in line.rows], 0)


# --- over all tasks ---


def aggregates(board: Board) -> list[Aggregate]:
    """One per protocol that the board's tasks follow: tasks that share data and policies under two limits are not two
    tasks. Protocols without a method that was measured on every task with one and the same seed are left out."""
    made = [aggregate(board, protocol, tasks) for protocol, tasks in by_protocol(board).items()]
    return [x for x in made if x is not None]


def by_protocol(board: Board) -> dict[str, list[str]]:
    """The board's tasks by what their limit follows."""
    found: dict[str, list[str]] = {}
    for task in board.tasks:
        found.setdefault(TASKS[task].protocol if task in TASKS else "", []).append(task)
    return found


def aggregate(board: Board, protocol: str = "", tasks: list[str] | None = None) -> Aggregate | None:
    """Statistics over tasks (by default all); None where no method was measured on every one with the same seed."""
    tasks = board.tasks if tasks is None else tasks
    seeds, left_out = _common_seeds(board, tasks)
    methods = list(seeds)
    if not methods:
        return None
    returns = {m: _scores(board, tasks, m, seeds[m], _normal_return) for m in methods}
    costs = {m: _scores(board, tasks, m, seeds[m], _normal_cost) for m in methods}
    episode_costs = {m: _scores(board, tasks, m, seeds[m], _normal_episode_costs) for m in methods}
    return_thresholds = np.linspace(*_range(returns), 101)
    cost_thresholds = _cost_thresholds(episode_costs)
    above = {m: (returns[m][..., None] > return_thresholds).astype(float) for m in methods}
    within = {m: (episode_costs[m][..., None] <= cost_thresholds).mean(2) for m in methods}
    return Aggregate(
        protocol=protocol,
        tasks=tasks,
        methods=methods,
        seeds=seeds,
        left_out=left_out,
        returns=returns,
        costs=costs,
        iqm_returns={m: _iqm(returns[m]) for m in methods},
        iqm_costs={m: _iqm(costs[m]) for m in methods},
        improves=_pairs(returns, methods),
        cheaper=_pairs({m: -c for m, c in costs.items()}, methods),
        return_thresholds=return_thresholds,
        return_profiles=np.array([statistics.profile(returns[m], return_thresholds) for m in methods]),
        return_bands=[_band(above[m]) for m in methods],
        cost_thresholds=cost_thresholds,
        cost_profiles=np.array([statistics.cost_profile(episode_costs[m], cost_thresholds) for m in methods]),
        cost_bands=[_band(within[m]) for m in methods],
    )


def _common_seeds(board: Board, tasks: list[str]) -> tuple[dict[Method, tuple[int, ...]], dict[Method, list[str]]]:
    """(by method the seeds that every task has; by method without any the tasks that lack it)."""
    seeds: dict[Method, tuple[int, ...]] = {}
    left_out: dict[Method, list[str]] = {}
    for method in board.methods:
        lines = {task: board.line(task, method) for task in tasks}
        had = {task: set(line.seeds) if line else set() for task, line in lines.items()}
        common = tuple(sorted(set.intersection(*had.values())))
        if common:
            seeds[method] = common
        else:
            left_out[method] = [task for task in tasks if not had[task]]
    return seeds, left_out


Score = Callable[[Result], float | np.ndarray]


def _scores(board: Board, tasks: list[str], method: Method, seeds: tuple[int, ...], score: Score) -> np.ndarray:
    """(seeds, tasks, ...) scores of a method."""
    by_task = [{row.seed: row.result for row in line.rows} for t in tasks if (line := board.line(t, method))]
    return np.array([[score(results[seed]) for results in by_task] for seed in seeds])


def _normal_return(result: Result) -> float:
    return normal_return(result["return_mean"], result["constants"])


def _normal_cost(result: Result) -> float:
    return normal_cost(result["cost_mean"], result["constants"])


def _normal_episode_costs(result: Result) -> np.ndarray:
    return normal_cost(np.array(result["per_episode"]["cost"]), result["constants"])


def _range(scores: dict[Method, np.ndarray]) -> Interval:
    """From the worst to the best run, at least from 0 to 1."""
    low = min(s.min() for s in scores.values())
    high = max(s.max() for s in scores.values())
    return min(0.0, float(low)), max(1.0, float(high))


def _cost_thresholds(episode_costs: dict[Method, np.ndarray]) -> np.ndarray:
    """From 0 to where nine of ten episodes of every method lie, at least to 3. Whole numbers are among them, since
    costs count steps."""
    most = max(float(np.quantile(costs, 0.9)) for costs in episode_costs.values())
    top = int(np.ceil(max(3.0, most)))
    return np.linspace(0.0, top, 20 * top + 1)


def _iqm(scores: np.ndarray) -> tuple[float, Interval | None]:
    """Interquartile mean over all seeds and tasks; the bootstrap resamples seeds within each task."""
    middle = float(statistics.iqm(scores))
    if len(scores) < 2:
        return middle, None
    low, high = statistics.stratified_bootstrap(scores, statistics.iqm, draws=DRAWS)
    return middle, (float(low), float(high))


def _band(shares: np.ndarray) -> np.ndarray | None:
    """(2, K): 95 % interval, at every threshold, of the mean of shares (runs, tasks, K); runs are resampled."""
    runs, tasks, _ = shares.shape
    if runs < 2:
        return None
    drawn = np.random.default_rng(0).multinomial(runs, np.full(runs, 1 / runs), (DRAWS, tasks))
    means = np.einsum("dmr,rmk->dk", drawn / (runs * tasks), shares, optimize=True)
    return np.percentile(means, [2.5, 97.5], axis=0)


def _pairs(scores: dict[Method, np.ndarray], methods: list[Method]) -> np.ndarray:
    """(M, M) probability that a run of the row scores higher than one of the column, averaged over tasks."""
    return np.array([[statistics.probability_of_improvement(scores[a], scores[b]) for b in methods] for a in methods])
