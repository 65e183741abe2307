"""What a guard makes of drivers, played inside its World before anybody drives.

From held-out states drivers of two kinds act alone, and under the shield: who does what drivers of the logs do, and who
wants something at full strength and heeds nobody. The World goes on as it predicts, and errs as it erred in held-out
steps. What they come to is judged by others than the barrier that the shield reads: by networks on all entries, which
learn danger anew, each from half of the episodes. What they say of a window is calibrated on held-out ones. Commands
take effect at once here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from msgspec.structs import replace

from ringfence.guards.filter import Guard
from ringfence.guards.policy import build
from ringfence.problem.constraints import lowest
from ringfence.problem.turns import pointing
from ringfence.proposals.base import held
from ringfence.types import Array
from ringfence.utils.device import on_device
from ringfence.world import World
from ringfence.world.barrier import Barrier, fit_label
from ringfence.world.card import Played
from ringfence.world.judging import Judging
from ringfence.world.logged import Logged
from ringfence.world.verdict import look_of

TOGETHER = 1500  # steps that are judged at once
STEPS = 30  # that each goes on for
STAYS = 0.9  # probability that who wants anything goes on wanting it for another step
BANK = 2000  # held-out steps whose errors are drawn
LEARNED = 8000  # steps that drivers are learned from
UNITS = 128  # that these are read through
RIDGE = 1e-3  # of their mean square
UPDATES = 800  # of a judge's networks
WIDTH = 32  # units of each of their layers
KNOWN = 3000  # logged states that are known
LOGGED = 1000  # held-out windows that judges are calibrated on
USUAL = 0.99  # share of held-out steps that are as near to what was logged as is known
ERROR = 1.645  # deviations: 95 in 100 lie below

Judge = Callable[[Array, Array], Array]  # of steps from features (W, N, D) to others: (W,), e.g. more is more dangerous


def played(world: World, logged: Logged, judging: Judging) -> tuple[Played, ...]:
    """What is predicted of both kinds of drivers by each judge; nothing of Worlds that know no danger."""
    scores = world.card.barrier
    if not judging.played or world.barrier is None or scores is None or scores.warning:
        return ()
    rng = np.random.default_rng(5)
    begun = rng.permutation(_far(logged))[:LOGGED]
    left = logged.picked("last_row", begun) - logged.picked("row", begun)
    there = np.arange(STEPS) < left[:, None]  # steps of these windows that belong to their episodes
    steps = np.where(there, begun[:, None] + np.arange(STEPS), begun[:, None])
    label = logged.label if logged.label.ndim == 1 else logged.label.any(1)
    met = (label[steps] & there).any(1)
    fitted = logged.fitted_steps
    halves = [fitted[logged.store.episode_of_step[fitted] % 2 == half] for half in (0, 1)]
    if not all(some.any() and not some.all() for some in (met, *(logged.unsafe[steps] for steps in halves))):
        return ()
    tracks = tracks_of(world, logged, judging.played, rng)
    shares: list[Played] = []
    judges = *(_networks(world, logged, half) for half in halves), _apart(world, logged, rng)
    sides = (logged.before(steps), logged.after(steps)), *((rows[:, :-1], rows[:, 1:]) for rows in tracks)
    said = [[_scores(judge, *side) for judge in judges] for side in sides]
    usual = np.quantile(said[0][2][there], USUAL)
    unknown = [each[2] > usual for each in said[1:]]
    for of in (0, 1):
        worst = np.where(there, said[0][of], -np.inf).max(1)
        chance = _calibrated(worst, met)
        alone, guarded = (chance(each[of].max(1)) for each in said[1:])
        many = len(alone) - len(alone) // 2
        for driver, some in (("logged", slice(many)), ("bold", slice(many, None))):
            saved = alone[some] - guarded[some]
            error = ERROR * saved.std() / math.sqrt(len(saved))
            strange = tuple(round(float(each[some].mean()), 4) for each in unknown)
            told = alone[some].mean(), guarded[some].mean(), error, _auroc(worst[met], worst[~met])
            before, under, error, auroc = (round(float(share), 4) for share in told)
            shares.append(Played(driver, of, before, under, error, strange, auroc))
    return tuple(shares)


def _far(logged: Logged) -> np.ndarray:
    """Held-out steps that are not close to danger, or begin an episode."""
    steps = logged.held_steps
    begin = logged.picked("row", steps) == logged.picked("first_row", steps)
    return steps[begin | ~logged.close_to_danger()[steps]]


def _calibrated(worst: np.ndarray, met: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """The chance of danger in a window with so high a score: isotonic in that of held-out windows (W,)."""
    from scipy.optimize import isotonic_regression  # slow to import, and read by fits alone

    order = np.argsort(worst)
    known, chance = worst[order], isotonic_regression(met[order].astype(float)).x
    return lambda score: chance[np.maximum(np.searchsorted(known, score, side="right") - 1, 0)]


def _auroc(high: np.ndarray, low: np.ndarray) -> float:
    return float((high[:, None] > low).mean() + 0.5 * (high[:, None] == low).mean())


def _scores(judge: Judge, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(W, K) of windows of steps, each (W, K, N, D), so many at once that judges are compiled once."""
    flat = [x.reshape(-1, *x.shape[2:]) for x in (before, after)]
    short = -len(flat[0]) % TOGETHER
    parts = [np.concatenate([x, np.repeat(x[:1], short, 0)]).reshape(-1, TOGETHER, *x.shape[1:]) for x in flat]
    found = np.concatenate([np.asarray(judge(*map(on_device, part))) for part in zip(*parts)])
    return found[: len(flat[0])].reshape(before.shape[:2])


