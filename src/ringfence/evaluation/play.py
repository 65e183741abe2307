"""Play a trained policy in anybody's simulator, through PettingZoo's parallel API."""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ringfence.datasets.task import Task
from ringfence.envs.episode import Cost, Episode, Shape
from ringfence.errors import UserError, whole_number
from ringfence.evaluation import evaluate, protocol, rollout, statistics
from ringfence.guards import Pilot
from ringfence.loading.resolve import resolve
from ringfence.loading.spec import PolicySpec
from ringfence.problem.constraints import CostColumn
from ringfence.problem.homogeneous import look
from ringfence.proposals.base import act_with, heard
from ringfence.training.runs import Run
from ringfence.utils.compilation import keep_programs
from ringfence.utils.files import writable
from ringfence.utils.progress import Progress


@dataclass(frozen=True, eq=False)
class Player:
    """Who plays, and what is known of it."""

    name: str
    policy: Any  # types.Policy of the whole team
    task: Task
    shape: Shape
    longest: int  # logged episode
    unsafe: Callable[[np.ndarray, np.ndarray | None], np.ndarray] | None  # (B,) of what is seen, where a formula tells
    told: dict  # what a result says of it
    limits: dict[str, float]  # per episode, of constraints that the data names
    run: Run | None = None
    variant: str = ""


def play(
    run: Run | str | Pilot,
    make_env: Callable[[], Any],
    *,
    episodes: int = 20,
    planner: str = "plain",
    split: str = "test",
    seed: int = 0,
    cost: Cost | None = None,
    at_once: int = 16,
    longest: int | None = None,
    keep: bool = False,
    quiet: bool = True,
    **options,
) -> dict:
    """Returns, costs and their intervals over `episodes` episodes of a simulator.

    run: a run, or a policy of anybody's under guard (`ringfence.guard`). `make_env()` makes a PettingZoo `ParallelEnv`
    whose agents, in the order of `possible_agents`, are those of the data, and who begin and end together. `at_once` of
    them are stepped side by side, so that one compiled call acts in all. Episode k is reset with the seed
    7 000 001 + k, on the split "validation", for choosing settings, with 9 000 001 + k; one that has not ended after
    `longest` steps (twenty times the longest logged one, at least 10 000) is refused; `seed` moves the policy's noise.
    `planner` and `options` (guard, danger, sight, world, ...) are as in `evaluate.load`. `keep` adds the result to the
    run's results.json, as `ringfence eval` does, for reports.

    A step's reward is the mean over agents. Its cost is `cost(infos)` if that is given, else the largest of the
    agents' costs (in their infos, or the third of six results, as Safety-Gymnasium's `step` has them); costs told as
    a dictionary are those of constraints by name, and the result's `constraints` has each beside its limit. Where there
    are none, 1 if the run's hazard calls the state unsafe that the step leads to.

    The summary is that of an evaluation (docs/evaluation.md), without what needs a benchmark's constants.
    """
    keep_programs()
    for name, value in (("episodes", episodes), ("at_once", at_once), ("longest", 1 if longest is None else longest)):
        whole_number(name, value, 1)
    if split not in rollout.RESETS:
        raise UserError(f"split='{split}' does not exist; use test or validation.")
    player = _pilot(run, planner, options) if isinstance(run, Pilot) else _trained(run, planner, split, options)
    if keep and player.run is None:
        raise UserError("keep=True adds a result to a run's folder, and a function under guard has none; leave it out.")
    if keep:
        _ = player.run.results, writable(player.run.path / "results.json")  # refused before anything is played
    policy, most = player.policy, longest or max(10_000, 20 * player.longest)
    envs = [make_env() for _ in range(min(at_once, episodes))]
    if len({id(env) for env in envs}) < len(envs):
        raise UserError(
            f"make_env() gave the same {type(envs[0]).__name__} twice, but several are stepped side by side; make a "
            "new one at every call, or pass at_once=1."
        )
    act = act_with if isinstance(run, Pilot) else jax.jit(act_with)
    key, begun, played = jax.random.key(seed), time.perf_counter(), []
    counts: dict[str, list[np.ndarray]] = {}  # of every episode: steps in which a guard failed, or did not know
    with Progress(f"{player.name} in {type(envs[0]).__name__}", episodes, 0, quiet) as bar:
        for first in range(0, episodes, len(envs)):
            seeds = range(first, min(first + len(envs), episodes))
            table = [Episode(env, player.shape, rollout.RESETS[split] + k, most) for env, k in zip(envs, seeds)]
            if player.unsafe:
                for episode, unsafe in zip(table, player.unsafe(*_seen(table))):
                    episode.unsafe_start = bool(unsafe)
            memory = policy.start(len(table))
            here: dict[str, np.ndarray] = {}
            while any(e.running for e in table):
                key, now = jax.random.split(key)
                memory, decided = act(policy, memory, *_seen(table), now)
                on = np.array([e.running for e in table])
                for name in (k for k in rollout.COUNTED if k in decided.info):
                    here[name] = here.get(name, np.zeros(len(table))) + (np.asarray(decided.info[name]) & on)
                for episode, action in zip(table, np.asarray(decided.action)):
                    if episode.running:
                        episode.step(action, cost)
                if any(e.owes for e in table):
                    if player.unsafe is None:
                        raise UserError(
                            "step() tells no cost, and the run's hazard has no formula to say what is unsafe; pass "
                            "cost=, a function of the agents' infos."
                        )
                    for episode, unsafe in zip(table, player.unsafe(*_seen(table))):
                        episode.charge(float(unsafe))
                memory = heard(policy, memory, _last_costs(table))
            played += table
            for name, steps in here.items():
                counts.setdefault(name, []).append(steps)
            bar.advance(len(table))
    together = _together(played) | {k: np.concatenate(v) for k, v in counts.items()}
    result = protocol.summarise(together, player.task, np.array([e.unsafe_start for e in played]))
    if played[0].constraints:
        result["constraints"] = _of_constraints(played, player.limits)
    more = {"task": player.task.name, "seed": seed, "eval_seconds": time.perf_counter() - begun} | player.told
    if keep:
        about = {"split": split, "protocol": protocol.PROTOCOL, "variant": player.variant}
        about |= {"simulator": name if isinstance(name := getattr(make_env, "told", None), str) else _named(envs[0])}
        player.run.add_result(player.variant, result | more | about)
    for name in ("return_norm", "cost_norm", "constants"):
        del result[name]
    return result | more | {"cost_limit": player.task.cost_limit}


