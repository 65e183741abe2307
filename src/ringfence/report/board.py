"""A results folder of the benchmark as a board: its tasks' ranked tables, what the grid lacks, and what compares
methods: paired tests on a task, and statistics over all tasks.

A preset made for the task (its data tier's, or its simulator's) is that algorithm's default there: one method over all
tasks.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ringfence.bench import suites, table
from ringfence.bench.cells import cell_status, read_about
from ringfence.bench.table import Place
from ringfence.datasets import registry
from ringfence.datasets.registry import TASKS
from ringfence.errors import UserError
from ringfence.evaluation import statistics
from ringfence.evaluation.statistics import Interval
from ringfence.evaluation.table import Result, Row
from ringfence.report.table import Line, Method, Section, methods_of, normal_cost, normal_return, paint, section
from ringfence.training.runs import Run

FILE = "bench.json"
DRAWS = 2000  # of every bootstrap


@dataclass(frozen=True)
class Missing:
    """A cell of the grid without a result."""

    task: str
    job: str  # algorithm[-preset], the folder's name
    seed: int
    why: str


@dataclass
class Board:
    """Everything a leaderboard is made of."""

    path: Path
    suite: str
    protocol: int
    split: str
    episodes: int  # per run and task
    sections: dict[str, Section]  # by task
    seeds: tuple[int, ...]  # that any cell has
    missing: list[Missing]
    unstarted: list[str]  # entries of the suite that no cell was begun of
    untouched: list[str]  # tasks of the suite without any cell or reference

    @property
    def tasks(self) -> list[str]:
        return list(self.sections)

    @property
    def lines(self) -> dict[str, list[Line]]:
        """By task the methods that were measured on it, in the order of rank."""
        return {task: each.tables.get(self.split, []) for task, each in self.sections.items()}

    @property
    def methods(self) -> list[Method]:
        return _methods(self.sections.values())

    def line(self, task: str, method: Method) -> Line | None:
        """A method's line on a task; None where it was not measured."""
        return next((line for line in self.lines[task] if line.method == method), None)


def is_board(folder: Path) -> bool:
    return (Path(folder) / FILE).is_file()


def read(folder: str | Path) -> Board:
    """The results folder as a board. `UserError` names the files that disagree where numbers must not be mixed."""
    folder = Path(folder)
    about = read_about(folder)
    places = table.places(folder)
    finished = [place for place in places if (place.path / "results.json").exists() and Run(place.path).results]
    if not finished:
        raise UserError(
            f"'{folder}' holds no finished cell, so there is nothing to rank; run `ringfence bench` into it first."
        )
    rows = table.read(folder)
    found = [_by_default(row) for row in rows if row.run is not None]
    if not found:
        raise UserError(
            f"'{folder}' holds results on other resets or of earlier checkpoints alone, so there is nothing to rank; "
            "run `ringfence bench` into it again."
        )
    named = {place.task for place in places} | {row.task for row in rows}
    known = list(registry.TASKS)
    tasks = sorted(named, key=lambda t: (known.index(t) if t in known else len(known), t))
    jobs = {_job(place.task, place.job) for place in places}
    missing = _missing(about["suite"], places, finished, tasks)
    # By task, its lines ranked, in the same colours everywhere.
    references = [row for row in rows if row.run is None]
    methods = methods_of(found)
    made = {}
    for task in tasks:
        mine, beside = ([row for row in some if row.task == task] for some in (found, references))
        made[task] = section(task, mine, beside, methods)
    lines = [line for each in made.values() for line in each.lines]
    order = _methods(made.values())
    paint(sorted(lines, key=lambda line: order.index(line.method) if line.method else 0))
    for each in made.values():
        each.tables = {split: ranked(lines, each.constants["cost_limit"]) for split, lines in each.tables.items()}
    suite = suites.SUITES.get(about["suite"])
    return Board(
        path=folder,
        suite=about["suite"],
        protocol=about["protocol"],
        split=about["split"],
        episodes=about["episodes"],
        sections=made,
        seeds=tuple(sorted({place.seed for place in places})),
        missing=sorted(missing, key=lambda m: (tasks.index(m.task), m.job, m.seed)),
        unstarted=[e.name for e in (suite.entries if suite else ()) if _entry_job(e) not in jobs],
        untouched=[t for t in (suite.tasks if suite else ()) if t not in named],
    )


