"""The naive driver of the proving ground: straight to the goal at full speed, whoever is in the way. Nothing is
learned; a guard shows by it what becomes of somebody who never saw the logs."""

from __future__ import annotations

from ringfence.algos.untrained import untrained
from ringfence.datasets import registry
from ringfence.datasets.recipes.proving import Naive
from ringfence.envs import System
from ringfence.errors import UserError
from ringfence.types import Spec


def _naive(spec: Spec) -> Naive:
    """The driver of a task, whose bodies it knows."""
    task = registry.TASKS.get(spec.task)
    if task is None or not isinstance(task.env, System):
        raise UserError(f"The naive driver knows the bodies of the proving ground, not those of '{spec.task}'.")
    return Naive(task.env)


NAIVE = untrained("naive", _naive)
