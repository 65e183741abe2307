"""The table of a results folder: one row per evaluation, traceable to its run folder; and one line per method."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from ringfence import stats
from ringfence.bench.cells import read_about
from ringfence.errors import UserError
from ringfence.files import whole
from ringfence.runs import Run, read_json

COLUMNS = (
    "task, algorithm, variant, seed, episodes, return_mean, return_std, return_norm, cost_mean, cost_norm, "
    "avoidable_cost, violation_rate, violation_upper, unsafe_starts, cost_cvar10, train_seconds, eval_seconds, "
    "plan_ms_p50, plan_ms_p99, parameters, run"
).split(", ")


def rows(out: str | Path) -> list[dict]:
    """Every evaluation of every cell, and the reference rows; mixed protocols are refused, naming the files."""
    out = Path(out)
    about = read_about(out)
    found, constants = [], {}
    for file in sorted((out / "reference").glob("*/reference.json")):
        for name, r in read_json(file, "is damaged; delete it").items():
            found.append({**r, "algorithm": name, "variant": "reference", "seed": 0, "run": str(file.relative_to(out))})
    for file in sorted((out / "cells").glob("*/*/*/results.json")):
        run = Run(file.parent)
        for r in run.results.values():
            if r["split"] != about["split"]:
                continue  # settings were chosen there; no table is made of it
            for name in ("protocol", "episodes"):
                if r[name] != about[name]:
                    raise UserError(
                        f"'{file}' has {name}={r[name]}, '{out / 'bench.json'}' {about[name]}; one table takes one "
                        "protocol: evaluate that run again or move it away."
                    )
            first = constants.setdefault(r["task"], (file, r["constants"]))
            if first[1] != r["constants"]:
                raise UserError(f"'{file}' and '{first[0]}' normalise {r['task']} differently; evaluate one again.")
            found.append({**r, "run": str(file.parent.relative_to(out))})
    if not any(r["variant"] != "reference" for r in found):
        raise UserError(f"'{out}' holds no finished cell yet; run `ringfence bench`.")
    return found


def write_csv(out: str | Path) -> Path:
    """DIR/table.csv, one line per row of `rows`."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for r in rows(out):
        writer.writerow({k: f"{v:.6g}" if isinstance(v := r.get(k, ""), float) else v for k in COLUMNS})
    path = Path(out) / "table.csv"
    with whole(path) as temporary:
        temporary.write_text(buffer.getvalue())
    return path


def summaries(found: list[dict], task: str) -> list[dict]:
    """One line per method of a task, best first: safe within the limit, then return (stats.rank)."""
    methods: dict[tuple[str, str], list[dict]] = {}
    for r in found:
        if r["task"] == task:
            methods.setdefault((r["algorithm"], r["variant"]), []).append(r)
    lines = []
    for (algorithm, variant), some in methods.items():
        violations = sum(round(r["violation_rate"] * r["episodes"]) for r in some)
        each = [r.get("per_episode", {}) for r in some]
        interval = {}
        if all(each):
            seeds = np.repeat(np.arange(len(each)), [len(e["return"]) for e in each])
            for name in ("return", "cost"):
                interval[name] = stats.bootstrap_mean(np.concatenate([e[name] for e in each]), strata=seeds)
        lines.append(
            {
                "algorithm": algorithm,
                "variant": variant,
                "seeds": len(some),
                "episodes": sum(r["episodes"] for r in some),
                "return": float(np.mean([r["return_mean"] for r in some])),
                "return_sd": float(np.std([r["return_mean"] for r in some])),
                "return_norm": float(np.mean([r["return_norm"] for r in some])),
                "return_interval": interval.get("return", some[0]["return_interval"]),
                "cost": float(np.mean([r["cost_mean"] for r in some])),
                "cost_interval": interval.get("cost", some[0]["cost_interval"]),
                "avoidable": float(np.mean([r["avoidable_cost"] for r in some])),
                "violations": violations / sum(r["episodes"] for r in some),
                "violations_upper": stats.upper_bound(violations, sum(r["episodes"] for r in some)),
                "limit": some[0]["constants"]["cost_limit"],
                "train_seconds": float(np.mean([r["train_seconds"] for r in some]))
                if "train_seconds" in some[0]
                else None,
                "runs": [r["run"] for r in some],
            }
        )
    order = stats.rank([x["return"] for x in lines], [x["cost"] for x in lines], lines[0]["limit"])
    return [lines[i] for i in order]


HEADER = ("method", "variant", "seeds", "return", "normalised", "cost", "avoidable", "unsafe episodes", "within limit")


def cells_of(line: dict) -> tuple[str, ...]:
    """A summary as text, one string per column of HEADER."""
    low, high = line["return_interval"]
    return (
        line["algorithm"],
        line["variant"],
        str(line["seeds"]),
        f"{line['return']:.1f} ± {line['return_sd']:.1f} [{low:.1f}, {high:.1f}]",
        f"{line['return_norm']:.3f}",
        f"{line['cost']:.3f} [{line['cost_interval'][0]:.3f}, {line['cost_interval'][1]:.3f}]",
        f"{line['avoidable']:.4f}",
        f"{100 * line['violations']:.1f} % (≤ {100 * line['violations_upper']:.1f} %)",
        "yes" if line["cost"] <= line["limit"] else "no",
    )


def markdown(out: str | Path) -> str:
    """All tables of a results folder, ranked, in Markdown."""
    found, parts = rows(out), []
    for task in sorted({r["task"] for r in found}):
        c = next(r["constants"] for r in found if r["task"] == task)
        parts.append(
            f"### {task}\n\nCost limit {c['cost_limit']:g} per episode; return normalised with "
            f"{c['return_min']:g} → {c['return_max']:g}.\n"
        )
        lines = [HEADER, ("---",) * len(HEADER), *(cells_of(s) for s in summaries(found, task))]
        parts.append("\n".join("| " + " | ".join(x) + " |" for x in lines) + "\n")
    return "\n".join(parts)


def latex(out: str | Path) -> str:
    """The same as booktabs tables; the best return within the limit is bold."""
    escape = lambda s: s.replace("%", r"\%").replace("_", r"\_").replace("±", r"$\pm$").replace("≤", r"$\le$")  # noqa: E731
    found, parts = rows(out), []
    for task in sorted({r["task"] for r in found}):
        body, best = [], True
        for s in summaries(found, task):
            text = [escape(x) for x in cells_of(s)]
            if best and s["cost"] <= s["limit"] and s["variant"] != "reference":
                text[3], best = rf"\textbf{{{text[3]}}}", False
            body.append(" & ".join(text) + r" \\")
        parts.append(
            "\n".join(
                [
                    rf"% {task}",
                    rf"\begin{{tabular}}{{ll{'r' * (len(HEADER) - 2)}}}",
                    r"\toprule",
                    " & ".join(HEADER) + r" \\",
                    r"\midrule",
                    *body,
                    r"\bottomrule",
                    r"\end{tabular}",
                ]
            )
        )
    return "\n\n".join(parts) + "\n"
