"""What a guard is told of faults: it then makes good for late actions, old observations and actions that are held."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError
from ringfence.faults import Faults
from ringfence.guards import Guard
from ringfence.guards.correction import ASKED
from ringfence.guards.policy import rows_foreseen
from ringfence.loading.resolve import resolve
from ringfence.loading.spec import PolicySpec
from ringfence.training.runs import Run
from ringfence.world import World

# Options by which a guard knows of faults.
COMPENSATION = ("delay", "max_age", "hold", "others_acceleration", "horizon")
GuardOf = Callable[[PolicySpec], Guard]
MAX_AGE = 8  # steps up to which a compensating guard makes good for observations that were lost


def compensated(
    run: Run | str | None, faults: Faults, options: Mapping[str, Any], guard_of: GuardOf | None = None
) -> dict[str, Any]:
    """Options of a guard that knows of faults; `guard_of` makes that of a spec without a run."""
    compensation(faults, options)  # what cannot be is refused in these words first
    return {**options, **_missing_options(PolicySpec.of(run, **options), faults, guard_of or _guard_of_run)}


def compensated_spec(spec: PolicySpec, faults: Faults) -> PolicySpec:
    """The same choices with a guard that knows of faults."""
    return spec.with_guard_options(**_missing_options(spec, faults, _guard_of_run))


def _guard_of_run(spec: PolicySpec) -> Guard:
    guard = resolve(spec).guard
    assert guard is not None, "checked before"
    return guard


def _missing_options(spec: PolicySpec, faults: Faults, guard_of: GuardOf) -> dict[str, Any]:
    """Options of a spec's guard that it lacks to know of faults, for the World that it reads."""
    given = dict(spec.guard_options)
    found = compensation(faults, {"guard": spec.guard, **given})
    late = bool({"delay", "max_age"} & {*found, *given})
    seldom = _steps_between(faults) > 1 and not {"horizon", "horizon_seconds"} & {*given}
    if not late and not seldom:
        return found
    guard = guard_of(spec)
    own = guard.world.card.data.action_delay  # of the machine itself
    if "delay" in found:
        found["delay"] += own
    if "max_age" in found:
        found["max_age"] = min(found["max_age"], max(rows_foreseen(guard.world) - found.get("delay", own), 0))
    if late and "others_acceleration" not in given:
        found["others_acceleration"] = own_acceleration(guard.world)
    rows = min(math.ceil(ASKED * _steps_between(faults) - 1e-9), rows_foreseen(guard.world))
    if seldom and rows > guard.options.horizon:
        found["horizon"] = rows
    return found


def _steps_between(faults: Faults) -> float:
    """Steps from one decision to the next that is another, or from one observation to the next, in the mean."""
    return max(1 / (1 - faults.asynchrony), 1 / (1 - faults.drop))


def known_to_guards(faults: Faults) -> bool:
    """Whether a guard that knows of these faults has other options than one that does not."""
    return bool(compensation(faults, {"guard": "shield"})) or _steps_between(faults) > 1


def compensation(faults: Faults, options: Mapping[str, Any]) -> dict[str, Any]:
    """What faults alone say to a guard, as its options."""
    guarded = options.get("guard", "none") != "none"
    if not guarded:
        raise UserError("compensate is read by nothing without a guard; name one with guard=, e.g. shield.")
    # Steps by which what is done is late in the mean, where an action may be late by up to `jitter`, each as likely,
    # and a newer one overtakes it: the sum of the chances that none of the last k has arrived.
    left = [(faults.jitter - k) / (faults.jitter + 1) for k in range(faults.jitter)]
    delay = faults.delay + round(float(np.cumprod(left).sum()))
    found = {
        "delay": delay,
        "max_age": max(MAX_AGE - delay, 0) if faults.drop else 0,
        "hold": round(1 / (1 - faults.asynchrony)),
    }
    twice = sorted(found.keys() & options.keys())
    if twice:
        raise UserError(f"compensate and {twice[0]} both tell the guard of it; give one of them.")
    usual = {"delay": 0, "max_age": 0, "hold": 1}
    return {name: value for name, value in found.items() if value != usual[name]}


def own_acceleration(world: World) -> float:
    """m/s² that an agent can change its velocity by, as the World predicts it of one in the mean of the logs; 0 where
    it does not know how long a step takes. Others of its kind can do as much."""
    names = world.map.names
    speeds = [names.index(f"own.v{axis}") for axis in "xyz" if f"own.v{axis}" in names]
    if world.map.dt is None or not speeds:
        return 0.0
    spec = world.spec
    pushes = np.concatenate([np.eye(spec.action_dim), -np.eye(spec.action_dim)]).astype(np.float32)
    before = jnp.broadcast_to(world.dynamics.mean, (len(pushes), spec.n_agents, len(names)))
    before = before.at[..., np.array(speeds)].set(0.0)
    action = jnp.broadcast_to(jnp.asarray(pushes)[:, None], (len(pushes), spec.n_agents, spec.action_dim))
    after, _ = world.dynamics.step(before, action)
    change = np.asarray((after - before)[..., np.array(speeds)])
    return round(float(np.linalg.norm(change, axis=-1).max()) / world.map.dt, 2)
