"""The table: one row per algorithm and variant, all seeds pooled; what must not be mixed is refused here."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from ringfence.algos import ALGORITHMS
from ringfence.errors import UserError
from ringfence.evaluation import reference
from ringfence.evaluation.protocol import of_last_step
from ringfence.logs.provenance import other_data
from ringfence.report.pooling import Numbers, mean_of, pool
from ringfence.training.runs import Run

SPLITS = ("test", "validation")
NAMES = {
    "bc": "BC",
    "bc-safe": "BC on safe episodes",
    "bc-best": "BC on the best tenth",
    "bc-return": "BC told the return",
    "ma-td3bc": "MA-TD3+BC",
    "ma-td3bc-lag": "MA-TD3+BC, Lagrange",
    "fisor": "FISOR",
    "ma-cql": "MA-CQL",
    "omar": "OMAR",
    "madiff": "MADIFF (no barrier)",
    "icbf": "ICBF-Diffuser",
    "mpc": "No prior",
}
ORDER = list(NAMES)  # rows of the table; algorithms that are not named here come last
NEEDED = ("episodes", "return_mean", "cost_mean", "cost_safe_start", "violation_rate", "constants", "protocol", "task")
NEEDED += ("return_interval", "cost_interval", "cost_safe_start_interval", "cost_cvar10", "unsafe_starts")


@dataclass(kw_only=True)
class Row(Numbers):
    """An algorithm and variant over its seeds, or a reference policy."""

    name: str  # in plain words
    variant: str  # as in results.json; empty for references
    algorithm: str
    preset: str
    reference: bool
    split: str
    seeds: tuple[int, ...]
    parameters: int | None = None
    train_seconds: float | None = None
    plan_ms: float | None = None
    members: list[tuple[Run, dict]] = field(default_factory=list)
    style: tuple[int, int] = (0, 0)  # colour, marker

    @property
    def label(self) -> str:
        """Name and variant in one line, e.g. `ICBF-Diffuser split+plans4`."""
        return f"{self.name} {self.variant}".strip()


@dataclass
class Section:
    """One task: everything that may stand in one table, and the runs it came from."""

    task: str
    hazard: dict
    card: dict
    constants: dict[str, float]
    protocol: int
    runs: list[Run]
    tables: dict[str, list[Row]]  # by split
    references: list[Row]

    @property
    def rows(self) -> list[Row]:
        return [r for split in SPLITS for r in self.tables.get(split, [])]


def sections(runs: Iterable[Run | str | Path] | Run | str | Path) -> list[Section]:
    """One section per task, in the order in which the runs name them."""
    tasks: dict[str, list[Run]] = {}
    for run in _distinct([runs] if isinstance(runs, str | Path | Run) else runs):
        tasks.setdefault(run.config["task"], []).append(run)
    if not tasks:
        raise UserError("No run was given, so there is nothing to report; pass run folders made by `ringfence train`.")
    return [_section(task, members) for task, members in tasks.items()]


def _distinct(runs: Iterable[Run]) -> list[Run]:
    """Folders become runs; the same folder named twice counts once."""
    found = {}
    for run in runs:
        run = Run.of(run)
        found.setdefault(run.path.resolve(), run)
    return list(found.values())


def _section(task: str, runs: list[Run]) -> Section:
    first, results = runs[0], {}
    for run in runs:
        results[run.path] = run.results
        if not results[run.path]:
            raise UserError(
                f"'{run.path}' has not been evaluated; run `ringfence eval {run.path}` first, or for a simulator "
                f"of your own `ringfence play {run.path} --env FILE.py:NAME`."
            )
    entries = [
        (run, _dated(name, r, run), {"variant": name, **r}) for run in runs for name, r in results[run.path].items()
    ]
    for run, name, result in entries:
        _check(f"'{run.path}' variant '{name}'", result, task)
        if result.get("split") not in SPLITS:
            raise UserError(f"'{run.path}' variant '{name}' has split '{result.get('split')}', not test or validation.")
        if "per_episode" not in result:
            raise UserError(f"'{run.path}' variant '{name}' lacks its episodes; run `ringfence eval {run.path}` again.")
    leader = entries[0][2]
    for run, name, result in entries:
        _agree(f"'{run.path}' variant '{name}'", result, leader, f"'{first.path}'")
    card = first.config.get("data") or {}
    for run in runs:
        if apart := other_data(run.config.get("data") or {}, card):
            name, here, there = apart[0]
            raise UserError(
                f"'{run.path}' was trained on other data (its {name} is {here}) than '{first.path}' ({there}); "
                "make one report for each data set."
            )
    references = _references(runs, task, leader, first)
    tables = {}
    fields = _differing(runs)
    for split in SPLITS:
        groups: dict[tuple, list[tuple[Run, dict]]] = {}
        for run, name, result in entries:
            if result["split"] == split:
                config = json.dumps(_made_with(run.config), sort_keys=True)
                groups.setdefault((run.config["algorithm"], name, config), []).append((run, result))
        rows = [_row(name, members, fields) for (_, name, _), members in groups.items()]
        if rows:
            tables[split] = sorted(rows, key=lambda r: place(r.algorithm, r.preset, r.variant))
    section = Section(
        task, first.config.get("hazard") or {}, card, leader["constants"], leader["protocol"], runs, tables, references
    )
    _paint(section)
    return section


def _dated(variant: str, result: dict, run: Run) -> str:
    """A variant's name with the step of the checkpoint that was played, where training went on since."""
    known = "@step" in variant or of_last_step(result, run.config["config"])
    return variant if known else f"{variant}@step{result['step']}"


