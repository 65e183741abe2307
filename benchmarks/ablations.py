"""What each choice of a guard is worth: every row differs in one thing from the default of the same policy and guard,
and is tested against it on the same resets.

    python benchmarks/ablations.py           # writes results/ablations.csv; resumable, forty minutes on one core

Cloned policies and Worlds of seed 0, test resets, danger learned of the cost column where nothing else is said.
Rows of agents who foresee by their own action alone were made by revision cac628af, which patched the library.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from common import RESULTS, append, brief, read

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.envs import SimpleSpread
from ringfence.evaluation import statistics
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.loading.resolve import load
from ringfence.problem.features import FeatureMap
from ringfence.training import loop, worlds
from ringfence.types import Array
from ringfence.world import World
from ringfence.world.barrier import Barrier, Widening

OUT = RESULTS / "ablations.csv"
PLAYED = ("episodes", "return", "cost", "infeasible_rate")
FIELDS = ("task", "proposal", "guard", "way", *PLAYED)
FIELDS += ("more_return", "more_return_low", "more_return_high", "p_return")
FIELDS += ("more_cost", "more_cost_low", "more_cost_high", "p_cost")


class Simulated(eqx.Module):
    """Simple Spread itself, in the place of a World's dynamics."""

    net: Array  # of no members: an ensemble's place
    env: SimpleSpread = eqx.field(static=True)
    map: FeatureMap = eqx.field(static=True)

    def step(self, before: Array, action: Array) -> tuple[Array, Array]:
        names = {name: d for d, name in enumerate(self.map.names)}
        p, v = (before[..., jnp.array([names[f"own.{x}{c}"] for c in "xy"])] for x in ("", "v"))
        marks = [before[..., 0, jnp.array([names[f"landmark{j}.d{c}"] for c in "xy"])] for j in range(p.shape[-2])]
        marks = jnp.stack(marks, -2) + p[..., :1, :]
        flat = jnp.concatenate([x.reshape(*x.shape[:-2], -1) for x in (p, v, marks)], -1)
        after, _ = self.env.step(self.env.from_global_state(flat), action)
        return self.map(self.env.observe(after), self.env.global_state(after)), jnp.zeros(action.shape[:-1])

    @property
    def size(self) -> int:
        return 1

    def members(self, index: Array) -> Array:
        return index

    def by_members(self, nets: Array) -> Simulated:
        return self


class Ahead(Barrier):
    """A barrier that knows danger by its value alone."""

    def of_steps(self, before: Array, after: Array) -> Array:
        return self.ahead(after)

    def along(self, rows: Array, widening: Sequence[Widening] = ()) -> Array:
        return self.ahead_apart(rows[..., 1:, :, :])

    def parts(self, rows: Array, widening: Sequence[Widening] = ()) -> Array:
        return self.along(rows)


def by_value(world: World) -> World:
    """V in the place of ℓ, in the margin of ℓ."""
    barrier = world.barrier
    return eqx.tree_at(lambda w: w.barrier, world, Ahead(**{f.name: getattr(barrier, f.name) for f in fields(barrier)}))


def by_simulator(world: World) -> World:
    """The simulator foresees."""
    simulated = Simulated(jnp.zeros((1, 1)), SimpleSpread(), world.map)
    return eqx.tree_at(lambda w: w.dynamics, world, simulated)


@dataclass(frozen=True)
class Way:
    """One thing that differs from the default."""

    options: dict = field(default_factory=dict)  # of the guard
    world: dict = field(default_factory=dict)  # settings of the World
    other: Callable[[World], World] = lambda world: world  # what is put in the place of a part


