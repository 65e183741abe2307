"""How good a World is: what episodes that no part of it has seen say of each part, for its card."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from msgspec.structs import replace

from ringfence.problem.constraints import lowest
from ringfence.problem.entries import Entries
from ringfence.problem.features import FeatureMap
from ringfence.types import Array
from ringfence.utils.precision import on_device
from ringfence.world import cause_candidates, probes
from ringfence.world.barrier import Barrier, MinBarrier
from ringfence.world.card import (
    UNKNOWN,
    Avoidable,
    BarrierScores,
    Foresight,
    HeldOut,
    MarginScores,
    PredictionError,
    Settings,
    Threshold,
    ValueScores,
)
from ringfence.world.causes import Cause, Edge
from ringfence.world.dynamics import Dynamics
from ringfence.world.logged import Logged
from ringfence.world.margins import (
    OUTLIERS,
    calibrated,
    conformal,
    count_entries,
    entries,
    rolled,
    scores_of_ends,
    widening,
)
from ringfence.world.model import World
from ringfence.world.quantities import Entry
from ringfence.world.values import Values

SCORED = 20_000  # steps that are scored at once
FALSE_ALARMS = 0.01  # of the safe steps, at which recall is given
STRANGE = 0.95  # share of held-out episodes that stay below the ensemble's threshold throughout
# The least margin, by loss: log-odds (4: 1 in 55, with both classes equally frequent), or of the 1 that hinges ask for.
LEAST = {"cross-entropy": 4.0, "hinges": 0.1, "gradient-penalty": 0.1}
UNJUDGED = 5.0  # the margin of a barrier that held-out episodes say nothing of
MARGINS = {0.0, 1.0, 2.0, 4.0, 8.0}  # that the card gives numbers of, beside the calibrated one
FEW = 5  # entries into danger, with fewer of which nothing is said
ENOUGH = 30  # held-out windows of what a barrier reads, with fewer of which nothing is said of so many steps ahead
AVOIDED = 0.95  # share of entries at which danger counts as avoidable
AIM = 0.01  # score that the search for actions that avoid it aims at: steps towards 0 itself end a hair below


@dataclass(frozen=True)
class Judging:
    """How much a World is asked. Less of it takes less time, and the card knows less."""

    steps: int = 60_000  # held-out ones that are scored
    windows: int = 3000  # held-out ones that are predicted, and entries into danger that margins are read from
    ahead: int = 8  # steps that features are predicted over
    read: int = 1000  # windows in which what a barrier reads is predicted
    read_steps: tuple[int, ...] = (1, 3, 5, 10, 15)  # ahead: rows are what guards look at, however long they take
    widened: tuple[int, ...] = (5, 7, 10, 15, 20, 30)  # steps ahead whose own margins are read
    foreseen: int = 1000  # entries that these are read from
    probed: int = 500  # states in which a barrier is asked about somebody nearer and farther
    avoided: int = 100  # entries into danger of which it is asked whether they could be avoided; 0: none
    before: tuple[int, ...] = (1, 2, 3, 5, 7, 10, 15, 20, 30)  # so many steps before them
    rounds: int = 15  # of the search for actions that avoid them
    searched: int = 128  # safe states from which a guard searches for what its World calls safe; 0: none
    corrections: int = 10  # of each of its searches
    restarts: int = 1  # likewise


JUDGING = Judging()  # of all Worlds


def judged(world: World, logged: Logged, whole: Logged, judging: Judging) -> World:
    """The World with its margins, and with a card that says how good it is; but for what a guard's search finds.
    `whole`: the logs as they are, where `logged` is cut at impacts, since returns go on after these."""
    rng = np.random.default_rng(0)
    predicted = prediction_error(world.dynamics, logged, rng, judging)
    explained = _value_scores(world.values, whole, world.alone, rng, judging.steps)
    ood = _threshold(world.dynamics, logged, judging.steps)
    of_barrier = _Judge(world.dynamics, world.card.settings, judging, rng)
    barrier = world.barrier
    scores = None
    constraints = None
    if isinstance(barrier, MinBarrier):
        each, found = zip(*(of_barrier.calibrated(b, logged.by(name)) for name, b in zip(barrier.names, barrier.each)))
        constraints = dict(zip(barrier.names, found))
        barrier = dataclasses.replace(barrier, each=each)
        scores, _ = of_barrier.scores(barrier, logged, 1.0)
    elif barrier is not None:
        barrier, scores = of_barrier.calibrated(barrier, logged)
    read = () if barrier is None else _foresight(world.dynamics, barrier, logged, judging)
    card = replace(
        world.card,
        held_out=HeldOut(episodes=int(whole.held_out.sum()), steps=len(whole.held_steps)),
        prediction_error=replace(predicted, read=read),
        values=explained,
        ood=ood,
        barrier=scores,
        constraints=constraints,
    )
    threshold = jnp.asarray(ood.threshold, jnp.float32)
    return dataclasses.replace(world, barrier=barrier, ood_threshold=threshold, card=card)


# --- predictions ---


def prediction_error(dynamics: Dynamics, logged: Logged, rng: np.random.Generator, judging: Judging) -> PredictionError:
    """Root mean square errors of held-out windows, rolled out along the logged actions."""
    held = logged.held_steps
    left = logged.picked("last_row", held) - logged.picked("row", held)
    ahead = int(min(judging.ahead, left.max()))
    starts = held[left >= ahead]
    starts = rng.choice(starts, min(judging.windows, len(starts)), replace=False)
    predicted, _ = rolled(dynamics, logged, starts, ahead)
    row = logged.picked("row", starts)
    came = logged.picked("features", row[:, None] + np.arange(ahead + 1))
    apart = logged.map.apart
    error = _rms(apart(np.asarray(predicted), came[:, 1:]))
    scale = np.maximum(np.asarray(dynamics.scale), 1e-9)

    def size(error: np.ndarray) -> np.ndarray:
        """(K,) of errors (K, D), over the entries that are predicted, each in its deviation."""
        return np.sqrt(((error / scale)[:, dynamics.predicted] ** 2).mean(1))

    usual = np.maximum(size(_rms(apart(came[:, 1:], came[:, :1]))), 1e-9)
    followed = starts[row > logged.picked("first_row", starts)]
    coasting = size(_coasted(logged, followed, ahead)) / usual if len(followed) else ()
    shown = sorted({0, min(2, ahead - 1), ahead - 1})
    return PredictionError(
        steps_ahead=tuple(range(1, ahead + 1)),
        error_of_change=tuple(round(float(v), 4) for v in size(error) / usual),
        by_entry={name: tuple(float(f"{error[k, d]:.3g}") for k in shown) for d, name in enumerate(logged.map.names)},
        coasting=tuple(round(float(v), 4) for v in coasting) if np.isfinite(coasting).all() else (),
    )


def _coasted(logged: Logged, starts: np.ndarray, ahead: int) -> np.ndarray:
    """(K, D) root mean square errors where everything goes on as it did in the step before."""
    row = logged.picked("row", starts)
    x = np.asarray(logged.arrays["features"])
    now = x[row]
    apart = logged.map.apart
    moved = apart(now, x[row - 1])
    return _rms(np.stack([apart(now + k * moved, x[row + k]) for k in range(1, ahead + 1)], 1))


def _rms(error: np.ndarray) -> np.ndarray:
    """(K, D) of windows (W, K, N, D)."""
    return np.sqrt((error**2).mean((0, 2)))


def _threshold(dynamics: Dynamics, logged: Logged, count: int) -> Threshold:
    """The conformal quantile, over held-out episodes, of the ensemble's largest disagreement."""
    steps = logged.held_steps[:count]
    _, spread = rolled(dynamics, logged, steps, 1)
    worst = np.asarray(spread)[:, 0].max(-1)
    episode = logged.store.episode_of_step[steps]
    most = np.array([worst[episode == e].max() for e in np.unique(episode)])
    return Threshold(threshold=conformal(most, STRANGE), level=STRANGE)


