"""How wrong a planner's forward dynamics is about the hazard: its error in clearance one to three steps ahead, with the
logged actions, as a share of the speed limit. On logged steps that it foresees within 30 % of the limit.

    ringfence train madiff halfcheetah_2x3-poor-quantile --out runs/foresight      # any planner, any robot task
    python benchmarks/foresight.py runs/foresight/*/*/*                            # writes results/tuning/foresight.csv
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from _rows import read, write

from ringfence import evaluate, tasks
from ringfence.data.make import make
from ringfence.runs import Run

OUT = Path(__file__).resolve().parent.parent / "results" / "tuning" / "foresight.csv"
LEVELS = (0.5, 0.9, 0.95, 0.975, 0.99)
ABOUT = ("task", "algorithm", "seed", "revision")
STEPS, AHEAD, NEAR = 20_000, 3, 0.3


def rows_of(path: Path) -> list[dict]:
    job, policy = evaluate.load(path, planner="shielded")
    run = Run(path).config
    store, _ = make(tasks.get(job.task.name))
    rng = np.random.default_rng(0)
    episode = rng.integers(0, store.episodes, STEPS)
    episode = episode[store.lengths[episode] > AHEAD]
    starts = np.concatenate([[0], store.episode_ends[:-1]])
    step = starts[episode] + rng.integers(0, store.lengths[episode] - AHEAD)

    def seen(k: int) -> jax.Array:
        row = step + k + episode  # every episode before has one state more than it has steps
        return policy.feature_map(jnp.asarray(store.observations[row]), jnp.asarray(store.state[row]))

    def least(x: jax.Array) -> np.ndarray:
        return np.asarray(policy.hazard.clearance(x)).min(-1) / job.task.hazard.limit

    now, rows = seen(0), []
    state = now
    for k in range(AHEAD):
        state = policy.foreseen_step(now[:, None], state, jnp.asarray(store.actions[step + k]))
        foreseen, came = least(state), least(seen(k + 1))
        near = np.abs(foreseen) < NEAR
        told = {"task": job.task.name, "algorithm": job.algorithm.name, "seed": run["seed"]}
        told |= {"revision": run.get("revision", 1), "limit": job.task.hazard.limit}
        told |= {"ahead": k + 1, "steps": int(near.sum())}
        told |= {f"error_{q}": round(float(np.quantile((foreseen - came)[near], q)), 4) for q in LEVELS}
        rows.append(told)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    rows = [r for path in sorted(a.runs) for r in rows_of(path)]
    about = {tuple(str(r[k]) for k in ABOUT) for r in rows}
    kept = [r for r in read(a.out) if tuple(r[k] for k in ABOUT) not in about]  # of other tasks or revisions
    write(a.out, sorted(kept + rows, key=lambda r: (r["task"], int(r["revision"]), int(r["ahead"]))))
    for r in rows:
        print(*(f"{k}={r[k]}" for k in ("task", "ahead", "error_0.5", "error_0.95", "error_0.99")), flush=True)


if __name__ == "__main__":
    main()
