"""How good a World is, on episodes that no part of it has seen."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from msgspec.structs import replace

from ringfence.problem.constraints import lowest
from ringfence.types import Array
from ringfence.utils.device import on_device
from ringfence.world import probes
from ringfence.world.barrier import Barrier, MinBarrier
from ringfence.world.card import (
    UNKNOWN,
    Avoidable,
    BarrierScores,
    HeldOut,
    MarginScores,
    PredictionError,
    Threshold,
    ValueScores,
)
from ringfence.world.dynamics import Dynamics
from ringfence.world.foresight import foresight
from ringfence.world.logged import Logged
from ringfence.world.margins import (
    OUTLIERS,
    WINDOWS,
    calibrated,
    conformal,
    count_entries,
    entries,
    rolled,
    scores_of_ends,
    widening,
)
from ringfence.world.model import World
from ringfence.world.values import Values

AHEAD = 8  # steps that predictions are validated over
STEPS = 60_000  # held-out steps that are scored
SCORED = 20_000  # of them at once
FALSE_ALARMS = 0.01  # of the safe steps, at which recall is given
STRANGE = 0.95  # share of held-out episodes that stay below the ensemble's threshold throughout
# The least margin, by loss: log-odds (4: 1 in 55, with both classes equally frequent), or of the 1 that hinges ask for.
LEAST = {"cross-entropy": 4.0, "hinges": 0.1, "gradient-penalty": 0.1}
UNJUDGED = 5.0  # the margin of a barrier that held-out episodes say nothing of
MARGINS = {0.0, 1.0, 2.0, 4.0, 8.0}  # that the card gives numbers of, beside the calibrated one
FEW = 5  # entries into danger, with fewer of which nothing is said
BEFORE = (1, 2, 3, 5, 7, 10, 15, 20, 30)  # steps before danger at which it is asked whether it could still be avoided
AVOIDED = 0.95  # share of entries at which it counts as avoidable
ENTERED = 100  # entries that are asked about
ROUNDS = 15  # of the search for actions that avoid it
AIM = 0.01  # score that the search aims at: steps towards 0 itself end a hair below


@dataclass(frozen=True)
class Validation:
    """What held-out episodes say of a World."""

    held_out: HeldOut
    prediction_error: PredictionError
    values: ValueScores
    ood: Threshold
    barrier: Barrier | MinBarrier | None  # with the margin that calibration asks for
    scores: BarrierScores | None
    constraints: dict[str, BarrierScores] | None


def validate(
    world: World,
    logged: Logged,
    whole: Logged,
    miscoverage: float,
    loss: str = "cross-entropy",
) -> Validation:
    """`miscoverage` is the share of unsafe steps that may be predicted at the default margin or above; `whole`: the
    logs as they are, where `logged` is cut at impacts, since returns go on after these."""
    rng = np.random.default_rng(0)
    held_out = HeldOut(episodes=int(whole.held_out.sum()), steps=len(whole.held_steps))
    read = foresight(world.dynamics, world.barrier, logged, np.random.default_rng(1))
    predicted = replace(prediction_error(world.dynamics, logged, rng), read=read)
    explained = _value_scores(world.values, whole, world.alone, rng)
    ood = _threshold(world.dynamics, logged)
    barrier = world.barrier
    scores = None
    constraints = None
    if isinstance(barrier, MinBarrier):
        each = {}
        constraints = {}
        for name, one in zip(barrier.names, barrier.each):
            found, unit = _barrier_scores(world.dynamics, one, logged.by(name), rng, miscoverage, LEAST[loss])
            each[name] = _in_units(one, unit)
            constraints[name] = _with_widening(found, each[name], world.dynamics, logged.by(name))
        barrier = MinBarrier(tuple(each.values()), barrier.names)
        scores, _ = _barrier_scores(world.dynamics, barrier, logged, rng, miscoverage, 1.0, 1.0)
    elif barrier is not None:
        scores, unit = _barrier_scores(world.dynamics, barrier, logged, rng, miscoverage, LEAST[loss])
        barrier = _in_units(barrier, unit)
        scores = _with_widening(scores, barrier, world.dynamics, logged)
    return Validation(held_out, predicted, explained, ood, barrier, scores, constraints)


def _with_widening(scores: BarrierScores, barrier: Barrier, dynamics: Dynamics, logged: Logged) -> BarrierScores:
    """The scores with what rows ahead ask for beyond the margin, where it was judged at all."""
    if scores.warning:
        return scores
    return replace(scores, widening=widening(barrier, dynamics, logged, np.random.default_rng(2)))


def _in_units(barrier: Barrier, unit: float) -> Barrier:
    return eqx.tree_at(lambda b: b.unit, barrier, jnp.asarray(unit, jnp.float32))


# --- predictions ---


def prediction_error(dynamics: Dynamics, logged: Logged, rng: np.random.Generator) -> PredictionError:
    """Root mean square errors of held-out windows, rolled out along the logged actions."""
    held = logged.held_steps
    left = logged.picked("last_row", held) - logged.picked("row", held)
    ahead = int(min(AHEAD, left.max()))
    starts = held[left >= ahead]
    starts = rng.choice(starts, min(WINDOWS, len(starts)), replace=False)
    predicted, _ = rolled(dynamics, logged, starts, ahead)
    row = np.asarray(logged.arrays["row"])[starts]
    came = logged.picked("features", row[:, None] + np.arange(ahead + 1))
    apart = logged.map.apart
    error = _rms(apart(np.asarray(predicted), came[:, 1:]))
    change = _rms(apart(came[:, 1:], came[:, :1]))
    scale = np.maximum(np.asarray(dynamics.scale), 1e-9)
    entries = dynamics.predicted
    share = _over_entries(error / scale, entries) / np.maximum(_over_entries(change / scale, entries), 1e-9)
    coasted = _coasted(logged, starts, ahead)
    coasting = _over_entries(coasted / scale, entries) / np.maximum(_over_entries(change / scale, entries), 1e-9)
    shown = sorted({0, min(2, ahead - 1), ahead - 1})
    return PredictionError(
        steps_ahead=tuple(range(1, ahead + 1)),
        error_of_change=tuple(round(float(v), 4) for v in share),
        by_entry={name: tuple(float(f"{error[k, d]:.3g}") for k in shown) for d, name in enumerate(logged.map.names)},
        coasting=tuple(round(float(v), 4) for v in coasting) if np.isfinite(coasting).all() else (),
    )


def _coasted(logged: Logged, starts: np.ndarray, ahead: int) -> np.ndarray:
    """(K, D) root mean square errors where everything goes on as it did in the step before."""
    row, first = (np.asarray(logged.arrays[name])[starts] for name in ("row", "first_row"))
    row = row[row > first]
    if not len(row):
        return np.full((ahead, len(logged.map.names)), np.nan)
    x = np.asarray(logged.arrays["features"])
    now = x[row]
    apart = logged.map.apart
    moved = apart(now, x[row - 1])
    errors = [apart(now + k * moved, x[row + k]) for k in range(1, ahead + 1)]
    return _rms(np.stack(errors, 1))


def _rms(error: np.ndarray) -> np.ndarray:
    """(K, D) of windows (W, K, N, D)."""
    return np.sqrt((error**2).mean((0, 2)))


def _over_entries(error: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """(K,) root mean square of some of the entries (K, D)."""
    return np.sqrt((error[:, entries] ** 2).mean(1))


def _threshold(dynamics: Dynamics, logged: Logged) -> Threshold:
    """The conformal quantile, over held-out episodes, of the ensemble's largest disagreement."""
    steps = logged.held_steps[:STEPS]
    _, spread = rolled(dynamics, logged, steps, 1)
    worst = np.asarray(spread)[:, 0].max(-1)
    episode = logged.store.episode_of_step[steps]
    most = np.array([worst[episode == e].max() for e in np.unique(episode)])
    return Threshold(threshold=conformal(most, STRANGE), level=STRANGE)


