"""What entries' names say: whose each is, which of several, in which role and along which axis (docs/import.md)."""

from __future__ import annotations

import functools
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

SPACE, LANE = "xyz", "sd"  # axes: of a plane or space; along a lane and aside
HEADINGS = ("heading", "yaw", "theta", "psi")  # angles from the first axis towards the second, rad
DEGREES, RADIANS = ("_deg", "_degrees"), ("_rad", "_radians")  # after the name of an angle
SPEEDS = ("v", "speed")
_NAME = re.compile(r"([a-z_]+?)([0-9]{0,9})\.(.+)")
_WORD = re.compile(r"\w+")
_MOTION = re.compile(rf"(d?v?)([{SPACE}{LANE}])")

Role = Literal["place", "velocity", "offset", "drift", "number"]  # drift: a velocity less one's own
_ROLES: dict[str, Role] = {"": "place", "v": "velocity", "d": "offset", "dv": "drift"}
# names that do not say whose an entry is, e.g. robot0_dvx
_LOOSE = re.compile(
    rf"(?:.*?(?<![a-z]))??(d|delta[._ ]?|rel[._ ]?)?(?:(v|vel|velocity|speed)|p|pos|position)?[._ ]?([{SPACE}])"
)
_NUMBERS = re.compile(rf"(?:.*(?<![a-z]))?d?(?:cos|sin|{'|'.join((*HEADINGS, *SPEEDS))})")


class Entry(NamedTuple):
    """An entry of observations, of the state or of a view."""

    whose: str  # own, other, or as a thing is called; "" where the name does not say
    order: int | None  # which of several of that name: 1 of other1
    what: str  # the rest of the name
    role: Role
    axis: str  # one of SPACE or LANE; "" of a number
    source: int  # which entry it is


def loosely(name: str) -> tuple[Role | None, str]:
    """What a name may mean that does not say whose its entry is, and along which axis: a drift along x of `robot0_dvx`,
    a number of `cos` and `truck0_speed`; None where it says nothing."""
    if match := _LOOSE.fullmatch(name.lower()):
        return _ROLES["d" * bool(match[1]) + "v" * bool(match[2])], match[3]
    return ("number" if _NUMBERS.fullmatch(name.lower()) else None), ""


def axes_of(fields: Collection[str], pattern: str = "d{}") -> str:
    """The axes along which fields of one body tell something, e.g. `dx` and `dy`; those of a lane where both are."""
    found = "".join(axis for axis in SPACE if pattern.format(axis) in fields)
    return found or LANE * all(pattern.format(axis) in fields for axis in LANE)


@dataclass(frozen=True)
class Entries:
    """All that the names of entries say, in their order."""

    names: tuple[str, ...]

    @classmethod
    def of(cls, names: Sequence[str]) -> Entries:
        """The same value for the same names, since it is asked often."""
        return _entries(tuple(names))

    @cached_property
    def at(self) -> dict[str, int]:
        """Entries by name."""
        return {name: d for d, name in enumerate(self.names)}

    @cached_property
    def bodies(self) -> dict[tuple[str, int | None], dict[str, int]]:
        """Fields of oneself, of others and of things, by what each is called and which of several it is."""
        found: dict[tuple[str, int | None], dict[str, int]] = {}
        for d, name in enumerate(self.names):
            if match := _NAME.fullmatch(name):
                found.setdefault((match[1], int(match[2]) if match[2] else None), {})[match[3]] = d
        return found

    @cached_property
    def each(self) -> tuple[Entry, ...]:
        """Every entry whose name says whose it is, in their order."""
        found = []
        for (whose, order), fields in self.bodies.items():
            for what, d in fields.items():
                match = _MOTION.fullmatch(what)
                role, axis = "number", ""
                if match and match[2] in axes_of(fields, match[1] + "{}"):
                    role, axis = _ROLES[match[1]], match[2]
                found.append(Entry(whose, order, what, role, axis, d))
        return tuple(sorted(found, key=lambda entry: entry.source))

    @cached_property
    def own(self) -> dict[str, int]:
        """Fields of oneself."""
        return self.bodies.get(("own", None), {})

    @cached_property
    def numbered(self) -> dict[str, list[dict[str, int]]]:
        """Fields of each of several things that names number (`other0.dx`, `wall1.dy`), by kind and in order."""
        found: dict[str, dict[int, dict[str, int]]] = {}
        for (kind, order), fields in self.bodies.items():
            words = {what: d for what, d in fields.items() if _WORD.fullmatch(what)}
            if order is not None and "_" not in kind and words:
                found.setdefault(kind, {})[order] = words
        return {kind: [fields for _, fields in sorted(things.items())] for kind, things in found.items()}

    @property
    def others(self) -> list[dict[str, int]]:
        """Fields of each of the others."""
        return self.numbered.get("other", [])

    @cached_property
    def axes(self) -> str:
        """Along which bodies move: a plane, space where anything is told along z, or a lane."""
        known = [(self.own, "{}"), (self.own, "v{}"), *((other, "d{}") for other in self.others[:1])]
        known += [(self.bodies.get(("agent", 0), {}), pattern) for pattern in ("{}", "v{}")]
        told = {axis for fields, pattern in known for axis in axes_of(fields, pattern)}
        return SPACE if "z" in told else LANE if told & set(LANE) and not told & set(SPACE) else SPACE[:2]

    def pair(self, pattern: str) -> tuple[int, ...]:
        """Own entries along the axes of a plane or a lane, e.g. v{}; none where one is not told."""
        fields = [pattern.format(axis) for axis in self.axes[:2]]
        return tuple(self.own[field] for field in fields) if set(fields) <= set(self.own) else ()

    @cached_property
    def direction(self) -> tuple[int, ...]:
        """Entries of where one looks: its cosine and sine, or an angle; none where names tell none."""
        for angle in ("", *(f"_{word}{unit}" for word in HEADINGS for unit in ("", *DEGREES, *RADIANS))):
            if f"cos{angle}" in self.own and f"sin{angle}" in self.own:
                return self.own[f"cos{angle}"], self.own[f"sin{angle}"]
        return next(((self.own[word],) for word in HEADINGS if word in self.own), ())

    @cached_property
    def speed(self) -> int | None:
        """The entry of how fast one goes ahead."""
        return next((self.own[word] for word in SPEEDS if word in self.own), None)


