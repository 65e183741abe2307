"""The 13-task table of the paper, printed values beside ours.

The paper's numbers are on the public data files and under constants of its cost that it does not state; ours are on
regenerated data, under the constants of each task. So two columns are to be read side by side, never ranked together.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.bench.cells import Grid, make_grids, narrowed
from ringfence.bench.suites import SUITES
from ringfence.bench.table import read
from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.evaluation.table import Result
from ringfence.utils.files import whole

FOLDERS = ("simple_spread", "mujoco")  # of results, one per suite
SEEDS = 5  # of the paper
METHODS = ("ma-td3bc", "omar", "icbf")
# The paper's rows: its name of a task, ours, and (reward, deviation, cost, deviation) of MA-TD3+BC, OMAR and its own
# method. "md" is the one tier of Simple Spread that is left: medium-replay.
PRINTED: dict[str, tuple[str, tuple[tuple[float, float, float, float], ...]]] = {
    "ant_2x4-good": ("2ant-good", ((0.73, 0.11, 2.39, 0.08), (0.34, 0.09, 1.25, 0.07), (1.05, 0.10, 0.44, 0.04))),
    "ant_2x4-medium": ("2ant-medium", ((0.41, 0.06, 1.45, 0.07), (0.18, 0.06, 0.35, 0.05), (0.60, 0.09, 0.80, 0.07))),
    "ant_2x4-poor": ("2ant-poor", ((0.21, 0.12, 0.55, 0.10), (0.20, 0.09, 0.43, 0.10), (0.33, 0.07, 0.29, 0.05))),
    "ant_4x2-good": ("4ant-good", ((0.70, 0.15, 1.95, 0.12), (0.15, 0.10, 0.25, 0.07), (0.99, 0.08, 0.64, 0.06))),
    "ant_4x2-medium": ("4ant-medium", ((0.50, 0.12, 1.73, 0.10), (0.69, 0.15, 0.82, 0.07), (0.48, 0.09, 0.56, 0.05))),
    "ant_4x2-poor": ("4ant-poor", ((0.25, 0.06, 0.74, 0.05), (0.23, 0.03, 0.53, 0.04), (0.40, 0.02, 0.44, 0.04))),
    "halfcheetah_2x3-good": (
        "2halfcheetah-good",
        ((1.11, 0.27, 2.14, 0.12), (0.81, 0.24, 1.76, 0.09), (1.08, 0.16, 0.66, 0.07)),
    ),
    "halfcheetah_2x3-medium": (
        "2halfcheetah-medium",
        ((0.51, 0.03, 1.58, 0.04), (0.25, 0.06, 1.51, 0.02), (0.43, 0.05, 0.48, 0.01)),
    ),
    "halfcheetah_2x3-poor": (
        "2halfcheetah-poor",
        ((0.09, 0.01, 0.20, 0.02), (0.05, 0.01, 0.19, 0.02), (0.13, 0.02, 0.17, 0.01)),
    ),
    "simple_spread-expert": (
        "simple spread-expert",
        ((1.08, 0.02, 3.30, 0.20), (1.35, 0.02, 5.50, 0.25), (1.11, 0.04, 0.00, 0.00)),
    ),
    "simple_spread-medium-replay": (
        "simple spread-md",
        ((0.32, 0.04, 1.30, 0.10), (0.60, 0.06, 2.30, 0.13), (0.82, 0.02, 0.30, 0.01)),
    ),
    "simple_spread-medium": (
        "simple spread-medium",
        ((0.71, 0.05, 2.10, 0.13), (0.65, 0.07, 2.50, 0.15), (0.88, 0.05, 0.00, 0.00)),
    ),
    "simple_spread-random": (
        "simple spread-random",
        ((0.23, 0.01, 0.00, 0.00), (0.49, 0.03, 1.50, 0.04), (0.56, 0.01, 0.00, 0.00)),
    ),
}
# Which of our rows stands for a method: algorithm and the endings that its variant may have, the best planner first.
OURS = {
    "MA-TD3+BC": ("ma-td3bc", ("",)),
    "OMAR": ("omar", ("",)),
    "ICBF": ("icbf", ("",)),
}


def parts(only: Iterable[str] = ()) -> dict[str, list[str]]:
    """The paper's tasks, or those named, by the suite that holds them."""
    return narrowed({s: [t for t in SUITES[s].tasks if t in PRINTED] for s in FOLDERS}, only, "the paper")


