"""How often steps are unsafe when somebody is in a cell: what the search for causes counts, and what it gains; and, of
a cause of one number, where danger begins, finer than cells are.

Every episode is in one of FOLDS parts. What explains a step is counted on the other parts, so that a cause gains
nothing by steps that it knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import msgspec
import numpy as np

from ringfence.utils import interrupts
from ringfence.world.causes import CELLS, Cause, Cells, Edge, narrowed
from ringfence.world.quantities import Entry, Quantity, from_zero, is_condition

UNSAFE_STEPS = 30_000  # that causes are looked for in, at most
SAFE_STEPS = 120_000  # likewise
FOLDS = 3
SUFFICIENT = 0.3  # share of unsafe steps, beyond what others explain, at which a cell is dangerous
CLEAR = 0.8  # probability of danger of cells whose neighbours may hold an edge
PRIOR = 2.0  # safe visits that every cell is taken to have had
SAMPLED = 20_000  # steps, of which it is told where cells are cut
TAILS = (0.0005, 0.9995)  # of what was seen, outside of which nothing is cut
RANKS = 200  # of unsafe steps, between which these are compared with safe ones, at most
VISITS = 20  # of unsafe steps between two ranks, at least
FINE = 3.0  # cells that half of the danger lies in, at least
CLEARLY = 3.0  # standard errors, by which unsafe steps have to be more
AROUND = 3.0  # cells to either side that an edge is looked for in


@dataclass(frozen=True, eq=False)
class Steps:
    """Some of the logged steps."""

    x: np.ndarray  # (T, N, D) where they led to
    unsafe: np.ndarray  # (T,) of the team or (T, N)
    fold: np.ndarray  # (T,) the part that its episode is in
    episode: np.ndarray  # (T,)
    low: np.ndarray  # (D,) of nearly all that was seen
    high: np.ndarray  # (D,)
    seen: dict[Cause, tuple[np.ndarray, np.ndarray]]  # where cells are cut, cells of steps
    read: dict[tuple[Quantity, int], tuple[np.ndarray, np.ndarray]]  # where numbers are cut, and which part each is in
    ways: dict[Quantity, tuple[np.ndarray, np.ndarray, np.ndarray]]  # values, shares of range and of danger below
    fine: dict[Cause, np.ndarray]  # safe visits

    def cells(self, cause: Cause) -> tuple[np.ndarray, np.ndarray]:
        """((width, B + 1) where cells are cut along each axis, (T, N, J) cell of each thing, in the part of its
        episode); remembered."""
        if cause not in self.seen:
            bins = _bins(cause, len(self.x) * self.x.shape[1])
            read = [self._read(one, bins) for one in cause.reads]
            cell = self.fold[:, None, None].astype(np.int32)
            for _, places in read:
                cell = cell * np.int32(bins) + places
            self.seen[cause] = np.stack([cuts for cuts, _ in read]), cell
        return self.seen[cause]

    def _read(self, read: Quantity, bins: int) -> tuple[np.ndarray, np.ndarray]:
        """((bins + 1,) where cells of a number are cut, (T, N, J) the one that each is in); remembered."""
        if (read, bins) not in self.read:
            cuts = self._cuts(read, bins)
            self.read[read, bins] = cuts, _places(cuts, read.of(self.x))
        return self.read[read, bins]

    def _cuts(self, read: Quantity, bins: int) -> np.ndarray:
        """(bins + 1,) where cells of a number begin and end: equally long, but that half of its danger has FINE of
        them, however little of the range that is. Who roams over a city is in danger within a metre."""
        if read not in self.ways:
            self.ways[read] = _way(self, read)
        values, spread, danger = self.ways[read]
        dense = np.argsort(-np.diff(danger) / np.maximum(np.diff(spread), 1e-12))
        half = dense[: np.searchsorted(np.cumsum(np.diff(danger)[dense]), 0.5) + 1]
        lacking = FINE / bins - np.diff(spread)[half].sum() if danger[-1] else 0.0
        more = np.clip(2 * lacking, 0.0, 0.5)
        way = (1 - more) * spread + more * danger
        return np.interp(np.linspace(0.0, 1.0, bins + 1), way, values).astype(self.x.dtype)

    def picked(self, cause: Cause) -> tuple[np.ndarray, np.ndarray]:
        """((T, P) cells of the agents and things that a cause is about, (P,) whose they are); those of a cause of all
        are remembered."""
        cell = self.cells(narrowed(cause, ()))[-1]
        agents, things = np.nonzero(cause.holds(cell.shape[1]))
        return cell[:, agents, things], agents

    def size(self, cause: Cause) -> int:
        """How many cells there are."""
        return (self.cells(narrowed(cause, ()))[0].shape[1] - 1) ** cause.width

    def safe_visits(self, cause: Cause) -> np.ndarray:
        """(FOLDS, cells) in safe steps; remembered."""
        if cause not in self.fine:
            cell, agents = self.picked(cause)
            self.fine[cause] = self.visits(cell, agents, ~self.unsafe, self.size(cause))
        return self.fine[cause]

    def visits(self, cell: np.ndarray, agents: np.ndarray, weight: np.ndarray, size: int) -> np.ndarray:
        """(FOLDS, size) visits of cells (T, P) by agents (P,), by what each step weighs (T,) or (T, N)."""
        some = np.flatnonzero(weight.reshape(len(weight), -1).any(1))  # of the others nothing is counted
        of = agents if self.each else np.zeros(len(agents), int)
        each = weight.reshape(len(weight), -1)[some][:, of]
        return np.bincount(cell[some].ravel(), each.ravel(), FOLDS * size).reshape(FOLDS, size)

    @cached_property
    def varies(self) -> np.ndarray:
        """(N, D) bool: which entries of whom vary at all."""
        return np.asarray(self.x.min(0) < self.x.max(0))

    def vary(self, cause: Cause) -> np.ndarray:
        """(N, J) bool: of which agents and things all that a cause reads varies."""
        return cause.varies(self.varies)

    def part(self, some: np.ndarray) -> Steps:
        """Those of the steps, `some` (T,) bool."""
        taken = {name: getattr(self, name)[some] for name in ("x", "unsafe", "fold", "episode")}
        return replace(self, **taken, seen={}, read={}, ways={}, fine={})

    @property
    def each(self) -> bool:
        """Whether every agent has a cost of its own."""
        return self.unsafe.ndim == 2


@dataclass(frozen=True, eq=False)
class Counted:
    """Cells of a cause, and what they say of each step without having counted its part."""

    steps: Steps
    cells: Cells  # of all steps
    others: np.ndarray  # (FOLDS, cells) probability of danger, by the steps of the other parts
    visited: np.ndarray  # (FOLDS, cells) bool: by steps of the other parts
    safe: np.ndarray  # (T,) or (T, N) log P(safe) by this cause
    gain: float = 0.0  # log likelihood of a step, beyond what was explained
    error: float = 0.0  # standard error of the gain over episodes

    @property
    def cause(self) -> Cause:
        return self.cells.cause

    # Most that are counted gain nothing, and of these nobody asks for more.

    @cached_property
    def called(self) -> np.ndarray:
        """(T,) or (T, N) bool: called unsafe as the cause is scored later, also where nobody was."""
        if not self.others.any():
            return np.zeros(self.safe.shape, bool)
        unsafe = self.safe < np.log(0.5)
        return unsafe if self.cause.goes_on else unsafe | self._any_in(~self.visited)

    @cached_property
    def near(self) -> np.ndarray:
        """(T,) or (T, N) bool: within a cell of danger, so that it may well explain an unsafe step."""
        from scipy.ndimage import binary_dilation  # slow to import, and read by fits alone

        if not self.others.any():
            return np.zeros(self.safe.shape, bool)
        width = self.cause.width
        clear = (self.others > CLEAR).reshape(FOLDS, *[self.cells.bins] * width)
        return self._any_in(binary_dilation(clear, np.ones((1, *[3] * width))))

    def _any_in(self, these: np.ndarray) -> np.ndarray:
        """(T,) or (T, N) bool: something that the cause is about is in one of these cells, FOLDS times each."""
        cell, agents = self.steps.picked(self.cause)
        return _worst(self.steps, np.where(these.ravel(), -1.0, 0.0)[cell], agents) < 0


def some_steps(x: np.ndarray, unsafe: np.ndarray, episode: np.ndarray, rng: np.random.Generator) -> Steps:
    """As many of the steps as are needed."""
    bad = unsafe if unsafe.ndim == 1 else np.asarray(unsafe.any(1))
    some = _sampled(bad, rng) if len(x) > SAFE_STEPS // 2 else np.arange(len(x))
    x = np.asarray(x[some], np.float32)
    # Whole teams are left out: every other row of all agents' would be of every other agent.
    flat = x[:: max(1, x[..., 0].size // 200_000)].reshape(-1, x.shape[-1])
    low, high = np.quantile(flat, TAILS, axis=0)
    fold = rng.permutation(int(episode.max()) + 1) % FOLDS
    return Steps(x, unsafe[some], fold[episode[some]], episode[some], low, high, {}, {}, {}, {})


def _sampled(bad: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rows of steps, in order: UNSAFE_STEPS of the unsafe ones at most, and the same share of the safe ones, at least
    as many and at most SAFE_STEPS."""
    rows = np.flatnonzero(bad)
    rows = rng.choice(rows, min(len(rows), UNSAFE_STEPS), replace=False)
    fine = np.flatnonzero(~bad)
    share = len(rows) / max(bad.sum(), 1)
    count = min(len(fine), SAFE_STEPS, max(int(share * len(fine)), UNSAFE_STEPS))
    return np.sort(np.concatenate([rows, rng.choice(fine, count, replace=False)]))


