"""How the numbers of a page were made: commands, changed settings, machines, data."""

from __future__ import annotations

import dataclasses
import inspect
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ringfence import algos
from ringfence.datasets import registry
from ringfence.datasets.task import Task
from ringfence.errors import UserError, unknown, whole_number
from ringfence.evaluation.play import play
from ringfence.evaluation.protocol import of_last_step
from ringfence.guards import GUARDS, GuardOptions, options_of
from ringfence.logs.provenance import regenerated
from ringfence.proposals.options import PLANNERS, PlanOptions
from ringfence.report.pooling import Result
from ringfence.report.table import Row, Section
from ringfence.training.runs import Run
from ringfence.training.worlds import GUARD, WORLD
from ringfence.utils import schemas, stored
from ringfence.utils.escape import shell

LONGEST = 400  # letters of a fact; the file itself lies in the run folder
IN_A_SIMULATOR = ("num_envs", "early_ends")  # options of `ringfence play` that results name


# --- commands ---


def commands(section: Section[Row], out: Path) -> list[str]:
    """Shell lines that make this section's numbers again. What they are made of was written by whoever wrote the run
    folders, so every word is quoted, and choices that this version does not know are refused (`check_choices`)."""
    make, data = _making(section)
    roots = dict.fromkeys(str(run.path.parent.parent) for run in section.runs)
    report = _line(["report", *roots, "--out", str(out)])
    return [*make, *_training(section, data), *_playing(section), report]


def _line(words: Iterable[Any]) -> str:
    """A command of `ringfence` with every word quoted."""
    return " ".join(["ringfence", *(shell(word) for word in words)])


def _making(section: Section[Row]) -> tuple[list[str], str]:
    """(lines that make the data, what training calls it)."""
    card = section.card
    if not regenerated(card):
        return [], "DATA.h5"
    task = section.task
    seed = _whole(card, "seed") or 0
    size = _whole(card, "size" if card.get("size") is not None else "transitions")
    full = registry.TASKS[task].transitions if task in registry.TASKS else None
    if seed == 0 and size in (None, full):
        unknown_size = "" if size else "  # its size was not recorded"
        return [_line(["data", "make", task]) + unknown_size], task
    data = f"{task}.h5"
    wanted = ["--size", size] if size else []
    return [_line(["data", "make", task, *wanted, "--seed", seed, "--out", data])], data


def _whole(card: Mapping[str, Any], name: str) -> int | None:
    """A count on a card, None where it has none."""
    return None if card.get(name) is None else whole_number(f"The data card's {name}", card[name], 0, 2**63)


def _training(section: Section[Row], data: str) -> list[str]:
    """A line for every stretch of seeds of one algorithm, preset, settings and root folder."""
    jobs: dict[tuple[str, str, str, str], list[int]] = {}
    for run in section.runs:
        config = run.config
        changed = json.dumps(_changes(config, preset=True), sort_keys=True)
        root = str(run.path.parent.parent.parent)
        jobs.setdefault((config["algorithm"], config["preset"], changed, root), []).append(config["seed"])
    lines = []
    for (algorithm, preset, changed, root), seeds in jobs.items():
        words: list[Any] = ["train", algorithm, data]
        if preset != _usual_preset(algorithm, section.task):
            words += ["--preset", preset]
        for first, count in _stretches(sorted(seeds)):
            tail = ["--seeds", count]
            if first:
                tail += ["--first-seed", first]
            if root != "runs":
                tail += ["--out", root]
            lines.append(_line([*words, *tail, *_set(json.loads(changed))]))
    return lines


def _usual_preset(algorithm: str, task: str) -> str:
    """The preset that training takes by default; no name where that is not known."""
    known = algos.ALGORITHMS.get(algorithm)
    if known is None:
        return ""
    return known.preset_for(registry.TASKS[task].presets if task in registry.TASKS else ())


def _stretches(seeds: list[int]) -> list[tuple[int, int]]:
    """[0, 1, 2, 5] -> [(0, 3), (5, 1)]"""
    found: list[list[int]] = []
    for seed in seeds:
        following = sum(found[-1]) if found else None
        if found and seed == following:
            found[-1][1] += 1
        elif following is None or seed >= following:
            found.append([seed, 1])
    return [(first, count) for first, count in found]


def _playing(section: Section[Row]) -> list[str]:
    """A line for all runs that were played the same way."""
    evaluations: dict[tuple[str | None, tuple[str, ...]], list[str]] = {}
    for row in section.rows:
        for run, result in row.members:
            check_choices(f"'{run.path}'", result)
            how = tuple(map(str, _how(result, run)))
            evaluations.setdefault((result.get("simulator"), how), []).append(str(run.path))
    lines = []
    for (simulator, how), paths in evaluations.items():
        command, env = ("play", ["--env", simulator]) if simulator else ("eval", [])
        lines.append(_line([command, *dict.fromkeys(paths), *env, *how]))
    return lines


