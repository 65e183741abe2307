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

from ringfence.world.causes import Cause, Edge, narrowed
from ringfence.world.cells import CELLS, Cells
from ringfence.world.quantities import Entry, from_zero

UNSAFE_STEPS = 30_000  # that causes are looked for in, at most
SAFE_STEPS = 120_000  # likewise
FOLDS = 3
SUFFICIENT = 0.3  # share of unsafe steps, beyond what others explain, at which a cell is dangerous
CLEAR = 0.8  # probability of danger of cells whose neighbours may hold an edge
PRIOR = 2.0  # safe visits that every cell is taken to have had
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
    seen: dict[Cause, tuple[np.ndarray, np.ndarray, int, np.ndarray]]  # ranges, cells along an axis, cells of steps
    fine: dict[Cause, np.ndarray]  # safe visits

    def cells(self, cause: Cause) -> tuple[np.ndarray, np.ndarray, int, np.ndarray]:
        """(low, high, cells along each axis, (T, N, J) cell of each thing in the part of its episode); remembered."""
        if cause not in self.seen:
            low, high = _range(self, cause)
            bins = _bins(cause, len(self.x) * self.x.shape[1])
            cell = _cell(cause, self.x, low, high, bins) + bins**cause.width * self.fold[:, None, None]
            self.seen[cause] = low, high, bins, cell.astype(np.int32)
        return self.seen[cause]

    def picked(self, cause: Cause) -> tuple[np.ndarray, np.ndarray]:
        """((T, P) cells of the agents and things that a cause is about, (P,) whose they are); those of a cause of all
        are remembered."""
        cell = self.cells(narrowed(cause, ()))[-1]
        agents, things = np.nonzero(cause.holds(cell.shape[1]))
        return cell[:, agents, things], agents

    def safe_visits(self, cause: Cause) -> np.ndarray:
        """(FOLDS, cells) in safe steps; remembered."""
        if cause not in self.fine:
            cell, agents = self.picked(cause)
            bins = self.cells(narrowed(cause, ()))[2]
            self.fine[cause] = self.visits(cell, agents, ~self.unsafe, bins**cause.width)
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
        return replace(self, **taken, seen={}, fine={})

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
    low, high = np.quantile(flat, [0.0005, 0.9995], axis=0)
    fold = rng.permutation(int(episode.max()) + 1) % FOLDS
    return Steps(x, unsafe[some], fold[episode[some]], episode[some], low, high, {}, {})


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
    low, high, bins, _ = steps.cells(narrowed(cause, ()))
    cell, agents = steps.picked(cause)
    left = explained.left
    bad, fine = steps.visits(cell, agents, left, bins**cause.width), steps.safe_visits(cause)
    usual = left.sum() / max(left.sum() + (~steps.unsafe).sum(), 1.0)
    all_bad, all_fine = bad.sum(0), fine.sum(0)
    cells = Cells(cause, low, high, bins, all_bad + all_fine, _danger(all_bad, all_fine, usual))
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


def _range(steps: Steps, cause: Cause) -> tuple[np.ndarray, np.ndarray]:
    at = [list(read.at) for read in cause.reads if isinstance(read, Entry)]
    if len(at) == cause.width:
        return np.array([steps.low[d].min() for d in at]), np.array([steps.high[d].max() for d in at])
    some = cause.of(steps.x[:: max(1, len(steps.x) // 20_000)])
    low, high = np.quantile(some, [0.0005, 0.9995], axis=tuple(range(some.ndim - 1)))
    if cause.is_rule:  # what is in danger is rare
        low = np.asarray(cause.of(steps.x).min(), float)[None]
    return np.array([0.0 if from_zero(read) else least for read, least in zip(cause.reads, low)]), high


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
    offset = values[..., None] - np.array(edge.bounds)
    safe = ((offset > 0).sum(-1) % 2 == 1) == edge.inside
    return np.where(safe, 1.0, -1.0) * np.abs(offset).min(-1)


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
