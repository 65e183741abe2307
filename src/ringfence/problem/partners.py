"""Who it is that an agent sees, where a list of others does not say.

Others who are listed by how near they come change their places in the list. But what two see of each other is the same
number, or the same with the opposite sign: how far apart they are, or where the other is. Nothing else in logs is so
exact, so the agent that sees the same is the one that is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.types import Array

VERSION = 1  # of what is found
ROWS = 500  # that are compared
ENTRIES = 300  # that are compared, each with each
MOST = 200_000_000  # numbers that are; of wide logs fewer rows
EXACT = 1e-4  # of an entry's deviation: what is rounded is off by less
REPEATED = 3  # times that a number may occur: places in a list that nobody has are filled with one number
OFTEN = 0.5  # of what is seen that somebody else sees, too: who is near another need not be on the other's list
SOME = 0.05  # of it, by the same two entries
ALONE = 1.5  # others, on average, that see the same; what more see is of all
AT_ONCE = 256  # states in which others are looked up at once
NEAREST = 3  # places, the first of a list, whose owners are looked for: each costs time
SAME = 1e-6  # squared deviations between what two see of each other, where it is logged
LIKE = 0.25  # and where it is predicted


class Mirrored(NamedTuple):
    """Something that agents see of others, one entry for each place in their list."""

    entries: tuple[int, ...]  # J
    sign: int  # of what the other sees of the agent


def found_in(x: np.ndarray) -> tuple[Mirrored, ...]:
    """What agents see of each other among the entries of features (W, N, D); of as many places each."""
    _, agents, width = x.shape
    rows = min(ROWS, MOST // max(1, (agents * width) ** 2))
    if agents < 2 or rows < 1 or width > ENTRIES:
        return ()
    x = np.asarray(x[np.unique(np.linspace(0, len(x) - 1, rows).astype(int))], np.float64)
    told = [e for e in range(width) if x[..., e].std() > 0]
    rare = {e: _rare(x[..., e]) for e in told}
    found = [part for sign in (-1, 1) for part in _of_sign(x, [e for e in told if rare[e].any()], rare, sign)]
    if not found:
        return ()
    sizes = [len(part.entries) for part in found]
    usual = max(sizes, key=lambda size: size * sizes.count(size))
    return tuple(part for part in found if len(part.entries) == usual)


def _rare(column: np.ndarray) -> np.ndarray:
    """(W, N) bool: the numbers that hardly occur again."""
    _, index, counts = np.unique(column, return_inverse=True, return_counts=True)
    return (counts <= REPEATED)[index].reshape(column.shape)


def _of_sign(x: np.ndarray, told: list[int], rare: dict[int, np.ndarray], sign: int) -> list[Mirrored]:
    others = ~np.eye(x.shape[1], dtype=bool)[..., None]
    theirs = sign * x[:, None, :, told]  # (W, 1, N, F)
    linked: dict[int, set[int]] = {}
    for e in told:
        same = np.abs(x[:, :, None, e, None] - theirs) <= EXACT * x[..., e].std()
        same &= rare[e][:, :, None, None] & others
        by_any = same.any(2)  # (W, N, F)
        links = np.flatnonzero(by_any.sum((0, 1)) >= SOME * rare[e].sum())
        if not len(links) or by_any[..., links].any(-1).sum() < OFTEN * rare[e].sum():
            continue
        many = same.sum((0, 1, 2))[links] / by_any.sum((0, 1))[links]
        if many.max() <= ALONE:
            linked[e] = {told[f] for f in links}
    for e, links in list(linked.items()):
        for f in links & set(linked):
            linked[f].add(e)
    parts = []
    while linked:
        part, new = set(), {next(iter(linked))}
        while new:
            part |= new
            new = {f for e in new for f in linked[e] if f in linked} - part
        parts.append(Mirrored(tuple(sorted(part)), sign))
        linked = {e: links for e, links in linked.items() if e not in part}
    return parts


def places(mirrored: Sequence[Mirrored]) -> int:
    """J, how many others are looked for."""
    return min(len(mirrored[0].entries), NEAREST) if mirrored else 0


def seen_in(mirrored: Sequence[Mirrored], features: Array, scale: Array) -> tuple[Array, Array]:
    """`seen_by` of logged features (M, N, D): what two see of each other is the same there."""

    def of(x: Array) -> tuple[Array, Array]:
        who, known = seen_by(mirrored, x, scale, SAME)
        return who.astype(jnp.int16), known

    return jax.jit(lambda x: jax.lax.map(of, x, batch_size=AT_ONCE))(features)


def seen_by(mirrored: Sequence[Mirrored], x: Array, scale: Array, bearable: float = LIKE) -> tuple[Array, Array]:
    """(..., N, J) the agent in each of the first places of the lists of features (..., N, D), and whether it is known:
    what the two see of each other is apart by no more than is `bearable`. `scale` (D,) are the entries' deviations."""
    entries = np.array([part.entries for part in mirrored])  # (C, J)
    sign = np.array([part.sign for part in mirrored], x.dtype)[:, None]
    unit = scale[entries].mean(1, keepdims=True)
    mine = jnp.moveaxis(x[..., entries] / unit, -2, -1)  # (..., N, J, C)
    theirs = jnp.moveaxis(sign * x[..., entries] / unit, -2, -1)[..., None, None, :, :, :]
    mine = mine[..., : places(mirrored), None, None, :]
    off = ((mine - theirs) ** 2).sum(-1).min(-1)  # (..., N, J, N)
    themselves = np.eye(x.shape[-2], dtype=bool)[:, None]
    off = jnp.where(themselves, jnp.inf, off)
    return off.argmin(-1), off.min(-1) <= len(mirrored) * bearable


def looked_up(theirs: Array, who: Array, known: Array) -> Array:
    """(..., N, J (F + 1)) what agents (..., N, F) have, for everybody who is seen, and whether who it is is known."""
    index = who.reshape(*who.shape[:-2], -1, 1)
    found = jnp.take_along_axis(theirs, index, -2).reshape(*who.shape, theirs.shape[-1])
    found = jnp.concatenate([found, jnp.ones_like(found[..., :1])], -1) * known[..., None]
    return found.reshape(*found.shape[:-2], who.shape[-1] * found.shape[-1])
