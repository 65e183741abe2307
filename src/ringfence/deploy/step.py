"""One joint action of a policy as a function of arrays alone, which says so where its guard cannot judge what it is
given."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from ringfence.deploy.jaxpr import Interpreter, bind, draws, live, value, values_of
from ringfence.errors import UserError
from ringfence.guards import Guarded
from ringfence.problem.homogeneous import agent_policy
from ringfence.training.job import Job
from ringfence.types import Array, Key, Policy, Spec, with_cost
from ringfence.utils.pytrees import named_leaves

SEEN = ("observations", "state")  # inputs that have to be finite; a cost is NaN where nobody knows it
LAST = "action"  # what a guarded file remembers beside its policy's carry
INFO = ("clearance", "next_clearance", "infeasible", "ood", "chosen")  # of what a policy tells, what is one number


@dataclass(frozen=True)
class Entry:
    """One input or output of the function."""

    name: str
    shape: tuple[int, ...]
    dtype: str  # float32, int32 or bool; float64 of what is moved


@dataclass(frozen=True, eq=False)
class Step:
    """One joint action as a function of arrays alone, in the order of `inputs`, and what its carry begins with."""

    call: Callable[..., list[Array]]
    inputs: tuple[Entry, ...]
    outputs: tuple[Entry, ...]
    initial: dict[str, np.ndarray]  # by the inputs' names
    draw: Callable[[Key], list[Array]]  # the noise that `Controller` would draw by a key
    origins: dict[str, np.ndarray] = field(default_factory=dict)  # what a file takes from inputs first, by their names

    @property
    def avals(self) -> list[jax.ShapeDtypeStruct]:
        return [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in self.inputs]

    @property
    def measured(self) -> tuple[Entry, ...]:
        """The inputs of a file."""
        return tuple(dataclasses.replace(x, dtype="float64") if x.name in self.origins else x for x in self.inputs)


def constraints_of(policy: Policy) -> list[str]:
    """The named ones that a guard's margins follow apart."""
    inner = agent_policy(policy)
    return list(inner.guard.barrier.limits) if isinstance(inner, Guarded) else []


@dataclass(frozen=True, eq=False)
class _Traced:
    """One joint action as programs: the one that draws, and the one that is given its noise instead."""

    drawing: core.ClosedJaxpr  # (key, *seen, *carry) -> (*results, *carry)
    given: core.ClosedJaxpr  # (key, *seen, *noise, *carry) -> (*results, *carry)
    seen: dict[str, jax.ShapeDtypeStruct]
    noise: dict[str, jax.ShapeDtypeStruct]
    carry: dict[str, Array]  # what it begins with
    results: list[str]  # the action and what is known of it

    @property
    def inputs(self) -> dict[str, Any]:
        """Arrays or their shapes, by name; the key, which comes first, is no input of a file."""
        return self.seen | self.noise | self.carry

    @property
    def outputs(self) -> list[str]:
        return [*self.results, *(name.replace("memory.", "next.", 1) for name in self.carry)]


def step_of(job: Job, policy: Policy) -> Step:
    """One joint action of a policy in one environment, without what nothing reads, by finite numbers alone."""
    traced = _trace(job, policy)
    program = traced.given.jaxpr
    names = list(traced.inputs)
    equations, used = live(program, ["key", *names], list(traced.carry), len(traced.results))
    if "key" in used:
        raise UserError(
            "This policy draws more than normal noise, and a file holds nothing that draws; play it with "
            "ringfence.Controller."
        )
    used -= _constant_carry(traced)
    inputs = [k for k, name in enumerate(names) if name in used]
    outputs = [k for k, name in enumerate(traced.outputs) if k < len(traced.results) or _before(name) in used]
    unread = {variable: traced.carry[name] for name, variable in zip(names, program.invars[1:]) if name in traced.carry}
    constants = _shared(values_of(traced.given)) | unread

    def call(*arrays: Array) -> list[Array]:
        known = constants | {program.invars[1 + k]: array for k, array in zip(inputs, arrays)}
        for equation in equations:
            read = [value(variable, known) for variable in equation.invars]
            known.update(zip(equation.outvars, bind(equation, read)))
        return [value(program.outvars[k], known) for k in outputs]

    shapes = list(traced.inputs.values())
    avals = traced.given.out_avals
    step = Step(
        call,
        tuple(_entry(names[k], shapes[k]) for k in inputs),
        tuple(_entry(traced.outputs[k], avals[k]) for k in outputs),
        {name: np.asarray(array) for name, array in traced.carry.items() if name in used},
        jax.jit(partial(_drawn, traced)),
        {name: np.array(x) for name, x in dataclasses.asdict(job.origins).items() if x is not None and name in used},
    )
    return _closed(step, job.spec if isinstance(agent_policy(policy), Guarded) else None)


