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
    summary: dict  # as evaluate.summarise makes it
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
    references: dict[str, dict[str, dict]]  # task -> name -> summary
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


def read(folder: str | Path) -> Board:
    """The results folder as rows. `UserError` names the files that disagree where numbers must not be mixed."""
    folder = Path(folder)
    told = read_about(folder)
    cells = [(path, *_place_of(path)) for path in sorted((folder / "cells").glob("*/*/*/")) if CELL.match(path.name)]
    finished, missing, partial = [], [], []
    for path, task, job, seed in cells:
        run = Run(path)
        state, reason = _status(path)
        if not run.results or not (path / "config.json").exists():
            missing.append(Missing(task, job, seed, f"{state}: {reason}" if reason else state))
            continue
        finished.append((run, task, job, seed))
        if state == "failed":
            partial.append(Missing(task, job, seed, f"not every evaluation is there, one failed: {reason}"))
        elif lacking := _lacking(told["suite"], task, job, run):
            partial.append(Missing(task, job, seed, f"not every evaluation is there: {', '.join(lacking)}"))
    if not finished:
        raise UserError(
            f"'{folder}' holds no finished cell, so there is nothing to rank; run `ringfence bench` into it first."
        )
    references = _references(folder)
    entries = _entries(finished, told["split"])
    if not entries:
        raise UserError(
            f"'{folder}' holds results on other resets or of earlier checkpoints alone, so there is nothing to rank; "
            "run `ringfence bench` into it again."
        )
    _check(entries, references, told, folder)
    names = {task for _, task, _, _ in cells} | {task for task, _ in references.values()}
    known = list(registry.TASKS)
    ordered = sorted(names, key=lambda t: (known.index(t) if t in known else len(known), t))
    seeds = tuple(sorted({seed for *_, seed in cells}))
    done = {(task, _job(task, job), seed) for _, task, job, seed in finished}
    missing = partial + [m for m in missing if (m.task, _job(m.task, m.job), m.seed) not in done]
    begun = {(task, _job(task, job), seed) for _, task, job, seed in cells}
    jobs = sorted({job for _, job, _ in begun})
    grid = [(t, j, s) for t in ordered for j in jobs for s in seeds if _planned(told["suite"], t, j)]
    missing += [Missing(*place, "not started") for place in grid if place not in begun]
    return Board(
        path=folder,
        suite=told["suite"],
        protocol=told["protocol"],
        split=told["split"],
        episodes=told["episodes"],
        tasks=ordered,
        seeds=seeds,
        entries=entries,
        references={task: rows for task, rows in references.values()},
        missing=sorted(missing, key=lambda m: (ordered.index(m.task), m.job, m.seed)),
        unstarted=[e.name for e in _suite(told["suite"]) if _entry_job(e) not in jobs],
        untouched=[t for t in _suite_tasks(told["suite"]) if t not in names],
        constants=_constants(entries, references),
        runs=[run for run, *_ in finished],
    )


def _place_of(path: Path) -> tuple[str, str, int]:
    """(task, job, seed) from a cell's folder."""
    return path.parent.parent.name, path.parent.name, int(CELL.match(path.name)[1])


def _status(path: Path) -> tuple[str, str]:
    """(state, reason in a line) of a cell; one that was begun and left nothing behind yet is under way."""
    file = path / "status.json"
    damaged = "has a damaged status.json; delete that file"
    told = schemas.read(file, schemas.Status, damaged) if file.exists() else {}
    reason = str(told.get("error") or "").strip().splitlines()
    return str(told.get("state") or "under way"), reason[-1] if reason else ""


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


def _lacking(suite: str, task: str, job: str, run: Run) -> list[str]:
    """Evaluations of the suite that a run does not have."""
    preset = run.config["preset"]
    known = {v.removeprefix(preset).removeprefix("+") or "plain" for v in run.results if v.startswith(preset)}
    entries = [e for e in _suite(suite) if _entry_job(e) == _job(task, job)]
    return [v for e in entries for v in e.evaluations if e.plays(_tier(task)) and v not in known]


def _references(folder: Path) -> dict[Path, tuple[str, dict[str, dict]]]:
    """File -> (task, rows by name)."""
    inside = folder / "reference"
    files = [(f, f.parent.name) for f in sorted(inside.glob("*/reference.json"))]
    files += [(f, f.stem) for f in sorted(inside.glob("*.json"))]
    return {f: (task, reference.read(f)) for f, task in files}


