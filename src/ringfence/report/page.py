"""Put tables, figures, animations and provenance on one page that needs nothing but itself."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from ringfence.datasets import registry
from ringfence.datasets.task import Task
from ringfence.errors import UserError
from ringfence.evaluation import recordings
from ringfence.logs.provenance import regenerated
from ringfence.problem import constraints
from ringfence.report import animation, figures, html, made
from ringfence.report.headline import headline, words_of
from ringfence.report.pooling import mean_of
from ringfence.report.table import NAMES, Row, Section, sections
from ringfence.training.runs import Run


def build_report(
    runs: Iterable[Run | str | Path] | Run | str | Path, out: str | Path, title: str | None = None
) -> Path:
    """Write one self-contained HTML page about evaluated runs and return its path.

    `runs` are run folders, or one of them; `out` is the page, or a folder that gets `report.html`. Runs of several
    tasks get a section each. `UserError` where a run has not been evaluated or numbers must not be compared.
    """
    found = sections(runs)
    out = html.page_file(out)
    context = {
        "title": title or "Ringfence report: " + ", ".join(s.task for s in found),
        "js": Markup(html.asset("player.js")),
        "sections": [_section(s, k, out) for k, s in enumerate(found)],
    }
    return html.write(out, html.render("template.html.j2", context))


@dataclass(frozen=True)
class SplitTable:
    """The rows of one split, and what stands below them."""

    split: str
    rows: list[Row]
    references: list[Row]  # of the test split alone
    constraints: list[ConstraintLine]
    guards: list[GuardLine]


@dataclass(frozen=True)
class GuardLine:
    """What the guard of a row says of itself."""

    row: Row
    verdict: str | None  # of its World; None of results of before
    infeasible: float  # share of the steps in which no action kept the margin
    ood: float | None  # share of the steps that the logs do not cover


@dataclass(frozen=True)
class ConstraintLine:
    """What a named constraint cost a row, mean of its runs; None where the runs do not say."""

    row: Row
    name: str
    cost_mean: float | None
    violation_rate: float | None
    limit: float | None
    limit_satisfied_rate: float | None


@dataclass(frozen=True)
class Family:
    """An algorithm and preset in the legend of the training curves."""

    name: str
    colour: int


def _section(section: Section[Row], k: int, out: Path) -> dict[str, Any]:
    """What the template shows of a task."""
    unit, _ = words_of(section.hazard)
    test = section.tables.get("test", [])
    recorded = animation.players(section)
    return {
        "id": f"task{k}",
        "task": section.task,
        "unit": unit,
        "headline": headline(section),
        "tables": [
            SplitTable(
                split, rows, section.references if split == "test" else [], constraint_table(rows), guard_table(rows)
            )
            for split, rows in section.tables.items()
        ],
        "constants": section.constants,
        "limits": {name: limit for row in section.rows for name, limit in row.limits.items()},
        "ceiling": section.card.get("return_ceiling"),
        "protocol": section.protocol,
        "several_seeds": any(len(r.seeds) > 1 for r in section.rows),
        "colours": figures.COLOURS,
        "scatter": Markup(figures.scatter(section, test, f"{unit} per episode", f"s{k}")) if test else None,
        "curves": figures.training_curves(section.rows, f"t{k}"),
        "families": _families(section.rows),
        "fields": _fields(section, k),
        "players": recorded,
        "films": animation.films(section),
        "film_shows": _film_shows(section),
        "simulated": _simulated(section) is not None,
        "players_json": Markup(json.dumps(recorded).replace("<", "\\u003c")),
        "commands": made.commands(section, out),
        "differences": made.differences(section.runs),
        "environments": made.environments(section.runs),
        "card": made.facts(section.card),
        "regenerated": regenerated(section.card),
    }


def _simulated(section: Section[Row]) -> Task | None:
    """The task, where a simulator of this package plays it."""
    return registry.simulated(section.task, constraints.from_dict(section.hazard)) if section.hazard else None


def _film_shows(section: Section[Row]) -> str:
    """What films of a task show, in words; empty where its simulator draws none."""
    task = _simulated(section)
    return "" if task is None else getattr(task.env, "film_shows", "")


def guard_table(rows: list[Row]) -> list[GuardLine]:
    """A line for each row that was played under a guard."""
    found = []
    for row in rows:
        results = [result for _, result in row.members]
        infeasible = mean_of(results, "infeasible_rate")
        if infeasible is None:
            continue
        verdicts = {result.get("verdict") for result in results}
        verdict = verdicts.pop() if len(verdicts) == 1 else None
        found.append(GuardLine(row, verdict, infeasible, mean_of(results, "ood_rate")))
    return found


def constraint_table(rows: list[Row]) -> list[ConstraintLine]:
    """A line for each named constraint of the rows whose simulator names them."""
    found = []
    for row in rows:
        costs = [result["constraints"] for _, result in row.members if "constraints" in result]
        if not costs or len(costs) < len(row.members):
            continue
        for name in costs[0]:
            runs = [by_name[name] for by_name in costs if name in by_name]
            line = ConstraintLine(
                row=row,
                name=name,
                cost_mean=mean_of(runs, "cost_mean"),
                violation_rate=mean_of(runs, "violation_rate"),
                limit=mean_of(runs, "limit"),
                limit_satisfied_rate=mean_of(runs, "limit_satisfied_rate"),
            )
            found.append(line)
    return found


def _families(rows: list[Row]) -> list[Family]:
    """Algorithms and presets with their colours."""
    found: dict[tuple[str, str], Family] = {}
    for row in rows:
        name = _family_name(NAMES.get(row.algorithm, row.algorithm), row.preset)
        found.setdefault((row.algorithm, row.preset), Family(name, row.style[0] % figures.COLOURS))
    return list(found.values())


def _family_name(name: str, preset: str) -> str:
    return name if preset == "default" else f"{name} {preset}"


def _fields(section: Section[Row], k: int) -> list[dict[str, Any]]:
    """Pictures of learned barriers, one per algorithm and preset; what cannot be loaded is said, not hidden."""
    found: list[dict[str, Any]] = []
    seen = set()
    for row in section.rows:
        run = min((run for run, _ in row.members), key=lambda run: run.config["seed"])
        config = run.config
        family = (row.algorithm, row.preset)
        if family in seen or not config["config"].get("barrier"):
            continue
        seen.add(family)
        entry = {"name": _family_name(row.name, row.preset), "seed": config["seed"]}
        state = _lonely_state(run, config["spec"]["n_agents"])
        try:
            drawn = figures.barrier_field(run, state, f"b{k}-{len(found)}")
        except UserError as error:
            found.append(entry | {"missing": str(error)})
            continue
        if drawn is not None:
            found.append(entry | {"field": drawn, "real": state is not None})
    return found


def _lonely_state(run: Run, n: int) -> np.ndarray | None:
    """A recorded state in which nobody but one other agent is near agent 0; None where none was kept."""
    for variant in run.results:
        recorded = recordings.read(run.path, variant)
        if recorded is not None and "states" in recorded:
            states = recorded["states"]
            return figures.lonely_state(states, n) if states.shape[-1] == 6 * n else None
    return None
