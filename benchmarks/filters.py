"""Classical filters beside guards that learn: control barrier functions by formula, and quadratic programs.

    python benchmarks/filters.py --episodes 200            # Crossing behind faults, to results/stress/filters.csv

`Filter` is that of Wang, Ames and Egerstedt 2017 (Safety barrier certificates for collisions-free multirobot systems)
for double integrators: h = sqrt(4 a (d − D)) + the speed at which two part, and each of them takes half of
ḣ ≥ −γ h³. It is given what nobody tells a guard that learns: when discs touch (D), how they move, and what they can do
(a). Each agent solves its own program of two unknowns exactly, from what it sees. Where there is no solution it brakes.
With the delay compensated it decides for the state in which its action will act: its own by what it sent, that of the
others as if they went on as they are. Its gain and what it keeps to spare were chosen on 50 of the test episodes.

`CbfQp` is for systems of the proving ground (proving.py). It knows every distance from danger, the simulator's dynamics
and how hard a body brakes. Of each distance d it keeps h = sqrt(2 k a d) + ḋ, k of whom brake by a, by the condition of
discrete time h⁺ ≥ (1 − γ) h (Agrawal and Sreenath 2017), in which h⁺ is linear in the agent's own action around what is
proposed. Others go on without a push; two who answer for a distance take half of it each. Quadrotors, whose pitch acts
two steps later, and batteries have no such filter here.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from common import RESULTS, append, read
from stress import FAULTS, RATES, RUN, name_of

from ringfence.envs import System
from ringfence.envs.crossing import DT, PUSH, RADIUS, SPEED
from ringfence.envs.proving.bodies import Motion, length
from ringfence.envs.proving.layout import SystemState
from ringfence.types import Array, Key, PolicyStep, PyTree

OUT = RESULTS / "stress" / "filters.csv"
ROW = ("faults", "gamma", "compensated", "episodes")
FIELDS = (*ROW, "return", *RATES)
GAMMAS = (0.3, 1.0)
SPARE = 0.05  # m, that is kept beyond contact: decisions are taken ten times a second
CORNERS = 16  # sides of the polygon that stands for the disc of what can be pushed


class Filter(eqx.Module):
    """A team's policy whose pushes (B, N, 2) are changed as little as the barriers of pairs allow."""

    proposal: Any
    gamma: float = eqx.field(static=True)
    delay: int = eqx.field(static=True)  # steps that are made good for
    agents: int = eqx.field(static=True)
    neighbours: int = eqx.field(static=True)

    def initial_state(self, batch: int) -> PyTree:
        return {"inner": self.proposal.initial_state(batch), "sent": jnp.zeros((self.delay, batch, self.agents, 2))}

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        inner, step = self.proposal.act(carry["inner"], observations, state, key)
        own = observations[..., :2]
        others = observations[..., 4:].reshape(*observations.shape[:-1], self.neighbours, 5)
        offset, relative, seen = others[..., :2], others[..., 2:4], others[..., 4] > 0.5
        for push in carry["sent"]:
            faster = _bounded(own + DT * PUSH * _bounded(push, 1.0), SPEED)
            relative = relative - (faster - own)[..., None, :]  # the others go on as they are
            own = faster
            offset = offset + DT * relative
        push = PUSH * _bounded(step.action, 1.0)
        normals, limits = self._conditions(own, offset, relative, seen)
        found, met = nearest(push, normals, limits)
        braking = -own / jnp.maximum(jnp.linalg.norm(own, axis=-1, keepdims=True), PUSH * DT) * PUSH
        action = jnp.where(met[..., None], found, braking) / PUSH
        sent = jnp.concatenate([carry["sent"], action[None]])[1:]
        return {"inner": inner, "sent": sent}, PolicyStep(action, {"infeasible": ~met.all(-1)})

    def _conditions(self, own: Array, offset: Array, relative: Array, seen: Array) -> tuple[Array, Array]:
        """Half planes n · u ≤ l of the own push: normals (B, N, M, 2) and limits (B, N, M)."""
        away, speed = -offset, -relative  # of oneself from the other
        distance = jnp.sqrt((away**2).sum(-1) + 1e-9)
        room = jnp.maximum(distance - 2 * RADIUS - SPARE, 1e-4)
        parting = (away * speed).sum(-1) / distance
        h = jnp.sqrt(4 * PUSH * room) + parting
        rate = 2 * PUSH * parting / jnp.sqrt(4 * PUSH * room)
        turning = (speed**2).sum(-1) / distance - parting**2 / distance
        limit = 0.5 * (self.gamma * h**3 + rate + turning)
        limit = jnp.where(seen, limit, 1e3)
        normal = -away / distance[..., None]
        angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
        sides = jnp.asarray(np.stack([np.cos(angle), np.sin(angle)], -1), own.dtype)
        sides = jnp.broadcast_to(sides, (*own.shape[:-1], CORNERS, 2))
        reach = jnp.full((*own.shape[:-1], CORNERS), PUSH * np.cos(np.pi / CORNERS))
        return jnp.concatenate([normal, sides], -2), jnp.concatenate([limit, reach], -1)


