"""Where names of strangers become another language: a terminal's, a spreadsheet's, Markdown's, LaTeX's, a shell's.

HTML is escaped by the page's templates, and figures read no mathematics in names (report/figures.py `STYLE`).
"""

from __future__ import annotations

import shlex

from rich.text import Text

from ringfence.errors import plain

LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "≤": r"$\le$",
    "±": r"$\pm$",
    "–": "--",
    "−": "$-$",
} | {c: f"\\{c}" for c in "&%$#_{}"}
MARKDOWN = {
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


def terminal(value) -> Text:
    """A cell that is shown as it stands: no markup, no control characters."""
    return Text(plain(str(value)))


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
