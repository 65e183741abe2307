"""Anybody's simulators side by side, as one `Env` (envs/base.py)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ringfence.envs.base import Outcome, Seen
from ringfence.envs.episode import Cost, Episode, Shape
from ringfence.errors import UserError, of_kind

Charge = Callable[[np.ndarray, np.ndarray | None], np.ndarray]


@dataclass(eq=False)
class SideBySide:
    """PettingZoo `ParallelEnv`s, whose `episodes` keep what came of each.

    A step's cost is `cost(infos)` if that is given, else what the simulator tells; else `charge` of the observations
    and states that it leads to, (B,). Where that is None, too, it is refused.
    """

    envs: Sequence[Any]
    shape: Shape
    max_steps: int
    early_ends: str = "refuse"
    cost: Cost | None = None
    charge: Charge | None = None
    episodes: list[Episode] = field(default_factory=list)

    def __post_init__(self):
        of_kind("cost", self.cost, Callable | None, "give a function of the infos of a step")

    @property
    def running(self) -> np.ndarray:
        return np.array([e.running for e in self.episodes])

    def reset(self, seeds: Sequence[int]) -> None:
        """Begin as many episodes as there are seeds, in the first simulators."""
        begun = zip(self.envs, seeds)
        self.episodes = [Episode(env, self.shape, seed, self.max_steps, self.early_ends) for env, seed in begun]

    def observe(self) -> Seen:
        states = [e.state for e in self.episodes if e.state is not None]
        return Seen(np.stack([e.seen for e in self.episodes]), np.stack(states) if states else None)

    def step(self, action: np.ndarray) -> Outcome:
        running = self.running
        for episode, own in zip(self.episodes, action):
            if episode.running:
                episode.step(own, self.cost)
        if any(e.lacks_cost for e in self.episodes if not e.skipped):
            self._charge()
        nothing = np.zeros(action.shape[1])  # of an episode that was skipped at its first step
        return Outcome(
            reward=np.stack([e.rewards[-1] if e.rewards else nothing for e in self.episodes]),
            cost=self._last_costs(),
            terminated=running & np.array([e.terminated for e in self.episodes]),
            shown=running & np.array([e.running or e.showed_end for e in self.episodes]),
        )

    def _charge(self) -> None:
        """The last step costs what is charged for where it led."""
        if self.charge is None:
            raise UserError(
                "step() tells no cost, and no formula says of what the policy sees whether it is unsafe; pass cost=, a "
                "function of the agents' infos."
            )
        for episode, cost in zip(self.episodes, self.charge(*self.observe())):
            episode.charge(float(cost))

    def _last_costs(self) -> np.ndarray | dict[str, np.ndarray]:
        """(B,) what the last step of each cost, or that by constraint."""
        named = [e.constraints[0] for e in self.episodes if e.constraints]
        if not named:
            return np.array([np.max(e.costs[-1]) if e.costs else 0.0 for e in self.episodes], np.float32)
        nothing = dict.fromkeys(named[0], 0.0)
        last = [e.constraints[-1] if e.constraints else nothing for e in self.episodes]
        return {name: np.array([np.max(costs[name]) for costs in last], np.float32) for name in nothing}
