"""Programs of JAX taken apart: played equation by equation they give what JAX gives, and stay what a file holds."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core

from ringfence.deploy import jaxpr
from ringfence.deploy.jaxpr import Interpreter
from ringfence.errors import UserError

X = jnp.linspace(-1.0, 2.0, 5)
ROWS = jnp.arange(15.0).reshape(3, 5)


def no_draw(equation, inputs):
    pytest.fail("nothing draws here")


def interpreted(f, *arguments, draw=no_draw, simplify: bool = False):
    """(what the interpreter makes of f's program, the names of primitives in it)."""
    program = jax.make_jaxpr(f)(*arguments)

    def play(*arguments):
        return Interpreter(draw, simplify).run(program, jax.tree.leaves(arguments))

    return play, names_in(jax.make_jaxpr(play)(*arguments))


def names_in(program: core.ClosedJaxpr) -> list[str]:
    """Of all primitives, inside and out."""
    names = []
    for equation in program.jaxpr.eqns:
        names.append(equation.primitive.name)
        names += [name for inside in jaxpr.programs_in(equation) for name in names_in(inside)]
    return names


def check(f, *arguments, **how) -> list[str]:
    """That f is played as JAX plays it; the names of primitives that are left."""
    play, names = interpreted(f, *arguments, **how)
    for ours, theirs in zip(jax.jit(play)(*arguments), jax.tree.leaves(f(*arguments)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    return names


def accumulate(x, rows, **options):
    """A loop that closes over one array, carries two and stacks two."""

    def step(carry, row):
        total, count = carry
        return (total + row * x, count + 1), (total.sum(), row[:2])

    return jax.lax.scan(step, (jnp.zeros(5), 0), rows, **options)


def test_a_loop_of_known_length_stays_one():
    names = check(accumulate, X, ROWS)
    assert "scan" in names


@pytest.mark.parametrize("options", [{"reverse": True}, {"unroll": 3}, {"unroll": True}])
def test_a_loop_is_unrolled_where_it_runs_backwards_or_was_to_be(options):
    names = check(lambda x, rows: accumulate(x, rows, **options), X, ROWS)
    assert "scan" not in names


def test_a_loop_without_rows_or_without_carry():
    assert "scan" in check(lambda x: jax.lax.scan(lambda total, _: (total + x, None), x, length=4), X)
    assert "scan" in check(lambda rows: jax.lax.scan(lambda _, row: (None, row.sum()), None, rows), ROWS)


def test_what_a_loop_closes_over_carries_and_stacks_is_told_by_shapes():
    (equation,) = (e for e in jax.make_jaxpr(accumulate)(X, ROWS).jaxpr.eqns if e.primitive.name == "scan")
    assert jaxpr.scan_counts(equation) == (1, 2)
    private = [name for name in ("num_consts", "num_carry", "ft_in", "ft_out") if name in equation.params]
    kept = {name: value for name, value in equation.params.items() if name not in private}
    assert jaxpr.scan_counts(equation.replace(params=kept)) == (1, 2), "whatever this version calls them"


def until(x, limit):
    """A loop whose condition and body each close over an array of their own."""
    return jax.lax.while_loop(
        lambda carry: carry[1] < limit.sum(), lambda carry: (carry[0] * x, carry[1] + 1.0), (x, 0.0)
    )


def test_a_loop_of_unknown_length_stays_one():
    assert "while" in check(until, X, jnp.ones(3))
    (equation,) = (e for e in jax.make_jaxpr(until)(X, jnp.ones(3)).jaxpr.eqns if e.primitive.name == "while")
    kept = {name: value for name, value in equation.params.items() if not name.endswith("_nconsts")}
    assert jaxpr.while_counts(equation.replace(params=kept)) == (1, 1)


def test_branches_stay_branches():
    def choose(k, x):
        return jax.lax.switch(k, [jnp.sin, lambda x: x * 2, lambda x: -x], x)

    for k in range(3):
        assert "cond" in check(choose, k, X)


def test_calls_are_taken_apart():
    @jax.custom_jvp
    def clipped(x):
        return jnp.clip(x, -0.5, 0.5)

    clipped.defjvp(lambda primals, tangents: (clipped(*primals), tangents[0]))

    @jax.custom_vjp
    def halved(x):
        return x / 2

    halved.defvjp(lambda x: (halved(x), None), lambda _, g: (g,))

    def nested(x):
        inner = jax.jit(lambda x: jax.jit(jnp.tanh)(x) + np.arange(5.0, dtype=np.float32))
        return jax.checkpoint(inner)(halved(clipped(x))), jax.nn.relu(x), jax.grad(lambda x: clipped(x).sum())(x)

    assert not {*check(nested, X)} & {*jaxpr.CALLS}


def test_what_jax_takes_along_is_bound_as_it_is():
    names = check(lambda x: jnp.linalg.solve(jnp.eye(5) + jnp.outer(x, x), x), X)
    assert "custom_linear_solve" in names
    assert "scatter-add" in check(lambda x: x.at[jnp.array([1, 1])].add(2.0), X)


def drawing(key, x, flag):
    """Draws before a loop, in every round of it, in a call and in one branch."""
    first, second, third = jax.random.split(key, 3)
    start = jax.jit(lambda key: jax.random.normal(key, (5,)))(first)
    step = lambda carry, key: (carry + jax.random.normal(key, (5,)), None)  # noqa: E731
    total, _ = jax.lax.scan(step, start * x, jax.random.split(second, 3))
    return total + jax.lax.cond(flag, lambda key: jax.random.normal(key), lambda key: 0.0, third)


@pytest.mark.parametrize("flag", [True, False])
def test_normal_noise_is_asked_for_in_order(flag):
    key = jax.random.key(3)
    program = jax.make_jaxpr(drawing)(key, X, flag)
    assert [shape.shape for shape in jaxpr.draws(program.jaxpr)] == [(5,), (5,), (5,), (5,), ()]
    drawn = []

    def keep(equation, inputs):
        drawn.append(jaxpr.bind(equation, inputs)[0])
        return drawn[-1]

    (ours,) = Interpreter(keep).run(program, [key, X, flag])
    np.testing.assert_allclose(ours, drawing(key, X, flag), rtol=1e-6)
    given = iter(drawn)
    (again,) = Interpreter(lambda *_: next(given)).run(program, [jax.random.key(9), X, flag])
    np.testing.assert_array_equal(again, ours)
    assert next(given, None) is None


def test_what_cannot_be_taken_apart_is_refused_in_a_sentence():
    def drawn_until(key):
        draw = lambda carry: carry + jax.random.normal(key)  # noqa: E731
        return jax.lax.while_loop(lambda carry: carry < 3, draw, 0.0)

    with pytest.raises(UserError, match="draws in a loop without a fixed length"):
        interpreted(drawn_until, jax.random.key(0), draw=lambda *_: 0.0)

    def calls_python(x):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((5,), "float32"), x)

    with pytest.raises(UserError, match="calls Python by 'pure_callback', and a file holds no Python"):
        interpreted(calls_python, X)

    inside = jax.make_jaxpr(jnp.sin)(X)
    strange = core.Primitive("strange_call")
    strange.def_abstract_eval(lambda x, **_: x)
    program = jax.make_jaxpr(lambda x: strange.bind(x, body=inside))(X)
    with pytest.raises(UserError, match=r"uses 'strange_call', a program within a program .*; play it with ringfence"):
        Interpreter(no_draw).run(program, [X])


def test_what_is_known_is_computed_now():
    def scaled(x):
        return x * jnp.sin(jnp.ones(5)).sum()

    names = check(scaled, X, simplify=True)
    assert "sin" not in names and names.count("mul") == 1


def test_truths_are_chosen_by_logic():
    """onnxruntime's choice is among numbers alone."""
    names = check(lambda x: jnp.where(x > 0, x > 1, x < -0.5), X, simplify=True)
    assert "select_n" not in names


def test_gathers_and_scatters_at_known_places_are_picked_exactly():
    """Repeated, left-out and outer places included."""
    x, put = jax.random.normal(jax.random.key(0), (4, 5)), jax.random.normal(jax.random.key(1), (4, 3))
    at = np.array([3, 0, 3])

    def moved(x, put):
        rows = jnp.array([2, 9, 2])
        return [
            x[:, at],
            x.at[:, np.array([4, 1, 0])].set(put),
            x.at[:, at].add(put),
            x.at[rows].add(put.T[:, 0:1], mode="drop"),
            jax.grad(lambda x: (x[:, at] ** 2).sum())(x),
        ]

    names = check(moved, x, put, simplify=True)
    assert not any("scatter" in name for name in names)


def test_only_what_is_needed_is_kept():
    """An output, what leads to it, and memory that it reads now or later on."""

    def step(seen, unread, count, last, total):
        return seen * count, count + last, last * 1.0, total + unread

    program = jax.make_jaxpr(step)(*[1.0] * 5).jaxpr
    names = ["seen", "unread", "count", "last", "total"]
    equations, used = jaxpr.live(program, names, names[2:], 1)
    assert used == {"seen", "count", "last"}
    assert [equation.primitive.name for equation in equations] == ["mul", "add", "mul"]
