"""Who the others are that entries number: `other0` of an agent is the first of the team but itself, unless logs tell
another order that stays, such as a ring's (next, opposite, previous)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

SHARE = 0.9  # of steps, that have to agree
LIKE = 0.05  # of a change: what follows is off by less
LEAST = 1e-5  # of an entry: less is no change


def others(n: int, most: int | None = None) -> np.ndarray:
    """(N, N-1) who the others of each agent are: the team but itself, in order; no more than `most` of them."""
    before = np.arange(n - 1)[:most]
    return (before + (before >= np.arange(n)[:, None])).astype(int)


def order_in(change: np.ndarray, how: Mapping[int, tuple[int, int]]) -> np.ndarray | None:
    """(N, J) who the others of each agent are, as changes (W, N, D) of entries tell: `other0.dx` changes by as much as
    that other's `own.x` less one's own. `how` has the entries: (the own one, which other it is about). None where the
    others may be the team in order, and where their order does not stay."""
    about = [(entry, own, other) for entry, (own, other) in how.items() if other >= 0]
    usual = others(change.shape[1], 1 + max((other for *_, other in about), default=-1))
    order = usual.copy()
    for agent, place in np.ndindex(*order.shape):
        told = [(entry, own) for entry, own, other in about if other == place]
        if _off(change, agent, told, [int(usual[agent, place])]).min() <= LIKE:
            continue
        off = _off(change, agent, told, range(change.shape[1]))
        order[agent, place] = off.argmin()
        if off.min() > LIKE:
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
