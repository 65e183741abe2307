"""Speed and memory, a file of results/performance for each group; on a machine that has nothing else to do.

    python benchmarks/speed.py GROUP        # one of GROUPS below; --out FILE writes elsewhere, --brief tries it out

simulator     env-steps/s of Simple Spread, a jitted scan over whole episodes, and of mpe2's own loop in the same run
robots        env-steps/s of MuJoCo's robots, and what `ringfence data make` takes; five substeps are one env-step
collect       1 M transitions of Simple Spread's medium tier, compilation included
actor_critic  updates/s of ma-td3bc and omar; a PyTorch loop over agents was measured beside them by revision cac628af
planning      an update of the planner, and one joint action under guards, as teams grow; untrained networks
guard         fitting a World, and one joint action of a clone under guards
crossing      the same of Crossing, 8, 64 and 256 agents who guard themselves
causes        the search for causes in 200,000 steps of six agents
tables        ten million rows of a table as a store
startup       until a command is done and a controller acts, with programs kept from an earlier process and without
proof         one joint action of Crossing with a proof and without, to results/stress/proof.json
board         plan_ms_p50 and plan_ms_p99 of results.json of seed 0 of a board's first task, where its checkpoints are
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import RESULTS, Rows, cores, keep, of_json, record

from ringfence import guard as guarded
from ringfence.datasets import behaviour, registry
from ringfence.datasets.make import make
from ringfence.datasets.task import Task
from ringfence.deploy import zoo
from ringfence.envs import Crossing, SafeMuJoCo, SimpleSpread
from ringfence.envs.base import NativeEnv, PureEnv
from ringfence.envs.mujoco import FRAME_SKIP
from ringfence.loading.resolve import load, make_policy
from ringfence.logs.store import EpisodeStore
from ringfence.training import loop, worlds
from ringfence.training.job import make_job
from ringfence.training.runs import Run
from ringfence.types import Array, Policy
from ringfence.utils.precision import in_float32
from ringfence.world import cause_search

WARM_UP = 10  # joint actions that are not counted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("group", choices=[*GROUPS, "proof", "board"])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--brief", action="store_true", help="few repeats, small teams and data")
    a = parser.parse_args()
    if a.group == "proof":
        proof(a.out or RESULTS / "stress" / "proof.json")
    elif a.group == "board":
        board(a.out or RESULTS / "simple_spread")
    else:
        rows = Rows()
        GROUPS[a.group](rows, a.brief)
        record(a.out or RESULTS / "performance" / f"{a.group}.json", rows)


def clock(call: Callable[[], Any]) -> float:
    """Seconds of a call, of all that it computes."""
    begun = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - begun


def rate(call: Callable[[], Any], steps: int, repeats: int, seconds: float = 0.0) -> float:
    """Median steps/s of a call of so many; repeated for so long that one call's start-up does not count."""
    rates = []
    for _ in range(repeats):
        took, done = 0.0, 0
        while not done or took < seconds:
            took, done = took + clock(call), done + steps
        rates.append(done / took)
    return median(rates)


def peak() -> float:
    """GiB that this process has held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)


def in_a_process(code: str, *words: str) -> Any:
    """What a program prints last, as JSON, in a process of its own."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_") or k == "JAX_PLATFORMS"}
    call = [sys.executable, *(["-c", code] if code else []), *words]
    done = subprocess.run(call, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1]) if code else None


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


def latency(rows: Rows, name: str, policy: Any, task: Task, calls: int = 300) -> None:
    took = plan_latency(policy, task, calls)
    for q in ("p50", "p99"):
        rows(f"{name}, {q}", took[f"plan_ms_{q}"], "ms")


