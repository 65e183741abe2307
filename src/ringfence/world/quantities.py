"""The language that danger is told in: numbers that are read of what agents see, and rules of these.

A quantity is read alike of each of J things, e.g. of all others: an entry, a length, how fast something comes nearer,
where it is to who looks somewhere, a weighted sum, an extreme or a sum over things or over the team. A rule is below 0
where all of its conditions hold. One evaluator reads NumPy's arrays, JAX's, and `Between`, all numbers from one to
another, of which it gives all that a quantity can be.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

SLOPED = 1e-9  # of squares, by which their root has a slope at 0, too
ORDINALS = ("", "second ", "third ", "fourth ", "fifth ", "sixth ")


class Between(NamedTuple):
    """All numbers from one to another, entry by entry."""

    low: Any
    high: Any

    def __getitem__(self, at: Any) -> Between:
        return Between(self.low[at], self.high[at])


class Entry(msgspec.Struct, frozen=True, tag=True):
    """An entry, of each thing; one alone is the same of all things: of oneself."""

    at: tuple[int, ...]  # (J,) or (1,) of the features
    name: str

    def of(self, x: Any) -> Any:
        return _picked(x, self.at)

    @property
    def parts(self) -> tuple[Quantity, ...]:
        return ()

    @property
    def words(self) -> str:
        return self.name


class Length(msgspec.Struct, frozen=True, tag=True):
    """How long a vector is; of one number, how far it is from 0."""

    parts: tuple[Quantity, ...]

    def of(self, x: Any) -> Any:
        return _length([part.of(x) for part in self.parts])

    @property
    def words(self) -> str:
        if len(self.parts) == 1:
            return f"|{self.parts[0].words}|"
        kind = _thing_at([part.words for part in self.parts])
        return f"{kind}.distance" if kind else f"length of {', '.join(part.words for part in self.parts)}"


class Closing(msgspec.Struct, frozen=True, tag=True):
    """How fast what is at an offset comes nearer, by its velocity to oneself."""

    offset: tuple[Quantity, ...]
    velocity: tuple[Quantity, ...]

    def of(self, x: Any) -> Any:
        offset, velocity = ([part.of(x) for part in vector] for vector in (self.offset, self.velocity))
        along = _total([_times(a, b) for a, b in zip(offset, velocity)])
        return _minus(_within(_over(along, _length(offset)), _length(velocity)))  # nothing is faster than it moves

    @property
    def parts(self) -> tuple[Quantity, ...]:
        return (*self.offset, *self.velocity)

    @property
    def words(self) -> str:
        return f"how fast {Length(self.offset).words} shrinks"


class Turned(msgspec.Struct, frozen=True, tag=True):
    """Of what is at an offset, to who looks into a direction, a vector or an angle (rad): how far ahead it is, how far
    to the left, or by what angle it is off the direction, to either side."""

    offset: tuple[Quantity, Quantity]
    direction: tuple[Quantity, ...]
    what: Literal["ahead", "aside", "angle"]

    def of(self, x: Any) -> Any:
        right, up = (part.of(x) for part in self.offset)
        looks = [part.of(x) for part in self.direction]
        cos, sin = _direction(looks)
        ahead = _total([_times(right, cos), _times(up, sin)])
        aside = _total([_times(up, cos), _minus(_times(right, sin))])
        if self.what == "angle":
            return _angle(_length([aside]), ahead)
        return ahead if self.what == "ahead" else aside

    @property
    def parts(self) -> tuple[Quantity, ...]:
        return (*self.offset, *self.direction)

    @property
    def words(self) -> str:
        kind, other = (_thing_at([part.words for part in vector]) for vector in (self.offset, self.direction))
        if other.startswith("another "):
            return f"angle between {kind} and {other}"
        return f"angle to {kind}" if self.what == "angle" else f"{kind}.{self.what}"


class Sum(msgspec.Struct, frozen=True, tag=True):
    """A weighted sum; with a number more it is a condition, which holds below 0."""

    parts: tuple[Quantity, ...]
    weights: tuple[float, ...]
    more: float | None = None

    def of(self, x: Any) -> Any:
        found = _total([_scaled(part.of(x), w) for part, w in zip(self.parts, self.weights)])
        return found if self.more is None else _plus(found, self.more)

    @property
    def words(self) -> str:
        """In units of the first part; a condition says what is below or above something."""
        unit = self.weights[0] if self.more is not None else 1.0
        terms = zip(self.parts, self.weights)
        said = "".join(_term(part.words, w / unit, k) for k, (part, w) in enumerate(terms))
        if self.more is None:
            return said
        return f"{said} {'below' if unit > 0 else 'above'} {-self.more / unit:.3g}"


class Product(msgspec.Struct, frozen=True, tag=True):
    """Numbers times each other, e.g. a force and a speed, which make a power."""

    parts: tuple[Quantity, Quantity]

    def of(self, x: Any) -> Any:
        return _times(*(part.of(x) for part in self.parts))

    @property
    def words(self) -> str:
        one, other = self.parts
        if other == Length((one,)):
            return f"the signed square of {one.words}"
        if other == one:
            return f"the square of {one.words}"
        return f"{one.words} times {other.words}"


class All(msgspec.Struct, frozen=True, tag=True):
    """The highest of several numbers: of conditions it is below 0 where all hold."""

    parts: tuple[Quantity, ...]

    def of(self, x: Any) -> Any:
        return _highest([part.of(x) for part in self.parts])

    @property
    def words(self) -> str:
        each = [part.words for part in self.parts]
        return " and ".join(each) if is_condition(self) else f"the highest of {', '.join(each)}"


class Over(msgspec.Struct, frozen=True, tag=True):
    """Of the numbers of all things, or of all agents: their sum, or the k-th lowest."""

    part: Quantity
    axis: Literal["things", "team"]
    rank: int = 0  # from 1 on; 0: the sum
    count: int = 0  # of the things; of a team it is as large as it is
    weights: tuple[float, ...] = ()  # of agents in a sum over the team; none: alike
    among: tuple[int, ...] = ()  # which of the things; none: all

    def of(self, x: Any) -> Any:
        """(..., N, 1) of features (..., N, D)."""
        each = self.part.of(x)
        if self.among:
            each = _picked(each, self.among)
        if self.weights:
            each = _times(each, _constant(each, np.array(self.weights, np.float32)[:, None]))
        if self.axis == "things":
            return _summed(each, -1) if not self.rank else _ranked(each, -1, self.rank)
        return _alike(_summed(each, (-2, -1)) if not self.rank else _ranked(each, -2, self.rank), each)

    @property
    def parts(self) -> tuple[Quantity, ...]:
        return (self.part,)

    @property
    def words(self) -> str:
        kind = self.part.words.strip("|").split(".")[0]
        some = ", ".join(f"{kind}{j}" for j in self.among)
        whose = "over the team" if self.axis == "team" else f"over {some or 'all'}"
        if self.weights:
            return f"sum of {self.part.words} times {', '.join(f'{w:.3g}' for w in self.weights)} {whose}"
        if not self.rank:
            return f"sum of {self.part.words} {whose}"
        if self.axis == "things" and self.part.words.endswith(".distance"):
            among = f" among {some}" if some else ""
            return f"{self.part.words} of the {ORDINALS[self.rank - 1]}nearest{among}"
        return f"{ORDINALS[self.rank - 1]}lowest {self.part.words} {whose}"


Quantity: TypeAlias = Entry | Length | Closing | Turned | Sum | Product | All | Over


def squared(quantity: Quantity) -> Product:
    """Its square, negative where it is."""
    return Product((quantity, quantity if isinstance(quantity, Length) else Length((quantity,))))


def leaves(quantity: Quantity) -> Iterator[Entry]:
    """The entries that it reads."""
    if isinstance(quantity, Entry):
        yield quantity
    for part in quantity.parts:
        yield from leaves(part)


def how_many(quantity: Quantity) -> int:
    """Of how many things it is read; 1 of oneself."""
    if isinstance(quantity, Over):
        return 1
    return len(quantity.at) if isinstance(quantity, Entry) else max(how_many(part) for part in quantity.parts)


def varies(quantity: Quantity, entries: np.ndarray) -> np.ndarray:
    """(N, J) bool: of which agents and things all that it reads varies, by the entries (N, D) that do."""
    if isinstance(quantity, Entry):
        return entries[:, list(quantity.at)]
    found = np.ones((len(entries), 1), bool)
    for part in quantity.parts:
        found = found & varies(part, entries)
    if isinstance(quantity, Over):
        found = found.all(-1, keepdims=True)
        found = found | (quantity.axis == "team" and bool(found.any()))
    return np.asarray(found)


def from_zero(quantity: Quantity) -> bool:
    """Whether it is a length, or one of several: nothing is less than 0."""
    if isinstance(quantity, Over):
        return from_zero(quantity.part)
    return isinstance(quantity, Length) or (isinstance(quantity, Turned) and quantity.what == "angle")


def is_condition(quantity: Quantity) -> bool:
    """Whether it is below 0 where something holds, one condition or several."""
    if isinstance(quantity, All):
        return all(is_condition(part) for part in quantity.parts)
    return isinstance(quantity, Sum) and quantity.more is not None


def goes_on(quantity: Quantity) -> bool:
    """Whether what is beyond all that was seen is like the nearest that was: nearer is worse. Of an entry it is not."""
    if isinstance(quantity, Over):
        return goes_on(quantity.part)
    return isinstance(quantity, (Length, All)) or (isinstance(quantity, Sum) and len(quantity.parts) > 1)


def _thing_at(words: Sequence[str]) -> str:
    """What kind of thing is at an offset that is called so, e.g. other.dx and other.dy; "" where it is none."""
    found = [re.fullmatch(r"(.*)\.d(\w)", one) for one in words]
    kinds = {match[1] for match in found if match}
    return kinds.pop() if all(found) and len(kinds) == 1 else ""


def _term(words: str, weight: float, k: int) -> str:
    size = "" if f"{abs(weight):.3g}" == "1" else f"{abs(weight):.3g} times "
    sign = "less " if weight < 0 else "plus " if k else ""
    return f"{' ' if k else ''}{sign}{size}{words}"


# --- arithmetic of arrays and of what is between two of them ---


def _numbers(array: Any) -> Any:
    return jnp if isinstance(array, jax.Array) else np


def _picked(x: Any, at: Sequence[int]) -> Any:
    index = np.array(at)
    return Between(x.low[..., index], x.high[..., index]) if isinstance(x, Between) else x[..., index]


def _minus(a: Any) -> Any:
    return Between(-a.high, -a.low) if isinstance(a, Between) else -a


def _plus(a: Any, number: float) -> Any:
    return Between(a.low + number, a.high + number) if isinstance(a, Between) else a + number


def _scaled(a: Any, weight: float) -> Any:
    if not isinstance(a, Between):
        return a * weight
    return Between(a.low * weight, a.high * weight) if weight >= 0 else Between(a.high * weight, a.low * weight)


def _total(parts: Sequence[Any]) -> Any:
    if isinstance(parts[0], Between):
        return Between(_total([part.low for part in parts]), _total([part.high for part in parts]))
    found = parts[0]
    for part in parts[1:]:
        found = found + part
    return found


def _times(a: Any, b: Any) -> Any:
    if not isinstance(a, Between):
        return a * b
    corners = [one * two for one in a for two in b]
    return Between(_least(corners), _highest(corners))


def _constant(a: Any, number: Any) -> Any:
    return Between(number, number) if isinstance(a, Between) else number


def _over(a: Any, length: Any) -> Any:
    """By lengths, which are above 0."""
    if not isinstance(a, Between):
        return a / length
    where = _numbers(a.low).where
    low, high = a
    near, far = length
    return Between(where(low < 0, low / near, low / far), where(high > 0, high / near, high / far))


def _within(a: Any, most: Any) -> Any:
    """No farther from 0 than that."""
    if not isinstance(a, Between):
        return a
    numbers = _numbers(a.low)
    far = most.high if isinstance(most, Between) else most
    return Between(numbers.maximum(a.low, -far), numbers.minimum(a.high, far))


def _square(a: Any) -> Any:
    if not isinstance(a, Between):
        return a * a
    numbers = _numbers(a.low)
    nearest = numbers.maximum(numbers.maximum(a.low, -a.high), 0.0)
    return Between(nearest * nearest, numbers.maximum(a.low * a.low, a.high * a.high))


def _length(parts: Sequence[Any]) -> Any:
    square = _total([_square(part) for part in parts])
    if isinstance(square, Between):
        return Between((square.low + SLOPED) ** 0.5, (square.high + SLOPED) ** 0.5)
    return (square + SLOPED) ** 0.5


def _highest(parts: Sequence[Any]) -> Any:
    if isinstance(parts[0], Between):
        return Between(_highest([part.low for part in parts]), _highest([part.high for part in parts]))
    found = parts[0]
    for part in parts[1:]:
        found = _numbers(found).maximum(found, part)
    return found


def _least(parts: Sequence[Any]) -> Any:
    return -_highest([-part for part in parts])


def _summed(a: Any, axis: Any) -> Any:
    return Between(*(_summed(one, axis) for one in a)) if isinstance(a, Between) else a.sum(axis, keepdims=True)


def _ranked(a: Any, axis: int, rank: int) -> Any:
    """The k-th lowest; both ends are, where each is between two."""
    if isinstance(a, Between):
        return Between(*(_ranked(one, axis, rank) for one in a))
    numbers = _numbers(a)
    return numbers.take(numbers.sort(a, axis=axis), np.array([rank - 1]), axis=axis)


def _alike(a: Any, each: Any) -> Any:
    """What is the team's (..., 1, 1), of every agent (..., N, 1)."""
    if isinstance(a, Between):
        return Between(_alike(a.low, each.low), _alike(a.high, each.high))
    return _numbers(a).broadcast_to(a, (*each.shape[:-1], 1))


