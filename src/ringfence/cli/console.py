"""What commands say to a person."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape


def complain(message: str) -> None:
    """Say on stderr what is wrong."""
    Console(stderr=True, highlight=False).print(f"[red]error:[/] {escape(message)}", soft_wrap=True)
