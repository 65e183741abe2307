"""What entries' names say: which of them are places, velocities and things around an agent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ringfence.problem.entries import HEADINGS, LANE, SPACE, SPEEDS, Entries


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