def _check(who: str, result: dict, task: str) -> None:
    missing = [k for k in NEEDED if k not in result]
    if missing:
        raise UserError(f"{who} lacks '{missing[0]}', so it was made by another version; evaluate it again.")
    if result["task"] != task:
        raise UserError(f"{who} holds a result of task '{result['task']}', not of '{task}'; evaluate the run again.")


def _agree(who: str, result: dict, leader: dict, of: str) -> None:
    if result["protocol"] != leader["protocol"]:
        raise UserError(
            f"{who} was evaluated under protocol {result['protocol']}, {of} under protocol {leader['protocol']}; "
            "such numbers cannot stand in one table: evaluate both with one version."
        )
    if result["constants"] != leader["constants"]:
        raise UserError(f"{who} was normalised with other constants than {of}; evaluate both with one version.")


def _references(runs: list[Run], task: str, leader: dict, first: Run) -> list[Row]:
    rows, read = {}, set()
    for run in runs:
        file = run.path.resolve().parent.parent / "reference.json"
        if file in read or not file.exists():
            continue
        read.add(file)
        for name, result in reference.read(file).items():
            _check(f"'{file}' row '{name}'", result, task)
            _agree(f"'{file}' row '{name}'", result, leader, f"'{first.path}'")
            rows.setdefault(name, pool([result]) | {"split": result.get("split", "test")})
    return [
        Row(name=name, variant="", algorithm="", preset="", reference=True, seeds=(), **numbers)
        for name, numbers in rows.items()
    ]


def config_of(told: dict) -> dict:
    """The config in a run's config.json; a field that is younger than the run had its default then."""
    if told["algorithm"] not in ALGORITHMS:  # one of somebody else's
        return dict(told["config"])
    return {f.name: f.default for f in dataclasses.fields(ALGORITHMS[told["algorithm"]].Config)} | told["config"]


def _made_with(told: dict) -> dict:
    """The config, and the algorithm's revision: with another one the same settings train another policy."""
    return config_of(told) | {"revision": told.get("revision", 1)}


def differing(configs: list[dict]) -> list[str]:
    """Fields in which configs differ: their runs get rows of their own."""
    fields = dict.fromkeys(k for c in configs for k in c)
    return [k for k in fields if len({json.dumps(c.get(k)) for c in configs}) > 1]


def _differing(runs: list[Run]) -> dict[tuple[str, str], list[str]]:
    """Differing fields by algorithm and preset."""
    configs: dict[tuple[str, str], list[dict]] = {}
    for told in (run.config for run in runs):
        configs.setdefault((told["algorithm"], told["preset"]), []).append(_made_with(told))
    return {key: differing(several) for key, several in configs.items()}


def _row(variant: str, members: list[tuple[Run, dict]], fields: dict) -> Row:
    told = members[0][0].config
    seeds = [run.config["seed"] for run, _ in members]
    for k, seed in enumerate(seeds):
        if seed in seeds[:k]:
            raise UserError(
                f"'{members[k][0].path}' and '{members[seeds.index(seed)][0].path}' are the same job with the same "
                f"seed {seed}; give only one of them."
            )
    shown = plain_variant(variant)
    if apart := fields.get((told["algorithm"], told["preset"])):
        config = _made_with(told)
        shown += " [" + ", ".join(f"{k}={config.get(k)}" for k in apart) + "]"
    results = [result for _, result in members]
    return Row(
        name=NAMES.get(told["algorithm"], told["algorithm"]),
        variant=shown.strip(),
        algorithm=told["algorithm"],
        preset=told["preset"],
        reference=False,
        split=results[0]["split"],
        seeds=tuple(sorted(seeds)),
        parameters=results[0].get("parameters"),
        train_seconds=mean_of(results, "train_seconds"),
        plan_ms=mean_of(results, "plan_ms_p50"),
        members=members,
        **pool(results, f"The runs of '{shown}'"),
    )


def plain_variant(variant: str) -> str:
    """A variant's name without what a table says elsewhere: `default+plans4@validation` -> `plans4`."""
    return re.sub(r"^default\b\+?|@validation\b", "", variant)


def place(algorithm: str, preset: str, variant: str) -> tuple:
    """Order of rows: that of NAMES, then by variant, numbers by size."""
    rank = ORDER.index(algorithm) if algorithm in ORDER else len(ORDER)
    parts = [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", variant)]
    return rank, algorithm, preset != "paper", [(isinstance(p, str), p) for p in parts]


def _paint(section: Section) -> None:
    """A colour per algorithm and preset, a marker per variant of it; the same ones in every figure."""
    colours: dict[tuple, int] = {}
    markers: dict[tuple, dict[str, int]] = {}
    for row in section.rows:
        family = row.algorithm, row.preset
        colour = colours.setdefault(family, len(colours))
        of = markers.setdefault(family, {})
        row.style = colour, of.setdefault(row.variant, len(of))