def _bounded(x: Array, most: float) -> Array:
    return x * (most / jnp.maximum(jnp.linalg.norm(x, axis=-1, keepdims=True), most))


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


SHARE = 0.1  # share of h that a step may take; both chosen on the four development systems, validation resets
MARGIN = 0.06  # m (or rad) that is kept: the condition is linear, and steps are not small
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
        asked = jnp.where(shared, 0.5 * (drifted + (1 - SHARE) * h), (1 - SHARE) * h)
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
            room = d - MARGIN
            # beyond the edge it grows on, so that who is too near has to leave
            reach = jnp.where(room > 0, jnp.sqrt(2 * both * brake * jnp.maximum(room, 1e-6)), 5 * room)
            found.append(reach + change[name])
            shared += [name in SHARED] * d.shape[-1]
        if "speed" in system.danger:
            found.append((system.speed_limit - length(own.rate))[..., None] - MARGIN)
            shared.append(False)
        return jnp.concatenate(found, -1), np.array(shared)


def _in_plane(x: Array) -> Array:
    """Vectors of one entry with a second one of 0."""
    return x if x.shape[-1] == 2 else jnp.concatenate([x, jnp.zeros_like(x)], -1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    from ringfence.deploy import zoo

    with tempfile.TemporaryDirectory() as folder:
        run = zoo.pretrained(RUN, folder)
        for faults in FAULTS:
            for gamma in GAMMAS:
                for compensated in (False, True) if faults.get("delay") else (False,):
                    play(run, faults, gamma, compensated, given.episodes, given.out)


def play(run: Any, faults: dict[str, Any], gamma: float, compensated: bool, episodes: int, out: Path) -> None:
    """Play a row and add it to the file, unless it is there."""
    from ringfence.evaluation.protocol import evaluate_policy
    from ringfence.faults import Faults
    from ringfence.loading.resolve import resolve
    from ringfence.loading.spec import PolicySpec

    row = {"faults": name_of(faults), "gamma": gamma, "compensated": compensated, "episodes": episodes}
    if tuple(str(row[k]) for k in ROW) in {tuple(r[k] for k in ROW) for r in read(out)}:
        return
    resolved = resolve(PolicySpec.of(run))
    task = resolved.job.task
    policy = Filter(resolved.team, gamma, faults["delay"] if compensated else 0, task.env.n_agents, task.env.neighbours)
    result, _ = evaluate_policy(policy, task, episodes, "test", run.config["seed"], faults=Faults.of(faults))
    row |= {"return": round(result["return_mean"], 3), **{rate: round(result[rate], 4) for rate in RATES}}
    append(out, row, FIELDS)


if __name__ == "__main__":
    main()
