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
from ringfence.evaluation.table import Row
from ringfence.logs.schema import regenerated
from ringfence.problem import constraints
from ringfence.report import barrier, figures, html, player, provenance
from ringfence.report.headline import danger, headline, words_of
from ringfence.report.pooling import mean_of
from ringfence.report.table import Line, Method, Section, sections
from ringfence.training.runs import Run

TEMPLATE = "page.html.j2"


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
        "board": None,
        "js": Markup(html.asset("player.js")),
        "sections": [of_section(s, k) | _of_runs(s, k, out) for k, s in enumerate(found)],
        "environments": provenance.environments([run for s in found for run in s.runs]),
    }
    return html.write(out, html.render(TEMPLATE, context))


@dataclass(frozen=True)
class SplitTable:
    """The lines of one split, and what stands below them."""

    split: str
    lines: list[Line]
    references: list[Line]  # of the first split alone
    constraints: list[ConstraintLine]
    guards: list[GuardLine]


@dataclass(frozen=True)
class GuardLine:
    """What the guard of a line says of itself."""

    line: Line
    verdict: str | None  # of its World; None of results of before
    infeasible: float  # share of the steps in which no action kept the margin
    ood: float | None  # share of the steps that the logs do not cover


@dataclass(frozen=True)
class ConstraintLine:
    """What a named constraint cost a line, mean of its runs; None where the runs do not say."""

    line: Line
    name: str
    cost_mean: float | None
    violation_rate: float | None
    limit: float | None
    limit_satisfied_rate: float | None


def of_section(section: Section, k: int) -> dict[str, Any]:
    """What every page shows of a task."""
    unit, _ = words_of(section.hazard)
    first = next(iter(section.tables), "")
    shown = [*section.lines, *section.references]
    tables = []
    for split, lines in section.tables.items():
        beside = [line for line in section.references if split == first and line.rows[0].split in (split, "data")]
        tables.append(SplitTable(split, lines, beside, constraint_table(lines), guard_table(lines)))
    return {
        "id": f"task{k}",
        "task": section.task,
        "short": section.task,
        "unit": unit,
        "headline": headline(section),
        "tables": tables,
        # What a page of runs or of a board has beside it, or neither.
        **dict.fromkeys(("absent", "contests", "files"), ()),
        **dict.fromkeys(("curves", "fields", "players", "films", "simulated", "commands"), ()),
        "ends": any(line.ended for line in shown),
        "danger": danger(section.hazard),
        "constants": section.constants,
        "limits": {name: limit for line in section.lines for name, limit in line.limits.items()},
        "ceiling": section.card.get("return_ceiling"),
        "protocol": section.protocol,
        "scatter": figures.scatter(section, tables[0].lines, f"{unit} per episode", f"s{k}") if tables else None,
        "card": provenance.facts(section.card),
        "regenerated": regenerated(section.card),
    }


def _of_runs(section: Section, k: int, out: Path) -> dict[str, Any]:
    """What the page of runs shows beside that."""
    recorded = player.players(section)
    simulated = _simulated(section)
    families = {_family_name(m): line.style[0] for line in section.lines if (m := line.method)}
    return {
        "curves": figures.training_curves(section.lines, f"t{k}"),
        "families": families,
        "fields": _fields(section, k),
        "players": recorded,
        "players_json": Markup(json.dumps(recorded, separators=(",", ":")).replace("<", "\\u003c")),
        "films": player.films(section),
        "film_shows": getattr(simulated.env, "film_shows", "") if simulated else "",
        "simulated": simulated is not None,
        "commands": provenance.commands(section, out),
        "differences": provenance.differences(section.runs),
    }


def _simulated(section: Section) -> Task | None:
    """The task, where a simulator of this package plays it."""
    return registry.simulated(section.task, constraints.from_dict(section.hazard)) if section.hazard else None


def guard_table(lines: list[Line]) -> list[GuardLine]:
    """What guards say, of each line that was played under one."""
    found = []
    for line in lines:
        results = [row.result for row in line.rows]
        infeasible = mean_of(results, "infeasible_rate")
        if infeasible is None:
            continue
        verdicts = {result.get("verdict") for result in results}
        verdict = verdicts.pop() if len(verdicts) == 1 else None
        found.append(GuardLine(line, verdict, infeasible, mean_of(results, "ood_rate")))
    return found


def constraint_table(lines: list[Line]) -> list[ConstraintLine]:
    """Each named constraint of the lines whose simulator names them."""
    found = []
    for line in lines:
        costs = [row.result["constraints"] for row in line.rows if "constraints" in row.result]
        if not costs or len(costs) < len(line.rows):
            continue
        for name in costs[0]:
            runs = [by_name[name] for by_name in costs if name in by_name]
            keys = ("cost_mean", "violation_rate", "limit", "limit_satisfied_rate")
            found.append(ConstraintLine(line, name, *(mean_of(runs, key) for key in keys)))
    return found


def _family_name(method: Method) -> str:
    return method.name if method.preset == "default" else f"{method.name} {method.preset}"


def _fields(section: Section, k: int) -> list[dict[str, Any]]:
    """Pictures of learned barriers, one per algorithm and preset; what cannot be loaded is said, not hidden."""
    first: dict[str, Row] = {}
    for line in section.lines:
        if line.method is not None and line.rows[0].config["config"].get("barrier"):
            first.setdefault(_family_name(line.method), line.rows[0])
    found: list[dict[str, Any]] = []
    for name, row in first.items():
        assert row.run is not None, "a method's row"
        state = _lonely_state(row.run, row.config["spec"]["n_agents"])
        entry: dict[str, Any] = {"name": name, "seed": row.seed}
        try:
            drawn = barrier.field(row.run, state, f"b{k}-{len(found)}")
        except UserError as error:
            found.append(entry | {"missing": str(error)})
            continue
        if drawn is not None:
            found.append(entry | {"field": drawn})
    return found


def _lonely_state(run: Run, n: int) -> np.ndarray | None:
    """A recorded state in which nobody but one other agent is near agent 0; None where none was kept."""
    for variant in run.results:
        recorded = recordings.read(run.path, variant)
        if recorded is not None and "states" in recorded:
            states = recorded["states"]
            return barrier.lonely_state(states, n) if states.shape[-1] == 6 * n else None
    return None
