"""Values from strangers that are no files: arrays, costs, tables, simulators and words of every wrong kind.

`benchmarks/hostile.py` tries all of it. Each case says what was done, how to read it, and whether what was taken is
what it says: kinds that are numbers after all (flags, half precision, lists) may be taken, if they keep their value.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import re
import shlex
import shutil
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.logs.store import EpisodeStore

Case = tuple[str, Callable[[], Any], Callable[[Any], bool]]

ARRAYS: dict[str, Callable[[np.ndarray], Any]] = {
    "as it is": lambda x: x,
    "big-endian": lambda x: x.astype(">f4"),
    "half precision": lambda x: x.astype(np.float16),
    "long double": lambda x: x.astype(np.longdouble),
    "lists": lambda x: x.tolist(),
    "read only": lambda x: np.frombuffer(x.tobytes(), x.dtype).reshape(x.shape),
    "backwards in memory": lambda x: x[::-1].copy()[::-1],
    "flags": lambda x: x > 0,
    "whole numbers": lambda x: np.round(x).astype(np.int64),
    "NaN": lambda x: x * np.nan,
    "one NaN": lambda x: np.where(np.arange(x.size).reshape(x.shape) == x.size - 1, np.nan, x),
    "infinite": lambda x: x + np.inf,
    "1e300": lambda x: x.astype(np.float64) + 1e300,
    "-1e300": lambda x: x.astype(np.float64) - 1e300,
    "1e30": lambda x: x.astype(np.float64) * 0 + 1e30,
    "2**70": lambda x: np.full(x.shape, 2**70, object),
    "400 digits": lambda x: np.full(x.shape, 10**400, object),
    "masked": lambda x: np.ma.masked_array(x, np.abs(x) >= 0),
    "one masked": lambda x: np.ma.masked_array(x, np.arange(x.size).reshape(x.shape) == 0),
    "complex": lambda x: x.astype(complex),
    "words": lambda x: x.astype(str),
    "bytes": lambda x: x.astype("S8"),
    "objects": lambda x: x.astype(object),
    "None inside": lambda x: np.full(x.shape, None),
    "dates": lambda x: x.astype("datetime64[s]"),
    "durations": lambda x: x.astype("timedelta64[s]"),
    "NaT": lambda x: np.full(x.shape, np.datetime64("NaT", "s")),
    "records": lambda x: np.zeros(x.shape, [("a", "f4"), ("b", "i4")]),
    "flat": lambda x: x.ravel(),
    "one axis more": lambda x: x[None],
    "one axis less": lambda x: x[0],
    "transposed": lambda x: np.concatenate([x, x[:1]]).T,
    "shorter": lambda x: x[:-1],
    "longer": lambda x: np.concatenate([x, x[:1]]),
    "narrower": lambda x: x[..., :-1],
    "wider": lambda x: np.concatenate([x, x[..., :1]], -1),
    "empty": lambda x: x[:0],
    "no entries": lambda x: x[..., :0],
    "ragged": lambda x: [x[0].tolist(), x[1].tolist()[:-1]],
    "None": lambda x: None,
    "a word": lambda x: "observations",
    "a number": lambda x: 3.0,
    "a dictionary": lambda x: {"a": x},
    "a set": lambda x: {1.0, 2.0},
    "a generator": lambda x: (row for row in x),
    "a function": lambda x: len,
    "a class": lambda x: np.ndarray,
    "an array of arrays": lambda x: np.array([x, None], object),
}

NUMBERS: list[Any] = [
    True, 0, 1, -1, 2.5, -0.0, 1e-320, 1e30, 1e300, -1e300, float("nan"), float("inf"), -float("inf"), 2**70, 10**400,
    1j, "1", "free", "", b"1", None, [], [1.0], [1.0, 2.0], [1.0, 2.0, 3.0], {}, {"zz": 1.0}, {"a": "x"}, {"a": -1.0},
    {"a": None}, {3: 1.0}, {"a": {"b": 1.0}}, np.float16(1), np.int8(1), np.bool_(True), np.float32("nan"),
    np.array(1.0), np.array([1.0, -1.0]), np.ma.masked, np.datetime64("NaT"), np.timedelta64(1, "s"), np.array("x"),
    np.array(None), object(), len, float, (), (1.0,), np.zeros((2, 1)), np.zeros(0),
]  # fmt: skip

WORDS = [
    "", " ", ".", "..", "../../x", "/etc/passwd", "a/b", "a\\b", "a\nb", "a\r\nb", "a\0b", "\x1b[31mred",
    "\x1b]0;t\x07", "\x9b31m", "\u202etxt", "\ud800", "\ufeff", "x" * 300, "x" * 70_000, "'", '"', "`z`", "$(z)",
    "${HOME}", "x; touch y", "x && touch y", "x | touch y", "x > y", "x\ntouch y", "-x", "--help", "=1+1", "+1", "@x",
    "|x|", "[x](y)", "![x](y)", "<script>alert(1)</script>", "<img src=x onerror=y>", "&lt;", "%00", "%s%n", "{x}",
    "{0}", "{{x}}", "[red]", "[/]", "$x^$", "\\input{x}", "~~x~~", "*x*", "# x", "[2cm]", "\\\\", "é", "日本", "🤖",
    "nan", "None", "null", "true", "1e999",
]  # fmt: skip


def plain_number(value: Any) -> float | None:
    """What a value is as a finite number, if it is one."""
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        array = np.asarray(value)
        if not np.ma.is_masked(value) and array.dtype.kind in "biuf" and np.isfinite(array).all() and array.size:
            return float(array.max())
    return None


def same_numbers(given: Any, kept: np.ndarray) -> bool:
    """Whether an array of plain numbers is the one that was given, to single precision."""
    if np.ma.is_masked(given):
        return False
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        array = np.asarray(given)
        if array.dtype.kind in "biuf" and array.shape == kept.shape and np.isfinite(kept).all():
            return bool(np.allclose(array.astype(np.float64), kept, rtol=1e-2, atol=1e-2))  # half precision among them
    return False


# --- what a guard is given ---
def at_run_time(controllers: dict[str, Callable[[], Any]], good: np.ndarray) -> Iterator[Case]:
    """Observations, costs, ages and states for controllers of agents without a state, of constraints a and b."""
    for whose, make in controllers.items():
        for kind, spoil in ARRAYS.items():
            given = spoil(good)

            def act(make=make, spoil=spoil):
                action = make().act(spoil(good))
                return action

            def sound(action, given=given):
                return same_numbers(given, good) or _benign(given, good.shape) and np.isfinite(action).all()

            yield f"{whose}: observations {kind}", act, sound
            state = _one(spoil, good[0])
            yield f"{whose}: a state {kind}", lambda make=make, state=state: make().act(good, state), _action
        for cost in NUMBERS:
            said = _short(cost)
            named = {"a": cost, "b": 0.0}
            yield f"{whose}: cost {said}", lambda make=make, c=cost: _paid(make(), good, c), _cost_is(cost)
            yield f"{whose}: cost of a {said}", lambda make=make, c=named: _paid(make(), good, c), _cost_is(named)
            yield f"{whose}: age {said}", lambda make=make, age=cost: make().act(good, age=age), _nothing(cost)


def of_functions(guarded: Callable[[Callable], Any], good: np.ndarray, actions: np.ndarray) -> Iterator[Case]:
    """Actions of a function under guard."""
    for kind, spoil in ARRAYS.items():
        given = spoil(actions)

        def act(given=given):
            return guarded(lambda observations, state: given).act(good)

        yield f"a function's actions {kind}", act, lambda found, g=given: _benign(g, actions.shape) and _action(found)
    for word in ("raises", "returns itself", "writes"):

        def function(observations, state, word=word):
            if word == "raises":
                raise ValueError("of the user's own")
            observations[:] = np.nan
            return observations[:, :2] if word == "returns itself" else actions

        def act(function=function, word=word):
            try:
                return guarded(function).act(good)
            except ValueError as error:
                if word == "raises" and str(error) == "of the user's own":  # it comes through as it is
                    return actions
                raise

        yield f"a function that {word}", act, lambda found: found is not None and _action(found)


def _benign(given: Any, shape: tuple[int, ...]) -> bool:
    """Whether an array is of finite numbers and of that shape, so that it may be taken."""
    if np.ma.is_masked(given):
        return False
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        array = np.asarray(given)
        with np.errstate(over="ignore"):
            return array.shape == shape and array.dtype.kind in "biuf" and np.isfinite(array.astype(np.float32)).all()
    return False


def _action(found: Any) -> bool:
    return isinstance(found, np.ndarray) and found.dtype == np.float32 and bool((np.abs(found) <= 1).all())


def _paid(controller: Any, good: np.ndarray, cost: Any) -> np.ndarray:
    controller.act(good)
    return controller.act(good, cost=cost)


def _cost_is(cost: Any) -> Callable[[Any], bool]:
    """A cost that was taken was none, one number of 0 or more, or one of each of the two agents."""
    costs = list(cost.values()) if isinstance(cost, dict) else [cost]
    known = all(plain_number(one) is not None and np.min(one) >= 0 and np.size(one) in (1, 2) for one in costs)
    return lambda found: _action(found) and (cost is None or (bool(costs) and known))


def _nothing(age: Any) -> Callable[[Any], bool]:
    """A guard that makes good for no age takes none."""
    return lambda found: age is None and _action(found)


def _short(value: Any) -> str:
    said = "a large number" if isinstance(value, int) and value > 10**9 else repr(value)
    return re.sub(r"0x[0-9a-f]+", "0x", said)[:40]


# --- arrays that become a store ---
def few_episodes(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Four episodes of five steps: what every store holds."""
    return {
        "observations": rng.normal(size=(4, 6, 2, 3)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (4, 5, 2, 2)).astype(np.float32),
        "rewards": rng.normal(size=(4, 5, 2)).astype(np.float32),
        "costs": (rng.random((4, 5, 2)) < 0.2).astype(np.float32),
    }


