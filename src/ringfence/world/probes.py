"""What a barrier answers when it is asked: somebody nearer and farther, at rest and closing; faster and slower."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from ringfence.problem.entries import Entries
from ringfence.types import Array
from ringfence.world import cause_candidates, cause_counts
from ringfence.world.barrier import Barrier, MinBarrier
from ringfence.world.card import PUT, UNKNOWN, Probe, ProbeMap
from ringfence.world.cause_nets import Score
from ringfence.world.causes import Cause, Edge
from ringfence.world.logged import Logged

RADII = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)  # at which somebody is put
INSIDE = 0.9  # of the radius: what is nearer has to be called unsafe
CLOSING = (0.0, 1.0)  # of the fastest closing that was seen
POINTS = 25  # of a curve
FARTHEST = 4.0  # radii, up to which the curve of a distance reaches
SIDE = 32  # values along each axis of a map
ASKED = 50  # held-out states in which every place of a map is asked about


class Probed(NamedTuple):
    """What was asked, and how it was answered."""

    answers: tuple[Probe, ...]
    maps: tuple[ProbeMap, ...]
    inside: float  # share of states with somebody inside the radius that are called unsafe


def probe(barrier: Barrier | MinBarrier, logged: Logged, unit: float, rng: np.random.Generator, count: int) -> Probed:
    """A barrier's answers, in margins of `unit`, in so many states where held-out safe steps led."""
    nets = [net for one in barrier.each for net in one.causes]
    curves = [_curve(net, unit) for net in nets if net.cause.width == 1]
    maps = [_map(net, unit) for net in nets if net.cause.width == 2]
    held = logged.held_steps
    fine = held[~logged.unsafe[held]]
    states = logged.after(rng.choice(fine, min(count, len(fine)), replace=False))
    names = logged.map.names
    if not nets:
        curves += _own_speed(barrier, states, names, unit)
        maps += _own_place(barrier, states, names, unit)
    answers = []
    inside = []
    for cause, edge in _near(barrier, logged):
        if edge.at is None or not edge.below:
            continue
        scores = {ratio: _put(barrier, states, names, cause, ratio * edge.at) / unit for ratio in RADII}
        answers.append(_neighbour(cause, edge.at, [scores[ratio] for ratio in RADII]))
        inside += [(scores[ratio] < 0).mean() for ratio in RADII if ratio <= INSIDE]
    return Probed((*curves, *answers), tuple(maps), float(np.mean(inside)) if inside else UNKNOWN)


def _neighbour(cause: Cause, radius: float, scores: list[np.ndarray]) -> Probe:
    """What is answered about something at each of RADII, by scores (speeds, W) of states."""
    at_rest, *closing = ([round(float((one[k] < 0).mean()), 3) for one in scores] for k in range(len(scores[0])))
    return Probe(
        name=cause.name + PUT,
        at=tuple(round(ratio * radius, 4) for ratio in RADII),
        scores=tuple(round(float(np.median(one)), 3) for one in scores),
        edge=radius,
        unsafe=tuple(at_rest),
        unsafe_closing=tuple(closing[0]) if closing else (),
    )


def _curve(net: Score, unit: float) -> Probe:
    """Scores of a cause that reads one number, along it; of a distance from 0 to well beyond where danger begins."""
    edge = net.edge
    reach = 0.25 * (edge.high[0] - edge.low[0])
    low = max(0.0, edge.low[0] - reach) if net.cause.from_zero else edge.low[0] - reach
    high = edge.high[0] + reach
    if net.cause.vector and edge.at:
        low, high = 0.0, min(high, FARTHEST * edge.at)
    at = np.linspace(low, high, POINTS)
    scores = np.asarray(_scores_of_values(net, at[:, None].astype(np.float32))) / unit
    return _along(net.cause.name, at, scores, edge.at)


def _along(name: str, at: np.ndarray, scores: np.ndarray, edge: float | None = None) -> Probe:
    """A curve of scores in margins; danger begins at `edge`, or where the score first passes 0."""
    if edge is None:
        k = next(iter(np.flatnonzero((scores[:-1] < 0) != (scores[1:] < 0))), None)
        edge = UNKNOWN if k is None else float(at[k] - scores[k] * (at[k + 1] - at[k]) / (scores[k + 1] - scores[k]))
    shown = tuple(round(float(score), 3) for score in scores)
    return Probe(
        name, tuple(round(float(value), 4) for value in at), shown, edge if edge is UNKNOWN else round(edge, 4)
    )


def _map(net: Score, unit: float) -> ProbeMap:
    """Scores of a cause that reads two numbers, over their plane."""
    axes = [_axis(low, high) for low, high in zip(net.edge.low, net.edge.high)]
    places = np.stack(np.meshgrid(*axes), -1)
    return _over(net.cause.name, axes, np.asarray(_scores_of_values(net, np.asarray(places, np.float32))) / unit)


