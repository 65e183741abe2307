"""Model-predictive control from a zero proposal: nothing is learned but the World, nothing is proposed but rest, and
whatever is done a guard finds by climbing value from noise (guards/filter.py, `refine`). What a learned proposal is
worth is what it adds to this."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from ringfence.algos.untrained import untrained
from ringfence.problem.bounds import Bounds
from ringfence.types import Array, Key, PolicyStep, PyTree, Spec
from ringfence.world import World


class Rest(eqx.Module):
    """Proposes to do nothing."""

    spec: Spec = eqx.field(static=True)

    def initial_state(self, batch: int) -> PyTree:
        return {}

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        s = self.spec
        shape = (observations.shape[0], s.n_agents, s.action_dim)
        return carry, PolicyStep(jnp.full(shape, Bounds(s.action_low, s.action_high).middle, jnp.float32), {})

    def propose(
        self, carry: PyTree, observations: Array, state: Array, key: Key, count: int, rows: int, world: World
    ) -> tuple[PyTree, Array, dict[str, Array]]:
        shape = (observations.shape[0], 1, rows, self.spec.n_agents, self.spec.action_dim)
        return carry, jnp.zeros(shape), {}


MPC = untrained("mpc", Rest)