def simulator(rows: Rows, brief: bool) -> None:
    repeats, unit = 2 if brief else 9, "env-steps/s"
    for n, batch, draw in ((3, 1024, False), (3, 4096, False), (3, 4096, True), (24, 256, False)):
        name = f"simple_spread N={n} batch={batch} {'random' if draw else 'given'} actions"
        rows(name, vectorised(n, batch, repeats, draw), unit)
    warnings.filterwarnings("ignore", module="pettingzoo")
    try:
        from mpe2 import simple_spread_v3
    except ImportError:
        print("mpe2 is not installed; its row is left out (pip install 'ringfence[test]').")
        return
    env = simple_spread_v3.parallel_env(N=3, max_cycles=25, continuous_actions=True)
    actions = np.random.default_rng(0).random((25, 3, 5), dtype=np.float32)

    def played() -> None:
        env.reset()
        for step in actions:
            env.step(dict(zip(env.agents, step)))

    theirs, best = rate(played, len(actions), repeats, 0.3), max(row["value"] for row in rows[:2])
    rows("mpe2 simple_spread_v3 N=3, its own loop", theirs, unit)
    rows("simple_spread N=3 given actions, best batch, over mpe2", best / theirs, "x")


def vectorised(n_agents: int, batch: int, repeats: int, draw: bool) -> float:
    """Env-steps/s with rewards and costs; actions are drawn inside the loop if `draw`, else given beforehand."""
    env = SimpleSpread(n_agents=n_agents)
    key, shape = jax.random.key(0), (batch, n_agents, env.action_dim)

    @jax.jit
    def rollout(key, inputs):
        def advance(state, x):
            action = jax.random.uniform(x, shape, minval=-1.0, maxval=1.0) if draw else x
            state, transition = env.step(state, action)
            return state, (transition.reward.mean(-1), transition.cost)

        return jax.lax.scan(advance, env.reset(key, batch), inputs)

    inputs = jax.random.split(key, env.episode_length)
    if not draw:
        inputs = jax.random.uniform(key, (env.episode_length, *shape), minval=-1.0, maxval=1.0)
    jax.block_until_ready(rollout(key, inputs))
    return rate(lambda: rollout(key, inputs), batch * env.episode_length, repeats, 0.3)


DATA = """
import json, resource, sys, time
begun = time.perf_counter()
from ringfence.datasets import registry as tasks
from ringfence.datasets.make import make
store, _ = make(tasks.get(sys.argv[1]), int(sys.argv[2]), out=sys.argv[3], fresh=True)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(json.dumps([time.perf_counter() - begun, peak, store.steps]))
"""


def robots(rows: Rows, brief: bool) -> None:
    repeats = 2 if brief else 9
    for parts in ("2x3", "2x4", "4x2"):
        rows(f"{SafeMuJoCo(parts).name} mj_step alone, one thread", mj_step(parts, repeats), "env-steps/s")
        for batch in (16, 256):
            rows(f"{SafeMuJoCo(parts).name} batch={batch}", batched(parts, batch, repeats), "env-steps/s")
    for task in ("halfcheetah_2x3-good", "ant_2x4-good"):
        with tempfile.TemporaryDirectory() as folder:
            made = in_a_process(DATA, task, "20000" if brief else "1000000", f"{folder}/data.h5")
        rows(f"data make {task}, {made[2]:,} transitions", made[0], "s")
        rows(f"data make {task}, peak memory", made[1], "GiB")


def batched(parts: str, batch: int, repeats: int) -> float:
    """Env-steps/s of a running batch under uniform actions drawn beforehand, resets of fallen robots included."""
    env = SafeMuJoCo(parts)
    sim, rng = env.simulate(batch), np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (50, batch, env.n_agents, env.action_dim))
    sim.reset(range(batch))
    rates, fresh = [], batch
    for _ in range(repeats):
        begun, done = time.perf_counter(), 0
        for action in actions:
            done += int(sim.running.sum())
            fallen = np.flatnonzero(sim.step(action).terminated)
            if len(fallen):
                sim.reset(range(fresh, fresh + len(fallen)), fallen)
                fresh += len(fallen)
        rates.append(done / (time.perf_counter() - begun))
    return median(rates)


