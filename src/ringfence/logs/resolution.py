"""Numbers so far from 0 that single precision tells them apart poorly, such as coordinates of a map in metres."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ringfence.errors import StoreError
from ringfence.logs.moving import gap_at, looked_at
from ringfence.logs.store import EpisodeStore

COARSE = 0.01  # of an entry's deviation: the distance of neighbouring numbers above which it is coarse
BLURRED = 0.25  # of what it changes by in a step: the distance above which nothing can be learned of its change


def coarse(store: EpisodeStore) -> list[str]:
    """Warnings of entries whose values are poorly resolved."""
    warnings = []
    for what, array, _ in _sources(store):
        flat = array.reshape(-1, array.shape[-1])
        spread = flat.std(0, dtype=np.float64)
        found = np.flatnonzero((spread > 0) & (_gap(flat) > COARSE * spread))
        if len(found):
            warnings.append(
                f"{what} entries {', '.join(map(str, found))} are so far from 0 that single precision tells their "
                "values apart poorly; make the store of numbers in double precision, which are moved towards 0."
            )
    return warnings


def require_resolved(store: EpisodeStore) -> None:
    """Refuse logs of which an entry changes by hardly more than single precision tells apart."""
    rows = looked_at(store.episode_ends)
    for what, array, names in _sources(store):
        flat = array.reshape(len(array), -1, array.shape[-1])
        change = np.abs(flat[rows + 1] - flat[rows])
        gap = _gap(flat[rows].reshape(-1, flat.shape[-1]))
        for entry in np.flatnonzero(gap > COARSE * change.max((0, 1))):  # few are looked at more closely
            changed = change[..., entry][change[..., entry] > 0]
            usual = float(np.median(changed)) if len(changed) else 0.0
            if usual and gap[entry] > BLURRED * usual:
                name = f" ('{names[entry]}')" if names else ""
                raise StoreError(
                    f"{what} entry {entry}{name} of '{store.card.task}' reaches {np.abs(flat[..., entry]).max():.4g} "
                    f"and changes by {usual:.2g} a step, which single precision tells apart by {gap[entry]:.2g}: "
                    "make the store of numbers in double precision, which are moved towards 0, or leave the entry out."
                )


def _sources(store: EpisodeStore) -> Iterator[tuple[str, np.ndarray, list[str] | None]]:
    """What is learned from: what it is, its rows and the names of their entries."""
    yield "Observation", store.observations, store.card.observation_names
    if store.state is not None:
        yield "State", store.state, store.card.state_names


def _gap(flat: np.ndarray) -> np.ndarray:
    """(D,) the distance of neighbouring numbers of single precision, at the largest of rows (M, D)."""
    return gap_at(np.abs(flat).max(0))
