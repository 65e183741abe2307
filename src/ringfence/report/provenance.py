"""How the numbers of a page were made: commands, changed settings, machines, data."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ringfence import algos
from ringfence.datasets import registry
from ringfence.errors import UserError, whole_number
from ringfence.logs.schema import regenerated
from ringfence.report.table import Section, settings_of
from ringfence.training.runs import Run
from ringfence.utils import schemas
from ringfence.utils.text import shell

THEIRS = "THEIR.py:SIMULATOR"
LONGEST = 400  # letters of a fact; the file itself lies in the run folder
PLAYED = ("eval", "play")  # commands that make results


# --- commands ---


def commands(section: Section, out: Path) -> list[str]:
    """Shell lines that make this section's numbers again. What they are made of was written by whoever wrote the run
    folders, so every word is quoted, and no result is made by another command than those that make some."""
    make, data = _making(section)
    roots = dict.fromkeys(str(run.path.parent.parent) for run in section.runs)
    report = _line(["report", *roots, "--out", str(out)])
    return [*make, *_training(section, data), *_playing(section), report]


def _line(words: Iterable[Any]) -> str:
    """A command of `ringfence` with every word quoted."""
    return " ".join(["ringfence", *(shell(word) for word in words)])


def _making(section: Section) -> tuple[list[str], str]:
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


def _training(section: Section, data: str) -> list[str]:
    """A line for the seeds of one algorithm, preset, settings and root folder: one that follow each other, else of
    each."""
    presets = registry.TASKS[section.task].presets if section.task in registry.TASKS else ()
    jobs: dict[tuple[tuple[str, ...], tuple[str, ...]], list[int]] = {}
    for run in section.runs:
        config = run.config
        words = ["train", config["algorithm"], data]
        known = algos.ALGORITHMS.get(config["algorithm"])
        if known is None or config["preset"] != known.preset_for(presets):
            words += ["--preset", config["preset"]]
        root = str(run.path.parent.parent.parent)
        last = [] if root == "runs" else ["--out", root]
        changed = sorted(_changes(config, preset=True).items())
        last += ["--set", *(f"{name}={value}" for name, value in changed)] if changed else []
        jobs.setdefault((tuple(words), tuple(last)), []).append(config["seed"])
    lines = []
    for (words, last), some in jobs.items():
        seeds = sorted(some)
        together = seeds == [*range(seeds[0], seeds[0] + len(seeds))]
        for first, count in [(seeds[0], len(seeds))] if together else [(seed, 1) for seed in seeds]:
            lines.append(_line([*words, "--seeds", count, *(["--first-seed", first] if first else []), *last]))
    return lines


def _playing(section: Section) -> list[str]:
    """A line for all runs that were played the same way, in the words that made their results."""
    played: dict[tuple[str, ...], list[str]] = {}
    untold = []
    for row in (row for line in section.lines for row in line.rows):
        words = row.result.get("command")
        if not words:
            untold.append(row)
            continue
        if words[0] not in PLAYED:
            raise UserError(f"{row.where} was made by '{words[0]}', which plays nothing; evaluate it again.")
        later = [] if row.last or "--checkpoint" in words else ["--checkpoint", str(row.result["step"])]
        played.setdefault((*words, *later), []).append(str(row.file.parent))
    lines = []
    for words, runs in played.items():
        known, theirs = _without_code(words)
        lines.append(_line([known[0], *dict.fromkeys(runs), *known[1:]]) + theirs)
    return lines + [f"# of {shell(row.where)} no command was recorded" for row in untold]


def _without_code(words: tuple[str, ...]) -> tuple[list[str], str]:
    """The words with `THEIRS` for a simulator, and a comment that names it: nobody is to run a stranger's code by
    copying a line."""
    known, named = [], []
    for before, word in zip(("", *words), words):
        option, equals, value = word.partition("=")
        if before == "--env" or (option == "--env" and equals):
            named.append(shell(value if option == "--env" else word))
            word = f"--env={THEIRS}" if option == "--env" else THEIRS
        known.append(word)
    return known, f"  # {THEIRS} is {', '.join(named)} of whoever played: read that code first" if named else ""


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
    algorithm = algos.ALGORITHMS.get(config["algorithm"])
    usual = settings_of({**config, "config": {}})  # of the algorithm alone
    if preset and algorithm is not None:
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
