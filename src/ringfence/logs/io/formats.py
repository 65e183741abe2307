"""Files of known kinds as columns (M,): Parquet, JSON lines, and what simulators and data sets of their own write."""

from __future__ import annotations

import itertools
import json
import warnings
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn
from xml.parsers import expat

import numpy as np

from ringfence.errors import StoreError, reading
from ringfence.utils.arrays import affordable

LOOSE = 2**26  # bytes beyond what Parquet files may unpack to by their size
LIST = 64  # bytes of a list of theirs beside those of its numbers
DEEP = 8  # objects within objects of JSON
OBSMAT = ("frame", "agent", "x", "z", "y", "vx", "vz", "vy")
SPACING = 0.4  # s between a pedestrian's lines
PIECE = 2**20  # bytes of XML that are parsed at a time
ELEMENT = 2**24  # bytes of a comment or an element
VEHICLES = ("vehicle", "person")  # persons are read where there is no vehicle: they may ride in one
WORDS = ("id", "type", "lane", "edge")
MOTION = ("x", "y", "speed", "angle")  # which are numbers in every file


# --- Parquet ---
def names_in(path: Path) -> list[str]:
    """Names of a file's columns."""
    from pyarrow import parquet

    with reading(path, "Parquet file"):
        return parquet.read_schema(path).names


def read_parquet(paths: Sequence[Path], wanted: Sequence[str]) -> dict[str, np.ndarray]:
    """The wanted columns, which are there, of files after one another. Lists of one length are rows (M, entries). Runs
    of one value are stored as one, so what the files unpack to is counted first."""
    stored = sum(path.stat().st_size for path in paths)
    whose = paths[0] if len(paths) == 1 else paths[0].parent
    affordable(whose, sum(_unpacked(path, wanted) for path in paths), stored=stored, loose=LOOSE)
    parts = [_of_parquet(path, wanted) for path in paths]
    return {name: _of_all(whose, name, [part[name] for part in parts]) for name in wanted}


def _unpacked(path: Path, wanted: Sequence[str]) -> int:
    """Bytes that the wanted columns claim, and at least those of their arrays."""
    from pyarrow import parquet

    size = 0
    with reading(path, "Parquet file"), parquet.ParquetFile(path) as file:
        leaves = [(k, file.schema.column(k)) for k in range(len(file.schema))]
        own = [(k, leaf) for k, leaf in leaves if any(f"{leaf.path}.".startswith(f"{name}.") for name in wanted)]
        for group in map(file.metadata.row_group, range(file.metadata.num_row_groups)):
            for k, leaf in own:
                chunk = group.column(k)
                values = max(8, leaf.length) * chunk.num_values  # text as numbers that say which it is
                lists = LIST * group.num_rows if leaf.max_repetition_level else 0
                size += max(chunk.total_uncompressed_size, values) + lists
    return size


def _of_parquet(path: Path, wanted: Sequence[str]) -> dict[str, np.ndarray]:
    from pyarrow import parquet

    with reading(path, "Parquet file"):
        with parquet.ParquetFile(path) as file:
            leaves = [file.schema.column(k) for k in range(len(file.schema))]
        texts = [leaf.path for leaf in leaves if leaf.physical_type == "BYTE_ARRAY"]
        with parquet.ParquetFile(path, read_dictionary=texts) as file:
            table = file.read(list(wanted))
        return {name: as_numpy(name, table.column(name)) for name in wanted}


def as_numpy(name: str, column: Any) -> np.ndarray:
    """An Arrow column as NumPy's: text as objects that rows share, lists of one length as rows (M, entries)."""
    from pyarrow import types

    kind = column.type
    if types.is_dictionary(kind):
        return np.concatenate([_shared_words(chunk) for chunk in column.chunks] or [np.zeros(0, object)])
    if types.is_decimal(kind):
        return column.cast("float64").to_numpy()
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        return _of_lists(column)
    if types.is_nested(kind):
        raise StoreError(f"{name} holds objects in every row; write a column for each of their fields.")
    return column.to_numpy()


def _shared_words(chunk: Any) -> np.ndarray:
    words = np.empty(len(chunk.dictionary) + 1, object)  # the last is None, of rows without any
    words[:-1] = chunk.dictionary.to_pylist()
    return words[chunk.indices.cast("int64").fill_null(-1).to_numpy(zero_copy_only=False)]


