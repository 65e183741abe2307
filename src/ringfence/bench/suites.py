"""What a grid consists of, as plain data: adding an algorithm is one line."""

from __future__ import annotations

from dataclasses import dataclass

from ringfence import algos
from ringfence.bench.stressed import Trial
from ringfence.datasets.registry import TASKS
from ringfence.datasets.task import Task
from ringfence.envs.proving.system import TEST
from ringfence.evaluation.compensation import known_to_guards
from ringfence.faults import Faults
from ringfence.loading.spec import PolicySpec
from ringfence.proposals.options import DEFAULT


@dataclass(frozen=True)
class Entry:
    """An algorithm in the table, and how its runs are played."""

    algorithm: str
    preset: str = ""  # empty: the one made for the task where there is one, else the default
    evaluations: tuple[str, ...] = (DEFAULT,)  # how its runs are played, as names of PolicySpec
    tiers: tuple[str, ...] = ()  # empty: all
    trials: tuple[Trial, ...] = ()  # how its runs are played behind faults

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
        return PolicySpec.parse(evaluation).variant(self.preset_for(task))


@dataclass(frozen=True)
class Suite:
    """Tasks and entries; every task is played with every entry."""

    tasks: tuple[str, ...]
    entries: tuple[Entry, ...]
    episodes: int = 200  # per run, by default
    folder: str = ""  # of its results; empty: its name


_TIERS = ("hasty", "mixed", "careful", "random")
_CROSSING = tuple(f"crossing-{tier}" for tier in _TIERS)
_SPREAD = tuple(f"simple_spread-{tier}" for tier in ("expert", "medium", "medium-replay", "random"))
# Safety-gymnasium's limits first: what reads no danger is trained there and then judged by the other limit.
_ROBOTS = tuple(t.name for protocol in ("native", "quantile") for t in TASKS.values() if t.protocol == protocol)

# How a proposal is played for its own sake, and under the cheapest guard.
_STRESSED = tuple(f"proving-{name}" for name in ("discs", "crowd", "drones"))
_ALONE, _ADAPTED = (DEFAULT, "shield-learned"), (DEFAULT, "adapt-learned")
_COOL = "low_temperature"
_ICBF_GUARDS = ("adapt-learned", "adapt-analytic", "full-learned")
_PROVEN = (DEFAULT, *(f"{guard}-{source}" for source in ("learned", "oracle") for guard in ("shield", "adapt", "full")))
# Faults at three strengths, and several at once; what a guard can know of is compensated, too.
_FAULTS = (
    *("delay1", "delay2", "delay3", "jitter1", "jitter2", "jitter3", "drop0.1", "drop0.3", "drop0.6"),
    *("asynchrony0.333", "asynchrony0.5", "asynchrony0.667"),
    *("noise0.005", "noise0.02", "noise0.05", "bias0.005", "bias0.02", "bias0.05"),
    *("gain0.9", "gain0.8", "gain0.6", "spread0.1", "spread0.2", "spread0.4", "stop0.001", "stop0.002", "stop0.005"),
    "delay1+drop0.1+noise0.005+gain0.9+asynchrony0.333",
    "delay2+drop0.3+noise0.005+gain0.8+asynchrony0.5",
    "delay3+drop0.6+noise0.02+gain0.6+asynchrony0.667",
)
_BEHIND = (
    *(Trial(spec, faults) for spec in _ALONE for faults in _FAULTS),
    *(Trial("shield-learned", faults, compensated=True) for faults in _FAULTS if known_to_guards(Faults.parse(faults))),
)
_RIVALS = ("bc-best", "bc-return", "bc-safe", "ma-td3bc", "ma-td3bc-lag", "omar")  # of a planner

