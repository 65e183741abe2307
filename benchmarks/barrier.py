"""Which barrier a guard needs: ways of fitting it, by what they tell of held-out steps and by what the guard makes of
them, each beside the one that differs in that thing alone.

    python benchmarks/barrier.py            # writes results/tuning/barrier.csv; resumable, an hour on 2 cores

Behaviour cloning is guarded: by `shield` on Simple Spread and in the yard, by `adapt` on robots. Validation resets.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from _rows import append, read

import ringfence
from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.loading.resolve import load
from ringfence.training import loop, worlds

HERE = Path(__file__).resolve().parent
OUT = HERE.parent / "results" / "tuning" / "barrier.csv"
WAYS: dict[str, dict] = {
    "default": {},
    "no distances": {"distances": False},
    "logged steps alone": {"predicted_share": 0.0},
    "foreseen steps alone": {"predicted_share": 1.0},
    "hinges": {"loss": "hinges"},
    "hinges, gradient penalty 0.01": {"loss": "gradient-penalty", "penalty": 0.01},
    "hinges, gradient penalty 0.1": {"loss": "gradient-penalty", "penalty": 0.1},
    "hinges, gradient penalty 1": {"loss": "gradient-penalty", "penalty": 1.0},
    "half the updates": {"half": True},
    "state alone": {"use_transition": False},
    "both ends of steps": {"use_transition": True},
}
GUARDS: dict[str, dict] = {
    "margin": {},
    "retain": {"condition": "retain"},
    "future": {"terminal_value": True},
}
SHORT = {"3 rows": {"horizon": 3}, "future, 3 rows": {"terminal_value": True, "horizon": 3}}  # where 7 are usual

FIELDS = ("task", "way", "guard", "seed", "fit_seconds", "unsafe_share", "recall", "auroc", "margin")
FIELDS += ("predicted_false_safe", "episodes", "return", "cost", "cost_low", "cost_high", "infeasible_rate")


class Simulated:
    """A task of the library: its data, cloning, and how that is guarded and played."""

    guards = GUARDS

    def __init__(self, name: str, seed: int, folder: str, episodes: int):
        self.task, self.seed = registry.get(name), seed
        self.store, _ = make(self.task)
        (self.run,) = loop.train("bc", self.store, seeds=(seed,), out=folder, quiet=True)
        body = self.task.protocol
        self.guard = {"guard": "adapt" if body else "shield"}
        self.episodes = max(1, episodes // 20) if body else episodes

    def play(self, world, **options) -> dict:
        policy = load(self.run, world=world, **{**self.guard, **options})[1]
        return evaluate_policy(policy, self.task, self.episodes, "validation", self.seed)[0]


class Yard:
    """examples/yard.py likewise."""

    guards = GUARDS | SHORT

    def __init__(self, name: str, seed: int, folder: str, episodes: int):
        sys.path.insert(0, str(HERE.parent / "examples"))
        import yard

        self.env, self.episodes, self.store = yard.Yard, episodes, yard.record()
        (self.run,) = loop.train("bc", self.store, seeds=(seed,), out=folder, quiet=True)
        self.guard = {"guard": "shield", "horizon": 7}

    def play(self, world, **options) -> dict:
        kw = dict(episodes=self.episodes, num_envs=self.episodes, split="validation", world=world)
        return ringfence.play(self.run, self.env, **kw, **{**self.guard, **options})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = ["simple_spread-expert", "yard", "halfcheetah_2x3-good", "halfcheetah_2x3-poor-quantile"]
    parser.add_argument("--tasks", nargs="+", default=names)
    parser.add_argument("--ways", nargs="+", default=list(WAYS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    there = read(a.out)
    done = {(r["task"], r["way"], r["guard"], int(r["seed"])) for r in there}
    for name in a.tasks:
        kind = Yard if name == "yard" else Simulated
        wanted = [(w, g) for w in a.ways for g in (kind.guards if w == "default" else ("margin",))]
        wanted = [x for x in wanted if (name, *x, a.seed) not in done]
        if not wanted:
            continue
        with tempfile.TemporaryDirectory() as folder:
            subject = kind(name, a.seed, folder, a.episodes)
            for way, guard in wanted:
                append(a.out, measured(name, subject, way, guard, a.seed), FIELDS)


def measured(name: str, subject, way: str, guard: str, seed: int) -> dict:
    """One row."""
    changes = dict(WAYS[way])
    if changes.pop("half", False):
        changes["barrier_updates"] = worlds.settings_for(subject.store).barrier_updates // 2
    begun = time.perf_counter()
    world = worlds.fit(subject.store, seed=seed, **changes)
    took = time.perf_counter() - begun
    scores = world.card.barrier
    played = subject.play(world, **subject.guards[guard])
    low, high = played["cost_interval"]
    row = {
        "task": name,
        "way": way,
        "guard": guard,
        "seed": seed,
        "fit_seconds": world.card.seconds.get("label", took),
    }
    row |= {k: getattr(scores, k) for k in ("unsafe_share", "recall", "auroc", "margin", "predicted_false_safe")}
    row |= {"episodes": subject.episodes, "return": played["return_mean"], "cost": played["cost_mean"]}
    row |= {"cost_low": low, "cost_high": high, "infeasible_rate": played.get("infeasible_rate", "")}
    row = {k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()}
    print(", ".join(f"{k} {v}" for k, v in row.items()), flush=True)
    return row


if __name__ == "__main__":
    main()