def _of_lists(column: Any) -> np.ndarray:
    from pyarrow import types

    plain = types.is_integer(column.type.value_type) or types.is_floating(column.type.value_type)
    lengths = column.combine_chunks().value_lengths().to_numpy(zero_copy_only=False)
    if not plain or not len(lengths) or not (lengths == lengths[0]).all():
        return column.to_numpy()
    flat = np.concatenate([chunk.flatten().to_numpy(zero_copy_only=False) for chunk in column.chunks])
    return flat.astype(np.float64, copy=False).reshape(len(lengths), -1)


def _of_all(whose: Path, name: str, parts: list[np.ndarray]) -> np.ndarray:
    if len(parts) == 1:
        return parts[0]
    try:
        return np.concatenate(parts)
    except (TypeError, ValueError):
        shapes = " and ".join(sorted({f"{part.dtype} {part.shape[1:]}" for part in parts}))
        raise StoreError(f"The files of '{whose}' hold '{name}' as {shapes}; write all of them in one way.") from None


# --- JSON lines ---
def read_json_lines(path: Path, wanted: Collection[str] | None) -> dict[str, np.ndarray]:
    """The wanted columns (M,) of a file with an object for each row, by name, and the names of all others without a
    row; what a row does not name is None there. A row's own objects are joined to its names by dots (`pose.x`). Lists
    stay lists."""
    names: dict[str, None] = {}
    found: dict[str, tuple[list[int], list[Any]]] = {name: ([], []) for name in wanted or ()}  # rows and their values
    rows = 0
    with path.open(encoding="utf-8-sig") as file:
        for number, line in enumerate(file, 1):
            if not line.strip():
                continue
            for name, value in _fields_of_line(path, number, line):
                names[name] = None
                if name in found:
                    found[name][0].append(rows)
                    found[name][1].append(value)
            rows += 1
    there = {name: column for name, column in found.items() if name in names}
    affordable(path, 8 * rows * len(there))  # a row has few bytes that names few columns
    return dict.fromkeys(names, np.zeros(0)) | {name: _of_values(rows, *column) for name, column in there.items()}


