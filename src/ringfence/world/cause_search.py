"""Causes of a cost column, found by what is never safe.

A cost says that a step was unsafe, and neither who was in danger nor why. But a step without cost says much: wherever
any agent was in it, and however near any two were, was safe. So of every small set of entries (a place, a speed, the
distance to another) it is counted how often a step is unsafe when somebody is in a cell of it. A cause is a set with
cells where steps are nearly always unsafe, and it is the simplest that tells held-out steps best. What it tells is
then explained, and the next cause is looked for in what is left, so that a rare one is found, too; last those that
hold for some agents alone, such as how far one may fall behind the one before it.

This is a noisy-or over causes and agents (Pearl 1988), grown greedily: P(safe) = Π over causes, agents and things of
(1 − p(cell)). Entries that come along with danger (goals, velocities, others' places) tell nothing that is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from ringfence.world.causes import Cause, Edge, Found, candidates, only_of, told_of, wider
from ringfence.world.cells import CELLS, Cells

VERSION = 6  # of the search: what was found by another is looked for again
UNSAFE_STEPS = 30_000  # that causes are looked for in, at most
SAFE_STEPS = 120_000  # likewise
MOST = 8  # causes
SUFFICIENT = 0.3  # share of unsafe steps, beyond what others explain, at which a cell is dangerous
PRIOR = 2.0  # safe visits that every cell is taken to have had
SIMPLER = 0.02  # share of a gain that a simpler cause may lack
LEAST_GAIN = 0.002  # of the likelihood that there is to win
SURE = 3.0  # standard errors, over episodes, by which a gain has to exceed nothing
NEEDED = 2.0  # standard errors, by which one that is kept beside all others has to
TESTED = 0.3  # share of the episodes that gains are measured on


@dataclass(frozen=True, eq=False)
class _Steps:
    """Some of the logged steps."""

    x: np.ndarray  # (T, N, D) where they led to
    unsafe: np.ndarray  # (T,) of the team or (T, N)
    tested: np.ndarray  # (T,) bool: gains are measured on these
    episode: np.ndarray  # (T,)
    low: np.ndarray  # (D,) of nearly all that was seen
    high: np.ndarray  # (D,)
    seen: dict[Cause, tuple[np.ndarray, np.ndarray, int, np.ndarray]]  # ranges, cells along an axis, cells of steps

    def cells(self, cause: Cause) -> tuple[np.ndarray, np.ndarray, int, np.ndarray]:
        """(low, high, cells along each axis, (T, N, J) cell of each thing); remembered."""
        if cause not in self.seen:
            low, high = _range(self, cause)
            bins = _bins(cause, len(self.x) * self.x.shape[1])
            self.seen[cause] = low, high, bins, _cell(cause, self.x, low, high, bins).astype(np.int32)
        return self.seen[cause]

    def picked(self, cause: Cause) -> tuple[np.ndarray, np.ndarray]:
        """((T, P) cells of the agents and things that a cause is about, (P,) whose they are); those of a cause of all
        are remembered."""
        cell = self.cells(told_of(cause, ()))[-1]
        agents, things = np.nonzero(cause.holds(cell.shape[1]))
        return cell[:, agents, things], agents

    @property
    def each(self) -> bool:
        """Whether every agent has a cost of its own."""
        return self.unsafe.ndim == 2


@dataclass(frozen=True, eq=False)
class _Tried:
    """A cause, and log P(safe) of the steps by it."""

    cells: Cells
    safe: np.ndarray  # (T,) or (T, N)
    gain: float = 0.0
    error: float = 0.0  # standard error of the gain over episodes


def radius(x: np.ndarray, unsafe: np.ndarray, episode: np.ndarray, cause: Cause) -> Edge:
    """Where one cause is dangerous, as steps tell it that look for no other."""
    steps = _some(x, unsafe, episode, np.random.default_rng(0))
    return _counted(steps, cause, np.zeros(steps.unsafe.shape), everything=True).edge


def find(
    x: np.ndarray, unsafe: np.ndarray, episode: np.ndarray, names: Sequence[str], seed: int = 0
) -> tuple[Found, list[Cells]]:
    """The causes of danger in steps that led to features x (T, N, D), `unsafe` (T,) of the team or (T, N) bool of each
    agent, of these episodes (T,); with the cells of each cause."""
    steps = _some(x, unsafe, episode, np.random.default_rng([seed, 5]))
    chosen = _grown(steps, names)
    chosen = _pruned(steps, chosen)
    if not chosen:
        return Found(), []
    cells = [_counted(steps, one.cells.cause, _without(steps, chosen, one), everything=True) for one in chosen]
    edges = tuple(one.edge for one in cells)
    return replace(_summary(steps, chosen), edges=edges), cells


def _some(x: np.ndarray, unsafe: np.ndarray, episode: np.ndarray, rng: np.random.Generator) -> _Steps:
    """As many steps as are needed, whole episodes tested."""
    bad = unsafe if unsafe.ndim == 1 else np.asarray(unsafe.any(1))
    some = _sampled(bad, rng) if len(x) > SAFE_STEPS // 2 else np.arange(len(x))
    x = np.asarray(x[some], np.float32)
    flat = x.reshape(-1, x.shape[-1])
    flat = flat[:: max(1, len(flat) // 200_000)]
    low, high = np.quantile(flat, [0.0005, 0.9995], axis=0)
    tested_episodes = rng.random(int(episode.max()) + 1) < TESTED
    return _Steps(x, unsafe[some], tested_episodes[episode[some]], episode[some], low, high, {})


def _sampled(bad: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rows of steps, in order: UNSAFE_STEPS of the unsafe ones at most, and the same share of the safe ones, at least
    as many and at most SAFE_STEPS."""
    rows = np.flatnonzero(bad)
    rows = rng.choice(rows, min(len(rows), UNSAFE_STEPS), replace=False)
    fine = np.flatnonzero(~bad)
    share = len(rows) / max(bad.sum(), 1)
    count = min(len(fine), SAFE_STEPS, max(int(share * len(fine)), UNSAFE_STEPS))
    return np.sort(np.concatenate([rows, rng.choice(fine, count, replace=False)]))


