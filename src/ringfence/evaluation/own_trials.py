"""Episodes of anybody's simulator, for a certificate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from ringfence.envs.base import Moment
from ringfence.envs.episode import Cost, Episode
from ringfence.evaluation.play import play_all, simulators_of
from ringfence.evaluation.player import player_of_run
from ringfence.evaluation.rollout import FORESEEN, RESETS
from ringfence.evaluation.simulators import name_of
from ringfence.evaluation.trials import Part, Trials, features, least_score, shortfall
from ringfence.faults import Faults
from ringfence.guards import Guard
from ringfence.loading.resolve import Resolved
from ringfence.utils.precision import float32
from ringfence.utils.progress import Progress

SIDE_BY_SIDE = 16  # simulators


class Foresight:
    """A `Watch` of B episodes: what a guard foresaw of every step, and how what came is scored, the least of all
    agents."""

    def __init__(self, guard: Guard, homogeneous: bool):
        self.guard = guard
        self.homogeneous = homogeneous
        self.foreseen: list[np.ndarray] = []
        self.came: list[np.ndarray] = []

    def __call__(self, now: Moment) -> None:
        """What came of a step, if it was shown."""
        with float32():
            before, after = (features(self.guard, self.homogeneous, *seen) for seen in (now.before, now.after))
            came = np.asarray(least_score(self.guard, before, after))
        self.foreseen.append(np.where(now.outcome.shown, np.asarray(now.decided.info[FORESEEN]), -np.inf))
        self.came.append(np.where(now.outcome.shown, came, np.inf))

    def shortfall(self) -> np.ndarray:
        """(B,) as a certificate counts it."""
        foreseen, came = np.stack(self.foreseen, 1), np.stack(self.came, 1)
        return shortfall(foreseen, came, self.guard.options.delay)


@dataclass(frozen=True)
class Own:
    """Episodes in a simulator of one's own: validation resets to calibrate on, test resets to count."""

    make_env: Callable[[], Any]
    faults: Faults
    episodes: Mapping[Part, int]
    cost: Cost | None = None
    quiet: bool = True

    def play(self, resolved: Resolved, part: Part, batch: int) -> Trials:
        """Another `batch` has other resets."""
        assert resolved.guard is not None, "refused before"
        guard = resolved.guard
        split = "test" if part == "test" else "validation"
        player = player_of_run(resolved, split, self.faults)
        count = self.episodes[part]
        env = simulators_of(self.make_env, min(SIDE_BY_SIDE, count), player, self.cost)
        first = RESETS[split] + batch * count * (part == "calibration")
        label = f"{part} in {type(env.envs[0]).__name__} behind {self.faults.name}, margin {guard.options.margin:.3g}"
        episodes: list[Episode] = []
        watches: list[Foresight] = []

        def watch() -> Foresight:
            watches.append(Foresight(guard, resolved.job.task.homogeneous))
            return watches[-1]

        key = jax.random.key(resolved.run.config["seed"] + batch)
        with Progress(label, count, 0, self.quiet) as bar:
            play_all(player, env, range(first, first + count), key, bar, episodes, watch)
        steps = sum(len(episode.rewards) for episode in episodes)
        infeasible = sum(episode.counts["infeasible"] for episode in episodes)
        violated = np.array([episode.team_costs.any() for episode in episodes])
        return Trials(violated, np.concatenate([watch.shortfall() for watch in watches]), infeasible / max(steps, 1))

    @property
    def about(self) -> dict[str, Any]:
        """Which simulator it was."""
        return {"simulator": name_of(self.make_env)}
