"""The table: one row per algorithm and variant, all seeds pooled; what must not be mixed is refused here."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from ringfence.algos import ALGORITHMS
from ringfence.errors import UserError
from ringfence.evaluation import reference
from ringfence.evaluation.protocol import of_last_step
from ringfence.logs.provenance import other_data
from ringfence.report.pooling import Line, Result, mean_of, pool
from ringfence.training.runs import Run, runs_below

SPLITS = ("test", "validation")
NAMES = {
    "bc": "BC",
    "bc-safe": "BC on safe episodes",
    "bc-best": "10 % BC",
    "bc-return": "return-conditioned BC",
    "ma-td3bc": "MA-TD3+BC",
    "ma-td3bc-lag": "MA-TD3+BC, Lagrange",
    "fisor": "FISOR",
    "ma-cql": "MA-CQL",
    "omar": "OMAR",
    "flow": "joint flow",
    "madiff": "MADIFF (no barrier)",
    "icbf": "ICBF-Diffuser",
    "mpc": "MPC from a zero proposal",
}
ORDER = list(NAMES)  # rows of the table; algorithms that are not named here come last
NEEDED = ("episodes", "return_mean", "cost_mean", "cost_safe_start", "violation_rate", "constants", "protocol", "task")
NEEDED += ("return_interval", "cost_interval", "cost_safe_start_interval", "cost_cvar10", "unsafe_starts")


@dataclass(kw_only=True)
class Row(Line):
    """A row of a report: an algorithm and variant over its seeds, or a reference policy."""

    algorithm: str
    preset: str
    split: str
    members: list[tuple[Run, Result]] = field(default_factory=list)


LineT = TypeVar("LineT", bound=Line)


@dataclass
class Section(Generic[LineT]):
    """One task: everything that may stand in one table, and the runs it came from."""

    task: str
    hazard: dict[str, Any]
    card: dict[str, Any]
    constants: dict[str, float]
    protocol: int
    runs: list[Run]
    tables: dict[str, list[LineT]]  # by split
    references: list[LineT]

    @property
    def rows(self) -> list[LineT]:
        return [r for split in SPLITS for r in self.tables.get(split, [])]


Played = tuple[Run, str, Result]  # a run, and one of its evaluations by name


def sections(runs: Iterable[Run | str | Path] | Run | str | Path) -> list[Section[Row]]:
    """One section per task, in the order in which the runs name them."""
    tasks: dict[str, list[Run]] = {}
    for run in _distinct([runs] if isinstance(runs, str | Path | Run) else runs):
        tasks.setdefault(run.config["task"], []).append(run)
    if not tasks:
        raise UserError("No run was given, so there is nothing to report; pass run folders made by `ringfence train`.")
    return [_section(task, members) for task, members in tasks.items()]


def _distinct(runs: Iterable[Run | str | Path]) -> list[Run]:
    """Folders become runs; the same folder named twice counts once."""
    found: dict[Path, Run] = {}
    for each in runs:
        below = [] if isinstance(each, Run) else runs_below(Path(each))
        for run in below or [Run.of(each)]:
            found.setdefault(run.path.resolve(), run)
    return list(found.values())


def _section(task: str, runs: list[Run]) -> Section[Row]:
    first = runs[0]
    played = [each for run in runs for each in _evaluations(run)]
    for run, name, result in played:
        _check_result(run, name, result, task)
    leader = played[0][2]
    for run, name, result in played:
        _agree(f"'{run.path}' variant '{name}'", result, leader, first)
    card = first.config.get("data") or {}
    _check_data(runs, card)
    section = Section(
        task=task,
        hazard=dict(first.config.get("hazard") or {}),
        card=dict(card),
        constants=leader["constants"],
        protocol=leader["protocol"],
        runs=runs,
        tables=_tables(runs, played),
        references=_references(runs, task, leader),
    )
    _paint(section)
    return section


def _evaluations(run: Run) -> list[Played]:
    """A run's results under names that tell the checkpoint where it is not the last."""
    results = run.results
    if not results:
        raise UserError(
            f"'{run.path}' has not been evaluated; run `ringfence eval {run.path}` first, or for a simulator "
            f"of your own `ringfence play {run.path} --env FILE.py:NAME`."
        )
    return [(run, _dated(name, r, run), {"variant": name, **r}) for name, r in results.items()]


def _dated(variant: str, result: Result, run: Run) -> str:
    """A variant's name with the step of the checkpoint that was played, where training went on since."""
    known = "@step" in variant or of_last_step(result, run.config["config"])
    return variant if known else f"{variant}@step{result['step']}"


def _check_result(run: Run, name: str, result: Result, task: str) -> None:
    _check(f"'{run.path}' variant '{name}'", result, task)
    if result.get("split") not in SPLITS:
        raise UserError(f"'{run.path}' variant '{name}' has split '{result.get('split')}', not test or validation.")
    if "per_episode" not in result:
        raise UserError(f"'{run.path}' variant '{name}' lacks its episodes; run `ringfence eval {run.path}` again.")


def _check(name: str, result: Result, task: str) -> None:
    missing = [k for k in NEEDED if k not in result]
    if missing:
        raise UserError(f"{name} lacks '{missing[0]}', so it was made by another version; evaluate it again.")
    if result["task"] != task:
        raise UserError(f"{name} holds a result of task '{result['task']}', not of '{task}'; evaluate the run again.")


def _agree(name: str, result: Result, leader: Result, first: Run) -> None:
    if result["protocol"] != leader["protocol"]:
        raise UserError(
            f"{name} was evaluated under protocol {result['protocol']}, '{first.path}' under protocol "
            f"{leader['protocol']}; such numbers cannot stand in one table: evaluate both with one version."
        )
    if result["constants"] != leader["constants"]:
        raise UserError(
            f"{name} was normalised with other constants than '{first.path}'; evaluate both with one version."
        )