# --- values ---


def _value_scores(values: Values, logged: Logged, alone: bool, rng: np.random.Generator) -> ValueScores:
    steps = rng.choice(logged.held_steps, min(STEPS, len(logged.held_steps)), replace=False)
    before = on_device(logged.before(steps))
    actions = on_device(logged.picked("actions", steps))
    reward, value = _valued(values, before, actions, on_device(logged.after(steps)), alone)
    rewards = np.asarray(logged.arrays["rewards"])[steps].mean(1)
    returns = np.asarray(logged.returns_to_go(values.discount))[steps]
    return ValueScores(
        reward_r2=_r2(rewards, np.asarray(reward)),
        value_r2=_r2(returns, np.asarray(value)),
    )


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


def _barrier_scores(
    dynamics: Dynamics,
    barrier: Barrier | MinBarrier,
    logged: Logged,
    rng: np.random.Generator,
    miscoverage: float,
    least: float,
    unit: float | None = None,
) -> tuple[BarrierScores, float]:
    """(scores, margin): calibrated, at `least` so much, unless it is known."""
    held = logged.held_steps
    unsafe = logged.unsafe
    bad = held[unsafe[held]]
    if len(bad) in (0, len(held)):
        kind = "safe" if len(bad) else "unsafe"
        warning = f"no held-out step is {kind}, so nothing is known of how well danger is recognised"
        return BarrierScores(warning=warning), UNJUDGED
    steps = rng.choice(held, min(STEPS, len(held)), replace=False)
    steps = np.unique(np.concatenate([steps, rng.choice(bad, min(WINDOWS, len(bad)), replace=False)]))
    now, ahead = _scored(barrier, logged, steps)
    truth = unsafe[steps]
    ends = entries(logged, bad)
    ends = rng.choice(ends, min(WINDOWS, len(ends)), replace=False)
    predicted = scores_of_ends(lambda *step: _score(barrier, *step), dynamics, logged, ends)
    if few := _too_few(count_entries(logged, bad), len(predicted)):
        return BarrierScores(warning=f"{few} to say how well danger is recognised, or to set a margin"), UNJUDGED
    if unit is None:
        unit = max(least, calibrated(predicted, now[~truth], max(miscoverage, OUTLIERS / len(predicted))))
    share = float(unsafe[held].mean())
    alarm = np.quantile(now[~truth], FALSE_ALARMS)
    asked = probes.probe(barrier, logged, unit, rng)
    scores = BarrierScores(
        unsafe_share=share,
        auroc=_auroc(now, truth),
        recall=float((now[truth] < alarm).mean()),
        false_alarms=FALSE_ALARMS,
        false_safe=float((now[truth] >= 0).mean()),
        false_unsafe=float((now[~truth] < 0).mean()),
        predicted_false_safe=float((predicted >= 0).mean()),
        margin=float(unit),
        miscoverage=float((predicted >= unit).mean()),
        calibration=tuple(_of_margin(m, now, truth, predicted, share) for m in sorted(MARGINS | {round(unit, 2)})),
        ahead_kept=float((ahead[~truth] >= unit).mean()),
        avoidable=_avoidable(dynamics, barrier, logged.arrays, ends[:ENTERED]),
        entries=float(count_entries(logged, bad)),
        margin_kept=float((now[~truth] >= unit).mean()),
        probed=asked.inside,
        probes=asked.answers,
        maps=asked.maps,
    )
    return scores, unit