def _direction(looks: Sequence[Any]) -> tuple[Any, Any]:
    """Cosine and sine of a direction."""
    if len(looks) > 1:
        long = _length(looks)
        one = 1.0
        cos, sin = (_within(_over(part, long), one) for part in looks)
        return cos, sin
    (angle,) = looks
    if not isinstance(angle, Between):
        numbers = _numbers(angle)
        return numbers.cos(angle), numbers.sin(angle)
    middle, turns = (angle.low + angle.high) / 2, (angle.high - angle.low) / 2
    numbers = _numbers(middle)
    cos, sin = numbers.cos(middle), numbers.sin(middle)
    across = numbers.sin(numbers.minimum(turns, np.pi / 2))
    back = 1.0 - numbers.cos(numbers.minimum(turns, np.pi))
    by_cos = abs(sin) * across + abs(cos) * back
    by_sin = abs(cos) * across + abs(sin) * back
    return Between(cos - by_cos, cos + by_cos), Between(sin - by_sin, sin + by_sin)


def _angle(aside: Any, ahead: Any) -> Any:
    """(rad) of what is so far aside, which is above 0, and ahead."""
    if not isinstance(ahead, Between):
        return _numbers(ahead).arctan2(aside, ahead)
    numbers = _numbers(ahead.low)
    # Of a box the angle is least where it is most ahead, at the side that is nearer where that is ahead.
    least = numbers.arctan2(numbers.where(ahead.high > 0, aside.low, aside.high), ahead.high)
    most = numbers.arctan2(numbers.where(ahead.low > 0, aside.high, aside.low), ahead.low)
    return Between(least, most)
