"""What several test files ask for by name."""

import dataclasses
import functools

import jax
import pytest

from ringfence.guards import searched
from ringfence.world import margins, validate

# A World that is fitted in a second and knows little.
QUICK_WORLD = dict(
    num_ensemble=2,
    dynamics_updates=20,
    dynamics_width=16,
    value_updates=20,
    barrier_updates=20,
    barrier_width=8,
    future_updates=20,
)

# What judges a World, and what stands for it in tests.
_LITTLE = {
    (searched, "false_safe"): lambda *_: None,
    (validate, "_avoidable"): lambda *_: None,
    (margins, "AHEAD"): margins.AHEAD[:1],
}
_IN_FULL = {place: getattr(*place) for place in _LITTLE}


def judge_little() -> None:
    """Worlds that are fitted from now on are hardly judged; where they are, of few entries and by a short search."""
    validate.ENTERED = 20
    searched.SHIELD = dataclasses.replace(searched.SHIELD, correction_restarts=0)
    for place, little in _LITTLE.items():
        setattr(*place, little)


def judge_in_full(patch: pytest.MonkeyPatch) -> None:
    """Worlds are judged by all that judges them, until the patch ends."""
    for place, whole in _IN_FULL.items():
        patch.setattr(*place, whole)


def in_one_program(function, *arguments):
    """What a function of JAX gives, compiled as a whole: operation by operation takes a program each."""
    fixed = tuple(k for k, x in enumerate(arguments) if isinstance(x, int))
    return jax.jit(lambda *given: function(*given), static_argnums=fixed)(*arguments)


class Compiled:
    """A simulator whose methods are a program each; what is no method of arrays is its own."""

    METHODS = ("reset", "step", "observe", "global_state", "from_global_state", "clearance")

    def __init__(self, env):
        self.env = env

    def __getattr__(self, name):
        found = getattr(self.env, name)
        return _program(self.env, name) if name in self.METHODS else found


@functools.cache
def _program(env, name):
    return jax.jit(getattr(env, name), static_argnums=1 if name == "reset" else ())
