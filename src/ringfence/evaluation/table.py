"""The one table of results: a row for each evaluation of a run and for each reference policy, read here for whoever
shows it, and the one place where rows are refused that must not stand beside each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ringfence.errors import UserError
from ringfence.evaluation import reference
from ringfence.evaluation.protocol import of_last_step
from ringfence.logs.schema import other_data
from ringfence.training.runs import Run

Result = dict[str, Any]  # a summary of episodes as results.json has it (schemas.Result), under today's names

SPLITS = ("test", "validation")
NEEDED = ("episodes", "return_mean", "cost_mean", "cost_safe_start", "violation_rate", "constants", "protocol", "task")
NEEDED += ("return_interval", "cost_interval", "cost_safe_start_interval", "cost_cvar10", "unsafe_starts")


@dataclass(frozen=True, eq=False)
class Row:
    """An evaluation of a run, or a reference policy."""

    task: str
    algorithm: str  # of a reference policy its name
    preset: str
    variant: str  # the evaluation's name, with the step of the checkpoint where training went on since
    seed: int
    result: Result
    file: Path  # that holds the result
    name: str  # of the result in that file
    run: Run | None = None  # None: a reference policy
    config: Mapping[str, Any] = field(default_factory=dict)  # config.json of the run

    @property
    def split(self) -> str:
        return self.result["split"]

    @property
    def last(self) -> bool:
        """Whether the run's last step was played."""
        return of_last_step(self.result, self.config.get("config", {}))

    @property
    def data(self) -> dict[str, Any]:
        """The card of what the run was trained on."""
        return self.config.get("data") or {}

    @property
    def where(self) -> str:
        """The file and the result in it, for messages."""
        return f"'{self.file}' {'row' if self.run is None else 'variant'} '{self.name}'"


def of_run(run: Run) -> list[Row]:
    """Every evaluation that a run folder holds."""
    results = run.results
    config = run.config if results else {}
    found = []
    for name, result in results.items():
        dated = "@step" in name or of_last_step(result, config["config"])
        variant = name if dated else f"{name}@step{result['step']}"
        who = (config["task"], config["algorithm"], config["preset"], variant, config["seed"])
        found.append(Row(*who, result, run.path / "results.json", name, run, config))
    return found


def of_references(file: Path, task: str) -> list[Row]:
    """The reference policies of a task that a reference.json holds."""
    return [of_reference(file, task, name, result) for name, result in reference.read(file).items()]


def of_reference(file: Path, task: str, name: str, result: Result) -> Row:
    """A reference policy's row."""
    return Row(task, name, "", "reference", 0, result, file, name)


def check(rows: Iterable[Row], declared: Mapping[str, Any] | None = None, by: str = "") -> None:
    """Refuse rows that are not whole, or that must not stand in one table: of another protocol, normalised with other
    constants or trained on other data than the first of their task. `declared` is what the file `by` says of all rows:
    protocol, split and episodes."""
    leaders: dict[str, Row] = {}
    trained: dict[str, Row] = {}
    for row in rows:
        _check_whole(row)
        leader = leaders.setdefault(row.task, row)
        if declared is None:
            _check_same(row, "protocol", leader.result["protocol"], leader.where)
        else:  # logged episodes have resets of their own and any number of them
            for name in ("protocol",) if row.split == "data" else ("protocol", "split", "episodes"):
                _check_same(row, name, declared[name], by)
        _check_same(row, "constants", leader.result["constants"], leader.where)
        if row.run is None:
            continue
        first = trained.setdefault(row.task, row)
        if unlike := other_data(row.data, first.data):
            what, here, there = unlike[0]
            raise UserError(
                f"'{row.file.parent}' was trained on other data (its {what} is {here}) than '{first.file.parent}' "
                f"({there}); such numbers cannot stand in one table: give each data set one of its own."
            )


def _check_whole(row: Row) -> None:
    result = row.result
    needed = (*NEEDED, "split") if row.run is None else (*NEEDED, "split", "per_episode")
    if lacking := [name for name in needed if name not in result]:
        raise UserError(f"{row.where} lacks '{lacking[0]}', so it was made by another version; evaluate it again.")
    for name, mine in (("task", row.task), ("algorithm", row.algorithm), ("seed", row.seed)):
        told = result.get(name, mine)
        if told != mine and (name == "task" or row.run is not None):
            raise UserError(f"{row.where} is of {name} {told!r}, not of {mine!r}; evaluate it again.")
    if row.run is not None and row.split not in SPLITS:
        raise UserError(f"{row.where} has split {row.split!r}, which is neither test nor validation.")


def _check_same(row: Row, name: str, wanted: Any, whose: str) -> None:
    if row.result[name] != wanted:
        raise UserError(
            f"{row.where} has {name} {row.result[name]}, {whose} has {wanted}; such numbers cannot stand in one table: "
            "evaluate one of them again, or keep it in a folder of its own."
        )
