"""Why the diffusion planner does not learn a pool: one change a row, at equal time, played as it is.

    python benchmarks/collapse.py results/pooled/collapse.json [--rows "as it is" ...]

`madiff` on `simple_spread-expert-pooled`, without a guard, one seed, 200 test resets. How many updates a row trains for
is what `SECONDS` of one core's time allow, measured on its own updates first. Rows that change only how a plan is
played share the run of the row they are about. `nearest` is how far a joint action is from what the nearest of the five
learners does there without noise (RMSE of an entry, over logged states): small where plans are some learner's,
whichever, and large where they are nobody's. Rows that the file holds already are not made again; at the end the table
is printed.
"""

import argparse
import json
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import command, machine
from pooled import drivers_of

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


@dataclass(frozen=True)
class Row:
    """A change, to training (`changes`, `learners`) or to how a plan is played."""

    changes: dict[str, Any] = field(default_factory=dict)  # to the config of madiff's default preset
    options: dict[str, Any] = field(default_factory=dict)  # of the planner
    learners: int = 5  # whose episodes are trained on
    true_inverse: bool = False  # actions by the simulator's own equation
    share: float = 1.0  # of the training time


RESIDUAL = {"net": "residual", "width": 384}
APART = {"distinguish_agents": True}
DRIVERS = {"drivers": 8, "batch": 64}  # windows that also tell drivers are dear: half as many make as many updates
ROWS = {
    "as it is": Row(),
    "actions by the true inverse dynamics": Row(true_inverse=True),
    "50 steps of DDPM for 5 of DDIM": Row(options={"sampler": "ddpm", "sampling_steps": 50}),
    "no guidance by the return": Row(options={"cfg_scale": 1.0, "target_return": 0.0}),
    "a third of the first noise": Row(options={"temperature": 0.3}),
    "one learner's fifth of the episodes": Row(learners=1),
    "the same, a fifth of the time": Row(learners=1, share=0.2),
    "a residual network of the team": Row(RESIDUAL),
    "told the drivers that are found": Row(DRIVERS),
    "agents told apart": Row(APART),
    "a residual network, told the drivers": Row(RESIDUAL | DRIVERS),
    "agents told apart, told the drivers": Row(APART | DRIVERS),
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


def updates_in(seconds: float, store: EpisodeStore, changes: dict) -> int:
    """How many updates a core makes in that time, a hundred at least; compiling is not counted."""
    marks: list[float] = []
    with tempfile.TemporaryDirectory() as out:
        ringfence.train(
            "madiff",
            store,
            changes=changes | {"num_updates": PROBE},
            world=WORLD,
            out=out,
            chunk=PROBE // 2,
            on_chunk=lambda step, metrics: marks.append(time.process_time()),
            quiet=True,
        )
    each = (marks[-1] - marks[0]) / (PROBE // 2)
    return max(100, round(seconds / each / 100) * 100)


def trained(row: Row, store: EpisodeStore, runs: Path) -> Run:
    """The run of a row; rows that train alike share it."""
    changed = "-".join(f"{k}-{v}" for k, v in row.changes.items())
    folder = runs / f"{changed}-learners-{row.learners}{'' if row.share == 1 else f'-share-{row.share}'}".strip("-")
    some = store
    if row.learners < len(store.card.extra["drivers"]):
        some = store.select(np.arange(store.episodes) % len(store.card.extra["drivers"]) < row.learners)
    counted = folder / "updates.json"
    if not counted.exists():
        folder.mkdir(parents=True, exist_ok=True)
        counted.write_text(json.dumps(updates_in(row.share * SECONDS, some, row.changes)))
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


def logged(store: EpisodeStore) -> tuple[np.ndarray, np.ndarray, Array]:
    """Some steps, the rows of their states, and what each learner does there without noise (5, STATES, N, A)."""
    step = np.random.default_rng(0).choice(store.steps, STATES, replace=False)
    row = step + store.episode_of_step[step]
    seen = jnp.asarray(store.observations[row])
    learners = [behaviour.shipped_policy("expert", lineage=k).actors for k in range(behaviour.LINEAGES)]
    return step, row, jnp.stack([matd3.act(actors, seen) for actors in learners])


def to_nearest(action: Array, learners: Array) -> float:
    """RMSE of an entry between joint actions (STATES, N, A) and the nearest learner's."""
    return round(float(((learners - action) ** 2).mean((2, 3)).min(0).mean() ** 0.5), 4)


def nearest(planner: Planner, store: EpisodeStore) -> float:
    """Of planned actions."""
    _, row, learners = logged(store)
    seen, state = jnp.asarray(store.observations[row]), jnp.asarray(store.state[row])
    action = planner.act(planner.initial_state(STATES), seen, state, jax.random.key(0))[1].action
    return to_nearest(action, learners)


def scale(store: EpisodeStore) -> dict[str, float]:
    """What `nearest` is of actions as logged, and of the mean of all learners; how far apart two learners are, and two
    agents of one learner who see the same."""
    step, row, learners = logged(store)
    seen = jnp.roll(jnp.asarray(store.observations[row]), 1, 1)
    turned = jnp.stack([matd3.act(behaviour.shipped_policy("expert", lineage=k).actors, seen) for k in range(5)])
    apart = jnp.stack([((learners - other) ** 2).mean() for other in learners]).sum()
    pairs = behaviour.LINEAGES / (behaviour.LINEAGES - 1)
    return {
        "logged": to_nearest(jnp.asarray(store.actions[step]), learners),
        "mean_of_learners": to_nearest(learners.mean(0), learners),
        "between_agents": round(float(((turned - jnp.roll(learners, 1, 2)) ** 2).mean() ** 0.5), 4),
        "between_learners": round(float((apart * pairs / behaviour.LINEAGES) ** 0.5), 4),
    }


def told_right(run: Run, planner: Planner, store: EpisodeStore) -> dict[str, float]:
    """Of a run that found drivers: how pure they are, and how far its plans are from the learner whose driver they are
    told (RMSE of an entry at logged states), beside the clones that found it in the same training."""
    drivers = drivers_of(run, store)
    if drivers is None:
        return {}
    some = drivers.store
    step, row, learners = logged(some)
    learner = some.episode_of_step[step] % len(learners)
    driver = drivers.counts.argmax(0)[learner]
    truth = np.asarray(learners)[learner, np.arange(STATES)]
    seen, state = jnp.asarray(some.observations[row]), jnp.asarray(some.state[row])
    # An episode that has begun keeps the driver that it carries.
    carry = planner.initial_state(STATES) | {"driver": jnp.asarray(driver, jnp.int32), "age": jnp.ones((), jnp.int32)}
    planned = planner.act(carry, seen, state, jax.random.key(0))[1].action
    cloned = drivers.clones[step, driver].reshape(truth.shape).clip(-1.0, 1.0)
    apart = {
        "told_right": np.asarray(planned) - truth,
        "clones": cloned - truth,
    }
    return {"drivers_purity": drivers.purity} | {
        name: round(float((error**2).mean() ** 0.5), 4) for name, error in apart.items()
    }


def measured(row: Row, store: EpisodeStore, runs: Path) -> dict:
    run = trained(row, store, runs)
    resolved = planner_of(run, row)
    result = evaluate_policy(resolved.team, TASK, EPISODES, "test", 0, 0, "", True)[0]
    return {
        "changes": row.changes,
        "played": row.options,
        "learners": row.learners,
        "true_inverse": row.true_inverse,
        "share_of_time": row.share,
        "updates": run.config["config"]["num_updates"],
        "parameters": int(sum(np.size(x) for x in jax.tree.leaves(resolved.policy.networks["denoiser"]))),
        **{k: round(float(result[k]), 4) for k in ("return_mean", "return_norm", "cost_mean")},
        "nearest": nearest(resolved.policy, store),
        **told_right(run, resolved.policy, store),
        "loss_inverse": round(float(run.metrics[-1]["loss/inverse"]), 4),
        "command": command(),
        "machine": machine(),
    }


def table(rows: dict) -> str:
    lines = [
        "| one change | updates | return, normalised | to the nearest learner | told whose: plans, clones |",
        "|---|---|---|---|---|",
    ]
    for name in ROWS:
        if name in rows:
            r = rows[name]
            told = f"{r['told_right']:.2f}, {r['clones']:.2f}" if "told_right" in r else ""
            lines.append(f"| {name} | {r['updates']} | {r['return_norm']:.3f} | {r['nearest']:.2f} | {told} |")
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
    found.setdefault("nearest_of", scale(store))
    for name in given.rows:
        if name not in found["rows"]:
            found["rows"][name] = measured(ROWS[name], store, given.runs)
            print(name, found["rows"][name], flush=True)
            given.out.parent.mkdir(parents=True, exist_ok=True)
            given.out.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n")
    print(table(found["rows"]))


if __name__ == "__main__":
    main()
