"""What a policy does in logged states, with the carry of an episode's first step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.evaluation.ope.logs import Logs
from ringfence.evaluation.ope.result import Behaviour
from ringfence.guards.policy import Guarded
from ringfence.problem import normalise
from ringfence.proposals.base import held, in_bounds_of
from ringfence.types import Array, Key, Proposes, PyTree
from ringfence.utils.precision import on_device
from ringfence.world import World

BATCH = 512  # states that a policy is asked in together
CHANGED = 0.05  # of the actions' range of 2: what counts as an intervention


@dataclass(frozen=True)
class Responses:
    """What a policy does in M logged states; what only a guard says is None without one."""

    action: np.ndarray  # (M, N, A) in [−1, 1]
    plan: np.ndarray  # (M, K, N, A) that it means to take along what the World predicts
    changed: np.ndarray | None = None  # (M,) bool: the guard changed the action
    infeasible: np.ndarray | None = None  # (M,) bool
    ood: np.ndarray | None = None  # (M,) bool: the guard's World knows nothing there


class Respondent:
    """A policy that is asked in logged states; a World predicts where its plans lead, `ahead` steps."""

    def __init__(self, policy: Any, logs: Logs, world: World, reads_state: bool, ahead: int, seed: int):
        self.policy = policy
        self.logs = logs
        self.world = world
        self.reads_state = reads_state
        self.ahead = ahead
        self.seed = seed
        self._respond = jax.jit(_respond, static_argnames="ahead")

    def __call__(self, rows: np.ndarray) -> Responses:
        """The responses in the states of so many rows (M,)."""
        root = jax.random.key(self.seed)
        parts = []
        for first in range(0, len(rows), BATCH):
            some = np.resize(rows[first : first + BATCH], BATCH)  # one shape, one program
            store = self.logs.store
            seen = on_device(store.observations[some])
            state = on_device(store.state[some]) if self.reads_state and store.state is not None else None
            key = jax.random.fold_in(root, first)
            part = self._respond(self.policy, self.world, seen, state, key, ahead=self.ahead)
            parts.append({name: np.asarray(v)[: len(rows) - first] for name, v in part.items()})
        return Responses(**{name: np.concatenate([p[name] for p in parts]) for name in parts[0]})


def _respond(policy: Any, world: World, seen: Array, state: Array | None, key: Key, *, ahead: int) -> dict[str, Array]:
    """Fields of `Responses`."""
    spec = world.spec
    act_key, plan_key = jax.random.split(key)
    carry, step = policy.act(policy.initial_state(len(seen)), seen, state, act_key)
    action = normalise.to_unit(step.action, spec.action_low, spec.action_high)
    found = {"action": action} | {k: step.info[k] for k in ("infeasible", "ood") if k in step.info}
    if isinstance(policy, Guarded):
        _, wanted, _ = policy.proposed(policy.initial_state(len(seen))["inner"], seen, state, act_key)
        wanted = normalise.in_units_of(world.spec, policy.guard.world.spec, wanted)
        difference = jnp.abs(wanted - action[:, None, None])[:, :, 0].max((-2, -1))
        found["changed"] = difference.min(-1) > CHANGED
    plan = _plan(policy, carry, world, seen, state, action, plan_key, ahead)
    rest = jnp.broadcast_to(plan[:, -1:], (len(seen), ahead, *plan.shape[2:]))
    return found | {"plan": jnp.concatenate([action[:, None], plan[:, 1:], rest], 1)[:, :ahead]}


def _plan(
    policy: Any, carry: PyTree, world: World, seen: Array, state: Array | None, action: Array, key: Key, ahead: int
) -> Array:
    """(B, K, N, A): the guard's plan, else what the policy proposes, else its action held."""
    if isinstance(policy, Guarded):
        return normalise.in_units_of(world.spec, policy.guard.world.spec, carry["last"])
    if isinstance(policy, Proposes):
        own = getattr(policy, "spec", world.spec)
        moved = in_bounds_of(own, world)
        proposed = policy.propose(policy.initial_state(len(seen)), seen, state, key, 1, ahead, moved)[1][:, 0]
        return normalise.in_units_of(world.spec, own, proposed)
    return held(action, ahead)[:, 0]


def behaviour(logs: Logs, steps: np.ndarray, responses: Responses, world: World) -> Behaviour:
    """What was done at logged steps (M,), beside what the logs did."""
    logged = logs.actions[steps]
    done = responses.action
    spread = jax.jit(lambda dynamics, x, action: dynamics.step(x, action)[1].max(-1))
    apart = np.asarray(spread(world.dynamics, logs.x[logs.row[steps]], done))
    rmse = np.sqrt(((done - logged) ** 2).mean())
    return Behaviour(
        intervention_rate=_share(responses.changed),
        infeasible_rate=_share(responses.infeasible),
        guard_ood_rate=_share(responses.ood),
        ood_rate=float((apart > float(world.ood_threshold)).mean()),
        action_rmse=float(rmse / max(float(logged.std()), 1e-6)),
    )


def _share(flags: np.ndarray | None) -> float | None:
    """Of the states (M,) or (M, N) in which somebody's flag is set."""
    if flags is None:
        return None
    return float(flags.any(-1).mean() if flags.ndim > 1 else flags.mean())
