"""What a guard makes of drivers, played inside its World before anybody drives.

From held-out states drivers of two kinds act alone, and under the shield: who does what drivers of the logs do, and who
wants something at full strength and heeds nobody. The World goes on as it predicts, and errs as it erred in held-out
steps. What they come to is judged by others than the barrier that the shield reads, who learned danger anew from half
of the episodes: networks on all entries, and nearness to what was dangerous. What they say of a window is calibrated
on held-out ones. Commands take effect at once here, and agents who see for themselves know nobody else's driver.
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

from ringfence.guards.correction import directions
from ringfence.guards.filter import Guard
from ringfence.guards.policy import build
from ringfence.problem.constraints import lowest
from ringfence.problem.normalise import varying
from ringfence.problem.turns import pointing
from ringfence.proposals.base import held
from ringfence.types import Array
from ringfence.utils.device import on_device
from ringfence.world import World
from ringfence.world.barrier import Shape, fit_label
from ringfence.world.card import Played
from ringfence.world.judging import Judging
from ringfence.world.logged import Logged
from ringfence.world.verdict import look_of

TOGETHER = 1500  # steps that are judged at once
STEPS = 30  # that each goes on for
AHEAD = 8  # steps for which who climbs rewards holds what it chooses among
CHOICES = 16  # actions that it chooses among, at most
STAYS = 0.9  # probability that who wants anything goes on wanting it for another step
BANK = 2000  # held-out steps whose errors are drawn
LEARNED = 8000  # steps that drivers are learned from
UNITS = 128  # that these are read through
RIDGE = 1e-3
UPDATES = 1000  # of a judge's networks
WIDTH = 32  # units of each of their layers
KNOWN = 1500  # logged things of every kind that nearness is read from, and as many dangerous ones
NEAR = 0.35  # deviations of every entry: so near counts
ROUNDS = 2  # in which nearness finds out who was to blame
LOGGED = 1000  # held-out windows that judges are calibrated on
USUAL = 0.99  # share of held-out steps that are as near to what was logged as is known
ERROR = 1.645  # deviations: 95 in 100 lie below

Judge = Callable[[Array, Array], Array]  # of steps from features (W, N, D) to others: (J, W), more is more dangerous


def played(world: World, logged: Logged, judging: Judging) -> tuple[Played, ...]:
    """What is predicted of both kinds of drivers by each judge; nothing of Worlds that know no danger."""
    scores = world.card.barrier
    if not judging.played or world.barrier is None or scores is None or scores.warning:
        return ()
    rng = np.random.default_rng(5)
    begun, there = _windows(logged, rng)
    steps = np.where(there, begun[:, None] + np.arange(STEPS), begun[:, None])
    label = logged.label if logged.label.ndim == 1 else logged.label.any(1)
    met = (label[steps] & there).any(1)
    if not met.any() or met.all():
        return ()
    tracks = tracks_of(world, logged, judging.played, rng)
    shares: list[Played] = []
    judges = _networks(world, logged), _nearness(world, logged, label, rng)
    sides = (logged.before(steps), logged.after(steps)), *((rows[:, :-1], rows[:, 1:]) for rows in tracks)
    said = [np.concatenate([_scores(judge, *side) for judge in judges]) for side in sides]
    usual = np.quantile(said[0][2][there], USUAL)
    unknown = [each[2] > usual for each in said[1:]]
    for name, of in (("networks", 0), ("nearness", 1)):
        worst = np.where(there, said[0][of], -np.inf).max(1)
        chance = _calibrated(worst, met)
        alone, guarded = (chance(each[of].max(1)) for each in said[1:])
        many = len(alone) * 2 // 3
        for driver, some in (("logged", slice(many)), ("bold", slice(many, None))):
            saved = alone[some] - guarded[some]
            shares.append(
                Played(
                    driver=driver,
                    judge=name,
                    alone=round(float(alone[some].mean()), 4),
                    guarded=round(float(guarded[some].mean()), 4),
                    error=round(float(ERROR * saved.std() / math.sqrt(len(saved))), 4),
                    unknown=tuple(round(float(each[some].mean()), 4) for each in unknown),
                    auroc=round(_auroc(worst[met], worst[~met]), 4),
                )
            )
    return tuple(shares)


def _windows(logged: Logged, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(first steps (W,), (W, K) bool: which of the steps that follow belong to their episodes) of held-out windows."""
    begun = rng.choice(_far(logged), min(LOGGED, len(_far(logged))), replace=False)
    left = logged.picked("last_row", begun) - logged.picked("row", begun)
    return begun, np.arange(STEPS) < left[:, None]


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
    """(J, W, K) of windows of steps, each (W, K, N, D), so many at once that judges are compiled once."""
    size = before.shape[:2]
    together = TOGETHER
    flat = [x.reshape(-1, *x.shape[2:]) for x in (before, after)]
    short = -len(flat[0]) % together
    parts = [np.concatenate([x, np.repeat(x[:1], short, 0)]).reshape(-1, together, *x.shape[1:]) for x in flat]
    found = np.concatenate([np.asarray(judge(*map(on_device, part))) for part in zip(*parts)], 1)
    return found[:, : size[0] * size[1]].reshape(-1, *size)


