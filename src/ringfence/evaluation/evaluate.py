"""A run folder is evaluated, and keeps the result."""

from __future__ import annotations

import dataclasses
import logging
from typing import Any, Literal

import jax
import numpy as np

from ringfence.errors import whole_number
from ringfence.evaluation import recordings
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.loading.resolve import Resolved, resolve
from ringfence.loading.spec import PolicySpec
from ringfence.proposals.guidance import guided_by
from ringfence.training import worlds
from ringfence.training.runs import Run
from ringfence.utils.compilation import keep_programs
from ringfence.utils.files import writable
from ringfence.utils.precision import in_float32

_log = logging.getLogger(__name__)

Split = Literal["test", "validation"]


@in_float32
def evaluate(
    run: Run | str,
    *,
    episodes: int = 200,
    split: Split = "test",
    planner: str = "default",
    num_recorded: int = 0,
    quiet: bool = True,
    checkpoint: int | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Evaluate a run folder and add the result to its results.json, under the variant's name.

    The first `num_recorded` episodes are kept for films. `planner`, `guard`, `barrier`, `execution`, `world` and other
    options are as in `load`. The result tells the `step` of the checkpoint that was played; where training is
    unfinished, a line on stderr says so.
    """
    return evaluate_spec(
        PolicySpec.of(run, checkpoint=checkpoint, planner=planner, **options),
        episodes=episodes,
        split=split,
        num_recorded=num_recorded,
        quiet=quiet,
    )


def evaluate_spec(
    spec: PolicySpec, *, episodes: int = 200, split: Split = "test", num_recorded: int = 0, quiet: bool = True
) -> dict[str, Any]:
    """`evaluate` of what a spec names."""
    keep_programs()
    whole_number("episodes", episodes, 1, 10**7)
    whole_number("num_recorded", num_recorded)
    resolved = resolve(spec)
    run = resolved.run
    job = resolved.job
    # What cannot be kept is refused before anything is played.
    _ = run.results
    writable(run.path / "results.json")
    if spec.checkpoint is None and resolved.step < job.config.num_updates:
        message = f"'{run.path}' is at step {resolved.step} of {job.config.num_updates}; its training is unfinished."
        _log.warning(message)
    variant = resolved.variant(split)
    seed = run.config["seed"]
    label = f"{job.algorithm.name} {variant} {job.task.name} seed {seed}"
    result, played = evaluate_policy(resolved.team, job.task, episodes, split, seed, num_recorded, label, quiet)
    command = ["eval", "--episodes", str(episodes), *split_words(split), *resolved.spec.words]
    result |= {"variant": variant, "command": command, "step": resolved.step} | about(resolved)
    run.add_result(variant, result)
    recordings.write(run.path, variant, played, num_recorded)
    return result


def split_words(split: str) -> list[str]:
    """The split as options of a command, where it is not the usual one."""
    return [] if split == "test" else ["--split", split]


def about(resolved: Resolved) -> dict[str, Any]:
    """What a result says of who played: algorithm, planner, guard, with all their options."""
    spec = resolved.spec
    run = resolved.run
    guard = resolved.guard
    options = resolved.plan_options
    of_world: dict[str, Any] = {}
    if guard is not None:
        card = guard.world.card
        of_world["world_settings"] = dataclasses.asdict(card.settings)
        of_world |= {"verdict": card.verdict.word} if card.verdict is not None else {}  # one of before has none
    return {
        "algorithm": resolved.job.algorithm.name,
        "spec": spec.name,
        "provenance": run.config["data"]["provenance"],
        "planner": spec.planner,
        "options": {} if options is None else dataclasses.asdict(options),
        **guided_by(resolved.proposal),
        "guard": "none" if guard is None else spec.guard,
        "barrier": "none" if guard is None else spec.barrier,
        "execution": worlds.execution_of(resolved.job.task, spec.execution),
        "agents": resolved.job.team,
        "guard_options": {} if guard is None else dataclasses.asdict(guard.options),
        **of_world,
        "train_seconds": sum(r["seconds"] for r in run.metrics),
        "parameters": int(sum(np.size(x) for x in jax.tree.leaves(resolved.policy))),
    }
