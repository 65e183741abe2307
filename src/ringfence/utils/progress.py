"""Progress of long work: a bar on a terminal, plain lines elsewhere. What is done within other work, or beside it, is
shown by its bar."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, Token, copy_context
from dataclasses import dataclass, field
from typing import Self, TypeVar

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


TRUST = 20.0  # s for which what was expected is believed: a part begins by compiling
SILENT = 4.0  # s after which something is said, however long a step takes

T = TypeVar("T")

_outer: ContextVar[Progress | None] = ContextVar("outer", default=None)
_part: ContextVar[_Part | None] = ContextVar("part", default=None)


@contextmanager
def beside(make: Callable[[], T]) -> Iterator[Callable[[], T]]:
    """While it is open `make` works in a thread of its own. What is given waits for it, and returns what it made; where
    the block fails, it is given up."""
    given_up = threading.Event()

    def run() -> T:
        interrupts.given_up_by.set(given_up)
        return make()

    with ThreadPoolExecutor(1) as pool:
        job = pool.submit(copy_context().run, run)
        try:
            yield job.result
        except BaseException:
            given_up.set()
            raise


class Progress:
    """Counts to `total`; `advance` may carry metrics, of which the telling ones are shown."""

    even = True  # each that is counted takes about as long

    def __init__(self, label: str, total: int, done: int = 0, quiet: bool = False):
        self.label, self.total, self.done = label, total, done
        self.outer = _outer.get()
        self.speaks = not quiet and self.outer is None
        self.terminal = self.speaks and sys.stderr.isatty()
        self.note = ""
        self.started = self.spoke = time.monotonic()

    def __enter__(self) -> Self:
        self.token: Token = _outer.set(self)
        if self.terminal:
            left = (TimeRemainingColumn(),) if self.even else ()
            self.bar = Rich(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                *left,
                TextColumn("{task.fields[note]}"),
                console=Console(stderr=True),
            )
            self.bar.start()
            self.task = self.bar.add_task(self.label, total=self.total, completed=self.done, note="")
        if self.speaks:
            self.over = threading.Event()
            threading.Thread(target=self._beat, daemon=True).start()
        return self

    def __exit__(self, *_) -> None:
        _outer.reset(self.token)
        if self.speaks:
            self.over.set()
        if self.terminal:
            self.bar.stop()

    def advance(self, count: int, metrics: dict[str, float] | None = None) -> None:
        """So many are done; a Ctrl-C that was swallowed is raised here."""
        interrupts.check()
        self.done += count
        self.note = "  ".join(f"{k.split('/')[-1]} {metrics[k]:.3g}" for k in SHOWN if metrics and k in metrics)
        if self.outer is not None:
            self.outer.within(self.label, self.done / max(self.total, 1))
        self._show(self.done >= self.total)

    def within(self, label: str, share: float) -> None:
        """What is done of work within this."""

    def _beat(self) -> None:
        while not self.over.wait(SILENT / 4):
            self._show()

    def _show(self, at_once: bool = False) -> None:
        if self.terminal:
            self.bar.update(self.task, completed=self.done, note=self.note)
        elif self.speaks and (at_once or time.monotonic() - self.spoke > SILENT):
            self.spoke = time.monotonic()
            elapsed = self.spoke - self.started
            line = f"{self.label}: {self.done}/{self.total}, {elapsed:.0f} s  {self.note}\n"
            print(line, end="", file=sys.stderr, flush=True)  # in one piece: two threads speak


@dataclass(eq=False)
class _Part:
    """One that is worked at."""

    name: str
    expected: float  # seconds
    several: int  # stages
    stages: list[str] = field(default_factory=list)  # by their labels
    share: float = 0.0  # that is done

    def told(self, label: str, share: float) -> None:
        """So much of that stage is done."""
        if label not in self.stages:
            self.stages.append(label)
        done = len(self.stages) - 1 + share
        self.share = max(self.share, done / max(self.several, len(self.stages)))


class Parts(Progress):
    """Work in several parts, in per cent, and what is left: by how long each is expected to take, in seconds, and how
    long those took that are done."""

    def __init__(self, label: str, expected: Iterable[tuple[str, float]], quiet: bool = False):
        super().__init__(label, 100, quiet=quiet)
        self.expected = list(expected)  # of what is to be done
        self.seconds: dict[str, float] = {}  # that parts took, by name
        self.finished = 0.0  # expected seconds of what is done
        self.open: list[_Part] = []  # worked at, one beside the other
        self.lock = threading.Lock()

    @contextmanager
    def part(self, name: str, several: int = 1) -> Iterator[None]:
        """While it is open, that part is worked at, which has so many stages."""
        one = _Part(name, self.skip(name), several)
        self.open.append(one)
        token, began = _part.set(one), time.monotonic()
        try:
            yield
        finally:
            _part.reset(token)
            took = time.monotonic() - began
            with self.lock:
                self.seconds[name] = self.seconds.get(name, 0.0) + took
                self.finished += one.expected or took
                self.open.remove(one)
        interrupts.check()
        self._show(at_once=not (self.expected or self.open))

    def skip(self, name: str) -> float:
        """That part need not be done any more; the seconds that it was expected to take, 0 where it was not."""
        with self.lock:
            found = next((k for k, (other, _) in enumerate(self.expected) if other == name), None)
            return 0.0 if found is None else self.expected.pop(found)[1]

    def within(self, label: str, share: float) -> None:
        if (one := _part.get()) is not None:
            one.told(label, share)
        self._show()

    def _show(self, at_once: bool = False) -> None:
        with self.lock:
            done = self.finished + sum(one.share * one.expected for one in self.open)
            rest = sum(seconds for _, seconds in self.expected)
            rest += sum((1.0 - one.share) * one.expected for one in self.open)
            names = " and ".join(one.name for one in self.open)
        spent = time.monotonic() - self.started
        pace = (spent + TRUST) / (done + TRUST)  # seconds of these for one that was expected
        self.done = round(100 * done / max(done + rest, 1e-9))
        left = pace * rest
        words = f"{left:.0f} s" if left < 100 else f"{left / 60:.0f} min"
        self.note = f"{names}, about {words} left" if rest else ""
        super()._show(at_once)
