"""A trained policy, guard included, as one file that needs neither Python nor this library.

The function in the file is one joint action of `evaluate.Controller`, of one environment, in float32:

    observations (N, O), state (S,), cost (), noise.K, memory.NAME  ->  action (N, A), info.NAME (), next.NAME

Whatever nothing reads is left out: cloning under a shield takes observations (and the state, where its World sees it)
and remembers nothing. `next.NAME` is `memory.NAME` of the step after; `cost` is what the last step cost, NaN where
nobody told; `noise.K` are standard normal numbers, drawn afresh for every step, since generators of random numbers
differ between runtimes. What memory begins with, names, shapes and the facts of the run are told inside the file.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import logging
import zipfile
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from ringfence import __version__
from ringfence.errors import UserError, unknown
from ringfence.guards import Guarded
from ringfence.loading.resolve import resolve
from ringfence.loading.spec import PolicySpec
from ringfence.problem.homogeneous import Each
from ringfence.proposals.base import heard
from ringfence.proposals.planner import Planner
from ringfence.training import worlds
from ringfence.training.job import Job
from ringfence.training.runs import Run
from ringfence.types import Array, Key, Policy
from ringfence.utils.files import whole, writable
from ringfence.utils.pytrees import digest_of, named_arrays, named_leaves

FORMATS = ("onnx", "stablehlo")
OPSET = 21  # of ONNX: onnxruntime 1.20 (2024) and younger read it
MOVES = ("gather", "scatter", "scatter-add", "scatter_add")
CALLS = ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "checkpoint", "remat2")
FOLDED = 1024  # entries of what is computed once and for all, though it is larger than what it is made of
LAYERED = 2**21  # entries added times places that they may be added to: beyond that, a scatter stays one
INFO = ("clearance", "infeasible", "strange", "chosen")  # of what a policy tells, what is one number


@dataclass(frozen=True)
class Entry:
    """One input or output of the function."""

    name: str
    shape: tuple[int, ...]
    dtype: str  # float32, int32 or bool


@dataclass(frozen=True, eq=False)
class Step:
    """One joint action as a function of arrays alone, in the order of `inputs`, and what its memory begins with."""

    call: Callable[..., list[Array]]
    inputs: tuple[Entry, ...]
    outputs: tuple[Entry, ...]
    initial: dict[str, np.ndarray]  # by the inputs' names
    draw: Callable[[Key], list[Array]]  # the noise that `Controller` would draw by a key

    @property
    def avals(self) -> list[jax.ShapeDtypeStruct]:
        return [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in self.inputs]


def export(
    run: Run | str | Path,
    out: str | Path,
    format: str = "onnx",
    step: int | None = None,
    planner: str = "plain",
    **options,
) -> Path:
    """Write the policy of a finished run to the file `out`: `onnx`, for onnxruntime and the like, needs the extra
    `ringfence[export]`; `stablehlo` needs nothing. Options are those of `evaluate.load`; what a format cannot hold is
    refused, and nothing is written."""
    if format not in FORMATS:
        raise unknown("format", str(format), FORMATS)
    file = writable(out)
    _converter() if format == "onnx" else _packer()
    resolved = resolve(PolicySpec.of(run, checkpoint=step, planner=planner, **options))
    job = resolved.job
    made = step_of(job, resolved.team)
    # A file says beside its name which checkpoint it is of.
    variant = dataclasses.replace(resolved.spec, checkpoint=None).variant(job.preset)
    told = facts(Run.of(run), job, resolved.team, made, variant, resolved.spec.danger)
    write = {"onnx": _write_onnx, "stablehlo": _write_stablehlo}[format]
    with whole(file) as temporary:
        write(made, told, temporary)
    return file


def _inner(policy: Policy) -> Policy:
    """The policy of each, where agents are alike."""
    return policy.one if isinstance(policy, Each) else policy


def _constraints(policy: Policy) -> list[str]:
    """The named ones that a guard's margins follow apart."""
    inner = _inner(policy)
    return list(inner.guard.danger.limits) if isinstance(inner, Guarded) else []