def _closed(step: Step, guarded: Spec | None) -> Step:
    """The same, where what is not finite is seen, or comes of it: no action (NaN), or, of a guard of that spec, the
    last one that it gave, `infeasible` and `ood`. What is remembered stays as it was."""
    inputs = [x.name for x in step.inputs]
    outputs = [x.name for x in step.outputs]

    def call(*arrays: Array) -> list[Array]:
        given = dict(zip([*inputs, f"memory.{LAST}"], arrays))
        found = dict(zip(outputs, step.call(*arrays[: len(inputs)])))
        numbers = [*(given[name] for name in SEEN if name in given), found["action"]]
        sound = jnp.stack([jnp.isfinite(x).all() for x in numbers]).all()
        unsound: dict[str, Any] = {name: given[_before(name)] for name in outputs if name.startswith("next.")}
        unsound["action"] = given.get(f"memory.{LAST}", jnp.nan)
        if guarded is not None:
            sound &= ~jnp.isnan(found["info.clearance"])
            unsound |= {"info.clearance": jnp.nan, "info.next_clearance": jnp.nan}
            unsound |= {"info.infeasible": jnp.array(True), "info.ood": jnp.array(True)}
            # Chosen once more: ONNX has one name for every value.
            found[f"next.{LAST}"], unsound[f"next.{LAST}"] = found["action"], unsound["action"]
        found |= {name: _either(sound, found[name], x) for name, x in unsound.items()}
        return [*found.values()]

    if guarded is None:
        return dataclasses.replace(step, call=call)
    low, high = (np.asarray(bound, np.float32) for bound in (guarded.action_low, guarded.action_high))
    action = next(x for x in step.outputs if x.name == "action")
    nothing = np.broadcast_to(np.clip(np.float32(0), low, high), action.shape)
    return dataclasses.replace(
        step,
        call=call,
        inputs=(*step.inputs, dataclasses.replace(action, name=f"memory.{LAST}")),
        outputs=(*step.outputs, dataclasses.replace(action, name=f"next.{LAST}")),
        initial=step.initial | {f"memory.{LAST}": nothing},
    )


def _either(first: Array, one: Array, other: Any) -> Array:
    """One or the other; onnxruntime chooses among numbers alone."""
    if one.dtype == bool:
        return (first & one) | (~first & other)
    return jnp.where(first, one, other)


def _trace(job: Job, policy: Policy) -> _Traced:
    """A policy's programs, before anything is left out."""
    seen = _seen(job, policy)
    carry = policy.initial_state(1)
    leaves, structure = jax.tree.flatten(carry)
    constraints = constraints_of(policy)

    def act(key: Key, seen_arrays: Sequence[Array], leaves: Sequence[Array]) -> tuple[dict[str, Array], list[Array]]:
        read = dict(zip(seen, seen_arrays))
        costs = {name: read["cost"][k : k + 1] for k, name in enumerate(constraints)}
        carry = with_cost(policy, jax.tree.unflatten(structure, leaves), costs or read["cost"][None])
        state = read["state"][None] if "state" in read else None
        carry, step = policy.act(carry, read["observations"][None], state, key)
        info = {f"info.{k}": step.info[k][0] for k in INFO if k in step.info and step.info[k].ndim == 1}
        return {"action": step.action[0]} | info, jax.tree.leaves(carry)

    key = jax.random.key(0)
    drawing, (results, _) = jax.make_jaxpr(act, return_shape=True)(key, list(seen.values()), leaves)
    noise = {f"noise.{k}": shape for k, shape in enumerate(draws(drawing.jaxpr))}

    def act_given(key: Key, *arrays: Array) -> list[Array]:
        """The action with noise given instead of drawn."""
        given = iter(arrays[len(seen) : len(seen) + len(noise)])
        interpreter = Interpreter(lambda *_: next(given), simplify=True)
        return interpreter.run(drawing, (key, *arrays[: len(seen)], *arrays[len(seen) + len(noise) :]))

    given = jax.make_jaxpr(act_given)(key, *seen.values(), *noise.values(), *leaves)
    names = [f"memory.{name}" for name, _ in named_leaves(carry)]
    return _Traced(drawing, given, seen, noise, dict(zip(names, leaves)), list(results))


def _seen(job: Job, policy: Policy) -> dict[str, jax.ShapeDtypeStruct]:
    """What a policy may be given of one environment at every step."""
    width, state_width = job.widths
    if width is None or state_width is None:
        raise UserError(
            "This run does not tell how wide its observations and state are, and a file has to; train it again."
        )
    num_constraints = len(constraints_of(policy))
    shapes: dict[str, tuple[int, ...]] = {"observations": (job.team, width)}
    if state_width:
        shapes["state"] = (state_width,)
    shapes["cost"] = (num_constraints,) if num_constraints else ()
    return {name: jax.ShapeDtypeStruct(shape, jnp.float32) for name, shape in shapes.items()}


def _drawn(traced: _Traced, key: Key) -> list[Array]:
    """The noise that the policy would draw by a key."""
    noise: list[Array] = []

    def keep(equation: core.JaxprEqn, inputs: list[Any]) -> Array:
        noise.append(bind(equation, inputs)[0])
        return noise[-1]

    zeros = [jnp.zeros(shape.shape, shape.dtype) for shape in traced.seen.values()]
    Interpreter(keep).run(traced.drawing, (key, *zeros, *traced.carry.values()))
    return noise


def _constant_carry(traced: _Traced) -> set[str]:
    """Names of carry that no step changes: it is a constant."""
    program = traced.given.jaxpr
    before = program.invars[len(program.invars) - len(traced.carry) :]
    after = program.outvars[len(traced.results) :]
    return {name for name, old, new in zip(traced.carry, before, after) if new is old}


def _before(name: str) -> str:
    """The input that `next.NAME` is in the step after."""
    return name.replace("next.", "memory.", 1)


def _shared(constants: dict[Any, Any]) -> dict[Any, Any]:
    """Arrays that are the same are kept once."""
    kept: dict[tuple, Any] = {}
    return {
        variable: kept.setdefault((variable.aval.shape, str(variable.aval.dtype), np.asarray(array).tobytes()), array)
        for variable, array in constants.items()
    }


def _entry(name: str, array: Any) -> Entry:
    return Entry(name, tuple(array.shape), str(array.dtype))
