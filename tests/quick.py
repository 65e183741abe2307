"""What several test files ask for by name."""

import functools

import jax

from ringfence.world.judging import Judging

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

# How Worlds of tests are judged: hardly, or by all that judges them, of fewer entries and by a search that never begins
# again.
LITTLE = Judging(avoided=0, searched=0, played=0, widened=(5,))
IN_FULL = Judging(avoided=20, restarts=0, played=0)


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
