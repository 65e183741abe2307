"""The leaderboard as text for other programs: CSV, LaTeX (booktabs) and Markdown, whole or short."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ringfence.errors import one_of, plain
from ringfence.report import html
from ringfence.report.board import Board, rankings, read, short
from ringfence.report.html import share
from ringfence.report.table import Line, Method
from ringfence.utils.text import latex, markdown, spreadsheet

# What CSV says of a line that was measured; intervals and the bound are 95 %, numbers per episode.
NUMBERS: dict[str, Callable[[Line], Any]] = {
    "within_limit": lambda r: int(r.safe),
    "best": lambda r: "" if r.reference else int(r.best),
    "return_mean": lambda r: r.returns,
    "return_sd": lambda r: r.returns_sd,
    "return_low": lambda r: r.returns_interval[0],
    "return_high": lambda r: r.returns_interval[1],
    "return_norm": lambda r: r.returns_norm,
    "cost_mean": lambda r: r.cost,
    "cost_sd": lambda r: r.cost_sd,
    "cost_low": lambda r: r.cost_interval[0],
    "cost_high": lambda r: r.cost_interval[1],
    "cost_norm": lambda r: r.cost_norm,
    "cost_safe_start": lambda r: r.cost_safe_start,
    "cost_safe_start_low": lambda r: r.cost_safe_start_interval[0],
    "cost_safe_start_high": lambda r: r.cost_safe_start_interval[1],
    "unsafe_episodes": lambda r: r.violation_rate,
    "unsafe_upper": lambda r: r.violation_upper,
    "ended_early": lambda r: r.ended,
    "steps_mean": lambda r: r.steps,
    "seeds": lambda r: "" if r.reference else len(r.seeds),
    "episodes": lambda r: r.episodes,
    "train_seconds": lambda r: r.train_seconds,
    "plan_ms_p50": lambda r: r.plan_ms,
    "parameters": lambda r: r.parameters,
}
COLUMNS = ("suite", "task", "algorithm", "preset", "variant", "method", "rank", *NUMBERS)


def export_board(folder: str | Path, form: str, out: str | Path) -> Path:
    """Write the leaderboard of a results folder to the file `out`; `form` is a name in FORMS."""
    exported = one_of("format", form, FORMS)
    return html.write(Path(out), exported(read(folder)))


def _rows(board: Board) -> dict[str, list[Line | Method]]:
    """By task: lines by rank, then the methods that were not measured on it, then the references."""
    absent = {t: [m for m in board.methods if not board.line(t, m)] for t in board.tasks}
    return {t: [*board.lines[t], *absent[t], *each.references] for t, each in board.sections.items()}


# --- CSV ---


def board_csv(board: Board) -> str:
    """One line per task and method, references included; full precision to six digits."""
    file = io.StringIO()
    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for task, rows in _rows(board).items():
        for row in rows:
            values = {"suite": board.suite, "task": task, "method": row.label} | _names(row)
            values |= {k: f(row) for k, f in NUMBERS.items()} if isinstance(row, Line) else {"seeds": 0}
            writer.writerow({k: spreadsheet(f"{v:.6g}" if isinstance(v, float) else v) for k, v in values.items()})
    return file.getvalue()


def _names(row: Line | Method) -> dict[str, Any]:
    method = row.method if isinstance(row, Line) else row
    if method is None:
        return {"variant": "reference"}
    names = {"algorithm": method.algorithm, "preset": method.preset, "variant": method.variant}
    return names | ({"rank": row.rank} if isinstance(row, Line) else {})


# --- LaTeX ---

HEAD = r"Method & Return & Norm.\ return & Cost & Cost of safe starts & Unsafe episodes (\%) & Seeds \\"


def board_latex(board: Board) -> str:
    """A booktabs `tabular` per task: ± is the deviation between seeds, bold the best within the limit, † over it."""
    lines = ["% needs \\usepackage{booktabs}"]
    for task, rows in _rows(board).items():
        c = board.sections[task].constants
        limit = f", cost limit {c['cost_limit']:g} per episode" if c else ""
        lines += [
            "",
            f"% {plain(task)}{limit}, {board.episodes} {board.split} episodes per seed, protocol {board.protocol}",
            "% bold: the highest return within the limit; dagger: over the limit; in brackets: exact 95 % upper bound",
            r"\begin{tabular}{lrrrrrr}",
            r"\toprule",
            HEAD,
            r"\midrule",
        ]
        between = False
        for r in rows:
            if isinstance(r, Line) and r.reference and not between:
                between = True
                lines.append(r"\midrule")
            lines.append(_latex(r))
        lines += [r"\bottomrule", r"\end{tabular}"]
    return "\n".join(lines) + "\n"


def _latex(r: Line | Method) -> str:
    name = latex(r.label)
    if isinstance(r, Method):
        return " & ".join([name, *["--"] * 5, "0"]) + r" \\"
    returns = _pm(r.returns, r.returns_sd, 1, r"\pm")
    norm = _pm(r.returns_norm, r.returns_norm_sd, 2, r"\pm")
    cost = _pm(r.cost, r.cost_sd, 2, r"\pm") + ("" if r.safe else r"^{\dagger}")
    cells = [returns, norm, cost, f"{r.cost_safe_start:.3f}"]
    cells += [rf"{100 * r.violation_rate:.1f}\;({100 * r.violation_upper:.1f})"]
    if r.best:
        name = rf"\textbf{{{name}}}"
        cells = [rf"\mathbf{{{c}}}" for c in cells]
    return " & ".join([name, *(f"${c}$" for c in cells), str(len(r.seeds)) if r.method else "--"]) + r" \\"


def _pm(value: float, deviation: float | None, digits: int, sign: str) -> str:
    text = f"{value:.{digits}f}"
    return text if deviation is None else f"{text} {sign} {deviation:.{digits}f}"


# --- Markdown ---


def board_markdown(board: Board) -> str:
    """A table per task with every column of the page that is a number."""
    head = ["method", "rank", "return", "norm. return", "cost", "cost of safe starts", "unsafe episodes", "seeds"]
    head += ["training s", "plan ms", "parameters"]
    blocks = []
    for task, rows in _rows(board).items():
        c = board.sections[task].constants
        ends = any(isinstance(r, Line) and r.ended for r in rows)
        columns = [*head, "ended early"] if ends else head
        facts = (
            f", cost limit {c['cost_limit']:g}, normalised with {c['return_min']:g} → {c['return_max']:g}" if c else ""
        )
        blocks.append(f"**{markdown(task)}**{facts}\n\n" + _table(columns, [_markdown(r, board, ends) for r in rows]))
    return "\n\n".join([*blocks, "± standard deviation between seeds. " + _legend(board)]) + "\n"


def board_markdown_short(board: Board) -> str:
    """One table per protocol, methods by tasks: normalised return and the cost of safe starts, by mean rank."""
    rows_to_beat = {task: each.references for task, each in board.sections.items()}
    blocks = []
    for ranking in rankings(board):
        head = ["norm. return (cost of safe starts)", *(short(t, board.suite) for t in ranking.tasks), "mean rank"]
        rows = []
        names = dict.fromkeys(r.name for t in ranking.tasks for r in rows_to_beat[t])
        for name in names:
            cells = [next((r for r in rows_to_beat[t] if r.name == name), None) for t in ranking.tasks]
            rows.append([name, *(_brief(r, 0) for r in cells), "–"])
        for row in ranking.rows:
            mean = "–" if row.mean is None else f"{row.mean:.2f}"
            cells = (_brief(cell, len(board.seeds)) for cell in row.cells)
            rows.append([row.line.label, *cells, mean])
        blocks.append(_table(head, rows))
    return "\n\n".join([*blocks, _legend(board)]) + "\n"


def _markdown(r: Line | Method, board: Board, ends: bool) -> list[str]:
    if isinstance(r, Method):
        blank = ["–"] * (4 if ends else 3)
        return [r.label, "–", "not measured", *["–"] * 4, f"0 of {len(board.seeds)}", *blank]
    returns = _pm(r.returns, r.returns_sd, 1, "±")
    norm = _pm(r.returns_norm, r.returns_norm_sd, 3, "±")
    several = f"{len(r.seeds)}" if len(r.seeds) == len(board.seeds) else f"{len(r.seeds)} of {len(board.seeds)}"
    return [
        r.label,
        str(r.rank or "–"),
        f"**{returns}**" if r.best else returns,
        norm,
        _pm(r.cost, r.cost_sd, 3, "±") + ("" if r.safe else " †"),
        f"{r.cost_safe_start:.3f} ({r.cost_safe_start_interval[0]:.3f} to {r.cost_safe_start_interval[1]:.3f})",
        f"{share(r.violation_rate)} (≤ {share(r.violation_upper)})",
        several if r.method else "–",
        "–" if r.train_seconds is None else f"{r.train_seconds:,.0f}",
        "–" if r.plan_ms is None else f"{r.plan_ms:.1f}",
        "–" if r.parameters is None else f"{r.parameters:,}",
        *(["–" if r.ended is None else share(r.ended)] if ends else []),
    ]


def _brief(r: Line | None, most: int) -> str:
    """`most`: seeds of a whole row; fewer are said."""
    if r is None:
        return "not measured"
    text = f"{r.returns_norm:.2f} ({r.cost_safe_start:.3f})" + ("" if r.safe else " †")
    text += f" [{len(r.seeds)}]" if r.method and len(r.seeds) < most else ""
    return f"**{text}**" if r.best else text


def _legend(board: Board) -> str:
    return (
        "**Bold**: the highest return within the cost limit; †: over the limit, which the upper end of the cost's 95 % "
        "interval decides; [n]: fewer seeds than the others. "
        f"{board.episodes} {board.split} episodes per seed, protocol {board.protocol}."
    )


def _table(head: list[str], rows: list[list[str]]) -> str:
    """The first cell of a row is a name."""
    lines = [[markdown(h) for h in head], ["---"] + ["---:"] * (len(head) - 1)]
    lines += [[markdown(name), *cells] for name, *cells in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


FORMS = {
    "csv": board_csv,
    "latex": board_latex,
    "markdown": board_markdown,
    "markdown-short": board_markdown_short,
}
