"""Writes the tables of docs/guard.md between their markers, from results/ alone.

python benchmarks/guards_tables.py
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from readme import put

RESULTS = Path(__file__).resolve().parent.parent / "results"
# Columns: their heads, and algorithm, guard, danger and sight of their rows.
SPREAD = {
    "cloning": "bc none none all",
    "shield, formula": "bc shield formula all",
    "**shield, learned**": "bc shield learned all",
    "**full, learned**": "bc full learned all",
    "no prior (`mpc`), full, learned": "mpc full learned all",
}
ROBOTS = {
    "cloning": "bc none none all",
    "adapt, formula": "bc adapt formula all",
    "adapt, learned": "bc adapt learned all",
    "full, formula": "bc full formula all",
    "**full, learned**": "bc full learned all",
}
OWN = {"cloning": "bc none none all", "shield, learned, own sight": "bc shield learned own"}
OWN_ROBOTS = {
    "cloning": "bc none none all",
    "adapt, learned, own sight": "bc adapt learned own",
    "full, learned, own sight": "bc full learned own",
}


def main() -> None:
    put("docs/guard.md", "spread", table("guards", SPREAD, short))
    put("docs/guard.md", "robots", table("guards-mujoco", ROBOTS, long))
    put("docs/guard.md", "own", table("own-sight", OWN, short))
    put("docs/guard.md", "own-robots", table("own-sight-mujoco", OWN_ROBOTS, long))
    put("docs/guard.md", "barrier", barrier())


def table(suite: str, columns: dict[str, str], cell) -> str:
    """A row per task, a column per guard; – where nothing was made."""
    rows = list(csv.DictReader((RESULTS / suite / "table.csv").open()))
    names = dict.fromkeys(r["task"] for r in rows)
    out = ["| | " + " | ".join(columns) + " |", "|---" * (1 + len(columns)) + "|"]
    for task in names:
        cells = []
        for of in columns.values():
            keys = ("algorithm", "guard", "danger", "sight")
            mine = (r for r in rows if r["task"] == task and r["variant"] != "reference")
            found = [r for r in mine if [r[k] for k in keys] == of.split()]
            seeds = {r["seed"] for r in found}
            cells.append(cell(found) + (f" ({len(seeds)} seeds)" if len(seeds) > 1 else "") if found else "–")
        if any(c != "–" for c in cells[1:]):
            out.append(f"| `{task}` | " + " | ".join(cells) + " |")
    return "\n".join(out)


def mean(rows: list[dict], key: str) -> float:
    return float(np.mean([float(r[key]) for r in rows]))


def short(rows: list[dict]) -> str:
    return f"{mean(rows, 'return_norm'):.2f} / {mean(rows, 'avoidable_cost'):.3f}"


def long(rows: list[dict]) -> str:
    fell = mean(rows, "termination_rate")
    told = f"{mean(rows, 'return_mean'):.0f} / {mean(rows, 'cost_mean'):.1f}"
    return told + (f" ({100 * fell:.0f} % fall)" if fell else "")


def barrier() -> str:
    """Ways of fitting a barrier, by what the guard makes of them."""
    head = ("way", "unsafe steps found", "margin", "return", "cost", "95 % interval", "infeasible")
    out = []
    rows = list(csv.DictReader((RESULTS / "tuning" / "barrier.csv").open()))
    for task in dict.fromkeys(r["task"] for r in rows):
        out += [f"`{task}`:", "", "| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
        for r in (r for r in rows if r["task"] == task):
            way = r["way"] if r["guard"] == "margin" else f"{r['way']}, condition `{r['guard']}`"
            if r["guard"] == "future":
                way = f"{r['way']}, last row judged by V"
            part = [way, f"{100 * float(r['recall']):.1f} %", f"{float(r['margin']):.1f}", f"{float(r['return']):.4g}"]
            part += [f"{float(r['cost']):.3g}", f"{float(r['cost_low']):.3g} to {float(r['cost_high']):.3g}"]
            part += [f"{100 * float(r['infeasible'] or 0):.1f} %"]
            out.append("| " + " | ".join(part) + " |")
        out.append("")
    return "\n".join(out).strip()


if __name__ == "__main__":
    main()