ROWS = {f"{k} row{'s' * (k > 1)} foreseen": Way({"horizon": k}) for k in (1, 3, 5, 7)}
MEMBERS = {f"an ensemble of {k}": Way(world={"num_ensemble": k}) for k in (1, 5)}
RETAIN = {"condition (3), not a margin": Way({"condition": "retain"})}
FORMULA = {"danger by the true formula": Way({"barrier": "analytic"})}
TRUE = {
    "the true dynamics": Way(other=by_simulator),
    "the true dynamics and formula": Way({"barrier": "analytic"}, other=by_simulator),
}
V = {"the last row judged by V": Way({"terminal_value": True})}
V_ALONE = {"by V alone": Way({"terminal_value": False}, other=by_value)}
OWN = ", own sight"  # of a guard's name here
# By task, algorithm and preset, and guard; the default is not named among the ways.
STUDIES: dict[tuple[str, str, str], dict[str, Way]] = {
    ("simple_spread-expert", "bc", "shield"): ROWS | V | V_ALONE | RETAIN | MEMBERS | FORMULA | TRUE,
    ("simple_spread-expert", "bc", "full"): {
        **ROWS,
        **MEMBERS,
        **FORMULA,
        **TRUE,
        **{f"climbed from {k} starts": Way({"num_restarts": k}) for k in (4, 16)},
        **{f"{k} steps of climbing": Way({"optimizer_steps": k}) for k in (5, 10, 40)},
        "no shield after it": Way({"correction_steps": 0, "adapt": 0.0}),
    },
    ("crossing-hasty", "bc", "shield"): {
        **{k: v for k, v in ROWS.items() if k != "5 rows foreseen"},
        "by ℓ alone": Way({"terminal_value": False}),
        **V_ALONE,
        **RETAIN,
        **MEMBERS,
        **FORMULA,
    },
    ("halfcheetah_2x3-medium", "bc", "adapt"): ROWS
    | V_ALONE
    | RETAIN
    | MEMBERS
    | FORMULA
    | {"a margin that stays": Way({"adapt": 0.0})},
    ("halfcheetah_2x3-medium", "bc", "full"): {
        **ROWS,
        **MEMBERS,
        **FORMULA,
        **{f"climbed from {k} starts": Way({"num_restarts": k}) for k in (4, 16)},
        "climbing anywhere": Way({"trust_radius": 2.0}),
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(dict.fromkeys(task for task, *_ in STUDIES)))
    parser.add_argument("--guards", nargs="+", default=list(dict.fromkeys(guard for *_, guard in STUDIES)))
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    for study, ways in STUDIES.items():
        if study[0] in a.tasks and study[2] in a.guards:
            measure(study, ways, a.out)


def measure(study: tuple[str, str, str], ways: dict[str, Way], out: Path) -> None:
    """The rows of a study that are not there yet; the default is played first, if any is missing."""
    name, algorithm, guard = study
    there = {r["way"] for r in read(out) if (r["task"], r["proposal"], r["guard"]) == study}
    if {"default", *ways} <= there:
        return
    task = registry.get(name)
    episodes = 20 if task.protocol else 200
    store, _ = make(task)
    with tempfile.TemporaryDirectory() as folder:
        kind, _, preset = algorithm.partition(":")
        (run,) = loop.train(kind, store, preset=preset or None, seeds=(0,), out=folder, quiet=True)

        def played(way: Way) -> dict:
            world = way.other(worlds.fit(store, **way.world))
            _, policy = load(run, world=world, guard=guard, **way.options)
            return evaluate_policy(policy, task, episodes, "test", 0)[0]

        usual = None
        for way, how in {"default": Way(), **ways}.items():
            if way in there and way != "default":
                continue
            found = played(how)
            usual = usual or found
            row = dict(zip(FIELDS, (*study, way, episodes)))
            row |= {"return": found["return_mean"], "cost": found["cost_mean"]}
            row |= {"infeasible_rate": found["infeasible_rate"]}
            for key in ("return", "cost"):
                test = statistics.paired_test(*(r["per_episode"][key] for r in (found, usual)))
                row |= dict(zip((f"more_{key}_low", f"more_{key}_high"), test["interval"]))
                row |= {f"more_{key}": test["difference"], f"p_{key}": test["p"]}
            if way not in there:
                append(out, brief(row), FIELDS)


def adjusted(rows: list[dict]) -> list[dict]:
    """The rows, those that differ from a default with `holm_return` and `holm_cost`: p by Holm's method over all."""
    tested = [(r, key) for r in rows if r["way"] != "default" for key in ("return", "cost")]
    for (r, key), p in zip(tested, statistics.holm(np.array([float(r[f"p_{key}"]) for r, key in tested]))):
        r[f"holm_{key}"] = p
    return rows


if __name__ == "__main__":
    main()