def step_of(job: Job, policy: Policy) -> Step:
    """One joint action of a policy in one environment, without what nothing reads."""
    width, state_width = job.widths
    if width is None or state_width is None:
        raise UserError(
            "This run does not tell how wide its observations and state are, and a file has to; train it again."
        )
    memory = policy.start(1)
    given = {"observations": jax.ShapeDtypeStruct((job.team, width), jnp.float32)}
    if state_width:
        given["state"] = jax.ShapeDtypeStruct((state_width,), jnp.float32)
    constraints = _constraints(policy)
    given["cost"] = jax.ShapeDtypeStruct((len(constraints),) if constraints else (), jnp.float32)
    leaves, shape = jax.tree.flatten(memory)
    named = [name for name, _ in named_leaves(memory)]

    def act(key: Key, seen: Sequence[Array], leaves: Sequence[Array]) -> tuple[dict[str, Array], list[Array]]:
        read = dict(zip(given, seen))
        cost = {name: read["cost"][k : k + 1] for k, name in enumerate(constraints)} or read["cost"][None]
        memory = heard(policy, jax.tree.unflatten(shape, leaves), cost)
        whole = read["state"][None] if state_width else None
        memory, step = policy.act(memory, read["observations"][None], whole, key)
        info = {f"info.{k}": step.info[k][0] for k in INFO if k in step.info and step.info[k].ndim == 1}
        return {"action": step.action[0]} | info, jax.tree.leaves(memory)

    key, seen = jax.random.key(0), list(given.values())
    traced, (told, _) = jax.make_jaxpr(act, return_shape=True)(key, seen, leaves)
    drawn = _draws(traced.jaxpr)

    def undrawn(key: Key, *x: Array) -> list[Array]:
        """The action with noise given instead of drawn."""
        noise, first = iter(x[len(seen) :]), x[: len(seen)]
        return _played(traced, (key, *first, *x[len(x) - len(leaves) :]), _How(lambda *_: next(noise), simpler=True))

    inputs = [(name, x) for name, x in given.items()] + [(f"noise.{k}", x) for k, x in enumerate(drawn)]
    inputs += [(f"memory.{name}", x) for name, x in zip(named, leaves)]
    outputs = [*told, *(f"next.{name}" for name in named)]
    flat = jax.make_jaxpr(undrawn)(key, *(x for _, x in inputs))
    kept, used = _needed(flat.jaxpr, len(told), named, ["key", *(name for name, _ in inputs)])
    if "key" in used:
        raise UserError(
            "This policy draws more than normal noise, and a file holds nothing that draws; play it with "
            "ringfence.Controller."
        )
    at = len(inputs) - len(leaves)
    still = [after is before for after, before in zip(flat.jaxpr.outvars[len(told) :], flat.jaxpr.invars[1 + at :])]
    used -= {f"memory.{name}" for name, stays in zip(named, still) if stays}  # what never changes is a constant
    used_out = [k for k, name in enumerate(outputs) if k < len(told) or f"memory.{name[5:]}" in used]
    places = [k for k, (name, _) in enumerate(inputs) if name in used]

    same: dict[tuple, Any] = {}  # arrays that are alike are kept once
    constants = [
        same.setdefault((v.aval.shape, str(v.aval.dtype), np.asarray(x).tobytes()), x)
        for v, x in zip(flat.jaxpr.constvars, flat.consts)
    ]

    def call(*x: Array) -> list[Array]:
        whole = [None] * at + list(leaves)
        for k, value in zip(places, x):
            whole[k] = value
        known = dict(zip(flat.jaxpr.constvars, constants)) | dict(zip(flat.jaxpr.invars[1:], whole))
        value = lambda v: v.val if isinstance(v, core.Literal) else known[v]  # noqa: E731
        for e in kept:
            out = e.primitive.bind(*map(value, e.invars), **e.params)
            known.update(zip(e.outvars, out if e.primitive.multiple_results else [out]))
        return [value(flat.jaxpr.outvars[k]) for k in used_out]

    def draw(key: Key) -> list[Array]:
        noise: list[Array] = []

        def keep(e, given: list) -> Array:
            noise.append(e.primitive.bind(*given, **e.params)[0])
            return noise[-1]

        zeros = [jnp.zeros(x.shape, x.dtype) for x in seen]
        _played(traced, (key, *zeros, *leaves), _How(keep))
        return noise

    avals = flat.out_avals
    return Step(
        call,
        tuple(Entry(inputs[k][0], tuple(inputs[k][1].shape), str(inputs[k][1].dtype)) for k in places),
        tuple(Entry(outputs[k], tuple(avals[k].shape), str(avals[k].dtype)) for k in used_out),
        {f"memory.{name}": np.asarray(x) for name, x in zip(named, leaves) if f"memory.{name}" in used},
        jax.jit(draw),
    )


