"""What the proving ground's files say, over seeds of clone and World (proving.py)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).resolve().parent.parent / "results"
POOLED = ("violation_rate", "return_mean")


def proven(folder: Path = RESULTS / "proving", files: str = "proving-*.json") -> list[dict[str, Any]]:
    """By system, what seed 0 found, but for `rows`, each the mean over the seeds that played it and the `most`
    violations of one, the `verdicts` of all seeds, and the `causes` of all."""
    found = []
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
    return pooled | {"most": max(row["violation_rate"] for row in rows)}