@dataclass(frozen=True, eq=False)
class Explained:
    """What several causes tell of steps, the worst of them."""

    steps: Steps
    safe: np.ndarray  # (T,) or (T, N) log P(safe)
    near: np.ndarray  # (T,) or (T, N) bool

    @classmethod
    def by(cls, steps: Steps, chosen: Sequence[Counted]) -> Explained:
        nothing = np.zeros(steps.unsafe.shape)
        safe = np.minimum.reduce([nothing, *[one.safe for one in chosen]])
        return cls(steps, safe, np.logical_or.reduce([nothing > 0, *[one.near for one in chosen]]))

    def beside(self, one: Counted) -> Explained:
        """What they tell with one more."""
        return Explained(self.steps, np.minimum(self.safe, one.safe), self.near | one.near)

    def of(self, steps: Steps, some: np.ndarray) -> Explained:
        """What they tell of those that are some (T,) bool of the steps."""
        return Explained(steps, self.safe[some], self.near[some])

    @cached_property
    def left(self) -> np.ndarray:
        """(T,) or (T, N) how much of each unsafe step is still to be explained. At the edge of a cause that is nothing:
        cells are too coarse to tell, and what they leave there is no cause of its own."""
        return np.exp(self.safe) * self.steps.unsafe * ~self.near

    @cached_property
    def likelihood(self) -> np.ndarray:
        return likelihood(self.steps, self.safe)


