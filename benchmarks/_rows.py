"""Tables of trials that grow row by row, so that nothing is lost when a study is cut short. Imports nothing heavy:
workers are pinned to a core before they start JAX."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from ringfence.utils import stored


def read(file: Path) -> list[dict[str, str]]:
    """All rows under today's names, none if there is no file yet."""
    return stored.table(file) if file.exists() else []


def append(file: Path, row: dict[str, Any], fields: tuple[str, ...]) -> None:
    """Add a row; a new file begins with the names of its fields, and one under older names gets today's."""
    fresh = not file.exists()
    if not fresh and tuple(csv.DictReader(file.open()).fieldnames or ()) != fields:
        write(file, read(file))
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a", newline="") as f:
        writer = csv.DictWriter(f, fields, lineterminator="\n")
        if fresh:
            writer.writeheader()
        writer.writerow(row)


def write(file: Path, rows: list[dict[str, Any]]) -> None:
    """The whole table at once, in place of what was there; fields are those of its first row."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="") as f:
        writer = csv.DictWriter(f, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def measured(r: dict[str, Any]) -> dict[str, float]:
    """What a table keeps of an evaluation."""
    return {
        "return": round(r["return_mean"], 2),
        "return_norm": round(r["return_norm"], 4),
        "cost": round(r["cost_mean"], 4),
        "cost_safe_start": round(r["cost_safe_start"], 4),
    }