def _too_few(entries: int, predicted: int) -> str:
    """What there is too little of to judge a barrier by; nothing where there is enough."""
    if entries < FEW:
        return f"too few held-out steps enter danger ({entries})"
    if predicted < 2 * OUTLIERS:
        return f"too few held-out steps into danger are predicted ({predicted})"
    return ""


def recall(barrier: Barrier, logged: Logged) -> float:
    """Share of the held-out unsafe steps that are found with FALSE_ALARMS; UNKNOWN where one kind is lacking."""
    steps = logged.held_steps[:STEPS]
    unsafe = logged.unsafe[steps]
    if unsafe.all() or not unsafe.any():
        return UNKNOWN
    now, _ = _scored(barrier, logged, steps)
    return float((now[unsafe] < np.quantile(now[~unsafe], FALSE_ALARMS)).mean())


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


def _of_margin(margin: float, now: np.ndarray, unsafe: np.ndarray, predicted: np.ndarray, share: float) -> MarginScores:
    """Of held-out steps with that margin: how many of 1000 are unsafe, weighed by how frequent the classes are."""
    passed = float((now[~unsafe] >= margin).mean())
    missed = float((now[unsafe] >= margin).mean())
    both = share * missed + (1 - share) * passed
    return MarginScores(
        margin=float(margin),
        unsafe_in_1000=float(1000 * share * missed / both) if both else 0.0,
        unsafe_predicted_above=float((predicted >= margin).mean()),
        safe_kept=passed,
    )


def _auroc(score: np.ndarray, unsafe: np.ndarray) -> float:
    """Probability that a safe step scores higher than an unsafe one."""
    from scipy.stats import mannwhitneyu  # slow to import, and read by fits alone

    safe, bad = score[~unsafe], score[unsafe]
    return float(mannwhitneyu(safe, bad, method="asymptotic").statistic / (len(safe) * len(bad)))


# --- what could be avoided ---


def _avoidable(
    dynamics: Dynamics, barrier: Barrier | MinBarrier, arrays: dict[str, Array], entered: np.ndarray
) -> Avoidable:
    """How many of the steps that entered danger other actions could have avoided from so many steps before, and any
    danger within the longest such time, as the World predicts it."""
    row, first, last = (np.asarray(arrays[name]) for name in ("row", "first_row", "last_row"))
    asked = {k: entered[row[entered] - (k - 1) >= first[entered]] for k in BEFORE}
    asked = {k: ends for k, ends in asked.items() if len(ends)}
    start = np.concatenate([ends - (k - 1) for k, ends in asked.items()])
    left = np.minimum(np.arange(max(BEFORE))[:, None], (last - row - 1)[start][None])
    x = np.asarray(arrays["features"])[row[start]]
    found = np.asarray(_avoided(dynamics, barrier, x, np.asarray(arrays["actions"])[start + left]))
    parts = np.split(found, np.cumsum([len(ends) for ends in asked.values()])[:-1])
    shares = {k: float(part.mean()) for k, part in zip(asked, parts)}
    most = max(shares.values())
    enough = [k for k, share in shares.items() if share >= AVOIDED * most]
    return Avoidable(before=tuple(shares), avoided=tuple(shares.values()), rows=enough[0])


@jax.jit
def _avoided(dynamics: Dynamics, barrier: Barrier | MinBarrier, x: Array, actions: Array) -> Array:
    """(W,) bool: whether some actions near the logged ones (K, W, N, A) keep all scores at 0 or more, from states
    (W, N, D)."""

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
    actions, best = jax.lax.fori_loop(0, ROUNDS, correct, (actions, nothing))
    return jnp.maximum(best, worst(actions)) >= 0
