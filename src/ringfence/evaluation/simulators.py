"""Simulators that are named on a command line."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from ringfence.errors import UserError


@dataclass(frozen=True)
class NamedSimulator:
    """What makes a simulator, and the name that it was given by."""

    name: str
    make: Callable[[], Any]

    def __call__(self) -> Any:
        return self.make()


def simulator(name: str) -> NamedSimulator:
    """What makes the simulator named FILE.py:NAME or MODULE:NAME, a class or a function without arguments."""
    where, _, attribute = name.rpartition(":")
    if not where or not attribute.isidentifier():
        raise UserError(f"'{name}' names no simulator; write FILE.py:NAME or MODULE:NAME of what makes a ParallelEnv.")
    make = getattr(_imported(where, attribute), attribute, None)
    if not callable(make):
        raise UserError(
            f"'{where}' has no {attribute} that can be called; name the class, or the function, that makes one."
        )
    return NamedSimulator(name, make)


def name_of(make_env: Callable[[], Any], env: Any = None) -> str:
    """The name a simulator was given by, else that of its class, or of what makes it."""
    if isinstance(make_env, NamedSimulator):
        return make_env.name
    made = make_env if env is None else type(env)
    return f"{made.__module__}:{getattr(made, '__qualname__', type(made).__qualname__)}"


def _of_file(file: Path) -> ModuleType:
    """The module of a file; one whose name another module has already, e.g. `queue`, gets a name of its own."""
    known = sys.modules.get(file.stem)
    if known is None or getattr(known, "__file__", None) == str(file):
        return importlib.import_module(file.stem)
    name = f"{file.stem}_{hashlib.blake2b(str(file).encode(), digest_size=4).hexdigest()}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None, "a file that ends in .py"
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _imported(where: str, attribute: str) -> ModuleType:
    """The module of a file, or of a name that is found from the working folder."""
    file = Path(where)
    is_file = file.suffix == ".py"
    if is_file and not file.is_file():
        raise UserError(f"'{where}' is no file; give the one that holds {attribute}.")
    sys.path.insert(0, str(file.resolve().parent if is_file else Path.cwd()))
    try:
        return _of_file(file.resolve()) if is_file else importlib.import_module(where)
    except Exception as error:  # it is anybody's code
        raise UserError(f"'{where}' cannot be imported ({type(error).__name__}: {error}); repair it first.") from error
    finally:
        sys.path.pop(0)
