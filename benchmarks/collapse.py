"""Why the diffusion planner does not learn a pool: one change a row, at equal time, played as it is.

    python benchmarks/collapse.py results/pooled/collapse.json [--rows "as it is" ...]

`madiff` on `simple_spread-expert-pooled`, without a guard, one seed, 200 test resets. How many updates a row trains for
is what `SECONDS` of one core's time allow, measured on its own updates first. Rows that change only how a plan is
played share the run of the row they are about. `nearest` is how far a joint action is from what the nearest of the five
learners does there without noise (RMSE of an entry, over logged states): small where plans are some learner's,
whichever, and large where they are nobody's. Rows that the file holds already are not made again; at the end the table
in docs/method.md is written anew.
"""

import argparse
import json
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import command, machine
from readme import put

import ringfence
from ringfence.datasets import behaviour, matd3
from ringfence.datasets.make import make
from ringfence.datasets.registry import TASKS
from ringfence.envs.simple_spread import DAMPING, DT, SENSITIVITY
from ringfence.evaluation.evaluate import evaluate_policy
from ringfence.loading.resolve import resolve
from ringfence.loading.spec import PolicySpec
from ringfence.logs.store import EpisodeStore
from ringfence.problem.normalise import Normaliser
from ringfence.proposals.planner import Planner
from ringfence.training.runs import Run
from ringfence.types import Array

TASK = TASKS["simple_spread-expert-pooled"]
EPISODES = 200  # test resets
STATES = 2000  # logged ones, where plans are put beside what learners do
SECONDS = 120.0  # of one core, of training
PROBE = 60  # updates whose second half is timed
# Nothing of these plans reads a World but value guidance, which is off.
WORLD = {"dynamics_updates": 100, "num_ensemble": 1, "value_updates": 100, "barrier": False, "causes": False}
RESULTS = Path(__file__).resolve().parent.parent / "results" / "pooled" / "collapse.json"


@dataclass(frozen=True)
class Row:
    """A change, to training (`changes`, `learners`) or to how a plan is played."""

    changes: dict[str, Any] = field(default_factory=dict)  # to the config of madiff's default preset
    options: dict[str, Any] = field(default_factory=dict)  # of the planner
    learners: int = 5  # whose episodes are trained on
    true_inverse: bool = False  # actions by the simulator's own equation


RESIDUAL = {"net": "residual", "width": 384}
ROWS = {
    "as it is": Row(),
    "actions by the true inverse dynamics": Row(true_inverse=True),
    "50 steps of DDPM for 5 of DDIM": Row(options={"sampler": "ddpm", "sampling_steps": 50}),
    "no guidance by the return": Row(options={"cfg_scale": 1.0, "target_return": 0.0}),
    "a third of the first noise": Row(options={"temperature": 0.3}),
    "one learner's fifth of the episodes": Row(learners=1),
    "a residual network of the team": Row(RESIDUAL),
    "told the drivers that were found": Row({"drivers": 8}),
    "both": Row(RESIDUAL | {"drivers": 8}),
    "two rows, none masked": Row({"horizon": 2}),
    "states for displacements": Row({"coordinates": "state"}),
    "all entries of everybody": Row({"carry": "all"}),
    "ε for x̂0 with SNR weights": Row({"prediction": "epsilon"}),
    "twice as wide": Row({"width": 256}),
}


class TrueInverse(eqx.Module):
    """What Simple Spread's equation says was done between two states, contacts left out."""

    normaliser: Normaliser
    velocity: tuple[int, ...] = eqx.field(static=True)  # own entries of a state

    def __call__(self, read: Array) -> Array:
        """Standardised state and step (..., 2 · D) -> actions (..., 2)."""
        n = self.normaliser
        state, step = jnp.split(read, 2, -1)
        at = np.array(self.velocity)
        before = n.invert_state(state)[..., at]
        changed = (step * n.step_scale[0] + n.step_mean[0])[..., at]
        return (changed + DAMPING * before) / (DT * SENSITIVITY)


