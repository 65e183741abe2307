"""Everything is learned and played in 32 bits, whatever the precision of the program that it is called from.

A program that sets JAX_ENABLE_X64 for code of its own gets the same numbers as any other. Its own functions, which are
called back (simulators, policies under guard), run in its own precision.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
T = TypeVar("T")


def float32() -> AbstractContextManager[object]:
    """While it is open, JAX makes numbers of 32 bits."""
    if not getattr(jax.config, "jax_enable_x64"):  # noqa: B009 (a name that its type does not tell)
        return nullcontext()
    return jax.enable_x64(False)


def float64() -> AbstractContextManager[object]:
    """While it is open, JAX makes numbers of 64 bits."""
    return jax.enable_x64(True)


def in_float32(function: Callable[P, T]) -> Callable[P, T]:
    """The function, in 32 bits."""

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        with float32():
            return function(*args, **kwargs)

    return run
