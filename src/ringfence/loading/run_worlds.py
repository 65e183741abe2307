"""The Worlds of runs: kept beside them, given, or made again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.logs.provenance import regenerated
from ringfence.problem.origins import Origins
from ringfence.training.runs import Run
from ringfence.training.worlds import GUARD, WORLD, fit, load, usual
from ringfence.world import Settings, World


def of_run(run: Run, quiet: bool = True) -> World:
    """The World that a run's training read, in its folder; of runs that read none, that of their data (`for_guard`)."""
    kept = run.path / WORLD
    return _kept(run, kept) if kept.exists() else of_data(run, None, quiet)


def _kept(run: Run, file: Path) -> World:
    """A World in the run's folder, which must be of the run's data."""
    found = load(file)
    if not _is_of_same_data(run, found) or found.spec.action_dim != run.config["spec"]["action_dim"]:
        raise UserError(
            f"'{file}' is a World of '{found.card.data.task}', the run is of other data ('{run.config['task']}'); put "
            "the run's own World there, or delete that file."
        )
    _of_same_origins(run, found)
    return found


def for_guard(
    run: Run,
    execution: str | None = None,
    world: World | str | Path | None = None,
    read: World | None = None,
    quiet: bool = True,
) -> World:
    """The World that guards a run: the one that is given; else that of its task and seed, whatever the run's own
    training read, so that all proposals of a task are judged alike. Of data that this package does not regenerate it
    is the one in the run's folder, or has to be given. `read`: what training read, if it is loaded already."""
    homogeneous = run.config["spec"].get("homogeneous", False)
    execution = execution or ("decentralized" if homogeneous else "centralized")
    if world is not None:
        world = world if isinstance(world, World) else load(world)
        _of_same(run, world, execution)
        return world
    if (run.path / GUARD).exists() and (kept := _kept(run, run.path / GUARD)).alone == (execution == "decentralized"):
        return kept
    if read is not None or (run.path / WORLD).exists():
        found = read or of_run(run, quiet)
        # Training may ask for another view, or for values that look less far.
        wanted = Settings(**usual(registry.TASKS[run.config["task"]], execution)) if _made_here(run) else None
        settings = found.card.settings
        same = wanted is None or (wanted.view, wanted.discount) == (settings.view, settings.discount)
        if same and found.alone == (execution == "decentralized"):
            return found
    return of_data(run, execution, quiet)


def _made_here(run: Run) -> bool:
    """Whether this package regenerates the data of a run."""
    return regenerated(run.config["data"]) and run.config["task"] in registry.TASKS


def of_data(run: Run, execution: str | None, quiet: bool = True) -> World:
    """The World of a run's data and seed, fitted by this version, where these data are regenerated."""
    config = run.config
    if not _made_here(run):
        flag = " --execution decentralized" if execution == "decentralized" else ""
        raise UserError(
            f"A guard of '{run.path}' needs the World of its data, which is not there; make one with `ringfence fit "
            f"STORE --out FILE{flag}` and name it with world=FILE (--world FILE)."
        )
    from ringfence.datasets.make import make

    card = config["data"]
    size = card.get("size", card.get("transitions"))
    store, _ = make(registry.get(config["task"]), size, card.get("seed", 0), must_keep=False)
    return fit(store, seed=config["seed"], execution=execution, quiet=quiet)


def _is_of_same_data(run: Run, world: World) -> bool:
    """Whether a World is of the task of a run, and of the same arrays, where the run tells which these are."""
    there = world.card.data
    return run.config["task"] == there.task and run.config["data"].get("content") in (None, there.content)


def _of_same_origins(run: Run, world: World) -> None:
    """Refuse a World of logs that were moved otherwise: it would take other numbers for the same place."""
    origins = Origins.of(run.config["data"])
    if world.spec.homogeneous:  # agents who see for themselves read no state, wherever it was moved
        origins = replace(origins, state=None)
    if world.origins != origins:
        raise UserError(
            f"The logs of the World were moved by other origins than those of the run '{run.path}'; fit one to the "
            "data that the run was trained on."
        )


def _of_same(run: Run, world: World, execution: str) -> None:
    """Refuse a World of other data, or of another execution."""
    if not _is_of_same_data(run, world):
        raise UserError(
            f"The World is of '{world.card.data.task}', the run '{run.path}' of other data ('{run.config['task']}'); "
            "fit one to the data that the run was trained on."
        )
    _of_same_origins(run, world)
    if world.alone != (execution == "decentralized"):
        raise UserError(
            f"The World was fitted with execution={world.card.settings.execution}, the guard is to have "
            f"execution={execution}; fit one with `ringfence fit STORE --execution {execution}`."
        )
