"""What entries change by in a step, where that is not their difference.

Angles begin again after a whole turn: a heading of 3.1 rad and one of -3.1 are neighbours. Read as numbers they are a
whole turn apart: what changes by it looks like a kick, and a prediction that passes the end goes where no angle is.
Places go with velocities, whose next ones they may go with as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ringfence.types import Array, X

# (lowest, whole turn): from minus a half or from none, in rad or degrees
KINDS = tuple((low * whole, whole) for whole in (2 * math.pi, 360.0) for low in (-0.5, 0.0))
FULL = 0.98  # of a turn, that an entry covers
BEYOND = 0.01  # of a turn, by which it may pass its ends: some are rounded, some noisy
JUMPS = 5  # steps that pass the end
SHORT = 0.125  # of a turn, the shorter way round, in which most of these go: what is drawn anew jumps by any share
LIKE = 2.0  # times what other steps change by, nine in ten of them: so much most of these do, too
TURNS = 0.01  # of the largest velocity: a smaller change tells nothing
FEW = 20  # changes, below which nothing is said
AGREE = 0.025  # of a share
USUAL = 0.2  # share of the changes that has to agree


class Turn(NamedTuple):
    """An entry that is an angle."""

    entry: int
    low: float  # from where it goes
    whole: float  # to where it begins again, less that


def turns_in(before: np.ndarray, after: np.ndarray) -> tuple[Turn, ...]:
    """The angles among the entries of features (W, N, D) before and after steps."""
    found = []
    lowest, highest = before.min((0, 1)), before.max((0, 1))
    for entry, (least, most) in enumerate(zip(lowest.tolist(), highest.tolist())):
        for low, whole in KINDS:
            within = least >= low - BEYOND * whole and most <= low + (1 + BEYOND) * whole
            if not within or most - least < FULL * whole:
                continue
            change = (after - before)[..., entry].astype(np.float64)
            jumps = np.abs(change) > whole / 2
            if not JUMPS <= jumps.sum() < jumps.size:
                continue
            usual = LIKE * np.quantile(np.abs(change[~jumps]), 0.9)
            if np.median(whole - np.abs(change[jumps])) <= min(SHORT * whole, usual):
                found.append(Turn(entry, low, whole))
                break
    return tuple(found)


def apart(turns: Sequence[Turn], after: X, before: X) -> X:
    """(..., D) features less others; of angles, the shorter way round."""
    change = after - before
    if not turns:
        return change
    entries, _, whole = _columns(turns, change)
    some = change[..., entries]
    xp = np if isinstance(change, np.ndarray) else jnp
    return _put(change, entries, some - whole * xp.round(some / whole))


def within(turns: Sequence[Turn], x: Array) -> Array:
    """Features (..., D) whose angles are where angles are."""
    if not turns:
        return x
    entries, low, whole = _columns(turns, x)
    some = x[..., entries]
    return _put(x, entries, some - whole * jnp.floor((some - low) / whole))


def pointing(turns: Sequence[Turn], x: Array, standard: Array) -> Array:
    """(..., D + T) the standardised features (..., D) that a network reads, with sines of angles in their place and
    cosines after all of them: they are continuous where an angle begins again."""
    if not turns:
        return standard
    entries, low, whole = _columns(turns, x)
    angle = 2 * jnp.pi * (x[..., entries] - low) / whole
    return jnp.concatenate([_put(standard, entries, jnp.sin(angle)), jnp.cos(angle)], -1)


def _columns(turns: Sequence[Turn], like: X) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Entries, lowest and whole, of every angle (T,)."""
    entries, low, whole = zip(*turns)
    return np.array(entries), np.array(low, like.dtype), np.array(whole, like.dtype)


def _put(x: X, entries: np.ndarray, values: X) -> X:
    if not isinstance(x, np.ndarray):
        return x.at[..., entries].set(values)
    changed = x.copy()
    changed[..., entries] = values
    return changed


def late_share(moved: np.ndarray, before: np.ndarray, after: np.ndarray, dt: float) -> float | None:
    """The share c of a step of `dt` seconds that bodies go with their next velocity, as logged: a place moves by
    ((1 − c) v + c v′) dt. Logs differ: a velocity is what a simulator goes on with, the mean of a step, or the
    difference to the place before. All three of any shape; None where the logs do not say.

    It is the most frequent share and no mean: where others are listed by distance, a place in the list may change its
    owner from one row to the next.
    """
    change = ((after - before) * dt).ravel()
    rest = (moved - before * dt).ravel()
    turns = np.abs(change) > TURNS * max(float(np.abs(before).max(initial=0.0)) * dt, 1e-9)
    if turns.sum() < FEW:
        return None
    share = rest[turns] / change[turns]
    tried = np.linspace(0, 1, 21)
    agree = np.array([(np.abs(share - one) < AGREE).mean() for one in tried])
    return float(round(tried[agree.argmax()], 2)) if agree.max() > USUAL else None
