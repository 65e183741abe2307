"""SUMO's floating car data (`--fcd-output`), XML, as columns.

Each `timestep` holds the vehicles of that time: x and y (m), speed (m/s) and angle, the direction in degrees clockwise
from north (sumo.dlr.de/docs/Simulation/Output/FCDOutput.html). Velocities follow from the last two.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

import numpy as np

from ringfence.errors import StoreError, reading

CHUNK = 2**20  # bytes that are parsed at a time
LONGEST = 2**24  # bytes of a comment or an element
KINDS = ("vehicle", "person")  # persons are read where there is no vehicle: they may ride in one
WORDS = ("id", "type", "lane", "edge")
MOTION = ("x", "y", "speed", "angle")  # which are numbers in every file


def read_fcd(path: Path) -> dict[str, np.ndarray]:
    """Columns (M,) `time`, `agent`, `vx`, `vy`, and every attribute that all vehicles have, numbers as float64."""
    rows = _Rows(path)
    with path.open("rb") as file, reading(path, "XML", "write it again"):
        for begins in itertools.count(0, CHUNK):  # expat begins anew at each piece of what it has not seen the end of
            piece = file.read(CHUNK)
            rows.parser.Parse(piece, not piece)
            if begins - rows.parser.CurrentByteIndex > LONGEST:
                raise StoreError(f"'{path}' holds {LONGEST / 2**20:.0f} MiB without an element; take them out.")
            if not piece:
                break
    return _columns(path, *rows.of_first_kind())


class _Rows:
    """What the parser has met so far: elements are read one by one, so that the file may be large."""

    def __init__(self, path: Path):
        self.path = path
        self.time: float | None = None
        self.times: dict[str, list[float]] = {kind: [] for kind in KINDS}
        self.found: dict[str, list[dict[str, str]]] = {kind: [] for kind in KINDS}
        self.root = ""
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._begin
        self.parser.StartDoctypeDeclHandler = self._refuse_doctype  # entities may unpack to anything

    def of_first_kind(self) -> tuple[list[float], list[dict[str, str]]]:
        kind = next((kind for kind in KINDS if self.found[kind]), KINDS[0])
        return self.times[kind], self.found[kind]

    def _begin(self, element: str, attributes: dict[str, str]) -> None:
        if not self.root:
            self.root = element
            if element != "fcd-export":
                raise StoreError(f"'{self.path}' begins with <{element}>, not <fcd-export>; give SUMO's --fcd-output.")
        elif element == "timestep":
            self.time = _number(self.path, "time", attributes.get("time"))
        elif element in KINDS:
            if self.time is None:
                raise StoreError(
                    f"'{self.path}' has a <{element}> outside of any <timestep>; give SUMO's --fcd-output."
                )
            self.times[element].append(self.time)
            self.found[element].append(attributes)

    def _refuse_doctype(self, *_: object) -> NoReturn:
        raise StoreError(f"'{self.path}' declares a document type, which SUMO's output has not; take that line out.")


def _columns(path: Path, times: list[float], rows: list[dict[str, str]]) -> dict[str, np.ndarray]:
    if not rows:
        raise StoreError(f"'{path}' holds no vehicle and no person at any time; simulate longer.")
    common = [name for name in rows[0] if all(name in row for row in rows)]
    lacking = [name for name in ("id", *MOTION) if name not in common]
    if lacking:
        raise StoreError(
            f"'{path}' has vehicles without {lacking[0]}; leave it in --fcd-output.attributes, or leave that option "
            "out."
        )
    columns = {"time": np.array(times), "agent": _words(rows, "id")}
    for name in common:
        if name in WORDS:
            columns[name] = _words(rows, name)
        elif name not in columns:
            columns[name] = _numbers(path, name, rows)
    angle = np.deg2rad(columns["angle"])
    speed = columns["speed"]
    return columns | {"vx": speed * np.sin(angle), "vy": speed * np.cos(angle)}


def _words(rows: list[dict[str, str]], name: str) -> np.ndarray:
    return np.array([row[name] for row in rows], object)  # which takes no row for as long as the longest


def _numbers(path: Path, name: str, rows: list[dict[str, str]]) -> np.ndarray:
    """An attribute of all rows: numbers, or words where it is none in the first of them."""
    try:
        float(rows[0][name])
    except ValueError:
        if name in MOTION:
            raise StoreError(
                f"'{path}' says {name}='{rows[0][name]:.60}', which is no number; write it again."
            ) from None
        return _words(rows, name)
    return np.array([_number(path, name, row[name]) for row in rows])


def _number(path: Path, name: str, text: str | None) -> float:
    """SUMO writes times as seconds, or as [days:]hours:minutes:seconds if asked to."""
    parts = (text or "").split(":")
    try:
        seconds = float(parts[-1])
        for part, unit in zip(reversed(parts[:-1]), (60, 3600, 86400), strict=False):
            seconds += unit * int(part)
    except ValueError:
        raise StoreError(f"'{path}' says {name}='{text}', which is no number; write it again.") from None
    return seconds
