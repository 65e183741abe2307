"""Worlds of data sets and of runs: which settings, from where. Who plays a run reads one that is there (`of_run`,
`for_guard`); only `fit`, `fit_run` and `with_world` make any."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from msgspec.structs import replace

from ringfence.datasets import registry
from ringfence.datasets.audit import odd_danger, odd_names
from ringfence.datasets.make import make
from ringfence.datasets.task import Task
from ringfence.errors import LAST_SEED, NoWorld, UserError, whole_number
from ringfence.guards.searched import false_safe
from ringfence.logs.resolution import require_resolved
from ringfence.logs.schema import StoreCard, complete_card, regenerated
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints, features
from ringfence.problem.origins import Origins
from ringfence.training.runs import Run
from ringfence.utils.compilation import keep_programs
from ringfence.utils.config import build_config
from ringfence.utils.files import writable
from ringfence.utils.precision import in_float32
from ringfence.utils.progress import Parts
from ringfence.world import Settings, World, judging, load, save
from ringfence.world.fit import Fit, cached_file, expected, fitted
from ringfence.world.verdict import decided

WORLD = "world.safetensors"  # in a run folder: the World that training read
GUARD = "guard.safetensors"  # and the one that guards, where that is kept there and is another
GUARD_ALONE = "guard-decentralized.safetensors"  # the same of agents who guard themselves, though their team could
COSTS_TELL = "costs_tell_danger"  # in a run's card of its data: whether costs tell safe steps from unsafe ones

P = ParamSpec("P")
T = TypeVar("T")

# Fields of a card that a World of its arrays depends on.
_READ = (
    "task hazard constraints homogeneous team agents action_low action_high action_sizes action_delay dt "
    "observation_names observation_origins state_names state_origins"
).split()


def settings_for(task: Task, costs_tell: bool, **changes) -> Settings:
    """The settings of a World of data: the task's own where it has some, and labels from the costs if they tell safe
    steps from unsafe ones, else from the formula; without either, no barrier."""
    execution = execution_of(task, changes.pop("execution", None))
    settings = usual(task, execution)
    if not costs_tell and "labels" not in changes and "barrier" not in changes:
        formula = not isinstance(task.hazard, constraints.CostColumn)
        settings |= {"labels": "formula"} if formula else {"barrier": False}
    return build_config(Settings, {**settings, **changes}, "the World")


def costs_tell(store: EpisodeStore) -> bool:
    """Whether costs tell safe steps from unsafe ones."""
    unsafe = store.costs > 0
    return bool(unsafe.any() and not unsafe.all())


def execution_of(task: Task, wanted: str | None = None) -> str:
    """Whether guards see the team ("centralized") or every agent guards itself ("decentralized"): as wanted; by
    default the team, but homogeneous agents know nothing but what each of them sees."""
    if task.homogeneous and wanted == "centralized":
        raise UserError(
            f"The agents of '{task.name}' are homogeneous and see for themselves, so there is no "
            "execution='centralized'; leave it out."
        )
    return wanted or ("decentralized" if task.homogeneous else "centralized")


def usual(task: Task, execution: str) -> dict:
    """What a task asks of its World by default: the fields of `Settings` that are not as everywhere."""
    return {
        "view": "decentralized" if execution == "decentralized" else "pruned",
        **task.world,
        "execution": execution,
    }


def check(seed: int, changes: Mapping[str, Any]) -> int:
    """The seed, if it is one and if these are settings of a World; refused before any data is made or read."""
    usual = {"execution"} if changes.get("execution") is None else set()  # as the task has it
    build_config(Settings, {name: changes[name] for name in changes.keys() - usual}, "the World")
    return whole_number("seed", seed, 0, LAST_SEED)


@in_float32
def fit(store: EpisodeStore, *, seed: int = 0, cached: bool = True, quiet: bool = True, **changes) -> World:
    """The World of a store (T + E rows, N agents); `changes` are fields of Settings. Cached by content: the same data,
    settings and seed are fitted once.

    world = ringfence.fit(store); print(world.card)
    """
    keep_programs()
    if not isinstance(store, EpisodeStore):
        raise UserError(f"fit() got data of type {type(store).__name__}; pass an EpisodeStore.")
    seed = check(seed, changes)
    require_resolved(store)
    task = registry.from_store(store)
    settings, logs = settings_for(task, costs_tell(store), **changes), task.logs(store)
    needed = settings.labels == "formula" and settings.barrier
    for note in odd_names(logs) if needed else odd_danger(logs, task):
        warnings.warn(note, stacklevel=3)  # before minutes are spent
    with Parts(f"World of '{logs.card.task}'", expected(settings, len(logs.limits)), quiet) as bar:
        with bar.part("reading"):
            map = task.feature_map(settings.view, logs, team=settings.execution == "centralized")
            spec = task.spec(map, logs)
            bind = constraints.bind if needed else constraints.bind_or_none
            hazard = bind(task.hazard, spec.feature_names, spec.n_agents)
        file = _cached_file(store.card, store.content, task, settings, seed)
        if cached:
            if (kept := _kept(file, logs.card.content or logs.content, settings, seed, map)) is not None:
                return kept
            writable(file)
        world = _judged(Fit(logs, map, spec, settings, hazard, seed, cached, bar))
    if cached:
        save(world, file)
    return world


def _judged(of: Fit) -> World:
    """The World, fitted, with a card that says how good it is: by itself, and by what a guard finds in it."""
    begun = time.perf_counter()
    world, logged, whole = fitted(of)
    with of.bar.part("card"):
        world = judging.judged(world, logged, whole, judging.JUDGING)
    card = world.card
    with of.bar.part("search"):
        if card.barrier is not None:
            searched = false_safe(world, logged, judging.JUDGING)
            card = replace(card, barrier=replace(card.barrier, searched=searched))
    seconds = of.bar.seconds | {"in all": time.perf_counter() - begun}
    card = replace(card, seconds={name: round(took, 1) for name, took in seconds.items()})
    return dataclasses.replace(world, card=decided(card))


def card_of(store: EpisodeStore) -> dict[str, Any]:
    """What a run says of its data: their card, and by what Worlds of them are found without them."""
    return store.card.to_dict() | {"content": store.content, COSTS_TELL: costs_tell(store)}


def _cached_file(card: StoreCard, content: str, task: Task, settings: Settings, seed: int) -> Path:
    """Where a World is cached: by what a run's config.json knows of it, since its view follows from data and settings,
    and its formula from the task."""
    told = {name: getattr(card, name) for name in _READ}
    how = [dataclasses.asdict(settings), dataclasses.asdict(judging.JUDGING), seed]
    return cached_file("world", [content, told, constraints.to_dict(task.hazard), *how])


def _kept(
    file: Path, content: str, settings: Settings, seed: int, map: features.FeatureMap | None = None
) -> World | None:
    """A cached World; None where there is none, a damaged one, or one of other data, settings or seed, which somebody
    has put there."""
    if not file.exists():
        return None
    try:
        found = load(file, map)
    except UserError:
        return None
    card = found.card
    return found if (card.data.content, card.settings, card.seed) == (content, settings, seed) else None


# --- of runs ---


def of_run(run: Run) -> World:
    """The World that a run's training read, in its folder."""
    file = run.path / WORLD
    if not file.exists():
        raise UserError(
            f"'{run.path}' lacks '{WORLD}', the World that its training read; copy it there or train again."
        )
    return _beside(run, file)