# --- predictions of what a barrier reads ---


def _foresight(
    dynamics: Dynamics, barrier: Barrier | MinBarrier, logged: Logged, judging: Judging
) -> tuple[Foresight, ...]:
    """How well everything that a barrier reads is predicted, in its own unit, beside everything going on as it did: in
    held-out windows, along the logged actions."""
    steps, starts = _windows(logged, judging)
    if not steps:
        return ()
    starts = np.random.default_rng(1).choice(starts, min(judging.read, len(starts)), replace=False)
    row = logged.picked("row", starts)
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
                error=_lengths(_read(predicted, cause, edge) - truth),
                coasting=_lengths(_read(coasted, cause, edge) - truth),
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


def _windows(logged: Logged, judging: Judging) -> tuple[tuple[int, ...], np.ndarray]:
    """(how many steps ahead, held-out steps that as many follow and one precedes)."""
    row, first, last = (logged.picked(name, logged.held_steps) for name in ("row", "first_row", "last_row"))
    left = np.where(row > first, last - row, 0)
    steps = tuple(k for k in judging.read_steps if (left >= k).sum() >= ENOUGH)
    if steps:
        return steps, logged.held_steps[left >= steps[-1]]
    return (), logged.held_steps[:0]


def _reads(barrier: Barrier | MinBarrier, names: Sequence[str]) -> dict[str, tuple[Cause, Edge | None]]:
    """What a barrier reads, by its name in words: its causes, or all entries, places of others as how far they are."""
    found: dict[str, tuple[Cause, Edge | None]] = {}
    for one in barrier.each:
        if one.causes:
            found |= {_name(net.cause, net.edge): (net.cause, net.edge) for net in one.causes}
            continue
        offsets = cause_candidates.offsets(names)
        inside = {d for cause in offsets for thing in cause.entries() for d in thing}
        found |= {_name(cause, None): (cause, None) for cause in offsets}
        found |= {name: (Cause((Entry((d,), name),)), None) for d, name in enumerate(names) if d not in inside}
    return found


