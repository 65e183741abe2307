"""What agents observe at run time, as in the store of a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ringfence.errors import UserError, of_kind
from ringfence.logs.io.rows import angle_of
from ringfence.logs.io.tracks import Tracks, nearest
from ringfence.logs.schema import GivenCard, StoreCard
from ringfence.problem.entries import SPACE, Entries, Entry
from ringfence.problem.partners import others
from ringfence.utils import schemas
from ringfence.utils.given import given_as, refuse_other_order


def observe(
    card: GivenCard,
    state: Mapping[str, Any],
    goal: Mapping[str, Any] | None = None,
    agents: Sequence[Any] | None = None,
) -> np.ndarray:
    """(N, O) what agents observe now, as in the store of a table with this `card`: for a policy at run time.

    `state` holds (N,) of every column of the table's state (velocities, too, if the import had to make them), and
    `goal` those of x, y, z: where each agent is to go. Agents stand in the order of the card's `agents`: others named
    here are refused. Agents who are homogeneous come in any number and order. Numbers are as they were measured: where
    the card tells origins, they are in double precision, and whoever acts on them takes the origins from them.
    """
    of_kind("card", card, StoreCard | Mapping, "give a store's card")
    of_kind("state", state, Mapping, "give a dictionary of columns, with one number of each agent")
    of_kind("goal", goal, Mapping | None, "give a dictionary of columns, with one number of each agent")
    fields = card.to_dict() if isinstance(card, StoreCard) else card
    try:
        schemas.check(dict(fields), schemas.Data)
    except ValueError as error:
        raise UserError(f"card is none of a store ({error}); give that of one which from_table made.") from None
    names: list[str] = list(fields.get("observation_names") or ())
    if not names:
        raise UserError("card names no observations; give that of a store which from_table made.")
    columns = {name: _numbers(f"state['{name}']", column) for name, column in state.items()}
    goals = {name: _numbers(f"goal['{name}']", column) for name, column in (goal or {}).items()}
    for name in [name for name in columns if f"own.cos_{name}" in names]:
        angle = angle_of(name, columns[name])
        columns |= {f"cos_{name}": np.cos(angle), f"sin_{name}": np.sin(angle)}
    if agents is not None:
        refuse_other_order(agents, None if fields.get("homogeneous") else fields.get("agents"))
    shapes = {column.shape for column in (*columns.values(), *goals.values())}
    if len(shapes) != 1 or len(next(iter(shapes))) != 1:
        raise UserError(f"state and goal hold arrays of shapes {sorted(shapes)}; give one number per agent of each.")
    known = {e.source: e for e in Entries.of(names).each}
    places = 1 + max((e.order for e in known.values() if e.whose == "other" and e.order is not None), default=-1)
    whom = _seen_by_each(fields, columns, places)
    now = _Now(columns, goals, whom, float(fields.get("sensing_radius") or np.inf))
    seen = np.stack([now.entry(name, known.get(d)) for d, name in enumerate(names)], 1)
    return seen if fields.get("observation_origins") else seen.astype(np.float32)


def _numbers(name: str, column: Any) -> np.ndarray:
    """(N,) finite numbers, in double precision."""
    found = given_as(name, column, (None,), "observe()", "give one number of each agent", double=True)
    return found.astype(np.float64)


@dataclass(frozen=True, eq=False)
class _Now:
    """N agents at one time."""

    columns: dict[str, np.ndarray]  # (N,)
    goals: dict[str, np.ndarray]  # (N,)
    others: np.ndarray  # (N, M) whom each agent sees, -1 where nobody is near
    sensing_radius: float  # m

    def entry(self, name: str, known: Entry | None) -> np.ndarray:
        """(N,) of an observation's entry, of which so much is known."""
        whose, order, what = known[:3] if known else ("", None, name)
        relative = what[:1] == "d" and what[1:] in self.columns
        column = what[1:] if relative else what
        if whose == "goal" and column in self.goals:
            return self.goals[column] - self.columns[column]
        if whose == "own" and what in self.columns:
            return self.columns[what]
        if whose == "other" and order is not None and (what == "seen" or column in self.columns):
            who = self.others[:, order]
            if what == "seen":
                return (who >= 0).astype(float)
            own = self.columns[column]
            theirs = own[who] - own if relative else own[who]
            first_axis = next((axis for axis in SPACE if axis in self.columns), None)
            # nobody is as far along the first axis as one senses
            return np.where(who >= 0, theirs, self.sensing_radius if column == first_axis else 0.0)
        made = whose == "own" and what[:1] == "v" and what[1:] in self.columns
        remedy = (
            f"add {what} to state: what {what[1:]} changed by since the row before, per second" if made else "add it"
        )
        raise UserError(f"The logs observe '{name}', which state and goal do not tell; {remedy}.")


def _seen_by_each(card: Mapping[str, Any], columns: dict[str, np.ndarray], slots: int) -> np.ndarray:
    """(N, slots) whom each agent sees."""
    n = len(next(iter(columns.values())))
    if not card.get("homogeneous"):
        if n != slots + 1:
            raise UserError(f"state tells of {n} agents, the logs of {slots + 1}; give all of them.")
        return others(n)
    zero = np.zeros(n, int)
    place = np.stack([columns[axis] for axis in SPACE if axis in columns], 1)
    now = Tracks(zero, np.arange(n), np.arange(n), zero, place, place, zero, zero, zero > 0, card.get("dt", 1.0))
    return nearest(now, place, slots, float(card.get("sensing_radius") or np.inf))
