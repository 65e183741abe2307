"""A run folder is evaluated, and keeps the result."""

from __future__ import annotations

import dataclasses
import sys
from typing import Literal

import jax
import numpy as np

from ringfence.errors import whole_number
from ringfence.evaluation import recordings
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.guards import Guarded
from ringfence.loading.resolve import Asked, _guard_of, asked, loaded, of_team, variant_name
from ringfence.proposals.planner import Planner
from ringfence.training import worlds
from ringfence.training.job import Job
from ringfence.training.runs import Run
from ringfence.types import Policy
from ringfence.utils.files import writable


def evaluate(
    run: Run | str,
    *,
    episodes: int = 200,
    split: Literal["test", "validation"] = "test",
    planner: str = "plain",
    record: int = 0,
    quiet: bool = True,
    step: int | None = None,
    **options,
) -> dict:
    """Evaluate a run folder and add the result to its results.json, under the variant's name.

    `planner`, `guard`, `danger`, `sight`, `world` and other options are as in `load`. The result tells the `step` of
    the checkpoint that was played; where training is unfinished, a line on stderr says so.
    """
    run, how = Run.of(run), asked(planner, **options)
    whole_number("episodes", episodes, 1, 10**7)
    whole_number("record", record)
    job, policy, at = loaded(run, step, how)
    _ = run.results, writable(run.path / "results.json")  # what cannot be kept is refused before anything is played
    if step is None and at < job.config.steps:
        print(f"'{run.path}' is at step {at} of {job.config.steps}; its training is unfinished.", file=sys.stderr)
    variant = variant_name(job, policy, how, split)
    variant += "" if step is None else f"@step{step}"
    seed = run.config["seed"]
    label = f"{job.algorithm.name} {variant} {job.task.name} seed {seed}"
    result, played = evaluate_policy(of_team(job, policy), job.task, episodes, split, seed, record, label, quiet)
    result |= {"variant": variant, "step": at} | about(run, job, policy, how)
    run.add_result(variant, result)
    recordings.write(run.path, variant, played, record)
    return result


def about(run: Run, job: Job, policy: Policy, how: Asked) -> dict:
    """What a result says of who played: algorithm, planner, guard, with all their options."""
    inner, guards = policy.proposal if isinstance(policy, Guarded) else policy, _guard_of(policy)
    plans = isinstance(inner, Planner)
    return {
        "algorithm": job.algorithm.name,
        "provenance": run.config["data"]["provenance"],
        "planner": how.planner if plans else "plain",
        "options": dataclasses.asdict(inner.options) if plans else {},
        "guard": how.guard if guards else "none",
        "danger": how.danger if guards else "none",
        "sight": worlds.sight_of(job.task, how.sight),
        "agents": job.team,
        "guard_options": dataclasses.asdict(guards) if guards else {},
        **({"world_settings": policy.guard.world.card["settings"]} if guards else {}),
        "train_seconds": sum(r["seconds"] for r in run.metrics),
        "parameters": _parameters(policy),
    }


def _parameters(policy: Policy) -> int:
    return int(sum(np.size(x) for x in jax.tree.leaves(policy)))
