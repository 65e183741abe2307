"""Stops: saturation limits, which logs come to again and again, to the digit, and never pass.

Speeds and steering have ends, batteries are full, rooms have walls. Networks that saw few steps there predict that who
pushes on goes on, so that a guard plans what nobody can do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import msgspec
import numpy as np
from msgspec.structs import replace

from ringfence.problem.entries import Entries
from ringfence.problem.features import FeatureMap
from ringfence.types import Array, X

SPEED, AHEAD = "own speed", "own speed ahead"  # which names do not give
OFTEN = 4  # times as often as the values next to it are logged, and as often would a linear law have passed it
BESIDE = 4  # values next to it
SURELY = 3.0  # times what that law errs by
ROUNDING = 4e-6  # of the value
STEPS = 20_000  # that the law is of
UNLIMITED = 1e9  # a speed
LARGEST = 1e15  # as of arrays that a store takes


class Stop(msgspec.Struct, frozen=True, omit_defaults=True):
    """What an entry, or a speed, does not pass."""

    name: str
    low: float | None = None
    high: float | None = None
    agent: int | None = None  # None: of all

    @property
    def words(self) -> str:
        whose = "" if self.agent is None else f" of agent {self.agent}"
        ends = [f"{end:.3g}" for end in (self.low, self.high) if end is not None]
        return f"{self.name}{whose} at {' and '.join(ends)}"

    def fits(self, map: FeatureMap) -> bool:
        """Whether it is of an agent and of a value that the view has, and what logs can come to."""
        ends = [end for end in (self.low, self.high) if end is not None]
        if not ends or any(not abs(end) <= LARGEST for end in ends) or ends != sorted(ends):
            return False
        known = self.agent is None or 0 <= self.agent < len(map.plus)
        if self.name == SPEED:
            return known and self.high is not None and self.high >= 0
        if self.name == AHEAD:
            return known and self.low is not None and self.low <= 0
        return known and self.name in map.names


@dataclass(frozen=True)
class Heading:
    """Entries that tell how fast a body that looks into a direction goes ahead: its velocity, or its speed, and that
    direction."""

    velocity: tuple[int, ...]  # two, or the speed
    direction: tuple[int, int]

    @classmethod
    def of(cls, names: Sequence[str]) -> Heading | None:
        """None where names tell of none."""
        known = Entries.of(names)
        if len(known.direction) < 2:
            return None
        cos, sin = known.direction
        if velocity := known.pair("v{}"):
            return cls(velocity, (cos, sin))
        return None if known.speed is None else cls((known.speed,), (cos, sin))

    def speed(self, x: X) -> X:
        """(...) ahead, of features (..., D): negative of who goes backwards."""
        if len(self.velocity) == 1:
            return x[..., self.velocity[0]]
        cos, sin = (x[..., d] for d in self.direction)
        vx, vy = (x[..., v] for v in self.velocity)
        return (vx * cos + vy * sin) / (cos**2 + sin**2 + 1e-9) ** 0.5

    def no_slower(self, x: Array, least: float) -> Array:
        """Features (..., D) with that speed ahead at least."""
        lacks = jnp.maximum(least - self.speed(x), 0.0)[..., None]
        if len(self.velocity) == 1:
            return x.at[..., np.array(self.velocity)].add(lacks)
        return x.at[..., np.array(self.velocity)].add(lacks * _ahead(x, self.direction))


class Saturation(NamedTuple):
    """The stops of agents, who are N, or 1 where all are alike, as arrays."""

    low: np.ndarray  # (N, D) float32, infinite where nothing stops
    high: np.ndarray
    fastest: np.ndarray  # (N,) UNLIMITED where nothing stops it

    @classmethod
    def of(cls, stops: Sequence[Stop], map: FeatureMap, agents: int) -> Saturation:
        at = Entries.of(map.names).at
        high = np.full((agents, len(at)), np.inf, np.float32)
        low, fastest = -high, np.full(agents, UNLIMITED, np.float32)
        for stop in stops:
            who = slice(None) if stop.agent is None else stop.agent
            if stop.name == SPEED:
                fastest[who] = stop.high
            elif stop.name in at:
                low[who, at[stop.name]] = -np.inf if stop.low is None else stop.low
                high[who, at[stop.name]] = np.inf if stop.high is None else stop.high
        return cls(low, high, fastest)


def saturated(stops: Sequence[Stop], map: FeatureMap, before: Array, after: Array) -> Array:
    """Features (..., N or 1, D) after a step, which are no farther beyond a stop than they were `before` it. What is
    relative to the own velocity goes with it."""
    if not stops:
        return after
    x = after
    low, high, fastest = Saturation.of(stops, map, x.shape[-2])
    if np.isfinite(low).any() or np.isfinite(high).any():
        x = jnp.clip(x, jnp.minimum(low, before), jnp.maximum(high, before))
    if (fastest < UNLIMITED).any():
        own = np.array(velocity_of(map.names))
        most = jnp.maximum(fastest, _length(before[..., own]))
        share = most / jnp.maximum(_length(x[..., own]), most)
        x = x.at[..., own].set(x[..., own] * share[..., None])
    least = next((stop.low for stop in stops if stop.name == AHEAD), None)
    heading = Heading.of(map.names)
    if least is not None and heading is not None:
        x = heading.no_slower(x, least)
    return _with_relative(map.names, after, x)


def _with_relative(names: Sequence[str], asked: Array, x: Array) -> Array:
    """Features (..., D) whose velocities less one's own follow from the own velocity, which was that of `asked`."""
    known = Entries.of(names)
    if own := _velocity(known):
        less = {axis: x[..., d] - asked[..., d] for axis, d in own.items()}
    elif known.speed is not None and len(known.direction) == 2:
        less = dict(zip(known.axes, jnp.moveaxis(_of_speed(known, x) - _of_speed(known, asked), -1, 0)))
    else:
        return x
    drifts = [e for e in known.each if e.role == "drift" and e.whose != "own" and e.axis in less]
    if not drifts:
        return x
    change = jnp.stack([less[e.axis] for e in drifts], -1)
    return x.at[..., np.array([e.source for e in drifts])].add(-change)