def _over(name: str, axes: Sequence[np.ndarray], scores: np.ndarray) -> ProbeMap:
    x, y = (tuple(round(float(value), 4) for value in axis) for axis in axes)
    return ProbeMap(name, x, y, tuple(tuple(round(float(score), 2) for score in row) for row in scores))


def _axis(low: float, high: float) -> np.ndarray:
    """Values over what was seen, and a little beyond."""
    reach = 0.1 * (high - low)
    return np.linspace(low - reach, high + reach, SIDE)


def _own_speed(barrier: Barrier | MinBarrier, states: np.ndarray, names: Sequence[str], unit: float) -> list[Probe]:
    """Median scores of the first agent along its own speed, where names tell it; all else stays as it was."""
    known = Entries.of(names)
    index = np.array(known.pair("v{}") or [known.speed] * (known.speed is not None), int)
    if not len(index):
        return []
    velocity = states[:, 0, index]
    speed = np.maximum(np.sqrt((velocity**2).sum(-1, keepdims=True)), 1e-6)
    at = np.linspace(0.0, 1.25 * np.quantile(speed, 0.999), POINTS)
    scores = []
    for value in at:
        put = states.copy()
        put[:, 0, index] = value * velocity / speed
        scores.append(np.median(np.asarray(_scores_of_all(barrier, states, put))[:, 0]))
    name = f"own speed ({', '.join(names[int(d)] for d in index)}), put into held-out states"
    return [_along(name, at, np.array(scores) / unit)]


def _own_place(barrier: Barrier | MinBarrier, states: np.ndarray, names: Sequence[str], unit: float) -> list[ProbeMap]:
    """Median scores of the first agent over its own place, where names tell it; all else stays as it was."""
    index = np.array(Entries.of(names).pair("{}"), int)
    if not len(index):
        return []
    some = states[:ASKED]
    axes = [_axis(*np.quantile(states[:, 0, d], (0.0, 1.0))) for d in index]
    rows = []
    for y in axes[1]:
        places = np.array([(x, y) for x in axes[0]])  # (SIDE, 2)
        before = np.tile(some, (SIDE, 1, 1))
        put = before.copy()
        put[:, 0, index] = np.repeat(places, len(some), 0)
        scores = _scores_of_all(barrier, before, put)
        rows.append(np.median(np.asarray(scores)[:, 0].reshape(SIDE, -1), 1))
    return [_over(f"{', '.join(names[int(d)] for d in index)}, put into held-out states", axes, np.array(rows) / unit)]


def _near(barrier: Barrier | MinBarrier, logged: Logged) -> list[tuple[Cause, Edge]]:
    """How near things come: the causes that are a distance, or, of networks on all entries, what names tell of one."""
    nets = [net for one in barrier.each for net in one.causes]
    if nets:
        return [(net.cause, net.edge) for net in nets if net.cause.vector]
    steps = logged.fitted_steps
    told = logged.after(steps), logged.label[steps], logged.store.episode_of_step[steps]
    return [(cause, cause_counts.radius(*told, cause)) for cause in cause_candidates.offsets(logged.map.names)]


def _put(
    barrier: Barrier | MinBarrier, states: np.ndarray, names: Sequence[str], cause: Cause, distance: float
) -> np.ndarray:
    """(1 or 2, W) scores of the first agent that the cause is about, with its thing at that distance: at rest, and
    closing where names tell its velocity."""
    agent, thing = cause.who[0] if cause.who else (0, 0)
    place = np.array([entry.at[thing] for entry in cause.vector or ()])
    offset = states[:, agent, place]
    length = np.maximum(np.sqrt((offset**2).sum(-1, keepdims=True)), 1e-6)
    direction = offset / length
    put = states.copy()
    put[:, agent, place] = offset / np.maximum(cause.of(states)[:, agent, thing], 1e-6) * distance
    speed = _speed_entries(names, place)
    found = []
    for share in CLOSING if speed is not None else CLOSING[:1]:
        moved = put
        if speed is not None:
            fastest = np.quantile(np.sqrt((states[..., speed] ** 2).sum(-1)), 0.99)
            moved = put.copy()
            moved[:, agent, speed] = -share * fastest * direction
        found.append(np.asarray(_scores_of_all(barrier, states, moved))[:, agent])
    return np.stack(found)


def _speed_entries(names: Sequence[str], place: np.ndarray) -> np.ndarray | None:
    """Where the relative velocity of that thing stands, as names tell."""
    given = [names[int(d)] for d in place]
    wanted = [name.replace(".d", ".dv") for name in given]
    if any(name not in names or name in given for name in wanted):
        return None
    return np.array([list(names).index(name) for name in wanted])


@jax.jit
def _scores_of_all(barrier: Barrier | MinBarrier, before: Array, after: Array) -> Array:
    return barrier.of_steps(before, after)


@jax.jit
def _scores_of_values(net: Score, values: Array) -> Array:
    return net.of_values(values)