def _name(cause: Cause, edge: Edge | None) -> str:
    if not cause.goes_on or cause.things == 1:
        return cause.name
    return f"{cause.name}, of the {'farthest' if _farther_is_worse(edge) else 'nearest'}"


def _farther_is_worse(edge: Edge | None) -> bool:
    return edge is not None and edge.at is not None and not edge.below


def _read(x: np.ndarray, cause: Cause, edge: Edge | None) -> np.ndarray:
    """(values, steps, entries): what a cause reads of features (W, K, N, D). Of distances, that of the thing in most
    danger: which of them is listed where may change."""
    read = np.moveaxis(cause.of(x), 1, 0)  # (K, W, N, J, width)
    held = cause.holds(x.shape[2])
    if not cause.goes_on:
        return np.swapaxes(read[:, :, held].reshape(len(read), -1, cause.width), 0, 1)
    sign = -1.0 if _farther_is_worse(edge) else 1.0
    worst = np.where(held, sign * read[..., 0], np.inf).min(-1)[:, :, held.any(1)]
    return np.swapaxes(sign * worst.reshape(len(read), -1, 1), 0, 1)


def _lengths(error: np.ndarray) -> tuple[float, ...]:
    """Root mean square, by steps ahead, of errors (values, steps, entries) as vectors."""
    return tuple(float(f"{value:.3g}") for value in np.sqrt((error**2).sum(-1).mean(0)))


# --- values ---


def _value_scores(values: Values, logged: Logged, alone: bool, rng: np.random.Generator, count: int) -> ValueScores:
    steps = rng.choice(logged.held_steps, min(count, len(logged.held_steps)), replace=False)
    before = on_device(logged.before(steps))
    actions = on_device(logged.picked("actions", steps))
    reward, value = _valued(values, before, actions, on_device(logged.after(steps)), alone)
    rewards = logged.picked("rewards", steps).mean(1)
    returns = np.asarray(logged.returns_to_go(values.discount))[steps]
    return ValueScores(_r2(rewards, np.asarray(reward)), _r2(returns, np.asarray(value)))


@eqx.filter_jit
def _valued(values: Values, before: Array, action: Array, after: Array, alone: bool) -> tuple[Array, Array]:
    """Reward and value (W,) of the team."""
    reward = values.of_steps(before, action, after)
    value = values.ahead(before)
    return (reward.mean(-1), value.mean(-1)) if alone else (reward, value)


def _r2(truth: np.ndarray, found: np.ndarray) -> float:
    """Share of the variance that is explained; of what does not vary, none is known."""
    if truth.var() <= 1e-12 * max(float(np.square(truth).mean()), 1e-12):
        return UNKNOWN
    return float(1 - ((truth - found) ** 2).mean() / max(truth.var(), 1e-12))


# --- the barrier ---


