"""A policy judged by logs alone, without a simulator: what it would do in logged states, where that leads as a World of
these logs foresees it, and what it is worth, by fitted Q evaluation and played in that World.

Nobody grades himself: the World that judges is fitted to the logs that are given, with a seed of its own, and is not
the one that guards. How far each number can be believed, on tasks whose truth is known: docs/judging.md.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError, whole_number
from ringfence.evaluation import statistics
from ringfence.evaluation.ope.fqe import worth
from ringfence.evaluation.ope.logged_actions import played
from ringfence.evaluation.ope.logs import Logs
from ringfence.guards import Danger
from ringfence.guards.policy import Guarded
from ringfence.loading.resolve import load
from ringfence.logs.store import EpisodeStore
from ringfence.problem import normalise
from ringfence.problem.homogeneous import Each
from ringfence.proposals.base import held
from ringfence.training import worlds
from ringfence.training.job import Job
from ringfence.training.runs import Run
from ringfence.types import Array, Key
from ringfence.world import World

AT_ONCE = 512  # states that a policy is asked about together
CHANGED = 0.05  # of the actions' range of 2: what counts as stepping in


def judge(
    run: Run | str,
    store: EpisodeStore,
    *,
    judge_world: World | None = None,
    states: int = 3000,
    transitions: int = 20_000,
    updates: int = 3000,
    members: int = 5,
    discount: float = 0.95,
    ahead: int = 3,
    episodes: int = 128,
    steps: int = 100,
    planner: str = "plain",
    compare: bool = True,
    seed: int = 0,
    quiet: bool = True,
    **options: Any,
) -> dict[str, Any]:
    """What logs say of a policy: a run as `evaluate.load` plays it (guard, danger, sight, world, ...).

    store: logs of the run's task, best those that it was not trained on (`trained_on` of the result says whether it
    was). `judge_world` is the World that foresees (default: fitted to these logs with seed + 1). `states` logged states
    are asked about; `transitions` teach the evaluation of Q, by `members` networks on resampled episodes, whose 95 %
    interval is Student's; `compare` evaluates what the logs did, too. Policies are asked with an empty memory: plans
    under way and adapted margins are not there.

    In `episodes` of up to `steps` steps it is played in the judging World, with its memory (`played`; 0 episodes: not).

    Keys: `return`, `cost` and `return_of_logs`, `cost_of_logs`: {mean, low, high}, discounted sums from the logged
    starts; `foreseen_unsafe`: share of safe logged states from which danger is foreseen within `ahead` steps, and of
    logs; `not_surely_safe`: share from which the foreseen margin is below the calibrated one, that all but `missed` of
    entries into danger stay below, with an upper bound over episodes; `steps_in`, `infeasible`, `strange`: shares of
    states in which a guard changed, could not do, or did not know; `unknown`: share in which the judging World's
    forward models are further apart than in the logs; `apart`: rms distance of the policy's actions from the logged
    ones, in deviations of the latter.
    """
    for name, value in (("states", states), ("transitions", transitions), ("updates", updates), ("ahead", ahead)):
        whole_number(name, value, 1)
    whole_number("episodes", episodes, 0)
    whole_number("steps", steps, 1)
    whole_number("members", members, 2, 100)
    if not 0 <= discount < 1:
        raise UserError(f"discount={discount} must be from 0 to below 1.")
    run = run if isinstance(run, Run) else Run(Path(run))
    check(run, store)
    job, policy = load(run, planner=planner, **options)
    policy = policy.one if isinstance(policy, Each) else policy
    judging = judge_world or worlds.fit(store, seed=seed + 1, sight=options.get("sight"), quiet=quiet)
    if not (judging.card.data.content == store.content and judging.spec.action_dim == store.actions.shape[2]):
        raise UserError("judge_world is of other logs; leave it out, and one is fitted to these.")
    logs = job.task.logs(store)
    told = Logs(logs, judging)
    ask = _asker(policy, logs, judging, job, ahead, seed)

    rng = np.random.default_rng(seed)
    picked = np.sort(rng.choice(logs.steps, min(states, logs.steps), replace=False))
    found = ask(told.row[picked])
    result = {
        "task": job.task.name,
        "algorithm": job.algorithm.name,
        "guard": options.get("guard", "none"),
        "logs": {"episodes": logs.episodes, "steps": logs.steps, "content": store.content},
        "trained_on": run.config["data"].get("content") == store.content,
        "discount": discount,
        "ahead": ahead,
        **_conduct(told, picked, found, judging),
        **_dangers(told, picked, found, judging, ahead),
    }
    key = jax.random.key(seed)
    needs_state = logs.state is not None and job.widths[1] > 0
    result["played"] = (
        played(policy, told, logs, judging, needs_state, jax.random.fold_in(key, 1), episodes, steps)
        if episodes
        else None
    )
    learned = rng.choice(logs.steps, min(transitions, logs.steps), replace=False)
    starts = rng.permutation(told.starts)[:2000]
    after, first = ask(told.row[learned] + 1)["action"], ask(starts)["action"]
    result |= worth(told, learned, after, starts, first, "", key, members, updates, discount, quiet)
    if not compare:
        return result
    logged = told.actions[np.minimum(learned + 1, told.last_step[learned])]
    begun = told.actions[told.step_of_start[np.searchsorted(told.starts, starts)]]
    return result | worth(told, learned, logged, starts, begun, "_of_logs", key, members, updates, discount, quiet)


def words(told: dict[str, Any]) -> list[str]:
    """A judgement as a person reads it."""
    whom = f"{told['algorithm']} under guard={told['guard']}, by {told['logs']['episodes']:,} logged episodes"
    lines = [whom + (" that it was trained on: the best case" if told["trained_on"] else "")]
    for what in ("return", "cost"):
        mine, theirs = told[what], told.get(what + "_of_logs")
        beside = f"; the logs {theirs['mean']:.4g} ({theirs['low']:.4g} to {theirs['high']:.4g})" if theirs else ""
        lines.append(
            f"{what}, discounted by {told['discount']:g}: {mine['mean']:.4g} ({mine['low']:.4g} to {mine['high']:.4g})"
            + beside
        )
    if (mine := told["played"]) is not None:
        dangerous = mine["danger"] and (
            f", {mine['danger']['mean']:.3g} dangerous steps (the logs {mine['danger_of_logs']:.3g})"
        )
        lines.append(
            f"played for {mine['steps']} steps in the World of these logs: return {mine['return']['mean']:.4g} "
            f"({mine['return']['low']:.4g} to {mine['return']['high']:.4g}; the logs {mine['return_of_logs']:.4g})"
            f"{dangerous or ''}; it does not know {100 * mine['lost']:.2g} % of the way"
        )
    if told["foreseen_unsafe"] is not None:
        lines.append(
            f"danger is foreseen within {told['ahead']} steps from {100 * told['foreseen_unsafe']:.2g} % of the safe "
            f"states (the logs: {100 * told['foreseen_unsafe_of_logs']:.2g} %); {100 * told['not_surely_safe']:.2g} % "
            f"are not surely safe (the logs: {100 * told['not_surely_safe_of_logs']:.2g} %)"
        )
    if told["steps_in"] is not None:
        lines.append(
            f"the guard steps in in {100 * told['steps_in']:.2g} % of the states, and cannot do what it should in "
            f"{100 * told['infeasible']:.2g} %"
        )
    lines.append(
        f"{100 * told['unknown']:.2g} % of its actions lead where these logs do not tell; they are {told['apart']:.2g} "
        "deviations from the logged ones"
    )
    return lines


def check(run: Run, store: EpisodeStore) -> None:
    """Refuse logs of another task."""
    told = run.config
    if told["task"] != store.card["task"]:
        raise UserError(
            f"The run is of '{told['task']}', the logs are of '{store.card['task']}'; judge it by logs of its own task."
        )


def _asker(policy, logs: EpisodeStore, world: World, job: Job, ahead: int, seed: int) -> Callable:
    """A function of rows (M,) to what the policy does there: `action` (M, N, A) and the actions `plan` (M, K, N, A)
    that it means to take along what the judging World foresees, in [−1, 1]; what its guard says."""
    spec = world.spec

    @jax.jit
    def of(policy, seen: Array, state: Array | None, key: Key) -> dict[str, Array]:
        ka, kp = jax.random.split(key)
        memory, step = policy.act(policy.start(len(seen)), seen, state, ka)
        action = normalise.to_unit(step.action, spec.action_low, spec.action_high)
        out = {"action": action} | {k: step.info[k] for k in ("infeasible", "strange") if k in step.info}
        if isinstance(policy, Guarded):
            _, wanted, _ = policy.proposed(policy.start(len(seen))["inner"], seen, state, ka)
            plan = memory["last"]
            out["changed"] = jnp.abs(wanted - action[:, None, None])[:, :, 0].max((-2, -1)).min(-1) > CHANGED
        elif hasattr(policy, "propose"):
            plan = policy.propose(policy.start(len(seen)), seen, state, kp, 1, ahead, world)[1][:, 0]
        else:
            plan = held(action, ahead)[:, 0]
        rest = jnp.broadcast_to(plan[:, -1:], (len(seen), ahead, *plan.shape[2:]))
        plan = jnp.concatenate([action[:, None], plan[:, 1:], rest], 1)[:, :ahead]
        return out | {"plan": plan}

    def ask(rows: np.ndarray) -> dict[str, np.ndarray]:
        parts, root = [], jax.random.key(seed)
        for k in range(0, len(rows), AT_ONCE):
            some = np.resize(rows[k : k + AT_ONCE], AT_ONCE)  # one shape, one program
            state = None if logs.state is None or job.widths[1] == 0 else jnp.asarray(logs.state[some])
            told = of(policy, jnp.asarray(logs.observations[some]), state, jax.random.fold_in(root, k))
            parts.append({name: np.asarray(v)[: len(rows) - k] for name, v in told.items()})
        return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}

    return ask


def _conduct(told: Logs, picked: np.ndarray, found: dict, world: World) -> dict[str, float | None]:
    """What it does in logged states, beside what was done."""
    logged, done = told.actions[picked], found["action"]
    spread = jax.jit(lambda d, x, a: d.step(x, a)[1].max(-1))
    unknown = np.asarray(spread(world.dynamics, told.x[told.row[picked]], jnp.asarray(done))) > float(world.strange)
    share = lambda name: float(found[name].any(-1).mean() if found[name].ndim > 1 else found[name].mean())  # noqa: E731
    return {
        "steps_in": share("changed") if "changed" in found else None,
        "infeasible": share("infeasible") if "infeasible" in found else None,
        "strange": share("strange") if "strange" in found else None,
        "unknown": float(unknown.mean()),
        "apart": float(np.sqrt(((done - logged) ** 2).mean()) / max(float(logged.std()), 1e-6)),
    }


def _dangers(told: Logs, picked: np.ndarray, found: dict, world: World, ahead: int) -> dict[str, Any]:
    """Where its plans lead from logged states that are not unsafe already, beside where the logs went on to."""
    if world.barrier is None:
        return {"foreseen_unsafe": None}
    safe = (picked == told.step_of_start[told.episode[picked]]) | (told.costs[np.maximum(picked - 1, 0)] == 0)
    later = np.minimum(picked[:, None] + np.arange(ahead), told.last_step[picked][:, None])

    @jax.jit
    def worst(danger: Danger, x: Array, plan: Array) -> Array:
        def step(x, action):
            after, spread = danger.world.dynamics.step(x, action)
            return after, (after, spread)

        rows, spread = jax.lax.scan(step, x, jnp.moveaxis(plan, 1, 0))[1]
        rows = jnp.concatenate([x[:, None], jnp.moveaxis(rows, 0, 1)], 1)
        return danger.along(rows, jnp.moveaxis(spread, 0, 1)).min((1, 2, 3))

    scores = world.card.barrier
    danger, x = Danger(world, "learned", None, False), told.x[told.row[picked]]
    by_policy = np.asarray(worst(danger, x, jnp.asarray(found["plan"])))[safe]
    by_logs = np.asarray(worst(danger, x, jnp.asarray(told.actions[later])))[safe]
    episodes = told.episode[picked][safe]
    doubtful = np.unique(episodes[by_policy < 1])
    return {
        "foreseen_unsafe": float((by_policy < 0).mean()),
        "foreseen_unsafe_of_logs": float((by_logs < 0).mean()),
        "not_surely_safe": float((by_policy < 1).mean()),
        "not_surely_safe_of_logs": float((by_logs < 1).mean()),
        "missed": None if scores is None or scores.warning else scores.missed,
        "episodes_not_surely_safe": len(doubtful) / len(np.unique(episodes)),
        "episodes_upper": statistics.upper_bound(len(doubtful), len(np.unique(episodes))),
        "margins": {"policy": _quantiles(by_policy), "logs": _quantiles(by_logs)},
    }


def _quantiles(x: np.ndarray) -> list[float]:
    return [round(float(v), 3) for v in np.quantile(x, np.linspace(0, 1, 41))]
