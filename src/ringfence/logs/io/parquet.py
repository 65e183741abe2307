"""Columns of Parquet files. Runs of one value are stored as one, so that what a file unpacks to is counted first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.errors import StoreError, reading
from ringfence.utils.arrays import affordable

PACKED = 20  # times their size that files may unpack to
LOOSE = 2**26  # bytes beyond that
LIST = 64  # bytes of a list beside those of its numbers


def names_in(path: Path) -> list[str]:
    """Names of a file's columns."""
    from pyarrow import parquet

    with reading(path, "Parquet file"):
        return parquet.read_schema(path).names


def read_parquet(paths: Sequence[Path], wanted: Sequence[str]) -> dict[str, np.ndarray]:
    """The wanted columns, which are there, of files after one another. Lists of one length are rows (M, entries)."""
    stored = sum(path.stat().st_size for path in paths)
    whose = paths[0] if len(paths) == 1 else paths[0].parent
    affordable(whose, sum(_unpacked(path, wanted) for path in paths), PACKED, stored, LOOSE)
    parts = [_columns(path, wanted) for path in paths]
    return {name: _joined(whose, name, [part[name] for part in parts]) for name in wanted}


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


def _columns(path: Path, wanted: Sequence[str]) -> dict[str, np.ndarray]:
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
        return np.concatenate([_text(chunk) for chunk in column.chunks] or [np.zeros(0, object)])
    if types.is_decimal(kind):
        return column.cast("float64").to_numpy()
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        return _lists(column)
    if types.is_nested(kind):
        raise StoreError(f"{name} holds objects in every row; write a column for each of their fields.")
    return column.to_numpy()


def _text(chunk: Any) -> np.ndarray:
    words = np.empty(len(chunk.dictionary) + 1, object)  # the last is None, of rows without any
    words[:-1] = chunk.dictionary.to_pylist()
    return words[chunk.indices.cast("int64").fill_null(-1).to_numpy(zero_copy_only=False)]


def _lists(column: Any) -> np.ndarray:
    lengths = column.combine_chunks().value_lengths().to_numpy(zero_copy_only=False)
    if not _is_plain(column.type.value_type) or not len(lengths) or not (lengths == lengths[0]).all():
        return column.to_numpy()
    flat = np.concatenate([chunk.flatten().to_numpy(zero_copy_only=False) for chunk in column.chunks])
    return flat.astype(np.float64, copy=False).reshape(len(lengths), -1)


def _is_plain(kind: Any) -> bool:
    from pyarrow import types

    return types.is_integer(kind) or types.is_floating(kind)


def _joined(whose: Path, name: str, parts: list[np.ndarray]) -> np.ndarray:
    if len(parts) == 1:
        return parts[0]
    try:
        return np.concatenate(parts)
    except (TypeError, ValueError):
        shapes = " and ".join(sorted({f"{part.dtype} {part.shape[1:]}" for part in parts}))
        raise StoreError(f"The files of '{whose}' hold '{name}' as {shapes}; write all of them in one way.") from None
