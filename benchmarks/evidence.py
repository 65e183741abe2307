"""What tables and claims are made of: every evaluation of a results folder with the numbers of its episodes, and the
test of one row against its paired baseline."""

from __future__ import annotations

import functools
import json
from collections import defaultdict
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from common import RESULTS

from ringfence import algos
from ringfence.bench import rows
from ringfence.datasets import registry
from ringfence.evaluation import statistics

Row = tuple[str, str]  # algorithm and variant
LEVEL = 0.05


@functools.cache
def evaluations(suite: str) -> dict[tuple[str, str, str], dict[int, dict]]:
    """By (task, algorithm, variant): the result of every seed, reference rows under seed 0."""
    found: dict = defaultdict(dict)
    for r in rows(RESULTS / suite):
        name = (r["algorithm"], r["variant"])
        found[r["task"], *name][r["seed"]] = r
    return dict(found)


def tasks_of(suite: str) -> list[str]:
    return list(dict.fromkeys(task for task, *_ in evaluations(suite)))


def of(suite: str, task: str, row: Row) -> dict[int, dict]:
    return evaluations(suite).get((task, *row), {})


def variant(task: str, row: Row) -> Row:
    """A row on this task: a preset made for its tier or its simulator stands for the default."""
    name, _, rest = row[1].partition("+")
    if name != "default" or row[0] not in algos.ALGORITHMS:
        return row
    preset = algos.get(row[0]).preset_for(registry.get(task).presets)
    return row[0], f"{preset}+{rest}" if rest else preset


def mean(suite: str, task: str, row: Row, key: str) -> float | None:
    """Over the seeds that there are."""
    found = [r[key] for r in of(suite, task, row).values() if r.get(key) is not None]
    return float(np.mean(found)) if found else None


@dataclass(frozen=True)
class Difference:
    """A row minus its paired baseline on the same resets, by the same seeds."""

    task: str
    seeds: tuple[int, ...]
    mean: float
    low: float  # 95 %, resets and seeds
    high: float
    p: float  # Wilcoxon over resets; `family` adjusts it

    @property
    def holds(self) -> bool:
        """Whether it is more than chance: after Holm over the family, and by an interval that knows of the seeds."""
        return self.p < LEVEL and not self.low <= 0 <= self.high


def difference(suite: str, task: str, row: Row, paired: Row, key: str) -> Difference | None:
    """Of `return`, `cost` or `cost_safe_start` (cost of the resets that start safe); None where one of the two is
    missing."""
    ours, theirs = of(suite, task, row), of(suite, task, paired)
    seeds = tuple(sorted(set(ours) & set(theirs)))
    if not seeds:
        return None
    kind = "cost" if key == "cost_safe_start" else key
    x, y = (np.array([r[s]["per_episode"][kind] for s in seeds], float) for r in (ours, theirs))
    d = x - y
    if key == "cost_safe_start":
        fine = ~np.array(ours[seeds[0]]["per_episode"]["unsafe_start"], bool)
        d = d[:, fine]
    test = statistics.paired_test(d.mean(0), np.zeros(d.shape[1]))
    low, high = statistics.mean_of_runs(d) if len(seeds) > 1 else test["interval"]
    return Difference(task, seeds, float(d.mean()), low, high, test["p"])


def family(found: list[Difference]) -> list[Difference]:
    """The same with p-values adjusted by Holm's method."""
    adjusted = statistics.holm(np.array([d.p for d in found])) if found else []
    return [replace(d, p=float(p)) for d, p in zip(found, adjusted)]


POOLED = ("violation_rate", "return_mean")


def proven(where: str = "proving", files: str = "proving-*.json") -> list[dict[str, Any]]:
    """By system, what seed 0 found, but for `rows`, each the mean over the seeds that played it and the `most`
    violations of one and the number of `seeds`, the `verdicts` of all seeds, and the `causes` of all."""
    found, folder = [], RESULTS / where
    for file in sorted(folder.glob(files)):
        others = sorted(folder.glob(f"seed-*/{file.name}"))
        seeds = [json.loads(one.read_text()) for one in (file, *others)]
        rows = {name: _mean([one["rows"][name] for one in seeds if name in one["rows"]]) for name in seeds[0]["rows"]}
        causes = list(dict.fromkeys(cause for one in seeds for cause in one["causes"]))
        found.append(seeds[0] | {"rows": rows, "verdicts": [one["verdict"] for one in seeds], "causes": causes})
    return found


def _mean(rows: list[dict[str, Any]]) -> dict[str, Any]:
    for row in rows:
        if "refused" in row:
            return row
    pooled = {name: float(np.mean([row[name] for row in rows])) for name in POOLED}
    return pooled | {"most": max(row["violation_rate"] for row in rows), "seeds": len(rows)}