# --- judges ---


def _networks(world: World, logged: Logged, steps: np.ndarray) -> Judge:
    """Networks on all entries, as a barrier without causes has them, by these steps."""
    fewer = {"barrier_updates": UPDATES, "barrier_width": WIDTH, "loss": "cross-entropy", "predicted_share": 0.0}
    settings = dataclasses.replace(world.card.settings, **fewer)
    blank = dataclasses.replace(world.barrier.each[0], causes=())
    unsafe = logged.unsafe[steps]
    data = *(logged.arrays[name] for name in ("features", "features", "row")), on_device(logged.label)  # none predicted
    net = fit_label(blank, data, steps[unsafe], steps[~unsafe], jax.random.key(len(steps)), settings)
    return lambda before, after: _of_networks(net, before, after)


@eqx.filter_jit
def _of_networks(net: Barrier, before: Array, after: Array) -> Array:
    return -lowest(net.of_steps(before, after))


def _apart(world: World, logged: Logged, rng: np.random.Generator) -> Judge:
    """How far the strangest agent of a step is from the nearest of the logs: mean square, in deviations of entries."""
    steps = rng.choice(logged.fitted_steps, min(KNOWN, len(logged.fitted_steps)), replace=False)
    known = _standard(world, on_device(logged.after(steps)))
    known = known.reshape(-1, known.shape[-1])[:KNOWN]
    return lambda _, after: _from_known(world, known, after)


@eqx.filter_jit
def _from_known(world: World, known: Array, after: Array) -> Array:
    read = _standard(world, after)
    squares = (read**2).sum(-1)[..., None] + (known**2).sum(1) - 2 * read @ known.T
    return squares.min(-1).max(-1) / read.shape[-1]


# --- drivers ---


Driver = tuple[Array, Array]  # random units (F, UNITS), and weights (N, 1 + F + UNITS, A) of what is read through them


def _driver(world: World, logged: Logged, rng: np.random.Generator) -> Driver:
    """What agents of the logs do, by what they see: least squares."""
    steps = rng.choice(logged.fitted_steps, min(LEARNED, len(logged.fitted_steps)), replace=False)
    read = _standard(world, on_device(logged.before(steps)))
    drawn = rng.normal(0, 1 / math.sqrt(read.shape[-1]), (read.shape[-1], UNITS))
    first = on_device(drawn, np.float32)
    return first, _solved(_units(first, read), on_device(logged.picked("actions", steps)))


def _acts(driver: Driver, read: Array) -> Array:
    """Actions (W, N, A) of standardised features (W, N, F)."""
    first, weights = driver
    return jnp.clip(jnp.einsum("wnp,npa->wna", _units(first, read), weights), -1.0, 1.0)