def _entries(finished: list[tuple[Run, str, str, int]], split: str) -> list[Entry]:
    configs = {run.path: run.config for run, *_ in finished}
    apart = _differing([(task, configs[run.path]) for run, task, *_ in finished])  # by (algorithm, preset)
    entries: dict[tuple, Entry] = {}
    data: dict[str, tuple[dict, Path]] = {}
    for run, task, _, seed in finished:
        told = configs[run.path]
        for name, here in (("task", task), ("seed", seed)):
            if told.get(name) != here:
                raise UserError(
                    f"'{run.path / 'config.json'}' names {name} {told.get(name)}, its folder {here}; a cell was moved: "
                    "put it back or delete it."
                )
        card = told.get("data") or {}
        first, path = data.setdefault(task, (card, run.path))
        if unlike := other_data(card, first):
            name, here, there = unlike[0]
            raise UserError(
                f"'{run.path}' was trained on other data (its {name} is {here}) than '{path}' ({there}); "
                "keep one results folder for each data set."
            )
        algorithm, preset = told["algorithm"], _preset(task, told)
        fields, config = apart.get((algorithm, preset), []), config_of(told)
        words = "[" + ", ".join(f"{k}={config.get(k)}" for k in fields) + "]" if fields else ""
        for variant, summary in run.results.items():
            if ("@" in variant and summary.get("split") != split) or not of_last_step(summary, config):
                continue  # settings were chosen there, or training went on; no table is made of it
            shown = variant
            if told["preset"] != preset:
                shown = re.sub(rf"^{re.escape(told['preset'])}\b", preset, variant)
            method = Method(algorithm, preset, shown, words)
            entry = Entry(task, algorithm, variant, seed, summary, run.path, method, told.get("revision", 1))
            other = entries.setdefault((task, method, seed), entry)
            if other is not entry:
                raise UserError(
                    f"'{other.path}' and '{run.path}' are the same cell (same config, same seed {seed}); delete one."
                )
    return list(entries.values())


def _differing(configs: list[tuple[str, dict]]) -> dict[tuple[str, str], list[str]]:
    """Config fields that tell rows of the same algorithm and preset apart: those that differ within some task.
    A setting that is one thing on one task and another on the next is no reason for two rows."""
    groups: dict[tuple, list[dict]] = {}
    for task, told in configs:
        groups.setdefault((told["algorithm"], _preset(task, told), task), []).append(config_of(told))
    found: dict[tuple[str, str], list[str]] = {}
    for (algorithm, preset, _), several in groups.items():
        names = found.setdefault((algorithm, preset), [])
        names += [k for k in differing(several) if k not in names]
    return found


def _preset(task: str, told: dict) -> str:
    """A run's preset, where one made for the task counts as the default."""
    return "default" if told["preset"] in _presets(task) else told["preset"]


def _check(entries: list[Entry], references: dict[Path, tuple[str, dict[str, dict]]], told: dict, folder: Path) -> None:
    """Every summary must be of the protocol, split, length and normalisation that the folder declares."""
    leaders: dict[str, tuple[Path, dict]] = {}
    for e in entries:
        file = e.path / "results.json"
        who = f"'{file}' variant '{e.variant}'"
        _complete(who, e.summary, e.task, (*NEEDED, "per_episode", "split"))
        for key in ("protocol", "split", "episodes"):
            _same(who, key, e.summary[key], told[key], folder)
        _normalised(who, e.summary, leaders.setdefault(e.task, (file, e.summary)))
    for file, (task, rows) in references.items():
        for name, summary in rows.items():
            who = f"'{file}' row '{name}'"
            _complete(who, summary, task, (*NEEDED, "split"))
            _same(who, "protocol", summary["protocol"], told["protocol"], folder)
            if summary["split"] != "data":  # logged episodes have resets of their own and any number of them
                for key in ("split", "episodes"):
                    _same(who, key, summary[key], told[key], folder)
            _normalised(who, summary, leaders.setdefault(task, (file, summary)))


def _complete(who: str, summary: dict, task: str, needed: tuple[str, ...]) -> None:
    lacking = [k for k in needed if k not in summary]
    if lacking:
        raise UserError(f"{who} lacks '{lacking[0]}', so it was made by another version; evaluate it again.")
    if summary["task"] != task:
        raise UserError(f"{who} holds a result of task '{summary['task']}', not of '{task}'; evaluate it again.")


def _same(who: str, key: str, here, declared, folder: Path) -> None:
    if here != declared:
        raise UserError(
            f"{who} has {key} {here}, '{folder / FILE}' declares {declared}; such numbers cannot stand in one table: "
            "evaluate the cell again or keep it in a results folder of its own."
        )


def _normalised(who: str, summary: dict, leader: tuple[Path, dict]) -> None:
    first, of = leader
    if summary["constants"] != of["constants"]:
        raise UserError(
            f"{who} was normalised with {summary['constants']}, '{first}' with {of['constants']}; "
            "evaluate both with one version."
        )


def _constants(entries: list[Entry], references: dict[Path, tuple[str, dict]]) -> dict[str, dict[str, float]]:
    found = {task: row["constants"] for task, rows in references.values() for row in rows.values()}
    return found | {e.task: e.summary["constants"] for e in entries}
