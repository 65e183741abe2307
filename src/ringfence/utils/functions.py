"""Somebody's function that decides: of observations and the state, or of observations alone."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

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
    if _takes(signature, 2) and not _of_its_own(signature):
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


def _of_its_own(signature: inspect.Signature) -> bool:
    """Whether the second parameter is a setting that has a value."""
    second = list(signature.parameters.values())[1:2]
    return any(one.default is not one.empty and one.name.strip("_") != "state" for one in second)
