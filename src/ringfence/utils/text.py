"""Numbers as a person reads them, names in the order in which people count, and where names of strangers become another
language: a terminal's, a spreadsheet's, Markdown's, LaTeX's, a shell's.

HTML is escaped by the page's templates, and figures read no mathematics in names (report/figures.py `STYLE`); `page`
takes what no page can hold out of both.
"""

from __future__ import annotations

import csv
import io
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from ringfence.errors import plain
from ringfence.utils.files import whole

LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "≤": r"$\le$",
    "±": r"$\pm$",
    "–": "--",
    "−": "$-$",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
} | {c: f"\\{c}" for c in "&%$#_{}"}
LATEX |= {c: f"{{{c}}}" for c in "[]*"}  # which `\\` of the row before would read as its own
MARKDOWN = {
    "\\": "\\\\",
    "~": "\\~",
    "$": "\\$",
    "|": "\\|",
    "_": "\\_",
    "*": "\\*",
    "`": "\\`",
    "<": "&lt;",
    ">": "&gt;",
    "&": "&amp;",
    "[": "\\[",
    "]": "\\]",
}
FORMULA = ("=", "+", "-", "@")  # what a spreadsheet computes when a cell begins with it


_DIGITS = re.compile(r"([0-9]+)")
# Controls but for line ends, halves of letters, and what turns the direction of text.
_NO_PAGE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def terminal(value) -> Text:
    """A cell that is shown as it stands: no markup, no control characters."""
    return Text(plain(str(value)))


def lines(text: str) -> Text:
    """Several lines that are shown as they stand."""
    return Text("\n".join(plain(line) for line in text.split("\n")))


def page(text: str) -> str:
    """HTML without what no page can hold, shown as escapes."""
    return _NO_PAGE.sub(lambda found: plain(found[0]), text)


def spreadsheet(value):
    """A cell of CSV that no program takes for a formula; numbers stay numbers."""
    if not isinstance(value, str):
        return value
    value = plain(value)
    return f"'{value}" if value.startswith(FORMULA) else value


def latex(text: str) -> str:
    """Text that LaTeX prints as it stands."""
    return "".join(LATEX.get(c, c) for c in plain(text))


def markdown(text: str) -> str:
    """Text that Markdown shows as it stands, in a table's cell, too."""
    return "".join(MARKDOWN.get(c, c) for c in plain(text))


def shell(word) -> str:
    """One word of a command."""
    return shlex.quote(plain(str(word)))


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> Path:
    """One line for each row, of these columns; what a row lacks is empty, numbers have six digits."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        cells = {name: row.get(name, "") for name in columns}
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else spreadsheet(v) for k, v in cells.items()})
    with whole(path) as temporary:
        temporary.write_text(buffer.getvalue())
    return path


def natural(name: str) -> tuple[list[str | tuple[int, str]], str]:
    """What to sort names by: numbers in them by their value, the rest as text."""
    parts: list[str | tuple[int, str]] = [*_DIGITS.split(name)]
    for k in range(1, len(parts), 2):  # which are digits; of any length, as text
        value = str(parts[k]).lstrip("0")
        parts[k] = len(value), value
    return parts, name


def numbered(column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different names of a column (M,), numbers by value and text in natural order, and (M,) whose is each row."""
    names, owner = np.unique(column, return_inverse=True)
    if names.dtype.kind not in "UO":
        return names, owner
    order = sorted(range(len(names)), key=lambda k: natural(str(names[k])))
    return names[order], np.argsort(order)[owner]


def significant(x: float, digits: int = 2) -> str:
    """So many significant digits, without an exponent where a number is a usual one: 100 and not 1e+02."""
    return f"{float(f'{x:.{digits}g}'):g}"


def percent(share: float, digits: int = 2) -> str:
    """A share as a percentage."""
    return f"{significant(100 * share, digits)} %"
