"""Cells of a grid: content-addressed run folders that are made once, resumed when cut short, and never made twice.

DIR/bench.json                                      suite, protocol and the number of episodes
DIR/reference/<task>/reference.json                 do-nothing, random actions, the data and its safe part
DIR/cells/<task>/<algorithm>[-<preset>]/seed-<k>-<id>/   a run folder (runs.py), and status.json
DIR/{runs,curves}.tar.xz                            the last two without checkpoints and recordings (packed.py)
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import json
import logging
import shutil
import time
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ringfence import algos
from ringfence.bench.packed import unpack
from ringfence.bench.stressed import Trial
from ringfence.bench.suites import COLLECTIONS, SUITES
from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.datasets.recipes import RECIPES
from ringfence.datasets.task import Task
from ringfence.errors import RunConflict, UserError, one_of, unknown, whole_number
from ringfence.evaluation import protocol, reference
from ringfence.evaluation.evaluate import evaluate_spec
from ringfence.guards import GuardOptions, options_of
from ringfence.loading import oracle
from ringfence.loading.spec import PolicySpec
from ringfence.logs.schema import other_data
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.proposals.options import PLANNERS, PlanOptions, plan_defaults
from ringfence.training import loop, worlds
from ringfence.training.runs import Run, write_json
from ringfence.utils import schemas
from ringfence.utils.files import whole
from ringfence.world import Settings

_log = logging.getLogger(__name__)

FORMAT = 1  # of a results folder
DAMAGED = "has a damaged status.json; delete that file"
STATES = ("done", "failed", "to do")
# What a cell's id is made of stays, so that what was made before a field came or got its name is found: a field is left
# out at the value that means what there was without it, and stands under the name that it had first.
_FIRST_NAMES = {"num_updates": "steps", "target_return": "target"}
_WITHOUT = {
    "drivers": 0,
    "distinguish_agents": False,
    "around": "nothing",
    "noisy_input": "unit",
    "guided": False,
    "error": "output",
    "clone_width": 384,
    "clone_depth": 3,
}


@dataclass(frozen=True)
class Cell:
    """One training run and its evaluations; all that must be known to make it anywhere."""

    task: str
    algorithm: str
    preset: str
    seed: int
    changes: tuple[tuple[str, float], ...] = ()  # to the preset, e.g. (("num_updates", 100),)
    evaluations: tuple[tuple[str, str], ...] = ()  # (variant in results.json, name of its PolicySpec)
    transitions: int | None = None  # of the data set; None: the task's own number
    trials: tuple[tuple[str, str, bool], ...] = ()  # how it is played behind faults, each a Trial

    @property
    def group(self) -> tuple:
        """Cells of one group differ in their seed alone: they share data, critic and compiled programs."""
        return self.task, self.algorithm, self.preset

    @property
    def config(self) -> Any:
        return algos.configured(algos.get(self.algorithm), self.preset, dict(self.changes))

    @property
    def id(self) -> str:
        """Hash of what training depends on, under the names that fields had first; how the run is played does not
        count."""
        task = registry.get(self.task)
        config = dataclasses.asdict(self.config)
        told = {k: v for k, v in config.items() if k not in _WITHOUT or v != _WITHOUT[k]}
        content = {
            "format": FORMAT,
            "data": [RECIPES, self.task, self.transitions or task.transitions, constraints.to_dict(task.hazard)],
            "algorithm": self.algorithm,
            "config": {_FIRST_NAMES.get(k, k): v for k, v in told.items()},
            "seed": self.seed,
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:10]

    def folder(self, out: Path) -> Path:
        name = self.algorithm if self.preset == "default" else f"{self.algorithm}-{self.preset}"
        return out / "cells" / self.task / name / f"seed-{self.seed}-{self.id}"

    def paired(self) -> Cell | None:
        """The same cell on the task that shares this one's data under another definition of danger, if the algorithm
        reads none: it learned the same there."""
        if algos.get(self.algorithm).cost_source(self.config) != "nothing":
            return None
        other = registry.paired(self.task)
        return None if other is None else replace(self, task=other)

    def missing(self, out: Path, episodes: int) -> list[tuple[str, str]]:
        """Evaluations that the folder does not hold yet."""
        known = Run(self.folder(out)).results
        config = dataclasses.asdict(self.config)

        def there(variant: str, name: str) -> bool:
            r = known.get(variant, {})
            same = r.get("episodes") == episodes and r.get("protocol") == protocol.PROTOCOL
            same = same and protocol.complete(r, registry.get(self.task)) and protocol.of_last_step(r, config)
            return same and same_options(r, PolicySpec.parse(name), registry.get(self.task), plan_defaults(self.config))

        return [e for e in self.evaluations if not there(*e)]

    def missing_trials(self, out: Path, episodes: int) -> list[Trial]:
        """Evaluations behind faults that the folder does not hold yet."""
        run = Run(self.folder(out))
        task = registry.get(self.task)
        config = dataclasses.asdict(self.config)

        def there(trial: Trial) -> bool:
            found = trial.result(run, episodes)
            if found is None or not protocol.of_last_step(found, config):
                return False
            return same_options(found, PolicySpec.parse(trial.spec), task, plan_defaults(self.config))

        return [trial for trial in itertools.starmap(Trial, self.trials) if not there(trial)]

    def unfinished(self, out: Path, episodes: int) -> bool:
        """Whether something of it is to be made."""
        return bool(self.missing(out, episodes) or self.missing_trials(out, episodes))

    def state(self, out: Path, episodes: int) -> str:
        """done, failed or to do."""
        if not self.unfinished(out, episodes):
            return "done"
        return "failed" if self.status(out).get("state") == "failed" else "to do"

    def status(self, out: Path) -> schemas.Status:
        """What its folder says of making it; nothing before it was begun."""
        return cell_status(self.folder(out)) or schemas.Status()


def cell_status(folder: Path) -> schemas.Status | None:
    """What a cell's folder says of making it; None before it says anything."""
    file = folder / "status.json"
    return schemas.read(file, schemas.Status, DAMAGED) if file.exists() else None