def arrays_of_stores() -> Iterator[Case]:
    """Every array of every way of making one, of every kind."""
    rng = np.random.default_rng(0)
    episodes = few_episodes(rng) | {
        "state": rng.normal(size=(4, 6, 3)).astype(np.float32),
        "terminated": np.array([True, False, True, False]),
    }
    steps = {
        "observations": episodes["observations"][:, :5].reshape(20, 2, 3),
        "actions": episodes["actions"].reshape(20, 2, 2),
        "rewards": episodes["rewards"].reshape(20, 2),
        "costs": episodes["costs"].reshape(20, 2),
        "episode_ends": np.arange(1, 5) * 5,
        "final_observations": episodes["observations"][:, 5],
        "speed": rng.random(20).astype(np.float32),
    }
    made = EpisodeStore.from_episodes(**{k: v for k, v in episodes.items() if k != "state"})
    names = ("observations", "actions", "rewards", "costs", "terminated", "truncated", "episode_ends")
    whole = {name: getattr(made, name) for name in names}
    for way, make, arrays in (
        ("from_episodes", EpisodeStore.from_episodes, episodes),
        ("from_steps", EpisodeStore.from_steps, steps),
        ("EpisodeStore", EpisodeStore, whole),
    ):
        for name, array in arrays.items():
            for kind, spoil in ARRAYS.items():
                given = _one(spoil, array)
                optional = name in ("state", "terminated", "speed", "costs") and way != "EpisodeStore"
                left_out = given is None and optional
                by_name = kind == "a dictionary" and name == "costs" and way != "EpisodeStore"
                taken = None if left_out else array if by_name else given
                if isinstance(given, Iterator):
                    continue  # it is used up by the first who looks

                def make_it(make=make, arrays=arrays, name=name, given=given):
                    return make(**{**arrays, name: given})

                def sound(store, name=name, taken=taken):
                    return _kept(store, name, taken)

                yield f"{way} {name} {kind}", make_it, sound


