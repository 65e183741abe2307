"""From a board's rows to numbers: one standing per task and method, ranks, and what holds over all tasks."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ringfence.datasets.registry import TASKS
from ringfence.evaluation import statistics
from ringfence.report.board import Board, Entry, Method
from ringfence.report.figures import COLOURS
from ringfence.report.pooling import Interval, Numbers, mean_of, normal_cost, normal_return, pool
from ringfence.types import Array

DRAWS = 2000  # of every bootstrap


@dataclass(kw_only=True)
class Standing(Numbers):
    """A method on a task over its seeds, or a reference policy."""

    task: str
    name: str
    variant: str
    method: Method | None  # None: a reference
    seeds: tuple[int, ...]
    returns_sd: float | None = None  # between seeds; None with fewer than two
    returns_norm_sd: float | None = None
    cost_sd: float | None = None
    ended: float | None = None  # share of episodes that ended before the time limit; None: not said
    steps: float | None = None  # mean of an episode
    train_seconds: float | None = None  # of one seed
    plan_ms: float | None = None  # median of one joint action
    parameters: int | None = None
    rank: int = 0  # on this task, from 1; 0 for references
    best: bool = False  # the highest return among the safe
    style: tuple[int, int] = (0, 0)  # colour, marker
    entries: list[Entry] = field(default_factory=list, repr=False)

    @property
    def reference(self) -> bool:
        return self.method is None

    @property
    def label(self) -> str:
        return f"{self.name} {self.variant}".strip()


@dataclass(frozen=True)
class Contest:
    """The first of a task against another method on the same resets, every reset averaged over a method's seeds.

    Differences are first minus other, with 95 % intervals over resets; p-values are Wilcoxon's signed-rank test,
    adjusted after Holm over all contests of the task, returns and costs together.
    """

    other: Standing
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
    returns: dict[Method, Array]
    costs: dict[Method, Array]
    iqm_returns: dict[Method, tuple[float, Interval | None]]  # no interval of one seed
    iqm_costs: dict[Method, tuple[float, Interval | None]]
    improves: Array  # (M, M): probability that the row's return beats the column's
    cheaper: Array  # (M, M): probability that the row's cost is below the column's
    return_thresholds: Array  # (K,)
    return_profiles: Array  # (M, K)
    return_bands: list[Array | None]  # (2, K) pointwise 95 % intervals, runs resampled within each task
    cost_thresholds: Array  # (K,)
    cost_profiles: Array  # (M, K)
    cost_bands: list[Array | None]


def standings(board: Board) -> dict[str, list[Standing]]:
    """By task: the methods that were measured on it, ranked, in the order of rank."""
    styles = _styles(board.methods)
    made = {}
    for task in board.tasks:
        rows = [_standing(board, task, m, styles[m]) for m in board.methods if board.of(task, m)]
        made[task] = _ranked(rows, board.constants[task]["cost_limit"]) if rows else []
    return made


def references(board: Board) -> dict[str, list[Standing]]:
    """By task: the rows that every method is read against."""
    return {t: [_reference(t, name, r) for name, r in board.references.get(t, {}).items()] for t in board.tasks}


def _ranked(rows: list[Standing], limit: float) -> list[Standing]:
    """Lexicographic, judged by the upper end of the cost's interval: within the limit first, by return; then the
    rest, by cost."""
    merits = [r.returns for r in rows], [r.cost_interval[1] for r in rows], limit
    for row, place in zip(rows, statistics.places(*merits)):
        row.rank = int(place)
        row.best = row.safe and place == 1
    return [rows[i] for i in statistics.rank(*merits)]


def contests(rows: list[Standing]) -> list[Contest]:
    """The first of a task's ranked rows against each of the others."""
    if len(rows) < 2:
        return []
    first, found = rows[0], []
    for other in rows[1:]:
        pair = [[_per_reset(row, what) for row in (first, other)] for what in ("return", "cost")]
        found.append([statistics.paired_test(*p) for p in pair])
    adjusted = statistics.holm(np.array([t["p"] for tests in found for t in tests])).reshape(-1, 2)
    return [
        Contest(row, r["difference"], r["interval"], float(p), c["difference"], c["interval"], float(q))
        for row, (r, c), (p, q) in zip(rows[1:], found, adjusted)
    ]


def _per_reset(row: Standing, what: str) -> Array:
    return np.mean([e.summary["per_episode"][what] for e in row.entries], 0)


