"""Everything is learned and played in 32 bits, whatever the precision of the program that it is called from.

A program that sets JAX_ENABLE_X64 for code of its own gets the same numbers as any other. Its own functions, which are
called back (simulators, policies under guard), run in its own precision.

Products of matrices are of 32 bits, too: on a GPU, JAX would else keep 10 bits of what they multiply (TF32), and bounds
that are proven would not hold. Arrays of the host come to the device so, too.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import ParamSpec, TypeVar

import jax
import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from ringfence.errors import UserError
from ringfence.types import Array

P = ParamSpec("P")
T = TypeVar("T")


_at_work: int | None = None  # the process that JAX works in


def refuse_forked() -> None:
    """Refuse to work in a process that was forked from one in which JAX had worked for this package."""
    global _at_work
    process = os.getpid()
    if _at_work not in (None, process):
        raise UserError(
            "This process was forked from one that JAX had worked in, and would wait for its threads for ever; start "
            'it with multiprocessing.get_context("spawn"), or use threads.'
        )
    _at_work = process


@contextmanager
def float32() -> Iterator[None]:
    """While it is open, JAX makes numbers of 32 bits, and multiplies them as such; not in a forked process."""
    refuse_forked()
    with jax.enable_x64(False), full_products():
        yield


@contextmanager
def full_products() -> Iterator[None]:
    """While it is open, or as a decorator while a function runs, products of matrices keep all bits of what they
    multiply, where JAX would round it first; also within a program that somebody else compiles."""
    with jax.default_matmul_precision("highest"):
        yield


def float64() -> AbstractContextManager[object]:
    """While it is open, JAX makes numbers of 64 bits."""
    return jax.enable_x64(True)


def in_float32(function: Callable[P, T]) -> Callable[P, T]:
    """The function, in 32 bits."""
    return float32()(function)


def on_device(x: ArrayLike, dtype: DTypeLike | None = None) -> Array:
    """The array on the device, of 32 bits; `jnp.asarray` compiles a program for every shape that it is given."""
    return jax.device_put(np.asarray(x, dtype))