def _kept(store: EpisodeStore, name: str, given: Any) -> bool:
    """Whether a store's array holds what was given, in plain numbers."""
    if given is None:
        return True
    if np.ma.is_masked(given):
        return False
    array = np.asarray(given)
    if array.dtype.kind not in "biuf":
        return False
    kept = getattr(store, "observations" if name == "final_observations" else name)
    if kept.dtype.kind not in "biuf" or not kept.dtype.isnative or not np.isfinite(kept.astype(float)).all():
        return False
    if name in ("observations", "final_observations", "state", "terminated", "episode_ends"):
        return True  # rows are put together with others
    return array.size == kept.size or array.size * store.n_agents == kept.size


# --- simulators ---
class Simulator:
    """Two agents for four steps; `odd` says what one of its answers is instead."""

    possible_agents = ["a", "b"]

    def __init__(self, odd: dict[str, Any] | None = None):
        self.odd = odd or {}

    def action_space(self, agent):
        from gymnasium.spaces import Box

        return self.odd.get("action_space", Box(-1.0, 1.0, (2,)))

    def observation_space(self, agent):
        return None

    def reset(self, seed=None, options=None):
        self.t = 0
        seen = {"a": np.zeros(3), "b": np.ones(3)}
        return self.odd.get("reset", ({**seen, **self.odd.get("first", {})}, {}))

    def step(self, actions):
        self.t += 1
        odd = self.odd if self.t == 2 else {}
        over = {agent: self.t == 4 for agent in "ab"}
        return (
            odd["step"]
            if "step" in odd
            else (
                odd.get("observations", {agent: np.full(3, float(self.t)) for agent in "ab"}),
                odd.get("rewards", dict.fromkeys("ab", 1.0)),
                odd.get("terminations", over),
                odd.get("truncations", dict.fromkeys("ab", False)),
                odd.get("infos", {agent: {"cost": 1.0} for agent in "ab"}),
            )
        )


