"""A trained policy, guard included, as one file that needs neither Python nor this library.

The function in the file is one joint action of `deploy.Controller`, of one environment, in float32:

    observations (N, O), state (S,), cost (), noise.K, memory.NAME  ->  action (N, A), info.NAME (), next.NAME

Whatever nothing reads is left out: cloning under a shield takes observations (and the state, where its World sees it)
and remembers its last action alone. `next.NAME` is `memory.NAME` of the step after; `cost` is what the last step cost,
NaN where nobody gave; `noise.K` are standard normal numbers, drawn afresh for every step, since generators of random
numbers differ between runtimes. What is carried begins with, names, shapes and the facts of the run are metadata.

Observations and states of logs that were moved towards 0 (`origins` of the metadata) come in float64, as they were
measured, and the file takes the origins from them.
"""

from __future__ import annotations

import dataclasses
import io
import json
import logging
import math
import sys
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from ringfence import __version__
from ringfence.deploy.jaxpr import Interpreter, bind, draws, live, operations, value, values_of
from ringfence.errors import UserError, needs, reason, unknown
from ringfence.evaluation.certificate import digest
from ringfence.guards import Guarded
from ringfence.loading.resolve import Resolved, resolve
from ringfence.loading.spec import PolicySpec
from ringfence.problem.bounds import stored
from ringfence.problem.homogeneous import agent_policy
from ringfence.proposals.guidance import TakesGuidance, guided_by
from ringfence.training import worlds
from ringfence.training.job import Job
from ringfence.training.runs import Run
from ringfence.types import Array, Key, Policy, Spec, with_cost
from ringfence.utils.files import whole, writable
from ringfence.utils.precision import float64, in_float32
from ringfence.utils.progress import Progress
from ringfence.utils.pytrees import named_leaves

FORMATS = ("onnx", "stablehlo")
OPSET = 21  # of ONNX: onnxruntime 1.20 (2024) and younger read it
MANY = 3000  # operations, which take half a minute
MAX_OPERATIONS = 20_000  # that jax2onnx converts in a quarter of an hour; its time grows with their square
SEEN = ("observations", "state")  # inputs that have to be finite; a cost is NaN where nobody knows it
LAST = "action"  # what a guarded file remembers beside its policy's carry
INFO = ("clearance", "next_clearance", "infeasible", "ood", "chosen")  # of what a policy tells, what is one number


@in_float32
def export(
    run: Run | str | Path,
    out: str | Path,
    format: str = "onnx",
    checkpoint: int | None = None,
    planner: str = "default",
    quiet: bool = True,
    **options: Any,
) -> Path:
    """Write the policy of a finished run to the file `out`: `onnx`, for onnxruntime and the like, or
    `stablehlo`; both need the extra `ringfence[export]`. Options are those of `ringfence.load`; what a format cannot
    hold is refused, and nothing is written."""
    if format not in FORMATS:
        raise unknown("format", str(format), FORMATS)
    file = writable(out)
    if format == "onnx" and file.suffix not in ("", ".onnx"):
        raise UserError(f"'{file.name}' ends in {file.suffix}, and what is written is onnx; end it in .onnx.")
    _converter() if format == "onnx" else _packer()
    resolved = resolve(PolicySpec.of(run, checkpoint=checkpoint, planner=planner, **options))
    action = step_of(resolved.job, resolved.team)
    metadata = metadata_of(resolved, action)
    count = operations(jax.make_jaxpr(action.call)(*action.avals).jaxpr) if format == "onnx" else 0
    if count > MAX_OPERATIONS:
        raise UserError(
            f"This policy has {count:,} operations, and more than {MAX_OPERATIONS:,} take hours to write as ONNX; look "
            "less far ahead (horizon=), or write it as StableHLO."
        )
    if not quiet and count > MANY:
        print(f"ONNX of {count:,} operations takes some minutes.", file=sys.stderr)
    with Progress(f"{file.name}{f', {count:,} operations' * bool(count)}", 1, 0, quiet) as bar:
        content = _onnx(action, metadata) if format == "onnx" else _stablehlo(action, metadata)
        bar.advance(1)
    with whole(file) as temporary:  # at once: who is stopped while converting leaves nothing
        temporary.write_bytes(content)
    return file


# --- metadata ---