# --- programs ---


def _is_key(var) -> bool:
    return jax.dtypes.issubdtype(getattr(var.aval, "dtype", np.float32), jax.dtypes.prng_key)


def _draws(jaxpr) -> list[jax.ShapeDtypeStruct]:
    """The normal numbers that a program draws, in the order of `_played`."""
    found = []
    for e in jaxpr.eqns:
        keyed, name = any(map(_is_key, e.invars)), e.primitive.name
        if keyed and e.params.get("name") == "_normal":
            found.append(jax.ShapeDtypeStruct(e.outvars[0].aval.shape, e.outvars[0].aval.dtype))
        elif keyed and name in CALLS:
            found += _draws(_inside(e).jaxpr)
        elif keyed and name == "scan":
            found += _draws(e.params["jaxpr"].jaxpr) * e.params["length"]
        elif keyed and name == "cond":
            found += [x for branch in e.params["branches"] for x in _draws(branch.jaxpr)]
    return found


@dataclass(frozen=True)
class _How:
    """How a program is played: `draw` (an equation, what it is given) stands for `jax.random.normal`; `simpler` asks
    for what every runtime has (`_picked`, `_computed`)."""

    draw: Callable[[Any, list], Array]
    simpler: bool = False


def _played(program: core.ClosedJaxpr, arguments: Sequence[Any], how: _How) -> list[Array]:
    """What a program gives for its arguments. Calls are taken apart, and so are loops that draw, run backwards or were
    to be unrolled anyway."""
    jaxpr = program.jaxpr
    known = dict(zip(jaxpr.constvars, program.consts)) | dict(zip(jaxpr.invars, arguments))

    def value(var) -> Any:
        return var.val if isinstance(var, core.Literal) else known[var]

    for e in jaxpr.eqns:
        given, name = [value(v) for v in e.invars], e.primitive.name
        keyed = any(map(_is_key, e.invars))
        if keyed and e.params.get("name") == "_normal":
            out = [how.draw(e, given)]
        elif name in CALLS:
            out = _played(_inside(e), given, how)
        elif name in LOOPS:
            out = LOOPS[name](e.params, given, how, keyed)
        elif how.simpler and name == "select_n" and e.outvars[0].aval.dtype == bool and len(given) == 3:
            which, no, yes = given  # onnxruntime chooses among numbers alone
            out = [(which & yes) | (~which & no)]
        elif how.simpler and name in MOVES and (found := _picked(e, given)) is not None:
            out = [found]
        else:
            out = _computed(e, given, how)
        known.update(zip(e.outvars, out))
    return [value(v) for v in jaxpr.outvars]


def _computed(e, given: list, how: _How) -> list[Array]:
    """What an equation gives; now, where all it reads is known and what it gives is small or no larger."""
    sizes = [sum(v.aval.size for v in some if hasattr(v.aval, "size")) for some in (e.invars, e.outvars)]
    known = not any(isinstance(x, jax.core.Tracer) for x in given)
    fixed = how.simpler and known and sizes[1] <= max(sizes[0], FOLDED)
    with jax.ensure_compile_time_eval() if fixed else nullcontext():
        out = e.primitive.bind(*given, **e.params)
    return out if e.primitive.multiple_results else [out]


def _picked(e, given: list) -> Array | None:
    """What a gather or scatter at known places gives, as entries picked from a flat array, which every runtime does at
    once; None where the places are not known or what is read lies outside."""
    x, places, *more = given
    if isinstance(places, jax.core.Tracer) or not any(isinstance(v, jax.core.Tracer) for v in given):
        return None
    if x.size + sum(v.size for v in more) >= 2**24 or not jnp.issubdtype(x.dtype, jnp.number):
        return None  # float32 counts no farther

    def moved(to: np.ndarray, *some: np.ndarray, many: bool = False) -> np.ndarray:
        """Where entries go: the same of their numbers, now; for each of `many`."""
        with jax.ensure_compile_time_eval():
            to, *some = (jnp.asarray(v, x.dtype) for v in (to, *some))
            go = lambda *some: e.primitive.bind(to, places, *some, **e.params)  # noqa: E731
            return np.asarray((jax.vmap(go) if many else go)(*some)).astype(np.int64)

    here, flat = np.arange(x.size).reshape(x.shape), jax.lax.reshape(x, (x.size,))
    if not more:
        at = moved(here)
        return _at(flat, at) if not at.size or 0 <= at.min() <= at.max() < x.size else None
    put, which = jax.lax.reshape(more[0], (more[0].size,)), np.arange(more[0].size).reshape(more[0].shape)
    if e.primitive.name == "scatter":
        return _at(jnp.concatenate([flat, put]), moved(here, which + x.size))
    if which.size * x.size > LAYERED:
        return None
    one_each = np.eye(which.size).reshape(-1, *which.shape)
    goes = moved(np.zeros(x.shape), one_each, many=True).reshape(which.size, x.size)
    often = goes.cumsum(0) * goes  # 1 for the first number that is added to a place, 2 for the second, ...
    layers = [np.where((often == k).any(0), (often == k).argmax(0) + 1, 0) for k in range(1, often.max(initial=0) + 1)]
    padded = jnp.concatenate([jnp.zeros(1, put.dtype), put])
    return functools.reduce(jnp.add, [_at(padded, k.reshape(x.shape)) for k in layers], x)


