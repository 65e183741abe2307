"""Rules: a cause of several numbers as conditions that hold together, whose thresholds are known as well as the edge of
a distance is: near and fast, along and aside, near soon.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ringfence.utils import interrupts
from ringfence.world.cause_counts import Counted, Explained, Steps, of_the_worst, parted
from ringfence.world.causes import VISITED, Cause, Cells
from ringfence.world.quantities import All, Entry, Over, Quantity, Sum, how_many, leaves, squared

SWEEPS = 4  # in which every threshold is looked for in turn
MOST_READ = 20_000_000  # numbers that a rule is looked for in
SCREENED = 400_000  # likewise, at first
STRAY = 0.02  # share of the danger that may lie outside of the box that a rule begins with
NEEDLESS = 0.002  # share of the unsafe steps by which a condition has to make fewer wrong
RATIOS = (2**0.5, 2**0.125, 2**0.03125, 2**0.0078125)  # by which a weight is tried to be more or less, ever finer
TRIED = (10, 3, 3, 3)  # such factors to either side
WEIGHTS = (0.5, 0.7, 1.4, 2.0)  # times which an agent's weight in a sum is tried
MOST_TERMS = 3  # that are added to a condition at once, and of which one that has more is left as it is
AS_LIKELY = 0.02  # of a loss, by which it may be more where what is read is simpler
LIKELY = 5  # numbers, of which these are
FEW = 30  # steps of either kind, below which no threshold is a line


@dataclass(frozen=True, eq=False)
class _Read:
    """What a cause reads in steps, in ranges of each number."""

    steps: Steps
    values: np.ndarray  # (T, P, K)
    agents: np.ndarray  # (P,)
    bad: np.ndarray  # (T,) or (T, N) bool: unsafe and not explained
    fine: np.ndarray

    def parted(self, score: np.ndarray) -> tuple[int, float]:
        """(steps that a score (T, P) tells wrongly, low in danger, where danger begins)."""
        worst = of_the_worst(self.steps, score, score, self.agents)
        return parted(worst[self.bad], worst[self.fine])


@dataclass(frozen=True)
class _Side:
    """A condition: `sign` times a number is below `at`."""

    number: int
    sign: float
    at: float

    def of(self, values: np.ndarray) -> np.ndarray:
        return self.sign * values[..., self.number] - self.at


def rules_of(steps: Steps, one: Counted, explained: Explained) -> Iterator[Cause]:
    """The cause as rules, by the steps that others leave unexplained: a box around its danger, and of two numbers a
    line, also one of a number and of the other's square: what it takes to stop grows so."""
    cause = one.cause
    read, scale = _read(steps, one, explained)
    if not read.bad.any():
        return
    sides = _fitted(read, _box(one.cells, scale))
    units = scale[sides[0].number] / scale if sides else scale
    if len(sides) > 1:
        yield _reading(cause, All(tuple(_condition(cause.reads, side, scale, units) for side in sides)))
    line = _best_line(read, steps, one, explained) if cause.width == 2 else None
    if line is not None:
        reads = tuple(squared(each) if k == line.squared else each for k, each in enumerate(cause.reads))
        units = [unit**2 if k == line.squared else unit for k, unit in enumerate(scale)]
        weights = line.signs[0], float(line.signs[1] * line.weight * units[0] / units[1])
        yield _reading(cause, Sum(reads, weights, -float(line.at * units[0])))


def _reading(cause: Cause, read: Quantity) -> Cause:
    return Cause((read,), cause.who)