def counted(steps: Steps, cause: Cause, explained: Explained) -> Counted:
    """The cause, by what others leave unexplained."""
    interrupts.check()  # a search counts thousands
    cuts = steps.cells(narrowed(cause, ()))[0]
    cell, agents = steps.picked(cause)
    left = explained.left
    bad, fine = steps.visits(cell, agents, left, steps.size(cause)), steps.safe_visits(cause)
    usual = left.sum() / max(left.sum() + (~steps.unsafe).sum(), 1.0)
    all_bad, all_fine = bad.sum(0), fine.sum(0)
    cells = Cells(cause, cuts, all_bad + all_fine, _danger(all_bad, all_fine, usual))
    others = _danger(all_bad - bad, all_fine - fine, usual)  # (FOLDS, size)
    visited = all_bad + all_fine - bad - fine > 0
    if not others.any():
        return Counted(steps, cells, others, visited, np.zeros(steps.unsafe.shape))
    safe = _worst(steps, np.log1p(-others).ravel()[cell], agents)
    return Counted(steps, cells, others, visited, safe, *gain(steps, explained, safe))


def _danger(bad: np.ndarray, fine: np.ndarray, usual: float) -> np.ndarray:
    """Probability that being in a cell makes a step unsafe; 0 where it is not clearly dangerous."""
    share = bad / (bad + fine + PRIOR)
    error = np.sqrt(np.maximum(share * (1 - share), 0.0) / (bad + fine + PRIOR))
    rest = max(1.0 - usual, 1e-9)  # nothing is left where all steps are unsafe
    beyond = np.clip((share - error - usual) / rest, 0.0, 1.0)  # the rest comes of other causes
    return np.where(beyond > SUFFICIENT, np.clip((share - usual) / rest, 0.0, 0.999), 0.0)


