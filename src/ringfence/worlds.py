"""Worlds of data sets and of runs: which settings, from where."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ringfence import features, hazards, tasks
from ringfence.data.origin import regenerated
from ringfence.data.store import EpisodeStore
from ringfence.errors import UserError
from ringfence.runs import Run, build_config
from ringfence.tasks import Task
from ringfence.world import Settings, World
from ringfence.world import load as load_world
from ringfence.world.fitting import fit_view

WORLD = "world.safetensors"  # in a run folder: the World that training read
GUARD = "guard.safetensors"  # and the one that guards, where that is kept there and is another


def settings_for(store: EpisodeStore, task: Task | None = None, **changes) -> Settings:
    """The settings of a World of this data: the task's own where it has some, and labels from its costs if they tell
    safe steps from unsafe ones, else from its formula; without either, no barrier."""
    task = task or tasks.from_store(store)
    sight = sight_of(task, changes.pop("sight", None))
    told = usual(task, sight)
    costs = store.costs > 0
    if not (costs.any() and not costs.all()) and "labels" not in changes and "barrier" not in changes:
        formula = not isinstance(task.hazard, hazards.CostColumn)
        told |= {"labels": "formula"} if formula else {"barrier": False}
    return build_config(Settings, {**told, **changes}, "the World")


def sight_of(task: Task, wanted: str | None = None) -> str:
    """Whether guards see the team ("all") or every agent guards itself ("own"): as wanted; by default the team, but
    agents who are alike know nothing but what each of them sees."""
    if task.alike and wanted == "all":
        raise UserError(
            f"The agents of '{task.name}' are alike and see for themselves, so there is no sight='all'; leave it out."
        )
    return wanted or ("own" if task.alike else "all")


def usual(task: Task, sight: str) -> dict:
    """What a task asks of its World, unless told otherwise: the fields of `Settings` that are not as everywhere."""
    return {"view": "decentralized" if sight == "own" else "pruned", **task.world, "sight": sight}


def fit(
    store: EpisodeStore,
    *,
    seed: int = 0,
    task: Task | None = None,
    cached: bool = True,
    quiet: bool = True,
    **changes,
) -> World:
    """The World of a store (T + E rows, N agents); `changes` are fields of Settings. Cached by content: the same data,
    settings and seed are fitted once. `task`: of a simulator that is not in `tasks.TASKS`; else the store's own.

    world = ringfence.fit(store); print(world.card)
    """
    if not isinstance(store, EpisodeStore):
        raise UserError(f"fit() got data of type {type(store).__name__}; pass an EpisodeStore.")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise UserError(f"seed={seed!r} must be a whole number, 0 or more.")
    task = task or tasks.from_store(store)
    settings, store = settings_for(store, task, **changes), task.logs(store)
    map = task.feature_map(settings.view, store)
    spec = task.spec(map, store)
    needed = settings.labels == "formula" and settings.barrier
    bind = hazards.bind if needed else hazards.bind_or_none
    hazard = bind(task.hazard, spec.feature_names, spec.n_agents)
    return fit_view(store, map, spec, settings, hazard=hazard, seed=int(seed), cached=cached, quiet=quiet)


def of_run(run: Run, quiet: bool = True) -> World:
    """The World that a run's training read, in its folder; of runs that read none, that of their data (`for_guard`)."""
    kept = run.path / WORLD
    return load(kept) if kept.exists() else _of_data(run, None, quiet)


def for_guard(
    run: Run,
    sight: str | None = None,
    world: World | str | Path | None = None,
    read: World | None = None,
    quiet: bool = True,
) -> World:
    """The World that guards a run: the one that is given; else that of its task and seed, whatever the run's own
    training read, so that all proposals of a task are judged alike. Of data that this package does not regenerate it
    is the one in the run's folder, or has to be given. `read`: what training read, if it is loaded already."""
    alike = run.config["spec"].get("alike", False)
    sight = sight or ("own" if alike else "all")
    if world is not None:
        world = world if isinstance(world, World) else load(world)
        _of_same(run, world, sight)
        return world
    if (run.path / GUARD).exists() and (kept := load(run.path / GUARD)).alone == (sight == "own"):
        return kept
    if read is not None or (run.path / WORLD).exists():
        found = read or of_run(run, quiet)
        # Training may ask for another view, or for values that look less far.
        wanted = Settings(**usual(tasks.TASKS[run.config["task"]], sight)) if _made_here(run) else None
        told = found.card["settings"]
        same = wanted is None or (wanted.view, wanted.discount) == (told["view"], told["discount"])
        if same and found.alone == (sight == "own"):
            return found
    return _of_data(run, sight, quiet)


def _made_here(run: Run) -> bool:
    """Whether this package regenerates the data of a run."""
    return regenerated(run.config["data"]) and run.config["task"] in tasks.TASKS


def _of_data(run: Run, sight: str | None, quiet: bool) -> World:
    """The World of a run's data and seed, where that is regenerated."""
    told = run.config
    if not _made_here(run):
        raise UserError(
            f"A guard of '{run.path}' needs the World of its data, which is not there; make one with `ringfence fit "
            f"STORE --out FILE{' --sight own' if sight == 'own' else ''}` and name it with world=FILE."
        )
    from ringfence.data.make import make

    card = told["data"]
    size = card.get("size", card.get("transitions"))
    store, _ = make(tasks.get(told["task"]), size, card.get("seed", 0), must_keep=False)
    return fit(store, seed=told["seed"], sight=sight, quiet=quiet)


def _of_same(run: Run, world: World, sight: str) -> None:
    """Refuse a World of other data, or of another sight."""
    told = run.config
    here, there = told["data"].get("content"), world.card["data"]
    apart = told["task"] != there["task"] or (here is not None and here != there["content"])
    if apart:
        raise UserError(
            f"The World is of '{there['task']}', the run '{run.path}' of other data ('{told['task']}'); fit one to the "
            "data that the run was trained on."
        )
    if world.alone != (sight == "own"):
        raise UserError(
            f"The World was fitted with sight={'own' if world.alone else 'all'}, the guard is to have sight={sight}; "
            f"fit one with `ringfence fit STORE --sight {sight}`."
        )


def load(path: str | Path) -> World:
    """The World in a file that `save` or `ringfence fit --out` wrote, or in a run folder."""

    def map_of(task: str, view: features.View, hazard: dict) -> features.FeatureMap | None:
        known = tasks.simulated(task, hazards.from_dict(hazard))
        return None if known is None else known.feature_map(view)

    return load_world(path, map_of)
