"""A results folder of the benchmark as a board: its tasks' ranked tables, and what the grid lacks.

A preset made for the task (its data tier's, or its simulator's) is that algorithm's default there: one method over all
tasks.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from ringfence.bench import suites, table
from ringfence.bench.cells import cell_status, read_about
from ringfence.bench.table import Place
from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.evaluation import statistics
from ringfence.evaluation.table import Row
from ringfence.report.table import Line, Method, Section, methods_of, paint, section
from ringfence.training.runs import Run

FILE = "bench.json"


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
    return Board(
        path=folder,
        suite=about["suite"],
        protocol=about["protocol"],
        split=about["split"],
        episodes=about["episodes"],
        sections=_sections(tasks, found, [row for row in rows if row.run is None]),
        seeds=tuple(sorted({place.seed for place in places})),
        missing=sorted(missing, key=lambda m: (tasks.index(m.task), m.job, m.seed)),
        unstarted=[e.name for e in _suite(about["suite"]) if _entry_job(e) not in jobs],
        untouched=[t for t in _suite_tasks(about["suite"]) if t not in named],
    )


def _sections(tasks: list[str], rows: list[Row], references: list[Row]) -> dict[str, Section]:
    """By task, its lines ranked, in the same colours everywhere."""
    methods = methods_of(rows)
    made = {}
    for task in tasks:
        mine, beside = ([row for row in some if row.task == task] for some in (rows, references))
        made[task] = section(task, mine, beside, methods)
    lines = [line for each in made.values() for line in each.lines]
    order = _methods(made.values())
    paint(sorted(lines, key=lambda line: order.index(line.method) if line.method else 0))
    for each in made.values():
        each.tables = {split: ranked(lines, each.constants["cost_limit"]) for split, lines in each.tables.items()}
    return made


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
    partial = [m for place in finished if (m := _partial(suite, place))]
    done = {_cell(place) for place in finished}
    unfinished = [_unfinished(place) for place in places if _cell(place) not in done]
    begun = {_cell(place) for place in places}
    jobs = sorted({job for _, job, _ in begun})
    seeds = sorted({place.seed for place in places})
    grid = [(task, job, seed) for task in tasks for job in jobs for seed in seeds if _planned(suite, task, job)]
    return partial + unfinished + [Missing(*cell, "not started") for cell in grid if cell not in begun]


def _cell(place: Place) -> tuple[str, str, int]:
    """What a folder is of; presets made for the task are no difference."""
    return place.task, _job(place.task, place.job), place.seed


def _partial(suite: str, cell: Place) -> Missing | None:
    """What a cell with results lacks, if anything."""
    state, reason = _status(cell.path)
    if state == "failed":
        why = f"not every evaluation is there, one failed: {reason}"
    elif lacking := _lacking(suite, cell):
        why = f"not every evaluation is there: {', '.join(lacking)}"
    else:
        return None
    return Missing(cell.task, cell.job, cell.seed, why)


def _unfinished(cell: Place) -> Missing:
    state, reason = _status(cell.path)
    return Missing(cell.task, cell.job, cell.seed, f"{state}: {reason}" if reason else state)


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


def _suite_tasks(name: str) -> tuple[str, ...]:
    return suites.SUITES[name].tasks if name in suites.SUITES else ()


def _entry_job(entry: suites.Entry) -> str:
    """The folder's name of a suite's entry, as `_job` has it."""
    return entry.algorithm if entry.preset in ("", "default") else f"{entry.algorithm}-{entry.preset}"


def _planned(suite: str, task: str, job: str) -> bool:
    """Whether the suite has this job on this task; jobs it does not know are expected on every task."""
    entries = [e for e in _suite(suite) if _entry_job(e) == job]
    return not entries or any(e.plays(_tier(task)) for e in entries)


def _lacking(suite: str, cell: Place) -> list[str]:
    """Evaluations of the suite that a run does not have."""
    known = {result.get("spec") for result in Run(cell.path).results.values()}
    _, job, _ = _cell(cell)
    entries = [e for e in _suite(suite) if _entry_job(e) == job and e.plays(_tier(cell.task))]
    return [name for e in entries for name in e.evaluations if name not in known]
