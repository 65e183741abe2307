"""Reads a results folder of the benchmark and refuses what must not stand in one table.

bench.json                              format, protocol, suite, episodes, split
reference/<task>/reference.json         summaries of the logged data and of trivial policies, by name
                                        (or reference/<task>.json)
cells/<task>/<algorithm>[-<preset>]/seed-<k>-<id>/   run folders; results.json holds one summary per variant

A preset made for the task (its data tier's, or its simulator's) is that algorithm's default there: one method over all
tasks.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

from ringfence.bench import suites
from ringfence.bench.cells import read_about
from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.evaluation import reference
from ringfence.evaluation.protocol import of_last_step
from ringfence.logs.provenance import other_data
from ringfence.proposals.options import DEFAULT
from ringfence.report.pooling import Result
from ringfence.report.table import NAMES, NEEDED, config_of, differing, place, plain_variant
from ringfence.training.runs import Run
from ringfence.utils import schemas

FILE = "bench.json"
CELL = re.compile(r"seed-(\d+)(?:-(.+))?")


@dataclass(frozen=True)
class Method:
    """What a row of the leaderboard compares: an algorithm with its preset, evaluated under one variant."""

    algorithm: str
    preset: str
    variant: str  # as in results.json, `default` in place of a preset that is the task's own
    apart: str = ""  # config fields in which cells of the same algorithm and preset differ

    @property
    def name(self) -> str:
        return NAMES.get(self.algorithm, self.algorithm)

    @property
    def shown(self) -> str:
        """The variant in short; the default one needs no words."""
        return f"{plain_variant(self.variant)} {self.apart}".strip()

    @property
    def label(self) -> str:
        return f"{self.name} {self.shown}".strip()

    @property
    def place(self) -> tuple:
        """Order in tables."""
        return place(self.algorithm, self.preset, self.shown)


@dataclass(frozen=True)
class Entry:
    """One finished evaluation: a task, a method and a seed."""

    task: str
    algorithm: str
    variant: str
    seed: int
    summary: Result
    path: Path  # the run folder
    method: Method
    revision: int  # of the algorithm that trained it


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
    episodes: int  # per entry
    tasks: list[str]
    seeds: tuple[int, ...]  # that any cell has
    entries: list[Entry]
    references: dict[str, dict[str, Result]]  # task -> name -> summary
    missing: list[Missing]
    unstarted: list[str]  # entries of the suite that no cell was begun of
    untouched: list[str]  # tasks of the suite without any cell or reference
    constants: dict[str, dict[str, float]]  # by task
    runs: list[Run] = field(repr=False, default_factory=list)  # finished ones

    @property
    def methods(self) -> list[Method]:
        return sorted({e.method for e in self.entries}, key=lambda m: m.place)

    def of(self, task: str, method: Method) -> list[Entry]:
        """Entries of a row, by seed."""
        return sorted((e for e in self.entries if (e.task, e.method) == (task, method)), key=lambda e: e.seed)


def is_board(folder: Path) -> bool:
    return (Path(folder) / FILE).is_file()


@dataclass(frozen=True)
class Cell:
    """A folder of the grid, with or without results."""

    path: Path
    task: str
    job: str  # algorithm[-preset], the folder's name
    seed: int

    @property
    def place(self) -> tuple[str, str, int]:
        """What the cell is of; presets made for the task are no difference."""
        return self.task, _job(self.task, self.job), self.seed


def read(folder: str | Path) -> Board:
    """The results folder as rows. `UserError` names the files that disagree where numbers must not be mixed."""
    folder = Path(folder)
    about = read_about(folder)
    cells = _cells(folder)
    finished = [(cell, run) for cell, run in ((cell, Run(cell.path)) for cell in cells) if _finished(run)]
    if not finished:
        raise UserError(
            f"'{folder}' holds no finished cell, so there is nothing to rank; run `ringfence bench` into it first."
        )
    references = _references(folder)
    entries = _entries(finished, about["split"])
    if not entries:
        raise UserError(
            f"'{folder}' holds results on other resets or of earlier checkpoints alone, so there is nothing to rank; "
            "run `ringfence bench` into it again."
        )
    _check(entries, references, about, folder)
    named = {cell.task for cell in cells} | {task for task, _ in references.values()}
    known = list(registry.TASKS)
    tasks = sorted(named, key=lambda t: (known.index(t) if t in known else len(known), t))
    jobs = {job for _, job, _ in (cell.place for cell in cells)}
    missing = _missing(about["suite"], cells, finished, tasks)
    return Board(
        path=folder,
        suite=about["suite"],
        protocol=about["protocol"],
        split=about["split"],
        episodes=about["episodes"],
        tasks=tasks,
        seeds=tuple(sorted({cell.seed for cell in cells})),
        entries=entries,
        references={task: rows for task, rows in references.values()},
        missing=sorted(missing, key=lambda m: (tasks.index(m.task), m.job, m.seed)),
        unstarted=[e.name for e in _suite(about["suite"]) if _entry_job(e) not in jobs],
        untouched=[t for t in _suite_tasks(about["suite"]) if t not in named],
        constants=_constants(entries, references),
        runs=[run for _, run in finished],
    )


def _cells(folder: Path) -> list[Cell]:
    found = []
    for path in sorted((folder / "cells").glob("*/*/*/")):
        if match := CELL.match(path.name):
            found.append(Cell(path, path.parent.parent.name, path.parent.name, int(match[1])))
    return found


def _finished(run: Run) -> bool:
    return bool(run.results) and (run.path / "config.json").exists()


def _missing(suite: str, cells: list[Cell], finished: list[tuple[Cell, Run]], tasks: list[str]) -> list[Missing]:
    """What the grid lacks: evaluations of finished cells, cells without any, and cells that were not begun."""
    partial = [m for cell, run in finished if (m := _partial(suite, cell, run))]
    done = {cell.place for cell, _ in finished}
    unfinished = [_unfinished(cell) for cell in cells if cell.place not in done]
    begun = {cell.place for cell in cells}
    jobs = sorted({job for _, job, _ in begun})
    seeds = sorted({cell.seed for cell in cells})
    grid = [(task, job, seed) for task in tasks for job in jobs for seed in seeds if _planned(suite, task, job)]
    return partial + unfinished + [Missing(*place, "not started") for place in grid if place not in begun]


def _partial(suite: str, cell: Cell, run: Run) -> Missing | None:
    """What a cell with results lacks, if anything."""
    state, reason = _status(cell.path)
    if state == "failed":
        why = f"not every evaluation is there, one failed: {reason}"
    elif lacking := _lacking(suite, cell, run):
        why = f"not every evaluation is there: {', '.join(lacking)}"
    else:
        return None
    return Missing(cell.task, cell.job, cell.seed, why)


def _unfinished(cell: Cell) -> Missing:
    state, reason = _status(cell.path)
    return Missing(cell.task, cell.job, cell.seed, f"{state}: {reason}" if reason else state)


def _status(path: Path) -> tuple[str, str]:
    """(state, reason in a line) of a cell; one that was begun and left nothing behind yet is under way."""
    file = path / "status.json"
    if not file.exists():
        return "under way", ""
    status = schemas.read(file, schemas.Status, "has a damaged status.json; delete that file")
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


def _lacking(suite: str, cell: Cell, run: Run) -> list[str]:
    """Evaluations of the suite that a run does not have."""
    preset = run.config["preset"]
    known = {v.removeprefix(preset).removeprefix("+") or DEFAULT for v in run.results if v.startswith(preset)}
    _, job, _ = cell.place
    entries = [e for e in _suite(suite) if _entry_job(e) == job and e.plays(_tier(cell.task))]
    return [name for e in entries for name in e.evaluations if name not in known]


def _references(folder: Path) -> dict[Path, tuple[str, dict[str, Result]]]:
    """File -> (task, rows by name)."""
    inside = folder / "reference"
    files = [(f, f.parent.name) for f in sorted(inside.glob("*/reference.json"))]
    files += [(f, f.stem) for f in sorted(inside.glob("*.json"))]
    return {f: (task, reference.read(f)) for f, task in files}


def _entries(finished: list[tuple[Cell, Run]], split: str) -> list[Entry]:
    configs = {run.path: run.config for _, run in finished}
    apart = _differing([(cell.task, configs[run.path]) for cell, run in finished])  # by (algorithm, preset)
    entries: dict[tuple, Entry] = {}
    cards: dict[str, tuple[dict, Path]] = {}  # by task: what the first run says of its data
    for cell, run in finished:
        config = configs[run.path]
        _check_place(run, config, cell)
        card = config.get("data") or {}
        _check_data(run, card, *cards.setdefault(cell.task, (card, run.path)))
        algorithm = config["algorithm"]
        preset = _preset(cell.task, config)
        settings = config_of(config)
        fields = apart.get((algorithm, preset), [])
        words = "[" + ", ".join(f"{k}={settings.get(k)}" for k in fields) + "]" if fields else ""
        for variant, summary in run.results.items():
            if ("@" in variant and summary.get("split") != split) or not of_last_step(summary, settings):
                continue  # settings were chosen there, or training went on; no table is made of it
            shown = variant
            if config["preset"] != preset:
                shown = re.sub(rf"^{re.escape(config['preset'])}\b", preset, variant)
            method = Method(algorithm, preset, shown, words)
            revision = config.get("revision", 1)
            entry = Entry(cell.task, algorithm, variant, cell.seed, summary, run.path, method, revision)
            other = entries.setdefault((cell.task, method, cell.seed), entry)
            if other is not entry:
                raise UserError(
                    f"'{other.path}' and '{run.path}' are the same cell (same config, same seed {cell.seed}); "
                    "delete one."
                )
    return list(entries.values())


def _check_place(run: Run, config: dict, cell: Cell) -> None:
    for name, here in (("task", cell.task), ("seed", cell.seed)):
        if config.get(name) != here:
            raise UserError(
                f"'{run.path / 'config.json'}' names {name} {config.get(name)}, its folder {here}; a cell was moved: "
                "put it back or delete it."
            )


def _check_data(run: Run, card: dict, first: dict, path: Path) -> None:
    if unlike := other_data(card, first):
        name, here, there = unlike[0]
        raise UserError(
            f"'{run.path}' was trained on other data (its {name} is {here}) than '{path}' ({there}); "
            "keep one results folder for each data set."
        )


def _differing(configs: list[tuple[str, dict]]) -> dict[tuple[str, str], list[str]]:
    """Config fields that tell rows of the same algorithm and preset apart: those that differ within some task.
    A setting that is one thing on one task and another on the next is no reason for two rows."""
    groups: dict[tuple, list[dict]] = {}
    for task, config in configs:
        groups.setdefault((config["algorithm"], _preset(task, config), task), []).append(config_of(config))
    found: dict[tuple[str, str], list[str]] = {}
    for (algorithm, preset, _), several in groups.items():
        names = found.setdefault((algorithm, preset), [])
        names += [k for k in differing(several) if k not in names]
    return found


def _preset(task: str, config: dict) -> str:
    """A run's preset, where one made for the task counts as the default."""
    return "default" if config["preset"] in _presets(task) else config["preset"]


