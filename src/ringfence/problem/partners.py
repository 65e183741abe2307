"""Who the others are that an agent sees.

Entries number them: `other0` of an agent is the first of the team but itself, unless logs tell another order that
stays, such as a ring's (next, opposite, previous). Others who are listed by how near they come change their places in
the list. But what two see of each other is the same number, or the same with the opposite sign: how far apart they are,
or where the other is. Nothing else in logs is so exact, so the agent that sees the same is the one that is seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.types import Array

SHARE = 0.9  # of steps, that have to agree
OFF = 0.05  # of a change: what follows is off by less
LEAST = 1e-5  # of an entry: less is no change
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


def others(n: int, most: int | None = None) -> np.ndarray:
    """(N, N-1) who the others of each agent are: the team but itself, in order; no more than `most` of them."""
    before = np.arange(n - 1)[:most]
    return (before + (before >= np.arange(n)[:, None])).astype(int)


def approaches(position: Array, velocity: Array, sight: float, soon: float) -> tuple[Array, Array, Array]:
    """Offsets and relative velocities (B, N, N, 2) of everybody to everybody, and the squared distance (B, N, N) of
    their nearest approach within `soon` s if all go on as now: beyond all others for who is out of `sight` m, and
    beyond these for oneself."""
    offset = position[..., None, :, :] - position[..., :, None, :]
    speed = velocity[..., None, :, :] - velocity[..., :, None, :]
    when = jnp.clip(-(offset * speed).sum(-1) / ((speed**2).sum(-1) + 1e-9), 0.0, soon)
    squared = ((offset + when[..., None] * speed) ** 2).sum(-1)
    in_sight = (offset**2).sum(-1) < sight**2
    squared = jnp.where(in_sight, squared, 1e6) + 1e9 * jnp.eye(position.shape[-2])
    return offset, speed, squared


def seen_first(order: Array, shown: int, things: int, sight: float, offset: Array, *more: Array) -> Array:
    """(..., N, shown (F + 1)) of the things at `offset` (..., N, M, 2) those that come first by `order` (..., N, M):
    where each is, what `more` there is to tell (..., N, M, F - 2), and whether it is in sight. What is not seen stands
    at the end of `sight` m. Only `things` of the M are things."""
    count = min(shown, things)
    _, which = jax.lax.top_k(-order, count)
    near, *rest = (jnp.take_along_axis(x, which[..., None], -2) for x in (offset, *more))
    rows = jnp.concatenate([near, *rest, jnp.ones_like(near[..., :1])], -1)
    unseen = np.zeros(rows.shape[-1], np.float32)
    unseen[0] = sight
    rows = jnp.where((near**2).sum(-1, keepdims=True) < sight**2, rows, unseen)
    missing = jnp.broadcast_to(unseen, (*rows.shape[:-2], shown - count, len(unseen)))
    return jnp.concatenate([rows, missing], -2).reshape(*rows.shape[:-2], -1)


def order_in(change: np.ndarray, how: Mapping[int, tuple[int, int]]) -> np.ndarray | None:
    """(N, J) who the others of each agent are, as changes (W, N, D) of entries tell: `other0.dx` changes by as much as
    that other's `own.x` less one's own. `how` has the entries: (the own one, which other it is about). None where the
    others may be the team in order, and where their order does not stay."""
    about = [(entry, own, other) for entry, (own, other) in how.items() if other >= 0]
    usual = others(change.shape[1], 1 + max((other for *_, other in about), default=-1))
    order = usual.copy()
    for agent, place in np.ndindex(*order.shape):
        told = [(entry, own) for entry, own, other in about if other == place]
        if _off(change, agent, told, [int(usual[agent, place])]).min() <= OFF:
            continue
        off = _off(change, agent, told, range(change.shape[1]))
        order[agent, place] = off.argmin()
        if off.min() > OFF:
            return None
    stays = all(len(set(row)) == len(row) for row in order.tolist())
    return order if stays and (order != usual).any() else None


def _off(change: np.ndarray, agent: int, told: Iterable[tuple[int, int]], who: Iterable[int]) -> np.ndarray:
    """(len(who),) by what share of its change the entry that tells best is off, if it is about each of these."""
    who = list(who)
    least = np.full(len(who), np.inf)
    for entry, own in told:
        mine = change[:, agent, entry]
        size = np.quantile(np.abs(mine), SHARE)
        wrong = np.quantile(np.abs((mine + change[:, agent, own])[:, None] - change[:, who, own]), SHARE, axis=0)
        least = np.minimum(least, np.where(size > LEAST, wrong / max(size, LEAST), np.inf))
    return np.where(np.array(who) == agent, np.inf, least)


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
