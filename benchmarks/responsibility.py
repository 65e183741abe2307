"""Agents out of step who leave a share of each pair's condition to the other, on the resets of the certificates.

python benchmarks/responsibility.py        # writes results/stress/responsibility.csv, a row when it is played

Rows are paired with results/stress/certificates/asynchrony0.667-margin1-0.json, whose guard leaves nothing.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import _rows
import numpy as np
from certificates import BATCH, FIRST, FOLDER, RUN, SETTINGS, file_of

from ringfence.deploy import zoo
from ringfence.evaluation.rollout import rollout
from ringfence.evaluation.statistics import upper_bound
from ringfence.evaluation.stress import compensated
from ringfence.faults import Faults, under_faults
from ringfence.loading.resolve import resolve
from ringfence.loading.spec import PolicySpec
from ringfence.utils.compilation import keep_programs

OUT = FOLDER.parent / "responsibility.csv"
SETTING = "asynchrony0.667"
TRIALS: dict[str, dict[str, Any]] = {
    "half": {"responsibility": "half"},
    "reserve": {"responsibility": "reserve"},
    "all, margin 1.5, horizon 6": {"margin": 1.5, "horizon": 6},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=BATCH)
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    pool = json.loads(file_of(FOLDER, SETTING, 1.0, 0).read_text())
    before = np.array(pool["violated"][: a.episodes], bool)
    done = {row["responsibility"] for row in _rows.read(a.out)}
    if "all" not in done:
        add(a.out, "all", before, before, {"return": pool["return"], "infeasible_rate": ""})
    keep_programs()
    with tempfile.TemporaryDirectory() as folder:
        run = zoo.pretrained(RUN, folder)
        for name, options in TRIALS.items():
            if name not in done:
                add(a.out, name, before, *played(run, options, a.episodes))


def played(run: Any, options: dict[str, Any], episodes: int) -> tuple[np.ndarray, dict[str, Any]]:
    faults = Faults.of(SETTINGS[SETTING])
    given = compensated(run, faults, {"guard": "shield", "margin": 1.0, **options})
    resolved = resolve(PolicySpec.of(run, **given))
    task = resolved.job.task
    policy = under_faults(resolved.team, faults, task)
    found = rollout(policy, task.simulator, episodes, "test", 0, 0, str(options), True, FIRST)
    means = {"return": found["rewards"].sum(1).mean(), "infeasible_rate": found["infeasible"].mean()}
    return found["costs"].sum(1) > 0, {name: round(float(value), 4) for name, value in means.items()}


def add(out: Path, name: str, before: np.ndarray, violated: np.ndarray, means: dict[str, Any]) -> None:
    row = {"responsibility": name, "episodes": len(violated), **means, "violations": int(violated.sum())}
    row["violation_upper"] = round(upper_bound(int(violated.sum()), len(violated)), 4)
    row |= {"only it": int((violated & ~before).sum()), "only without": int((before & ~violated).sum())}
    print(row, flush=True)
    _rows.append(out, row, tuple(row))


if __name__ == "__main__":
    main()
