"""A classical filter for systems of the proving ground: control barrier functions by formula, and a quadratic program.

Nobody tells a guard that learns what this one knows: every distance from danger, the simulator's dynamics, and how hard
a body brakes. Of each distance d it keeps h = sqrt(2 k a d) + ḋ, k of whom brake by a (Wang, Ames and Egerstedt 2017,
Safety barrier certificates for collisions-free multirobot systems), by the condition of discrete time
h⁺ ≥ (1 − γ) h (Agrawal and Sreenath 2017), in which h⁺ is linear in the agent's own action around what is proposed.
Others go on without a push; two who answer for a distance take half of it each. Each agent solves its program of at
most two unknowns exactly, and brakes where it has no solution. Quadrotors, whose pitch acts two steps later, and
batteries have no such filter here.

results/stress/filters.csv has one for Crossing behind faults, in continuous time. It knows nothing that is learned, so
its rows stay as they are; revision cac628af made them.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs import System
from ringfence.envs.proving.bodies import Motion, length
from ringfence.envs.proving.layout import SystemState
from ringfence.types import Array, Key, PolicyStep, PyTree

GAMMA = 0.1  # share of h that a step may take; both chosen on the four development systems, validation resets
SPARE = 0.06  # m (or rad) that is kept: the condition is linear, and steps are not small
SHARED = ("pairs", "apart")  # distances that two answer for
SIDES = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))


def filtered(system: System) -> bool:
    """Whether there is such a filter."""
    return system.body != "quadrotor" and "battery" not in system.danger


class CbfQp(eqx.Module):
    """A policy whose actions (B, N, A) are changed as little as the barriers allow."""

    proposal: Any
    system: System = eqx.field(static=True)

    def initial_state(self, batch: int) -> PyTree:
        return self.proposal.initial_state(batch)

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        assert state is not None, "systems have one"
        system = self.system
        carry, step = self.proposal.act(carry, observations, state, key)
        now = system.from_global_state(state)
        wanted = system.unit(system.physical(step.action))
        normals, limits = self._conditions(now, wanted)
        found, met = nearest(_in_plane(wanted), normals, limits)
        found = found[..., : system.action_dim]
        still = jnp.zeros_like(now.rate)
        slowest = jnp.zeros(now.rate.shape[:-1])
        braking = system.unit(system.made_of.steer(now.motion, still, slowest, system.plant))
        action = system.given(system.physical(jnp.where(met[..., None], found, braking)))
        return carry, PolicyStep(action, {"infeasible": ~met.all(-1)})

    def _conditions(self, now: SystemState, wanted: Array) -> tuple[Array, Array]:
        """Half planes n · u ≤ l of the own action: normals (B, N, M, 2) and limits (B, N, M)."""
        system = self.system
        others, phase = self._moved(now, None), now.phase + 2 * jnp.pi * system.dt / system.mover[2]
        h, shared = self._barriers(now.motion, now.motion, now.phase)
        drifted, _ = self._barriers(others, others, phase)

        def after(action: Array) -> Array:
            return self._barriers(self._moved(now, action), others, phase)[0]

        slopes = []
        for axis in range(system.action_dim):
            push = jnp.zeros_like(wanted).at[..., axis].set(1.0)
            then, slope = jax.jvp(after, (wanted,), (push,))
            slopes.append(slope)
        slope = _in_plane(jnp.stack(slopes, -1))
        asked = jnp.where(shared, 0.5 * (drifted + (1 - GAMMA) * h), (1 - GAMMA) * h)
        # then + slope · (u − wanted) ≥ asked
        limit = then - asked - (slope * _in_plane(wanted)[..., None, :]).sum(-1)
        size = length(slope)
        acts = size > 1e-4
        normal = jnp.where(acts[..., None], -slope / jnp.maximum(size, 1e-4)[..., None], np.array([1.0, 0.0]))
        limit = jnp.where(acts, limit / jnp.maximum(size, 1e-4), 1e3)
        sides = jnp.broadcast_to(np.array(SIDES), (*wanted.shape[:-1], 4, 2))
        return jnp.concatenate([normal, sides], -2), jnp.concatenate([limit, jnp.ones(sides.shape[:-1])], -1)

    def _moved(self, now: SystemState, action: Array | None) -> Motion:
        """Everybody a step later, under their own actions, or without a push."""
        system = self.system
        push = jnp.zeros_like(now.applied) if action is None else self._physical(action)
        applied = now.applied + system.dt / (system.lag + system.dt) * (push - now.applied)
        return system.made_of.move(now.motion, applied, system.plant)

    def _physical(self, unit: Array) -> Array:
        """Unclipped, so that it has a slope at the bounds."""
        low, high = self.system.bounds
        return (unit + 1.0) / 2 * (high - low) + low

    def _barriers(self, own: Motion, others: Motion, phase: Array) -> tuple[Array, np.ndarray]:
        """(h (B, N, M), whether two answer for it (M,))."""
        system = self.system
        mover = system.mover_at(phase)
        rates = (own.rate, others.rate, system.mover_rate(phase))
        distance, change = jax.jvp(system.of_place, (own.config, others.config, mover), rates)
        brake = system.made_of.brake / float(system.plant.mass.max())
        found, shared = [], []
        for name, d in distance.items():
            both = 2 if name in SHARED else 1
            room = d - SPARE
            # beyond the edge it grows on, so that who is too near has to leave
            reach = jnp.where(room > 0, jnp.sqrt(2 * both * brake * jnp.maximum(room, 1e-6)), 5 * room)
            found.append(reach + change[name])
            shared += [name in SHARED] * d.shape[-1]
        if "speed" in system.danger:
            found.append((system.speed_limit - length(own.rate))[..., None] - SPARE)
            shared.append(False)
        return jnp.concatenate(found, -1), np.array(shared)


def _in_plane(x: Array) -> Array:
    """Vectors of one entry with a second one of 0."""
    return x if x.shape[-1] == 2 else jnp.concatenate([x, jnp.zeros_like(x)], -1)


def nearest(wanted: Array, normals: Array, limits: Array) -> tuple[Array, Array]:
    """(the point (..., 2) of all half planes n · u ≤ l that is nearest to `wanted`, whether there is one): in a plane
    that is `wanted` itself, its projection on a side, or a corner."""
    over = (normals * wanted[..., None, :]).sum(-1) - limits
    on_sides = wanted[..., None, :] - over[..., None] * normals
    first, second = np.triu_indices(normals.shape[-2], 1)
    (a, b), (c, d) = (jnp.moveaxis(normals[..., k, :], -1, 0) for k in (first, second))
    e, f = limits[..., first], limits[..., second]
    det = a * d - b * c
    det = jnp.where(jnp.abs(det) < 1e-6, jnp.nan, det)
    corners = jnp.stack([(e * d - b * f) / det, (a * f - e * c) / det], -1)
    points = jnp.concatenate([wanted[..., None, :], on_sides, corners], -2)
    inside = ((normals[..., None, :, :] * points[..., None, :]).sum(-1) <= limits[..., None, :] + 1e-4).all(-1)
    far = jnp.where(inside, ((points - wanted[..., None, :]) ** 2).sum(-1), jnp.inf)
    best = far.argmin(-1)
    return jnp.take_along_axis(points, best[..., None, None], -2)[..., 0, :], inside.any(-1)
