"""Progress of long work: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Rich

from ringfence.utils import interrupts

SHOWN = (
    "loss/denoising",
    "loss/shaping",
    "barrier/data_accuracy_safe",
    "barrier/data_accuracy_unsafe",
    "loss/cloning",
    "loss/critic",
    "loss/actor",
    "value",
)


class Progress:
    """Counts to `total`; `advance` may carry metrics, of which the telling ones are shown."""

    def __init__(self, label: str, total: int, done: int = 0, quiet: bool = False):
        self.label, self.total, self.done, self.quiet = label, total, done, quiet
        self.terminal = sys.stderr.isatty() and not quiet
        self.started = self.spoke = time.monotonic()

    def __enter__(self) -> Progress:
        if self.terminal:
            self.bar = Rich(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
                TextColumn("{task.fields[note]}"),
                console=Console(stderr=True),
            )
            self.bar.start()
            self.task = self.bar.add_task(self.label, total=self.total, completed=self.done, note="")
        return self

    def __exit__(self, *_) -> None:
        if self.terminal:
            self.bar.stop()

    def advance(self, count: int, metrics: dict[str, float] | None = None) -> None:
        interrupts.check()
        self.done += count
        note = "  ".join(f"{k.split('/')[-1]} {metrics[k]:.3g}" for k in SHOWN if metrics and k in metrics)
        if self.terminal:
            self.bar.update(self.task, completed=self.done, note=note)
        elif not self.quiet and (time.monotonic() - self.spoke > 10 or self.done >= self.total):
            self.spoke = time.monotonic()
            elapsed = self.spoke - self.started
            print(f"{self.label}: {self.done}/{self.total}, {elapsed:.0f} s  {note}", file=sys.stderr, flush=True)