def simulators(collect: Callable[..., EpisodeStore]) -> Iterator[Case]:
    """Answers of a simulator that are of another kind."""
    good = np.zeros(3, np.float32)
    for kind, spoil in ARRAYS.items():
        for place in ("first", "observations"):
            odd = {place: {"a": spoil(np.stack([good, good]))[0] if kind == "one axis less" else _one(spoil, good)}}
            odd[place]["b"] = good
            yield (
                f"a simulator's {place} {kind}",
                lambda odd=odd: collect(lambda: Simulator(odd), episodes=1),
                lambda store, given=odd[place]["a"]: _benign(given, (3,)) and store.steps == 4,
            )
    for value in NUMBERS:
        for place in ("rewards", "terminations", "truncations"):
            odd = {place: {"a": value, "b": 1.0 if place == "rewards" else False}}
            yield (
                f"a simulator's {place} {_short(value)}",
                lambda odd=odd: collect(lambda: Simulator(odd), episodes=1),
                lambda store, place=place, value=value: _answer_kept(store, place, value),
            )
        odd = {"infos": {"a": {"cost": value}, "b": {"cost": 1.0}}}
        yield (
            f"a simulator's cost {_short(value)}",
            lambda odd=odd: collect(lambda: Simulator(odd), episodes=1),
            lambda store, value=value: plain_number(value) is not None and np.min(value) >= 0 or value is None,
        )
        for place in ("reset", "step", "observations", "rewards", "terminations", "infos", "action_space"):
            if value is None or not np.any(np.size(value)):
                continue
            # An agent that flags and infos do not name has none.
            ignored = isinstance(value, dict) and (place == "terminations" or _of_nobody(value)) and place != "rewards"
            yield (
                f"a simulator whose {place} is {_short(value)}",
                lambda odd={place: value}: collect(lambda: Simulator(odd), episodes=1),
                lambda store, ignored=ignored: ignored,
            )


