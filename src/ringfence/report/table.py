"""Rows of results as the lines of a task's table: one per method, all its seeds pooled, and the reference policies."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ringfence.algos import ALGORITHMS
from ringfence.errors import UserError, of_kind
from ringfence.evaluation import reference, statistics
from ringfence.evaluation.statistics import Interval
from ringfence.evaluation.table import SPLITS, Result, Row, check, of_reference, of_references, of_run
from ringfence.training.runs import LOGS, Run, runs_below
from ringfence.utils.config import fields_of
from ringfence.utils.files import place

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
ORDER = list(NAMES)  # lines of the table; algorithms that are not named here come last
COLOURS = 10  # series colours in style.css
Style = tuple[int, int]  # colour, marker
Number = TypeVar("Number", float, np.ndarray)


@dataclass(frozen=True)
class Method:
    """An algorithm with its preset, evaluated under one variant: what a line of a table compares."""

    algorithm: str
    preset: str
    variant: str  # as in results.json
    apart: str = ""  # settings in which runs of the same algorithm and preset differ

    @property
    def name(self) -> str:
        """The algorithm in plain words."""
        return NAMES.get(self.algorithm, self.algorithm)

    @property
    def shown(self) -> str:
        """The variant without what a table says elsewhere: `default+plans4@validation` -> `plans4`."""
        variant = re.sub(r"^default\b\+?|@validation\b", "", self.variant)
        return f"{variant} {self.apart}".strip()

    @property
    def label(self) -> str:
        return f"{self.name} {self.shown}".strip()

    @property
    def place(self) -> tuple:
        """Order in tables: that of NAMES, then by variant, numbers by size."""
        rank = ORDER.index(self.algorithm) if self.algorithm in ORDER else len(ORDER)
        parts = [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", self.shown)]
        first = self.preset.startswith("algorithm1")
        return rank, self.algorithm, not first, [(isinstance(p, str), p) for p in parts]


@dataclass(kw_only=True)
class Numbers:
    """Per episode, over all runs of a line. Intervals are 95 %."""

    episodes: int  # over all runs
    returns: float
    returns_interval: Interval
    returns_norm: float
    cost: float
    cost_interval: Interval
    cost_norm: float
    cost_safe_start: float
    cost_safe_start_interval: Interval
    returns_sd: float | None  # between runs; None of one
    cost_sd: float | None
    violations: int
    violation_upper: float  # exact, one-sided, of the resets on which any run has one
    unsafe_starts: int
    cvar: float  # mean of the tenth of episodes with the highest cost
    safe: bool  # the upper end of the cost's interval is within the limit, and so it is of every named constraint
    limits: dict[str, float] = field(default_factory=dict)  # per episode, of the constraints that are named

    @property
    def violation_rate(self) -> float:
        return self.violations / self.episodes


@dataclass(kw_only=True)
class Line(Numbers):
    """A method over its seeds, or a reference policy."""

    name: str  # in plain words
    rows: list[Row] = field(repr=False)  # by seed
    method: Method | None = None  # None: a reference
    parameters: int | None = None
    train_seconds: float | None = None  # of one seed
    plan_ms: float | None = None  # median of one joint action
    ended: float | None = None  # share of episodes that ended before the time limit; None: not said
    steps: float | None = None  # mean of an episode
    style: Style = (0, 0)
    rank: int = 0  # on this task, from 1; 0 where nothing is ranked
    best: bool = False  # the highest return among the safe

    @property
    def reference(self) -> bool:
        return self.method is None

    @property
    def variant(self) -> str:
        """What is evaluated beside the default, in short; empty for references."""
        return "" if self.method is None else self.method.shown

    @property
    def label(self) -> str:
        """Name and variant in one line, e.g. `ICBF-Diffuser split+plans4`."""
        return f"{self.name} {self.variant}".strip()

    @property
    def seeds(self) -> tuple[int, ...]:
        """None of a reference."""
        return () if self.reference else tuple(row.seed for row in self.rows)

    @property
    def returns_norm_sd(self) -> float | None:
        constants = self.rows[0].result["constants"]
        return None if self.returns_sd is None else self.returns_sd / return_span(constants)


@dataclass
class Section:
    """One task: everything that may stand in one table."""

    task: str
    tables: dict[str, list[Line]]  # by split
    references: list[Line]
    hazard: dict[str, Any] = field(default_factory=dict)
    card: dict[str, Any] = field(default_factory=dict)
    constants: dict[str, float] = field(default_factory=dict)  # none where nothing was measured
    protocol: int = 0

    @property
    def lines(self) -> list[Line]:
        return [line for table in self.tables.values() for line in table]

    @property
    def runs(self) -> list[Run]:
        """Of all lines, each once."""
        found = {row.run.path: row.run for line in self.lines for row in line.rows if row.run is not None}
        return list(found.values())


def sections(runs: Iterable[Run | str | Path] | Run | str | Path) -> list[Section]:
    """One section per task of evaluated runs, in the order in which the runs name them."""
    rows: dict[str, list[Row]] = {}
    distinct: dict[Path, Run] = {}  # the same folder named twice counts once
    of_kind("runs", runs, Iterable | Run | Path, "give run folders, or one of them")
    for each in [runs] if isinstance(runs, str | Path | Run) else runs:
        below = [] if isinstance(each, Run) else runs_below(place(each))
        for run in below or [Run.of(each)]:
            distinct.setdefault(run.path.resolve(), run)
    for run in distinct.values():
        found = of_run(run)
        if not found:
            raise UserError(
                f"'{run.path}' has not been evaluated; run `ringfence eval {run.path}` first, or for a simulator "
                f"of your own `ringfence play {run.path} --env FILE.py:NAME`."
            )
        rows.setdefault(found[0].task, []).extend(found)
    if not rows:
        raise UserError("No run was given, so there is nothing to report; pass run folders made by `ringfence train`.")
    return [_section_of_runs(task, mine) for task, mine in rows.items()]


def _section_of_runs(task: str, rows: list[Row]) -> Section:
    files = dict.fromkeys(row.file.parent.resolve().parent.parent / reference.FILE for row in rows)
    found = [row for file in files if file.exists() for row in of_references(file, task)]
    check([*rows, *found])
    references = list({row.name: row for row in reversed(found)}.values())[::-1]  # the first of a name
    first = rows[0]
    if first.run is not None and reference.LOGS not in [row.name for row in references]:
        logs = reference.of_run(first.run, first.result["constants"])
        if logs is not None:
            references.append(of_reference(first.run.path / LOGS, task, reference.LOGS, logs))
    made = section(task, rows, references, methods_of(rows))
    paint(made.lines)
    return made


def section(task: str, rows: list[Row], references: list[Row], methods: Mapping[Row, Method]) -> Section:
    """The lines of a task's checked rows, of which each is of one of `methods`."""
    tables: dict[str, list[Line]] = {}
    for split in SPLITS:
        groups: dict[Method, list[Row]] = {}
        for row in rows:
            if row.split == split:
                groups.setdefault(methods[row], []).append(row)
        if groups:
            lines = [_line(method, mine) for method, mine in groups.items()]
            tables[split] = sorted(lines, key=lambda line: line.method.place if line.method else ())
    beside = [Line(name=row.name, rows=[row], **_means([row]), **vars(pool([row.result]))) for row in references]
    for k, line in enumerate(beside):
        line.style = 0, k
    config = rows[0].config if rows else {}
    told: Mapping[str, Any] = next((row.result for row in (*rows, *references)), {})
    return Section(
        task=task,
        tables=tables,
        references=beside,
        hazard=dict(config.get("hazard") or {}),
        card=dict(config.get("data") or {}),
        constants=told.get("constants", {}),
        protocol=told.get("protocol", 0),
    )


