"""Logs are moved towards 0 where their numbers lie so far from it that single precision blurs their steps.

Places are moved, and what no name tells. Velocities, offsets and flags mean what they say, to dangers and replays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ringfence.logs.schema import LARGEST, StoreCard
from ringfence.problem.entries import Entries, loosely

COARSE = 0.01  # of what an entry changes by in a step: the distance of neighbouring numbers above which it is coarse
FAR = 8.0  # times the range of an entry that it is away from 0, so that moving it gains three bits or more
SHARED = 0.1  # of their size: entries that are as near to each other are moved together, so that they still compare
STEPS = 20_000  # that are looked at, at most
ROUNDED = 4 * np.finfo(np.float64).eps  # of a number: what changes by less does not change
Names = Mapping[str, Sequence[str] | None]  # of the entries of arrays


@dataclass(frozen=True, eq=False)
class _Entry:
    """What is known of one entry of an array."""

    least: float
    most: float
    moves: bool
    is_coarse: bool

    @property
    def middle(self) -> float:
        return (self.least + self.most) / 2

    def near(self, value: float) -> bool:
        return self.moves and max(abs(self.least - value), abs(self.most - value)) <= SHARED * abs(value)


def gap_at(largest: np.ndarray) -> np.ndarray:
    """The distance of neighbouring numbers of single precision at numbers of these sizes."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is larger than any such number is refused later
        return np.spacing(np.abs(largest).astype(np.float32)).astype(np.float64)


def moved(
    observations: np.ndarray, state: np.ndarray | None, episode_ends: np.ndarray, card: StoreCard
) -> tuple[np.ndarray, np.ndarray | None, StoreCard]:
    """Observations (T+E, N, O) and state (T+E, S) in single precision, moved where that is needed, and the card, which
    says by what. What is in single precision already has lost what it has lost, and a card that tells origins is of
    logs that were moved before."""
    given = {"observations": observations, "state": state}
    precise = {name: array for name, array in given.items() if array is not None and array.dtype.itemsize > 4}
    if precise and not card.origins:
        rows = looked_at(episode_ends)
        names = {"observations": card.observation_names, "state": card.state_names}
        for name, origins in origins_of({name: (x[rows], x[rows + 1]) for name, x in precise.items()}, names).items():
            given[name] = precise[name] - origins
            card = moved_by(card, name, origins)
    near = {name: None if x is None else x.astype(np.float32, copy=False) for name, x in given.items()}
    assert near["observations"] is not None
    return near["observations"], near["state"], card


def moved_by(card: StoreCard, name: str, origins: np.ndarray) -> StoreCard:
    """The card that says what origins (D,) of an array are."""
    names = card.observation_names if name == "observations" else card.state_names
    named = names if names and len(names) == len(origins) else [f"entry {d}" for d in range(len(origins))]
    some = [f"{origins[d]:.10g} from {named[d]}" for d in np.flatnonzero(origins)]
    warning = (
        f"{name} are moved towards 0, where single precision tells them apart: {', '.join(some)} is subtracted, and so "
        "it is from what is given at run time"
    )
    field = "observation_origins" if name == "observations" else "state_origins"
    return card.updated(**{field: origins.tolist(), "warnings": [*card.warnings, warning]})


def looked_at(episode_ends: np.ndarray) -> np.ndarray:
    """(K,) rows of T+E whose steps are looked at; each is followed by the row that its step leads to."""
    steps = np.unique(np.linspace(0, episode_ends[-1] - 1, STEPS).astype(int))
    return steps + np.searchsorted(episode_ends, steps, side="right")


def origins_of(pairs: Mapping[str, tuple[np.ndarray, np.ndarray]], names: Names) -> dict[str, np.ndarray]:
    """(D,) what to take from the entries of arrays, of those of which something is to be taken; of each the rows that
    are looked at, before and after a step, (K, ..., D), and what its entries are called.

    Entries whose numbers are near to each other have the same origin, whatever array they are of: their differences
    stay what they are.
    """
    entries = {
        name: list(_entries(*pair, _may_move(names.get(name), pair[0].shape[-1]))) for name, pair in pairs.items()
    }
    found = {name: np.zeros(len(each)) for name, each in entries.items()}
    for members in _clusters([one for each in entries.values() for one in each]):
        origin = _round(min(one.least for one in members), max(one.most for one in members))
        for name, each in entries.items():
            found[name][[d for d, one in enumerate(each) if one in members]] = origin
    return {name: origins for name, origins in found.items() if origins.any()}


def _may_move(names: Sequence[str] | None, size: int) -> np.ndarray:
    """(D,) entries that are places, or may be."""
    if names is None or len(names) != size:
        return np.ones(size, bool)
    whose = {entry.source: entry for entry in Entries.of(names).each}
    found = []
    for d, name in enumerate(names):
        role, what = (whose[d].role, whose[d].what) if d in whose else (None, name)
        role = loosely(what)[0] if role in (None, "number") else role
        found.append(role in (None, "place") and what != "seen")
    return np.array(found)


def _entries(before: np.ndarray, after: np.ndarray, may_move: np.ndarray) -> Iterator[_Entry]:
    for d in range(before.shape[-1]):
        first = before[..., d]
        values = np.stack([first, after[..., d]]).astype(np.float64)
        if not (np.abs(values) <= LARGEST).all():  # refused later, by name
            yield _Entry(0.0, 0.0, False, False)
            continue
        least = float(values.min())
        most = float(values.max())
        change = np.abs(values[1] - values[0])
        changes = change > ROUNDED * np.abs(values).max(0)
        usual = float(np.median(change[changes])) if changes.any() else 0.0
        far = abs(least + most) / 2 >= FAR * (most - least)
        blurred = float(gap_at(np.array(max(-least, most)))) > COARSE * usual
        yield _Entry(least, most, bool(may_move[d]), bool(may_move[d]) and usual > 0 and far and blurred)


def _clusters(entries: list[_Entry]) -> Iterator[list[_Entry]]:
    """Coarse entries that are near to each other, with all others that are as near."""
    left = sorted((one for one in entries if one.is_coarse), key=lambda one: one.middle)
    while left:
        center = left[0].middle
        members = [one for one in entries if one.near(center)]
        yield members
        left = [one for one in left[1:] if one not in members]


def _round(least: float, most: float) -> float:
    """A round number near the middle of a range: logs of the same place are likely to be moved by the same."""
    unit = 10.0 ** np.ceil(np.log10(max(most - least, 1e-9)))
    return float(np.round((least + most) / 2 / unit) * unit)