def same_options(stored: dict, spec: PolicySpec, task: Task, defaults: dict) -> bool:
    """Whether a result was played as a spec stands for on a task today: with its options of planner and guard, given
    the planner's defaults, and in a World of today's settings. What labels come from follows from the data."""
    plan = PlanOptions(**{**defaults, **PLANNERS[spec.planner], **dict(spec.plan_options)})
    usual = dataclasses.asdict(PlanOptions())
    wanted = dataclasses.asdict(plan)
    if stored["options"]:
        played = {**usual, **stored["options"]}
        weights = ("barrier_guidance", "value_guidance")  # 0 before they could be the method's own
        played, wanted = ({**x, **{name: x[name] or 0.0 for name in weights}} for x in (played, wanted))
        if played != wanted:
            return False
    guard = stored.get("guard_options") or {}
    if not spec.guarded:
        return not guard
    usual = dataclasses.asdict(GuardOptions())
    asked = dict(spec.guard_options)
    played = {**usual, **guard}  # an option newer than the result had its default then
    newer = usual.keys() - guard.keys() - asked.keys()  # a named guard that has since learned more was that guard
    if spec.barrier == oracle.ORACLE:
        wanted = dataclasses.asdict(oracle.options(spec.guard, task, asked))
        return bool(guard) and played == wanted | {name: played[name] for name in newer}
    options = GuardOptions(**options_of(spec.guard, spec.barrier, task.guard, **asked))
    wanted = dataclasses.asdict(options) | {name: played[name] for name in newer}
    if options.horizon_seconds:  # how many steps these are, the World knew
        wanted["horizon"] = played["horizon"]
    if task.guard_by_card:  # how far the guard looked, and whether beyond the logs, was the World's affair
        looked = {"horizon", "terminal_value", "within_logs"} - asked.keys()
        wanted |= {name: played[name] for name in looked}
    world = Settings(**worlds.usual(task, worlds.execution_of(task, spec.execution)))
    fitted = stored.get("world_settings") or {}  # results of before say nothing of it
    known = {k: v for k, v in dataclasses.asdict(world).items() if k not in ("labels", "barrier")}
    return bool(guard) and played == wanted and all(fitted.get(k, v) == v for k, v in known.items())