def _check_data(runs: list[Run], card: dict[str, Any]) -> None:
    for run in runs:
        if apart := other_data(run.config.get("data") or {}, card):
            name, here, there = apart[0]
            raise UserError(
                f"'{run.path}' was trained on other data (its {name} is {here}) than '{runs[0].path}' ({there}); "
                "make one report for each data set."
            )


def _tables(runs: list[Run], played: list[Played]) -> dict[str, list[Row]]:
    """By split, the rows that any run has: evaluations of one algorithm, variant and config are one."""
    tables: dict[str, list[Row]] = {}
    fields = _differing(runs)
    for split in SPLITS:
        groups: dict[tuple, list[tuple[Run, Result]]] = {}
        for run, name, result in played:
            if result["split"] == split:
                config = json.dumps(_made_with(run.config), sort_keys=True)
                groups.setdefault((run.config["algorithm"], name, config), []).append((run, result))
        rows = [_row(name, members, fields) for (_, name, _), members in groups.items()]
        if rows:
            tables[split] = sorted(rows, key=lambda r: place(r.algorithm, r.preset, r.variant))
    return tables


def _references(runs: list[Run], task: str, leader: Result) -> list[Row]:
    rows: dict[str, Row] = {}
    for file in dict.fromkeys(run.path.resolve().parent.parent / reference.FILE for run in runs):
        if not file.exists():
            continue
        for name, result in reference.read(file).items():
            _check(f"'{file}' row '{name}'", result, task)
            _agree(f"'{file}' row '{name}'", result, leader, runs[0])
            rows.setdefault(name, _reference(name, result))
    if reference.LOGS not in rows and (logs := reference.of_run(runs[0], leader["constants"])) is not None:
        rows[reference.LOGS] = _reference(reference.LOGS, logs)
    return list(rows.values())


def _reference(name: str, result: Result) -> Row:
    return Row(
        name=name,
        variant="",
        algorithm="",
        preset="",
        reference=True,
        split=result.get("split", "test"),
        seeds=(),
        **vars(pool([result])),
    )


def config_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings in a run's config.json; a field that is younger than the run had its default then."""
    known = ALGORITHMS.get(config["algorithm"])
    if known is None:  # one of somebody else's
        return dict(config["config"])
    return {f.name: f.default for f in dataclasses.fields(known.Config)} | config["config"]


def _made_with(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings, and the algorithm's revision: with another one the same settings train another policy."""
    return config_of(config) | {"revision": config.get("revision", 1)}


def differing(configs: list[dict[str, Any]]) -> list[str]:
    """Fields in which configs differ: their runs get rows of their own."""
    fields = dict.fromkeys(k for c in configs for k in c)
    return [k for k in fields if len({json.dumps(c.get(k)) for c in configs}) > 1]


def _differing(runs: list[Run]) -> dict[tuple[str, str], list[str]]:
    """Differing fields by algorithm and preset."""
    configs: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for config in (run.config for run in runs):
        configs.setdefault((config["algorithm"], config["preset"]), []).append(_made_with(config))
    return {key: differing(several) for key, several in configs.items()}


def _row(variant: str, members: list[tuple[Run, Result]], fields: dict[tuple[str, str], list[str]]) -> Row:
    config = members[0][0].config
    algorithm: str = config["algorithm"]
    preset: str = config["preset"]
    shown = plain_variant(variant)
    if apart := fields.get((algorithm, preset)):
        settings = _made_with(config)
        shown += " [" + ", ".join(f"{k}={settings.get(k)}" for k in apart) + "]"
    results = [result for _, result in members]
    return Row(
        name=NAMES.get(algorithm, algorithm),
        variant=shown.strip(),
        algorithm=algorithm,
        preset=preset,
        split=results[0]["split"],
        seeds=_seeds(members),
        parameters=results[0].get("parameters"),
        train_seconds=mean_of(results, "train_seconds"),
        plan_ms=mean_of(results, "plan_ms_p50"),
        members=members,
        **vars(pool(results, f"The runs of '{shown}'")),
    )


def _seeds(members: list[tuple[Run, Result]]) -> tuple[int, ...]:
    """Those of a row's runs, in order; none may be there twice."""
    first: dict[int, Run] = {}
    for run, _ in members:
        seed = run.config["seed"]
        if seed in first:
            raise UserError(
                f"'{run.path}' and '{first[seed].path}' are the same job with the same seed {seed}; give only one of "
                "them."
            )
        first[seed] = run
    return tuple(sorted(first))


def plain_variant(variant: str) -> str:
    """A variant's name without what a table says elsewhere: `default+plans4@validation` -> `plans4`."""
    return re.sub(r"^default\b\+?|@validation\b", "", variant)


def place(algorithm: str, preset: str, variant: str) -> tuple:
    """Order of rows: that of NAMES, then by variant, numbers by size."""
    rank = ORDER.index(algorithm) if algorithm in ORDER else len(ORDER)
    parts = [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", variant)]
    return rank, algorithm, not preset.startswith("algorithm1"), [(isinstance(p, str), p) for p in parts]


def _paint(section: Section[Row]) -> None:
    """A colour per algorithm and preset, a marker per variant of it; the same ones in every figure."""
    colours: dict[tuple, int] = {}
    markers: dict[tuple, dict[str, int]] = {}
    for row in section.rows:
        family = (row.algorithm, row.preset)
        colour = colours.setdefault(family, len(colours))
        known = markers.setdefault(family, {})
        row.style = (colour, known.setdefault(row.variant, len(known)))
