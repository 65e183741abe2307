"""What a grid consists of, as plain data: adding an algorithm is one line."""

from __future__ import annotations

from dataclasses import dataclass

from ringfence import algos
from ringfence.tasks import TASKS, Task

# Named sets of evaluation-time choices; keyword arguments of evaluate.evaluate.
EVALUATIONS: dict[str, dict] = {
    "plain": {},
    "plans8": {"plans": 8},
    "guarded": {"planner": "guarded"},
    "steady": {"planner": "steady"},
    "shielded": {"planner": "shielded"},
    "adaptive": {"planner": "adaptive"},
}


@dataclass(frozen=True)
class Entry:
    """An algorithm in the table, and how its runs are played."""

    algorithm: str
    preset: str = ""  # empty: the one made for the task where there is one, else the default
    evaluations: tuple[str, ...] = ("plain",)
    tiers: tuple[str, ...] = ()  # empty: all

    def plays(self, tier: str) -> bool:
        """Whether it is played on tasks of this tier."""
        return not self.tiers or tier in self.tiers

    @property
    def name(self) -> str:
        return f"{self.algorithm}:{self.preset}" if self.preset else self.algorithm

    def preset_for(self, task: Task) -> str:
        return self.preset or algos.get(self.algorithm).preset_for(task.presets)

    def names(self, task: Task) -> tuple[str, str]:
        """What the entry is called where entries are chosen."""
        return self.algorithm, f"{self.algorithm}:{self.preset_for(task)}"

    def variant(self, task: Task, evaluation: str) -> str:
        """The name of an evaluation in results.json."""
        preset = self.preset_for(task)
        return preset if evaluation == "plain" else f"{preset}+{evaluation}"


@dataclass(frozen=True)
class Suite:
    """Tasks and entries; every task is played with every entry."""

    tasks: tuple[str, ...]
    entries: tuple[Entry, ...]
    episodes: int = 200  # per run, unless told otherwise


SUITES = {
    "simple_spread": Suite(
        tuple(f"simple_spread-{tier}" for tier in ("expert", "medium", "medium-replay", "random")),
        (
            Entry("bc"),
            Entry("bc-safe"),
            Entry("ma-td3bc"),
            Entry("ma-td3bc-lag"),
            Entry("fisor"),
            Entry("omar"),
            Entry("ma-cql"),
            Entry("madiff", "default", ("plain", "guarded")),
            Entry("icbf", "paper"),
            Entry("icbf", "split", ("plain", "plans8", "guarded")),
            Entry("icbf", "long", ("plain", "guarded"), ("expert", "medium")),
        ),
    ),
    "mujoco": Suite(
        # Safety-gymnasium's limits first: what reads no danger is trained there and then judged by the other limit.
        tuple(t.name for protocol in ("native", "quantile") for t in TASKS.values() if t.protocol == protocol),
        (
            Entry("bc"),
            Entry("bc-safe"),
            Entry("ma-td3bc"),
            Entry("ma-td3bc-lag"),
            Entry("fisor"),
            Entry("omar"),
            Entry("ma-cql"),
            Entry("madiff", evaluations=("plain", "steady", "shielded", "adaptive")),
            Entry("icbf", "mujoco-paper"),
            Entry("icbf", evaluations=("plain", "steady", "shielded", "adaptive")),
        ),
        episodes=20,
    ),
}
