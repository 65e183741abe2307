"""Tables larger than memory, read a part at a time into the file of one store.

Such a table is in the order of its times, whoever's rows they are, or of recordings and their times. Where a part ends
within a recording, so does an episode, by the recording and not by itself; no step is lost, since the next part begins
with the rows that the one before ended with, if agents are logged at the same times. Steps, teams and what entries are
moved by are those of the first part.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ringfence.errors import StoreError, UserError, one_of
from ringfence.logs.io.columns import Columns, Form, batches, dates, numbers, rows_of, words
from ringfence.logs.io.table import LAYOUTS, read_layout, read_table
from ringfence.logs.io.table_schema import TableSchema
from ringfence.logs.io.tracks import GAP
from ringfence.logs.resolution import coarse
from ringfence.logs.schema import ARRAYS, OPTIONAL, StoreCard
from ringfence.logs.store import EpisodeStore, Pieces, write
from ringfence.utils import interrupts
from ringfence.utils.files import elsewhere, writable
from ringfence.utils.progress import Progress

LARGE = 4_000_000  # rows, from which on tables are read in parts
ROWS = 1_000_000  # of a part
COPIED = 2**24  # numbers of an array that are copied at once


def is_large(files: Sequence[Path], options: Mapping[str, Any]) -> bool:
    """Whether tables are to be read in parts: they are many rows, as their files tell, and no one recording."""
    return not options.get("join") and sum(rows_of(Path(file)) for file in files) > LARGE


def import_large(
    files: Sequence[Path],
    path: Path,
    *,
    layout: str | None = None,
    card: Mapping[str, Any] | None = None,
    rows: int = ROWS,
    quiet: bool = False,
    **options: Any,
) -> Written:
    """Write the store of tables that are read in parts of so many rows; options as of `EpisodeStore.from_table`, or of
    `from_layout`."""
    path = writable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    table = _Table.of(layout, options)
    with _beside(path) as folder:
        kept = _Growing(folder)
        with Progress("rows", max(1, sum(rows_of(Path(file)) for file in files)), quiet=quiet) as progress:
            for part in _parts(files, table, rows):
                try:
                    kept.add(table.store(part.tables, card or {}, kept.first, kept.team))
                except StoreError as error:
                    raise StoreError(f"{part.name}: {error}") from None
                progress.advance(part.rows)
        return kept.finish(path)


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """A folder beside a file that is to be written; what the disk refuses there is said of the file."""
    with tempfile.TemporaryDirectory(dir=path.absolute().parent, prefix=f".{path.name}.") as name:
        folder = Path(name)
        interrupts.unfinished.add(folder)
        try:
            yield folder
        except OSError as error:
            raise UserError(
                f"'{path}' could not be written ({error}); free some space or {elsewhere(path)}."
            ) from error
        finally:
            interrupts.unfinished.discard(folder)


@dataclass(frozen=True)
class _Table:
    """How tables are read."""

    layout: str | None
    options: Mapping[str, Any]
    time: str  # its columns
    episode: str | None
    wanted: list[str] | None  # all where it is not known
    form: Form
    time_format: str | None
    numbers: tuple[str, ...] = ()  # columns that are nothing else
    costs: tuple[str, ...] = ()

    @classmethod
    def of(cls, layout: str | None, options: Mapping[str, Any]) -> _Table:
        if layout is not None:
            known = one_of("layout", layout, LAYOUTS).columns
            form = Form(texts=(known.get("agent", "agent"),))
            return cls(layout, options, known.get("time", "time"), options.get("episode"), None, form, None)
        schema = TableSchema.of(options)
        theirs = {ours: their for their, ours in schema.rename.items()}
        named = [theirs.get(name, name) for name in schema.columns]
        time, agent = (theirs.get(name, name) for name in (schema.time, schema.agent))
        episode, ended = (name and theirs.get(name, name) for name in (schema.episode, schema.terminated))
        if schema.homogeneous and schema.sensing_radius is None:
            raise UserError("Tables that are read in parts need sensing_radius (--sensing-radius) beside neighbours.")
        costs = tuple(theirs.get(name, name) for name in schema.cost)
        form = Form(schema.header, schema.decimal, tuple(name for name in (agent, episode) if name))
        if schema.wide:
            return cls(None, options, time, episode, None, form, schema.time_format, costs=costs)
        others = tuple(name for name in named if name not in (time, agent, episode, ended))
        return cls(None, options, time, episode, named, form, schema.time_format, others, costs)

    def when(self, columns: Columns) -> np.ndarray:
        """(M,) times of rows."""
        found = dates(self.time, columns[self.time], self.time_format)
        return found if found.dtype.kind in "biufmM" else numbers({self.time: found}, self.time)

    def whose(self, columns: Columns) -> np.ndarray:
        """(M,) recordings of rows."""
        return np.zeros(len(columns[self.time]), int) if self.episode is None else words(columns, self.episode)

    def store(self, tables: list[Columns], card: Mapping[str, Any], first: StoreCard | None, team: int) -> EpisodeStore:
        """The store of a part, in steps, teams of so many agents and origins as in the first one."""
        found: Any = tables
        schema = TableSchema.of(self.options) if self.layout is None else None
        if self.layout is not None:
            found, schema = read_layout(tables, self.layout, self.options)
        assert schema is not None
        if first is None:
            return EpisodeStore.of_read(read_table(found, schema, card=card))
        origins = np.array(first.observation_origins or np.zeros(len(first.observation_names or ())))
        same = replace(schema, dt=first.dt, team=None if schema.homogeneous else team)
        return EpisodeStore.of_read(read_table(found, same, card=card, origins=origins))


@dataclass(frozen=True)
class _Part:
    """Tables, or rows of one, that are read together."""

    name: str
    tables: list[Columns]
    rows: int


def _parts(files: Sequence[Path], table: _Table, rows: int) -> Iterator[_Part]:
    """Rows of large tables, and small ones together."""
    before: _Part | None = None
    for part in (part for file in files for part in _of_file(Path(file), table, rows)):
        if before is not None and before.rows + part.rows <= rows:
            before = _Part(
                f"{before.name.partition(' to ')[0]} to {part.name}",
                [*before.tables, *part.tables],
                before.rows + part.rows,
            )
            continue
        if before is not None:
            yield before
        before = part
    if before is not None:
        yield before


def _of_file(file: Path, table: _Table, rows: int) -> Iterator[_Part]:
    """Rows of a table. A recording that ends within them is not cut; of a longer one, the last rows begin the next
    part, too."""
    held: Columns = {}
    reached, done = None, 0
    over: set[str] = set()
    for batch, following in _with_next(batches(file, table.wanted, table.form, rows, table.numbers), rows):
        new = len(batch[table.time])
        part = {k: np.concatenate([held[k], column]) if held else column for k, column in batch.items()}
        when = table.when(part)
        whose = table.whose(part)
        name = f"rows {done + new - len(when):,} to {done + new - 1:,} of '{file}'"
        goes_on = when[-new:][whose[-new:] == whose[0]]
        if (reached is not None and (goes_on < reached).any()) or over & set(whose.tolist()):
            raise StoreError(
                f"{name} go back in time, or to a recording of before, and a table of so many rows is read in parts; "
                "sort it by recording and time, or give a file for each recording."
            )
        done += new
        kept, later = np.ones(len(when), bool), np.zeros(len(when), bool)
        reached = None
        if following and (whose != whose[-1]).any():
            later = whose == whose[-1]
            kept = ~later
            over |= set(whose[kept].tolist())
        elif following and table.whose(following)[0] == whose[0]:
            times = np.unique(when)
            reached = times[-1]
            if table.when(following).min() - reached <= GAP * np.median(np.diff(times)):  # of the last time may be more
                reached = times[-min(2, len(times))]
                kept, later = when < times[-1], when >= reached
        yield _Part(name, [{k: column[kept] for k, column in part.items()}], int(kept.sum()))
        held = {k: column[later] for k, column in part.items()} if later.any() else {}
        if reached is not None and held:  # what led there was counted
            counted = table.when(held) == reached
            held |= {k: np.where(counted, np.zeros_like(held[k]), held[k]) for k in table.costs if k in held}


def _with_next(read: Iterator[Columns], rows: int) -> Iterator[tuple[Columns, Columns]]:
    """What is read, and what comes next; few rows at the end are read with what is before them."""
    before: Columns = {}
    for batch in read:
        if before and len(next(iter(batch.values()))) < rows // 2:
            before = {k: np.concatenate([before[k], column]) for k, column in batch.items()}
            continue
        if before:
            yield before, batch
        before = batch
    if before:
        yield before, {}


class Written(NamedTuple):
    """A store on disk."""

    card: StoreCard
    episodes: int
    steps: int


class _Growing:
    """A store whose arrays grow on disk, part by part."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.first: StoreCard | None = None
        self.like: dict[str, np.ndarray] = {}  # none of the rows of each array
        self.rows: dict[str, int] = {}
        self.of_team = True  # whether all agents have the same costs
        self.notes: dict[str, list[str]] = {}  # by what they say, but for numbers

    @property
    def team(self) -> int:
        """How many agents it is of; 0 of none so far."""
        return self.like["actions"].shape[1] if self.like else 0

    def add(self, store: EpisodeStore) -> None:
        """Its episodes after those of before."""
        each = store.costs.ndim == 2
        self.of_team &= not each
        n = store.n_agents
        found = {name: getattr(store, name) for name in (*ARRAYS, *OPTIONAL) if getattr(store, name) is not None}
        for name in ("costs", "constraints"):  # a later part may have costs of each agent
            if name in found and not each:
                found[name] = np.repeat(found[name][:, None], n, 1)
        found["episode_ends"] = found["episode_ends"] + self.rows.get("actions", 0)
        card = store.card
        if self.first is None:
            self.first = card
            self.like = {name: array[:0] for name, array in found.items()}
        shapes = {name: array.shape[1:] for name, array in found.items()}
        if shapes != {name: array.shape[1:] for name, array in self.like.items()}:
            raise StoreError("it holds other entries or agents than the rows before; give tables of one kind.")
        if store.n_agents > 1 and (card.agents is None or card.agents != self.first.agents):
            raise StoreError(
                "it is of other agents than the rows before, and rows of a team are of one agent each where tables are "
                "read in parts; give neighbours (--neighbours 6), or a file for each team."
            )
        if far := coarse(store) if self.rows else []:
            raise StoreError(f"it lies far from the rows before: {far[0]}")
        self.first = self.first.updated(
            action_low=np.minimum(self.first.action_low, card.action_low).tolist(),
            action_high=np.maximum(self.first.action_high, card.action_high).tolist(),
        )
        if card.sensing_radius is not None:
            self.first = self.first.updated(sensing_radius=max(self.first.sensing_radius or 0.0, card.sensing_radius))
        for note in card.warnings:
            self.notes.setdefault(re.sub(r"[\d.,]+", "#", note), []).append(note)
        for name, array in found.items():
            with (self.folder / name).open("ab") as file:
                np.ascontiguousarray(array, self.like[name].dtype).tofile(file)
            self.rows[name] = self.rows.get(name, 0) + len(array)

    def finish(self, path: Path) -> Written:
        """Write the store."""
        if self.first is None:
            raise StoreError("The tables hold no rows; give some that do.")
        notes = [
            said[0] if len(set(said)) == 1 else f"{said[0]} (and so in {len(said) - 1} parts more)"
            for said in self.notes.values()
        ]
        card = self.first.updated(warnings=notes)
        write(path, card, {name: self._pieces(name) for name in self.like})
        return Written(card, self.rows["episode_ends"], self.rows["actions"])

    def _pieces(self, name: str) -> Pieces:
        """An array, some rows at a time."""
        like, rows = self.like[name], self.rows[name]
        each = int(np.prod(like.shape[1:], dtype=int))
        of_team = self.of_team and name in ("costs", "constraints")
        count = max(1, COPIED // max(each, 1))

        def read() -> Iterator[np.ndarray]:
            with (self.folder / name).open("rb") as file:
                for begin in range(0, rows, count):
                    some = np.fromfile(file, like.dtype, min(count, rows - begin) * each).reshape(-1, *like.shape[1:])
                    yield some[:, 0] if of_team else some

        shape = (rows, *(like.shape[2:] if of_team else like.shape[1:]))
        return Pieces(shape, like.dtype, read())
