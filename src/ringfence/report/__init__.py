"""One self-contained HTML page from the files of evaluated runs."""

from __future__ import annotations

from ringfence.report.page import build_report

__all__ = ["build_report"]
