"""What a barrier answers when it is asked: somebody nearer and farther, at rest and closing; faster and slower."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.types import Array
from ringfence.world import cause_search, causes
from ringfence.world.barrier import Barrier, MinBarrier
from ringfence.world.card import UNKNOWN, Probe
from ringfence.world.cause_nets import Score
from ringfence.world.causes import Cause, Edge
from ringfence.world.logged import Logged

RADII = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)  # at which somebody is put
INSIDE = 0.9  # of the radius: what is nearer has to be called unsafe
STATES = 500  # held-out states that are asked about
CLOSING = (0.0, 1.0)  # of the fastest closing that was seen
POINTS = 25  # of a curve


def probe(
    barrier: Barrier | MinBarrier, logged: Logged, unit: float, rng: np.random.Generator
) -> tuple[tuple[Probe, ...], float]:
    """(answers in margins of `unit`, share of states with somebody inside the radius that are called unsafe)."""
    each = barrier.each if isinstance(barrier, MinBarrier) else (barrier,)
    curves = [_curve(net, unit) for one in each for net in one.causes if net.cause.width == 1]
    states = _states(logged, rng)
    answers = []
    inside = []
    for cause, edge in _near(barrier, logged):
        if edge.at is None or not edge.below:
            continue
        scores = {ratio: _put(barrier, states, logged.map.names, cause, ratio * edge.at) / unit for ratio in RADII}
        at = tuple(round(ratio * edge.at, 4) for ratio in RADII)
        medians = tuple(round(float(np.median(scores[ratio])), 3) for ratio in RADII)
        answers.append(Probe(f"{cause.name}, put into held-out states", at, medians, edge.at))
        inside += [(scores[ratio] < 0).mean() for ratio in RADII if ratio <= INSIDE]
    return (*curves, *answers), float(np.mean(inside)) if inside else UNKNOWN


def _curve(net: Score, unit: float) -> Probe:
    """Scores of a cause that reads one number, along it."""
    edge = net.edge
    reach = 0.25 * (edge.high[0] - edge.low[0])
    low = max(0.0, edge.low[0] - reach) if net.cause.length else edge.low[0] - reach
    at = np.linspace(low, edge.high[0] + reach, POINTS)
    scores = np.asarray(net.of_values(jnp.asarray(at[:, None], jnp.float32))) / unit
    crossing = np.flatnonzero((scores[:-1] < 0) != (scores[1:] < 0))
    begins = round(float(at[crossing[0]]), 4) if len(crossing) else UNKNOWN
    shown = tuple(round(float(score), 3) for score in scores)
    return Probe(net.cause.name, tuple(round(float(value), 4) for value in at), shown, begins)


def _near(barrier: Barrier | MinBarrier, logged: Logged) -> list[tuple[Cause, Edge]]:
    """How near things come: the causes that are a distance, or, of networks on all entries, what names tell of one."""
    each = barrier.each if isinstance(barrier, MinBarrier) else (barrier,)
    if any(one.causes for one in each):
        return [(net.cause, net.edge) for one in each for net in one.causes if net.cause.length]
    return [(cause, _radius(cause, logged)) for cause in causes.offsets(logged.map.names)]


def _radius(cause: Cause, logged: Logged) -> Edge:
    steps = logged.fitted_steps
    rows = np.asarray(logged.arrays["row"])[steps] + 1
    x = logged.picked("features", rows)
    return cause_search.radius(x, logged.label[steps], logged.store.episode_of_step[steps], cause)


def _states(logged: Logged, rng: np.random.Generator) -> Array:
    """(W, N, D) where held-out safe steps led."""
    held = logged.held_steps
    fine = held[~logged.unsafe[held]]
    fine = rng.choice(fine, min(STATES, len(fine)), replace=False)
    return jnp.asarray(logged.after(fine))


def _put(
    barrier: Barrier | MinBarrier, states: Array, names: Sequence[str], cause: Cause, distance: float
) -> np.ndarray:
    """(W * closing,) scores of the first agent that the cause is about, with its thing at that distance, at rest and
    closing."""
    agent, thing = cause.who[0] if cause.who else (0, 0)
    place = np.array(cause.things[thing])
    offset = states[:, agent, place]
    length = jnp.maximum(jnp.sqrt((offset**2).sum(-1, keepdims=True)), 1e-6)
    direction = offset / length
    put = states.at[:, agent, place].set(direction * distance)
    speed = _speed_entries(names, place)
    found = []
    for share in CLOSING:
        moved = put
        if speed is not None:
            fastest = jnp.quantile(jnp.sqrt((states[..., speed] ** 2).sum(-1)), 0.99)
            moved = put.at[:, agent, speed].set(-share * fastest * direction)
        found.append(np.asarray(_scores_of_all(barrier, states, moved))[:, agent])
    return np.concatenate(found)


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
