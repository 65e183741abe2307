"""Worlds of data sets: which settings, from where."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from ringfence.datasets import registry
from ringfence.datasets.audit import odd_danger, odd_names
from ringfence.datasets.task import Task
from ringfence.errors import LAST_SEED, UserError, whole_number
from ringfence.guards.searched import false_safe
from ringfence.logs.resolution import require_resolved
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints, features
from ringfence.utils.compilation import keep_programs
from ringfence.utils.config import build_config
from ringfence.utils.precision import in_float32
from ringfence.utils.progress import Parts
from ringfence.world import Settings, World, judging
from ringfence.world import load as load_world
from ringfence.world.fit import Fit, expected, fitted
from ringfence.world.verdict import decided

WORLD = "world.safetensors"  # in a run folder: the World that training read
GUARD = "guard.safetensors"  # and the one that guards, where that is kept there and is another


def settings_for(store: EpisodeStore, task: Task | None = None, **changes) -> Settings:
    """The settings of a World of this data: the task's own where it has some, and labels from its costs if they tell
    safe steps from unsafe ones, else from its formula; without either, no barrier."""
    task = task or registry.from_store(store)
    execution = execution_of(task, changes.pop("execution", None))
    settings = usual(task, execution)
    costs = store.costs > 0
    if not (costs.any() and not costs.all()) and "labels" not in changes and "barrier" not in changes:
        formula = not isinstance(task.hazard, constraints.CostColumn)
        settings |= {"labels": "formula"} if formula else {"barrier": False}
    return build_config(Settings, {**settings, **changes}, "the World")


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
    keep_programs()
    if not isinstance(store, EpisodeStore):
        raise UserError(f"fit() got data of type {type(store).__name__}; pass an EpisodeStore.")
    seed = check(seed, changes)
    require_resolved(store)
    task = task or registry.from_store(store)
    settings, store = settings_for(store, task, **changes), task.logs(store)
    needed = settings.labels == "formula" and settings.barrier
    for note in odd_names(store) if needed else odd_danger(store, task):
        warnings.warn(note, stacklevel=3)  # before minutes are spent
    with Parts(f"World of '{store.card.task}'", expected(settings, len(store.limits)), quiet) as bar:
        with bar.part("reading"):
            map = task.feature_map(settings.view, store, team=settings.execution == "centralized")
            spec = task.spec(map, store)
            bind = constraints.bind if needed else constraints.bind_or_none
            hazard = bind(task.hazard, spec.feature_names, spec.n_agents)
        of = Fit(store, map, spec, settings, hazard, seed, cached, bar)
        if (kept := of.kept()) is not None:
            return kept
        return of.keep(_judged(of))


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


@in_float32
def load(path: str | Path) -> World:
    """The World in a file that `save` or `ringfence fit --out` wrote, or in a run folder."""

    def map_of(task: str, view: features.View, hazard: dict) -> features.FeatureMap | None:
        known = registry.simulated(task, constraints.from_dict(hazard))
        return None if known is None else known.feature_map(view)

    return load_world(path, map_of)
