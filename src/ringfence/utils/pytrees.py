"""Pytrees as named arrays, the form in which they are kept on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from ringfence.errors import CheckpointError
from ringfence.types import PyTree
from ringfence.utils.files import whole


def named_leaves(tree: PyTree) -> list[tuple[str, Any]]:
    """Leaves with their paths, e.g. ('params/denoiser/blocks/0/qkv', array)."""
    return [
        ("/".join(str(getattr(k, "key", getattr(k, "name", getattr(k, "idx", k)))) for k in path), leaf)
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]
    ]


def named_arrays(tree: PyTree) -> dict[str, np.ndarray]:
    """Leaves on the host, by path."""
    return {name: np.array(leaf, order="C") for name, leaf in named_leaves(tree)}


def digest_of(arrays: Iterable[tuple[str, np.ndarray]]) -> str:
    """Of arrays and their names, in this order."""
    digest = Digest()
    for name, array in arrays:
        digest.begin(name, array.shape, array.dtype)
        digest.add(array)
    return digest.found


class Digest:
    """Of arrays and their names, some rows of each at a time."""

    def __init__(self):
        self._digest = hashlib.blake2b(digest_size=8)

    def begin(self, name: str, shape: tuple[int, ...], dtype: np.dtype) -> None:
        self._digest.update(f"{name} {shape} {dtype}".encode())

    def add(self, rows: np.ndarray) -> None:
        self._digest.update(np.ascontiguousarray(rows).data)

    @property
    def found(self) -> str:
        return self._digest.hexdigest()


def save_named(file: Path, arrays: dict[str, np.ndarray], metadata: Mapping[str, str] | None = None) -> None:
    """Write a file of named arrays, whole or not at all."""
    with whole(file) as temporary:
        try:
            save_file(arrays, temporary, dict(metadata or {}))
        except SafetensorError as error:  # its own wrapping of the operating system's error
            raise OSError(str(error)) from error


def load_named(file: str | Path, template: PyTree) -> PyTree:
    """The tree in a file of named arrays, which must be the template's in name and shape."""
    return as_tree(load_file(file), template, file)


def as_tree(arrays: dict[str, np.ndarray], template: PyTree, file: str | Path) -> PyTree:
    """The tree of named arrays that were read from `file`."""
    leaves = []
    for name, leaf in named_leaves(template):
        if name not in arrays:
            raise CheckpointError(f"'{file}' lacks the array '{name}'; it was made by another model: make it again.")
        if arrays[name].shape != leaf.shape:
            raise CheckpointError(
                f"'{file}': '{name}' has shape {arrays[name].shape}, its config gives {leaf.shape}; it belongs to "
                "another task or config."
            )
        # Converted by NumPy: JAX would compile a program for every shape.
        leaves.append(jax.device_put(np.asarray(arrays[name], leaf.dtype)))
    return jax.tree.unflatten(jax.tree.structure(template), leaves)
