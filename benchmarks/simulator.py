"""Environment steps per second: the vectorised Simple Spread, and mpe2's own loop on the same machine in the same run.

One env-step advances all agents of one environment. Ours is a jitted scan over whole episodes, with rewards and costs,
compiled beforehand; values are medians over repeats.
"""

from __future__ import annotations

import argparse
import time
import warnings
from statistics import median

import jax
import numpy as np
from _common import record

from ringfence.envs import SimpleSpread

DEFAULT_OUT = "results/performance/simulator.json"


def vectorised(n_agents: int, batch: int, repeats: int, draw: bool) -> float:
    """Median env-steps/s; actions are drawn inside the loop if `draw`, else given beforehand."""
    env = SimpleSpread(n_agents=n_agents)
    shape = (batch, n_agents, env.action_dim)

    @jax.jit
    def rollout(key, inputs):
        def advance(state, x):
            action = jax.random.uniform(x, shape, minval=-1.0, maxval=1.0) if draw else x
            state, transition = env.step(state, action)
            return state, (transition.reward.mean(-1), transition.cost)

        return jax.lax.scan(advance, env.reset(key, batch), inputs)

    key = jax.random.key(0)
    length = env.episode_length
    inputs = (
        jax.random.split(key, length) if draw else jax.random.uniform(key, (length, *shape), minval=-1.0, maxval=1.0)
    )
    jax.block_until_ready(rollout(key, inputs))
    rates = []
    for _ in range(repeats):
        start, done = time.perf_counter(), 0
        while time.perf_counter() - start < 0.3:  # long enough that one call's start-up does not count
            jax.block_until_ready(rollout(key, inputs))
            done += batch * length
        rates.append(done / (time.perf_counter() - start))
    return median(rates)


def mpe2_loop(repeats: int) -> float:
    """Median env-steps/s of mpe2's parallel environment under the same kind of actions, drawn beforehand."""
    warnings.filterwarnings("ignore", module="pettingzoo")
    from mpe2 import simple_spread_v3

    env = simple_spread_v3.parallel_env(N=3, max_cycles=25, continuous_actions=True)
    actions = np.random.default_rng(0).random((25, 3, 5), dtype=np.float32)
    rates = []
    for _ in range(repeats):
        start, done = time.perf_counter(), 0
        while time.perf_counter() - start < 0.3:
            env.reset()
            for step in actions:
                env.step(dict(zip(env.agents, step)))
            done += len(actions)
        rates.append(done / (time.perf_counter() - start))
    return median(rates)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=9, help="measurements per row; the median is reported")
    parser.add_argument("--out", default=DEFAULT_OUT, help="where to write the rows")
    args = parser.parse_args()
    unit = "env-steps/s"
    rows = []
    for n_agents, batch, draw in ((3, 1024, False), (3, 4096, False), (3, 4096, True), (24, 256, False)):
        name = f"simple_spread N={n_agents} batch={batch} {'random' if draw else 'given'} actions"
        rows.append({"name": name, "value": vectorised(n_agents, batch, args.repeats, draw), "unit": unit})
    try:
        theirs = mpe2_loop(args.repeats)
    except ImportError:
        print("mpe2 is not installed; its row is left out (pip install 'ringfence[test]').")
    else:
        rows.append({"name": "mpe2 simple_spread_v3 N=3, its own loop", "value": theirs, "unit": unit})
        best = max(row["value"] for row in rows[:2])
        rows.append(
            {"name": "simple_spread N=3 given actions, best batch, over mpe2", "value": best / theirs, "unit": "x"}
        )
    record(args.out, rows)


if __name__ == "__main__":
    main()
