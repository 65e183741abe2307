"""A run is played behind faults: late actions, lost and noisy observations, another gain, agents out of step."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ringfence.envs.episode import Cost
from ringfence.errors import UserError, whole_number
from ringfence.evaluation.certificate import digest
from ringfence.evaluation.compensation import compensated_spec
from ringfence.evaluation.evaluate import Split, about
from ringfence.evaluation.play import name_of, play
from ringfence.evaluation.protocol import evaluate_policy
from ringfence.faults import Faults
from ringfence.loading.resolve import load_job, resolve
from ringfence.loading.spec import PolicySpec
from ringfence.training.runs import Run, add_entry
from ringfence.utils import schemas
from ringfence.utils.compilation import keep_programs
from ringfence.utils.files import writable
from ringfence.utils.precision import in_float32

FILE = "stress.json"  # in the run folder, beside results.json: a table of results has no faults
STRESSED_ELSEWHERE = (
    "so `ringfence stress` has nothing to play in; name a simulator of your own: `ringfence stress RUN --env "
    "FILE.py:NAME --delay 2`."
)


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
    make_env: Callable[[], Any] | None = None,
    cost: Cost | None = None,
    quiet: bool = True,
    **options: Any,
) -> dict[str, Any]:
    """Evaluate a run behind faults, on the same resets as `evaluate`, and add the result to its stress.json.

    With `make_env` it is played in a simulator of one's own, and `cost` is of its infos, both as in `play`.

    faults: a `Faults`, or its fields by name. `compensate` tells the guard of the delay, that observations may be old
    where they are dropped, that actions are held where agents act in turn, and what others can do meanwhile; by
    itself a guard knows none of it. Other options are as in `load`. Without faults the numbers are those of `evaluate`.
    """
    faults = faults if isinstance(faults, Faults) else Faults.of(faults or {})
    options |= {"checkpoint": checkpoint, "planner": planner}
    spec = PolicySpec.of(run, **options)
    how: dict[str, Any] = {"episodes": episodes, "split": split, "compensate": compensate, "quiet": quiet}
    if make_env is None:
        if cost is not None:
            raise UserError("cost is of the infos of a simulator of one's own; give make_env=, or leave cost out.")
        return stress_spec(spec, faults, **how)
    file = writable(Run.of(run).path / FILE)
    result = play(run, make_env, faults=faults, cost=cost, **how, **options)
    result |= {"faults": dataclasses.asdict(faults), "asked": spec.name, "compensated": compensate}
    result |= {"simulator": name_of(make_env)}
    return _added(file, result, f"{result['variant']} in {result['simulator']}", faults)


def stress_spec(
    spec: PolicySpec,
    faults: Faults,
    *,
    episodes: int = 100,
    split: Split = "test",
    compensate: bool = False,
    quiet: bool = True,
) -> dict[str, Any]:
    """`stress` of what a spec names."""
    keep_programs()
    whole_number("episodes", episodes, 1, 10**7)
    check_simulator(spec, STRESSED_ELSEWHERE)
    resolved = resolve(compensated_spec(spec, faults) if compensate else spec)
    file = writable(resolved.run.path / FILE)
    results(resolved.run)  # a damaged file is refused before anything is played
    name = f"{resolved.variant(split)} behind {faults.name}" + (", which it knows" if compensate else "")
    seed = resolved.run.config["seed"]
    result, _ = evaluate_policy(
        resolved.team, resolved.job.task, episodes, split, seed, 0, f"{resolved.job.task.name} {name}", quiet, faults
    )
    result |= {"variant": resolved.variant(split), "step": resolved.step, "faults": dataclasses.asdict(faults)}
    result |= {"asked": spec.name, "compensated": compensate} | about(resolved)
    if resolved.guard is not None:
        result["digests"] = {"policy": digest(resolved.proposal), "world": digest(resolved.guard.world)}
    return _added(file, result, resolved.variant(split), faults)


def _added(file: Path, result: dict[str, Any], played: str, faults: Faults) -> dict[str, Any]:
    """The result, beside the others of a run by what was played."""
    name = f"{played} behind {faults.name}" + (", which it knows" if result["compensated"] else "")
    add_entry(file, lambda: results(Run(file.parent)), name, result)
    return result


def check_simulator(spec: PolicySpec, remedy: str) -> None:
    """Refuse, before a guard asks for its World, a run of data that has no simulator here."""
    if spec.run is None:
        return
    task = load_job(spec.run, spec.agents).task
    if task.env is None:
        raise UserError(f"Task '{task.name}' exists only as data, {remedy}")


def results(run: Run) -> dict[str, dict[str, Any]]:
    """What a run's stress.json holds, by who played and behind which faults; nothing where there is none."""
    file = run.path / FILE
    return schemas.read(file, dict[str, dict[str, Any]], "is damaged; delete that file") if file.exists() else {}