def _standing(board: Board, task: str, method: Method, style: tuple[int, int]) -> Standing:
    entries = board.of(task, method)
    told = [e.summary for e in entries]
    c = board.constants[task]
    sd = _deviation(told, "return_mean")
    return Standing(
        task=task,
        name=method.name,
        variant=method.shown,
        method=method,
        seeds=tuple(e.seed for e in entries),
        returns_sd=sd,
        returns_norm_sd=None if sd is None else sd / (c["return_max"] - c["return_min"]),
        cost_sd=_deviation(told, "cost_mean"),
        ended=mean_of(told, "termination_rate"),
        steps=mean_of(told, "steps_mean"),
        train_seconds=mean_of(told, "train_seconds"),
        plan_ms=mean_of(told, "plan_ms_p50"),
        parameters=told[0].get("parameters"),
        style=style,
        entries=entries,
        **pool(told),
    )


def _reference(task: str, name: str, told: dict) -> Standing:
    ended, steps = told.get("termination_rate"), told.get("steps_mean")
    return Standing(task=task, name=name, variant="", method=None, seeds=(), ended=ended, steps=steps, **pool([told]))


def _deviation(results: list[dict], key: str) -> float | None:
    return float(np.std([r[key] for r in results], ddof=1)) if len(results) > 1 else None


def _styles(methods: list[Method]) -> dict[Method, tuple[int, int]]:
    """A colour per algorithm and preset; no two methods have both colour and marker in common."""
    families: dict[tuple, int] = {}
    taken: dict[int, int] = {}
    styles = {}
    for m in methods:
        colour = families.setdefault((m.algorithm, m.preset), len(families)) % COLOURS
        taken[colour] = taken.get(colour, -1) + 1
        styles[m] = colour, taken[colour]
    return styles


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
    seeds, left_out = {}, {}
    for m in board.methods:
        had = {t: {e.seed for e in board.of(t, m)} for t in tasks}
        common = tuple(sorted(set.intersection(*had.values())))
        if common:
            seeds[m] = common
        else:
            left_out[m] = [t for t in tasks if not had[t]]
    methods = list(seeds)
    if not methods:
        return None
    returns, costs, episode_costs = {}, {}, {}
    for m in methods:
        cells = [[_entry(board, t, m, s) for t in tasks] for s in seeds[m]]
        score = [[normal_return(e.summary["return_mean"], board.constants[e.task]) for e in row] for row in cells]
        price = [[normal_cost(e.summary["cost_mean"], board.constants[e.task]) for e in row] for row in cells]
        returns[m], costs[m] = np.array(score), np.array(price)
        episode_costs[m] = np.array(
            [
                [normal_cost(np.array(e.summary["per_episode"]["cost"]), board.constants[e.task]) for e in row]
                for row in cells
            ]
        )
    low, high = _range(returns)
    return_thresholds = np.linspace(low, high, 101)
    top = int(np.ceil(max(3.0, *(float(np.quantile(c, 0.9)) for c in episode_costs.values()))))
    cost_thresholds = np.linspace(0.0, top, 20 * top + 1)  # whole numbers are among them, since costs count steps
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


def _entry(board: Board, task: str, method: Method, seed: int) -> Entry:
    return next(e for e in board.of(task, method) if e.seed == seed)


def _iqm(scores: Array) -> tuple[float, Interval | None]:
    """Interquartile mean over all seeds and tasks; the bootstrap resamples seeds within each task."""
    several = len(scores) > 1
    return float(statistics.iqm(scores)), statistics.stratified_bootstrap(
        scores, statistics.iqm, draws=DRAWS
    ) if several else None


def _band(shares: Array) -> Array | None:
    """(2, K): 95 % interval, at every threshold, of the mean of shares (runs, tasks, K); runs are resampled."""
    runs, tasks, _ = shares.shape
    if runs < 2:
        return None
    taken = np.random.default_rng(0).multinomial(runs, np.full(runs, 1 / runs), (DRAWS, tasks)) / (runs * tasks)
    return np.percentile(np.einsum("dmr,rmk->dk", taken, shares, optimize=True), [2.5, 97.5], axis=0)


def _pairs(scores: dict[Method, Array], methods: list[Method]) -> Array:
    """(M, M) probability that a run of the row scores higher than one of the column, averaged over tasks."""
    return np.array([[statistics.probability_of_improvement(scores[a], scores[b]) for b in methods] for a in methods])


def _range(scores: dict[Method, Array]) -> Interval:
    """From the worst to the best run, at least from 0 to 1."""
    low, high = min(s.min() for s in scores.values()), max(s.max() for s in scores.values())
    return min(0.0, float(low)), max(1.0, float(high))
