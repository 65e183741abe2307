"""Crossing's speed: agent-steps of the simulator per second, fitting its World, and milliseconds of one joint action of
8, 64 and 256 agents, each guarded by itself.

python benchmarks/crossing.py             # writes results/performance/crossing.json; some minutes, on a quiet machine
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from statistics import median

import jax
import numpy as np
from _common import Rows, record

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.envs import Crossing
from ringfence.loading.resolve import load
from ringfence.training import loop, worlds

OUT = Path(__file__).resolve().parent.parent / "results" / "performance" / "crossing.json"
TEAMS = (8, 64, 256)
BATCH = 500
GUARDS = {
    "none": {},
    "shield": {"guard": "shield"},
    "shield by ℓ alone along 15 rows": {"guard": "shield", "horizon": 15, "terminal_value": False},
    "full": {"guard": "full"},
}


def simulated(repeats: int = 5) -> float:
    """Agent-steps/s of 8 agents, observations included."""
    env = Crossing()

    @jax.jit
    def play(key):
        def step(state, key):
            push = jax.random.uniform(key, (BATCH, env.n_agents, 2), minval=-1.0, maxval=1.0)
            after, out = env.step(state, push)
            return after, (env.observe(after).sum(), out.cost.sum())

        return jax.lax.scan(step, env.reset(key, BATCH), jax.random.split(key, env.episode_length))[1]

    jax.block_until_ready(play(jax.random.key(0)))
    rates = []
    for k in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(play(jax.random.key(k)))
        rates.append(BATCH * env.n_agents * env.episode_length / (time.perf_counter() - begun))
    return median(rates)


def acting(run, world, agents: int, options: dict, steps: int = 200) -> np.ndarray:
    """(steps,) milliseconds of joint actions along two episodes, where agents meet."""
    job, policy = load(run, agents=agents, **options, **({"world": world} if options else {}))
    env = job.task.env
    act = jax.jit(lambda policy, carry, seen, key: policy.act(carry, seen, None, key))
    move, look = jax.jit(env.step), jax.jit(env.observe)
    key, took = jax.random.key(0), []
    for t in range(steps):
        if t % env.episode_length == 0:
            state, carry = env.reset(jax.random.fold_in(key, t), 1), policy.initial_state(1)
        seen = jax.block_until_ready(look(state))
        begun = time.perf_counter()
        carry, step = jax.block_until_ready(act(policy, carry, seen, jax.random.fold_in(key, t)))
        took.append((time.perf_counter() - begun) * 1e3)
        state, _ = move(state, step.action)
    return np.array(took[10:])


def main() -> None:
    row = Rows()
    row("Crossing, 8 agents: simulated", simulated(), "agent-steps/s")
    store, _ = make(registry.get("crossing-hasty"))
    begun = time.perf_counter()
    world = worlds.fit(store, cached=False)
    row("Crossing: fitting a World", time.perf_counter() - begun, "s")
    with tempfile.TemporaryDirectory() as folder:
        (run,) = loop.train("bc", store, out=folder, quiet=True)
        for guard, options in GUARDS.items():
            for agents in TEAMS[: 2 if guard == "full" else 3]:
                took = acting(run, world, agents, options)
                for name, share in (("p50", 50), ("p99", 99)):
                    value = float(np.percentile(took, share))
                    row(f"Crossing: one joint action, guard {guard}, {agents} agents, {name}", value, "ms")
    record(OUT, row)


if __name__ == "__main__":
    main()
