"""Somebody's function that decides: of observations and the state, or of observations alone."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from ringfence.errors import UserError


class OfObservations:
    """A function that reads no state, called like one that does. It has `reset()` if the function, or whose method it
    is, has one; a copy of it has a copy of their memory."""

    def __init__(self, function: Callable[[Any], Any]):
        self.function = function
        owner = function if hasattr(function, "reset") else getattr(function, "__self__", None)
        if callable(reset := getattr(owner, "reset", None)):
            self.reset = reset

    def __call__(self, observations: Any, state: Any) -> Any:
        return self.function(observations)


def of_both(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function as one of (observations, state). What has no signature is taken as it is."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return function
    if _takes(signature, 2):
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
