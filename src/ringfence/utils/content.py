"""What anybody's function or object is made of, as a digest that another process finds again."""

from __future__ import annotations

import functools
import hashlib
import random
import sys
import sysconfig
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

ATOMS = (type(None), bool, int, float, complex, str, bytes, type(...), np.generic)
STREAMS = (random.Random, np.random.RandomState, np.random.Generator, np.random.BitGenerator)


def content_of(value: Any) -> str:
    """The digest (12 letters) of a function's code, of the values that it captures, reads by their names and has bound,
    and of an object's class and attributes. Of installed packages the name alone counts, and so does the kind of a
    random stream, wherever it stands. What changes as it acts may say by an
    attribute `made_of` what it is."""
    return _Digests().of(value)


class _Digests:
    """Digests of objects, each made once: they may contain one another."""

    def __init__(self):
        self.known: dict[int, tuple[str, Any]] = {}  # with the object: a number is free when it is gone

    def of(self, value: Any) -> str:
        if id(value) in self.known:
            return self.known[id(value)][0]
        self.known[id(value)] = "within itself", value
        digest = hashlib.blake2b(_name(type(value)).encode(), digest_size=6)
        if isinstance(value, ATOMS):
            digest.update(repr(value).encode())
        elif (array := _array(value)) is not None:
            digest.update(f"{array.shape} {array.dtype}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        else:
            parts = [self.of(part) for part in _parts(value)]
            digest.update(" ".join(sorted(parts) if isinstance(value, set | frozenset) else parts).encode())
        self.known[id(value)] = digest.hexdigest(), value
        return digest.hexdigest()


def _parts(value: Any) -> Iterable[Any]:
    """What an object consists of."""
    if isinstance(value, (ModuleType, *STREAMS)):
        return [getattr(value, "__name__", "")]
    if isinstance(value, CodeType):
        return value.co_code, value.co_consts, value.co_names, value.co_freevars
    if isinstance(value, FunctionType):
        return [_name(value)] if _is_installed(value) else _of_function(value)
    if isinstance(value, type):
        return [_name(value)] if _is_installed(value) else _of_class(value)
    if isinstance(value, dict):
        return [part for item in value.items() for part in item]
    if isinstance(value, list | tuple | set | frozenset):
        return value
    if isinstance(value, np.ndarray):  # of objects
        return value.ravel().tolist()
    return _of_instance(value)


def _of_instance(value: Any) -> Iterable[Any]:
    """Of what is neither a container nor code: as copies of it are made, which tell all that it holds."""
    if hasattr(type(value), "made_of"):
        return type(value), value.made_of
    if isinstance(value, MethodType):
        return value.__func__, value.__self__
    if isinstance(value, CellType):
        with suppress(ValueError):  # an empty one
            return [value.cell_contents]
    if isinstance(value, BuiltinFunctionType):
        return [_name(value)]
    if (wrapped := getattr(value, "__wrapped__", None)) is not None:
        return [wrapped]
    try:
        copied = value.__reduce_ex__(2)
    except Exception:  # a lock, a file, a window: it is of its kind
        return [type(value)]
    return [type(value), *([copied] if isinstance(copied, str) else (_listed(part) for part in copied[1:]))]


def _listed(part: Any) -> Any:
    """Iterators of items, as some objects are copied by, as lists."""
    return list(part) if hasattr(part, "__next__") else part


def _of_function(function: FunctionType) -> Iterable[Any]:
    names = sorted(_names(function.__code__) & function.__globals__.keys())
    read = {name: function.__globals__[name] for name in names}
    return function.__code__, function.__defaults__, function.__kwdefaults__, function.__closure__, read


def _names(code: CodeType) -> set[str]:
    """The names that code reads, that of functions within it included."""
    within = (_names(const) for const in code.co_consts if isinstance(const, CodeType))
    return set(code.co_names).union(*within)


def _of_class(kind: type) -> Iterable[Any]:
    """Name and bases of a class, its methods, and what else it holds."""
    own = {name: part for name, part in vars(kind).items() if callable(part) or not name.startswith("__")}
    own = {name: getattr(part, "__func__", getattr(part, "fget", part)) for name, part in own.items()}
    return [_name(kind), kind.__bases__, own]


def _array(value: Any) -> np.ndarray | None:
    """Numbers, whoever's array they are in."""
    if not hasattr(value, "__array__") or isinstance(value, type):
        return None
    with suppress(Exception):  # e.g. a key of JAX, or an array on another device
        array = np.asarray(value)
        return array if array.dtype != object else None
    return None


def _name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _is_installed(value: Any) -> bool:
    """Whether a class or a function is of Python or of an installed package."""
    module = sys.modules.get(value.__module__)
    file = getattr(module, "__file__", None)
    if module is None or file is None:
        return value.__module__ not in ("__main__", "__mp_main__")
    return any(Path(file).is_relative_to(folder) for folder in _installed())


@functools.cache
def _installed() -> tuple[str, ...]:
    paths = sysconfig.get_paths()
    return tuple(paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib"))
