"""What commands say to a person."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape

from ringfence.errors import UserError, plain

if TYPE_CHECKING:
    from ringfence.training.runs import Run


WIDE = 1000  # columns of what is no terminal: nothing is cut that another program, or a file, is to read


def console() -> Console:
    """Of stdout, as wide as its terminal."""
    terminal = sys.stdout is not None and sys.stdout.isatty()  # None: it was closed
    return Console(highlight=False, width=None if terminal else WIDE)


def complain(message: str) -> None:
    """Say on stderr what is wrong."""
    Console(stderr=True, highlight=False).print(f"[red]error:[/] {escape(message)}", soft_wrap=True)


def plain_warnings() -> None:
    """Have warnings say what they say, and not where in the code."""
    warnings.formatwarning = lambda message, *_, **__: f"warning: {plain(str(message))}\n"


@dataclass
class Refusals:
    """Why runs were refused, so that what several are refused for is said once."""

    runs: dict[str, list[Run]] = field(default_factory=dict)  # by message

    @contextmanager
    def of(self, run: Run) -> Iterator[None]:
        """Note down a refusal of this run and go on."""
        try:
            yield
        except UserError as error:
            self.runs.setdefault(str(error), []).append(run)