@dataclass(frozen=True)
class Grid:
    """The cells of one results folder."""

    out: Path
    suite: str
    cells: tuple[Cell, ...]
    episodes: int = 200

    @property
    def taken(self) -> str:
        """What a second runner reads."""
        return f"Another runner works on '{self.out}'; wait for it or stop it."

    def count(self) -> dict[str, int]:
        """How many cells are done, failed and to do."""
        states = [c.state(self.out, self.episodes) for c in self.cells]
        return {s: states.count(s) for s in STATES}

    def groups(self) -> list[list[Cell]]:
        """Unfinished cells by group, in the grid's order; failed ones are tried again."""
        left: dict[tuple, list[Cell]] = {}
        for cell in self.cells:
            if cell.unfinished(self.out, self.episodes):
                left.setdefault(cell.group, []).append(cell)
        return list(left.values())

    def references(self) -> dict[str, int | None]:
        """Tasks whose reference rows are not there yet, with the size of their data."""
        sizes = {c.task: c.transitions for c in self.cells}
        folder = self.out / "reference"
        return {t: n for t, n in sizes.items() if not reference.there(registry.get(t), folder, self.episodes, n)}

    def open(self) -> None:
        """Make the folder, if it is not there."""
        self.check()
        if not (self.out / "bench.json").exists():
            write_json(self.out / "bench.json", about(self.suite, self.episodes))

    def check(self) -> None:
        """Refuse a folder that holds anything but results of this suite and protocol."""
        mine = about(self.suite, self.episodes)
        file = self.out / "bench.json"
        if not file.exists():
            if self.out.exists() and not self.out.is_dir():
                raise UserError(f"'{self.out}' is a file; give --out an empty or a results folder.")
            if self.out.exists() and any(self.out.iterdir()):
                raise UserError(f"'{self.out}' holds something else; give --out an empty or a results folder.")
            return
        there = read_about(self.out)
        wrong = [k for k in mine if there.get(k) != mine[k]]
        if wrong:
            raise UserError(
                f"'{file}' has {wrong[0]}={there.get(wrong[0])!r}, this grid {mine[wrong[0]]!r}; give another --out."
            )


def about(suite: str, episodes: int) -> dict[str, Any]:
    """Contents of bench.json."""
    return {"format": FORMAT, "protocol": protocol.PROTOCOL, "suite": suite, "episodes": episodes, "split": "test"}


RESTORE = "restore that file, e.g. from another results folder of this suite and number of episodes"


def read_about(out: Path) -> dict[str, Any]:
    """bench.json of a results folder of this version, whose archives are unpacked then."""
    file = out / "bench.json"
    if not file.is_file():
        raise UserError(
            f"'{out}' holds no bench.json, so it is no results folder; give the --out of `ringfence bench`."
        )
    there = schemas.read(file, schemas.Bench, f"holds a damaged bench.json; {RESTORE}")
    if there.get("format") != FORMAT:
        raise UserError(
            f"'{file}' has format {there.get('format')}, this version reads format {FORMAT}; use the version of "
            "ringfence that wrote it, or run the benchmark again."
        )
    if lacking := [name for name in about("", 0) if name not in there]:
        raise UserError(f"'{file}' lacks '{lacking[0]}'; {RESTORE}.")
    unpack(out)
    return dict(there)


def statuses(out: str | Path) -> list[dict[str, Any]]:
    """status.json of every cell that was begun, with its task and folder; a begun cell without one is under way, and
    one that failed early has nothing else."""
    read_about(Path(out))
    found = []
    begun = {f.parent for name in ("config", "status") for f in (Path(out) / "cells").glob(f"*/*/[!.]*/{name}.json")}
    for folder in sorted(begun):
        status = cell_status(folder) or {"state": "under way"}
        task, algorithm, seed = folder.parts[-3:]
        found.append({**status, "task": task, "run": f"{algorithm}/{seed}"})
    return found


def entry_names(suite: str) -> set[str]:
    """What entries of a suite are chosen by."""
    chosen = SUITES[suite]
    return {name for task in chosen.tasks for e in chosen.entries for name in e.names(registry.get(task))}