def _how(result: Result, run: Run) -> list[Any]:
    """The options of `ringfence eval`, or `ringfence play`, that gave a result."""
    words: list[Any] = ["--episodes", result["episodes"]]
    for name in IN_A_SIMULATOR:
        usual = inspect.signature(play).parameters[name].default
        if result.get(name, usual) != usual:
            words += [f"--{name.replace('_', '-')}", result[name]]
    if result["split"] == "validation":
        words += ["--split", "validation"]
    if not of_last_step(result, run.config["config"]):
        words += ["--checkpoint", result["step"]]
    planner = result.get("planner", "default")
    if planner != "default":
        words += ["--planner", planner]
    task = registry.TASKS.get(run.config["task"])
    team = run.config.get("team") if task is None or task.env is None else task.env.n_agents
    if result.get("agents") not in (None, team):
        words += ["--agents", result["agents"]]
    settings = _given(result.get("options") or {}, _planner_options(planner))
    if result.get("guard_options"):
        words += ["--guard", result["guard"], "--barrier", result["barrier"]]
        if result["execution"] != "centralized":
            words += ["--execution", result["execution"]]
        kept = any((run.path / name).exists() for name in (GUARD, WORLD))
        if result["barrier"] == "learned" and task is None and not kept:
            words += ["--world", "DATA.world"]  # of data that this package does not make it has to be given
        settings |= _given(result["guard_options"], _guard_options(result, task))
    return [*words, *_set(settings)]


def check_choices(name: str, result: Result) -> None:
    """Refuse a result that says of how it was played what this version does not know: nobody could play it again."""
    planners = [stored.PLANNERS.get(planner, planner) for planner in PLANNERS]
    choices = {
        "planner": [*planners, *stored.PLANNERS_BEFORE_GUARDS],
        "guard": GUARDS,
        "barrier": ["none", "learned", "analytic", "both"],
        "execution": ["centralized", "decentralized"],
    }
    for kind, known in choices.items():
        if result.get(kind) is not None and result[kind] not in known:
            raise UserError(f"{name}: {unknown(kind, result[kind], known)}")
    options = {
        "options": [*stored.planner_options(dataclasses.asdict(PlanOptions())), *stored.OPTIONS_BEFORE_GUARDS],
        "guard_options": [*stored.guard_options(dataclasses.asdict(GuardOptions()))],
    }
    for kind, known in options.items():
        for option in result.get(kind) or {}:
            if option not in known:
                raise UserError(f"{name}: {unknown(f'entry of {kind}', option, known)}")


def _planner_options(planner: str) -> dict[str, Any]:
    """Those of a named planner."""
    return dataclasses.asdict(PlanOptions()) | PLANNERS.get(planner, {})


def _guard_options(result: Result, task: Task | None) -> dict[str, Any]:
    """Those of a result's named guard, under today's names."""
    options = options_of(result["guard"], result["barrier"], {} if task is None else task.guard)
    return stored.guard_options(dataclasses.asdict(GuardOptions()) | options)


def _given(options: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    """Options that are not as usual."""
    return {name: value for name, value in options.items() if value != usual.get(name)}


def _set(settings: Mapping[str, Any]) -> list[str]:
    """--set and its words; nothing where nothing is set."""
    return ["--set", *(f"{name}={value}" for name, value in settings.items())] if settings else []


# --- settings and machines ---


def differences(runs: Iterable[Run]) -> list[dict[str, Any]]:
    """Per job the config fields that differ from the algorithm's defaults: {name, changed, seeds}."""
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    for run in runs:
        config = run.config
        algorithm = config["algorithm"]
        preset = config["preset"]
        changed = _changes(config, preset=False)
        job = (algorithm, preset, json.dumps(changed, sort_keys=True))
        entry = found.setdefault(job, {"name": f"{algorithm} {preset}", "changed": changed, "seeds": []})
        entry["seeds"].append(config["seed"])
    return list(found.values())


def _changes(config: Mapping[str, Any], preset: bool) -> dict[str, Any]:
    """Config fields that differ from the defaults, or from the defaults and the preset together."""
    try:
        algorithm = algos.get(config["algorithm"])
    except UserError:
        return dict(config["config"])
    usual = {f.name: f.default for f in dataclasses.fields(algorithm.Config)}
    if preset:
        usual |= algorithm.presets.get(config["preset"], {})
    usual = json.loads(json.dumps(usual))  # as config.json has it: lists for tuples
    return {k: v for k, v in config["config"].items() if k not in usual or usual[k] != v}


def environments(runs: Iterable[Run]) -> list[dict[str, Any]]:
    """Distinct env.json of the runs as {facts, runs}, with the names of the runs."""
    found: dict[str, dict[str, Any]] = {}
    for run in runs:
        file = run.path / "env.json"
        if not file.exists():
            continue
        environment = schemas.read(file, schemas.Environment, "has a damaged env.json; delete that file")
        if environment:
            key = json.dumps(environment, sort_keys=True)
            entry = found.setdefault(key, {"facts": facts(environment), "runs": []})
            entry["runs"].append(f"{run.path.parent.name}/{run.path.name}")
    return list(found.values())


def facts(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """A JSON object as rows of a list; what is empty is left out, and long entries are cut."""
    rows = []
    for name, value in values.items():
        if value in (None, [], {}, ""):
            continue
        if isinstance(value, dict):
            text = ", ".join(f"{k} {_plain(v)}" for k, v in value.items())
        elif isinstance(value, list):
            text = ", ".join(_plain(v) for v in value)
        else:
            text = _plain(value)
        rows.append((name.replace("_", " "), text if len(text) <= LONGEST else text[:LONGEST] + " …"))
    return rows


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    return value if isinstance(value, str) else json.dumps(value)
