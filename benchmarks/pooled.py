"""Logs of many drivers: what learns the pooled tiers, played as it is, one seed.

    python benchmarks/pooled.py results/pooled [--tasks simple_spread-expert-pooled ...] [--rows flow bc ...]

One file for each task. Rows that a file holds already are not made again. `runs/pooled` keeps the runs, so a row whose
run is there is only played. Budgets are small, so that a laptop makes a row in minutes; each row says its own.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np
from _common import command, machine

import ringfence
from ringfence.datasets.make import make
from ringfence.datasets.recipes.spread import TURNS
from ringfence.datasets.registry import TASKS
from ringfence.evaluation.evaluate import evaluate
from ringfence.loading.resolve import load_job
from ringfence.logs.store import EpisodeStore
from ringfence.training import loop
from ringfence.training.runs import Run

EPISODES = 200  # test resets
COLUMNS = ("return_mean", "return_norm", "cost_mean", "cost_safe_start", "train_seconds", "parameters")
FLOW = {"num_updates": 4000}
# (algorithm, preset, changes, how it is played)
ROWS = {
    "bc": ("bc", "default", {}, {}),
    "bc, joint view": ("bc", "joint", {}, {}),
    "flow": ("flow", "default", FLOW, {}),
    "flow, the drivers' means": ("flow", "default", FLOW, {"sampling_steps": 1, "temperature": 0.0}),
    "flow, 4 steps": ("flow", "default", FLOW, {"sampling_steps": 4}),
    "flow, one driver": ("flow", "default", FLOW | {"drivers": 1}, {}),
    "flow, one driver, its mean": ("flow", "default", FLOW | {"drivers": 1}, {"sampling_steps": 1, "temperature": 0.0}),
    "flow, told the return": ("flow", "return", FLOW, {}),
    "flow, told the return, 2.5 asked": ("flow", "return", FLOW, {"target_return": 2.5}),
    "flow, told the return, 2.5 asked, guidance 2": ("flow", "return", FLOW, {"target_return": 2.5, "cfg_scale": 2.0}),
    "bc-best": ("bc-best", "default", {}, {}),
    "madiff": ("madiff", "default", {}, {}),
    "icbf": ("icbf", "split", {}, {}),
}


def purity(run: Run, store: EpisodeStore, episodes: int = 2000) -> float | None:
    """Share of whole episodes that the flow gives a driver who is mostly one learner; the card says whose they are."""
    if run.config["algorithm"] != "flow" or store.card.extra.get("driver_of_episode") != TURNS:
        return None
    job = load_job(run)
    a = job.algorithm
    blank = lambda: loop.learned(a.init(jax.random.key(0), job.spec, job.config, None, job.feature_map, job.hazard))  # noqa: E731
    _, state = run.load_checkpoint(jax.eval_shape(blank))
    some = store.select(np.arange(store.episodes) < episodes)
    row = np.arange(some.steps) + some.episode_of_step
    x = job.feature_map(some.observations[row], some.state[row])
    clones = state["ema"]["clones"](state["frozen"]["normaliser"].state(x).reshape(some.steps, -1))
    actions = some.actions.reshape(some.steps, 1, -1)
    errors = ((np.asarray(clones).reshape(some.steps, -1, actions.shape[-1]) - actions) ** 2).sum(-1)
    found = np.add.reduceat(errors, np.concatenate([[0], some.episode_ends[:-1]])).argmin(1)
    learner = np.arange(some.episodes) % len(some.card.extra["drivers"])
    table = np.array([np.bincount(learner[found == c], minlength=5) for c in range(errors.shape[-1])])
    return round(float(table.max(1).sum() / some.episodes), 4)


def milliseconds(run: Run, store: EpisodeStore, options: dict) -> float:
    """Of one joint action, the median of 200."""
    pilot = ringfence.Controller(run, **options)
    seconds = []
    for k in range(210):
        begun = time.perf_counter()
        pilot.act(store.observations[k], None if store.state is None else store.state[k])
        seconds.append(time.perf_counter() - begun)
    return round(1000 * float(np.median(seconds[10:])), 2)


def row(name: str, store: EpisodeStore, runs: Path) -> dict:
    algorithm, preset, changes, options = ROWS[name]
    told = "-".join(f"{k}-{v}" for k, v in changes.items()) or "default"
    run = ringfence.train(algorithm, store, preset=preset, changes=changes, out=str(runs / preset / told), quiet=True)[
        0
    ]
    result = evaluate(run, episodes=EPISODES, **options)
    found = {k: round(float(result[k]), 4) for k in COLUMNS}
    about = {"algorithm": algorithm, "preset": preset, "changes": changes, "played": options}
    return {
        **about,
        "updates": run.config["config"]["num_updates"],
        **found,
        "drivers_purity": purity(run, store),
        "milliseconds": milliseconds(run, store, options),
        "command": command(),
        "machine": machine(),
    }


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    reader.add_argument("out", type=Path)
    reader.add_argument("--tasks", nargs="*", default=["simple_spread-expert-pooled", "simple_spread-medium-pooled"])
    reader.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS))
    reader.add_argument("--runs", type=Path, default=Path("runs/pooled"))
    given = reader.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for task in given.tasks:
        store, _ = make(TASKS[task])
        file = given.out / f"{task}.json"
        found = json.loads(file.read_text()) if file.exists() else {"task": task, "episodes": EPISODES, "seed": 0}
        found["data"] = {"return_norm": round(float(TASKS[task].normalised_return(store.returns.mean())), 4)}
        rows = found.setdefault("rows", {})
        for name in given.rows:
            if name in rows:
                continue
            rows[name] = row(name, store, given.runs)
            print(task, name, rows[name], flush=True)
            file.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
