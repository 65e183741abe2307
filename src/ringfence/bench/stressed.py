"""Evaluations behind faults, as a suite asks for them, and the table that is made of them."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ringfence.errors import UserError
from ringfence.evaluation import compensation, stress
from ringfence.evaluation.certificate import Certificate
from ringfence.evaluation.protocol import PROTOCOL
from ringfence.faults import Faults
from ringfence.loading.spec import PolicySpec
from ringfence.training.runs import Run
from ringfence.utils import text

COLUMNS = (
    "task, algorithm, seed, faults, guard, barrier, compensated, agents, episodes, return_mean, return_norm, "
    "cost_mean, violation_rate, violation_upper, infeasible_rate, run"
).split(", ")
COVERS = "certificate_covers"  # a column, where a certificate is given

Row = dict[str, Any]


class Trial(NamedTuple):
    """How runs are played behind faults."""

    spec: str  # name of its PolicySpec
    faults: str  # name of its Faults
    compensated: bool = False

    def play(self, run: Run, episodes: int) -> None:
        """Add the result to the run's stress.json."""
        # A benchmark measures what an unfit World is worth, too.
        spec = replace(PolicySpec.parse(self.spec, run), anyway=True)
        stress.stress_spec(spec, Faults.parse(self.faults), episodes=episodes, compensate=self.compensated)

    def result(self, run: Run, episodes: int) -> Row | None:
        """What the run holds of it, in as many episodes by today's protocol; options are those that it asked for."""
        wanted = {
            "asked": self.spec,
            "faults": dataclasses.asdict(Faults.parse(self.faults)),
            "compensated": self.compensated,
            "episodes": episodes,
            "protocol": PROTOCOL,
        }
        for found in stress.results(run).values():
            if all(found.get(name) == value for name, value in wanted.items()):
                known = compensation.COMPENSATION if self.compensated else ()
                asked = {k: v for k, v in found["guard_options"].items() if k not in known}
                return {**found, "guard_options": asked}
        return None


def rows(out: str | Path, certificate: Certificate | None = None) -> list[Row]:
    """Every evaluation behind faults in a results folder; none where its suite has none."""
    found = []
    for file in sorted((Path(out) / "cells").glob(f"*/*/[!.]*/{stress.FILE}")):
        run = Run(file.parent)
        seed = run.config["seed"]
        for result in stress.results(run).values():
            # of validation resets, of an earlier checkpoint, or of a simulator of somebody's own
            if "@" in result["variant"] or "simulator" in result:
                continue
            row = {**result, "faults": Faults.of(result["faults"]).name, "seed": seed}
            row["run"] = str(file.parent.relative_to(out))
            if certificate is not None:
                row[COVERS] = covers(certificate, result)
            found.append(row)
    if certificate is not None and not any(row[COVERS] for row in found):
        raise UserError(
            f"This certificate is of no guard that was played in '{out}'; make one of a run there by "
            "`ringfence certify`."
        )
    return found


def covers(certificate: Certificate, result: Row) -> str:
    """What a certificate says of a result: `promised`, where it is of that guarded run behind these faults; of other
    faults whether no more episodes violated than it allows, `kept` or `broken`; nothing of another guard or run."""
    own = (certificate.policy, certificate.world, certificate.agents, certificate.barrier, certificate.guard)
    digests = result.get("digests", {})
    names = ("agents", "barrier", "guard_options")
    if own != (digests.get("policy"), digests.get("world"), *(result[name] for name in names)):
        return ""
    if certificate.faults == result["faults"]:
        return "promised"
    return "kept" if result["violation_rate"] <= certificate.bound else "broken"


def write_csv(out: str | Path, certificate: Certificate | None = None) -> Path | None:
    """DIR/stress.csv, one line per row of `rows`; None where there are none."""
    found = rows(out, certificate)
    if not found:
        return None
    columns = COLUMNS if certificate is None else [*COLUMNS, COVERS]
    return text.write_csv(Path(out) / "stress.csv", columns, found)
