"""Where agents are in anybody's simulator, as far as its entries' names tell: for films of what was played."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from ringfence.envs.base import Moment, Seen, Watch, nobody
from ringfence.envs.episode import Episode
from ringfence.evaluation.recordings import Recording
from ringfence.problem.entries import Names

EPISODES = 4  # that are kept
LONGEST = 2000  # steps that are kept of each


class Places:
    """A `Watch` of the first of B episodes: where everybody is, seen from above."""

    def __init__(self, names: Names):
        self.names = names
        self.rows: list[np.ndarray] = []  # (R, N, 2) each, nan where nobody showed it
        self.resting = np.zeros((0, 0, 2))  # (R, K, 2) goals, landmarks: what does not move by itself

    def __call__(self, now: Moment) -> None:
        """Where a step led, if that was shown."""
        if not self.rows:
            self._begin(now.before)
        if len(self.rows) <= LONGEST:
            place = self._of(now.after)
            self.rows.append(np.where(now.outcome.shown[: len(place), None, None], place, np.nan))

    def _begin(self, seen: Seen) -> None:
        place = self._of(seen)
        self.rows.append(place)
        found = [place + seen.observations[: len(place)][..., pair[:2]] for pair in self.names.resting]
        self.resting = np.concatenate([np.zeros((len(place), 0, 2)), *found], 1)

    def _of(self, seen: Seen) -> np.ndarray:
        """(R, N, 2)"""
        place = self.names.place(seen.observations[:EPISODES], None if seen.state is None else seen.state[:EPISODES])
        assert place is not None, "asked before"
        return np.asarray(place[..., :2], np.float64)


def watching(names: Names, count: int) -> tuple[list[Places], Callable[[], Watch]]:
    """Who watches the first tables of `count` episodes each, until enough are kept; nobody watches the others."""
    watches: list[Places] = []

    def watch() -> Watch:
        if len(watches) >= math.ceil(EPISODES / count) or names.place_is_unknown:
            return nobody
        watches.append(Places(names))
        return watches[-1]

    return watches, watch


def recording(watches: Sequence[Places], episodes: Sequence[Episode]) -> Recording:
    """What is kept of the first of these episodes (recordings.py); nothing where nobody watched."""
    seen = [(np.stack(w.rows, 1)[r], w.resting[r]) for w in watches for r in range(len(w.rows[0]))]
    kept = [(rows, resting, e) for (rows, resting), e in zip(seen, episodes) if e.over and not e.skipped][:EPISODES]
    if not kept:
        return {}
    steps = min(max(len(e.rewards) for *_, e in kept), LONGEST)
    arrays = {
        "places": np.stack([filled(rows, steps + 1, np.nan) for rows, *_ in kept]),
        "resting": np.stack([resting for _, resting, _ in kept]),
        "rewards": np.stack([filled(e.team_rewards, steps, np.nan) for *_, e in kept]),
        "costs": np.stack([filled(e.team_costs, steps, 0.0) for *_, e in kept]),
    }
    if all(np.ndim(cost) for *_, e in kept for cost in e.costs):
        arrays["agent_costs"] = np.stack([filled(np.stack(e.costs), steps, 0.0) for *_, e in kept])
    return arrays


def filled(rows: np.ndarray, length: int, nothing: float) -> np.ndarray:
    """So many rows: the first of these, or as many more of nothing."""
    rows = rows[:length]
    return np.concatenate([rows, np.full((length - len(rows), *rows.shape[1:]), nothing)])
