"""Columns of a table: of a data frame, a dictionary of arrays, or a file of a known kind."""

from __future__ import annotations

import importlib
import io
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, time
from numbers import Number
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ringfence.errors import StoreError, UserError, needs, reading, reason, unknown
from ringfence.logs.io.formats import as_numpy, names_in, read_fcd, read_json_lines, read_obsmat, read_parquet

Table = Mapping[str, Any] | str | Path | Any  # or a data frame that narwhals reads
Tables = Table | list[Table] | tuple[Table, ...]  # one, or several recordings
Columns = dict[str, np.ndarray]
READERS: dict[str, Callable[[Path], Columns]] = {".xml": read_fcd, ".txt": read_obsmat}
LINES = (".jsonl", ".ndjson")
PARQUET = (".parquet", ".pq")
KINDS = (".csv", *PARQUET, *LINES, *READERS)
LONGEST = 1000  # entries of a list
WIDEST = 50_000  # columns of text, each of which takes kilobytes before its first row
LINE = 40  # bytes of a row of text, about
BLOCK = 2**24  # bytes of text that are read at once
SHOWN = 40  # letters of an entry
LOOKS = (  # parts of times, and how they are written
    (r"^\d{14}$", "%Y%m%d%H%M%S"),
    (r"(?<!\d)\d{1,2}:\d{2}:\d{2}\.\d{1,6}(?!\d)", "%H:%M:%S.%f"),
    (r"(?<!\d)\d{1,2}:\d{2}:\d{2}", "%H:%M:%S"),
    (r"(?<![\d:+-])\d{1,2}:\d{2}(?!\d)", "%H:%M"),
    (r"\b[ap]m\b", "%p"),
    (r"(?<=[SfMp ])([+-]\d{2}:?\d{2}|Z)$", "%z"),
    (r"\b(UTC|GMT)\b", "%Z"),
    (r"\b(Mon|Tues|Wednes|Thurs|Fri|Satur|Sun)day\b", "%A"),
    (r"\b(Mon|Tue|Wed|Thu|Fri|Sat|Sun)\b", "%a"),
    (r"\b(January|February|March|April|June|July|August|September|October|November|December)\b", "%B"),
    (r"\b(Jan|Feb|Mar|Apr|May|Jun|Jul|Aug|Sep|Oct|Nov|Dec)\b", "%b"),
)
COMMA = re.compile(r"[+-]?(\d+(,\d*)?|,\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True)
class Form:
    """How a text file is written."""

    header: tuple[str, ...] = ()  # names of its columns, where it has no head; lines that begin with # are left out
    decimal: str = "."
    texts: tuple[str, ...] = ()  # columns that are text whatever they look like: 007 is another than 7


AS_USUAL = Form()


def read_columns(table: Table, wanted: Iterable[str], form: Form = AS_USUAL) -> Columns:
    """The named columns, whatever the table is; one that is absent is refused with the nearest name. JSON lines that
    hold none of them are left out."""
    wanted = list(dict.fromkeys(wanted))
    if isinstance(table, str | Path):
        table = _read_file(Path(table), wanted, form)
        if table and all(name in table and table[name].dtype.kind == "O" for name in wanted):
            there = np.any([[entry is not None for entry in table[name]] for name in wanted], 0)
            table = {name: table[name][there] for name in wanted}
    if isinstance(table, Mapping):
        found = {name: _array(name, table[name]) for name in known(wanted, list(table))}
    else:
        frame = _frame(table)
        columns = {name: frame[name] for name in known(wanted, frame.columns)}
        arrow = frame.implementation.is_pyarrow()
        found = {name: as_numpy(name, x.to_native()) if arrow else x.to_numpy() for name, x in columns.items()}
    if form.decimal != ".":
        found = {name: x if name in form.texts else _pointed(x) for name, x in found.items()}
    lengths = {len(column) if column.ndim in (1, 2) else -1 for column in found.values()}
    if len(lengths) != 1 or not lengths - {-1, 0}:
        shapes = ", ".join(f"{name} {column.shape}" for name, column in found.items())
        raise StoreError(f"The columns are not of one length above 0 ({shapes}); give one entry per row.")
    return found


def _pointed(column: np.ndarray) -> np.ndarray:
    """A column with text that is a number with a decimal comma as that number; a CSV file's reader knows it itself."""
    if column.dtype.kind not in "UO" or column.ndim != 1:
        return column
    entries = column.tolist()
    found = [float(x.replace(",", ".")) if isinstance(x, str) and COMMA.fullmatch(x.strip()) else x for x in entries]
    if all(type(entry) is float for entry in found):
        return np.array(found)
    pointed = np.empty(len(found), object)
    pointed[:] = found
    return pointed if found != entries else column


def names_of(table: Table, form: Form = AS_USUAL) -> list[str]:
    """The names of all its columns."""
    if isinstance(table, str | Path):
        return list(_read_file(Path(table), None, form))
    return [str(name) for name in (table if isinstance(table, Mapping) else _frame(table).columns)]


def seconds(columns: Columns, name: str) -> np.ndarray:
    """A column of times as float64 s; dates are counted from the first of them."""
    column = columns[name]
    if column.dtype.kind not in "Mm":
        found = numbers(columns, name)
        if _reads_as_dates(found):
            raise StoreError(
                f"row 0: {name} is {found[0]:.0f}, which reads as a date and no count of seconds; say how times are "
                "written, as time_format='%Y%m%d%H%M%S' (--time-format)."
            )
        return found
    _refuse_missing(name, np.isnat(column))
    if (unit := np.datetime_data(column.dtype)[0]) in ("Y", "M"):
        raise StoreError(f"{name} counts years or months, which are of several lengths; give dates of days or less.")
    if unit == "as":
        raise StoreError(f"{name} counts attoseconds, of which ten seconds are too many; give nanoseconds.")
    return (column - column.min() if column.dtype.kind == "M" else column) / np.timedelta64(1, "s")


def _reads_as_dates(numbers: np.ndarray) -> bool:
    """Whether all are fourteen digits of a year, month, day, hour, minute and second."""
    finite = np.isfinite(numbers)
    rest, fits = np.floor(np.where(finite, numbers, 0.0)), finite
    for size, least, most in ((100, 0, 60), (100, 0, 59), (100, 0, 23), (100, 1, 31), (100, 1, 12), (1e5, 1900, 2100)):
        fits = fits & (rest % size >= least) & (rest % size <= most)
        rest = rest // size
    return bool(fits.all() and not rest.any())


def dates(name: str, column: np.ndarray, written: str | None = None) -> np.ndarray:
    """A column of dates that are `written` as text (by default as ISO 8601) as dates; one of no dates as it is. Those
    with an offset are counted in UTC, and a column in which some have one is left to be refused."""
    if written is not None and (column.dtype.kind in "iu" or (column.dtype.kind == "f" and _reads_as_dates(column))):
        whole = column.astype(np.int64) if column.dtype.kind == "f" else column
        column = whole.astype(str)  # as the text that a file's would be
    if column.dtype.kind not in "UO" or column.ndim != 1 or not len(column):
        return column
    read = [_date(entry, written) for entry in column.tolist()]
    wrong = [row for row, one in enumerate(read) if one is None]
    found = [one for one in read if one is not None]
    if not found and written is None:
        return column
    if wrong:
        form = "in ISO 8601" if written is None else f"as time_format='{written}'"
        remedy = "repair or drop it" if found else "say how it is written"
        raise StoreError(f"row {wrong[0]}: {name} is {str(column[wrong[0]])[:40]!r}, no time {form}; {remedy}.")
    if len({one.tzinfo is None for one in found}) > 1:
        return column
    return np.array(
        [one if one.tzinfo is None else one.astimezone(UTC).replace(tzinfo=None) for one in found], "M8[us]"
    )


def _date(entry: Any, written: str | None) -> datetime | None:
    """The date of an entry, if it is one."""
    try:
        found = datetime.fromisoformat(entry) if written is None else datetime.strptime(entry, written)
        if found.tzinfo is not None:
            found.astimezone(UTC)
    except (TypeError, ValueError, OverflowError):  # of the first day of year 1, further east
        return None
    return found


def _remedy(entry: Any) -> str | None:
    """What to do about an entry that is no number as it is written, where its looks tell."""
    text = f"{entry:%H:%M:%S}" if isinstance(entry, time) else str(entry).strip()
    if re.fullmatch(r"[+-]?\d+,\d+", text):
        return "if its comma is a decimal point, give decimal=',' (--decimal ,)"
    form = next((form for form in _forms(text[:SHOWN]) if _date(text, form) is not None), None)
    return form and f"if it is a time, say how times are written, as time_format='{form}' (--time-format)"


def _forms(text: str) -> Iterator[str]:
    """How a time may be written that looks so, with the day before the month where both are possible."""
    form = text.replace("%", "%%")
    for looks, letters in LOOKS:
        form = re.sub(looks, letters, form, flags=re.IGNORECASE)
    if "%p" in form:
        form = form.replace("%H", "%I")
    pieces = re.split(r"\d+", form)
    for order in ("", "dmY", "mdY", "Ymd", "dmy", "mdy", "ymd", "dY", "Yd", "dy"):
        if len(order) == len(pieces) - 1 and (len(order) == 3 or "%" in form):
            yield "".join(a + b for a, b in zip(pieces, [*(f"%{letter}" for letter in order), ""]))


def numbers(columns: Columns, name: str) -> np.ndarray:
    """A column as float64; the first entry that is no finite real number is refused by its row. Text, dates, complex
    numbers and missing entries are none: what they would become is a guess."""
    column = columns[name]
    if column.dtype.kind not in "biufO":
        remedy = _remedy(column[0]) or "convert the column, or leave it out"
        raise StoreError(f"row 0: {name} is {str(column[0])[:40]!r}, no number; {remedy}.")
    row = None
    if column.dtype.kind == "O":
        others = [
            k
            for k, entry in enumerate(column)
            if not isinstance(entry, Number) or isinstance(entry, complex | np.complexfloating) or not _converts(entry)
        ]
        # One word makes text of a whole column of a file; the row to repair is its own.
        words = (k for k in others if not (isinstance(column[k], str) and _converts(column[k])))
        row = next(words, others[0] if others else None)
    if row is not None:
        remedy = _remedy(column[row]) or "repair or drop it"
        raise StoreError(f"row {row}: {name} is {str(column[row])[:40]!r}, no number; {remedy}.")
    found = column.astype(np.float64)
    wrong = ~np.isfinite(found)
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise StoreError(
            f"row {row}: {name} is {found[row]} ({int(wrong.sum())} such rows); fill it, or drop the rows (a hole of "
            "more than the gap ends an episode)."
        )
    return found


def words(columns: Columns, name: str) -> np.ndarray:
    """A column of names: numbers as they are, text decoded; a missing entry is refused by its row."""
    column = columns[name]
    if column.dtype.kind in "fMm":
        _refuse_missing(name, ~np.isfinite(column))
    if column.dtype.kind not in "OS":
        return column
    _refuse_missing(name, np.fromiter(map(is_missing, column), bool, len(column)))
    found = np.empty(len(column), object)  # NumPy's own text takes as much for each row as the longest
    found[:] = [_text(name, row, entry) for row, entry in enumerate(column)]
    return found


def _refuse_missing(name: str, missing: np.ndarray) -> None:
    if missing.any():
        raise StoreError(f"row {int(np.flatnonzero(missing)[0])}: {name} is missing; fill or drop it.")


def _text(name: str, row: int, entry: Any) -> str:
    if not isinstance(entry, bytes):
        return str(entry)
    try:
        return entry.decode()
    except UnicodeDecodeError:
        raise StoreError(f"row {row}: {name} is {entry[:40]!r}, no text in UTF-8; write it anew in that.") from None


def known(wanted: list[str], names: list[Any]) -> list[str]:
    there = set(names)
    for name in wanted:
        if name not in there:
            raise unknown("column of the table", name, map(str, names))
    return wanted


def _array(name: str, column: Any) -> np.ndarray:
    """A column of a dictionary; what a mask hides is refused, and so is what is no column."""
    if np.ma.is_masked(column):
        raise StoreError(f"{name} hides entries behind a mask; fill them in, or drop the rows that hold them.")
    try:
        return np.asarray(column)
    except (TypeError, ValueError) as error:
        raise StoreError(f"{name} is no column ({str(error).split('. ')[0]}); give one entry per row.") from None


def is_missing(entry: Any) -> bool:
    """None, NaN, NaT and pandas' NA, which will not say whether it is itself."""
    try:
        return entry is None or bool(entry != entry)
    except TypeError:
        return True


def _frame(table: Any) -> Any:
    """A data frame of any library as narwhals' own."""
    narwhals = reader("narwhals")
    try:
        return narwhals.from_native(table, eager_only=True)
    except Exception as error:  # names of columns that are no words, or there twice: each library has its own refusal
        if not isinstance(error, TypeError):
            raise StoreError(
                f"The table cannot be read ({reason(error)}); give every column its own name, in words."
            ) from error
        raise StoreError(
            f"The table is a {type(table).__name__}; give a data frame (pandas, polars, pyarrow), a dictionary of "
            "columns, or a .csv or .parquet file."
        ) from None


def reader(module: str) -> ModuleType:
    """A package that reads tables."""
    with needs("tables", "Tables"):
        return importlib.import_module(module)


def _read_file(path: Path, wanted: list[str] | None, form: Form) -> Columns:
    """The wanted columns of a file; of others, and of all where nothing is wanted, there may be no more than names."""
    kind = path.suffix.lower()
    if not path.is_file():
        raise StoreError(f"'{path}' is no file; give a {_or(KINDS)} file.")
    told = bool(form.header) and kind not in (*PARQUET, *LINES, ".xml")  # any text, whose columns are named
    if kind not in KINDS and not told:
        raise StoreError(f"'{path}' ends in '{kind}'; give a {_or(KINDS)} file.")
    with reading(path, "table that can be read", "write it again"):
        if kind in READERS and not told:
            return READERS[kind](path)
        if kind in LINES:
            return read_json_lines(path, wanted)
        return _read_by_arrow(path, wanted, form)


def rows_of(path: Path) -> int:
    """Rows of a file, about as many as its size tells where it does not say how many."""
    if not path.is_file():
        return 0
    if path.suffix.lower() not in PARQUET:
        return path.stat().st_size // LINE
    reader("pyarrow")
    from pyarrow import parquet

    with reading(path, "Parquet file"), parquet.ParquetFile(path) as file:
        return file.metadata.num_rows


def batches(
    path: Path, wanted: list[str] | None, form: Form, rows: int, numbers: Iterable[str] = ()
) -> Iterator[Columns]:
    """The wanted columns of a file, about so many rows at a time; all at once of a kind that is not read by rows.
    `numbers` are those that are nothing else."""
    kind = path.suffix.lower()
    if kind not in (*PARQUET, ".csv") or not path.is_file() or (form.header and kind == ".csv"):
        yield read_columns(path, names_of(path, form) if wanted is None else wanted, form)
        return
    pyarrow = reader("pyarrow")
    from pyarrow import csv, parquet

    with reading(path, "table that can be read", "write it again"):
        whole: list[str] = []  # of which later rows may have points where the first have none
        if kind == ".csv":
            schema = csv.open_csv(path, **_of_csv(path, form)[1]).schema
            whole = [one.name for one in schema if pyarrow.types.is_integer(one.type)]
            there = schema.names
        else:
            there = names_in(path)
        twice = [name for name, times in Counter(there).items() if times > 1]
        if twice:
            raise StoreError(f"'{path}' has the column '{twice[0]}' twice; give every column its own name.")
        names = there if wanted is None else known(list(dict.fromkeys(wanted)), there)
        if kind == ".csv":
            source, how = _of_csv(path, form, {*whole, *numbers} - set(form.texts), names)
            read: Iterable[Any] = csv.open_csv(source, **how)
        else:
            read = parquet.ParquetFile(path).iter_batches(rows, columns=names)
        found, count = [], 0
        for batch in read:
            found.append(batch)
            count += batch.num_rows
            if count >= rows:
                yield _of_batches(found, names)
                found, count = [], 0
        if count:
            yield _of_batches(found, names)


def _of_batches(found: list[Any], names: Sequence[str]) -> Columns:
    import pyarrow

    table = pyarrow.Table.from_batches(found)
    return {name: as_numpy(name, table.column(name)) for name in names}


def _or(kinds: Iterable[str]) -> str:
    *first, last = kinds
    return f"{', '.join(first)} or {last}"


def _read_by_arrow(path: Path, wanted: list[str] | None, form: Form) -> Columns:
    """Columns of a Parquet file, or of text, separated by what separates the first line; by spaces only where the form
    names the columns."""
    reader("pyarrow")
    from pyarrow import csv

    table = None
    if path.suffix.lower() not in PARQUET:
        source, options = _of_csv(path, form)
        table = csv.read_csv(source, **options)
    names = names_in(path) if table is None else table.column_names
    twice = [name for name, times in Counter(names).items() if times > 1]
    if twice:
        raise StoreError(f"'{path}' has the column '{twice[0]}' twice, or no header; give every column its own name.")
    if wanted is None:
        return dict.fromkeys(names, np.zeros(0))
    known(wanted, names)
    return read_parquet([path], wanted) if table is None else {name: table.column(name).to_numpy() for name in wanted}


def _of_csv(
    path: Path, form: Form, numbers: Iterable[str] = (), wanted: Sequence[str] | None = None
) -> tuple[Any, dict[str, Any]]:
    """(what is read, how); `numbers` are columns that are nothing else."""
    import pyarrow
    from pyarrow import csv

    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = (line for line in file if line.strip() and not line.startswith("#"))
        head = next(lines, "") if form.header else file.readline(2**20)
        separator = max(",;\t|", key=head.count)  # the first of those that separate as often
        if head.count(separator) >= WIDEST:
            raise StoreError(f"'{path}' has more than {WIDEST:,} columns; leave out those that nobody needs.")
        source: Any = path
        if form.header:
            spaces = separator not in head
            separator = "\t" if spaces else separator
            rows = ("\t".join(line.split()) + "\n" if spaces else line for line in (head, *lines))
            source = io.BytesIO("".join(rows).encode())
    types = {name: pyarrow.float64() for name in numbers} | {name: pyarrow.string() for name in form.texts}
    return source, {
        "read_options": csv.ReadOptions(column_names=list(form.header) or None, block_size=BLOCK),
        "parse_options": csv.ParseOptions(delimiter=separator),
        "convert_options": csv.ConvertOptions(
            column_types=types,
            strings_can_be_null=True,
            decimal_point=form.decimal,
            include_columns=wanted,
        ),
    }


def _converts(entry: Any) -> bool:
    """Whether a number can be made of it, which an integer may be too large for."""
    try:
        float(entry)
    except (OverflowError, TypeError, ValueError):
        return False
    return True


# --- lists ---
def stacked(name: str, column: np.ndarray) -> np.ndarray | None:
    """(M, entries) of a column of lists, all of one length; None of any other column."""
    if column.ndim == 2:
        return column
    if column.dtype.kind != "O" or not any(_is_list(entry) for entry in column):
        return None
    length = next(len(entry) for entry in column if _is_list(entry))
    for row, entry in enumerate(column):
        if not _is_list(entry) or len(entry) != length or any(_is_list(inner) for inner in entry):
            raise StoreError(
                f"row {row}: {name} is no list of {length} numbers as in the rows before; drop the row, or mend it."
            )
    if not 0 < length <= LONGEST:
        raise UserError(f"{name} holds lists of {length} entries, from 1 to {LONGEST} can be read; leave it out.")
    rows = np.array([list(entry) for entry in column], object)
    try:
        return rows.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        return rows  # whoever reads its numbers refuses the first that is none, by its row


def by_entry(name: str, rows: np.ndarray, names: Sequence[str] | None) -> Columns:
    """Columns (M,) of lists (M, entries) by the names of their entries, counted where they have none."""
    length = rows.shape[1]
    if names is not None and len(names) != length:
        raise StoreError(
            f"{name} holds lists of {length}, and meta/info.json names {len(names)} entries; mend one of them."
        )
    return dict(zip(names if names is not None else map(str, range(length)), rows.T))


def _is_list(entry: object) -> bool:
    return isinstance(entry, list | tuple) or (isinstance(entry, np.ndarray) and entry.ndim == 1)