SUITES = {
    "simple_spread": Suite(
        _SPREAD,
        (
            Entry("bc"),
            Entry("bc-safe"),
            Entry("ma-td3bc"),
            Entry("ma-td3bc-lag"),
            Entry("fisor"),
            Entry("omar"),
            Entry("ma-cql"),
            Entry("madiff", "default"),
            Entry("icbf", "algorithm1"),
            Entry("icbf", "default"),
            Entry("icbf", "long", tiers=("expert", "medium")),
        ),
    ),
    "mujoco": Suite(
        _ROBOTS,
        (
            Entry("bc"),
            Entry("bc-safe"),
            Entry("ma-td3bc"),
            Entry("ma-td3bc", "mujoco-long"),
            Entry("ma-td3bc-lag"),
            Entry("fisor"),
            Entry("omar"),
            Entry("ma-cql"),
            Entry("madiff", evaluations=(DEFAULT, _COOL)),
            Entry("icbf", "algorithm1-mujoco"),
            Entry("icbf", evaluations=(DEFAULT, _COOL)),
        ),
        episodes=20,
    ),
    # Proposal x guard x danger's source, under Worlds that are fitted for every seed.
    "guards": Suite(
        _SPREAD,
        (
            Entry("bc", evaluations=(DEFAULT, "shield-learned", "shield-analytic", "full-learned")),
            Entry("mpc", evaluations=("full-learned",)),
            Entry("icbf", "default", (DEFAULT, "select-learned", "shield-learned", "full-learned")),
            Entry("icbf", "shaped", (DEFAULT, "shield-learned")),
            Entry("madiff", "default", _ALONE),
            Entry("madiff", "long", _ALONE),
            Entry("madiff", "own", _ALONE),
            *(Entry(name, evaluations=_ALONE) for name in _RIVALS),
            Entry("bc-return", "advantage", _ALONE),
        ),
    ),
    "guards-mujoco": Suite(
        _ROBOTS,
        (
            Entry("bc", evaluations=(DEFAULT, "adapt-learned", "adapt-analytic", "full-learned", "full-analytic")),
            Entry("icbf", evaluations=(_COOL, *(f"{_COOL}+{guard}" for guard in _ICBF_GUARDS))),
            Entry("madiff", evaluations=(_COOL, f"{_COOL}+adapt-learned")),
            *(Entry(name, evaluations=_ADAPTED) for name in _RIVALS),
            Entry(
                "mpc", evaluations=("full-learned", "full-learned+trust_radius2.0")
            ),  # anywhere, too: near rest is no place
        ),
        episodes=20,
    ),
    # Homogeneous agents, each by itself; danger that is decided ten steps ahead.
    "crossing": Suite(
        _CROSSING + tuple(f"crossing_unicycle-{tier}" for tier in _TIERS),
        (Entry("bc", evaluations=(DEFAULT, "shield-learned")),),
        episodes=1000,
    ),
    "crossing-guards": Suite(
        _CROSSING[:1],
        (
            Entry(
                "bc",
                evaluations=(
                    DEFAULT,
                    "shield-learned",
                    "shield-learned+horizon1",
                    *(f"shield-learned+horizon{k}+terminal_valueFalse" for k in (1, 3, 7, 15)),
                    "shield-analytic+horizon15+terminal_valueFalse",
                    "full-learned",
                ),
            ),
            Entry("icbf", evaluations=_ALONE),
            Entry("madiff", evaluations=_ALONE),
            *(Entry(name, evaluations=_ALONE) for name in _RIVALS),
        ),
    ),
    "crossing-teams": Suite(
        _CROSSING[:1],
        (Entry("bc", evaluations=("shield-learned", *(f"shield-learned+agents{n}" for n in (4, 16, 64, 256)))),),
        episodes=50,
    ),
    # Simple Spread's three, each by its own view, in teams of another size.
    "spread-teams": Suite(
        ("spread_alike-expert", "spread_alike-medium"),
        (
            Entry(
                "bc",
                evaluations=tuple(
                    (f"{how}+" if how else "") + f"agents{n}" if n else how or DEFAULT
                    for how in ("", "shield-learned", "full-learned")
                    for n in (0, 2, 4, 6)
                ),
            ),
        ),
    ),
    # Systems that no setting was chosen on; the oracle knows their dynamics and their distances from danger.
    "proving-ground": Suite(
        tuple(f"proving-{name}" for name in TEST),
        (Entry("bc", evaluations=_PROVEN), Entry("naive", evaluations=_PROVEN)),
        episodes=500,
    ),
    # Late, lost and noisy: no guard, one that does not know, and one that does.
    "stress": Suite(
        ("crossing-hasty", "simple_spread-expert", "halfcheetah_2x3-medium", *_STRESSED),
        (Entry("bc", evaluations=_ALONE, trials=_BEHIND),),
        folder="stress-suite",  # results/stress holds other trials
    ),
    # Every agent guards its own action by its own view, and hears of nobody.
    "own-sight": Suite(
        _SPREAD, (Entry("bc", evaluations=(DEFAULT, "shield-learned-decentralized", "full-learned-decentralized")),)
    ),
    "own-sight-mujoco": Suite(
        _ROBOTS,
        (Entry("bc", evaluations=(DEFAULT, "adapt-learned-decentralized", "full-learned-decentralized")),),
        episodes=20,
    ),
}

# Suites that answer one question together.
COLLECTIONS = {"attribution": ("guards", "guards-mujoco", "crossing", "crossing-guards")}