def _at(flat: Array, places: np.ndarray) -> Array:
    """Entries of a flat array at places (...) that lie in it."""
    one = jax.lax.GatherDimensionNumbers(offset_dims=(), collapsed_slice_dims=(0,), start_index_map=(0,))
    inside = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
    picked = jax.lax.gather(flat, places.reshape(-1, 1).astype(np.int32), one, (1,), mode=inside)
    return jax.lax.reshape(picked, places.shape)


def _inside(e) -> core.ClosedJaxpr:
    """The program that an equation calls."""
    found = next(e.params[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in e.params)
    return found if isinstance(found, core.ClosedJaxpr) else core.ClosedJaxpr(found, ())


def _scan(p: dict, given: list, how: _How, keyed: bool) -> list[Array]:
    """A loop of known length; step by step where it was to be unrolled anyway, draws, or runs backwards."""
    fixed, carry, moving = given[: p["num_consts"]], p["num_consts"] + p["num_carry"], p["num_carry"]
    state, rows = given[p["num_consts"] : carry], given[carry:]

    def step(state, row):
        out = _played(p["jaxpr"], [*fixed, *state, *row], how)
        return out[:moving], out[moving:]

    if not (keyed or p["reverse"] or p["unroll"] >= p["length"]):
        state, told = jax.lax.scan(step, state, rows, p["length"], unroll=p["unroll"])
        return [*state, *told]
    kept = []
    for k in reversed(range(p["length"])) if p["reverse"] else range(p["length"]):
        state, told = step(state, [x[k] for x in rows])
        kept.append(told)
    return [*state, *(jnp.stack(x) for x in zip(*(kept[::-1] if p["reverse"] else kept)))]


def _while(p: dict, given: list, how: _How, keyed: bool) -> list[Array]:
    """A loop that ends when its condition says so."""
    asks, does = given[: p["cond_nconsts"]], given[p["cond_nconsts"] : p["cond_nconsts"] + p["body_nconsts"]]
    return jax.lax.while_loop(
        lambda state: _played(p["cond_jaxpr"], [*asks, *state], how)[0],
        lambda state: _played(p["body_jaxpr"], [*does, *state], how),
        given[len(asks) + len(does) :],
    )


def _cond(p: dict, given: list, how: _How, keyed: bool) -> list[Array]:
    """Branches; all of them, where they draw."""
    if keyed:
        each = [_played(branch, given[1:], how) for branch in p["branches"]]
        return [jax.lax.select_n(given[0], *x) for x in zip(*each)]
    return jax.lax.switch(given[0], [lambda *x, b=b: _played(b, x, how) for b in p["branches"]], *given[1:])


LOOPS = {"scan": _scan, "while": _while, "cond": _cond}


def _needed(jaxpr, told: int, memory: list[str], inputs: list[str]) -> tuple[list, set[str]]:
    """The equations and the inputs that the first `told` outputs need, now or by way of memory later on."""
    used: set[str] = set()
    while True:
        wanted = {v for v in jaxpr.outvars[:told] if not isinstance(v, core.Literal)}
        wanted |= {
            v
            for v, name in zip(jaxpr.outvars[told:], memory)
            if f"memory.{name}" in used and not isinstance(v, core.Literal)
        }
        kept = []
        for e in reversed(jaxpr.eqns):
            if any(v in wanted for v in e.outvars):
                kept.append(e)
                wanted |= {v for v in e.invars if not isinstance(v, core.Literal)}
        found = {name for name, v in zip(inputs, jaxpr.invars) if v in wanted}
        if found == used:
            return kept[::-1], used
        used = found


# --- what is told ---


def facts(run: Run, job: Job, policy: Policy, made: Step, variant: str, danger: str) -> dict[str, Any]:
    """What a file tells of itself, as JSON holds it."""
    told, spec, inner = run.config, job.spec, _inner(policy)
    guarded = isinstance(inner, Guarded)
    proposal = inner.proposal if guarded else inner
    card = told["data"]
    names = {
        "agents": (card.get("agents"), job.team),
        "observations": (card.get("observation_names"), job.widths[0]),
        "state": (card.get("state_names"), job.widths[1]),
    }
    return {
        "ringfence": __version__,
        "task": told["task"],
        "algorithm": told["algorithm"],
        "preset": told["preset"],
        "variant": variant,
        "seed": told["seed"],
        "provenance": card["provenance"],
        "planner_options": dataclasses.asdict(proposal.options) if isinstance(proposal, Planner) else {},
        "guard_options": dataclasses.asdict(inner.guard.options) if guarded else {},
        "danger": danger if guarded else "none",
        "sight": worlds.sight_of(job.task, "own" if guarded and inner.guard.world.alone else None),
        "world": digest_of(sorted(named_arrays(inner.guard.world).items())) if guarded else None,
        "n_agents": job.team,
        "names": {k: list(x) for k, (x, n) in names.items() if x is not None and len(x) == n},
        "constraints": _constraints(policy),
        "action_low": spec.action_low,
        "action_high": spec.action_high,
        "inputs": [dataclasses.asdict(x) for x in made.inputs],
        "outputs": [dataclasses.asdict(x) for x in made.outputs],
        "initial": {name: _short(x) for name, x in made.initial.items()},
    }


def _short(x: np.ndarray) -> Any:
    """An array as one number where all its entries are that number, else as nested lists."""
    first = x.flat[0] if x.size else 0
    return np.asarray(first).item() if (x == first).all() else x.tolist()


# --- formats ---


def _write_stablehlo(made: Step, told: dict[str, Any], file: Path) -> None:
    """A ZIP of three: `metadata.json`, `policy.mlirbc` (the portable StableHLO program, for any runtime that reads it)
    and `policy.jax` (the same for `jax.export.deserialize`). Nothing in it depends on a platform."""
    jax_export = _packer()
    checks = [jax_export.DisabledSafetyCheck.platform()]
    frames = jax.config.jax_traceback_in_locations_limit
    jax.config.update("jax_traceback_in_locations_limit", 0)  # whose lines of code these were is nobody's business
    try:
        program = jax_export.export(jax.jit(made.call), platforms=["cpu"], disabled_checks=checks)(*made.avals)
    finally:
        jax.config.update("jax_traceback_in_locations_limit", frames)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in (
            ("metadata.json", json.dumps(told, indent=1).encode()),
            ("policy.mlirbc", program.mlir_module_serialized),
            ("policy.jax", bytes(program.serialize())),
        ):
            packed.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content, zipfile.ZIP_DEFLATED)