def for_guard(
    run: Run,
    execution: str | None = None,
    world: World | str | Path | None = None,
    read: World | None = None,
) -> World:
    """The World that guards a run: the one that is given; else that of its task and seed, whatever the run's own
    training read, so that all proposals of a task are judged alike. Of data that this package does not regenerate one
    that training read is taken, too. None is made: `NoWorld` says how. `read`: what training read, if it is loaded."""
    task = _task_of(run)
    execution = execution_of(task, execution)
    if world is not None:
        world = world if isinstance(world, World) else load(world)
        _require_same(run, world)
        if world.alone != (execution == "decentralized"):
            raise UserError(
                f"The World was fitted with execution={world.card.settings.execution}, the guard is to have "
                f"execution={execution}; fit one with `ringfence fit STORE --execution {execution}`."
            )
        return world
    found = _in_folder(run, task, execution, read)
    found = _in_cache(run, task, execution) if found is None else found
    if found is None:
        raise _lacking(run, task, execution)
    return found


@in_float32
def fit_run(run: Run | str | Path, *, execution: str | None = None, quiet: bool = True) -> World:
    """The World that guards a run, in its folder from now on: that of `for_guard`, or else one that is fitted to the
    run's data, made again where this package made them. Its seed is the run's, its settings are the task's."""
    run = Run.of(run)
    task = _task_of(run)
    execution = execution_of(task, execution)
    found = _in_folder(run, task, execution)
    if found is not None:
        return found
    file = writable(run.path / (GUARD if execution == execution_of(task) else GUARD_ALONE))
    world = _in_cache(run, task, execution)
    if world is None:
        if not _made_here(run):
            raise _lacking(run, task, execution)
        config = run.config
        card = config["data"]
        size = card.get("size", card.get("transitions"))
        store, _ = make(registry.get(config["task"]), size, card.get("seed", 0), must_keep=False)
        world = fit(store, seed=config["seed"], execution=execution, quiet=quiet)
    save(world, file)
    return world