def updates_in(seconds: float, store: EpisodeStore, changes: dict, runs: Path) -> int:
    """How many updates a core makes in that time, a hundred at least; compiling is not counted."""
    marks: list[float] = []
    ringfence.train(
        "madiff",
        store,
        changes=changes | {"num_updates": PROBE},
        world=WORLD,
        out=str(runs / "probe"),
        chunk=PROBE // 2,
        on_chunk=lambda step, metrics: marks.append(time.process_time()),
        quiet=True,
    )
    each = (marks[-1] - marks[0]) / (PROBE // 2)
    return max(100, round(seconds / each / 100) * 100)


def trained(row: Row, store: EpisodeStore, runs: Path) -> Run:
    """The run of a row; rows that train alike share it."""
    folder = runs / ("-".join(f"{k}-{v}" for k, v in row.changes.items()) + f"-learners-{row.learners}").strip("-")
    some = store
    if row.learners < len(store.card.extra["drivers"]):
        some = store.select(np.arange(store.episodes) % len(store.card.extra["drivers"]) < row.learners)
    counted = folder / "updates.json"
    if not counted.exists():
        folder.mkdir(parents=True, exist_ok=True)
        counted.write_text(json.dumps(updates_in(SECONDS, some, row.changes, folder)))
    changes = row.changes | {"num_updates": json.loads(counted.read_text())}
    return ringfence.train("madiff", some, changes=changes, world=WORLD, out=str(folder), quiet=True)[0]


def planner_of(run: Run, row: Row) -> Any:
    """The run's planner as the row plays it, resolved."""
    resolved = resolve(PolicySpec.of(run, **row.options))
    if not row.true_inverse:
        return resolved
    planner = resolved.policy
    assert isinstance(planner, Planner)
    at = tuple(planner.feature_map.names.index(name) for name in ("own.vx", "own.vy"))
    networks = planner.networks | {"inverse": TrueInverse(planner.normaliser, at)}
    return replace(resolved, policy=eqx.tree_at(lambda p: p.networks, planner, networks))


def nearest(planner: Planner, store: EpisodeStore) -> float:
    """RMSE of an entry between planned joint actions and the nearest learner's, at logged states."""
    step = np.random.default_rng(0).choice(store.steps, STATES, replace=False)
    at = step + store.episode_of_step[step]
    seen, state = jnp.asarray(store.observations[at]), jnp.asarray(store.state[at])
    action = planner.act(planner.initial_state(STATES), seen, state, jax.random.key(0))[1].action
    learners = [behaviour.shipped_policy("expert", lineage=k).actors for k in range(behaviour.LINEAGES)]
    errors = [((matd3.act(actors, seen) - action) ** 2).mean((1, 2)) for actors in learners]
    return float(jnp.stack(errors).min(0).mean() ** 0.5)


def measured(row: Row, store: EpisodeStore, runs: Path) -> dict:
    run = trained(row, store, runs)
    resolved = planner_of(run, row)
    result = evaluate_policy(resolved.team, TASK, EPISODES, "test", 0, 0, "", True)[0]
    return {
        "changes": row.changes,
        "played": row.options,
        "learners": row.learners,
        "true_inverse": row.true_inverse,
        "updates": run.config["config"]["num_updates"],
        "parameters": int(sum(np.size(x) for x in jax.tree.leaves(resolved.policy.networks["denoiser"]))),
        **{k: round(float(result[k]), 4) for k in ("return_mean", "return_norm", "cost_mean")},
        "nearest": round(nearest(resolved.policy, store), 4),
        "loss_inverse": round(float(run.metrics[-1]["loss/inverse"]), 4),
        "command": command(),
        "machine": machine(),
    }


def table(rows: dict) -> str:
    lines = ["| one change | updates | return, normalised | to the nearest learner |", "|---|---|---|---|"]
    for name in ROWS:
        if name in rows:
            r = rows[name]
            lines.append(f"| {name} | {r['updates']} | {r['return_norm']:.3f} | {r['nearest']:.2f} |")
    return "\n".join(lines)


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    reader.add_argument("out", type=Path)
    reader.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS))
    reader.add_argument("--runs", type=Path, default=Path("runs/collapse"))
    given = reader.parse_args()
    store, _ = make(TASK)
    about = {"task": TASK.name, "episodes": EPISODES, "seed": 0, "seconds": SECONDS}
    found = json.loads(given.out.read_text()) if given.out.exists() else about | {"rows": {}}
    for name in given.rows:
        if name not in found["rows"]:
            found["rows"][name] = measured(ROWS[name], store, given.runs)
            print(name, found["rows"][name], flush=True)
            given.out.parent.mkdir(parents=True, exist_ok=True)
            given.out.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n")
    if given.out.resolve() == RESULTS:
        put("docs/method.md", "collapse", table(found["rows"]))


if __name__ == "__main__":
    main()