def _worst(steps: Steps, each: np.ndarray, agents: np.ndarray) -> np.ndarray:
    """(T,) or (T, N) of values (T, P) of these agents' things: the least, of all agents where costs are the team's."""
    if not steps.each:
        return each.min(1)
    found = np.zeros(steps.unsafe.shape)
    for agent in np.unique(agents):
        found[:, agent] = each[:, agents == agent].min(1)
    return found


def gain(steps: Steps, explained: Explained, safe: np.ndarray) -> tuple[float, float]:
    """(log likelihood that a cause adds to a step, its standard error over episodes)."""
    more = likelihood(steps, np.minimum(explained.safe, safe)) - explained.likelihood
    more = np.where(steps.unsafe & explained.near, 0.0, more)
    more = more if more.ndim == 1 else more.sum(1)
    totals = np.bincount(steps.episode, more)
    totals = totals[np.bincount(steps.episode) > 0]
    error = totals.std() * np.sqrt(len(totals)) / len(more)
    return float(more.mean()), float(error)


def likelihood(steps: Steps, safe: np.ndarray) -> np.ndarray:
    """(T,) or (T, N) log likelihood of the steps; what no cause explains is as frequent as in all."""
    open_ = safe > -1e-6
    leak = np.clip(steps.unsafe[open_].mean() if open_.any() else 0.0, 1e-4, 1 - 1e-4)
    chance = np.clip(1 - np.exp(safe) * (1 - leak), 1e-4, 1 - 1e-4)
    return np.where(steps.unsafe, np.log(chance), np.log1p(-chance))


def _way(steps: Steps, read: Quantity) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(values of a number, the share of its range below each, and the share of its danger: of what unsafe steps clearly
    are more often than safe ones, none where they are not)."""
    bad, fine = _some_values(steps, read, steps.unsafe), _some_values(steps, read, ~steps.unsafe)
    if isinstance(read, Entry):
        low, high = steps.low[list(read.at)].min(), steps.high[list(read.at)].max()
    else:
        low, high = np.quantile(read.of(steps.x[:: max(1, len(steps.x) // SAMPLED)]), TAILS)
    low = 0.0 if from_zero(read) else low
    if is_condition(read):  # what is in danger is rare
        low = min(low, float(read.of(steps.x).min()))
    high = max(high, low + max(1e-9, 1e-6 * abs(low)))  # as single precision tells apart
    ranks = np.linspace(0.0, 1.0, int(np.clip(len(bad) / VISITS, 1, RANKS)) + 1)
    values = np.unique([low, *np.clip(np.quantile(bad, ranks) if len(bad) else [], low, high), high])
    spread = (values - low) / (high - low)
    shares = [
        np.diff(np.searchsorted(np.sort(some), values[1:-1], "right"), prepend=0, append=len(some)) / max(len(some), 1)
        for some in (bad, fine)
    ]
    error = np.sqrt(shares[0] / max(len(bad), 1) + shares[1] / max(len(fine), 1))
    more = np.maximum(shares[0] - shares[1] - CLEARLY * error, 0.0)
    return values, spread, np.cumsum([0.0, *more]) / max(more.sum(), 1e-12)


def _some_values(steps: Steps, read: Quantity, of: np.ndarray) -> np.ndarray:
    """(S,) of a number in some of these steps (T,) or (T, N) bool: of how far things are, of the nearest."""
    rows = np.flatnonzero(of if of.ndim == 1 else of.any(1))
    rows = rows[:: max(1, len(rows) // SAMPLED)]
    values = np.asarray(read.of(steps.x[rows]))
    if from_zero(read):
        values = values.min(-1, keepdims=True)
    if of.ndim == 2:
        values = values[of[rows]]
    elif from_zero(read):
        values = values.min(1)
    return values.ravel()


def _places(cuts: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Which cell values are in, 255 at most: as that of the slice of the range that each is in, and from there on."""
    bins, low, high = len(cuts) - 1, cuts[0], cuts[-1]
    slices = 16 * bins
    begins = np.linspace(low, high, slices, endpoint=False, dtype=cuts.dtype)
    upper = np.append(cuts[1:-1], np.inf).astype(cuts.dtype)
    scaled = np.clip((values - low) * (slices / (high - low)), 0, slices - 1)
    found = np.searchsorted(cuts[1:-1], begins, "right").astype(np.uint8)[scaled.astype(np.int32)]
    while (beyond := values >= upper[found]).any():
        found += beyond
    return found


