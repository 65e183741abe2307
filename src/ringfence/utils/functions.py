"""Somebody's function: whether it decides by observations and the state or by observations alone, and whether it is the
same as another, by its code and all that this holds."""

from __future__ import annotations

import copyreg
import dis
import functools
import hashlib
import importlib.util
import inspect
import io
import operator
import pickle
import random
import sys
import sysconfig
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any, Literal

import numpy as np

from ringfence.errors import UserError


def memory_of(function: Any) -> Any:
    """Who has `reset()`, and so a memory: the function, or the object whose method it is. None: nobody."""
    owner = function if hasattr(function, "reset") else getattr(function, "__self__", None)
    return owner if callable(getattr(owner, "reset", None)) and not inspect.isclass(owner) else None


class OfObservations:
    """A function that reads no state, called like one that does. It has `reset()` if the function, or whose method it
    is, has one; a copy of it has a copy of their memory."""

    def __init__(self, function: Callable[[Any], Any]):
        self.function = function
        owner = memory_of(function)
        if owner is not None:
            self.reset = owner.reset

    def __call__(self, observations: Any, state: Any) -> Any:
        return self.function(observations)


def of_both(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function as one of (observations, state). What has no signature is taken as it is; a second parameter with a
    default is the function's own setting, unless it is called `state`."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return function
    second = list(signature.parameters.values())[1:2]
    is_setting = any(one.default is not one.empty and one.name.strip("_") != "state" for one in second)
    if _takes(signature, 2) and not is_setting:
        return function
    if _takes(signature, 1):
        return OfObservations(function)
    raise UserError("policy takes observations, or (observations, state), and gives actions; this function cannot.")


def _takes(signature: inspect.Signature, count: int) -> bool:
    try:
        signature.bind(*[None] * count)
    except TypeError:
        return False
    return True


ATOMS = {type(None), bool, int, float, complex, str, bytes, type(...)}
STREAMS = (random.Random, np.random.RandomState, np.random.Generator, np.random.BitGenerator)
Streams = Literal["by kind", "by state", "as unknown"]
LOCKS = (type(threading.Lock()), type(threading.RLock()))
ARRAYS = ("numpy", "jax", "jaxlib", "torch")  # whose arrays are their numbers
CLOSED = object()  # stands for what nobody can look into


def content_of(value: Any, streams: Streams = "by kind") -> str:
    """The digest (12 letters) of a function's code, of the values that it captures, reads by their names and has bound,
    of an object's class and attributes, and of the modules that it reaches, with all that they hold. Of installed
    packages the name alone counts, and so does the kind of a random stream, wherever it stands, unless `streams` say
    otherwise. What changes as it acts may say by an attribute `made_of` what it is. A blank and a kind follow where
    something of that kind is held that tells nothing of itself, such as a generator or an open file: two of these are
    never known to be the same."""
    digest = hashlib.blake2b(digest_size=6)
    things, number, closed = [value], {id(value): 0}, ""

    def write(part: Any) -> None:
        if type(part) in ATOMS or isinstance(part, np.generic):
            digest.update(pickle.dumps(part, 4))
        elif type(part) in (tuple, set, frozenset):  # which two processes share differently
            digest.update(f"{len(part)} in a {type(part).__name__}".encode())
            named = part if isinstance(part, tuple) else sorted(part, key=lambda x: getattr(x, "__qualname__", repr(x)))
            for inner in named:
                write(inner)
        else:
            if id(part) not in number:
                number[id(part)] = len(things)
                things.append(part)  # which keeps its number from being free
            digest.update(f"#{number[id(part)]}".encode())

    if type(value) in ATOMS | {tuple, set, frozenset}:
        things[:] = [[value]]
    for thing in things:  # which grows
        digest.update(f"{_name(type(thing))} of".encode())
        for part in _drawn(thing, streams) or _parts(thing):
            closed = closed or _name(type(thing)) * (part is CLOSED)
            write(None if part is CLOSED else part)
    return f"{digest.hexdigest()} {closed}".strip()


def _drawn(value: Any, streams: Streams) -> Iterable[Any]:
    """What a random stream tells of itself, where its kind is not enough; else nothing."""
    if streams == "by kind" or not isinstance(value, STREAMS) or not _is_installed(type(value).__module__):
        return ()
    return [CLOSED] if streams == "as unknown" else [pickle.dumps(value, 4)]


def _parts(value: Any) -> Iterable[Any]:
    """What an object consists of."""
    kind = type(value)
    installed = _is_installed(kind.__module__)
    if name := _found(value):
        return [name]
    if kind in LOCKS or (installed and isinstance(value, STREAMS)):
        return ()
    if isinstance(value, ModuleType):
        return [value.__name__, *(() if _is_installed(value.__name__) else _own(value))]
    if isinstance(value, CodeType):
        return value.co_code, value.co_consts, value.co_names, value.co_freevars
    if isinstance(value, FunctionType):
        return _of_function(value)
    if isinstance(value, type):
        return _of_class(value)
    if kind is dict:
        return _items(value)
    if kind is list:
        return value
    if kind.__module__.partition(".")[0] in ARRAYS and hasattr(kind, "__array__") and not np.ma.isMaskedArray(value):
        with suppress(Exception):  # e.g. a key of JAX, or an array on another device
            array = np.asarray(value)
            inner = array.ravel().tolist() if array.dtype == object else [np.ascontiguousarray(array).tobytes()]
            return [array.shape, str(array.dtype), *inner]
    return _of_instance(value, installed)


def _of_instance(value: Any, installed: bool) -> Iterable[Any]:
    """Of what is neither a container nor code: as copies of it are made, and, where its class is somebody's own and may
    copy less, its attributes."""
    kind = type(value)
    if hasattr(kind, "made_of"):
        return kind, value.made_of
    if isinstance(value, MethodType):
        return value.__func__, value.__self__
    if isinstance(value, CellType):
        with suppress(ValueError):
            return [value.cell_contents]
        return ()  # an empty one
    if isinstance(value, BuiltinFunctionType):
        return value.__qualname__, value.__self__
    if isinstance(value, property):
        return value.fget, value.fset, value.fdel
    if isinstance(value, weakref.ref):
        return [value()]
    if installed and hasattr(value, "__wrapped__") and not isinstance(value, functools.partial):
        return kind, value.__wrapped__
    attributes = object.__getstate__(value)
    held: Iterable[Any] = ()
    with suppress(Exception):
        copied: Any = copyreg.dispatch_table.get(kind, operator.methodcaller("__reduce_ex__", 2))(value)
        held = () if isinstance(copied, str) else [list(x) if isinstance(x, Iterator) else x for x in copied]
    told = held or (attributes and not isinstance(value, io.IOBase))
    bare = all(base is object or not _is_installed(base.__module__) for base in kind.__mro__)
    return kind, *held, None if held and installed else attributes, *(() if told or bare else [CLOSED])


def _of_function(function: FunctionType) -> Iterable[Any]:
    bound = function.__defaults__, function.__kwdefaults__, function.__closure__
    if _is_installed(function.__globals__.get("__name__")):
        return _name(function), *bound
    codes = list(_codes(function.__code__))
    names = {name for code in codes for name in code.co_names}
    read = {name: function.__globals__[name] for name in sorted(names & function.__globals__.keys())}
    return function.__code__, *bound, vars(function), *_items(read), *_imported(codes, function.__globals__)


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Code, and that of functions within it."""
    yield code
    for const in code.co_consts:
        if isinstance(const, CodeType):
            yield from _codes(const)


def _imported(codes: Iterable[CodeType], globals: dict[str, Any]) -> Iterator[ModuleType]:
    """Modules of one's own that code imports as it runs."""
    for code in codes:
        steps = list(dis.get_instructions(code))
        for (level, names), step in zip(zip(steps, steps[1:]), steps[2:]):
            if step.opname == "IMPORT_NAME" and (level.argval or not _is_installed(step.argval)):
                with suppress(Exception, SystemExit):
                    yield __import__(step.argval, globals, None, names.argval, level.argval)


def _of_class(kind: type) -> Iterable[Any]:
    """Name and bases of a class, its methods, and what else it holds."""
    if _is_installed(kind.__module__) and "<locals>" not in kind.__qualname__:
        return [_name(kind)]
    return _name(kind), type(kind), kind.__bases__, *_own(kind)


def _own(holder: Any) -> Iterator[Any]:
    """Names in a module or a class, and what is called so, without what Python itself has named."""
    named = {name: x for name, x in vars(holder).items() if not name.startswith("__") and name != "_abc_impl"}
    if isinstance(holder, type):
        named |= {name: x for name, x in vars(holder).items() if callable(x)}
    return _items({name: named[name] for name in sorted(named)})


def _items(named: dict[Any, Any]) -> Iterator[Any]:
    return (part for item in named.items() for part in item)


def _name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _found(value: Any) -> str | None:
    """The name by which an installed package holds it."""
    with suppress(Exception):  # whatever else is called so
        if _is_installed(value.__module__):
            there = functools.reduce(getattr, value.__qualname__.split("."), sys.modules[value.__module__])
            return _name(value) if there is value else None
    return None


def _is_installed(name: Any) -> bool:
    """Whether a module is of Python, of an installed package or of this one."""
    name, top = str(name), str(name).partition(".")[0]
    if top in ("__main__", "__mp_main__"):
        return False
    module = sys.modules.get(name)
    if getattr(module, "__file__", None) is None:  # as of those that a package makes as it goes
        module = sys.modules.get(top)
    found = None
    with suppress(Exception):  # of what was never a file
        found = importlib.util.find_spec(top) if module is None else None
    file = getattr(module, "__file__", None) or getattr(found, "origin", None)
    file = file or next(
        iter(getattr(module, "__path__", getattr(found, "submodule_search_locations", None)) or ()), None
    )
    return top in sys.stdlib_module_names if file in (None, "built-in", "frozen") else _is_place(file)


@functools.cache
def _is_place(file: str) -> bool:
    """Whether packages are installed there."""
    paths = sysconfig.get_paths()
    ours = *(paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")), Path(__file__).parents[1]
    within = any(Path(file).is_relative_to(folder) for folder in ours)
    return within or not {"site-packages", "dist-packages"}.isdisjoint(Path(file).parts)