def _check(
    entries: list[Entry], references: dict[Path, tuple[str, dict[str, Result]]], about: dict, folder: Path
) -> None:
    """Every summary must be of the protocol, split, length and normalisation that the folder declares."""
    leaders: dict[str, tuple[Path, Result]] = {}  # by task: the first file, and its summary
    for e in entries:
        file = e.path / "results.json"
        name = f"'{file}' variant '{e.variant}'"
        _complete(name, e.summary, e.task, (*NEEDED, "per_episode", "split"))
        for key in ("protocol", "split", "episodes"):
            _same(name, key, e.summary[key], about[key], folder)
        _normalised(name, e.summary, *leaders.setdefault(e.task, (file, e.summary)))
    for file, (task, rows) in references.items():
        for row, summary in rows.items():
            name = f"'{file}' row '{row}'"
            _complete(name, summary, task, (*NEEDED, "split"))
            _same(name, "protocol", summary["protocol"], about["protocol"], folder)
            if summary["split"] != "data":  # logged episodes have resets of their own and any number of them
                for key in ("split", "episodes"):
                    _same(name, key, summary[key], about[key], folder)
            _normalised(name, summary, *leaders.setdefault(task, (file, summary)))


def _complete(name: str, summary: Result, task: str, needed: tuple[str, ...]) -> None:
    lacking = [k for k in needed if k not in summary]
    if lacking:
        raise UserError(f"{name} lacks '{lacking[0]}', so it was made by another version; evaluate it again.")
    if summary["task"] != task:
        raise UserError(f"{name} holds a result of task '{summary['task']}', not of '{task}'; evaluate it again.")


def _same(name: str, key: str, here: object, declared: object, folder: Path) -> None:
    if here != declared:
        raise UserError(
            f"{name} has {key} {here}, '{folder / FILE}' declares {declared}; such numbers cannot stand in one table: "
            "evaluate the cell again or keep it in a results folder of its own."
        )


def _normalised(name: str, summary: Result, first: Path, leader: Result) -> None:
    if summary["constants"] != leader["constants"]:
        raise UserError(
            f"{name} was normalised with {summary['constants']}, '{first}' with {leader['constants']}; "
            "evaluate both with one version."
        )


def _constants(
    entries: list[Entry], references: dict[Path, tuple[str, dict[str, Result]]]
) -> dict[str, dict[str, float]]:
    found = {task: row["constants"] for task, rows in references.values() for row in rows.values()}
    return found | {e.task: e.summary["constants"] for e in entries}
