"""Whether a barrier holds what a search for actions finds: a guard looks for what its World calls safe, and so it finds
the pockets in which the World is wrong."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ringfence.guards.barrier import BarrierSource
from ringfence.guards.correction import TOLERANCE
from ringfence.guards.filter import Guard
from ringfence.guards.options import GuardOptions
from ringfence.proposals.base import held
from ringfence.types import Array
from ringfence.utils.precision import on_device
from ringfence.world import World, cause_candidates
from ringfence.world.card import UNKNOWN
from ringfence.world.cause_counts import Explained, counted, some_steps
from ringfence.world.causes import Cause, Cells
from ringfence.world.judging import Judging
from ringfence.world.logged import Logged
from ringfence.world.quantities import Entry

FEW = 10  # safe steps of what was found, with fewer of which nothing is said
SURE = 0.8  # probability that being in a cell makes a step unsafe, from which on what was found there counts as wrong


def false_safe(world: World, logged: Logged, judging: Judging) -> float:
    """The share of predicted steps that a shield's search calls safe, and that the logs call dangerous: somebody is in
    a place, or as near to something, as hardly any safe step was. UNKNOWN where names tell no places."""
    known = [] if world.barrier is None or not judging.searched else _known(logged)
    if not known:
        return UNKNOWN
    rng = np.random.default_rng(3)
    steps = logged.held_steps
    safe = steps[~logged.unsafe[steps]]
    close = np.intersect1d(safe, np.flatnonzero(logged.close_to_danger()))
    picked = [rng.choice(these, min(judging.searched // 2, len(these)), replace=False) for these in (close, safe)]
    begun = np.concatenate(picked)
    if len(begun) < FEW:
        return UNKNOWN
    present = logged.before(begun)
    agents, entries = logged.arrays["actions"].shape[1:]
    wanted = rng.choice((-1.0, 0.0, 1.0), (len(present), agents, entries)).astype(np.float32)
    options = GuardOptions(correction_steps=judging.corrections, correction_restarts=judging.restarts, margin=1.0)
    guard = Guard(BarrierSource(world, "learned", None, False), options)
    rows, met = _searched(guard, on_device(present), on_device(wanted))
    found = np.asarray(rows)[np.asarray(met)]  # (found, K, N, D)
    if len(found) < FEW:
        return UNKNOWN
    wrong = np.logical_or.reduce([_dangerous(one, found) for one in known])
    return round(float(wrong.mean()), 4)


@eqx.filter_jit
def _searched(guard: Guard, present: Array, wanted: Array) -> tuple[Array, Array]:
    """Where corrected plans lead (B, K, N, D), and whether they keep the margin (B,)."""
    limits = max(1, len(guard.barrier.limits))
    shape = (len(present), present.shape[1], limits) if guard.world.alone else (len(present), limits)
    margin = jnp.full(shape, guard.options.margin)
    plan = held(guard.world.spec.own(wanted), guard.options.horizon)[:, 0]

    def followed(plan: Array) -> tuple[Array, Array]:
        rows, spread = guard.predict(present, plan[:, None])
        return rows[:, 0, 1:], guard.missing(present, guard.clear(rows, spread, margin)[:, 0], margin)

    rows, missing = followed(guard.shielded(present, plan, followed(plan)[1], margin))
    return rows, (missing >= -TOLERANCE).all((1, 2))


def _known(logged: Logged) -> list[Cells]:
    """Where the logs have danger: one's own place, and how far things are, as names tell, counted cell by cell."""
    names = list(logged.map.names)
    simple = cause_candidates.offsets(names)
    if {"own.x", "own.y"} <= set(names):
        simple.insert(0, Cause(tuple(Entry((names.index(name),), name) for name in ("own.x", "own.y"))))
    if not simple:
        return []
    steps = np.arange(logged.store.steps)
    x = logged.after(steps)
    counts = some_steps(x, logged.label, logged.store.episode_of_step, np.random.default_rng(0))
    nothing = Explained.by(counts, [])
    return [counted(counts, cause, nothing).cells for cause in simple]


def _dangerous(cells: Cells, x: np.ndarray) -> np.ndarray:
    """(W, K) bool: somebody is in a cell that the logs call dangerous, at features (W, K, N, D)."""
    read = cells.cause.of(x)  # (W, K, N, J, width)
    index = np.floor((read - cells.low) / (cells.high - cells.low) * cells.bins).astype(int)
    inside = (((index >= 0) | cells.cause.goes_on) & (index < cells.bins)).all(-1)  # nearer than ever is as the nearest
    index = np.clip(index, 0, cells.bins - 1)
    cell = np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), (cells.bins,) * cells.cause.width)
    return (inside & (cells.danger[cell] > SURE)).any((-1, -2))