def make_grid(
    suite: str,
    out: str | Path,
    *,
    seeds: int = 5,
    episodes: int | None = None,
    only_tasks: Iterable[str] = (),
    only: Iterable[str] = (),
    num_updates: int | None = None,
    transitions: int | None = None,
) -> Grid:
    """The grid of a suite, or of the named tasks and entries (`algorithm` or `algorithm:preset`) of it."""
    chosen = one_of("suite", suite, SUITES)
    episodes = chosen.episodes if episodes is None else episodes
    seeds = whole_number("seeds", seeds, 1, 10_000)
    episodes = whole_number("episodes", episodes, 1, 10**7)
    names = tuple(only_tasks) or chosen.tasks
    only = tuple(only)
    for name in names:
        if name not in chosen.tasks:
            raise unknown(f"task of the suite {suite}", name, chosen.tasks)
    known = entry_names(suite)
    for name in only:
        if name not in known:
            raise unknown("entry", name, known)
    changes = () if num_updates is None else (("num_updates", num_updates),)
    cells = []
    for name in names:
        task = registry.get(name)
        for e in chosen.entries:
            if not e.plays(task.tier) or (only and not set(only) & set(e.names(task))):
                continue
            played = tuple((e.variant(task, v), v) for v in e.evaluations)
            preset = e.preset_for(task)
            whose = (changes, played, transitions, e.trials)
            cells += [Cell(name, e.algorithm, preset, k, *whose) for k in range(seeds)]
    if not cells:
        raise UserError(
            f"The suite {suite} plays {', '.join(sorted(only))} on none of {', '.join(names)}; choose other tasks or "
            "algorithms."
        )
    return Grid(Path(out), suite, tuple(cells), episodes)


def make_grids(held: Mapping[str, Iterable[str]], root: Path, only: Iterable[str] = (), **sizes: Any) -> list[Grid]:
    """The grids of several suites' tasks `held`, each in its folder of `root`; an entry that one suite alone knows is
    made there. `sizes`: arguments of `make_grid`."""
    known = {suite: entry_names(suite) for suite in held}
    only = list(only)
    for name in only:
        if not any(name in k for k in known.values()):
            raise unknown("entry", name, set().union(*known.values()))
    mine = {suite: [n for n in only if n in known[suite]] for suite in held}
    return [
        make_grid(suite, root / suite, only_tasks=names, only=mine[suite], **sizes)
        for suite, names in held.items()
        if mine[suite] or not only
    ]


def collected(name: str, only_tasks: Iterable[str] = ()) -> dict[str, list[str]]:
    """The tasks of a collection of suites, or those named, by suite."""
    return narrowed({suite: SUITES[suite].tasks for suite in COLLECTIONS[name]}, only_tasks, name)


def narrowed(held: Mapping[str, Iterable[str]], only: Iterable[str], of: str) -> dict[str, list[str]]:
    """The tasks of several suites, or those named; a name that no suite of the collection `of` holds is refused."""
    only = list(only)
    known = set().union(*held.values())
    for task in only:
        if task not in known:
            raise unknown(f"task of {of}", task, known)
    kept = {suite: [t for t in names if t in only or not only] for suite, names in held.items()}
    return {suite: names for suite, names in kept.items() if names}


Tell = Callable[[str, Cell], None]  # hears of an event (start, done, failed) and its cell


def run_group(cells: list[Cell], out: Path, episodes: int, tell: Tell) -> None:
    """Train and play cells of one group, one after the other.

    A cell that fails is recorded and does not stop the others.
    """
    _Group(cells, out, episodes, tell).run()