def mj_step(parts: str, repeats: int, steps: int = 1000) -> float:
    """Env-steps/s of one thread that calls MuJoCo's own `mj_step` and nothing else."""
    import mujoco

    model = SafeMuJoCo(parts).model()
    data, controls = mujoco.MjData(model), np.random.default_rng(0).uniform(-1, 1, (steps, model.nu))

    def played() -> None:
        mujoco.mj_resetData(model, data)
        for control in controls:
            data.ctrl[:] = control
            mujoco.mj_step(model, data, FRAME_SKIP)

    return rate(played, steps, repeats)


COLLECT = """
import json, resource, sys, time
start = time.perf_counter()
import jax
from ringfence.datasets.behaviour import collect, shipped_policy
from ringfence.envs.simple_spread import SimpleSpread
imported = time.perf_counter()
env = SimpleSpread()
data = collect(env, shipped_policy("medium"), int(sys.argv[1]) // env.episode_length, jax.random.key(0))
took = time.perf_counter() - imported
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
size = sum(x.nbytes for x in data.values()) / 2**20
print(json.dumps([took, imported - start, peak, size, float(data["rewards"].mean(-1).sum(-1).mean())]))
"""


def collect(rows: Rows, brief: bool) -> None:
    names = ("wall time", "imports", "peak resident memory", "size of the arrays", "mean return")
    units = ("s", "s", "MiB", "MiB", "return per episode")
    for name, unit, value in zip(names, units, in_a_process(COLLECT, "20000" if brief else "1000000")):
        rows(f"collect medium, 1 M transitions: {name}", value, unit)