def _grown(steps: _Steps, names: Sequence[str]) -> list[_Tried]:
    """Causes, one after the other, each the simplest of those that tell most of what is left: first those that hold for
    all agents, then those that hold for some alone."""
    pool = list(candidates(names))
    chosen = _added(steps, [], pool)
    n_agents = steps.x.shape[1]
    if n_agents > 1 and len(chosen) < MOST:
        alone = [one for cause in pool for one in only_of(cause, n_agents)]
        chosen = _added(steps, chosen, alone)
    return [_widened(steps, one, _without(steps, chosen, one), names) for one in chosen]


def _added(steps: _Steps, chosen: list[_Tried], pool: Sequence[Cause]) -> list[_Tried]:
    """These causes and more of the pool, while they tell something."""
    chosen = list(chosen)
    explained = _together(steps, chosen)
    least = LEAST_GAIN * -_likelihood(steps, np.zeros(steps.unsafe.shape)).mean()
    while len(chosen) < MOST:
        best = _simplest(steps, pool, explained)
        if best is None or best.gain < max(least, SURE * best.error):
            break
        if best.cells.cause.who:
            best = _gathered(steps, best, pool, explained)
        chosen.append(best)
        explained = np.minimum(explained, best.safe)
    return chosen


def _gathered(steps: _Steps, best: _Tried, pool: Sequence[Cause], explained: np.ndarray) -> _Tried:
    """The cause of a single agent as one of all for whom it holds likewise, one after the other."""
    things = best.cells.cause.things
    length = best.cells.cause.length
    others = [cause for cause in pool if cause.things == things and cause.length == length]
    for other in sorted(others, key=lambda cause: -_tried(steps, cause, explained).gain):
        who = best.cells.cause.who
        if other.who[0] in who:
            continue
        more = _tried(steps, told_of(best.cells.cause, (*who, *other.who)), explained)
        if more.gain > (1 + SIMPLER) * best.gain:
            best = more
    return best