def grids(root: Path, only_tasks: Iterable[str] = (), only: Iterable[str] = (), **sizes: Any) -> list[Grid]:
    """The grids of the paper's tasks and methods, or of those named, one per suite, in folders of `root`; an entry that
    one suite alone knows is made there. `sizes`: arguments of `make_grid`."""
    return make_grids(parts(only_tasks), root, list(only) or METHODS, **sizes)


@dataclass(frozen=True)
class Line:
    """A method on a task: (reward, deviation, cost, deviation) as printed and as measured here, both normalised."""

    task: str
    method: str
    printed: tuple[float, float, float, float]
    ours: tuple[float, float | None, float, float | None] | None  # no deviation of one seed
    variant: str = ""
    seeds: int = 0


def lines(folders: Iterable[str | Path]) -> list[Line]:
    """The table from results folders; a task or method that they lack has no measured values."""
    folders = [Path(f) for f in folders]
    found: dict[tuple[str, str, str], list[Result]] = {}
    if not any((f / "bench.json").exists() for f in folders):
        names = " nor ".join(f"'{f}'" for f in folders)
        raise UserError(
            f"Neither {names} is a results folder; run `ringfence bench paper`, or name the folder it wrote."
        )
    for folder in folders:
        for row in read(folder) if (folder / "bench.json").exists() else ():
            found.setdefault((row.task, row.algorithm, row.variant), []).append(row.result)
    table = []
    for task, (_, values) in PRINTED.items():
        presets = (*registry.get(task).presets, "default")  # of rows that may stand there
        for (method, (algorithm, endings)), printed in zip(OURS.items(), values):
            wanted = [preset + ending for ending in endings for preset in presets]
            variant = next((v for v in wanted if (task, algorithm, v) in found), "")
            runs = found.get((task, algorithm, variant), [])
            ours = None
            if runs:
                reward, cost = (np.array([run[name] for run in runs]) for name in ("return_norm", "cost_norm"))
                ours = float(reward.mean()), _deviation(reward), float(cost.mean()), _deviation(cost)
            table.append(Line(task, method, printed, ours, variant, len(runs)))
    return table


def _deviation(x: np.ndarray) -> float | None:
    """Between seeds; None of one."""
    return float(x.std(ddof=1)) if len(x) > 1 else None


def markdown(table: list[Line]) -> str:
    """One row per task: reward / cost, printed (in italics) and ours, per method."""
    out = ["| task | " + " | ".join(f"*{m}, paper* | {m}, ours" for m in OURS) + " |"]
    out.append("|---|" + "---|" * (2 * len(OURS)))
    for task in PRINTED:
        cells = []
        for line in (x for x in table if x.task == task):
            reward, _, cost, _ = line.printed
            cells.append(f"*{reward:.2f} / {cost:.2f}*")
            cells.append(brief(line))
        out.append(f"| {task} | " + " | ".join(cells) + " |")
    return "\n".join(out)


def brief(line: Line) -> str:
    """Ours in short: reward / cost, and the number of seeds where there are fewer than the paper's five."""
    if line.ours is None:
        return "–"
    return f"{line.ours[0]:.2f} / {line.ours[2]:.2f}" + (f" [{line.seeds}]" if line.seeds < SEEDS else "")


def write(table: list[Line], path: Path) -> Path:
    """CSV with one line per task and method."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    names = ("return_norm", "return_std", "cost_norm", "cost_std")
    head = [f"{whose}_{n}" for whose in ("paper", "ours") for n in names]
    writer.writerow(["task", "method", "variant", "seeds", *head])
    for x in table:
        ours = ["" if v is None else f"{v:.4f}" for v in x.ours or [None] * 4]
        writer.writerow([x.task, x.method, x.variant, x.seeds, *x.printed, *ours])
    with whole(path) as temporary:
        temporary.write_text(buffer.getvalue())
    return path