def causes(rows: Rows, brief: bool) -> None:
    """The search for causes in 200,000 steps of six walkers: of two who are too near, of who is near and fast, and of a
    sum over the team."""
    rng = np.random.default_rng(0)
    episodes, agents = (50 if brief else 2000), 6
    phase = rng.uniform(0, 2 * np.pi, (episodes, 1, agents, 2))
    turning = rng.uniform(0.02, 0.06, phase.shape)  # rad a step
    phase = phase + turning * np.arange(100)[:, None, None]
    place, velocity = 6 * np.sin(phase), 60 * turning * np.cos(phase)  # m, m/s
    others = np.array([[j for j in range(agents) if j != i] for i in range(agents)])
    offset, relative = (a[:, :, others] - a[:, :, :, None] for a in (place, velocity))
    moves = np.concatenate([offset, relative], -1).reshape(episodes, 100, agents, -1)
    load = np.cumsum(rng.normal(0, 0.1, (episodes, 100, agents, 1)), 1)
    x = np.concatenate([place, velocity, load, moves], -1).astype(np.float32).reshape(episodes * 100, agents, -1)
    names = ["own.x", "own.y", "own.vx", "own.vy", "own.load"]
    names += [f"other{j}.{what}" for j in range(agents - 1) for what in ("dx", "dy", "dvx", "dvy")]
    near = np.linalg.norm(offset, axis=-1).min(-1)
    fast = np.linalg.norm(velocity, axis=-1)
    dangers = {
        "two too near": (near < 0.25).any(-1),
        "near and fast": ((near < 0.5) & (fast > 2.0)).any(-1),
        "sum over the team": np.abs(load[..., 0].sum(-1)) > 3.5,
    }
    for name, unsafe in dangers.items():
        begun = time.process_time()
        found, _ = cause_search.find(x, unsafe.reshape(-1), np.arange(len(x)) // 100, names)
        rows(
            f"search, {name}: {'; '.join(cause.name for cause in found.causes)}",
            time.process_time() - begun,
            "s of CPU",
        )


IMPORT = """
import json, resource, sys, time
from pathlib import Path
from ringfence.logs.large import import_large
begun = time.process_time()
options = dict(time="time", agent="id", state=["x", "y"], cost=("hit",), quiet=True)
made = import_large([Path(sys.argv[1])], Path(sys.argv[2]), **options)
print(json.dumps([time.process_time() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, made.steps]))
"""


def tables(rows: Rows, brief: bool) -> None:
    """A Parquet table of ten who drive about, who are in episodes of 500 steps, as a store."""
    import pyarrow
    from pyarrow import parquet

    agents, block = 10, 100_000
    steps = 100_000 if brief else 1_000_000
    pace, phase = np.linspace(0.5, 1.5, agents), np.random.default_rng(0).uniform(0, 6, agents)
    with tempfile.TemporaryDirectory() as folder:
        file, writer = Path(folder) / "fleet.parquet", None
        for begin in range(0, steps, block):
            t = np.arange(begin, begin + block)
            turned = t[:, None] * 0.01 * pace + phase
            place = 10 * np.stack([np.cos(turned), np.sin(0.8 * turned)], -1)
            hit = np.repeat(np.abs(place[..., 0]).min(1) < 0.01, agents)
            times = np.repeat(t * 0.1 + t // 500 * 100.0, agents)
            columns = {"time": times, "id": np.tile(np.arange(agents), len(t)), "hit": hit.astype(float)}
            table = pyarrow.table(columns | dict(zip("xy", place.reshape(-1, 2).T)))
            writer = writer or parquet.ParquetWriter(file, table.schema)
            writer.write_table(table)
        assert writer is not None
        writer.close()
        took, peak, made = in_a_process(IMPORT, str(file), str(Path(folder) / "fleet.h5"))
    rows(f"table of {steps * agents:,} rows, {made:,} steps of {agents} agents", took, "s of CPU")
    rows(f"table of {steps * agents:,} rows: peak resident memory", peak, "GiB")


def actor_critic(rows: Rows, brief: bool) -> None:
    """Three agents, batch 1024, two layers of 64, on one core, as the grid's workers run."""
    store, _ = make(registry.get("simple_spread-expert"))
    os.sched_setaffinity(0, cores()[:1])
    updates = 3 if brief else 100
    for name in ("ma-td3bc", "omar"):
        go = updating(name, store)
        rows(f"{name}, compile time", clock(partial(go, 1)), "s")
        rows(f"{name}, 3 agents, batch 1024, one core", rate(partial(go, updates), updates, 3), "updates/s")


def updating(name: str, store: EpisodeStore) -> Callable[[int], Any]:
    """What makes so many updates."""
    job, data, state, _ = prepared(name, registry.from_store(store), store)
    advance, _ = loop.make_program(job)
    fixed = jax.vmap(jax.random.key)(jnp.arange(1)), data.arrays, data.arrays["scores"][None]

    def go(count: int) -> Any:
        nonlocal state
        state, metrics = advance(state, *fixed, count)
        return metrics

    return go


def prepared(name: str, task: Task, store: EpisodeStore) -> tuple[Any, Any, Any, Any]:
    """A job, its windows, its state stacked for one seed, and the World that it reads."""
    quick = {f"{part}_updates": 10 for part in ("dynamics", "value", "barrier", "future")}
    job = make_job(name, task, None, {}, store, *([quick] if name == "icbf" else []))
    read = [worlds.fit(store, **job.world)] if name == "icbf" else []
    data = loop.windows_of(job, store, *read)
    state = job.algorithm.init(jax.random.key(0), job.spec, job.config, data, job.feature_map, job.hazard, *read)
    return job, data, jax.tree.map(lambda x: x[None], state), (read or [None])[0]


def planning(rows: Rows, brief: bool) -> None:
    updates = 2 if brief else 20
    for n in (3,) if brief else (3, 6, 12):
        hazard = registry.TASKS["simple_spread-random"].hazard
        task = Task(f"simple_spread-{n}-agents", SimpleSpread(n_agents=n), hazard)
        played = behaviour.collect(task.env, "random", 400, jax.random.key(0), batch=400)
        parts = (played[k] for k in ("observations", "actions", "rewards", "costs"))
        card = {"task": task.name, "hazard": task.hazard}
        job, data, state, world = prepared(
            "icbf", task, EpisodeStore.from_episodes(*parts, state=played["state"], card=card)
        )
        advance, _ = loop.make_program(job)
        fixed = jax.vmap(jax.random.key)(jnp.arange(1)), data.arrays, data.arrays["scores"][None], updates
        planner = make_policy(job, jax.tree.map(lambda x: x[0], state), {})
        begun = time.perf_counter()
        compiled = advance.lower(state, *fixed).compile()
        compiling, took = time.perf_counter() - begun, []
        for _ in range(6):
            begun = time.perf_counter()
            state, metrics = jax.block_until_ready(compiled(state, *fixed))
            took.append((time.perf_counter() - begun) / updates * 1e3)
        rows(f"training update, {n} agents, batch {job.config.batch}", float(np.median(took[1:])), "ms")
        rows(f"training update per agent, {n} agents", float(np.median(took[1:])) / n, "ms")
        rows(f"compile time of the training step, {n} agents", compiling, "s")
        for name in ("select", "full"):
            policy = guarded(planner, world, guard=name)
            latency(rows, f"one joint action, guard {name}, {n} agents", policy, task, 20 if brief else 300)
    rows("peak memory of this benchmark", peak(), "GiB")


def guard(rows: Rows, brief: bool) -> None:
    tasks = ("simple_spread-expert", "halfcheetah_2x3-medium", "ant_4x2-medium")
    for name in tasks[: 1 if brief else 3]:
        task, (store, _) = registry.get(name), make(registry.get(name))
        begun = time.perf_counter()
        world = worlds.fit(store, cached=False)
        rows(f"{name}: fitting a World", time.perf_counter() - begun, "s")
        with tempfile.TemporaryDirectory() as folder:
            (run,) = loop.train("bc", store, out=folder, changes={"num_updates": 200}, quiet=True)
            for which in ("none", "shield", "full"):
                how = {} if which == "none" else {"guard": which, "world": world}
                latency(rows, f"{name}: cloning, guard {which}, one joint action", load(run, **how)[1], task)
    rows("peak memory of this benchmark", peak(), "GiB")


BATCH = 500
ON_CROSSING = {
    "none": {},
    "shield": {"guard": "shield"},
    "shield by ℓ alone along 15 rows": {"guard": "shield", "horizon": 15, "terminal_value": False},
    "full": {"guard": "full"},
}


def crossing(rows: Rows, brief: bool) -> None:
    env = Crossing()

    @jax.jit
    def play(key):
        def step(state, key):
            push = jax.random.uniform(key, (BATCH, env.n_agents, 2), minval=-1.0, maxval=1.0)
            after, out = env.step(state, push)
            return after, (env.observe(after).sum(), out.cost.sum())

        return jax.lax.scan(step, env.reset(key, BATCH), jax.random.split(key, env.episode_length))[1]

    clock(lambda: play(jax.random.key(0)))
    simulated = rate(lambda: play(jax.random.key(0)), BATCH * env.n_agents * env.episode_length, 2 if brief else 5)
    rows("Crossing, 8 agents: simulated", simulated, "agent-steps/s")
    store, _ = make(registry.get("crossing-hasty"))
    begun = time.perf_counter()
    world = worlds.fit(store, cached=False)
    rows("Crossing: fitting a World", time.perf_counter() - begun, "s")
    with tempfile.TemporaryDirectory() as folder:
        (run,) = loop.train("bc", store, out=folder, quiet=True)
        for which, options in ON_CROSSING.items():
            for agents in (8, 64, 256)[: 2 if which == "full" else 3]:
                took = acting(run, agents, {**options, "world": world} if options else {})
                for q in (50, 99):
                    name = f"Crossing: one joint action, guard {which}, {agents} agents, p{q}"
                    rows(name, float(np.percentile(took, q)), "ms")


def acting(run: Any, agents: int, options: dict, steps: int = 200) -> np.ndarray:
    """(steps − 10,) milliseconds of joint actions along two episodes, where agents meet."""
    job, policy = load(run, agents=agents, **options)
    env, key = job.task.env, jax.random.key(0)
    act = jax.jit(lambda policy, carry, seen, key: policy.act(carry, seen, None, key))
    move, look = jax.jit(env.step), jax.jit(env.observe)
    took: list[float] = []
    state, carry = env.reset(key, 1), policy.initial_state(1)
    for t in range(steps):
        if t % env.episode_length == 0:
            state, carry = env.reset(jax.random.fold_in(key, t), 1), policy.initial_state(1)
        seen = jax.block_until_ready(look(state))
        begun = time.perf_counter()
        carry, step = jax.block_until_ready(act(policy, carry, seen, jax.random.fold_in(key, t)))
        took.append((time.perf_counter() - begun) * 1e3)
        state, _ = move(state, step.action)
    return np.array(took[10:])


POLICY = "crossing-hasty/bc"
EVALUATE = "eval {run} --guard shield --agents 8 --episodes 20"
ACT = """
import sys, time
import numpy as np
from ringfence import Controller
controller = Controller(sys.argv[1], guard=sys.argv[2], agents=8)
observations = np.zeros((8, controller.job.widths[0]), np.float32)
begun = time.perf_counter()
if "warm" in sys.argv:
    controller.warm_up(observations)
    begun = time.perf_counter()
controller.act(observations)
print(time.perf_counter() - begun)
"""


def startup(rows: Rows, brief: bool) -> None:
    """Every measurement is a process of its own; the first of each begins with an empty folder. The policy and its
    World come with the package."""

    def measure(name: str, once: Callable[[], float]) -> None:
        pairs = list(_pairs(once, 1 if brief else 3))
        first, second = (median(taken) for taken in zip(*pairs))
        rows(f"{name}, first process", first, "s")
        rows(f"{name}, second process", second, "s")
        rows(f"{name}, second against first", second / first, "")

    with tempfile.TemporaryDirectory() as folder:
        run = zoo.pretrained(POLICY, Path(folder) / "runs").path
        call = ("-m", "ringfence", *EVALUATE.format(run=run).split())
        measure(f"ringfence {EVALUATE.format(run=POLICY)}", lambda: clock(lambda: in_a_process("", *call)))
        for which in ("shield", "full"):
            for how, after in ((), ""), (("warm",), " that has warmed up"):
                words = (str(run), which, *how)
                name = f"{POLICY}, 8 agents, {which}: first action of a loaded controller{after}"
                measure(name, lambda words=words: in_a_process(ACT, *words))


def _pairs(once: Callable[[], float], repeats: int) -> Iterator[tuple[float, float]]:
    """Seconds of a first process with an empty folder, and of a second with what the first has kept."""
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as programs:
            os.environ["RINGFENCE_COMPILATION_CACHE"] = programs
            yield once(), once()


def proof(out: Path) -> None:
    """Milliseconds of a joint action of eight agents, and of all that is said of it, along episodes."""
    found: dict[str, Any] = {"cores": os.cpu_count()}
    with tempfile.TemporaryDirectory() as folder:
        run = zoo.pretrained(POLICY, folder)
        for name, options in (("shield", {}), ("shield and proof", {"proof": 0.02})):
            took = acting(run, 8, {"guard": "shield", **options})
            found |= {f"{name}, p{q}": round(float(np.percentile(took, q)), 2) for q in (50, 99)}
    keep(out, of_json(out.resolve()) | {"milliseconds": found})


def board(folder: Path, task: str = "simple_spread-expert") -> None:
    for cell in sorted((folder / "cells" / task).glob("*/seed-0-*")):
        run = Run(cell)
        if not run.checkpoints():
            print(f"{cell}: no checkpoint here, left as it is")
            continue
        for variant, result in run.results.items():
            how = {k: result[k] for k in ("guard", "barrier", "execution")} | result["guard_options"]
            how = how if result.get("guard", "none") != "none" else {}
            policy = worlds.with_world(load, run, **result["options"], **how)[1]
            took = plan_latency(policy, registry.get(task))
            run.add_result(variant, result | took)
            print(f"{cell.parent.name} {variant}: {took['plan_ms_p50']:.2f} ms, p99 {took['plan_ms_p99']:.2f}")


GROUPS: dict[str, Callable[[Rows, bool], None]] = {
    "simulator": simulator,
    "robots": robots,
    "collect": collect,
    "actor_critic": actor_critic,
    "planning": planning,
    "guard": guard,
    "crossing": crossing,
    "startup": startup,
    "causes": causes,
    "tables": tables,
}

if __name__ == "__main__":
    main()
