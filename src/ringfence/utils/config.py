"""Configs: frozen dataclasses whose fields carry their bounds, built from names and values that anybody may have given.

Bounds are `Annotated[int, Meta(ge=1)]`. A `description` in one replaces the usual words of its refusal: what the value
"must" do.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta

from ringfence.errors import UserError, of_kind, one_of, unknown

Count = Annotated[int, Meta(ge=1, le=10**9)]  # updates
BatchSize = Annotated[int, Meta(ge=1, le=10**8)]
Width = Annotated[int, Meta(ge=1, le=10**5)]  # units of a layer
Depth = Annotated[int, Meta(ge=1, le=1000)]  # layers
Rows = Annotated[int, Meta(ge=2, le=10_000)]  # of a window
AtLeastOne = Annotated[int, Meta(ge=1)]
Natural = Annotated[int, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
NonNegative = Annotated[float, Meta(ge=0)]
Positive = Annotated[float, Meta(gt=0)]

LARGEST = 2**53  # up to here whole numbers are floats, too
KINDS = {bool: "true or false", int: "a whole number", float: "a number", type(None): "None"}
SPELLINGS = {"none": "null", "yes": "true", "no": "false"}  # what text may say for JSON's words
C = TypeVar("C")


@dataclass(frozen=True)
class Field:
    """A field of a config: its type taken apart."""

    name: str
    hint: Any
    default: Any
    kinds: frozenset[type]  # members of a union, or the one type
    choices: tuple[str, ...]  # of a literal
    bounds: Meta | None


@functools.cache
def fields_of(config: type) -> dict[str, Field]:
    """The fields of a config dataclass by name."""
    hints = get_type_hints(config, include_extras=True)
    return {f.name: _field(f.name, hints[f.name], f.default) for f in dataclasses.fields(config)}


def build_config(config: type[C], changes: Mapping[str, Any], of: str) -> C:
    """A config dataclass from named changes; strings are read as the field's type. Unknown names, values of another
    type and values out of bounds are refused in the name of who reads them, `of`."""
    of_kind(f"what {of} are made of", changes, Mapping, "give a dictionary of their fields")
    fields = fields_of(config)
    values = {}
    for name, given in changes.items():
        field = one_of(f"config field of {of}", name, fields)
        value = read_text(field, given) if isinstance(given, str) else _of_type(field, given, of)
        refuse_out_of_bounds(field, value, of)
        values[name] = value
    return config(**values)


def check_bounds(config: Any) -> None:
    """Refuse a config, made by whatever means, with a value out of its field's bounds."""
    for name, field in fields_of(type(config)).items():
        refuse_out_of_bounds(field, getattr(config, name))


def read_text(field: Field, text: str) -> Any:
    """A value that somebody wrote, e.g. `--set name=1e3`."""
    if field.choices or field.kinds == {str}:
        return text
    word = text.strip()
    kind = functools.reduce(lambda one, other: one | other, field.kinds)
    try:
        return msgspec.convert(SPELLINGS.get(word.lower(), word), kind, strict=False)
    except msgspec.ValidationError:
        wanted = "a number or none" if field.default is None else type(field.default).__name__
        problem = f"{field.name}='{text}' cannot be read as {wanted}; its default is {field.default!r}."
        raise UserError(problem) from None


def refuse_out_of_bounds(field: Field, value: Any, of: str = "") -> None:
    """Refuse a number out of the field's bounds, one that is not finite, and none of a literal's values."""
    if field.choices and (not isinstance(value, str | int | float | None) or value not in field.choices):
        raise unknown(f"value of {of}'s {field.name}" if of else field.name, str(value), map(str, field.choices))
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    bounds = field.bounds or Meta()
    limits = (bounds.ge, operator.ge), (bounds.gt, operator.gt), (bounds.le, operator.le), (bounds.lt, operator.lt)
    if abs(value) < LARGEST and all(limit is None or holds(value, limit) for limit, holds in limits):
        return
    owner = f" of {of}" if of else ""
    raise UserError(f"{field.name}={value}{owner} must {bounds.description or _in_words(value, bounds)}.")


def _field(name: str, hint: Any, default: Any) -> Field:
    members = get_args(hint) if type(None) in get_args(hint) else (hint,)
    bounds = next((extra for m in members if get_origin(m) is Annotated for extra in get_args(m)[1:]), None)
    kinds = frozenset(get_args(m)[0] if get_origin(m) is Annotated else m for m in members)
    choices = get_args(hint) if get_origin(hint) is Literal else ()
    return Field(name, hint, default, kinds, choices, bounds)


def _of_type(field: Field, value: Any, of: str) -> Any:
    """A value given from Python, of the field's type: 1e3 is a whole number, True is none."""
    value = value.item() if isinstance(value, np.generic) else value
    if not field.kinds <= KINDS.keys():
        return value  # literals are compared with their bounds; of another type, its algorithm knows more
    if field.kinds == {int} and isinstance(value, float) and value.is_integer():
        return int(value)
    whole_for_float = float in field.kinds and type(value) is int
    if type(value) not in field.kinds and not whole_for_float:
        wanted = " or ".join(words for kind, words in KINDS.items() if kind in field.kinds)
        raise UserError(f"{field.name}={value!r} of {of} must be {wanted}.")
    return value


def _in_words(value: float, bounds: Meta) -> str:
    """What a value that is out of bounds must do."""
    if bounds.gt == 0 and value <= 0:
        return "be positive"
    if bounds.ge is not None and bounds.le is not None and bounds.le <= 1000:
        return f"be between {bounds.ge} and {bounds.le}"
    if bounds.ge is not None and value < bounds.ge:
        return f"be at least {bounds.ge}"
    return "be finite" if bounds.le is None else f"be at most {bounds.le}"
