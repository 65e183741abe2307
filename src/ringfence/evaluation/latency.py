"""How long one joint action takes."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.datasets.task import Task
from ringfence.envs.base import NativeEnv, PureEnv
from ringfence.types import Array, Policy
from ringfence.utils.precision import in_float32

WARM_UP = 10  # calls that are not counted


def _first(env: PureEnv | NativeEnv) -> tuple[Array, Array]:
    """What a policy sees at the start of an episode: (1, N, O), (1, S)."""
    if isinstance(env, NativeEnv):
        sim = env.simulate(1)
        sim.reset([0])
        return jnp.asarray(sim.observe().observations), jnp.asarray(sim.observe().state)
    state = env.reset(jax.random.key(0), 1)
    return env.observe(state), env.global_state(state)


@in_float32
def plan_latency(policy: Policy, task: Task, calls: int = 200) -> dict[str, float]:
    """Milliseconds for one joint action in one environment: p50 and p99 over `calls`, after warm-up."""
    seen = _first(task.simulator)
    act = jax.jit(lambda policy, carry, seen, key: policy.act(carry, *seen, key)[1])  # with all that it says beside it
    carry = policy.initial_state(1)
    took = []
    for key in jax.random.split(jax.random.key(1), calls + WARM_UP):
        begun = time.perf_counter()
        jax.block_until_ready(act(policy, carry, seen, key))
        took.append((time.perf_counter() - begun) * 1e3)
    p50, p99 = np.percentile(took[WARM_UP:], [50, 99])
    return {"plan_ms_p50": float(p50), "plan_ms_p99": float(p99)}
