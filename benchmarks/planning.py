"""What planning and training cost: latency of one joint action, compile time and memory of training, growth with N.

    python benchmarks/planning.py            # writes results/performance/planning.json

Untrained networks of the default sizes: time does not depend on the weights.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from _common import Rows, record

from ringfence import guard
from ringfence.datasets import behaviour, registry
from ringfence.datasets.task import Task
from ringfence.envs import SimpleSpread
from ringfence.evaluation.latency import plan_latency
from ringfence.loading.resolve import make_policy
from ringfence.logs.store import EpisodeStore
from ringfence.training import loop, worlds
from ringfence.training.job import make_job

OUT = Path(__file__).resolve().parent.parent / "results" / "performance" / "planning.json"
TEAMS = (3, 6, 12)


def team_task(n: int) -> Task:
    return Task(f"simple_spread-{n}-agents", SimpleSpread(n_agents=n), registry.TASKS["simple_spread-random"].hazard)


def random_store(task: Task, episodes: int) -> EpisodeStore:
    played = behaviour.collect(task.env, "random", episodes, jax.random.key(0), batch=min(episodes, 500))
    return EpisodeStore.from_episodes(
        played["observations"],
        played["actions"],
        played["rewards"],
        played["costs"],
        state=played["state"],
        card={"task": task.name, "hazard": task.hazard},
    )


def measure_team(n: int, updates: int) -> tuple[dict[str, float], tuple]:
    """Milliseconds per update (batch 128), seconds to compile it, and the job and state for planning."""
    task = team_task(n)
    store = random_store(task, 400)
    quick = {f"{part}_updates": 10 for part in ("dynamics", "value", "barrier", "future")}
    job = make_job("icbf", task, None, {}, store, quick)
    world = worlds.fit(store, task=task, **job.world)
    data = loop.windows_of(job, store, world)
    state = job.algorithm.init(jax.random.key(0), job.spec, job.config, data, job.feature_map, job.hazard, world)
    scores = data.arrays["scores"][None]
    advance, _ = loop.make_program(job)
    roots = jax.vmap(jax.random.key)(jnp.arange(1))
    stacked = jax.tree.map(lambda x: x[None], state)
    begun = time.perf_counter()
    compiled = advance.lower(stacked, roots, data.arrays, scores, updates).compile()
    compile_seconds = time.perf_counter() - begun
    took = []
    for _ in range(6):
        begun = time.perf_counter()
        stacked, metrics = compiled(stacked, roots, data.arrays, scores, updates)
        jax.block_until_ready(metrics)
        took.append((time.perf_counter() - begun) / updates * 1e3)
    return {"update_ms": float(np.median(took[1:])), "compile_s": compile_seconds}, (job, state, world)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--teams", type=int, nargs="+", default=TEAMS)
    parser.add_argument("--calls", type=int, default=300)
    parser.add_argument("--updates", type=int, default=20)
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    row = Rows()
    for n in a.teams:
        cost, (job, state, world) = measure_team(n, a.updates)
        row(f"training update, {n} agents, batch {job.config.batch}", cost["update_ms"], "ms")
        row(f"training update per agent, {n} agents", cost["update_ms"] / n, "ms")
        row(f"compile time of the training step, {n} agents", cost["compile_s"], "s")
        planner = make_policy(job, state, {})
        for name in ("select", "full"):
            policy = guard(planner, world, guard=name)
            took = plan_latency(policy, job.task, a.calls)
            row(f"one joint action, guard {name}, {n} agents, p50", took["plan_ms_p50"], "ms")
            row(f"one joint action, guard {name}, {n} agents, p99", took["plan_ms_p99"], "ms")
    row("peak memory of this benchmark", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, "GiB")
    record(a.out, row)


if __name__ == "__main__":
    main()