def metadata_of(resolved: Resolved, step: Step) -> dict[str, Any]:
    """What a file says of itself, as JSON holds it."""
    spec = resolved.spec
    assert spec.run is not None  # or nothing were resolved
    job = resolved.job
    guard = resolved.guard
    plan_options = resolved.plan_options
    guide = resolved.proposal.guide if isinstance(resolved.proposal, TakesGuidance) else None
    config = spec.run.config
    data = config["data"]
    width, state_width = job.widths
    names = {
        "agents": (data.get("agents"), job.team),
        "observations": (data.get("observation_names"), width),
        "state": (data.get("state_names"), state_width),
    }
    return {
        "ringfence": __version__,
        "task": config["task"],
        "algorithm": config["algorithm"],
        "preset": config["preset"],
        # A file says beside its name which checkpoint it is of.
        "variant": dataclasses.replace(spec, checkpoint=None).variant(job.preset),
        "seed": config["seed"],
        "provenance": data["provenance"],
        "planner_options": dataclasses.asdict(plan_options) if plan_options else {},
        **guided_by(resolved.proposal),
        "guard_options": dataclasses.asdict(guard.options) if guard else {},
        "barrier": spec.barrier if guard else "none",
        "execution": worlds.execution_of(job.task, "decentralized" if guard and guard.world.alone else None),
        "world": digest(guard.world) if guard else None,
        "guiding_world": None if guide is None else digest(guide.world),
        "n_agents": job.team,
        "names": {k: list(x) for k, (x, count) in names.items() if x is not None and len(x) == count},
        "constraints": constraints_of(resolved.team),
        "action_low": stored(job.spec.action_low),
        "action_high": stored(job.spec.action_high),
        "inputs": [dataclasses.asdict(x) for x in step.measured],
        "outputs": [dataclasses.asdict(x) for x in step.outputs],
        "initial": {name: _short(x) for name, x in step.initial.items()},
        **({"origins": {name: x.tolist() for name, x in step.origins.items()}} if step.origins else {}),
    }


def _short(x: np.ndarray) -> Any:
    """An array as one number where all its entries are that number, else as nested lists.

    JSON has no word for NaN or infinity: they are the strings "NaN", "Infinity" and "-Infinity", which `float` and
    `numpy.asarray` read.
    """
    first = x.flat[0] if x.size else np.zeros((), x.dtype)[()]
    same = bool(np.array_equal(x, np.full_like(x, first), equal_nan=x.dtype.kind == "f"))
    return _jsonable(first.item() if same else x.tolist())


def _jsonable(value: Any) -> Any:
    """Numbers, and nested lists of them, as JSON can hold them."""
    if isinstance(value, list):
        return [_jsonable(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def _json(metadata: dict[str, Any], indent: int | None = None) -> str:
    """Metadata as JSON that every reader takes."""
    return json.dumps(metadata, indent=indent, allow_nan=False)


# --- formats ---


def _stablehlo(step: Step, metadata: dict[str, Any]) -> bytes:
    """A ZIP of three: `metadata.json`, `policy.mlirbc` (the portable StableHLO program, for any runtime that reads it)
    and `policy.jax` (the same for `jax.export.deserialize`). Nothing in it depends on a platform."""
    jax_export = _packer()
    checks = [jax_export.DisabledSafetyCheck.platform()]
    pack = partial(jax_export.export, platforms=["cpu"], disabled_checks=checks)
    with _without_locations():
        program = pack(jax.jit(step.call))(*step.avals)
        if step.origins:
            program = _of_measured(step, program, pack)
    contents = {
        "metadata.json": _json(metadata, indent=1).encode(),
        "policy.mlirbc": program.mlir_module_serialized,
        "policy.jax": bytes(program.serialize()),
    }
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in contents.items():
            packed.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content, zipfile.ZIP_DEFLATED)
    return file.getvalue()


def _of_measured(step: Step, program: Any, pack: Callable[..., Any]) -> Any:
    """The program with what it takes from its inputs first, in double precision."""
    origins = [step.origins.get(x.name) for x in step.inputs]

    def call(*arrays: Array) -> list[Array]:
        near = [x if o is None else (x - jnp.asarray(o)).astype(jnp.float32) for x, o in zip(arrays, origins)]
        return program.call(*near)

    with float64():
        return pack(jax.jit(call))(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in step.measured))


@contextmanager
def _without_locations() -> Iterator[None]:
    """Whose lines of code a program was traced from is nobody's business."""
    option = "jax_traceback_in_locations_limit"
    limit = getattr(jax.config, option)
    jax.config.update(option, 0)
    try:
        yield
    finally:
        jax.config.update(option, limit)


def _onnx(step: Step, metadata: dict[str, Any]) -> bytes:
    model = as_onnx(step)
    _take_origins(model.graph, step.origins)
    for name, text in {"ringfence": _json(metadata), **_flat(step.initial)}.items():
        model.metadata_props.add(key=name, value=text)
    return model.SerializeToString()


