"""Play a trained policy in anybody's simulator, through PettingZoo's parallel API."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from ringfence import evaluate
from ringfence.each import look
from ringfence.episodes import Cost, Episode, Shape
from ringfence.errors import UserError, whole_number
from ringfence.progress import Progress
from ringfence.runs import Run


def play(
    run: Run | str,
    make_env: Callable[[], Any],
    *,
    episodes: int = 20,
    planner: str = "plain",
    split: str = "test",
    seed: int = 0,
    cost: Cost | None = None,
    at_once: int = 16,
    longest: int | None = None,
    quiet: bool = True,
    **options,
) -> dict:
    """Returns, costs and their intervals over `episodes` episodes of a simulator; nothing is stored.

    `make_env()` makes a PettingZoo `ParallelEnv` whose agents, in the order of `possible_agents`, are those of the
    run's data, and who begin and end together. `at_once` of them are stepped side by side, so that one compiled call
    acts in all. Episode k is reset with the seed 7 000 001 + k, on the split "validation", for choosing settings,
    with 9 000 001 + k; one that has not ended after `longest` steps (twenty times the longest logged one, at least
    10 000) is refused; `seed` moves the policy's noise. `planner` and `options` (guard, danger, sight, world, ...) are
    as in `evaluate.load`.

    A step's reward is the mean over agents. Its cost is `cost(infos)` if that is given, else the largest of the
    agents' costs (in their infos, or the third of six results, as Safety-Gymnasium's `step` has them); where there
    are none, 1 if the run's hazard calls the state unsafe that the step leads to.

    The summary is that of an evaluation (docs/evaluation.md), without what needs a benchmark's constants.
    """
    for name, value in (("episodes", episodes), ("at_once", at_once), ("longest", 1 if longest is None else longest)):
        whole_number(name, value, 1)
    if split not in evaluate.RESETS:
        raise UserError(f"split='{split}' does not exist; use test or validation.")
    job, policy = evaluate.load(run, planner=planner, **options)
    most = longest or max(10_000, 20 * job.spec.episode_length)
    envs = [make_env() for _ in range(min(at_once, episodes))]
    if len({id(env) for env in envs}) < len(envs):
        raise UserError(
            f"make_env() gave the same {type(envs[0]).__name__} twice, but several are stepped side by side; make a "
            "new one at every call, or pass at_once=1."
        )
    widths = job.widths
    shape = Shape(job.team, widths[0], widths[1] or 0, job.task.alike)
    act, key, begun = jax.jit(evaluate.act_with), jax.random.key(seed), time.perf_counter()

    @jax.jit
    def label(seen, state):
        unsafe, _ = job.hazard.labels(look(job.feature_map, job.task.alike, seen, state))
        return unsafe.reshape(len(seen), -1).any(-1)

    played: list[Episode] = []
    formula = job.hazard.has_formula
    with Progress(f"{job.algorithm.name} in {type(envs[0]).__name__}", episodes, 0, quiet) as bar:
        for first in range(0, episodes, len(envs)):
            seeds = range(first, min(first + len(envs), episodes))
            table = [Episode(env, shape, evaluate.RESETS[split] + k, most) for env, k in zip(envs, seeds)]
            if formula:
                for episode, unsafe in zip(table, np.asarray(label(*_seen(table)))):
                    episode.unsafe_start = bool(unsafe)
            memory = policy.start(len(table))
            while any(e.running for e in table):
                key, now = jax.random.split(key)
                memory, decided = act(policy, memory, *_seen(table), now)
                for episode, action in zip(table, np.asarray(decided.action)):
                    if episode.running:
                        episode.step(action, cost)
                if any(e.owes for e in table):
                    if not formula:
                        raise UserError(
                            "step() tells no cost, and the run's hazard has no formula to say what is unsafe; pass "
                            "cost=, a function of the agents' infos."
                        )
                    for episode, unsafe in zip(table, np.asarray(label(*_seen(table)))):
                        episode.charge(float(unsafe))
                memory = evaluate.heard(policy, memory, np.array([np.max(e.costs[-1]) for e in table], np.float32))
            played += table
            bar.advance(len(table))
    result = evaluate.summarise(_together(played), job.task, np.array([e.unsafe_start for e in played]))
    for name in ("return_norm", "cost_norm", "constants"):
        del result[name]
    return result | {
        "task": job.task.name,
        "cost_limit": job.task.cost_limit,
        "seed": seed,
        "eval_seconds": time.perf_counter() - begun,
    }


def _seen(table: list[Episode]) -> tuple[np.ndarray, np.ndarray | None]:
    """(B, N, O) and (B, S), or None without a state."""
    return np.stack([e.seen for e in table]), None if table[0].state is None else np.stack([e.state for e in table])


def _together(played: list[Episode]) -> dict[str, np.ndarray]:
    """`rewards`, `costs` (E, L), `steps`, `terminated` (E,); nothing happens after an episode's end."""
    longest = max(len(e.rewards) for e in played)

    def padded(of: Callable[[Episode], list]) -> np.ndarray:
        return np.stack([np.pad(x := np.array(of(e)), (0, longest - len(x))) for e in played])

    counts = {
        "steps": np.array([len(e.rewards) for e in played]),
        "terminated": np.array([e.terminated for e in played]),
    }
    rewards, costs = padded(lambda e: [r.mean() for r in e.rewards]), padded(lambda e: [np.max(c) for c in e.costs])
    return {"rewards": rewards, "costs": costs} | counts