def _methods(sections: Iterable[Section]) -> list[Method]:
    """Of all tasks, in the order of tables."""
    return sorted({line.method for each in sections for line in each.lines if line.method}, key=lambda m: m.place)


def ranked(lines: list[Line], limit: float) -> list[Line]:
    """Lexicographic, judged by the upper end of the cost's interval: within the limit first, by return; then the
    rest, by cost."""
    returns = [line.returns for line in lines]
    # Who keeps the sum but not each constraint's own limit is over the limit.
    costs = [
        line.cost_interval[1] if line.safe or not line.limits else max(line.cost_interval[1], 2 * limit + 1)
        for line in lines
    ]
    for line, place in zip(lines, statistics.places(returns, costs, limit)):
        line.rank = int(place)
        line.best = line.safe and bool(place == 1)
    return [lines[i] for i in statistics.rank(returns, costs, limit)]


def _by_default(row: Row) -> Row:
    """The same, where a preset made for the task counts as the default."""
    if row.preset not in _presets(row.task):
        return row
    return replace(row, preset="default", variant=re.sub(rf"^{re.escape(row.preset)}\b", "default", row.variant))


def _missing(suite: str, places: list[Place], finished: list[Place], tasks: list[str]) -> list[Missing]:
    """What the grid lacks: evaluations of finished cells, cells without any, and cells that were not begun."""
    found = [lacking for place in finished if (lacking := _partial(suite, place))]
    done = {_cell(place) for place in finished}
    for place in places:
        if _cell(place) not in done:
            state, reason = _status(place.path)
            found.append(Missing(place.task, place.job, place.seed, f"{state}: {reason}" if reason else state))
    begun = {_cell(place) for place in places}
    jobs = sorted({job for _, job, _ in begun})
    seeds = sorted({place.seed for place in places})
    for task, job in itertools.product(tasks, jobs):
        # Jobs that the suite does not know are expected on every task.
        entries = [e for e in _suite(suite) if _entry_job(e) == job]
        if not entries or any(e.plays(_tier(task)) for e in entries):
            found += [Missing(task, job, seed, "not started") for seed in seeds if (task, job, seed) not in begun]
    return found


def _cell(place: Place) -> tuple[str, str, int]:
    """What a folder is of; presets made for the task are no difference."""
    return place.task, _job(place.task, place.job), place.seed


def _partial(suite: str, cell: Place) -> Missing | None:
    """What a cell with results lacks, if anything."""
    state, reason = _status(cell.path)
    if state == "failed":
        return Missing(cell.task, cell.job, cell.seed, f"not every evaluation is there, one failed: {reason}")
    known = {result.get("spec") for result in Run(cell.path).results.values()}
    _, job, _ = _cell(cell)
    entries = [e for e in _suite(suite) if _entry_job(e) == job and e.plays(_tier(cell.task))]
    lacking = [name for e in entries for name in e.evaluations if name not in known]
    if not lacking:
        return None
    return Missing(cell.task, cell.job, cell.seed, f"not every evaluation is there: {', '.join(lacking)}")


def _status(path: Path) -> tuple[str, str]:
    """(state, reason in a line) of a cell; one that was begun and left nothing behind yet is under way."""
    status = cell_status(path) or {}
    reason = str(status.get("error") or "").strip().splitlines()
    return str(status.get("state") or "under way"), reason[-1] if reason else ""


def _tier(task: str) -> str:
    return registry.TASKS[task].tier if task in registry.TASKS else ""


def _job(task: str, job: str) -> str:
    """A folder's name without the preset made for the task: the same job on every task."""
    for name in _presets(task):
        job = job.removesuffix(f"-{name}")
    return job


