"""A run is played behind faults: late actions, lost and noisy observations, another gain, agents out of step."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from ringfence.errors import UserError, whole_number
from ringfence.evaluation.evaluate import Split, about
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.faults import Faults
from ringfence.loading.resolve import resolve
from ringfence.loading.spec import PolicySpec
from ringfence.training.runs import Run, write_json
from ringfence.utils.compilation import keep_programs
from ringfence.utils.files import writable
from ringfence.utils.precision import in_float32

FILE = "stress.json"  # in the run folder, beside results.json: a table of results has no faults
MAX_AGE = 8  # steps up to which a compensating guard makes good for observations that were lost


@in_float32
def stress(
    run: Run | str,
    faults: Faults | Mapping[str, Any] | None = None,
    *,
    episodes: int = 100,
    split: Split = "test",
    planner: str = "default",
    checkpoint: int | None = None,
    compensate: bool = False,
    quiet: bool = True,
    **options: Any,
) -> dict[str, Any]:
    """Evaluate a run behind faults, on the same resets as `evaluate`, and add the result to its stress.json.

    faults: a `Faults`, or its fields by name. `compensate` tells the guard of the delay, and that observations may be
    old where they are dropped; a guard that is not told does not know. Other options are as in `load`. Without faults
    the numbers are those of `evaluate`.
    """
    faults = faults if isinstance(faults, Faults) else Faults.of(faults or {})
    if compensate:
        options |= compensation(faults, options)
    keep_programs()
    whole_number("episodes", episodes, 1, 10**7)
    resolved = resolve(PolicySpec.of(run, checkpoint=checkpoint, planner=planner, **options))
    file = writable(resolved.run.path / FILE)
    kept = json.loads(file.read_text()) if file.exists() else {}
    name = f"{resolved.variant(split)} behind {faults.name}"
    seed = resolved.run.config["seed"]
    result, _ = evaluate_policy(
        resolved.team, resolved.job.task, episodes, split, seed, 0, f"{resolved.job.task.name} {name}", quiet, faults
    )
    result |= {"variant": resolved.variant(split), "step": resolved.step, "faults": dataclasses.asdict(faults)}
    result |= about(resolved)
    write_json(file, kept | {name: result})
    return result


def compensation(faults: Faults, options: Mapping[str, Any]) -> dict[str, Any]:
    """What a guard is told of faults, as its options."""
    guarded = options.get("guard", "none") != "none"
    if not guarded:
        raise UserError("compensate is read by nothing without a guard; name one with guard=, e.g. shield.")
    found = {"delay": faults.delay, "max_age": MAX_AGE if faults.drop else 0}
    twice = sorted(found.keys() & options.keys())
    if twice:
        raise UserError(f"compensate and {twice[0]} both tell the guard of it; give one of them.")
    return {name: value for name, value in found.items() if value}