def _widened(steps: _Steps, one: _Tried, explained: np.ndarray, names: Sequence[str]) -> _Tried:
    """The cause with more entries, where these tell clearly more; once simple ones tell what they can, so that a second
    cause is not taken for a part of the first."""
    best = _tried(steps, one.cells.cause, explained)
    while (more := _best_wider(steps, best, explained, names)) is not None:
        best = more
    return best


def _simplest(steps: _Steps, pool: Sequence[Cause], explained: np.ndarray) -> _Tried | None:
    """The simplest cause of those that tell about as much as any."""
    gains = [_tried(steps, cause, explained).gain for cause in pool]
    least = (1 - SIMPLER) * max(gains, default=0.0)
    enough = [(cause, gain) for cause, gain in zip(pool, gains) if gain > 0 and gain >= least]
    if not enough:
        return None
    best, _ = min(enough, key=lambda one: (one[0].width, not one[0].length, -one[1]))
    return _tried(steps, best, explained)


def _best_wider(steps: _Steps, best: _Tried, explained: np.ndarray, names: Sequence[str]) -> _Tried | None:
    """The cause with one more entry, where that tells clearly more."""
    tried = [_tried(steps, cause, explained) for cause in wider(best.cells.cause, names)]
    found = max(tried, key=lambda t: t.gain, default=None)
    if found is None or found.gain < (1 + 2 * SIMPLER) * best.gain:
        return None
    return found if found.gain - best.gain > SURE * max(found.error, best.error) else None


def _pruned(steps: _Steps, chosen: list[_Tried]) -> list[_Tried]:
    """Without those that the rest make needless."""
    for one in sorted(chosen, key=lambda t: t.gain):
        rest = [t for t in chosen if t is not one]
        gain, error = _gain(steps, _together(steps, rest), one.safe)
        if rest and gain < max(LEAST_GAIN * 0.5, NEEDED * error):
            chosen = rest
    return chosen


def _without(steps: _Steps, chosen: list[_Tried], one: _Tried) -> np.ndarray:
    return _together(steps, [t for t in chosen if t is not one])


def _together(steps: _Steps, chosen: list[_Tried]) -> np.ndarray:
    """Log P(safe) by several causes: the worst counts."""
    return np.minimum.reduce([np.zeros(steps.unsafe.shape), *[t.safe for t in chosen]])


def _tried(steps: _Steps, cause: Cause, explained: np.ndarray) -> _Tried:
    """How much better a cause tells the tested steps than what is explained already."""
    cells = _counted(steps, cause, explained)
    safe = _safe(steps, cells)
    if not cells.danger.any():
        return _Tried(cells, safe)
    return _Tried(cells, safe, *_gain(steps, explained, safe))


def _gain(steps: _Steps, explained: np.ndarray, safe: np.ndarray) -> tuple[float, float]:
    """(log likelihood that a cause adds to a tested step, its standard error over episodes)."""
    more = _likelihood(steps, np.minimum(explained, safe)) - _likelihood(steps, explained)
    episode = steps.episode[steps.tested]
    totals = np.bincount(episode, more)
    counts = np.bincount(episode)
    totals = totals[counts > 0]
    error = totals.std() * np.sqrt(len(totals)) / len(more)
    return float(more.mean()), float(error)


