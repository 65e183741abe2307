"""One self-contained HTML page from the files of evaluated runs, or of a whole results folder of the benchmark."""

from __future__ import annotations

from ringfence.errors import needs

with needs("report", "Pages, figures and films"):
    import jinja2  # noqa: F401
    import matplotlib  # noqa: F401
    import PIL  # noqa: F401

from ringfence.report.board_page import build_board
from ringfence.report.export import board_csv, board_latex, board_markdown, board_markdown_short, export_board
from ringfence.report.page import build_report

__all__ = [
    "board_csv",
    "board_latex",
    "board_markdown",
    "board_markdown_short",
    "build_board",
    "build_report",
    "export_board",
]