def _one(spoil: Callable, good: np.ndarray) -> Any:
    with contextlib.suppress(Exception):
        return spoil(good)
    return "no such array"


def _of_nobody(infos: dict) -> bool:
    return all(info is None or isinstance(info, dict) for agent, info in infos.items() if agent in ("a", "b"))


def _answer_kept(store: EpisodeStore, place: str, value: Any) -> bool:
    if place == "rewards":
        number = plain_number(value)
        return number is not None and np.size(value) == 1 and abs(store.rewards[1, 0] - number) <= 1e-6 * abs(number)
    return plain_number(value) in (0.0, 1.0) or value is None


# --- tables ---
def columns(**instead: Any) -> dict[str, Any]:
    """A table of two agents, with some columns in place of its own."""
    times = np.tile(np.arange(20) * 0.1, 2)
    base = {"t": times, "id": np.repeat([0, 1], 20), "run": np.zeros(40, int), "x": np.sin(times), "y": times}
    return base | {"hit": np.zeros(40)} | instead


def tabled(table: Any, **options: Any) -> EpisodeStore:
    given = {"time": "t", "agent": "id", "episode": "run", "state": ["x", "y"], "cost": "hit"} | options
    return EpisodeStore.from_table(table, **given)


def tables() -> Iterator[Case]:
    """Columns, and options, of every kind."""
    import pandas as pd

    for name, column in columns().items():
        for kind, spoil in ARRAYS.items():
            given = _one(spoil, np.asarray(column))
            words = name in ("id", "run")
            yield (
                f"a table whose {name} is {kind}",
                lambda name=name, given=given: tabled(columns(**{name: given})),
                lambda store, given=given, words=words: _column_kept(given, words),
            )

            def framed(name=name, given=given):
                return tabled(pd.DataFrame(columns(**{name: given})))

            if isinstance(given, np.ndarray) and given.ndim == 1 and len(given) == 40 and not np.ma.is_masked(given):
                yield f"a frame whose {name} is {kind}", framed, lambda _, g=given, w=words: _column_kept(g, w)
    junk: list[Any] = [*NUMBERS[:30], *WORDS[:12], ["x"], ["x", "x"], [["x"]], lambda: 0]
    for option in ("dt", "gap", "team", "neighbours", "sensing_radius", "min_episode_steps", "max_episode_steps"):
        for value in junk:
            yield f"{option}={_short(value)}", lambda o=option, v=value: tabled(columns(), **{o: v}), _is_store
    for option in (
        "max_speed",
        "time",
        "agent",
        "episode",
        "state",
        "action",
        "reward",
        "cost",
        "goal",
        "wide",
        "danger",
    ):
        for value in junk:
            yield f"{option}={_short(value)}", lambda o=option, v=value: tabled(columns(), **{o: v}), _is_store
    for value in junk:
        yield f"rename={_short(value)}", lambda v=value: tabled(columns(), rename=v), _is_store
        yield f"rename x={_short(value)}", lambda v=value: tabled(columns(), rename={"x": v}), _is_store
        yield f"split={_short(value)}", lambda v=value: EpisodeStore.split_table(columns(), v, **SCHEMA), _is_parts
        yield f"the table is {_short(value)}", lambda v=value: tabled(v), lambda _: False


SCHEMA = {"time": "t", "agent": "id", "episode": "run", "state": ["x", "y"], "cost": "hit"}


def _column_kept(given: Any, words: bool) -> bool:
    if np.ma.is_masked(given) or given is None:
        return False
    array = np.asarray(given)
    if array.ndim != 1 or len(array) not in (40, 41, 39):
        return False
    return words or array.dtype.kind in "biufM" or (array.dtype.kind == "O" and all(map(_plain, array)))


def _plain(value: Any) -> bool:
    number = plain_number(value)
    return number is not None or (isinstance(value, int) and abs(value) < 1e15)


