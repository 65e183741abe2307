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

ROWS = 500  # that are compared
MOST = 4_000_000  # numbers that are compared, and equal ones that are found; of wide logs fewer rows
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
    rows = min(ROWS, MOST // max(1, agents * width))
    if agents < 2 or rows < 1:
        return ()
    x = np.asarray(x[np.unique(np.linspace(0, len(x) - 1, rows).astype(int))], np.float64)
    told = np.flatnonzero(x.std((0, 1)) > 0)
    x = x[..., told]
    rare = np.stack([_rare(column) for column in np.moveaxis(x, -1, 0)], -1) if len(told) else np.zeros(x.shape, bool)
    found = [Mirrored(tuple(told[list(part)].tolist()), sign) for sign in (-1, 1) for part in _of_sign(x, rare, sign)]
    if not found:
        return ()
    sizes = [len(part.entries) for part in found]
    usual = max(sizes, key=lambda size: size * sizes.count(size))
    return tuple(part for part in found if len(part.entries) == usual)


def _rare(column: np.ndarray) -> np.ndarray:
    """(W, N) bool: the numbers that hardly occur again."""
    _, index, counts = np.unique(column, return_inverse=True, return_counts=True)
    return (counts <= REPEATED)[index].reshape(column.shape)


def _of_sign(x: np.ndarray, rare: np.ndarray, sign: int) -> list[list[int]]:
    """Groups of entries of x (W, N, F) by which two see the same of each other, up to the sign; `rare` (W, N, F) tells
    which numbers count."""
    entries = x.shape[-1]
    looked_at, row, i, e, f = _equal(x, rare, sign)
    asked = rare[looked_at].sum((0, 1))  # of each entry
    seen = np.unique(((row * x.shape[1] + i) * entries + e) * entries + f)  # by i of anybody
    pairs, times = np.unique(seen % entries**2, return_counts=True)
    _, by_all = np.unique(e * entries + f, return_counts=True)  # in the same order
    often = times >= SOME * asked[pairs // entries]
    pairs, many = pairs[often], (by_all / times)[often]
    told = np.unique(seen[np.isin(seen % entries**2, pairs)] // entries)  # (row, agent, entry)
    shared = np.bincount(told % entries, minlength=entries)
    linked: dict[int, set[int]] = {}
    for one in np.flatnonzero((asked > 0) & (shared >= OFTEN * asked)):
        of_one = pairs // entries == one
        if of_one.any() and many[of_one].max() <= ALONE:
            linked[int(one)] = set((pairs[of_one] % entries).tolist())
    for one, links in list(linked.items()):
        for other in links & set(linked):
            linked[other].add(one)
    groups = []
    while linked:
        group, new = set(), {next(iter(linked))}
        while new:
            group |= new
            new = {other for one in new for other in linked[one] if other in linked} - group
        groups.append(sorted(group))
        linked = {one: links for one, links in linked.items() if one not in group}
    return groups


def _equal(x: np.ndarray, rare: np.ndarray, sign: int) -> list[np.ndarray]:
    """The rows of x (W, N, F) that are looked at, and of P numbers in them that two agents share up to the sign the
    row, agent, entry and the other's entry (P,). It ends early where too many are shared."""
    near = EXACT * x.std((0, 1))
    found = []
    left = MOST
    rows = np.random.default_rng(0).permutation(len(x))  # a part of them is evenly spread, too
    for row in rows:
        agent, entry = np.nonzero(rare[row])
        theirs = sign * x[row].ravel()
        order = theirs.argsort()
        mine = x[row, agent, entry]
        first = np.searchsorted(theirs, mine - near[entry], "left", order)
        many = np.searchsorted(theirs, mine + near[entry], "right", order) - first
        left -= many.sum()
        if left < 0 and found:
            break
        which = np.repeat(np.arange(len(mine)), many)
        place = np.arange(many.sum()) - np.repeat(many.cumsum() - many, many)
        other, its = np.divmod(order[first[which] + place], x.shape[2])
        apart = other != agent[which]
        found.append([np.full(apart.sum(), row), agent[which][apart], entry[which][apart], its[apart]])
    return [rows[: len(found)], *(np.concatenate(part) for part in zip(*found))]


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
