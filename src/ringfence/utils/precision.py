"""Everything is learned and played in 32 bits, whatever the precision of the program that it is called from.

A program that sets JAX_ENABLE_X64 for code of its own gets the same numbers as any other. Its own functions, which are
called back (simulators, policies under guard), run in its own precision.

Products of matrices are of 32 bits, too: on a GPU, JAX would else keep 10 bits of what they multiply (TF32), and bounds
that are proven would not hold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import ParamSpec, TypeVar

import jax

from ringfence.utils.forks import refuse_forked

P = ParamSpec("P")
T = TypeVar("T")


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
