"""Configs: typed, bounded, built from names and values that anybody may have written."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from ringfence.errors import UserError, unknown


def parse_as(kind: type, changes: dict[str, str]) -> dict[str, Any]:
    """Words read as the types of a config's fields."""
    fields = {f.name: f for f in dataclasses.fields(kind)}
    return {name: _parse(name, text, fields[name].default) for name, text in changes.items()}


def build_config(kind: type, changes: dict[str, Any], of: str) -> Any:
    """A config dataclass from named changes; strings are read as the field's type, unknown names are refused."""
    fields, hints, values = {f.name: f for f in dataclasses.fields(kind)}, get_type_hints(kind), {}
    for name, value in changes.items():
        if name not in fields:
            raise unknown(f"config field of {of}", name, fields)
        default = fields[name].default
        values[name] = _parse(name, value, default) if isinstance(value, str) else _typed(of, name, value, hints[name])
        _in_range(of, name, values[name])
        options = get_args(hints[name]) if get_origin(hints[name]) is Literal else ()
        if options and values[name] not in options:
            raise unknown(f"value of {of}'s {name}", str(values[name]), map(str, options))
    return kind(**values)


# Least and largest value that a field of this name may have, in whatever config it is.
RANGES = {"steps": (1, 10**9), "batch": (1, 10**8), "width": (1, 10**5), "depth": (1, 1000), "horizon": (2, 10_000)}


POSITIVE = ("lr", "clip")


def _in_range(of: str, name: str, value: Any) -> None:
    low, high = RANGES.get(name, (None, None))
    if not isinstance(value, int | float) or isinstance(value, bool):
        return
    if not abs(value) < 2**53 or (low is not None and value < low) or (high is not None and value > high):
        if high is not None and high <= 1000:
            bound = f"between {low} and {high}"
        elif low is not None and value < low:
            bound = f"at least {low}"
        else:
            bound = "finite" if high is None else f"at most {high}"
        raise UserError(f"{name}={value} of {of} must be {bound}.")
    if name in POSITIVE and value <= 0:
        raise UserError(f"{name}={value} of {of} must be positive.")


def _typed(of: str, name: str, value: Any, hint: Any) -> Any:
    """A value given from Python, of the field's type: 1e3 is a whole number, True is none."""
    value = value.item() if isinstance(value, np.generic) else value
    kinds = set(get_args(hint)) or {hint}
    if not kinds <= {bool, int, float, type(None)}:
        return value  # literals are compared below; of another type, its algorithm knows more
    if kinds == {int} and isinstance(value, float) and value.is_integer():
        return int(value)
    fits = (type(value) in kinds) or (float in kinds and type(value) is int)
    if not fits:
        words = {bool: "true or false", int: "a whole number", float: "a number", type(None): "None"}
        wanted = " or ".join(words[k] for k in (bool, int, float, type(None)) if k in kinds)
        raise UserError(f"{name}={value!r} of {of} must be {wanted}.")
    return value


def _parse(name: str, text: str, default: Any) -> Any:
    try:
        if isinstance(default, bool):
            return {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}[text.lower()]
        if isinstance(default, int):
            return int(float(text)) if float(text).is_integer() else int(text)
        if isinstance(default, float):
            return float(text)
        if default is None:
            words = {"none": None, "true": True, "false": False}
            return words[text.lower()] if text.lower() in words else float(text)
    except (ValueError, KeyError):
        wanted = "a number or none" if default is None else type(default).__name__
        raise UserError(f"{name}='{text}' cannot be read as {wanted}; its default is {default!r}.") from None
    return text
