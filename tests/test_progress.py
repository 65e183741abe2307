"""What long work says of itself: one bar, what is left, and no long silence."""

import threading
import time
import types

import pytest

from ringfence.errors import UserError
from ringfence.training import worlds
from ringfence.utils import progress
from ringfence.utils.progress import Parts, Progress, beside
from tests.quick import QUICK_WORLD


@pytest.fixture
def clock(monkeypatch):
    """A clock that is set by hand; nobody beats meanwhile."""
    clock = types.SimpleNamespace(now=0.0)
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(monotonic=lambda: clock.now))
    monkeypatch.setattr(Progress, "_beat", lambda self: None)
    monkeypatch.setattr(progress, "TRUST", 1e-9)
    return clock


def test_what_is_left_follows_from_what_it_took(clock, capsys):
    """Parts that took twice as long as expected make those ahead take so, too; work within one counts by its share."""
    with Parts("World", [("a", 10.0), ("b", 30.0), ("b", 30.0), ("c", 10.0)]) as bar:
        with bar.part("a"):
            clock.now = 20.0
        assert capsys.readouterr().err == "World: 12/100, 20 s  , about 2 min left\n"
        assert bar.skip("b") == 30.0, "it was there already"
        with bar.part("b"), Progress("critic", 4) as inner:
            clock.now = 50.0
            inner.advance(2)
        assert capsys.readouterr().err == "World: 50/100, 50 s  b, about 50 s left\n"
        with bar.part("unexpected"), bar.part("c"):
            clock.now = 60.0
    assert capsys.readouterr().err == "World: 100/100, 60 s  \n" * 2
    assert bar.seconds == {"a": 20.0, "b": 30.0, "c": 10.0, "unexpected": 10.0}


def test_work_beside_other_work_is_shown_by_the_same_bar(clock, capsys):
    """Both parts count, by what each has done, and what is made comes back; what failed fails where it is asked for."""
    at_half, seen = threading.Event(), threading.Event()

    def make() -> str:
        with bar.part("beside"), Progress("values", 4) as inner:
            inner.advance(2)
            at_half.set()
            assert seen.wait(10)
            inner.advance(2)
        return "made"

    with Parts("World", [("a", 10.0), ("beside", 30.0)]) as bar:
        with beside(make) as made, bar.part("a"):
            assert at_half.wait(10)
            clock.now = 5.0
            bar._show(at_once=True)
            seen.set()
        assert made() == "made"
    assert "World: 38/100, 5 s  " in capsys.readouterr().err
    assert set(bar.seconds) == {"a", "beside"}

    def fails() -> None:
        raise UserError("no")

    with pytest.raises(UserError, match="no"), beside(fails) as failed:
        failed()


def test_what_nobody_waits_for_is_given_up():
    begun, told = threading.Event(), []

    def for_ever() -> None:
        with Progress("values", 10**9, quiet=True) as bar:
            try:
                while True:
                    bar.advance(1)
                    begun.set()
            except KeyboardInterrupt:
                told.append("given up")
                raise

    with pytest.raises(UserError, match="bad"), beside(for_ever):
        assert begun.wait(10)
        raise UserError("bad")
    assert told == ["given up"]


def test_nobody_is_silent_for_long(monkeypatch, capsys):
    monkeypatch.setattr(progress, "SILENT", 0.04)
    with Parts("World", [("search", 1.0)]) as bar, bar.part("search"):
        time.sleep(0.3)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 3 and all(line.startswith("World: ") for line in lines)
    time.sleep(0.1)
    assert not capsys.readouterr().err, "it is over"


def test_a_fit_has_one_bar(small_store, capsys, monkeypatch):
    monkeypatch.setattr(progress, "SILENT", 0.05)
    worlds.fit(small_store, cached=False, quiet=False, **QUICK_WORLD)
    lines = capsys.readouterr().err.splitlines()
    shown = [int(line.split(": ")[1].split("/")[0]) for line in lines]
    assert all(line.startswith(f"World of '{small_store.card.task}': ") for line in lines)
    assert shown == sorted(shown) and shown[-1] == 100 and len(set(shown)) > 2
    worlds.fit(small_store, cached=False, quiet=True, **QUICK_WORLD)
    assert not capsys.readouterr().err