def _standard(world: World, x: Array) -> Array:
    acts = world.dynamics
    return pointing(acts.map.turns, x, (x - acts.mean) / acts.scale)


def _units(first: Array, read: Array) -> Array:
    return jnp.concatenate([jnp.ones_like(read[..., :1]), read, jax.nn.relu(read @ first)], -1)


@jax.jit
def _solved(x: Array, y: Array) -> Array:
    """Weights (N, P, A) of units (W, N, P) to actions (W, N, A)."""
    squares = jnp.einsum("wnp,wnq->npq", x, x)
    size = jnp.trace(squares, axis1=1, axis2=2)[:, None, None] / x.shape[-1]
    return jnp.linalg.solve(squares + RIDGE * size * jnp.eye(x.shape[-1]), jnp.einsum("wnp,wna->npa", x, y))


def _wanted(rng: np.random.Generator, windows: int, agents: int, dim: int) -> np.ndarray:
    """(K, W, N, A) of who wants anything, at full strength, for a while."""
    drawn = rng.choice((-1.0, 0.0, 1.0), (STEPS, windows, agents, dim)).astype(np.float32)
    new = rng.random((STEPS, windows, agents)) > STAYS
    new[0] = True
    since = np.maximum.accumulate(np.where(new, np.arange(STEPS)[:, None, None], 0), 0)
    return np.take_along_axis(drawn, since[..., None], 0)


# --- play ---


def tracks_of(world: World, logged: Logged, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rows (W, K+1, N, D) of windows alone, and the same guarded: the first half by drivers like those of the logs."""
    card = replace(world.card, look=look_of(world.card))
    guard = build(None, dataclasses.replace(world, card=card), None, "shield", "learned", anyway=True).guard
    far = _far(logged)
    x = logged.before(rng.choice(far, count, replace=len(far) < count))
    safe = logged.held_steps[~logged.unsafe[logged.held_steps]]
    bank = rng.choice(safe, BANK)
    steps = map(on_device, (logged.before(bank), logged.picked("actions", bank), logged.after(bank)))
    wants = _wanted(rng, count // 2, *logged.arrays["actions"].shape[1:])
    drawn = rng.integers(0, BANK, (STEPS, count))
    given = guard, _driver(world, logged, rng), on_device(x), on_device(wants), _errors(world, *steps), on_device(drawn)
    both = (np.moveaxis(np.asarray(_play(jnp.asarray(guarded), *given)), 0, 1) for guarded in (False, True))
    alone, guarded = (np.concatenate([x[:, None], rows], 1) for rows in both)
    return alone, guarded


@eqx.filter_jit
def _errors(world: World, before: Array, action: Array, after: Array) -> Array:
    """(Q, N or 1, F) by how much more standardised entries changed in steps than is predicted."""
    acts = world.dynamics
    change = acts.changes(before, action).mean(0)
    moved = acts.map.apart(after, before)[:, : change.shape[1], acts.predicted]
    return (moved - acts.step_mean) / acts.step_scale - change


@eqx.filter_jit
def _play(guarded: Array, guard: Guard, driver: Driver, x: Array, wants: Array, errors: Array, drawn: Array) -> Array:
    """(K, W, N, D) where windows lead from states x (W, N, D), with errors drawn (K, W) from the bank."""
    world = guard.world
    acts = world.dynamics
    limits = max(1, len(guard.barrier.limits))
    margin = jnp.full((*x.shape[: 2 if world.alone else 1], limits), guard.options.margin)

    def corrected(x: Array, action: Array) -> Array:
        plan = held(action, guard.options.horizon)
        return guard.decide(x, plan, plan[:, 0], margin, jax.random.key(0)).plan[:, 0]

    def step(x: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        want, error = now
        action = jnp.concatenate([_acts(driver, _standard(world, x[: len(x) - len(want)])), want])
        action = world.spec.own(action)
        action = jax.lax.cond(guarded, corrected, lambda x, action: action, x, action)
        after = acts.arrived(x, acts.changes(x, action).mean(0) + errors[error])
        return after, after

    return jax.lax.scan(step, x, (wants, drawn))[1]