def with_world(play: Callable[P, T], *given: P.args, **options: P.kwargs) -> T:
    """What `play` gives of all else. Where it is refused for lack of a World that can be made of regenerated data, that
    is made first; nothing else decides so."""
    for _ in range(2):  # a guard may read one, and a planner be guided by another
        try:
            return play(*given, **options)
        except NoWorld as refused:
            lacking = refused
        fit_run(lacking.folder, execution=lacking.execution, quiet=False)  # it takes minutes
    return play(*given, **options)


def _task_of(run: Run) -> Task:
    """The task of a run's data, as far as a World depends on it."""
    config = run.config
    hazard = constraints.from_dict(config["data"].get("hazard", config["hazard"]))
    known = registry.simulated(config["task"], hazard) if config.get("feature_map") is None else None
    return known or Task(config["task"], None, hazard, homogeneous=config["spec"].get("homogeneous", False))


def _in_folder(run: Run, task: Task, execution: str, read: World | None = None) -> World | None:
    """The World in a run's folder that guards it."""
    alone = execution == "decentralized"
    for file in (run.path / GUARD, run.path / GUARD_ALONE):
        if file.exists() and (kept := _beside(run, file)).alone == alone:
            return kept
    if read is None and not (run.path / WORLD).exists():
        return None
    found = of_run(run) if read is None else read
    # Training may ask for another view, or for values that look less far.
    wanted = Settings(**usual(task, execution)) if _made_here(run) else found.card.settings
    same = (wanted.view, wanted.discount) == (found.card.settings.view, found.card.settings.discount)
    return found if same and found.alone == alone else None


def _in_cache(run: Run, task: Task, execution: str) -> World | None:
    """The World that was fitted to a run's data before, with its seed and its task's settings."""
    config = run.config
    card = config["data"]
    if not {"content", COSTS_TELL} <= card.keys():
        return None
    settings = settings_for(task, bool(card[COSTS_TELL]), execution=execution)
    file = _cached_file(complete_card(card), card["content"], task, settings, config["seed"])
    return _kept(file, card["content"], settings, config["seed"])


def _made_here(run: Run) -> bool:
    """Whether this package regenerates the data of a run."""
    return regenerated(run.config["data"]) and run.config["task"] in registry.TASKS


def _lacking(run: Run, task: Task, execution: str) -> UserError:
    """The refusal of who reads no World, because there is none."""
    flag = "" if execution == execution_of(task) else f" --execution {execution}"
    needs = f"A guard of '{run.path}' needs the World of its data, which is not there; make"
    if _made_here(run):
        return NoWorld(f"{needs} it with `ringfence fit {run.path}{flag}`.", run.path, execution)
    return UserError(
        f"{needs} one with `ringfence fit STORE --out FILE{flag}` and name it with world=FILE (--world FILE)."
    )


def _beside(run: Run, file: Path) -> World:
    """A World in the run's folder."""
    found = load(file)
    _require_same(run, found, f"'{file}'", "put the run's own World there, or delete that file")
    return found


def _require_same(
    run: Run, world: World, what: str = "What is given", remedy: str = "fit one to the data that it was trained on"
) -> None:
    """Refuse a World of other data than the run's: of another task or action, of other arrays (but another processor
    rounds regenerated ones otherwise), or moved by other origins, by which the same place has other numbers."""
    config = run.config
    there = world.card.data
    content = None if regenerated(config["data"]) else config["data"].get("content")
    same = (config["task"], config["spec"]["action_dim"]) == (there.task, world.spec.action_dim)
    if not same or content not in (None, there.content):
        raise UserError(
            f"{what} is a World of '{there.task}', the run '{run.path}' of other data ('{config['task']}'); {remedy}."
        )
    origins = Origins.of(config["data"])
    if world.spec.homogeneous:  # agents who see for themselves read no state, wherever it was moved
        origins = dataclasses.replace(origins, state=None)
    if world.origins != origins:
        raise UserError(
            f"{what} is a World of logs that were moved by other origins than those of the run '{run.path}'; {remedy}."
        )
