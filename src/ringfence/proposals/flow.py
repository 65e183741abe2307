"""Joint actions by a rectified flow, of a driver that is drawn once for an episode, where it begins, and kept.

noise ε (N·A) ──┐
state, driver ──┼─► clean action â(a_τ, τ)   a_τ+Δ = a_τ + Δ (â − a_τ)/(1 − τ)    τ = 0 .. 1 in 1 to 4 steps

With `barrier_guidance` every step moves â to where a World's danger keeps its margin (guidance.py).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.errors import UserError
from ringfence.problem.features import FeatureMap
from ringfence.problem.normalise import Normaliser
from ringfence.proposals.base import from_unit, rolled
from ringfence.proposals.drivers import asked, classifier_free, draw, several
from ringfence.proposals.guidance import Guide, Way
from ringfence.proposals.options import PlanOptions
from ringfence.types import Array, Key, PolicyStep, PyTree, Spec
from ringfence.world import World

WAVES = 4  # sines and cosines of τ
UNREAD = ("sampler", "value_guidance", "reconcile", "replan", "execution")  # options of plans of states


def time_entries(tau: Array) -> Array:
    """(...,) τ in [0, 1] -> (..., 2 · WAVES)."""
    angle = tau[..., None] * (jnp.pi / 2 * 2.0 ** jnp.arange(WAVES))
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)


def clean_action(net: Any, seen: Array, action: Array, tau: Array, driver: Array, score: Array, keep: Array) -> Array:
    """â (B, N·A) of a noised action (B, N·A) at τ (B,): `seen` (B, N·D) standardised, `driver` (B, C) one of C, `score`
    (B,) the condition y where `keep` (B,) says so."""
    return net(jnp.concatenate([seen, action, time_entries(tau), driver, asked(seen, score, keep)], -1))


class FlowPolicy(eqx.Module):
    """Follows one of the drivers that the logs were found to hold; which one is drawn when an episode begins."""

    networks: dict[str, Any]  # flow, prior
    normaliser: Normaliser
    drivers: int = eqx.field(static=True)
    conditioned: bool = eqx.field(static=True)  # whether it learned to read the return
    spec: Spec = eqx.field(static=True)
    feature_map: FeatureMap = eqx.field(static=True)
    options: PlanOptions = eqx.field(static=True)
    guide: Guide | None = None  # of the sampling, where `barrier_guidance` asks for it

    def __check_init__(self):
        usual = PlanOptions()
        for name in UNREAD:
            if getattr(self.options, name) != getattr(usual, name):
                raise UserError(
                    f"{name}={getattr(self.options, name)} is about plans of states, and flow draws joint actions; "
                    "leave it out."
                )
        for name in ("target_return", "cfg_scale"):
            if not self.conditioned and getattr(self.options, name) != getattr(usual, name):
                raise UserError(
                    f"{name}={getattr(self.options, name)} is read by nothing, because the run was trained with "
                    "condition='none'; train with the preset return."
                )

    def initial_state(self, batch: int) -> PyTree:
        return {"driver": jnp.zeros(batch, jnp.int32), "age": jnp.zeros((), jnp.int32)}

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        """observations (B, N, O), state (B, S) -> joint action (B, N, A) within the task's bounds."""
        x = self.feature_map(observations, state)
        carry, key = self._with_driver(carry, x, key)
        present = None if self.guide is None else self.guide.world.map(observations, state)
        action = self.draw(x, carry["driver"], key, present)
        return carry, PolicyStep(from_unit(action, self.spec), {})

    def propose(
        self, carry: PyTree, observations: Array, state: Array, key: Key, count: int, rows: int, world: World
    ) -> tuple[PyTree, Array, dict[str, Array]]:
        """(carry, actions (B, `count`, `rows`, N, A) in [−1, 1], info) along the rows that the World foresees: the
        first of the episode's own driver, the others of such as may drive here."""
        x = self.feature_map(observations, state)
        carry, key = self._with_driver(carry, x, key)
        batch = observations.shape[0]
        driver = several(
            carry["driver"], count, lambda more: self._drawn(jnp.repeat(x, more, 0), jax.random.fold_in(key, 1))
        )

        guides = None if self.guide is None else jnp.repeat(self.guide.world.map(observations, state), count, 0)
        seen, present = (jnp.repeat(m(observations, state), count, 0) for m in (self.feature_map, world.map))
        temperatures = jnp.tile(self.options.temperatures(count), batch)

        def act(x: Array) -> Array:
            # what is foreseen is proposed unguided
            return self.draw(x, driver, key, guides if x is seen else None, temperatures)

        actions = rolled(act, self.feature_map, world, seen, present, rows)
        return carry, actions.reshape(batch, count, *actions.shape[2:]), {}

    def draw(
        self, x: Array, driver: Array, key: Key, present: Array | None = None, temperature: Array | None = None
    ) -> Array:
        """Actions (B, N, A) in [−1, 1] at features (B, N, D), of drivers (B,), from noise of `temperature` (B,), by
        default the options' one; guided from `present` (B, N, D'), the same in the World's view."""
        o, s = self.options, self.spec
        batch = x.shape[0]
        seen = self._seen(x)
        which = jax.nn.one_hot(driver, self.drivers)

        def clean(action: Array, tau: Array) -> Array:
            def answer(score: Array, keep: Array) -> Array:
                return clean_action(self.networks["flow"], seen, action, tau, which, score, keep)

            return self._guided(answer, batch)

        def joint(action: Array) -> Array:
            return s.own(jnp.clip(action, -1.0, 1.0).reshape(batch, s.n_agents, s.action_dim))

        heat = o.temperature if temperature is None else temperature[:, None]
        action = heat * jax.random.normal(key, (batch, s.n_agents * s.action_dim))
        for k in range(o.sampling_steps):
            aim = clean(action, jnp.full(batch, k / o.sampling_steps))
            if present is not None and self.guide is not None:
                way = Way(lambda aim: aim[:, None], lambda _, aim: joint(aim), aim, False)
                aim = self.guide.moved(present, way, aim, 1)
            action = action + (aim - action) / (o.sampling_steps - k)
        return joint(action)

    def _guided(self, answer: Callable[[Array, Array], Array], batch: int) -> Array:
        """What answers to (y, whether it is given), guided by the return that is asked for, if training knew any."""
        score = jnp.full(batch, self.options.target_return)
        if not self.conditioned:
            return answer(score, jnp.zeros(batch, bool))
        return classifier_free(answer, score, self.options.cfg_scale)

    def _with_driver(self, carry: PyTree, x: Array, key: Key) -> tuple[PyTree, Key]:
        """What is carried, with the driver that this episode's first features x (B, N, D) draw, and a key."""
        k1, k2 = jax.random.split(key)
        driver = jnp.where(carry["age"] == 0, self._drawn(x, k1), carry["driver"])
        return {"driver": driver, "age": carry["age"] + 1}, k2

    def _drawn(self, x: Array, key: Key) -> Array:
        """(B,) who drives at features x (B, N, D), drawn."""
        return draw(self.networks["prior"], self._seen(x), key, lambda ask: self._guided(ask, x.shape[0]))

    def _seen(self, x: Array) -> Array:
        """(B, N·D) what networks read of features (B, N, D)."""
        return self.normaliser.state(x).reshape(x.shape[0], -1)