def _line(method: Method, rows: list[Row]) -> Line:
    """A method's line; no seed may be there twice."""
    first: dict[int, Row] = {}
    for row in rows:
        other = first.setdefault(row.seed, row)
        if other is not row:
            raise UserError(
                f"'{other.file.parent}' and '{row.file.parent}' are the same job with the same seed {row.seed}; keep "
                "only one of them."
            )
    rows = [first[seed] for seed in sorted(first)]
    numbers = pool([row.result for row in rows], f"The runs of '{method.shown}'")
    means = _means(rows) | {"parameters": rows[0].result.get("parameters")}
    return Line(name=method.name, method=method, rows=rows, **means, **vars(numbers))


def _means(rows: list[Row]) -> dict[str, float | None]:
    keys = {"train_seconds": "train_seconds", "plan_ms": "plan_ms_p50"}
    keys |= {"ended": "termination_rate", "steps": "steps_mean"}
    return {name: mean_of([row.result for row in rows], key) for name, key in keys.items()}


def methods_of(rows: Iterable[Row]) -> dict[Row, Method]:
    """Every row's method. Settings that differ between runs of the same algorithm, preset and task set methods apart;
    one that is one thing on one task and another on the next does not."""
    settings = {row: settings_of(row.config) for row in rows}
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row, mine in settings.items():
        groups.setdefault((row.algorithm, row.preset, row.task), []).append(mine)
    apart: dict[tuple[str, str], dict[str, None]] = {}
    for (algorithm, preset, _), several in groups.items():
        fields = dict.fromkeys(k for one in several for k in one)
        differing = [k for k in fields if len({json.dumps(one.get(k)) for one in several}) > 1]
        apart.setdefault((algorithm, preset), {}).update(dict.fromkeys(differing))
    found = {}
    for row, mine in settings.items():
        words = ", ".join(f"{k}={mine.get(k)}" for k in apart[row.algorithm, row.preset])
        found[row] = Method(row.algorithm, row.preset, row.variant, f"[{words}]" if words else "")
    return found