class _Group:
    """Cells that are being made: the first of `left` now."""

    def __init__(self, cells: list[Cell], out: Path, episodes: int, tell: Tell):
        self.left = list(cells)
        self.out = out
        self.episodes = episodes
        self.tell = tell
        self.adopted: dict[Cell, str] = {}  # whose training was another cell's, by that cell's folder
        self.begun = time.perf_counter()

    def run(self) -> None:
        while self.left:
            self._start()
            try:
                # All that is left, in one call: seeds share their data and compiled programs.
                first = self.left[0]
                store = data_of(first.task, first.transitions)
                for cell in self.left:
                    if paired := adopt(cell, self.out, store.card.to_dict()):
                        self.adopted[cell] = str(paired.folder(self.out).relative_to(self.out))
                loop.train(
                    first.algorithm,
                    store,
                    preset=first.preset,
                    seeds=tuple(cell.seed for cell in self.left),
                    changes=dict(first.changes),
                    folder={cell.seed: cell.folder(self.out) for cell in self.left}.__getitem__,
                    on_finish=self._finish,
                    quiet=True,
                )
            except Exception as error:
                failed = self.left[0]
                if isinstance(error, RunConflict):  # found before any training, and perhaps not in the first cell
                    failed = next(c for c in self.left if c.folder(self.out) == error.folder)
                record_failure(failed, self.out, f"{type(error).__name__}: {error}", traceback.format_exc())
                self.left.remove(failed)
                self.tell("failed", failed)

    def _start(self) -> None:
        self.begun = time.perf_counter()
        self.tell("start", self.left[0])

    def _finish(self, run: Run) -> None:
        """Play the cell whose run is trained, and go on to the next one."""
        cell = self.left[0]
        trained = time.perf_counter() - self.begun
        for _, name in cell.missing(self.out, self.episodes):
            num_recorded = 4 if cell.seed == 0 else 0
            # A benchmark measures what an unfit World is worth, too.
            spec = replace(PolicySpec.parse(name, run), anyway=True)
            worlds.with_world(evaluate_spec, spec, episodes=self.episodes, num_recorded=num_recorded)
        for trial in cell.missing_trials(self.out, self.episodes):
            worlds.with_world(trial.play, run, self.episodes)
        played = time.perf_counter() - self.begun - trained
        # What the cell's status says of its time; of one that was only played again, training took what it took.
        adopted = {"adopted": self.adopted[cell]} if cell in self.adopted else {}
        took: dict[str, Any] = {"train_seconds": trained, "eval_seconds": played, **adopted}
        before = dict(cell.status(self.out))
        if before.get("state") == "done":
            took |= {name: before[name] for name in ("train_seconds", "adopted") if name in before}
            took["eval_seconds"] += before.get("eval_seconds", 0.0)
        _record(cell, self.out, "done", took)
        self.tell("done", self.left.pop(0))
        if self.left:
            self._start()


@functools.lru_cache(maxsize=1)
def data_of(task: str, transitions: int | None) -> EpisodeStore:
    """The data set of a task. The last one is kept: groups of one task follow each other, and what was computed from a
    store (windows, critic) is found again by the store itself."""
    return make(registry.get(task), transitions, must_keep=False)[0]


def adopt(cell: Cell, out: Path, card: dict[str, Any]) -> Cell | None:
    """Begin a cell on data of this card with what its paired cell has learned, and return that one; its training is
    then over at once. None where that cell is not done, or learned of other data or by another revision."""
    paired = cell.paired()
    if paired is None or paired.status(out).get("state") != "done" or Run(cell.folder(out)).checkpoints():
        return None
    there = Run(paired.folder(out))
    here = Run(cell.folder(out))
    config = there.config
    apart = {name for name, *_ in other_data(config["data"], card)} - {"task", "hazard"}
    if apart or config.get("revision", 1) != algos.get(cell.algorithm).revision:
        return None
    learned = [file for _, file in there.checkpoints()[-1:]]
    if not learned:  # results without what was learned, as a copied folder has them
        return None
    for file in (there.path / "metrics.jsonl", *learned):
        with whole(here.path / file.relative_to(there.path)) as temporary:
            shutil.copyfile(file, temporary)
    return paired


def _record(cell: Cell, out: Path, state: str, more: Mapping[str, Any]) -> None:
    attempts = cell.status(out).get("attempts", 0) + 1
    write_json(cell.folder(out) / "status.json", {"state": state, "attempts": attempts, "id": cell.id, **more})


def record_failure(cell: Cell, out: Path, error: str, trace: str = "") -> None:
    """Say in the cell's folder what went wrong."""
    _record(cell, out, "failed", {"error": error, "traceback": trace})


def tell_lost(what: str, why: str) -> None:
    """Say that something which no cell needs could not be made."""
    _log.warning(f"{what} could not be made: {why}")


def make_reference(task: str, out: Path, episodes: int, transitions: int | None = None) -> None:
    """Reference rows of a task, once."""
    reference.make(registry.get(task), data_of(task, transitions), out / "reference", episodes)