@dataclass(frozen=True, eq=False)
class _Judge:
    """What barriers of a World are judged by."""

    dynamics: Dynamics
    settings: Settings
    judging: Judging
    rng: np.random.Generator

    def calibrated(self, barrier: Barrier, logged: Logged) -> tuple[Barrier, BarrierScores]:
        """The barrier with its margin, and what is known of both; with what rows ahead ask for beyond the margin, where
        it was judged at all."""
        scores, unit = self.scores(barrier, logged)
        barrier = eqx.tree_at(lambda b: b.unit, barrier, jnp.asarray(unit, jnp.float32))
        if scores.warning:
            return barrier, scores
        asked = self.judging.widened, self.judging.foreseen
        more = widening(barrier, self.dynamics, logged, np.random.default_rng(2), *asked)
        return barrier, replace(scores, widening=more)

    def scores(
        self, barrier: Barrier | MinBarrier, logged: Logged, unit: float | None = None
    ) -> tuple[BarrierScores, float]:
        """(scores, margin): calibrated, unless it is known."""
        held = logged.held_steps
        unsafe = logged.unsafe
        bad = held[unsafe[held]]
        if len(bad) in (0, len(held)):
            kind = "safe" if len(bad) else "unsafe"
            warning = f"no held-out step is {kind}, so nothing is known of how well danger is recognised"
            return BarrierScores(warning=warning), UNJUDGED
        rng, asked = self.rng, self.judging
        steps = rng.choice(held, min(asked.steps, len(held)), replace=False)
        steps = np.unique(np.concatenate([steps, rng.choice(bad, min(asked.windows, len(bad)), replace=False)]))
        now, ahead = _scored(barrier, logged, steps)
        truth = unsafe[steps]
        ends = entries(logged, bad)
        ends = rng.choice(ends, min(asked.windows, len(ends)), replace=False)
        predicted = scores_of_ends(lambda *step: _score(barrier, *step), self.dynamics, logged, ends)
        entered = count_entries(logged, bad)
        if few := _too_few(entered, len(predicted)):
            return BarrierScores(warning=f"{few} to say how well danger is recognised, or to set a margin"), UNJUDGED
        safe, danger = now[~truth], now[truth]
        if unit is None:
            missed = max(self.settings.miscoverage, OUTLIERS / len(predicted))
            unit = max(LEAST[self.settings.loss], calibrated(predicted, safe, missed))
        share = float(unsafe[held].mean())
        answers = probes.probe(barrier, logged, unit, rng, asked.probed)
        shown = sorted(MARGINS | {round(unit, 2)})
        scores = BarrierScores(
            unsafe_share=share,
            auroc=_auroc(safe, danger),
            recall=_found(safe, danger),
            false_alarms=FALSE_ALARMS,
            false_safe=float((danger >= 0).mean()),
            false_unsafe=float((safe < 0).mean()),
            predicted_false_safe=float((predicted >= 0).mean()),
            margin=float(unit),
            miscoverage=float((predicted >= unit).mean()),
            calibration=tuple(_of_margin(margin, safe, danger, predicted, share) for margin in shown),
            ahead_kept=float((ahead[~truth] >= unit).mean()),
            avoidable=_avoidable(self.dynamics, barrier, logged.arrays, ends[: asked.avoided], asked),
            entries=float(entered),
            margin_kept=float((safe >= unit).mean()),
            probed=answers.inside,
            probes=answers.answers,
            maps=answers.maps,
        )
        return scores, unit


def _too_few(entries: int, predicted: int) -> str:
    """What there is too little of to judge a barrier by; nothing where there is enough."""
    if entries < FEW:
        return f"too few held-out steps enter danger ({entries})"
    if predicted < 2 * OUTLIERS:
        return f"too few held-out steps into danger are predicted ({predicted})"
    return ""


def recall(barrier: Barrier, logged: Logged, judging: Judging) -> float:
    """Share of the held-out unsafe steps that are found with FALSE_ALARMS; UNKNOWN where one kind is lacking."""
    steps = logged.held_steps[: judging.steps]
    unsafe = logged.unsafe[steps]
    if unsafe.all() or not unsafe.any():
        return UNKNOWN
    now, _ = _scored(barrier, logged, steps)
    return _found(now[~unsafe], now[unsafe])


def _found(safe: np.ndarray, danger: np.ndarray) -> float:
    """Share of the unsafe steps that score lower than all safe ones but FALSE_ALARMS."""
    return float((danger < np.quantile(safe, FALSE_ALARMS)).mean())