def settings_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings in a run's config.json, where a field that is younger than the run had its default then; and the
    algorithm's revision: with another one the same settings train another policy."""
    known = ALGORITHMS.get(config["algorithm"])  # none of somebody else's
    defaults = {} if known is None else {name: f.default for name, f in fields_of(known.Config).items()}
    return defaults | config["config"] | {"revision": config.get("revision", 1)}


def paint(lines: Iterable[Line]) -> None:
    """A colour per algorithm and preset, the same in every figure; no two methods have colour and marker in common."""
    families: dict[tuple[str, str], int] = {}
    taken: dict[int, int] = {}
    styles: dict[tuple[str, str, str], Style] = {}
    for line in lines:
        if (method := line.method) is None:
            continue
        family = (method.algorithm, method.preset)
        colour = families.setdefault(family, len(families)) % COLOURS
        if (*family, line.label) not in styles:
            taken[colour] = taken.get(colour, -1) + 1
            styles[*family, line.label] = colour, taken[colour]
        line.style = styles[*family, line.label]


def pool(results: list[Result], name: str = "the runs of a line") -> Numbers:
    """The summaries of a line's runs as one. `UserError` if they played different numbers of resets.

    The interval of one run speaks of its episodes alone, that of several also of what another seed would have trained.
    """
    measured = _of_one(results[0]) if len(results) == 1 else _of_several(results, name)
    constants = results[0]["constants"]
    limits = limits_of(results)
    costs = [(r.get("constraints", {}).get(name, {}), limit) for r in results for name, limit in limits.items()]
    # By the upper ends of the costs' intervals; what was not measured is not kept.
    kept = all(c and not c.get("cost_interval", (0.0, c["cost_mean"]))[1] > limit for c, limit in costs)
    means = [(c.get("cost_mean", np.inf), limit) for c, limit in costs]
    shares = [cost / limit if limit > 0 else np.inf if cost > 0 else 0.0 for cost, limit in means]  # 1 at the limit
    return Numbers(
        **measured,
        episodes=sum(r["episodes"] for r in results),
        returns_sd=_deviation(results, "return_mean"),
        cost_sd=_deviation(results, "cost_mean"),
        violations=sum(map(_violations, results)),
        returns_norm=normal_return(measured["returns"], constants),
        cost_norm=float(max(0.0, *shares)) if limits else normal_cost(measured["cost"], constants),
        safe=kept and measured["cost_interval"][1] <= constants["cost_limit"],
        limits=limits,
    )