def _counted(steps: _Steps, cause: Cause, explained: np.ndarray, everything: bool = False) -> Cells:
    """Cells of a cause, by the steps that are not tested (or all): of what others leave unexplained."""
    part = np.ones(len(steps.x), bool) if everything else ~steps.tested
    low, high, bins, _ = steps.cells(told_of(cause, ()))
    cell, agents = steps.picked(cause)
    cell = cell[part]
    unsafe = steps.unsafe[part]
    left = np.exp(explained[part]) * unsafe
    size = bins**cause.width
    of = agents if steps.each else np.zeros(len(agents), int)
    bad = np.bincount(cell.ravel(), left.reshape(len(left), -1)[:, of].ravel(), size)
    fine = np.bincount(cell.ravel(), (~unsafe).reshape(len(left), -1)[:, of].ravel().astype(float), size)
    usual = left.sum() / max(left.sum() + (~unsafe).sum(), 1.0)
    share = bad / (bad + fine + PRIOR)
    error = np.sqrt(share * (1 - share) / (bad + fine + PRIOR))
    beyond = np.clip((share - error - usual) / (1 - usual), 0.0, 1.0)  # the rest comes of other causes
    danger = np.where(beyond > SUFFICIENT, np.clip((share - usual) / (1 - usual), 0.0, 0.999), 0.0)
    return Cells(cause, low, high, bins, bad + fine, danger)


def _range(steps: _Steps, cause: Cause) -> tuple[np.ndarray, np.ndarray]:
    entries = np.array(cause.things)
    if not cause.length:
        return steps.low[entries].min(0), steps.high[entries].max(0)
    some = cause.of(steps.x[:: max(1, len(steps.x) // 20_000)])
    return np.zeros(1), np.quantile(some, 0.9995, axis=tuple(range(some.ndim - 1)))


def _bins(cause: Cause, samples: int) -> int:
    most = CELLS[cause.width]
    return int(np.clip((samples / 20) ** (1 / cause.width), 6, most))


def _cell(cause: Cause, x: np.ndarray, low: np.ndarray, high: np.ndarray, bins: int) -> np.ndarray:
    """(T, N, J) the cell of each thing."""
    scaled = (cause.of(x) - low) / np.maximum(high - low, 1e-9) * bins
    places = np.clip(scaled, 0, bins - 1).astype(np.int64)
    cell = places[..., 0]
    for k in range(1, cause.width):
        cell = cell * bins + places[..., k]
    return cell


def _safe(steps: _Steps, cells: Cells) -> np.ndarray:
    """Log P(safe) of steps by one cause: of the worst thing, and of the worst agent where costs are the team's."""
    if not cells.danger.any():
        return np.zeros(steps.unsafe.shape)
    cell, agents = steps.picked(cells.cause)
    each = np.log1p(-cells.danger)[cell]
    if not steps.each:
        return each.min(1)
    safe = np.zeros(steps.unsafe.shape)
    for agent in np.unique(agents):
        safe[:, agent] = each[:, agents == agent].min(1)
    return safe


def _likelihood(steps: _Steps, safe: np.ndarray) -> np.ndarray:
    """(T',) log likelihood of the tested steps; what no cause explains is as frequent as in the rest."""
    fitted = ~steps.tested
    open_ = safe[fitted] > -1e-6
    unsafe = steps.unsafe[fitted]
    leak = np.clip(unsafe[open_].mean() if open_.any() else 0.0, 1e-4, 1 - 1e-4)
    chance = np.clip(1 - np.exp(safe[steps.tested]) * (1 - leak), 1e-4, 1 - 1e-4)
    each = np.where(steps.unsafe[steps.tested], np.log(chance), np.log1p(-chance))
    return each if each.ndim == 1 else each.sum(1)


def _summary(steps: _Steps, chosen: list[_Tried]) -> Found:
    unsafe = steps.unsafe[steps.tested]
    limit = np.log(0.5)

    def explained(safe: np.ndarray) -> tuple[float, float]:
        called = safe[steps.tested] < limit
        return float(called[unsafe].mean()), float(called[~unsafe].mean())

    share, false_alarms = explained(_together(steps, chosen))
    shares = tuple(round(explained(one.safe)[0], 4) for one in chosen)
    return Found(tuple(one.cells.cause for one in chosen), round(share, 4), round(false_alarms, 4), shares)
