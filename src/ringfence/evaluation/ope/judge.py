"""`judge`, as off-policy evaluation was called in 0.1.0."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from ringfence.evaluation.ope.estimate import ope
from ringfence.evaluation.ope.result import ModelRollout, OPEResult, Safety
from ringfence.logs.store import EpisodeStore
from ringfence.training.runs import Run
from ringfence.utils.renamed import deprecated, renamed

ARGUMENTS = {
    "judge_world": "evaluation_world",
    "members": "num_ensemble",
    "episodes": "rollout_episodes",
    "steps": "rollout_steps",
}


def judge(run: Run | str, store: EpisodeStore, **given: Any) -> dict[str, Any]:
    """`ringfence.ope` under the names of 0.1.0, for one release."""
    deprecated("ringfence.judge", "ringfence.ope")
    return _judgement(ope(run, store, **renamed(given, ARGUMENTS, "judge", warn=False)))


def _judgement(result: OPEResult) -> dict[str, Any]:
    behaviour = result.behaviour
    found = {
        "task": result.task,
        "algorithm": result.algorithm,
        "guard": result.guard,
        "logs": asdict(result.logs),
        "trained_on": result.trained_on,
        "discount": result.discount,
        "ahead": result.ahead,
        "steps_in": behaviour.intervention_rate,
        "infeasible": behaviour.infeasible_rate,
        "strange": behaviour.guard_ood_rate,
        "unknown": behaviour.ood_rate,
        "apart": behaviour.action_rmse,
        **_dangers(result.safety),
        "played": None if result.rollout is None else _played(result.rollout),
        "return": asdict(result.values.returns),
        "cost": asdict(result.values.costs),
    }
    if result.values_of_logs is not None:
        found["return_of_logs"] = asdict(result.values_of_logs.returns)
        found["cost_of_logs"] = asdict(result.values_of_logs.costs)
    return found


def _dangers(safety: Safety | None) -> dict[str, Any]:
    if safety is None:
        return {"foreseen_unsafe": None}
    return {
        "foreseen_unsafe": safety.predicted_violation_rate,
        "foreseen_unsafe_of_logs": safety.predicted_violation_rate_of_logs,
        "not_surely_safe": safety.margin_violation_rate,
        "not_surely_safe_of_logs": safety.margin_violation_rate_of_logs,
        "missed": safety.miscoverage,
        "episodes_not_surely_safe": safety.margin_violation_episodes,
        "episodes_upper": safety.margin_violation_episodes_upper,
        "margins": {"policy": list(safety.margins), "logs": list(safety.margins_of_logs)},
    }


def _played(rollout: ModelRollout) -> dict[str, Any]:
    return {
        "episodes": rollout.episodes,
        "steps": rollout.steps,
        "return": asdict(rollout.returns),
        "danger": None if rollout.unsafe_steps is None else asdict(rollout.unsafe_steps),
        "episodes_in_danger": rollout.violation_rate,
        "lost": rollout.ood_rate,
        "return_of_logs": rollout.returns_of_logs,
        "danger_of_logs": rollout.unsafe_steps_of_logs,
    }