def _take_origins(graph: Any, origins: dict[str, np.ndarray]) -> None:
    """Let an ONNX graph take origins from its inputs first, in double precision."""
    import onnx

    first = []
    for name, taken in origins.items():
        constant = onnx.numpy_helper.from_array(taken.astype(np.float64), f"{name}.origins")
        graph.initializer.append(constant)
        for node in graph.node:
            node.input[:] = [f"{name}.near" if read == name else read for read in node.input]
        first.append(onnx.helper.make_node("Sub", [name, constant.name], [f"{name}.far"]))
        first.append(onnx.helper.make_node("Cast", [f"{name}.far"], [f"{name}.near"], to=onnx.TensorProto.FLOAT))
        given = next(x for x in graph.input if x.name == name)
        given.type.tensor_type.elem_type = onnx.TensorProto.DOUBLE
    nodes = [*first, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


def _flat(initial: dict[str, np.ndarray]) -> dict[str, str]:
    """Initial memory as a program without a JSON reader takes it: one number for all entries, or every one of them."""
    flat = {name: np.asarray(_short(x), object).reshape(-1) for name, x in initial.items()}
    return {f"initial.{name}": " ".join(map(str, numbers)) for name, numbers in flat.items()}


def as_onnx(step: Step) -> Any:
    """The function as an ONNX model of the opset OPSET; what jax2onnx has no words for is refused."""
    convert, checked, runtime = _converter()
    log = logging.getLogger("onnx_ir")  # which says of values inside loops that it knows no type for them
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        model = convert(
            step.call,
            step.avals,
            model_name="ringfence",
            opset=OPSET,
            input_names=[x.name for x in step.inputs],
            output_names=[x.name for x in step.outputs],
        )
    except Exception as error:  # it raises anything where it does not know an operation
        what = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(f"This policy cannot be written as ONNX ({what}); write it as StableHLO.") from error
    finally:
        log.setLevel(level)
    _swept(model.graph)
    checked(model)
    try:  # what is well formed may still be what no runtime loads
        session = runtime(model.SerializeToString(), providers=["CPUExecutionProvider"])
        session.run(None, {x.name: np.zeros(x.shape, x.dtype) for x in step.inputs})
    except Exception as error:
        raise UserError(
            f"The ONNX file of this policy would not run ({reason(error)}); write it as StableHLO."
        ) from error
    return model


def _swept(graph: Any) -> set[str]:
    """Names that a graph reads, after what no operation reads was taken out of it, which runtimes would complain of."""
    read = {x.name for x in graph.output}
    for node in graph.node:
        read |= set(node.input)
        for inside in (x.g for x in node.attribute if x.HasField("g")):
            read |= _swept(inside)
    kept = [x for x in graph.initializer if x.name in read]
    del graph.initializer[:]
    graph.initializer.extend(kept)
    return read


def _packer() -> Any:
    """`jax.export`, which packs programs with flatbuffers, a package that JAX does not ask for itself."""
    with needs("export", "StableHLO files"):
        import flatbuffers  # noqa: F401
        from jax import export as jax_export
    return jax_export


def _converter() -> tuple[Callable, Callable, Callable]:
    """What converts to ONNX, what checks the result, and what runs it."""
    as_it_was = jnp.cumsum  # which jax2onnx replaces for good, by one that takes no axis by its place
    with needs("export", "ONNX files"):
        from jax2onnx import to_onnx
        from onnx.checker import check_model
        from onnxruntime import InferenceSession
    jnp.cumsum = as_it_was
    return to_onnx, check_model, InferenceSession


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
    # Carry that no step changes is a constant.
    before = program.invars[len(program.invars) - len(traced.carry) :]
    after = program.outvars[len(traced.results) :]
    used -= {name for name, old, new in zip(traced.carry, before, after) if new is old}
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
    # What a policy may be given of one environment at every step.
    width, state_width = job.widths
    if width is None or state_width is None:
        raise UserError(
            "This run does not tell how wide its observations and state are, and a file has to; train it again."
        )
    constraints = constraints_of(policy)
    shapes: dict[str, tuple[int, ...]] = {"observations": (job.team, width)}
    if state_width:
        shapes["state"] = (state_width,)
    shapes["cost"] = (len(constraints),) if constraints else ()
    seen = {name: jax.ShapeDtypeStruct(shape, jnp.float32) for name, shape in shapes.items()}
    carry = policy.initial_state(1)
    leaves, structure = jax.tree.flatten(carry)

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


def _drawn(traced: _Traced, key: Key) -> list[Array]:
    """The noise that the policy would draw by a key."""
    noise: list[Array] = []

    def keep(equation: core.JaxprEqn, inputs: list[Any]) -> Array:
        noise.append(bind(equation, inputs)[0])
        return noise[-1]

    zeros = [jnp.zeros(shape.shape, shape.dtype) for shape in traced.seen.values()]
    Interpreter(keep).run(traced.drawing, (key, *zeros, *traced.carry.values()))
    return noise


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