def tilted_of(steps: Steps, one: Counted, explained: Explained, more: Sequence[Quantity]) -> Iterator[Cause]:
    """The cause with a line of one or a few numbers more in the place of one of its thresholds: of that by which most
    steps are told rightly."""
    conditions = _conditions(one)
    if not conditions or not more:
        return
    some = _read(steps, one, explained, SCREENED)[0]
    best: tuple[int, int, _Near, list[Quantity]] | None = None
    for k, old in enumerate(conditions):
        free = [each for each in more if _is_new(each, old)]
        if not free or len(old.parts) > MOST_TERMS:
            continue
        near = _Near.of(some, one.cause, conditions, k)
        if min(near.bad.sum(), near.fine.sum()) >= FEW:
            fewer, likely = near.likely(free)
            if best is None or fewer > best[0]:
                best = fewer, k, near, likely
    if best is None:
        return
    _, k, few, likely = best
    read = _read(steps, one, explained)[0]
    whole = _Near.of(read, one.cause, conditions, k)
    terms: list[Quantity] = []
    while likely and len(terms) < MOST_TERMS:
        losses = [few.likeliest(few.of_quantities([*terms, each]))[0] for each in likely]
        alike = (each for each, loss in zip(likely, losses) if loss <= (1 + AS_LIKELY) * min(losses))
        terms = [*terms, min(alike, key=lambda each: not isinstance(each, Entry))]
        likely.remove(terms[-1])
        numbers = whole.of_quantities(terms)
        found, at = whole.refined(numbers, few.likeliest(few.of_quantities(terms), raw=True)[1])
        needed = whole.needed(numbers, found)
        numbers, found = numbers[:, needed], found[needed]
        old, weights, tells = conditions[k], tuple(float(w) for w in found), tuple(terms[j] for j in needed)
        new = Sum((*old.parts, *tells), (*old.weights, *weights), float((old.more or 0.0) - at))
        alone = replace(whole, values=np.zeros_like(whole.values)).best(numbers, found)
        needless = alone[0] <= whole.best(numbers, found)[0] + NEEDLESS * whole.bad.sum()
        if needless and max(map(how_many, [*tells, *conditions[:k], *conditions[k + 1 :]])) == one.cause.things:
            unit = float(whole.values.std() / max((numbers @ found).std(), 1e-9))
            new = Sum(tells, tuple(unit * w for w in weights), -unit * alone[1])
        parts = _settled(read, one.cause, (*conditions[:k], new, *conditions[k + 1 :]))
        yield _reading(one.cause, parts[0] if len(parts) == 1 else All(parts))


def _is_new(each: Quantity, old: Sum) -> bool:
    """Whether a number may shift a condition: it reads something else, or is the square of what is read."""
    known = {d for leaf in leaves(old) for d in leaf.at}
    squares = [squared(part) for part in old.parts]
    return each not in old.parts and (each in squares or not known >= {d for leaf in leaves(each) for d in leaf.at})


def _settled(read: _Read, cause: Cause, conditions: tuple[Sum, ...]) -> tuple[Sum, ...]:
    """The conditions, each in turn where it tells fewest steps wrongly beside the others."""
    for k, one in enumerate(conditions):
        near = _Near.of(read, cause, conditions, k)
        at = near.best(np.zeros((len(near.values), 0)), np.zeros(0))[1]
        if near.bad.any() and near.fine.any() and np.isfinite(at):
            moved = Sum(one.parts, one.weights, float((one.more or 0.0) - at))
            conditions = (*conditions[:k], moved, *conditions[k + 1 :])
    return conditions


def weighted_of(steps: Steps, one: Counted, explained: Explained) -> Iterator[Cause]:
    """A cause of a sum over the team with weights of agents by which fewest steps are told wrongly, each in turn."""
    (read,) = one.cause.reads[:1]
    agents = steps.x.shape[1]
    if one.cause.width > 1 or not isinstance(read, Over) or read.axis != "team" or read.rank or agents < 2:
        return
    told = _read(steps, one, explained)[0]
    team = told.bad if told.bad.ndim == 1 else told.bad.any(1)
    fine = told.fine if told.fine.ndim == 1 else told.fine.all(1)
    each = np.asarray(read.part.of(told.steps.x).sum(-1), np.float64)  # (T, N)
    sign = 1.0 if one.cells.edge.below else -1.0

    def wrong(weights: np.ndarray) -> int:
        score = sign * each @ weights
        return parted(score[team], score[fine])[0]

    weights, least = np.ones(agents), wrong(np.ones(agents))
    for factors in ((0.0, *WEIGHTS), WEIGHTS, [w**0.25 for w in WEIGHTS], [w**0.0625 for w in WEIGHTS]):
        for k in range(agents):
            for factor in factors:
                tried = np.where(np.arange(agents) == k, weights * factor, weights)
                if (count := wrong(tried)) < least:
                    weights, least = tried, count
    if not weights.any():
        return
    weights = weights / weights.max()
    yield _reading(one.cause, Over(read.part, "team", weights=tuple(round(float(w), 4) for w in weights)))