_entries = functools.lru_cache(256)(Entries)


@dataclass(frozen=True, eq=False)
class Names:
    """Which entries of observations (O) and of the state (S) say what."""

    observation: dict[str, int]
    state: dict[str, int]
    agents: int

    @classmethod
    def of(cls, observation: Sequence[str], state: Sequence[str], agents: int) -> Names:
        """Of entries in their order; of none where nobody names them."""
        return cls({n: d for d, n in enumerate(observation)}, {n: d for d, n in enumerate(state)}, agents)

    @cached_property
    def entries(self) -> Entries:
        """What names say of observations."""
        return Entries.of(list(self.observation))

    @cached_property
    def axes(self) -> str:
        """Along which agents move: a plane, or space where something is logged along z."""
        each = {self.entries.axes, Entries.of(list(self.state)).axes}
        return next((axes for axes in (SPACE, LANE) if axes in each), SPACE[:2])

    def pair(self, pattern: str) -> list[int] | None:
        """Entries of x and y (and z in space), where all are observed; `pattern` as own.v{}."""
        found = [self.observation.get(pattern.format(axis)) for axis in self.axes]
        return None if None in found else [d for d in found if d is not None]

    def state_pair(self, pattern: str) -> list[int] | None:
        found = [self.state.get(pattern.format(axis)) for axis in self.axes]
        return None if None in found else [d for d in found if d is not None]

    def pairs(self, pattern: str, count: int) -> list[list[int]] | None:
        """The pairs of `count` things, e.g. other{}.d{{}}, where all are observed."""
        found = [self.pair(pattern.format(j)) for j in range(count)]
        return None if None in found else [pair for pair in found if pair is not None]

    def state_pairs(self, pattern: str) -> list[list[int]] | None:
        """The same of every agent in the state."""
        found = [self.state_pair(pattern.format(j)) for j in range(self.agents)]
        return None if None in found else [pair for pair in found if pair is not None]

    @cached_property
    def slots(self) -> int:
        """How many others are observed relative to an agent."""
        count = 0
        while self.pair(f"other{count}.d{{}}") is not None:
            count += 1
        return count

    @cached_property
    def things(self) -> list[str]:
        """What else is observed relative to an agent, e.g. goal and landmark0."""
        found = dict.fromkeys((e.whose, e.order) for e in self.entries.each if e.role == "offset")
        named = [(whose, "" if order is None else str(order)) for whose, order in found]
        return [whose + order for whose, order in named if not (whose == "other" and order) and whose + order != "own"]

    @cached_property
    def as_logged(self) -> list[str]:
        """Entries of a driven agent that stay as they were logged: no name says how they follow from its motion."""
        own = self.entries.own
        moved = {e.source for e in self.entries.each if e.role in ("offset", "drift")}
        moved |= {e.source for e in self.entries.each if e.whose == "own" and e.role in ("place", "velocity")}
        moved |= {*self.entries.direction, *(own[word] for word in (*HEADINGS, *SPEEDS) if word in own)}
        moved |= {other["seen"] for other in self.entries.others if "seen" in other}
        return [name for d, name in enumerate(self.observation) if d not in moved]

    @cached_property
    def resting(self) -> list[list[int]]:
        """The entries of x and y (and z) of what is observed relative to an agent and does not move by itself."""
        found = [self.pair(f"{name}.d{{}}") for name in self.things if f"{name}.dvx" not in self.observation]
        return [pair for pair in found if pair is not None]

    @cached_property
    def place_is_unknown(self) -> bool:
        """Whether no entry says where agents are."""
        return self.pair("own.{}") is None and self.state_pairs("agent{}.{{}}") is None

    def place(self, observations: np.ndarray, state: np.ndarray | None) -> np.ndarray | None:
        """(..., N, X) m where agents are, of observations (..., N, O) and a state (..., S); None where nothing says."""
        if own := self.pair("own.{}"):
            return observations[..., own]
        if state is not None and (where := self.state_pairs("agent{}.{{}}")):
            return state[..., where]
        return None

    @cached_property
    def placed(self) -> bool:
        """Whether everybody's place is known."""
        return self.agents > 1 and not self.place_is_unknown