def _is_store(found: Any) -> bool:
    arrays = (found.observations, found.actions, found.rewards, found.costs)
    return all(np.isfinite(array).all() for array in arrays)


def _is_parts(found: Any) -> bool:
    return all(map(_is_store, found))


def files_of_tables(place: Path, rng: random.Random, times: int) -> Iterator[Case]:
    """Files of every format with flipped bits, cut short, or other bytes in them."""
    import pandas as pd
    from pyarrow import Table, parquet

    folder = place / "tables"
    folder.mkdir()
    frame = pd.DataFrame(columns())
    parquet.write_table(Table.from_pandas(frame), folder / "a.parquet")
    frame.to_csv(folder / "a.csv", index=False)
    frame.to_json(folder / "a.jsonl", orient="records", lines=True)
    vehicles = '<vehicle id="{}" x="{}" y="1.5" angle="90.0" type="t" speed="1.0" pos="1" lane="l" slope="0"/>'
    rows = "".join(
        f'<timestep time="{k}.00">{vehicles.format("a", k)}{vehicles.format("b", 9 - k)}</timestep>' for k in range(20)
    )
    (folder / "a.xml").write_text(f"<?xml version='1.0'?><fcd-export>{rows}</fcd-export>")
    lines = [f"{6 * k}.0 {i}.0 {0.4 * k:.3f} 0.0 {i}.0 1.0 0.0 0.0" for k in range(1, 20) for i in (1, 2)]
    (folder / "a.txt").write_text("\n".join(lines) + "\n")
    readers = {
        "a.parquet": tabled,
        "a.csv": tabled,
        "a.jsonl": tabled,
        "a.xml": lambda file: EpisodeStore.from_layout(file, "sumo"),
        "a.txt": lambda file: EpisodeStore.from_layout(file, "obsmat"),
    }
    inserts = (
        b"\0",
        b"\xff\xfe",
        b"\n\n\n",
        b"\r",
        b'"',
        b",,,,",
        b"nan",
        b"inf",
        b"1e999",
        b"9" * 400,
        b"\xef\xbb\xbf",
        b"<",
        b"&a;",
    )
    for name, read in readers.items():
        file = folder / name
        raw = file.read_bytes()
        changed = [*_broken(raw, rng, 60 * times)]
        for insert in inserts:
            for _ in range(times):
                at = rng.randrange(len(raw))
                changed.append((f"{insert[:4]!r} at {at}", raw[:at] + insert + raw[at:]))
        changed += [("nothing", b""), ("zeros", bytes(1000)), ("one line", raw.split(b"\n")[0]), ("twice", raw + raw)]
        for what, content in changed:
            file.write_bytes(content)
            yield f"{name}: {what}", lambda file=file, read=read: read(file), _is_store
        file.write_bytes(raw)
        yield f"{name}: as it is", lambda file=file, read=read: read(file), _is_store
    bomb = '<!DOCTYPE x [<!ENTITY a "{}">{}]><fcd-export>&z;</fcd-export>'
    levels = "".join(f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">' for k in range(24)) + '<!ENTITY z "&y;">'
    (folder / "b.xml").write_text(bomb.format("a" * 100, levels))
    yield "an XML bomb", lambda: EpisodeStore.from_layout(folder / "b.xml", "sumo"), lambda _: False
    (folder / "c.xml").write_text('<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]><fcd-export>&e;</fcd-export>')
    yield "an XML file that names another", lambda: EpisodeStore.from_layout(folder / "c.xml", "sumo"), lambda _: False
    os.mkfifo(folder / "d.csv")
    yield "a pipe", lambda: tabled(folder / "d.csv"), lambda _: False


def _broken(raw: bytes, rng: random.Random, count: int) -> Iterator[tuple[str, bytes]]:
    from tests import corpus

    yield from corpus.broken_bytes(raw, rng, count)


# --- archives and links ---
def archives(place: Path, unpack: Callable[[Path], Any]) -> Iterator[Case]:
    """Members that are no files of a cell, names that lead out, and links in the way."""
    kinds = {
        "a link": tarfile.SYMTYPE,
        "a hard link": tarfile.LNKTYPE,
        "a pipe": tarfile.FIFOTYPE,
        "a device": tarfile.CHRTYPE,
        "a folder": tarfile.DIRTYPE,
        "a sparse file": tarfile.GNUTYPE_SPARSE,
        "of unknown kind": b"Z",
    }
    names = ["cells/../../victim", "/tmp/victim", "victim", "cells//a/results.json", "cells/a/../../../victim"]
    names += ["cells/a/results.json\0x", "cells/\ud800/results.json", "cells/" + "a/" * 200 + "results.json", "cells"]
    names += [f"cells/{word}/results.json" for word in WORDS if "\0" not in word and "\ud800" not in word]
    for what, kind in kinds.items():
        member = tarfile.TarInfo("cells/a/results.json")
        member.type = kind
        member.linkname = str(place / "victim")
        yield from _archive(place, f"a member is {what}", [(member, b"")], unpack)
    for name in names:
        yield from _archive(place, f"a member called {name[:30]!r}", [(tarfile.TarInfo(name), b"{}")], unpack)
    twice = [(tarfile.TarInfo("cells/a/results.json"), b"{}"), (tarfile.TarInfo("cells/a/results.json"), b"[]")]
    yield from _archive(place, "a member twice", twice, unpack)
    claimed = tarfile.TarInfo("cells/a/results.json")
    yield from _archive(place, "a bomb", [(claimed, b"0" * 100_000_000)], unpack)


def _archive(place: Path, what: str, members: list, unpack: Callable[[Path], Any]) -> Iterator[Case]:
    folder = place / "archive"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        with tarfile.open(folder / "runs.tar.xz", "w:xz", preset=0) as tar:
            for member, content in members:
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
    except (UnicodeEncodeError, ValueError):
        return
    outside = lambda: [p for p in (place / "victim", Path("/tmp/victim")) if p.exists()]  # noqa: E731
    inside = lambda: all(p.resolve().is_relative_to(folder.resolve()) for p in folder.rglob("*"))  # noqa: E731
    yield what, lambda: unpack(folder), lambda _: not outside() and inside()


# --- words that become commands and pages ---
def words_of_results(
    run: Any, build: Callable[[Any, Path], Path], commands: Callable[[Any], list[str]], words: list[str]
) -> Iterator[Case]:
    """Words in a run's files: a page shows them, and commands to copy hold them as one word."""
    config = json.loads((run.path / "config.json").read_text())
    results = json.loads((run.path / "results.json").read_text())
    variant = next(iter(results))
    places: list[tuple[str, tuple[str, ...]]] = [
        ("config.json", ("task",)), ("config.json", ("preset",)), ("config.json", ("algorithm",)),
        ("config.json", ("data", "simulator")), ("config.json", ("data", "provenance")),
        ("config.json", ("data", "zz")),
        ("config.json", ("data", "seed")), ("config.json", ("data", "size")), ("config.json", ("config", "zz")),
        ("results.json", (variant, "planner")), ("results.json", (variant, "guard")),
        ("results.json", (variant, "barrier")), ("results.json", (variant, "execution")),
        ("results.json", (variant, "simulator")), ("results.json", (variant, "split")),
        ("results.json", (variant, "guard_options")), ("results.json", (variant, "options")),
        ("results.json", (variant, "command")), ("results.json", (variant, "spec")),
    ]  # fmt: skip
    for file, (*path, last) in places:
        for word in words:
            options, told = (word, {word: 1}, {"horizon": word}), ([word], ["eval", "--set", word], word)
            for value in options if last.endswith("options") else told if last == "command" else (word,):
                whole = json.loads(json.dumps(config if file == "config.json" else results))
                inner = whole
                for key in path:
                    inner = inner[key]
                inner[last] = value

                def read(file=file, whole=whole):
                    (run.path / file).write_text(json.dumps(whole))
                    try:
                        return build(run, run.path.parent / "page.html").read_text(encoding="utf-8"), commands(run)
                    finally:
                        (run.path / "config.json").write_text(json.dumps(config))
                        (run.path / "results.json").write_text(json.dumps(results))

                yield f"{file} {'.'.join([*path, last])} = {word[:20]!r}", read, _harmless
    yield "as it is", lambda: (build(run, run.path.parent / "page.html").read_text(), commands(run)), _harmless


def _harmless(found: tuple[str, list[str]]) -> bool:
    """Whether a page runs no script and shows no control character, and a shell finds one command a line."""
    page, lines = found
    controls = re.search("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\ud800-\udfff]", page)
    scripts = re.search(r"<script>alert|<img src=x", page)
    return controls is None and scripts is None and all(map(_one_command, lines))


def _one_command(line: str) -> bool:
    words = shlex.shlex(line.removesuffix("\\"), posix=True, punctuation_chars=True)
    words.whitespace_split = True
    words.commenters = ""
    unquoted = re.sub(r"'[^']*'", "", line)
    return not re.search(r"[;&|<>`$()\n]", unquoted) and bool(list(words))


# --- commands ---
def command_lines(
    main: Callable[[list[str]], Any], store: Path, run: Path, place: Path, words: list[str]
) -> Iterator[Case]:
    """Options of commands that are none: refused before anything is fitted."""
    out = str(place / "out.h5")
    sizes = ["-1", "0", "1e9", "x", "", "nan", "99999999999999999999", "-99999999999999999999", "0x10", "1.5", "∞"]
    commands = {
        "ope": (["ope", str(run), str(store)], ["--seed", "--states", "--transitions", "--updates"]),
        "fit": (["fit", str(store), "--out", str(place / "w.safetensors")], ["--seed"]),
        "train": (["train", "bc", "--data", str(store), "--out", str(place / "runs")], ["--seeds"]),
        "eval": (["eval", str(run)], ["--episodes", "--agents", "--horizon", "--num-samples"]),
        "replay": (["replay", str(run), str(store)], ["--seed", "--windows", "--steps"]),
        "import-table": (["data", "import-table", "no.csv", "--out", out], ["--dt", "--gap", "--team", "--split"]),
        "make": (["data", "make", "simple_spread-random"], ["--size", "--seed"]),
    }
    for name, (line, options) in commands.items():
        for option in options:
            for size in sizes:
                seed = option.startswith("--seed")
                if (size == "0" and seed) or (size.startswith("9") and not seed):  # as good as any
                    continue
                argv = [*line, option, size]
                yield f"{name} {option} {size!r}", lambda argv=argv: _exit(main, argv), lambda status: status == 2
    places = ["/proc/x.html", "/dev/null/x.html", str(store) + "/x.html", "\0", "", "a\nb/" + "x" * 300]
    for path in places:
        argv = ["ope", str(run), str(store), "--report", path]
        yield f"ope --report {path[:20]!r}", lambda argv=argv: _exit(main, argv), lambda status: status == 2
    for word in words:
        for argv in (
            ["data", "info", word],
            ["eval", word],
            ["fit", word],
            ["report", word],
            ["ope", word, str(store)],
        ):
            yield f"{argv[0]} {word[:20]!r}", lambda argv=argv: _exit(main, argv), lambda status: status in (0, 2)
        argv = ["eval", str(run), "--world", word, "--guard", "shield"]
        yield f"eval --world {word[:20]!r}", lambda argv=argv: _exit(main, argv), lambda status: status == 2


def _exit(main: Callable[[list[str]], Any], argv: list[str]) -> int:
    """The status that a command exits with; what it prints holds no control character."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            main(argv)
            status = 0
        except SystemExit as exit:
            status = exit.code if isinstance(exit.code, int) else 2
    return -1 if re.search("[\x00-\x08\x0b\x0c\x0e-\x1a\x1c-\x1f\x7f-\x9f\u202e]", said.getvalue()) else status
