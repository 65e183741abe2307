"""Programs of JAX, taken apart equation by equation: what an exported file can hold is made of what stays.

A function traced by JAX is a *jaxpr*, a list of equations, some of which hold jaxprs of their own. `Interpreter.run`
plays one. Under a second trace, what it does becomes a flatter program:

* calls (`jit`, `checkpoint`, custom derivatives) become what they call;
* `jax.random.normal` becomes whatever `draw` gives for it;
* `scan` is unrolled where it draws, runs backwards or was to be unrolled anyway, and stays a loop elsewhere;
* `while` stays a loop; one that draws is refused, since nobody knows how often;
* `cond` stays a choice of branches; where a branch draws, all are computed and one is selected;
* any other primitive without a program inside is bound as it is, and so are those of `BOUND`.

Any other primitive that holds a program, or calls Python, is refused. Names of parameters differ between versions of
JAX, so what a loop closes over, carries and stacks follows from shapes alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import core

from ringfence.errors import UserError
from ringfence.types import Array

Draw = Callable[[core.JaxprEqn, list[Any]], Array]  # an equation that draws, and its inputs

CALLS = (
    "jit",
    "pjit",
    "closed_call",
    "core_call",
    "custom_jvp_call",
    "custom_vjp_call",
    "custom_vjp_call_jaxpr",
    "checkpoint",
    "remat2",
)
# They hold a program that says how numbers are combined, and JAX takes it along.
BOUND = ("custom_linear_solve", "reduce", "reduce_window", "select_and_scatter_add")
CALLBACKS = ("pure_callback", "io_callback")
MOVES = ("gather", "scatter", "scatter-add", "scatter_add")
MAX_FOLDED = 1024  # entries of what is computed once and for all, though it is larger than what it is made of
MAX_LAYERED = 2**21  # entries added times places that they may be added to: beyond that, a scatter stays one
MAX_PICKED = 2**24  # entries; float32, which counts them, counts no farther


@dataclass(frozen=True)
class Interpreter:
    """Plays programs. `draw` stands for `jax.random.normal`; `simplify` asks for what every runtime has: gathers and
    scatters at known places become picks, and what is known is computed now."""

    draw: Draw
    simplify: bool = False

    def run(self, program: core.ClosedJaxpr, arguments: Sequence[Any]) -> list[Any]:
        """What a program gives for its arguments; `UserError` where it holds what this cannot take apart."""
        known = values_of(program) | dict(zip(program.jaxpr.invars, arguments))
        for equation in program.jaxpr.eqns:
            inputs = [value(variable, known) for variable in equation.invars]
            known.update(zip(equation.outvars, self._play(equation, inputs)))
        return [value(variable, known) for variable in program.jaxpr.outvars]

    def _play(self, equation: core.JaxprEqn, inputs: list[Any]) -> list[Any]:
        name = equation.primitive.name
        if draws_normal(equation):
            return [self.draw(equation, inputs)]
        if name in CALLS:
            return self.run(called(equation), inputs)
        if name == "scan":
            return self._scan(equation, inputs)
        if name == "while":
            return self._while(equation, inputs)
        if name == "cond":
            return self._cond(equation, inputs)
        _check_known(equation)
        return self._simpler(equation, inputs) if self.simplify else bind(equation, inputs)

    def _scan(self, equation: core.JaxprEqn, inputs: list[Any]) -> list[Any]:
        """A loop of known length."""
        program = closed(equation.params["jaxpr"])
        length, unroll, backwards = (equation.params[name] for name in ("length", "unroll", "reverse"))
        num_consts, num_carry = scan_counts(equation)
        constants = inputs[:num_consts]
        carry = inputs[num_consts : num_consts + num_carry]
        rows = inputs[num_consts + num_carry :]

        def step(carry: list[Any], row: list[Any]) -> tuple[list[Any], list[Any]]:
            outputs = self.run(program, [*constants, *carry, *row])
            return outputs[:num_carry], outputs[num_carry:]

        if not (reads_key(equation) or backwards or unroll >= length):
            carry, stacked = jax.lax.scan(step, carry, rows, length, unroll=unroll)
            return [*carry, *stacked]
        kept: list[list[Any]] = []
        for k in reversed(range(length)) if backwards else range(length):
            carry, outputs = step(carry, [x[k] for x in rows])
            kept.append(outputs)
        in_order = kept[::-1] if backwards else kept
        return [*carry, *(jnp.stack(column) for column in zip(*in_order))]

    def _while(self, equation: core.JaxprEqn, inputs: list[Any]) -> list[Any]:
        """A loop that ends when its condition says so."""
        condition = closed(equation.params["cond_jaxpr"])
        body = closed(equation.params["body_jaxpr"])
        if any(draws(program.jaxpr) for program in (condition, body)):
            raise UserError(
                "This policy draws in a loop without a fixed length, and a file holds nothing that draws; play it "
                "with ringfence.Controller."
            )
        num_asked, num_consts = while_counts(equation)
        asked = inputs[:num_asked]
        constants = inputs[num_asked : num_asked + num_consts]
        return jax.lax.while_loop(
            lambda carry: self.run(condition, [*asked, *carry])[0],
            lambda carry: self.run(body, [*constants, *carry]),
            inputs[num_asked + num_consts :],
        )

    def _cond(self, equation: core.JaxprEqn, inputs: list[Any]) -> list[Any]:
        """Branches; all of them, where they may draw."""
        index, *operands = inputs
        branches = [partial(self.run, closed(branch)) for branch in equation.params["branches"]]
        if reads_key(equation):
            outputs = [branch(operands) for branch in branches]
            return [jax.lax.select_n(index, *column) for column in zip(*outputs)]
        return jax.lax.switch(index, branches, operands)

    def _simpler(self, equation: core.JaxprEqn, inputs: list[Any]) -> list[Any]:
        """One equation by what every runtime has; now, where all it reads is known and what it gives is small or no
        larger."""
        name = equation.primitive.name
        if name == "select_n" and jnp.issubdtype(dtype_of(equation.outvars[0]), np.bool_) and len(inputs) == 3:
            which, no, yes = inputs  # onnxruntime chooses among numbers alone
            return [(which & yes) | (~which & no)]
        if name in MOVES:
            picked = _picked(equation, inputs)
            if picked is not None:
                return [picked]
        size = sum(_size(variable) for variable in equation.outvars)
        small = size <= max(MAX_FOLDED, sum(_size(variable) for variable in equation.invars))
        known = not any(isinstance(x, Tracer) for x in inputs)
        with jax.ensure_compile_time_eval() if known and small else nullcontext():
            return bind(equation, inputs)


# --- equations and what they hold ---


def value(variable: Any, known: dict[Any, Any]) -> Any:
    """Of a variable or a literal."""
    return variable.val if isinstance(variable, core.Literal) else known[variable]


def values_of(program: core.ClosedJaxpr) -> dict[Any, Any]:
    """The constants that a program closes over."""
    return dict(zip(program.jaxpr.constvars, program.consts))


def bind(equation: core.JaxprEqn, inputs: Sequence[Any]) -> list[Any]:
    """One equation as JAX itself would play it."""
    outputs = equation.primitive.bind(*inputs, **equation.params)
    return list(outputs) if equation.primitive.multiple_results else [outputs]


def closed(program: core.Jaxpr | core.ClosedJaxpr) -> core.ClosedJaxpr:
    return program if isinstance(program, core.ClosedJaxpr) else core.ClosedJaxpr(program, ())


def called(equation: core.JaxprEqn) -> core.ClosedJaxpr:
    """The program that a call calls."""
    return closed(next(equation.params[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in equation.params))


def programs_in(equation: core.JaxprEqn) -> Iterator[core.ClosedJaxpr]:
    """Every program that an equation holds."""
    for parameter in equation.params.values():
        for one in parameter if isinstance(parameter, tuple | list) else (parameter,):
            if isinstance(one, core.Jaxpr | core.ClosedJaxpr):
                yield closed(one)


def operations(jaxpr: core.Jaxpr) -> int:
    """How many equations there are, those of programs within them included."""
    return sum(1 + sum(operations(one.jaxpr) for one in programs_in(equation)) for equation in jaxpr.eqns)


def scan_counts(equation: core.JaxprEqn) -> tuple[int, int]:
    """(constants, carried) inputs of a `scan`: what is carried has the same shape inside and outside, rows of what is
    stacked have an axis less."""
    inside = closed(equation.params["jaxpr"]).jaxpr
    rows = sum(len(shape_of(row)) < len(shape_of(whole)) for row, whole in zip(inside.invars, equation.invars))
    num_carry = sum(len(shape_of(one)) == len(shape_of(whole)) for one, whole in zip(inside.outvars, equation.outvars))
    return len(equation.invars) - rows - num_carry, num_carry


def while_counts(equation: core.JaxprEqn) -> tuple[int, int]:
    """(constants of the condition, constants of the body) among the inputs of a `while`: both read the carry, too."""
    num_carry = len(equation.outvars)
    condition = closed(equation.params["cond_jaxpr"]).jaxpr
    body = closed(equation.params["body_jaxpr"]).jaxpr
    return len(condition.invars) - num_carry, len(body.invars) - num_carry


def shape_of(variable: Any) -> tuple[int, ...]:
    return variable.aval.shape


def dtype_of(variable: Any) -> Any:
    return variable.aval.dtype


def is_key(variable: Any) -> bool:
    """Whether a variable is a key of random numbers."""
    return jnp.issubdtype(getattr(variable.aval, "dtype", np.float32), jax.dtypes.prng_key)  # tokens have no type


def reads_key(equation: core.JaxprEqn) -> bool:
    return any(is_key(variable) for variable in equation.invars)


def draws_normal(equation: core.JaxprEqn) -> bool:
    """Whether this is `jax.random.normal`."""
    return equation.params.get("name") == "_normal" and reads_key(equation)


def draws(jaxpr: core.Jaxpr) -> list[jax.ShapeDtypeStruct]:
    """The normal numbers that a program draws, in the order in which an `Interpreter` asks for them; those within a
    `while` stand there once."""
    found: list[jax.ShapeDtypeStruct] = []
    for equation in jaxpr.eqns:
        if draws_normal(equation):
            (drawn,) = equation.outvars
            found.append(jax.ShapeDtypeStruct(shape_of(drawn), dtype_of(drawn)))
        elif reads_key(equation):
            inside = [shape for program in programs_in(equation) for shape in draws(program.jaxpr)]
            found += inside * (equation.params["length"] if equation.primitive.name == "scan" else 1)
    return found


def live(
    jaxpr: core.Jaxpr, inputs: Sequence[str], carried: Sequence[str], num_outputs: int
) -> tuple[list[core.JaxprEqn], set[str]]:
    """(equations, names of inputs) that the first `num_outputs` outputs need, now or later on.

    The outputs after those are the next values of the inputs named `carried`: they are needed where the input is.
    """
    used: set[str] = set()
    while True:
        needed = _variables(jaxpr.outvars[:num_outputs])
        needed |= _variables(v for v, name in zip(jaxpr.outvars[num_outputs:], carried) if name in used)
        kept = []
        for equation in reversed(jaxpr.eqns):
            if not needed.isdisjoint(equation.outvars):
                kept.append(equation)
                needed |= _variables(equation.invars)
        found = {name for name, variable in zip(inputs, jaxpr.invars) if variable in needed}
        if found == used:
            return kept[::-1], used
        used = found


def _variables(some: Any) -> set[Any]:
    return {variable for variable in some if not isinstance(variable, core.Literal)}


def _size(variable: Any) -> int:
    return getattr(variable.aval, "size", 0)


def _check_known(equation: core.JaxprEqn) -> None:
    name = equation.primitive.name
    if name in CALLBACKS:
        raise UserError(f"This policy calls Python by '{name}', and a file holds no Python; compute it with jax.numpy.")
    if name in BOUND or name.startswith("scatter") or next(programs_in(equation), None) is None:
        return
    raise UserError(
        f"This policy uses '{name}', a program within a program that Ringfence cannot take apart with jax "
        f"{jax.__version__}; play it with ringfence.Controller."
    )


# --- gathers and scatters at known places ---


def _picked(equation: core.JaxprEqn, inputs: list[Any]) -> Array | None:
    """What a gather or scatter at known places gives, as entries picked from a flat array, which every runtime does at
    once; None where the places are not known or what is read lies outside."""
    x, places, *updates = inputs
    if isinstance(places, Tracer) or not any(isinstance(v, Tracer) for v in inputs):
        return None
    if x.size + sum(v.size for v in updates) >= MAX_PICKED or not jnp.issubdtype(x.dtype, jnp.number):
        return None
    here = np.arange(x.size).reshape(x.shape)
    flat = jax.lax.reshape(x, (x.size,))
    if not updates:
        read = _moved(equation, places, x.dtype, here)
        inside = not read.size or 0 <= read.min() <= read.max() < x.size
        return _at(flat, read) if inside else None
    (update,) = updates
    put = jax.lax.reshape(update, (update.size,))
    there = np.arange(update.size).reshape(update.shape)
    if equation.primitive.name == "scatter":
        return _at(jnp.concatenate([flat, put]), _moved(equation, places, x.dtype, here, there + x.size))
    if there.size * x.size > MAX_LAYERED:
        return None
    return _added(equation, places, x, put, there.shape)


def _added(equation: core.JaxprEqn, places: Any, x: Array, put: Array, shape: tuple[int, ...]) -> Array:
    """What a scatter that adds gives: layer by layer, at most one number for every place."""
    one_each = np.eye(put.size).reshape(-1, *shape)
    goes = _moved(equation, places, x.dtype, np.zeros(x.shape), one_each, many=True).reshape(put.size, x.size)
    order = goes.cumsum(0) * goes  # 1 for the first number that is added to a place, 2 for the second, ...
    padded = jnp.concatenate([jnp.zeros(1, put.dtype), put])
    total = x
    for k in range(1, order.max(initial=0) + 1):
        layer = np.where((order == k).any(0), (order == k).argmax(0) + 1, 0)
        total = total + _at(padded, layer.reshape(x.shape))
    return total


def _moved(
    equation: core.JaxprEqn, places: Any, dtype: Any, to: np.ndarray, *updates: np.ndarray, many: bool = False
) -> np.ndarray:
    """Where entries go: the same move of their numbers, now; for each of `many` updates."""

    def move(*updates: Array) -> Array:
        return equation.primitive.bind(jnp.asarray(to, dtype), places, *updates, **equation.params)

    with jax.ensure_compile_time_eval():
        given = [jnp.asarray(update, dtype) for update in updates]
        moved = (jax.vmap(move) if many else move)(*given)
        return np.asarray(moved).astype(np.int64)


def _at(flat: Array, places: np.ndarray) -> Array:
    """Entries of a flat array at places (...) that lie in it."""
    one = jax.lax.GatherDimensionNumbers(offset_dims=(), collapsed_slice_dims=(0,), start_index_map=(0,))
    inside = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
    picked = jax.lax.gather(flat, places.reshape(-1, 1).astype(np.int32), one, (1,), mode=inside)
    return jax.lax.reshape(picked, places.shape)
