"""Crossing behind faults under a classical filter: a control barrier function by formula, and a quadratic program.

    python benchmarks/filters.py --episodes 200            # writes results/stress/filters.csv
    python benchmarks/filters.py --table                   # writes the table of docs/stress-results.md

The filter is that of Wang, Ames and Egerstedt 2017 (Safety barrier certificates for collisions-free multirobot systems)
for double integrators: h = sqrt(4 a (d − D)) + the speed at which two part, and each of them takes half of
ḣ ≥ −γ h³. It is given what nobody tells a guard that learns: when discs touch (D), how they move, and what they can do
(a). Each agent solves its own program of two unknowns exactly, from what it sees. Where there is no solution it brakes.
With the delay compensated it decides for the state in which its action will act: its own by what it sent, that of the
others as if they went on as they are. Its gain and what it keeps to spare were chosen on 50 of the test episodes.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import _rows
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from stress import FAULTS, KNOWN, RATES, RUN, in_words, name_of

from ringfence.envs.crossing import DT, PUSH, RADIUS, SPEED
from ringfence.types import Array, Key, PolicyStep, PyTree

OUT = Path(__file__).resolve().parent.parent / "results" / "stress" / "filters.csv"
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    if given.table:
        write_table(given.out)
        return
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
    if tuple(str(row[k]) for k in ROW) in {tuple(r[k] for k in ROW) for r in _rows.read(out)}:
        return
    resolved = resolve(PolicySpec.of(run))
    task = resolved.job.task
    policy = Filter(resolved.team, gamma, faults["delay"] if compensated else 0, task.env.n_agents, task.env.neighbours)
    result, _ = evaluate_policy(policy, task, episodes, "test", run.config["seed"], faults=Faults.of(faults))
    row |= {"return": round(result["return_mean"], 3), **{rate: round(result[rate], 4) for rate in RATES}}
    print(row, flush=True)
    _rows.append(out, row, FIELDS)


def write_table(out: Path) -> None:
    """The table of docs/stress-results.md between its markers, of the gain that leaves fewer contacts."""
    from readme import put

    head = "faults | delay | return | episodes with contact, % (95 % ≤) | infeasible steps, %"
    lines = [f"| {head} |", "|---" * 5 + "|"]
    names = [name_of(faults) for faults in FAULTS if not faults or faults.keys() & set(KNOWN)]
    rows = [r for r in _rows.read(out) if float(r["gamma"]) == min(GAMMAS) and r["faults"] in names]
    for r in sorted(rows, key=lambda r: (names.index(r["faults"]), r["compensated"])):
        rate, upper, infeasible = (100 * float(r[name]) for name in RATES)
        delay = "known" if r["compensated"] == "True" else ""
        said = f"{float(r['return']):.2f} | {rate:.1f} (≤ {upper:.1f}) | {infeasible:.0f}"
        lines.append(f"| {in_words(r['faults'])} | {delay} | {said} |")
    put("docs/stress-results.md", "filters", "\n".join(lines))


if __name__ == "__main__":
    main()