def _fields_of_line(path: Path, number: int, line: str) -> Iterator[tuple[str, Any]]:
    try:
        row = json.loads(line, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        raise StoreError(f"Line {number} of '{path}' is no JSON ({error}); write one object per line.") from None
    if not isinstance(row, dict):
        raise StoreError(f'Line {number} of \'{path}\' is no object; write one per row, such as {{"t": 0.1, "x": 2}}.')
    return _by_dots(path, number, row, "", DEEP)


def _by_dots(path: Path, number: int, row: dict[str, Any], before: str, depth: int) -> Iterator[tuple[str, Any]]:
    if not depth:
        raise StoreError(f"Line {number} of '{path}' holds objects in objects {DEEP} deep; write flatter rows.")
    for name, value in row.items():
        if isinstance(value, dict):
            yield from _by_dots(path, number, value, f"{before}{name}.", depth - 1)
        else:
            yield before + name, value


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    row = dict(pairs)
    if len(row) < len(pairs):
        raise ValueError("it names a field twice")
    return row


def _of_values(rows: int, where: list[int], values: list[Any]) -> np.ndarray:
    """Numbers as numbers and words as words; anything else as it is, for whoever reads the column to judge."""
    kinds = {type(value) for value in values} if len(values) == rows else {type(None)}
    if kinds <= {int, float}:
        try:
            return np.array(values, np.int64 if kinds == {int} else np.float64)  # ids are longer than floats are exact
        except OverflowError:  # an integer that no float holds
            pass
    if kinds == {bool}:
        return np.array(values)
    column = np.empty(rows, object)
    for row, value in zip(where, values):  # lists, which NumPy would make into more axes
        column[row] = value
    return column


# --- pedestrians of ETH (Pellegrini et al. 2009) and UCY ---
def read_obsmat(path: Path) -> dict[str, np.ndarray]:
    """Columns (M,) `time` (s), `agent`, `x`, `y` (m), `vx`, `vy` (m/s) of an `obsmat.txt`: eight numbers a line without
    a header, of which the height is 0 throughout and left out. A pedestrian has a line every 0.4 s, whatever the frames
    are counted by."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of an empty file, which is refused below
            rows = np.loadtxt(path, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        reason = str(error).splitlines()[0]
        raise StoreError(f"'{path}' is no obsmat ({reason}); give lines of {len(OBSMAT)} numbers.") from None
    if rows.shape[1:] != (len(OBSMAT),) or not len(rows):
        raise StoreError(
            f"'{path}' has {len(rows)} lines of {rows.shape[-1]} numbers; an obsmat has {len(OBSMAT)}: "
            f"{' '.join(OBSMAT)}."
        )
    columns = dict(zip(OBSMAT, rows.T))
    frame, agent = columns["frame"], columns["agent"]
    order = np.lexsort((frame, agent))
    apart = np.diff(frame[order])[np.diff(agent[order]) == 0]
    apart = apart[apart > 0]
    if not len(apart):
        raise StoreError(f"'{path}' has no pedestrian at two frames; give lines of {' '.join(OBSMAT)}.")
    time = frame * SPACING / float(np.median(apart))
    if not (np.isfinite(agent) & (agent == np.round(agent))).all():
        raise StoreError(f"'{path}' numbers a pedestrian otherwise than by whole numbers; give {' '.join(OBSMAT)}.")
    return {
        "time": time,
        "agent": agent.astype(np.int64),
        **{name: columns[name] for name in ("x", "y", "vx", "vy")},
    }


# --- SUMO ---
def read_fcd(path: Path) -> dict[str, np.ndarray]:
    """Columns (M,) `time`, `agent`, `vx`, `vy`, and every attribute that all vehicles have, numbers as float64, of
    floating car data (`--fcd-output`, sumo.dlr.de/docs/Simulation/Output/FCDOutput.html). Each `timestep` holds the
    vehicles of that time: x and y (m), speed (m/s) and angle, the direction in degrees clockwise from north. Velocities
    follow from the last two."""
    rows = _Vehicles(path)
    with path.open("rb") as file, reading(path, "XML", "write it again"):
        for begins in itertools.count(0, PIECE):  # expat begins anew at each piece of what it has not seen the end of
            piece = file.read(PIECE)
            rows.parser.Parse(piece, not piece)
            if begins - rows.parser.CurrentByteIndex > ELEMENT:
                raise StoreError(f"'{path}' holds {ELEMENT / 2**20:.0f} MiB without an element; take them out.")
            if not piece:
                break
    return _of_vehicles(path, *rows.of_first_kind())


class _Vehicles:
    """What the parser has met so far: elements are read one by one, so that the file may be large."""

    def __init__(self, path: Path):
        self.path = path
        self.time: float | None = None
        self.times: dict[str, list[float]] = {kind: [] for kind in VEHICLES}
        self.found: dict[str, list[dict[str, str]]] = {kind: [] for kind in VEHICLES}
        self.root = ""
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._begin
        self.parser.StartDoctypeDeclHandler = self._refuse_doctype  # entities may unpack to anything

    def of_first_kind(self) -> tuple[list[float], list[dict[str, str]]]:
        kind = next((kind for kind in VEHICLES if self.found[kind]), VEHICLES[0])
        return self.times[kind], self.found[kind]

    def _begin(self, element: str, attributes: dict[str, str]) -> None:
        if not self.root:
            self.root = element
            if element != "fcd-export":
                raise StoreError(f"'{self.path}' begins with <{element}>, not <fcd-export>; give SUMO's --fcd-output.")
        elif element == "timestep":
            self.time = _number(self.path, "time", attributes.get("time"))
        elif element in VEHICLES:
            if self.time is None:
                raise StoreError(
                    f"'{self.path}' has a <{element}> outside of any <timestep>; give SUMO's --fcd-output."
                )
            self.times[element].append(self.time)
            self.found[element].append(attributes)

    def _refuse_doctype(self, *_: object) -> NoReturn:
        raise StoreError(f"'{self.path}' declares a document type, which SUMO's output has not; take that line out.")


def _of_vehicles(path: Path, times: list[float], rows: list[dict[str, str]]) -> dict[str, np.ndarray]:
    if not rows:
        raise StoreError(f"'{path}' holds no vehicle and no person at any time; simulate longer.")
    common = [name for name in rows[0] if all(name in row for row in rows)]
    lacking = [name for name in ("id", *MOTION) if name not in common]
    if lacking:
        raise StoreError(
            f"'{path}' has vehicles without {lacking[0]}; leave it in --fcd-output.attributes, or leave that option "
            "out."
        )
    columns = {"time": np.array(times), "agent": _texts(rows, "id")}
    for name in common:
        if name in WORDS:
            columns[name] = _texts(rows, name)
        elif name not in columns:
            columns[name] = _numbers(path, name, rows)
    angle = np.deg2rad(columns["angle"])
    speed = columns["speed"]
    return columns | {"vx": speed * np.sin(angle), "vy": speed * np.cos(angle)}


def _texts(rows: list[dict[str, str]], name: str) -> np.ndarray:
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
        return _texts(rows, name)
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