def _of_speed(known: Entries, x: Array) -> Array:
    return x[..., known.speed, None] * _ahead(x, known.direction)


def _ahead(x: Array, direction: Sequence[int]) -> Array:
    """(..., 2) the unit vector into the direction that features (..., D) tell."""
    towards = x[..., np.array(direction)]
    return towards / jnp.sqrt((towards**2).sum(-1, keepdims=True) + 1e-9)


def _length(x: Array) -> Array:
    return jnp.sqrt((x**2).sum(-1) + 1e-12)


def velocity_of(names: Sequence[str]) -> list[int]:
    """Own entries of a velocity along two axes or more; none where names tell of none."""
    own = _velocity(Entries.of(names))
    return [*own.values()] if len(own) > 1 else []


def _velocity(known: Entries) -> dict[str, int]:
    """Own entries of the velocity, by axis."""
    return {axis: known.own[f"v{axis}"] for axis in known.axes if f"v{axis}" in known.own}


# --- what logs say ---


def found(
    map: FeatureMap,
    predicted: np.ndarray,
    steps: tuple[np.ndarray, np.ndarray, np.ndarray],
    safe: np.ndarray,
    alike: bool,
) -> tuple[Stop, ...]:
    """Stops of the `predicted` entries, and of the own velocity, in `steps`: states before and after (S, N, D) and
    actions (S, N, A), of which (S,) are `safe`. Agents who are `alike`, and limbs of one body, have them together."""
    turning = {turn.entry for turn in map.turns}
    free = [d for d in predicted.tolist() if d not in turning]
    stops = [stop for who, each in _groups(map, steps, alike) for stop in _stops(map.names, free, who, *each)]
    stops = [*{(one.name, one.agent): one for one in (_of_all(each, stops, len(map.plus)) for each in stops)}.values()]
    heading = None if map.joint else Heading.of(map.names)
    if heading is not None:  # nobody brakes at rest in logs of cars
        _, after, _ = steps
        slowest = heading.speed(after[safe] if safe.any() else after).min()
        stops.append(Stop(AHEAD, min(float(slowest), 0.0)))
    return tuple(stops)


