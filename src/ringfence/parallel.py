"""Play a trained policy in anybody's simulator, through PettingZoo's parallel API."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from ringfence import evaluate
from ringfence.each import look
from ringfence.errors import UserError, whole_number
from ringfence.progress import Progress
from ringfence.runs import Run
from ringfence.training import Job

Cost = Callable[[dict[str, dict]], float]


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
    act, key, begun = jax.jit(evaluate.act_with), jax.random.key(seed), time.perf_counter()

    @jax.jit
    def label(seen, state):
        unsafe, _ = job.hazard.labels(look(job.feature_map, job.task.alike, seen, state))
        return unsafe.reshape(len(seen), -1).any(-1)

    played: list[_Episode] = []
    formula = job.hazard.has_formula
    with Progress(f"{job.algorithm.name} in {type(envs[0]).__name__}", episodes, 0, quiet) as bar:
        for first in range(0, episodes, len(envs)):
            seeds = range(first, min(first + len(envs), episodes))
            table = [_Episode(env, job, evaluate.RESETS[split] + k, most) for env, k in zip(envs, seeds)]
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
                memory = evaluate.heard(policy, memory, np.array([e.costs[-1] for e in table], np.float32))
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


class _Episode:
    """One episode under way: what its agents see, and what they have earned and cost."""

    def __init__(self, env: Any, job: Job, seed: int, longest: int):
        lacking = [name for name in ("possible_agents", "reset", "step") if not hasattr(env, name)]
        if lacking:
            raise UserError(
                f"make_env() made a {type(env).__name__} without {lacking[0]}; give a PettingZoo ParallelEnv."
            )
        self.env, self.job, self.agents, self.longest = env, job, list(env.possible_agents), longest
        if len(set(map(str, self.agents))) < len(self.agents):
            raise UserError(f"{type(env).__name__} names an agent twice in possible_agents; give each its own name.")
        if len(self.agents) != job.team:
            remedy = f"; pass agents={len(self.agents)}" if job.task.alike else ""
            raise UserError(
                f"{type(env).__name__} has {len(self.agents)} agents, the run was trained with {job.team}{remedy}."
            )
        if job.widths[1] and not hasattr(env, "state"):
            raise UserError(
                f"The run reads a global state, which {type(env).__name__} lacks; give it a state() method."
            )
        self.rewards: list[float] = []
        self.costs: list[float] = []
        self.terminated = self.unsafe_start = False
        self.running = True
        begun = env.reset(seed=seed)
        if not isinstance(begun, tuple) or len(begun) != 2:
            raise UserError(
                f"reset() of {type(env).__name__} returned a {type(begun).__name__}; a ParallelEnv's returns two "
                "things, observations and infos."
            )
        self._look(begun[0])

    @property
    def owes(self) -> bool:
        """The last step told no cost."""
        return len(self.costs) < len(self.rewards)

    def charge(self, cost: float) -> None:
        """Set the cost of the last step, if nobody has."""
        if self.owes:
            self.costs.append(cost)

    def step(self, action: np.ndarray, cost: Cost | None) -> None:
        """Act (N, A) and take note of what came of it."""
        told, name = self.env.step(dict(zip(self.agents, action))), type(self.env).__name__
        if not isinstance(told, tuple | list) or len(told) not in (5, 6):
            count = len(told) if hasattr(told, "__len__") else 1
            raise UserError(f"step() of {name} returned {count} things; a ParallelEnv's are five.")
        if odd := [type(part).__name__ for part in told if not isinstance(part, Mapping)]:
            raise UserError(f"step() of {name} returned a {odd[0]}; each of its five is a dict by agent.")
        seen, rewards, *costs, terminations, truncations, infos = told
        self._all_in("rewards", rewards, len(self.rewards) + 1)
        ended = [bool(terminations.get(a) or truncations.get(a)) for a in self.agents]
        if any(ended) and not all(ended):
            gone = self.agents[ended.index(True)]
            raise UserError(f"{gone} ended at step {len(self.rewards) + 1} before its team; agents must end together.")
        self.rewards.append(float(np.mean([_number(rewards[a], "reward", name) for a in self.agents])))
        told_of = {a: i for a, i in infos.items() if isinstance(i, Mapping)}
        each = costs[0] if costs else {a: i["cost"] for a, i in told_of.items() if "cost" in i}
        if cost is not None:
            self.costs.append(_number(cost(infos), "cost", "cost="))
        elif each:
            self.costs.append(max(_number(c, "cost", name) for c in each.values()))
        if self.costs[-1:] and self.costs[-1] < 0:
            raise UserError(f"Step {len(self.rewards)} has the cost {self.costs[-1]:g}; a cost is 0 or positive.")
        if len(self.rewards) >= self.longest and not all(ended):
            raise UserError(
                f"An episode of {name} has not ended after {self.longest} steps; let truncations end it, or pass "
                "longest=."
            )
        if not np.isfinite([*self.rewards[-1:], *self.costs[-1:]]).all():
            raise UserError(f"Step {len(self.rewards)} has a reward or cost that is not finite; repair the simulator.")
        self.running = not all(ended)
        self.terminated = all(bool(terminations.get(a)) for a in self.agents)
        if self.running or seen:
            self._look(seen)
        elif self.owes:  # costs that were told need no last state
            raise UserError(
                "step() tells neither a cost nor the state that an episode ends in; return the last observations."
            )

    def _all_in(self, what: str, told: dict, step: int) -> None:
        lacking = [str(a) for a in self.agents if a not in told]
        if lacking:
            raise UserError(
                f"{type(self.env).__name__} tells no {what} of {', '.join(lacking)} at step {step}; all "
                "of possible_agents must take part until the episode ends."
            )

    def _look(self, seen: dict) -> None:
        n, (width, state_width) = self.job.team, self.job.widths
        self._all_in("observations", seen, len(self.rewards))
        there = [seen[a] for a in self.agents]
        self.seen = evaluate.given_as("observations", there, (n, width))
        self.state = evaluate.given_as("state", self.env.state(), (state_width,)) if state_width else None


def _number(value: Any, what: str, whose: str) -> float:
    try:
        return float(np.asarray(value, np.float64).reshape(()))
    except (TypeError, ValueError):
        raise UserError(f"{whose} tells the {what} {str(value)[:80]!r}, which is no number; give one.") from None


def _seen(table: list[_Episode]) -> tuple[np.ndarray, np.ndarray | None]:
    """(B, N, O) and (B, S), or None without a state."""
    return np.stack([e.seen for e in table]), None if table[0].state is None else np.stack([e.state for e in table])


def _together(played: list[_Episode]) -> dict[str, np.ndarray]:
    """`rewards`, `costs` (E, L), `steps`, `terminated` (E,); nothing happens after an episode's end."""
    longest = max(len(e.rewards) for e in played)

    def padded(name: str) -> np.ndarray:
        return np.stack([np.pad(x := np.array(getattr(e, name)), (0, longest - len(x))) for e in played])

    counts = {
        "steps": np.array([len(e.rewards) for e in played]),
        "terminated": np.array([e.terminated for e in played]),
    }
    return {"rewards": padded("rewards"), "costs": padded("costs")} | counts