@dataclass(frozen=True, eq=False)
class _Near:
    """The agents and things of steps for which all conditions but one hold, one after the other."""

    read: _Read
    at: tuple[np.ndarray, ...]  # step and which of the agents and things
    things: np.ndarray  # (P,) of which agents' things
    values: np.ndarray  # of the one condition
    starts: np.ndarray  # where those of another step, or of another agent in it, begin
    bad: np.ndarray  # bool, of each of these
    fine: np.ndarray

    @classmethod
    def of(cls, read: _Read, cause: Cause, conditions: Sequence[Sum], k: int) -> _Near:
        interrupts.check()
        things = np.nonzero(cause.holds(read.steps.x.shape[1]))[1]
        each = [_of_picked(one, read.steps.x, read.agents, things) for one in conditions]
        others = [other < 0 for i, other in enumerate(each) if i != k]
        at = np.nonzero(np.logical_and.reduce([np.ones(each[k].shape, bool), *others]))
        whose = at[0] if read.bad.ndim == 1 else at[0] * read.bad.shape[1] + read.agents[at[1]]
        keys, starts = np.unique(whose, return_index=True)
        bad, fine = read.bad.reshape(-1)[keys], read.fine.reshape(-1)[keys]
        return cls(read, at, things, each[k][at], starts, bad, fine)

    def of_quantities(self, quantities: Sequence[Quantity]) -> np.ndarray:
        """(M, K) what each is."""
        x, agents = self.read.steps.x, self.read.agents
        return np.stack([_of_picked(one, x, agents, self.things)[self.at] for one in quantities], -1)

    def likeliest(self, numbers: np.ndarray, raw: bool = False) -> tuple[float, np.ndarray]:
        """(loss, weights (K,) of numbers (M, K), in deviations of each or as they are) by which the condition makes
        steps likeliest: a noisy-or over all that is near, whose log-odds are linear."""
        from scipy.optimize import minimize  # slow to import, and read by fits alone

        spread = numbers.std(0)
        usable = spread > 0
        unit = float(self.values.std()) or 1.0
        inputs = np.concatenate(
            [self.values[:, None] / unit, (numbers - numbers.mean(0))[:, usable] / spread[usable]], -1
        ).astype(np.float32)
        share = np.where(self.bad, 0.5 / max(self.bad.sum(), 1), 0.5 / max(self.fine.sum(), 1)) * (self.bad | self.fine)
        whose = np.repeat(np.arange(len(self.starts)), np.diff([*self.starts, len(self.values)]))

        def loss(given: np.ndarray) -> tuple[float, np.ndarray]:
            odds = np.clip(-(inputs @ given[:-1].astype(np.float32)) + given[-1], -30, 30).astype(np.float64)
            chance = 1.0 / (1.0 + np.exp(-odds))
            safe = np.add.reduceat(-np.logaddexp(0.0, odds), self.starts)  # log P(safe)
            unsafe = np.log(np.maximum(-np.expm1(safe), 1e-12))
            total = -(share * np.where(self.bad, unsafe, safe)).sum()
            slope = share * np.where(self.bad, -np.exp(safe - unsafe), 1.0)  # by odds, over the chance of each
            each = (slope[whose] * chance).astype(np.float32)
            return total, np.array([*(-(each @ inputs)), each.sum()], np.float64) + 2e-4 * np.array([*given[:-1], 0.0])

        begun = np.zeros(inputs.shape[1] + 1)
        begun[0] = 5.0
        found = minimize(loss, begun, jac=True, method="L-BFGS-B", options={"maxiter": 60})
        weights = np.zeros(numbers.shape[1])
        weights[usable] = found.x[1:-1] / max(abs(found.x[0]), 1e-6) * (unit / spread[usable] if raw else 1.0)
        return float(found.fun), weights

    def likely(self, quantities: Sequence[Quantity]) -> tuple[int, list[Quantity]]:
        """(by how many steps fewer are told wrongly where the condition reads all of these, too, the likeliest)."""
        numbers = self.of_quantities(quantities)
        weights = self.likeliest(numbers, raw=True)[1]
        fewer = self.best(numbers[:, :0], weights[:0])[0] - self.best(numbers, weights)[0]
        order = np.argsort(-np.abs(weights * numbers.std(0)))[:LIKELY]
        return fewer, [quantities[j] for j in order if weights[j]]

    def refined(self, numbers: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
        """Weights of numbers (M, K) by which fewest steps are told wrongly, each in turn, and where danger begins."""
        at = 0.0
        for factor in RATIOS[1:]:
            for k in range(len(weights)):
                tried = [np.where(np.arange(len(weights)) == k, weights * factor**i, weights) for i in range(-3, 4)]
                found = [self.best(numbers, each) for each in tried]
                best = _middle_of_best(found)
                weights, at = tried[best], found[best][1]
        return weights, at

    def needed(self, numbers: np.ndarray, weights: np.ndarray) -> list[int]:
        """Which of numbers (M, K) tell something beside the others."""
        kept = list(range(len(weights)))
        most = self.best(numbers, weights)[0] + NEEDLESS * self.bad.sum()
        for k in sorted(kept, key=lambda k: abs(weights[k]) * numbers[:, k].std()):
            rest = [other for other in kept if other != k]
            if rest and self.best(numbers[:, rest], weights[rest])[0] <= most:
                kept = rest
        return kept

    def best(self, numbers: np.ndarray, weights: np.ndarray) -> tuple[int, float]:
        """(steps that the condition tells wrongly with these weights of numbers, where danger begins)."""
        worst = np.minimum.reduceat(self.values + numbers @ weights.astype(np.float32), self.starts)
        return parted(worst[self.bad], worst[self.fine])


def _conditions(one: Counted) -> tuple[Sum, ...]:
    """Of a rule, or of a cause of one number with one edge."""
    if one.cause.width > 1:
        return ()
    read, edge = one.cause.reads[0], one.cells.edge
    if one.cause.is_rule:
        return tuple(part for part in (read.parts if isinstance(read, All) else (read,)) if isinstance(part, Sum))
    if len(edge.bounds) - sum(edge.unseen) != 1:
        return ()
    (at,) = (bound for bound, unseen in zip(edge.bounds, edge.unseen) if not unseen)
    below = edge.inside == (sum(bound < at for bound in edge.bounds) % 2 == 0)
    sign = 1.0 if below else -1.0
    return (Sum((read,), (sign,), -sign * at),)


def _of_picked(quantity: Quantity, x: np.ndarray, agents: np.ndarray, things: np.ndarray) -> np.ndarray:
    """(T, P) of these agents and things."""
    found = quantity.of(x)
    return np.asarray(found[:, agents, things if found.shape[-1] > 1 else 0], np.float32)


def _read(steps: Steps, one: Counted, explained: Explained, most: int = MOST_READ) -> tuple[_Read, np.ndarray]:
    """What it reads in as many steps as are so many numbers, and the range of each number."""
    cells = one.cells
    agents, things = np.nonzero(one.cause.holds(steps.x.shape[1]))
    left = explained.left > 0.5
    kept = np.asarray(left if left.ndim == 1 else left.any(1))
    room = max(1, most // (len(agents) * cells.cause.width))
    kept = _thinned(kept, room // 2) | _thinned(~kept, room - min(kept.sum(), room // 2))
    scale = np.maximum(cells.high - cells.low, 1e-9)
    values = np.asarray(one.cause.of(steps.x[kept])[:, agents, things] / scale, np.float32)
    some = steps if kept.all() else steps.part(kept)
    return _Read(some, values, agents, left[kept], ~some.unsafe), scale


def _thinned(some: np.ndarray, count: int) -> np.ndarray:
    """(T,) bool: every so many-th of them, about as many as that at most."""
    at = np.flatnonzero(some)
    found = np.zeros(some.shape, bool)
    found[at[:: max(1, -(-len(at) // max(count, 1)))]] = True
    return found


def _box(cells: Cells, scale: np.ndarray) -> list[_Side]:
    """Sides around nearly all cells of danger, where others were visited beyond."""
    visited = np.flatnonzero(cells.visits >= VISITED)
    danger = visited[cells.danger[visited] > 0.5]
    if not len(danger):
        return []
    places, dangerous = (np.stack(np.unravel_index(at, (cells.bins,) * len(scale)), -1) for at in (visited, danger))
    weight = (cells.visits * cells.danger)[danger]
    sides = []
    for k in range(len(scale)):
        order = np.argsort(dangerous[:, k], kind="stable")
        share = np.cumsum(weight[order]) / max(weight.sum(), 1e-9)
        ends = (min(np.searchsorted(share, q), len(order) - 1) for q in (STRAY, 1 - STRAY))
        first, last = (int(dangerous[order[end], k]) for end in ends)
        cuts = cells.cuts[k] / scale[k]
        if last < places[:, k].max():
            sides.append(_Side(k, 1.0, float(cuts[last + 1])))
        if first > places[:, k].min():
            sides.append(_Side(k, -1.0, -float(cuts[first])))
    return sides


def _fitted(read: _Read, sides: list[_Side]) -> list[_Side]:
    """The sides at thresholds that tell fewest steps wrongly, each in turn, without those that tell nothing."""
    for _ in range(SWEEPS):
        before = sides
        for k, side in enumerate(sides):
            score = np.where(_highest(read, sides, k) < 0, side.sign * read.values[..., side.number], np.inf)
            at = read.parted(score)[1]
            if np.isfinite(at):
                sides = [*sides[:k], replace(side, at=at), *sides[k + 1 :]]
        if sides == before:
            break
    for side in list(sides):
        rest = [other for other in sides if other is not side]
        if rest and _count(read, rest) <= _count(read, sides) + NEEDLESS * read.bad.sum():
            sides = rest
    return sides


def _highest(read: _Read, sides: Sequence[_Side], without: int = -1) -> np.ndarray:
    """(T, P) the highest of all sides but one."""
    found = np.full(read.values.shape[:-1], -np.inf, np.float32)
    for k, side in enumerate(sides):
        if k != without:
            np.maximum(found, side.of(read.values), out=found)
    return found


def _count(read: _Read, sides: Sequence[_Side]) -> int:
    """Steps that they tell wrongly."""
    score = _highest(read, sides)
    unsafe = of_the_worst(read.steps, score, score, read.agents) < 0
    return int((read.bad & ~unsafe).sum() + (read.fine & unsafe).sum())


def _condition(reads: Sequence[Quantity], side: _Side, scale: np.ndarray, units: np.ndarray) -> Sum:
    """The side in units of the first number."""
    weight = float(side.sign * units[side.number])
    return Sum((reads[side.number],), (weight,), -float(side.at * scale[side.number] * units[side.number]))


@dataclass(frozen=True)
class _Line:
    """A condition of two numbers: the first and so many times the second, each times a sign, are below `at`."""

    wrong: int  # steps that it tells wrongly
    signs: tuple[float, float]
    weight: float
    at: float
    squared: int | None  # which of the two is squared


def _best_line(read: _Read, steps: Steps, one: Counted, explained: Explained) -> _Line | None:
    """The line that tells fewest steps wrongly: of both numbers as they are, or of one's square, where some steps say
    that this tells more."""
    some = _read(steps, one, explained, SCREENED)[0]
    lines = [line for k in (None, 1, 0) if (line := _line(some, one.cells, k)) is not None]
    if not lines:
        return None
    plain, *squares = lines
    best = min(squares, key=lambda line: line.wrong)
    clearly = best.wrong < plain.wrong - NEEDLESS * some.bad.sum()
    return _line(read, one.cells, best.squared if clearly else None)


def _line(read: _Read, cells: Cells, squared: int | None) -> _Line | None:
    """The line that tells fewest steps wrongly, towards where danger is; of the square of one number."""
    centres, unsafe = cells.known()
    if unsafe.all() or not unsafe.any():
        return None
    toward = centres[unsafe].mean(0) - centres[~unsafe].mean(0)
    signs = (1.0 if toward[0] < 0 else -1.0), (1.0 if toward[1] < 0 else -1.0)
    one, two = (
        sign * (values * abs(values) if k == squared else values)
        for k, (sign, values) in enumerate(zip(signs, np.moveaxis(read.values, -1, 0)))
    )
    weight, found, best = 1.0, [(0, 0.0)], 0
    for factor, either in zip(RATIOS, TRIED):
        tried = [weight * factor**k for k in range(-either, either + 1)]
        found = [read.parted(one + np.float32(w) * two) for w in tried]
        best = _middle_of_best(found)
        weight = tried[best]
    return _Line(found[best][0], signs, weight, found[best][1], squared)


def _middle_of_best(found: Sequence[tuple[int, float]]) -> int:
    """Of what tells fewest steps wrongly, the one in the middle."""
    alike = [k for k, (wrong, _) in enumerate(found) if wrong == min(found)[0]]
    return alike[len(alike) // 2]
