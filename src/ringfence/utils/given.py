"""What strangers give at run time, read once: numbers of the right kind and shape, finite, and a copy of one's own."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ringfence.errors import UserError

NUMBERS = "biuf"  # kinds of NumPy's types; complex, text, times and objects are none
SHOWN = 20  # names of agents in a refusal
LETTERS = {1: "S", 2: "NO", 3: "BNA"}  # axes that messages name


def given_as(
    name: str,
    value: Any,
    expected: tuple[int | None, ...],
    who: str = "this run",
    remedy: str = "pass what its data holds",
    origins: Sequence[float] | None = None,
    double: bool = False,
) -> np.ndarray:
    """A new float32 array of the expected shape, with finite numbers alone; None stands for a width that nobody knows.

    It is a copy: whoever gave it may go on writing into theirs. `origins` of its last axis are taken from it, in double
    precision. What comes in `double` precision stays in it, where that is asked for.
    """
    letters = LETTERS[len(expected)]
    wanted = f"({', '.join(letter if n is None else str(n) for letter, n in zip(letters, expected))})"
    rows = value if isinstance(value, list | tuple) else ()
    if any(isinstance(one, np.ma.MaskedArray) for one in (value, *rows)):
        raise UserError(f"{name} is a masked array, whose hidden entries nobody may act upon; fill them in.")
    try:
        array = np.asarray(value)
        if array.dtype.kind == "V" and array.dtype.names is None:  # bfloat16 and its like
            array = array.astype(np.float32)
        if array.dtype.kind not in NUMBERS:
            raise TypeError
        if origins is not None and array.shape[-1:] == (len(origins),):
            array = array.astype(np.float64) - np.asarray(origins)
        with np.errstate(over="ignore"):
            array = np.array(array, np.float64 if double and array.dtype.itemsize > 4 else np.float32)
    except (TypeError, ValueError):
        raise UserError(f"{name} is no array of numbers; pass one of shape {wanted}.") from None
    if array.ndim != len(expected) or any(n not in (None, m) for m, n in zip(array.shape, expected)):
        raise UserError(f"{name} has shape {array.shape}, {who} takes {wanted}; {remedy}.")
    if not np.isfinite(array).all():
        where = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
        raise UserError(
            f"{name}{where} is {array[tuple(where)]}, but a policy takes finite numbers alone; repair that entry."
        )
    return array


def refuse_other_order(agents: Sequence[Any], known: Sequence[str] | None, all_known: bool = True) -> None:
    """Refuse agents whose rows would be taken for others': those that the logs know at another place, or, where they
    are `all_known`, not at all. Logs that name none are of nobody in particular."""
    if isinstance(agents, str | bytes | Mapping) or not isinstance(agents, Iterable):
        raise UserError(f"agents={str(agents)[:60]!r} must be a list of names, in the order of the rows.")
    if known is None:
        return
    for k, (agent, logged) in enumerate(itertools.zip_longest(map(str, agents), known)):
        if agent != logged and (all_known or agent in known):
            raise UserError(
                f"Agent {k} is {agent or 'nobody'} here and {logged or 'nobody'} in the logs; bring all into the logs' "
                f"order: {', '.join(known[:SHOWN])}{', ...' * (len(known) > SHOWN)}."
            )


def cost_given(value: Any, agents: int) -> float | dict[str, float]:
    """What a step cost: a number, one of each agent, of which the largest counts, or these by constraint."""
    if isinstance(value, Mapping):
        return {str(name): _cost(cost, f"cost['{name}']", agents) for name, cost in value.items()}
    return _cost(value, "cost", agents)


def _cost(value: Any, name: str, agents: int) -> float:
    remedy = "give a number, 0 or more, or one of each agent"
    if isinstance(value, np.ma.MaskedArray):
        raise UserError(f"{name} is a masked array; {remedy}.")
    try:
        cost = np.asarray(value)
    except (TypeError, ValueError):
        cost = np.asarray(None)
    if cost.dtype.kind not in NUMBERS or cost.shape not in ((), (1,), (agents,)):
        raise UserError(f"{name} is {str(value)[:60]!r}, which is no number; {remedy}.")
    if not np.isfinite(cost).all() or cost.min() < 0:
        raise UserError(f"{name} is {str(value)[:60]}; {remedy}.")
    return float(cost.max())