def simulator(told: str) -> Callable[[], Any]:
    """What makes the simulator that is told as FILE.py:NAME or MODULE:NAME, a class or a function without arguments."""
    where, colon, name = told.rpartition(":")
    if not colon or not name.isidentifier() or not where:
        raise UserError(f"'{told}' names no simulator; write FILE.py:NAME or MODULE:NAME of what makes a ParallelEnv.")
    file = Path(where)
    if file.suffix == ".py" and not file.is_file():
        raise UserError(f"'{where}' is no file; give the one that holds {name}.")
    sys.path.insert(0, str(file.resolve().parent if file.suffix == ".py" else Path.cwd()))
    try:
        module = importlib.import_module(file.stem if file.suffix == ".py" else where)
    except Exception as error:  # it is anybody's code
        raise UserError(f"'{where}' cannot be imported ({type(error).__name__}: {error}); repair it first.") from error
    finally:
        sys.path.pop(0)
    if not callable(make := getattr(module, name, None)):
        raise UserError(f"'{where}' has no {name} that can be called; name the class, or the function, that makes one.")

    def made() -> Any:
        return make()

    made.told = told
    return made


def _named(env: Any) -> str:
    return f"{type(env).__module__}:{type(env).__qualname__}"


def _trained(run: Run | str, planner: str, split: str, options: dict) -> Player:
    """A run, as it is to be played."""
    resolved = resolve(PolicySpec.of(run, planner=planner, **options))
    run = Run.of(run)
    job = resolved.job

    @jax.jit
    def unsafe(seen, state):
        found, _ = job.hazard.labels(look(job.feature_map, job.task.alike, seen, state))
        return found.reshape(len(seen), -1).any(-1)

    return Player(
        job.algorithm.name,
        resolved.team,
        job.task,
        Shape(job.team, job.widths[0], job.widths[1] or 0, job.task.alike),
        job.spec.episode_length,
        (lambda *seen: np.asarray(unsafe(*seen))) if job.hazard.has_formula else None,
        {"step": resolved.step} | evaluate.about(resolved),
        run.config["data"].get("constraints") or {},
        run,
        resolved.variant(split),
    )


def _pilot(pilot: Pilot, planner: str, options: dict) -> Player:
    """Anybody's function under guard."""
    if options or planner != "plain":
        raise UserError(f"{[*options, 'planner'][0]} was said to ringfence.guard(), or not at all; leave it out here.")
    world = pilot.policy.guarded.guard.world
    spec = world.spec
    task = Task(spec.task, None, CostColumn(), action_low=spec.action_low, action_high=spec.action_high)
    shape = Shape(pilot.policy.agents, None, None if world.map.reads_state else 0, spec.alike)
    return Player(
        "a function under guard",
        _OneByOne(pilot.policy),
        task,
        shape,
        spec.episode_length,
        None,
        {"guard": "own"},
        world.limits,
    )


class _OneByOne:
    """A function under guard that is asked for each simulator by itself, as by its pilot; the guard judges all."""

    def __init__(self, policy: Any):
        self.policy, self.start, self.hear = policy, policy.start, policy.hear

    def act(self, memory, seen, state, key):
        wanted = [self.policy.function(x, None if state is None else state[k]) for k, x in enumerate(seen)]
        return self.policy.decided(memory, seen, state, wanted, key)


def _seen(table: list[Episode]) -> tuple[np.ndarray, np.ndarray | None]:
    """(B, N, O) and (B, S), or None without a state."""
    return np.stack([e.seen for e in table]), None if table[0].state is None else np.stack([e.state for e in table])


def _last_costs(table: list[Episode]) -> np.ndarray | dict[str, np.ndarray]:
    """(B,) what the last step of each cost, or that by constraint."""
    if not table[0].constraints:
        return np.array([np.max(e.costs[-1]) for e in table], np.float32)
    names = table[0].constraints[0]
    return {k: np.array([np.max(e.constraints[-1][k]) for e in table], np.float32) for k in names}


def _of_constraints(played: list[Episode], limits: dict[str, float]) -> dict[str, dict]:
    """Of each constraint: the team's cost per episode, its limit, and the share of episodes within it."""
    found = {}
    for name in played[0].constraints[0]:
        costs = np.array([sum(float(np.max(c[name])) for c in e.constraints) for e in played])
        found[name] = {
            "cost_mean": float(costs.mean()),
            "cost_interval": statistics.bootstrap_mean(costs),
            "violation_rate": float((costs > 0).mean()),
            "violation_upper": statistics.upper_bound(int((costs > 0).sum()), len(costs)),
        }
        if name in limits:
            found[name] |= {"limit": limits[name], "limit_satisfied_rate": float((costs <= limits[name]).mean())}
    return found


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