# --- judges ---


def _networks(world: World, logged: Logged) -> Judge:
    """Networks on all entries, as a barrier without causes has them, by every other episode."""
    kept = world.card.settings
    settings = dataclasses.replace(kept, loss="cross-entropy", barrier_updates=UPDATES, barrier_width=WIDTH)
    blank = dataclasses.replace(world.barrier.each[0], causes=())
    steps = logged.fitted_steps[logged.store.episode_of_step[logged.fitted_steps] % 2 == 0]
    unsafe = logged.unsafe[steps]
    data = *(logged.arrays[name] for name in ("features", "features", "row")), on_device(logged.label)  # none predicted
    settings = dataclasses.replace(settings, predicted_share=0.0)
    net = fit_label(blank, data, steps[unsafe], steps[~unsafe], jax.random.key(17), settings)
    return lambda before, after: _of_networks(net, before, after)


@eqx.filter_jit
def _of_networks(net: eqx.Module, before: Array, after: Array) -> Array:
    return -lowest(net.of_steps(before, after))[None]


def _nearness(world: World, logged: Logged, label: np.ndarray, rng: np.random.Generator) -> Judge:
    """How near a step is to danger, and how far from all that was logged: by things, each in its own deviations, of the
    agent and the thing that are in most of it."""
    shape = world.barrier.each[0].shape
    steps = logged.fitted_steps[logged.store.episode_of_step[logged.fitted_steps] % 2 == 1]
    bad, fine = steps[label[steps]], steps[~label[steps]]
    few = max(KNOWN // logged.map.plus.shape[0], 50)
    picked = [rng.choice(some, min(few, len(some)), replace=False) for some in (bad, fine)]
    harm, safe = (_parts(shape, logged.before(some), logged.after(some)) for some in picked)
    units = [(part.mean((0, 1, 2)), varying(part.std((0, 1, 2)), part.mean((0, 1, 2)))) for part in safe]
    harm, safe = ([(part - mean) / scale for part, (mean, scale) in zip(parts, units)] for parts in (harm, safe))
    flat = [part.reshape(-1, part.shape[-1]) for part in safe]
    flat = [on_device(rng.permutation(part)[:KNOWN], np.float32) for part in flat]
    blame = [np.ones(part.shape[:-1], np.float32) for part in harm]
    banks = [on_device(part.reshape(-1, part.shape[-1]), np.float32) for part in harm]
    for _ in range(ROUNDS):
        each = [_evidence(b, b, on_device(w.ravel()), f)[1] for b, w, f in zip(banks, blame, flat)]
        each = [np.asarray(e).reshape(len(picked[0]), -1) + np.log(w.mean() + 1e-6) for e, w in zip(each, blame)]
        share = jax.nn.softmax(np.concatenate(each, 1), 1)
        ends = np.cumsum([e.shape[1] for e in each])[:-1]
        blame = [part.reshape(w.shape) for part, w in zip(np.split(np.asarray(share), ends, 1), blame)]
    given = shape, units, banks, [on_device(w.ravel()) for w in blame], flat
    return lambda before, after: _near(*given, before, after)


@eqx.filter_jit
def _near(
    shape: Shape,
    units: list[tuple[np.ndarray, np.ndarray]],
    banks: list[Array],
    blame: list[Array],
    safe: list[Array],
    before: Array,
    after: Array,
) -> Array:
    """(2, W) how near steps are to danger, and how far from the nearest that was logged, by the worst thing."""
    far, near = [], []
    for part, (mean, scale), bank, weight, fine in zip(_parts(shape, before, after), units, banks, blame, safe):
        read = ((part - mean) / scale).reshape(-1, part.shape[-1])
        for found, one in zip((far, near), _evidence(read, bank, weight, fine)):
            found.append(one.reshape(len(after), -1))
    return jnp.stack([jnp.concatenate(each, 1).max(1) for each in (near, far)])


@jax.jit
def _evidence(read: Array, bank: Array, weight: Array, safe: Array) -> tuple[Array, Array]:
    """(M,) how far entries (M, F) are from the nearest of both banks (Q, F), in deviations of an entry; and the
    logarithm of how much nearer they are to those that were dangerous, each with its weight, than to the safe ones."""
    squares = [((read**2).sum(1)[:, None] + (b**2).sum(1) - 2 * read @ b.T) / read.shape[1] for b in (bank, safe)]
    nearest = jnp.sqrt(jnp.maximum(jnp.minimum(squares[0].min(1), squares[1].min(1)), 0.0))
    dense = [
        jax.scipy.special.logsumexp(-0.5 * s / NEAR**2, 1, b=w)
        for s, w in zip(squares, (weight / weight.sum(), jnp.full(len(safe), 1.0 / len(safe))))
    ]
    return nearest, dense[0] - dense[1]


def _parts(shape: Shape, before: Array, after: Array) -> list[Array]:
    """Entries (W, N, J, F) that are read together: own ones, and those of things of each kind."""
    x = after
    groups = [np.array(entries) for _, entries in shape.pairs]
    if shape.own:
        groups.insert(0, np.array([shape.own]))
    if shape.use_transition:
        x = (np if isinstance(after, np.ndarray) else jnp).concatenate([after, after - before], -1)
        groups = [np.concatenate([entries, entries + after.shape[-1]], -1) for entries in groups]
    return [x[..., entries] for entries in groups]


# --- drivers ---


class Driver(eqx.Module):
    """What agents of the logs do, by what they see: least squares through random units."""

    first: Array  # (F, UNITS)
    weights: Array  # (N, 1 + F + UNITS, A)

    def __call__(self, read: Array) -> Array:
        """Actions (..., N, A) of standardised features (..., N, F)."""
        return jnp.clip(jnp.einsum("...np,npa->...na", _units(self.first, read), self.weights), -1.0, 1.0)


def _driver(world: World, logged: Logged, rng: np.random.Generator) -> Driver:
    steps = logged.fitted_steps
    some = rng.choice(steps, min(LEARNED, len(steps)), replace=False)
    read = _standard(world, on_device(logged.before(some)))
    first = rng.normal(0, 1 / math.sqrt(read.shape[-1]), (read.shape[-1], UNITS))
    first = on_device(first, np.float32)
    return Driver(first, _solved(_units(first, read), on_device(logged.picked("actions", some))))


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
    """Rows (W, K+1, N, D) of windows alone, and the same guarded: the first two thirds by drivers like those of the logs,
    then who wants anything, then who climbs rewards."""
    card = replace(world.card, look=look_of(world.card))
    guard = build(None, dataclasses.replace(world, card=card), None, "shield", "learned", anyway=True).guard
    far = _far(logged)
    x = on_device(logged.before(rng.choice(far, count, replace=len(far) < count)))
    safe = logged.held_steps[~logged.unsafe[logged.held_steps]]
    bank = rng.choice(safe, BANK)
    steps = (on_device(x) for x in (logged.before(bank), logged.picked("actions", bank), logged.after(bank)))
    wants = _wanted(rng, count * 5 // 6 - count * 2 // 3, *logged.arrays["actions"].shape[1:])
    drawn = rng.integers(0, BANK, (STEPS, count))
    given = guard, _driver(world, logged, rng), x, on_device(wants), _errors(world, *steps), on_device(drawn)
    both = (np.moveaxis(np.asarray(_play(jnp.asarray(guarded), *given)), 0, 1) for guarded in (False, True))
    alone, guarded = (np.concatenate([np.asarray(x)[:, None], rows], 1) for rows in both)
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
    own = dataclasses.replace(world.values, alone=True)  # what every agent earns for the team
    some = np.concatenate([np.zeros((1, wants.shape[-1])), directions(wants.shape[-1])])[:CHOICES]
    order = [np.random.default_rng(agent).permutation(len(some)) for agent in range(x.shape[1])]
    tried = jnp.asarray(some[np.stack(order, 1)], jnp.float32)  # (S, N, A)
    middle, last = len(x) * 2 // 3, len(x) * 5 // 6

    def climbs(x: Array) -> Array:
        """What earns most by what is predicted, of what is held for a while."""
        plans = jnp.broadcast_to(tried[:, None], (len(x), len(tried), AHEAD, *tried.shape[1:]))
        rows, _ = guard.predict(x, plans)
        earned = own.of_steps(rows[..., :-1, :, :], plans, rows[..., 1:, :, :]).sum(2)
        return jnp.take_along_axis(tried[None], earned.argmax(1)[:, None, :, None], 1)[:, 0]

    def corrected(x: Array, action: Array) -> Array:
        plan = held(action, guard.options.horizon)
        return guard.decide(x, plan, plan[:, 0], margin, jax.random.key(0)).plan[:, 0]

    def step(x: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        want, error = now
        action = jnp.concatenate([driver(_standard(world, x[:middle])), want, climbs(x[last:])])
        action = world.spec.own(action)
        action = jax.lax.cond(guarded, corrected, lambda x, action: action, x, action)
        after = acts.arrived(x, acts.changes(x, action).mean(0) + errors[error])
        return after, after

    return jax.lax.scan(step, x, (wants, drawn))[1]
