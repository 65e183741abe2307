"""A trained policy, guard included, as one file that needs neither Python nor this library.

The function in the file is one joint action of `evaluate.Controller`, of one environment, in float32:

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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ringfence import __version__
from ringfence.deploy.jaxpr import operations
from ringfence.deploy.step import Step, constraints_of, step_of
from ringfence.errors import UserError, unknown
from ringfence.evaluation.certificate import digest
from ringfence.loading.resolve import Resolved, resolve
from ringfence.loading.spec import PolicySpec
from ringfence.problem.bounds import stored
from ringfence.proposals.guidance import TakesGuidance
from ringfence.training import worlds
from ringfence.training.runs import Run
from ringfence.types import Array
from ringfence.utils.files import whole, writable
from ringfence.utils.precision import float64, in_float32
from ringfence.utils.progress import Progress

FORMATS = ("onnx", "stablehlo")
OPSET = 21  # of ONNX: onnxruntime 1.20 (2024) and younger read it
MANY = 3000  # operations, which take half a minute
MAX_OPERATIONS = 20_000  # that jax2onnx converts in a quarter of an hour; its time grows with their square


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
    """Write the policy of a finished run to the file `out`: `onnx`, for onnxruntime and the like, needs the extra
    `ringfence[export]`; `stablehlo` needs nothing. Options are those of `evaluate.load`; what a format cannot hold is
    refused, and nothing is written."""
    if format not in FORMATS:
        raise unknown("format", str(format), FORMATS)
    file = writable(out)
    if format == "onnx" and file.suffix not in ("", ".onnx"):
        raise UserError(f"'{file.name}' ends in {file.suffix}, and what is written is onnx; end it in .onnx.")
    _converter() if format == "onnx" else _packer()
    resolved = resolve(PolicySpec.of(run, checkpoint=checkpoint, planner=planner, **options))
    action = step_of(resolved.job, resolved.team)
    metadata = metadata_of(resolved, action)
    count = _operations(action) if format == "onnx" else 0
    if not quiet and count > MANY:
        print(f"ONNX of {count:,} operations takes some minutes.", file=sys.stderr)
    with Progress(f"{file.name}{f', {count:,} operations' * bool(count)}", 1, 0, quiet) as bar:
        content = _onnx(action, metadata) if format == "onnx" else _stablehlo(action, metadata)
        bar.advance(1)
    with whole(file) as temporary:  # at once: who is stopped while converting leaves nothing
        temporary.write_bytes(content)
    return file


def _operations(step: Step) -> int:
    """How many an ONNX file has to hold; too many are refused."""
    count = operations(jax.make_jaxpr(step.call)(*step.avals).jaxpr)
    if count > MAX_OPERATIONS:
        raise UserError(
            f"This policy has {count:,} operations, and more than {MAX_OPERATIONS:,} take hours to write as ONNX; look "
            "less far ahead (horizon=), or write it as StableHLO."
        )
    return count


# --- metadata ---


def metadata_of(resolved: Resolved, step: Step) -> dict[str, Any]:
    """What a file says of itself, as JSON holds it."""
    spec = resolved.spec
    assert spec.run is not None  # or nothing were resolved
    job = resolved.job
    guard = resolved.guard
    plan_options = resolved.plan_options
    guiding = resolved.proposal.world if isinstance(resolved.proposal, TakesGuidance) else None
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
        "guided": float(getattr(resolved.proposal, "guidance", 0.0)),
        "guard_options": dataclasses.asdict(guard.options) if guard else {},
        "barrier": spec.barrier if guard else "none",
        "execution": worlds.execution_of(job.task, "decentralized" if guard and guard.world.alone else None),
        "world": digest(guard.world) if guard else None,
        "guiding_world": None if guiding is None else digest(guiding),
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
    convert, checked = _converter()
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
    try:
        import flatbuffers  # noqa: F401
        from jax import export as jax_export
    except ImportError:
        raise UserError("StableHLO is packed by flatbuffers, which is missing; run pip install flatbuffers.") from None
    return jax_export


def _converter() -> tuple[Callable, Callable]:
    """What converts to ONNX, and what checks the result."""
    as_it_was = jnp.cumsum  # which jax2onnx replaces for good, by one that takes no axis by its place
    try:
        from jax2onnx import to_onnx
        from onnx.checker import check_model

        jnp.cumsum = as_it_was
    except ImportError:
        raise UserError("ONNX is written by jax2onnx, which is missing; run pip install 'ringfence[export]'.") from None
    return to_onnx, check_model
