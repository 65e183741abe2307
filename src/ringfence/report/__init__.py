"""One self-contained HTML page from the files of evaluated runs, or of a whole results folder of the benchmark."""

from __future__ import annotations

import importlib

from ringfence.errors import needs

# Loaded on first use: what is no page needs none of the packages that draw.
_WHERE = {
    "board_csv": "export",
    "board_latex": "export",
    "board_markdown": "export",
    "board_markdown_short": "export",
    "build_board": "board_page",
    "build_ope": "logs_pages",
    "build_replay": "logs_pages",
    "build_report": "page",
    "export_board": "export",
}
__all__ = list(_WHERE)


def __getattr__(name: str):
    if name not in _WHERE:
        raise AttributeError(f"module 'ringfence.report' has no attribute '{name}'")
    with needs("report", "Pages, figures and films"):
        return getattr(importlib.import_module(f"ringfence.report.{_WHERE[name]}"), name)