def _of_all(stop: Stop, stops: Sequence[Stop], agents: int) -> Stop:
    """The stop, of all where every agent has it."""
    alike = sum(one.name == stop.name and _same(one.low, stop.low) and _same(one.high, stop.high) for one in stops)
    return replace(stop, agent=None) if alike == agents else stop


def _same(one: float | None, other: float | None) -> bool:
    return one == other or (one is not None and other is not None and math.isclose(one, other, rel_tol=ROUNDING))


def _groups(
    map: FeatureMap, steps: tuple[np.ndarray, np.ndarray, np.ndarray], alike: bool
) -> Iterator[tuple[int | None, tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """(whose, states before and after (S, D) and actions (S, A))."""
    before, after, actions = steps
    if map.joint:
        yield None, (before[:, 0], after[:, 0], actions.reshape(len(actions), -1))
    elif alike:
        yield None, (_all(before), _all(after), _all(actions))
    else:
        for i in range(before.shape[1]):
            yield i, (before[:, i], after[:, i], actions[:, i])


def _all(x: np.ndarray) -> np.ndarray:
    return x.reshape(-1, x.shape[-1])


def _stops(
    names: Sequence[str], free: list[int], who: int | None, before: np.ndarray, after: np.ndarray, actions: np.ndarray
) -> Iterator[Stop]:
    ends = {d: _ends(lambda x: x[:, 0], before[:, [d]], after[:, [d]], before, actions) for d in free}
    own = velocity_of(names)
    if own and set(own) <= set(free):
        _, fastest = _ends(lambda x: np.sqrt((x**2).sum(-1)), before[:, own], after[:, own], before, actions)
        # who is fastest along each axis is fastest, and who is fastest is so along some axis, too
        if fastest is not None and not _same(fastest, math.hypot(*(ends[d][1] or 0.0 for d in own))):
            yield Stop(SPEED, None, fastest, who)
            for d in own:
                low, high = ends[d]
                low = None if low is not None and _same(-low, fastest) else low
                ends[d] = low, None if _same(high, fastest) else high
    for d, (low, high) in ends.items():
        if low is not None or high is not None:
            yield Stop(names[d], low, high, who)


def _ends(
    value: Callable[[np.ndarray], np.ndarray], x: np.ndarray, y: np.ndarray, before: np.ndarray, actions: np.ndarray
) -> tuple[float | None, float | None]:
    """(lowest, highest) of the `value` of entries (S, F), which steps take from x to y: where it ends, though a linear
    law of what is read (S, D) and done (S, A) would pass that."""
    values = value(y.astype(np.float64))
    ends = [(sign, end) for sign in (-1, 1) if (end := _end(sign * values)) is not None]
    if not ends:
        return None, None
    rng = np.random.default_rng(0)
    elsewhere = np.flatnonzero(~np.logical_or.reduce([there for _, (_, there) in ends]))
    some = rng.permutation(elsewhere)[:STEPS]
    if len(some) <= before.shape[1] + actions.shape[1] + 1:
        return None, None

    def read(steps: np.ndarray) -> np.ndarray:
        ones = np.ones((len(steps), 1))
        return np.concatenate([before[steps], actions[steps], ones], -1, dtype=np.float64)

    weights = np.linalg.lstsq(read(some), y[some].astype(np.float64) - x[some])[0]
    led = lambda steps: value(x[steps] + read(steps) @ weights)  # noqa: E731
    error = np.sqrt(((led(some) - values[some]) ** 2).mean())
    kept: list[float | None] = [None, None]
    for sign, (end, there) in ends:
        at = rng.permutation(np.flatnonzero(there))[:STEPS]
        if (sign * led(at) - end > SURELY * error).sum() >= OFTEN:
            kept[max(sign, 0)] = sign * end
    return kept[0], kept[1]


def _end(values: np.ndarray) -> tuple[float, np.ndarray] | None:
    """(the highest of values (S,), which are there), if so many are there as would not be by chance."""
    end = float(values.max())
    near = ROUNDING * abs(end)
    there = values >= end - near
    if there.sum() < OFTEN or there.all():
        return None
    rest, beside = values[~there], 0
    for _ in range(BESIDE):
        if not len(rest):
            break
        same = rest >= rest.max() - near
        beside += same.sum()
        rest = rest[~same]
    return (end, there) if there.sum() >= OFTEN * beside / BESIDE else None