def _write_onnx(made: Step, told: dict[str, Any], file: Path) -> None:
    model = as_onnx(made)
    for name, value in (("ringfence", json.dumps(told)), *_flat(made.initial)):
        model.metadata_props.add(key=name, value=value)
    file.write_bytes(model.SerializeToString())


def _flat(initial: dict[str, np.ndarray]):
    """Initial memory as a program without a JSON reader takes it: one number for all entries, or every one of them."""
    for name, x in initial.items():
        short = _short(x)
        flat = np.asarray(short).reshape(-1)
        yield f"initial.{name}", " ".join(str(v.item()) for v in flat)


def as_onnx(made: Step):
    """The function as an ONNX model of the opset OPSET; what jax2onnx has no words for is refused."""
    convert, checked = _converter()
    log = logging.getLogger("onnx_ir")  # which says of values inside loops that it knows no type for them
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        model = convert(
            made.call,
            made.avals,
            model_name="ringfence",
            opset=OPSET,
            input_names=[x.name for x in made.inputs],
            output_names=[x.name for x in made.outputs],
        )
    except Exception as error:  # it raises anything where it does not know an operation
        what = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(f"This policy cannot be written as ONNX ({what}); write it as StableHLO.") from error
    finally:
        log.setLevel(level)
    _swept(model.graph)
    checked(model)
    return model


def _swept(graph) -> set[str]:
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


def _packer():
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
