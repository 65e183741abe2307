"""How well what a barrier reads is predicted, in its own unit, beside everything going on as it did."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ringfence.problem.entries import Entries
from ringfence.problem.features import FeatureMap
from ringfence.world import cause_candidates
from ringfence.world.barrier import Barrier, MinBarrier
from ringfence.world.card import Foresight
from ringfence.world.causes import Cause, Edge
from ringfence.world.dynamics import Dynamics
from ringfence.world.logged import Logged
from ringfence.world.margins import rolled

SECONDS = (1.0, 2.0)  # ahead, where the logs say how long a step is
STEPS = (1, 3, 8)  # ahead, where they do not, or where their episodes or these predictions end sooner
FARTHEST = 40  # steps
ENOUGH = 30  # held-out windows of that length
WINDOWS = 1000  # of them that are predicted


def foresight(
    dynamics: Dynamics, barrier: Barrier | MinBarrier | None, logged: Logged, rng: np.random.Generator
) -> tuple[Foresight, ...]:
    """Errors of everything that a barrier reads, in held-out windows, along the logged actions."""
    steps, starts = _windows(logged)
    if not steps or barrier is None:
        return ()
    starts = rng.choice(starts, min(WINDOWS, len(starts)), replace=False)
    row = np.asarray(logged.arrays["row"])[starts]
    index = np.array(steps)
    now = logged.picked("features", row)
    came = logged.picked("features", row[:, None] + index)
    predicted = np.asarray(rolled(dynamics, logged, starts, steps[-1])[0])[:, index - 1]
    dt = logged.store.card.dt
    moved = _moved(logged.map, now, logged.picked("features", row - 1), dt)
    coasted = now[:, None] + index[:, None, None] * moved[:, None]
    predicted, coasted = (came + logged.map.apart(x, came) for x in (predicted, coasted))
    found = []
    for name, (cause, edge) in _reads(barrier, logged.map.names).items():
        truth = _read(came, cause, edge)
        found.append(
            Foresight(
                name=name,
                steps_ahead=steps,
                seconds=() if dt is None else tuple(round(k * dt, 4) for k in steps),
                error=_rms(_read(predicted, cause, edge) - truth),
                coasting=_rms(_read(coasted, cause, edge) - truth),
                deviation=float(f"{np.sqrt(truth.var((0, 1)).sum()):.3g}"),
            )
        )
    return tuple(found)


def _moved(map: FeatureMap, now: np.ndarray, before: np.ndarray, dt: float | None) -> np.ndarray:
    """What entries (W, N, D) change by in a step of constant velocity: by their velocities where names tell these,
    since a place in a list of others may change its owner; else by what they changed by."""
    moved = map.apart(now, before)
    if dt is None:
        return moved
    known = Entries.of(map.names)
    for e in known.each:
        fast = {"place": f"v{e.axis}", "offset": f"dv{e.axis}"}.get(e.role)
        velocity = known.bodies[e.whose, e.order].get(fast or "")
        if velocity is not None:
            moved[..., e.source] = dt * now[..., velocity]
    return moved


def _windows(logged: Logged) -> tuple[tuple[int, ...], np.ndarray]:
    """(how many steps ahead, held-out steps that as many follow and one precedes)."""
    row, first, last = (np.asarray(logged.arrays[name])[logged.held_steps] for name in ("row", "first_row", "last_row"))
    left = np.where(row > first, last - row, 0)
    dt = logged.store.card.dt
    in_seconds = () if dt is None else sorted({max(1, round(seconds / dt)) for seconds in SECONDS})
    for wanted in (in_seconds, STEPS):
        steps = tuple(k for k in wanted if k <= FARTHEST and (left >= k).sum() >= ENOUGH)
        if steps:
            return steps, logged.held_steps[left >= steps[-1]]
    return (), logged.held_steps[:0]


def _reads(barrier: Barrier | MinBarrier, names: Sequence[str]) -> dict[str, tuple[Cause, Edge | None]]:
    """What a barrier reads, by its name in words: its causes, or all entries, places of others as how far they are."""
    each = barrier.each if isinstance(barrier, MinBarrier) else (barrier,)
    found: dict[str, tuple[Cause, Edge | None]] = {}
    for one in each:
        if one.causes:
            found |= {_name(net.cause, net.edge): (net.cause, net.edge) for net in one.causes}
            continue
        offsets = cause_candidates.offsets(names)
        inside = {d for cause in offsets for thing in cause.things for d in thing}
        found |= {_name(cause, None): (cause, None) for cause in offsets}
        found |= {name: (Cause(name, ((d,),)), None) for d, name in enumerate(names) if d not in inside}
    return found


def _name(cause: Cause, edge: Edge | None) -> str:
    if not cause.length or len(cause.things) == 1:
        return cause.name
    return f"{cause.name}, of the {'farthest' if _farther_is_worse(edge) else 'nearest'}"


def _farther_is_worse(edge: Edge | None) -> bool:
    return edge is not None and edge.at is not None and not edge.below


def _read(x: np.ndarray, cause: Cause, edge: Edge | None) -> np.ndarray:
    """(values, steps, entries): what a cause reads of features (W, K, N, D). Of distances, that of the thing in most
    danger: which of them is listed where may change."""
    read = np.moveaxis(cause.of(x), 1, 0)  # (K, W, N, J, width)
    held = cause.holds(x.shape[2])
    if not cause.length:
        return np.swapaxes(read[:, :, held].reshape(len(read), -1, cause.width), 0, 1)
    sign = -1.0 if _farther_is_worse(edge) else 1.0
    worst = np.where(held, sign * read[..., 0], np.inf).min(-1)[:, :, held.any(1)]
    return np.swapaxes(sign * worst.reshape(len(read), -1, 1), 0, 1)


def _rms(error: np.ndarray) -> tuple[float, ...]:
    """By steps ahead, of errors (values, steps, entries) as vectors."""
    return tuple(float(f"{value:.3g}") for value in np.sqrt((error**2).sum(-1).mean(0)))
