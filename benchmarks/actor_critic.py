"""Updates per second of omar and ma-td3bc, beside a straightforward PyTorch loop over agents in the same run.

    pip install torch
    python benchmarks/actor_critic.py        # writes results/performance/actor_critic.json

Three agents, batch 1024, the study's networks (two layers of 64). The loop is what one writes first: a module per agent
and head, one agent after the other, minibatches indexed from tensors in memory. Measured on one core, as the grid's
workers run, and on two: a run on each against the better of one loop with two threads and two loops with one.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
from _common import record

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.training import loop
from ringfence.training.job import make_job

OUT = Path(__file__).resolve().parent.parent / "results" / "performance" / "actor_critic.json"


def ours(algorithm: str, store, updates: int) -> tuple[float, float]:
    """(updates per second, seconds to compile)."""
    task = registry.from_store(store)
    job = make_job(algorithm, task, None, {}, store)
    c = job.config
    data = loop.windows_of(job, store)
    state = job.algorithm.init(jax.random.key(0), job.spec, c, data, job.feature_map, job.hazard)
    advance, _ = loop.make_program(job)
    roots = jax.vmap(jax.random.key)(jnp.arange(1))
    state = jax.tree.map(lambda x: x[None], state)
    begun = time.perf_counter()
    scores = data.arrays["scores"][None]
    state, metrics = advance(state, roots, data.arrays, scores, 1)
    jax.block_until_ready(metrics)
    compiling = time.perf_counter() - begun
    rates = []
    for _ in range(3):
        begun = time.perf_counter()
        state, metrics = advance(state, roots, data.arrays, scores, updates)
        jax.block_until_ready(metrics)
        rates.append(updates / (time.perf_counter() - begun))
    return sorted(rates)[1], compiling


def torch_loop(algorithm: str, store, updates: int) -> float:
    """Updates per second of the PyTorch loop."""
    import torch
    from torch import nn
    from torch.nn import functional as F

    n, batch, gamma, tau = 3, 1024, 0.95, 0.01
    rows = len(store.actions)
    episode = store.episode_of_step
    here = torch.arange(rows) + torch.as_tensor(episode)
    seen = torch.as_tensor(store.observations, dtype=torch.float32)
    acted = torch.as_tensor(store.actions, dtype=torch.float32)
    paid = torch.as_tensor(store.rewards, dtype=torch.float32)
    d, a = seen.shape[-1], acted.shape[-1]

    def network(inputs: int, outputs: int, *last) -> nn.Module:
        layers = [nn.BatchNorm1d(inputs), nn.Linear(inputs, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU()]
        return nn.Sequential(*layers, nn.Linear(64, outputs), *last)

    agents = []
    for _ in range(n):
        actor, critics = network(d, a, nn.Tanh()), [network(d + a, 1) for _ in range(2)]
        targets = [network(d, a, nn.Tanh()), *[network(d + a, 1) for _ in range(2)]]
        for target, net in zip(targets, [actor, *critics]):
            target.load_state_dict(net.state_dict())
        parameters = [p for q in critics for p in q.parameters()]
        optimisers = torch.optim.Adam(actor.parameters(), 0.01), torch.optim.Adam(parameters, 0.01)
        agents.append((actor, critics, targets, optimisers))

    def value(critic: nn.Module, x, action):
        return critic(torch.cat([x, action], -1))[:, 0]

    def sampled(critic: nn.Module, x, actions):
        b, s, _ = actions.shape
        return value(critic, x.repeat_interleave(s, 0), actions.reshape(b * s, -1)).reshape(b, s)

    def update() -> None:
        for i, (actor, critics, targets, (of_actor, of_critics)) in enumerate(agents):
            pick = torch.randint(rows, (batch,))
            x, ahead = seen[here[pick], i], seen[here[pick] + 1, i]
            action, reward = acted[pick, i], paid[pick, i]
            with torch.no_grad():
                after = targets[0](ahead)
                goal = reward + gamma * torch.minimum(*[value(q, ahead, after) for q in targets[1:]])
            loss = sum(F.mse_loss(value(q, x, action), goal) for q in critics)
            if algorithm == "omar":
                drawn = torch.rand(batch, 10, a) * 2 - 1
                for q in critics:
                    spread = torch.logsumexp(sampled(q, x, drawn) + a * torch.log(torch.tensor(2.0)), 1)
                    loss = loss + 5.0 * (spread - value(q, x, action)).mean()
            of_critics.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_([p for q in critics for p in q.parameters()], 0.5)
            of_critics.step()
            own = actor(x)
            if algorithm == "omar":
                with torch.no_grad():
                    mean, deviation = torch.zeros(batch, a), torch.full((batch, a), 2.0)
                    for _ in range(3):
                        tried = (mean[:, None] + deviation[:, None] * torch.randn(batch, 10, a)).clamp(-1, 1)
                        q = sampled(critics[0], x, tried)
                        mean = (q.softmax(1)[..., None] * tried).sum(1)
                        deviation = ((tried - mean[:, None]) ** 2).mean(1).sqrt()
                    best = tried[torch.arange(batch), q.argmax(1)]
                    better = q.max(1).values > value(critics[0], x, own)
                    best = torch.where(better[:, None], best, own)
                loss = F.mse_loss(own, best)
            else:
                q = value(critics[0], x, own)
                loss = F.mse_loss(own, action) - 2.5 / q.abs().mean().detach() * q.mean()
            loss = loss + 1e-3 * (own**2).mean()
            of_actor.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
            of_actor.step()
            with torch.no_grad():
                for target, net in zip(targets, [actor, *critics]):
                    for p, q in zip(target.parameters(), net.parameters()):
                        p.lerp_(q, tau)

    update()
    rates = []
    for _ in range(3):
        begun = time.perf_counter()
        for _ in range(updates):
            update()
        rates.append(updates / (time.perf_counter() - begun))
    return sorted(rates)[1]


def pinned(cores: set[int], job: tuple, start, out) -> None:
    """Measure in a process that owns `cores`, once everybody is ready."""
    os.sched_setaffinity(0, cores)
    kind, name, updates = job
    store, _ = make(registry.get("simple_spread-expert"))
    if kind == "loop":
        import torch

        torch.set_num_threads(len(cores))
    start.wait()
    out.put(torch_loop(name, store, updates) if kind == "loop" else ours(name, store, updates))


def together(kind: str, name: str, updates: int, cores: list[set[int]]) -> list:
    """What processes side by side measure, one for each set of cores."""
    spawn = multiprocessing.get_context("spawn")
    start, out = spawn.Barrier(len(cores)), spawn.Queue()
    processes = [spawn.Process(target=pinned, args=(c, (kind, name, updates), start, out)) for c in cores]
    for process in processes:
        process.start()
    found = [out.get() for _ in processes]
    for process in processes:
        process.join()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=100)
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    first, second = sorted(os.sched_getaffinity(0))[:2]
    each, both = [{first}, {second}], [{first, second}]
    rows = []
    for name in ("ma-td3bc", "omar"):
        alone, compiling = together("ours", name, a.updates, each[:1])[0]
        pair = sum(rate for rate, _ in together("ours", name, a.updates, each))
        loops = {
            "on one core": sum(together("loop", name, a.updates, each[:1])),
            "on two cores": sum(together("loop", name, a.updates, both)),
            "two processes": sum(together("loop", name, a.updates, each)),
        }
        best = max(loops.values())
        rows += [
            {"name": f"{name}, 3 agents, batch 1024, one core", "value": alone, "unit": "updates/s"},
            {"name": f"{name}, two cores, a run on each", "value": pair, "unit": "updates/s"},
            {"name": f"{name}, compile time", "value": compiling, "unit": "s"},
        ]
        rows += [{"name": f"{name}, PyTorch loop {k}", "value": v, "unit": "updates/s"} for k, v in loops.items()]
        rows += [
            {"name": f"{name}, over the loop, one core", "value": alone / loops["on one core"], "unit": "x"},
            {"name": f"{name}, over the best loop, two cores", "value": pair / best, "unit": "x"},
        ]
    record(a.out, rows)


if __name__ == "__main__":
    main()