def _presets(task: str) -> tuple[str, ...]:
    return registry.TASKS[task].presets if task in registry.TASKS else ()


def _suite(name: str) -> tuple[suites.Entry, ...]:
    return suites.SUITES[name].entries if name in suites.SUITES else ()


def _entry_job(entry: suites.Entry) -> str:
    """The folder's name of a suite's entry, as `_job` has it."""
    return entry.algorithm if entry.preset in ("", "default") else f"{entry.algorithm}-{entry.preset}"


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
    # By method the seeds that every task has; by method without any the tasks that lack it.
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
    methods = list(seeds)
    if not methods:
        return None

    def scores(score: Callable[[Result, dict[str, float]], float | np.ndarray]) -> dict[Method, np.ndarray]:
        """(seeds, tasks, ...) of every method."""
        found = {}
        for m in methods:
            by_task = [{row.seed: row.result for row in line.rows} for t in tasks if (line := board.line(t, m))]
            each = [[score(results[seed], results[seed]["constants"]) for results in by_task] for seed in seeds[m]]
            found[m] = np.array(each)
        return found

    returns = scores(lambda result, constants: normal_return(result["return_mean"], constants))
    costs = scores(lambda result, constants: normal_cost(result["cost_mean"], constants))
    episode_costs = scores(lambda result, constants: normal_cost(np.array(result["per_episode"]["cost"]), constants))
    # From the worst to the best run, at least from 0 to 1.
    low = min(0.0, *(float(s.min()) for s in returns.values()))
    high = max(1.0, *(float(s.max()) for s in returns.values()))
    return_thresholds = np.linspace(low, high, 101)
    # From 0 to where nine of ten episodes of every method lie, at least to 3. Whole numbers are among them, since costs
    # count steps.
    most = max(float(np.quantile(costs, 0.9)) for costs in episode_costs.values())
    top = int(np.ceil(max(3.0, most)))
    cost_thresholds = np.linspace(0.0, top, 20 * top + 1)
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


def short(task: str, suite: str) -> str:
    """`simple_spread-expert` -> `expert` on a board of simple_spread."""
    return task.removeprefix(f"{suite}-") or task


# --- ranking ---


@dataclass(frozen=True)
class RankingRow:
    """A method over the tasks of a ranking."""

    line: Line  # of the first task on which it was measured
    cells: list[Line | None]  # per task
    mean: float | None  # of its ranks; None where a task is missing


@dataclass(frozen=True)
class Ranking:
    """Methods by their mean rank over the tasks that follow one protocol."""

    protocol: str  # empty where a board has one kind of tasks
    tasks: list[str]
    rows: list[RankingRow]


def rankings(board: Board) -> list[Ranking]:
    """One per protocol: tasks that share data and policies under two limits are not two tasks."""
    return [Ranking(p, tasks, _ranks(board, tasks)) for p, tasks in by_protocol(board).items()]


def _ranks(board: Board, tasks: list[str]) -> list[RankingRow]:
    """Mean ranks are counted among the methods that were measured on every task; the others come last, since they have
    none."""
    cells = {m: [board.line(t, m) for t in tasks] for m in board.methods}
    # Of the methods that were measured on every task, among themselves.
    complete = {m: [cell for cell in row if cell] for m, row in cells.items() if all(row)}
    places: list[np.ndarray] = []
    for k, task in enumerate(tasks):
        measured = [row[k] for row in complete.values()]
        limit = board.sections[task].constants.get("cost_limit", 0.0)  # a task may have no result yet
        places.append(statistics.places([r.returns for r in measured], [r.cost_interval[1] for r in measured], limit))
    means = {m: float(np.mean([place[k] for place in places])) for k, m in enumerate(complete)}
    rows = [
        RankingRow(first, row, means.get(method))
        for method, row in cells.items()
        if (first := next((cell for cell in row if cell), None))
    ]
    return sorted(rows, key=lambda r: (r.mean is None, r.mean or 0.0))
