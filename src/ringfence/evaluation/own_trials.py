"""Episodes of anybody's simulator, for a certificate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.episode import Cost
from ringfence.evaluation.play import Table, play_tables, simulators_of
from ringfence.evaluation.player import player_of_run
from ringfence.evaluation.rollout import FORESEEN, RESETS
from ringfence.evaluation.simulators import name_of
from ringfence.evaluation.trials import Part, Trials, features, least_score, shortfall
from ringfence.faults import Faults
from ringfence.guards import Guard
from ringfence.loading.resolve import Resolved
from ringfence.types import Array
from ringfence.utils.precision import float32
from ringfence.utils.progress import Progress

SIDE_BY_SIDE = 16  # simulators


class Foresight:
    """A `Watch` of B episodes: what a guard foresaw of every step, and how what came is scored, the least of all
    agents."""

    def __init__(self, guard: Guard, homogeneous: bool):
        self.guard = guard
        self.homogeneous = homogeneous
        self.before: Array | None = None
        self.foreseen: list[np.ndarray] = []
        self.came: list[np.ndarray] = []

    def begin(self, observations: np.ndarray, state: np.ndarray | None) -> None:
        """Episodes begin here."""
        self.before = self._features(observations, state)

    def step(
        self, info: Mapping[str, Array], counts: np.ndarray, observations: np.ndarray, state: np.ndarray | None
    ) -> None:
        """What came of a step, where that counts (B,): the episode was running, and showed where it led."""
        after = self._features(observations, state)
        with float32():
            came = np.asarray(least_score(self.guard, self.before, after))
        self.foreseen.append(np.where(counts, np.asarray(info[FORESEEN]), -np.inf))
        self.came.append(np.where(counts, came, np.inf))
        self.before = after

    def shortfall(self) -> np.ndarray:
        """(B,) as a certificate counts it."""
        foreseen, came = np.stack(self.foreseen, 1), np.stack(self.came, 1)
        return shortfall(foreseen, came, self.guard.options.delay)

    def _features(self, observations: np.ndarray, state: np.ndarray | None) -> Array:
        with float32():
            return jnp.asarray(features(self.guard, self.homogeneous, observations, state))


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
        envs = simulators_of(self.make_env, min(SIDE_BY_SIDE, count), player)
        first = RESETS[split] + batch * count * (part == "calibration")
        label = f"{part} in {type(envs[0]).__name__} behind {self.faults.name}, margin {guard.options.margin:.3g}"
        tables: list[Table] = []
        watches: list[Foresight] = []

        def watch() -> Foresight:
            watches.append(Foresight(guard, resolved.job.task.homogeneous))
            return watches[-1]

        key = jax.random.key(resolved.run.config["seed"] + batch)
        with Progress(label, count, 0, self.quiet) as bar:
            play_tables(
                tables,
                player,
                envs,
                range(first, first + count),
                self.cost,
                key,
                bar,
                watch_of=watch,
            )
        episodes = [episode for table in tables for episode in table.episodes]
        steps = sum(len(episode.rewards) for episode in episodes)
        infeasible = sum(float(table.counted("infeasible").sum()) for table in tables)
        violated = np.array([sum(float(np.max(cost)) for cost in episode.costs) > 0 for episode in episodes])
        return Trials(violated, np.concatenate([watch.shortfall() for watch in watches]), infeasible / max(steps, 1))

    @property
    def about(self) -> dict[str, Any]:
        """Which simulator it was."""
        return {"simulator": name_of(self.make_env)}
