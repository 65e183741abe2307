"""What a replay found, as values and as a person reads it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

from ringfence.evaluation.statistics import clopper_pearson


@dataclass(frozen=True)
class Row:
    """A policy under one filter. Counts are of windows; intervals are exact, at 95 %."""

    policy: str
    filter: str  # none, brake, formula, or the guard's name
    windows: int
    logged: int  # with contact as logged
    alone: int  # with contact of the same policy without a filter
    contacts: int
    prevented: int
    caused: int
    infeasible: float | None = None  # share of steps in which the guard cannot do what it should
    ood: float | None = None  # and in which it is out of distribution
    margin: float | None = None  # median of the guard's margin
    by_agent: tuple[dict[str, Any], ...] = ()  # the same of each driven agent

    @property
    def contacts_interval(self) -> tuple[float, float]:
        low, high = clopper_pearson(self.contacts, self.windows)
        return low, high

    @property
    def caused_interval(self) -> tuple[float, float]:
        low, high = clopper_pearson(self.caused, self.windows)
        return low, high

    @property
    def prevented_interval(self) -> tuple[float, float] | None:
        """Of the contacts without a filter; None where there are none."""
        if not self.alone:
            return None
        low, high = clopper_pearson(self.prevented, self.alone)
        return low, high


@dataclass(frozen=True, eq=False)
class Film:
    """One window: places in metres."""

    title: str
    others: np.ndarray  # (L+1, K, X) along X axes
    logged: np.ndarray  # (L+1, X)
    alone: np.ndarray  # (L+1, X) the policy without guard
    guarded: np.ndarray  # (L+1, X)


@dataclass(frozen=True)
class ReplayResult:
    """Rows by policy and filter, all of the same windows."""

    task: str
    radius: float  # m
    radius_from: str
    kinematics: str
    steps: int
    seconds: float
    windows: int
    begun_in_contact: int  # windows left out
    guard: str
    verdict: str | None  # of the World
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    films: tuple[Film, ...] = field(default=(), repr=False)

    def to_json(self) -> dict[str, Any]:
        """All but the films, with intervals, as files hold it."""
        made = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("rows", "films")}
        intervals = ("contacts_interval", "prevented_interval", "caused_interval")
        made["rows"] = [asdict(row) | {name: getattr(row, name) for name in intervals} for row in self.rows]
        return made

    def row(self, policy: str, filter: str) -> Row:
        return next(row for row in self.rows if (row.policy, row.filter) == (policy, filter))

    def summary(self) -> list[str]:
        """Lines for a terminal."""
        first = self.rows[0]
        lines = [
            f"{self.task}: {self.windows} windows of {self.seconds:.3g} s, contact below {self.radius:.3g} m "
            f"({self.radius_from}), kinematics {self.kinematics}; as logged {first.logged} with contact",
            f"{'policy':12} {'filter':10} {'contacts':>8} {'prevented':>16} {'caused':>7}  of windows (95 %)",
        ]
        for row in self.rows:
            share = f"{row.prevented} of {row.alone}" if row.filter != "none" else "–"
            low, high = row.contacts_interval
            lines.append(
                f"{row.policy:12} {row.filter:10} {row.contacts:8} {share:>16} {row.caused:7}  "
                f"contacts {100 * row.contacts / row.windows:.1f} % ({100 * low:.1f} to {100 * high:.1f})"
            )
        return [*lines, *self.notes]
