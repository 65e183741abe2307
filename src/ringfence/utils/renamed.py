"""Public names of before: they work for one release, with a warning that says today's name."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from ringfence.errors import UserError

T = TypeVar("T")

# What a module called by another name: where it is now, as "module:name".
NAMES = {
    "ringfence.guards": {
        "guard": "ringfence:guard",
        "Pilot": "ringfence:Controller",
        "Danger": "ringfence.guards:BarrierSource",
        "DANGERS": "ringfence.guards:BARRIERS",
    },
    "ringfence.guards.barrier": {
        "Danger": "ringfence.guards.barrier:BarrierSource",
        "DANGERS": "ringfence.guards.barrier:BARRIERS",
    },
}
INFO = {"strange": "ood"}  # what is known of an action


def names_of(module: str) -> Callable[[str], Any]:
    """The `__getattr__` of a module that had other names."""

    def find(name: str) -> Any:
        if name not in NAMES[module]:
            raise AttributeError(f"module '{module}' has no attribute '{name}'")
        place, _, today = NAMES[module][name].partition(":")
        deprecated(f"{module}.{name}", f"{place}.{today}")
        return getattr(importlib.import_module(place), today)

    return find


class Info(dict[str, T]):
    """What is known of an action, by name."""

    def __missing__(self, name: str) -> T:
        today = INFO.get(name, name)
        if today not in self:
            raise KeyError(name)
        deprecated(f"info['{name}']", f"info['{today}']")
        return self[today]


class HadStart:
    """A policy whose `initial_state` was called `start`."""

    def initial_state(self, batch: int) -> Any:
        raise NotImplementedError

    def start(self, batch: int) -> Any:
        deprecated("start of a policy", "initial_state")
        return self.initial_state(batch)


def policy_of_before(policy: T) -> T:
    """Somebody's policy, whose class may call `initial_state` by the name of before."""
    kind: Any = type(policy)
    if not hasattr(kind, "initial_state") and hasattr(kind, "start") and hasattr(kind, "act"):
        deprecated(f"start of the policy {kind.__name__}", "initial_state")
        kind.initial_state = kind.start
    return policy


def renamed(given: Mapping[str, Any], names: Mapping[str, str], of: str, warn: bool = True) -> dict[str, Any]:
    """What was given by name, under today's names; `names` maps those of before to them. Two names of one choice are
    refused. Without `warn` nothing is said, e.g. of a file that an older version wrote."""
    found: dict[str, Any] = {}
    for name, value in given.items():
        today = names.get(name, name)
        if today != name and today in given:
            raise UserError(f"{today} and {name} are two names of one choice; give {today} alone.")
        if today != name and warn:
            deprecated(f"{name} of {of}", today)
        found[today] = value
    return found


def renamed_values(given: Mapping[str, T], values: Mapping[str, Mapping[str, T]], warn: bool = True) -> dict[str, T]:
    """The same with today's names of values; `values` maps those of before to them, by what they are values of."""
    found = {name: _today(values.get(name), value) for name, value in given.items()}
    for name, value in given.items():
        if found[name] != value and warn:
            deprecated(f"{name}={value}", f"{name}={found[name]}")
    return found


def _today(values: Mapping[str, T] | None, value: T) -> T:
    return values[value] if values and isinstance(value, str) and value in values else value


def deprecated(what: str, instead: str) -> None:
    """Warn that a public name goes with the next release."""
    warnings.warn(f"{what} is called {instead} now; the old name goes with the next release.", FutureWarning, 3)