def _bins(cause: Cause, samples: int) -> int:
    most = CELLS[cause.width]
    return int(np.clip((samples / 20) ** (1 / cause.width), 6, most))


# --- edges ---


def radius(x: np.ndarray, unsafe: np.ndarray, episode: np.ndarray, cause: Cause) -> Edge:
    """Where one cause is dangerous, as steps tell it that look for no other."""
    steps = some_steps(x, unsafe, episode, np.random.default_rng(0))
    nothing = Explained.by(steps, [])
    return refined(steps, counted(steps, cause, nothing).cells.edge, cause, nothing)


def refined(steps: Steps, edge: Edge, cause: Cause, explained: Explained) -> Edge:
    """The edge with bounds between the values that parted unsafe steps from safe ones, finer than cells are."""
    if cause.is_rule and edge.bounds:  # its conditions say where
        return msgspec.structs.replace(edge, at=0.0, below=True, bounds=(0.0,), inside=True, unseen=(False,))
    if not edge.bounds:
        return edge
    agents, things = np.nonzero(cause.holds(steps.x.shape[1]))
    values = cause.of(steps.x)[:, agents, things, 0]
    value = of_the_worst(steps, values, signed(values, edge), agents)
    left = explained.left > 0.5
    size = (edge.high[0] - edge.low[0]) / CELLS[1]
    bounds = list(edge.bounds)
    for k, bound in enumerate(edge.bounds):
        near = np.abs(value - bound) < AROUND * size
        bad, fine = value[near & left], value[near & ~steps.unsafe]
        if not edge.unseen[k] and len(bad) and len(fine):
            sign = 1.0 if (k % 2 == 0) == edge.inside else -1.0
            bounds[k] = sign * parted(sign * bad, sign * fine)[1]
    seen = [bound for bound, unseen in zip(bounds, edge.unseen) if not unseen]
    at = None if edge.at is None else round(seen[0], 4)
    return msgspec.structs.replace(edge, bounds=tuple(sorted(bounds)), at=at)


def signed(values: np.ndarray, edge: Edge) -> np.ndarray:
    """Distances of values to where danger begins, below 0 in danger."""
    passed, far = np.zeros(values.shape, bool), np.full(values.shape, np.inf)
    for bound in edge.bounds:
        passed ^= values > bound
        np.minimum(far, np.abs(values - bound), out=far)
    return np.where(passed == edge.inside, far, -far)


def of_the_worst(steps: Steps, values: np.ndarray, score: np.ndarray, agents: np.ndarray) -> np.ndarray:
    """(T,) or (T, N) the values of the things in most danger; far off where an agent has none."""
    if not steps.each:
        return np.take_along_axis(values, score.argmin(1)[:, None], 1)[:, 0]
    found = np.full(steps.unsafe.shape, np.inf)
    for agent in np.unique(agents):
        own = agents == agent
        found[:, agent] = np.take_along_axis(values[:, own], score[:, own].argmin(1)[:, None], 1)[:, 0]
    return found


def parted(bad: np.ndarray, fine: np.ndarray) -> tuple[int, float]:
    """(steps told wrongly by the edge that tells fewest so, where it is), by scores of unsafe and of safe steps, low in
    danger: in the middle to the next score; −∞ where no score is finite."""
    bad, fine = np.sort(bad), np.sort(fine)
    tried = np.unique(np.concatenate([bad, fine]))
    wrong = len(bad) - np.searchsorted(bad, tried, "right") + np.searchsorted(fine, tried, "right")
    tried = tried[np.isfinite(tried)]  # what is not finite comes last
    if not len(tried):
        return len(bad), -np.inf
    best = int(wrong[: len(tried)].argmin())
    return int(wrong[best]), float(0.5 * (tried[best] + tried[min(best + 1, len(tried) - 1)]))


def within(steps: Steps, cause: Cause, edge: Edge) -> np.ndarray:
    """(T,) or (T, N) bool: somebody is in danger by a cause of one number."""
    agents, things = np.nonzero(cause.holds(steps.x.shape[1]))
    score = signed(cause.of(steps.x)[:, agents, things, 0], edge)
    return of_the_worst(steps, score, score, agents) < 0