def _scored(barrier: Barrier | MinBarrier, logged: Logged, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ℓ of steps and V of where they lead, each (W,), of the agent in most danger."""
    now = []
    ahead = []
    for start in range(0, len(steps), SCORED):
        some = steps[start : start + SCORED]
        after = logged.after(some)
        now.append(np.asarray(_score(barrier, logged.before(some), after)))
        ahead.append(np.asarray(_score_ahead(barrier, after)))
    return np.concatenate(now), np.concatenate(ahead)


@jax.jit
def _score(barrier: Barrier | MinBarrier, before: Array, after: Array) -> Array:
    return lowest(barrier.of_steps(before, after))


@jax.jit
def _score_ahead(barrier: Barrier | MinBarrier, after: Array) -> Array:
    return lowest(barrier.ahead(after))


def _of_margin(
    margin: float, safe: np.ndarray, danger: np.ndarray, predicted: np.ndarray, share: float
) -> MarginScores:
    """Of held-out steps with that margin: how many of 1000 are unsafe, weighed by how frequent the classes are."""
    passed = float((safe >= margin).mean())
    missed = float((danger >= margin).mean())
    both = share * missed + (1 - share) * passed
    return MarginScores(
        margin=float(margin),
        unsafe_in_1000=float(1000 * share * missed / both) if both else 0.0,
        unsafe_predicted_above=float((predicted >= margin).mean()),
        safe_kept=passed,
    )


def _auroc(safe: np.ndarray, danger: np.ndarray) -> float:
    """Probability that a safe step scores higher than an unsafe one."""
    from scipy.stats import mannwhitneyu  # slow to import, and read by fits alone

    return float(mannwhitneyu(safe, danger, method="asymptotic").statistic / (len(safe) * len(danger)))


# --- what could be avoided ---


def _avoidable(
    dynamics: Dynamics, barrier: Barrier | MinBarrier, arrays: dict[str, Array], entered: np.ndarray, judging: Judging
) -> Avoidable | None:
    """How many of the steps that entered danger other actions could have avoided from so many steps before, and any
    danger within the longest such time, as the World predicts it. None where none is asked about."""
    if not len(entered):
        return None
    row, first, last = (np.asarray(arrays[name]) for name in ("row", "first_row", "last_row"))
    asked = {k: entered[row[entered] - (k - 1) >= first[entered]] for k in judging.before}
    asked = {k: ends for k, ends in asked.items() if len(ends)}
    start = np.concatenate([ends - (k - 1) for k, ends in asked.items()])
    left = np.minimum(np.arange(max(judging.before))[:, None], (last - row - 1)[start][None])
    x = np.asarray(arrays["features"])[row[start]]
    found = np.asarray(_avoided(dynamics, barrier, x, np.asarray(arrays["actions"])[start + left], judging.rounds))
    parts = np.split(found, np.cumsum([len(ends) for ends in asked.values()])[:-1])
    shares = {k: float(part.mean()) for k, part in zip(asked, parts)}
    most = max(shares.values())
    enough = [k for k, share in shares.items() if share >= AVOIDED * most]
    return Avoidable(before=tuple(shares), avoided=tuple(shares.values()), rows=enough[0])


@partial(jax.jit, static_argnames="rounds")
def _avoided(dynamics: Dynamics, barrier: Barrier | MinBarrier, x: Array, actions: Array, rounds: int) -> Array:
    """(W,) bool: whether some actions near the logged ones (K, W, N, A), searched for in so many rounds, keep all
    scores at 0 or more, from states (W, N, D)."""

    def worst(actions: Array) -> Array:
        def step(before: Array, action: Array) -> tuple[Array, Array]:
            after, _ = dynamics.step(before, action)
            return after, lowest(barrier.of_steps(before, after))

        return jax.lax.scan(step, x, actions)[1].min(0)

    def correct(_, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        actions, best = carry
        h, back = jax.vjp(worst, actions)
        slope = back(jnp.where(h < AIM, 1.0, 0.0))[0]
        size = jnp.maximum((slope**2).sum((0, 2, 3)), 1e-6)
        moved = actions - (jnp.minimum(h - AIM, 0.0) / size)[:, None, None] * slope
        return jnp.clip(moved, -1.0, 1.0), jnp.maximum(best, h)

    nothing = jnp.full(len(x), -jnp.inf)
    actions, best = jax.lax.fori_loop(0, rounds, correct, (actions, nothing))
    return jnp.maximum(best, worst(actions)) >= 0