def _deviation(results: list[Result], key: str) -> float | None:
    return float(np.std([r[key] for r in results], ddof=1)) if len(results) > 1 else None


def limits_of(results: Iterable[Result]) -> dict[str, float]:
    """The limit of every constraint that a result names. Their sum is no limit: what one leaves, another must not
    use up."""
    limits: dict[str, float] = {}
    for result in results:
        for name, constraint in result.get("constraints", {}).items():
            if constraint.get("limit") is not None:
                limits[name] = min(constraint["limit"], limits.get(name, constraint["limit"]))
    return limits


def _of_one(result: Result) -> dict[str, Any]:
    """Its own numbers: it may be of logged data, whose episodes are not kept one by one."""
    return {
        "returns": result["return_mean"],
        "returns_interval": tuple(result["return_interval"]),
        "cost": result["cost_mean"],
        "cost_interval": tuple(result["cost_interval"]),
        "cost_safe_start": result["cost_safe_start"],
        "cost_safe_start_interval": tuple(result["cost_safe_start_interval"]),
        "unsafe_starts": result["unsafe_starts"],
        "cvar": result["cost_cvar10"],
        "violation_upper": statistics.upper_bound(_violations(result), result["episodes"]),
    }


def _of_several(results: list[Result], name: str) -> dict[str, Any]:
    """From the episodes (runs, resets) of all."""
    played = [r["episodes"] for r in results]
    if len(set(played)) > 1:
        raise UserError(
            f"{name} were played for {min(played)} and for {max(played)} episodes, which are not the same resets; "
            "evaluate all of them with the same --episodes."
        )
    returns = _episodes(results, "return")
    cost = _episodes(results, "cost")
    unsafe = _episodes(results, "unsafe_start")
    if unsafe.all():  # nothing is known of safe starts: no cost
        safe_start = np.ones_like(unsafe, bool)
        cost_safe_start = np.zeros_like(cost)
    else:
        safe_start = unsafe == 0
        cost_safe_start = cost
    return {
        "returns": float(returns.mean()),
        "returns_interval": statistics.mean_of_runs(returns),
        "cost": float(cost.mean()),
        "cost_interval": statistics.mean_of_runs(cost, least=0.0),
        "cost_safe_start": float(cost_safe_start[safe_start].mean()),
        "cost_safe_start_interval": statistics.mean_of_runs(cost_safe_start, safe_start, least=0.0),
        "unsafe_starts": int(unsafe.sum()),
        "cvar": statistics.cvar(cost.ravel()),
        # Runs share their resets, which alone are independent; a mean over runs is at most this share of them.
        "violation_upper": statistics.upper_bound(int((cost > 0).any(0).sum()), cost.shape[1]),
    }


def _episodes(results: list[Result], what: str) -> np.ndarray:
    return np.array([r["per_episode"][what] for r in results], float)


def _violations(result: Result) -> int:
    return round(result["violation_rate"] * result["episodes"])


def normal_return(x: Number, constants: dict[str, float]) -> Number:
    """0 at return_min, 1 at return_max."""
    return (x - constants["return_min"]) / return_span(constants)


def normal_cost(x: Number, constants: dict[str, float]) -> Number:
    """1 at the limit."""
    return (x + constants["cost_offset"]) / _span(constants["cost_limit"] + constants["cost_offset"])


def return_span(constants: dict[str, float]) -> float:
    """What lies between normalised returns of 0 and 1."""
    return _span(constants["return_max"] - constants["return_min"])


def _span(size: float) -> float:
    if not size:
        raise UserError("A result's constants say that 0 and 1 are the same return or cost; evaluate its run again.")
    return size


def mean_of(results: Iterable[Mapping[str, Any]], key: str) -> float | None:
    """Mean of what the summaries say under `key`; None where none says it."""
    values = [r[key] for r in results if r.get(key) is not None]
    return float(np.mean(values)) if values else None
