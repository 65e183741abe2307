"""How good a World is, on episodes that no part of it has seen; in numbers, and in words."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.problem.constraints import lowest
from ringfence.types import Array
from ringfence.world.barrier import Barrier, Worst
from ringfence.world.card import JUDGED
from ringfence.world.model import World

VERSION = 7  # of the judgement: cached cards of another are made again
AHEAD = 8  # steps that foresight is judged over
WINDOWS = 3000  # of each kind that it is judged on
STEPS = 60_000  # held-out steps that scores are judged on
FALSE_ALARMS = 0.01  # of the safe steps, at which recall is told
# The least margin, by loss: log-odds (4: 1 in 55, with both classes equally frequent), or of the 1 that hinges ask for.
LEAST = {"cross-entropy": 4.0, "hinges": 0.1, "gradient-penalty": 0.1}
ENTRIES = 30  # into danger: fewer say nothing, and all unsafe steps stand for them
OUTLIERS = 3  # entries that may look safe however few there are: one freak of foresight is not to set the margin
BEFORE = (1, 2, 3, 5, 7, 10, 15)  # steps before danger at which it is asked whether it could still be avoided
AVOIDED = 0.95  # share of entries at which it counts as avoidable
ENTERED = 100  # entries that are asked about
ROUNDS = 15  # of the search for actions that avoid it
AIM = 0.01  # score that the search aims at: steps towards 0 itself end a hair below


def judge(
    world: World, told, level: float, missed: float, loss: str = "cross-entropy"
) -> tuple[dict[str, Any], float, Barrier | Worst | None]:
    """(facts, the ensemble's threshold, the barrier with the margin that calibration asks for)."""
    rng = np.random.default_rng(0)
    facts: dict[str, Any] = {"held_out": {"episodes": int(told.held.sum()), "steps": int(len(told.kept))}}
    facts["foresight"] = _foresight(world, told, rng)
    facts["values"] = _values(world, told, rng)
    strange = _strange(world, told, level)
    facts["strange"] = {"threshold": strange, "level": level}
    barrier = world.barrier
    if isinstance(barrier, Worst):
        each = {
            name: _barrier(_with(world, one), told.of(name), rng, missed, LEAST[loss])
            for name, one in zip(barrier.names, barrier.each)
        }
        barrier = Worst(tuple(_in_units(b, each[k][1]) for k, b in zip(barrier.names, barrier.each)), barrier.names)
        facts["barrier"], _ = _barrier(_with(world, barrier), told, rng, missed, 1.0, 1.0)
        facts["constraints"] = {name: found for name, (found, _) in each.items()}
    elif barrier is not None:
        facts["barrier"], unit = _barrier(world, told, rng, missed, LEAST[loss])
        barrier = _in_units(barrier, unit)
    return facts, strange, barrier


def _with(world: World, barrier: Barrier | Worst) -> World:
    return dataclasses.replace(world, barrier=barrier)


def _in_units(barrier: Barrier, unit: float) -> Barrier:
    return eqx.tree_at(lambda b: b.unit, barrier, jnp.asarray(unit, jnp.float32))


def _foresight(world: World, told, rng) -> dict[str, Any]:
    """Root mean square errors of held-out windows, rolled out along the logged actions."""
    left = np.asarray(told.arrays["last_row"] - told.arrays["row"])[told.kept]
    ahead = int(min(AHEAD, left.max()))
    starts = told.kept[left >= ahead]
    starts = rng.choice(starts, min(WINDOWS, len(starts)), replace=False)
    foreseen, _ = _rolled(world, told, starts, ahead)
    row = np.asarray(told.arrays["row"])[starts]
    x = told.arrays["features"]
    came = np.stack([np.asarray(x[row + k]) for k in range(ahead + 1)], 1)
    error = np.asarray(foreseen) - came[:, 1:]
    scale = np.maximum(np.asarray(world.dynamics.scale), 1e-9)
    rms = np.sqrt((error**2).mean((0, 2)))  # (ahead, D)
    still = np.sqrt(((came[:, 1:] - came[:, :1]) ** 2).mean((0, 2)))
    entries = world.dynamics.foreseen
    share = np.sqrt(((rms / scale)[:, entries] ** 2).mean(1)) / np.maximum(
        np.sqrt(((still / scale)[:, entries] ** 2).mean(1)), 1e-9
    )
    return {
        "steps_ahead": list(range(1, ahead + 1)),
        "error_of_change": [round(float(v), 4) for v in share],
        "by_entry": {
            name: [float(f"{rms[k, d]:.3g}") for k in sorted({0, min(2, ahead - 1), ahead - 1})]
            for d, name in enumerate(world.map.names)
        },
    }


def _rolled(world: World, told, starts: np.ndarray, ahead: int) -> tuple[Array, Array]:
    """Rows (W, K, N, D) and disagreement (W, K, N) from the states before steps, along the logged actions."""
    row = told.arrays["row"][starts]
    actions = jnp.stack([told.arrays["actions"][np.minimum(starts + k, told.store.steps - 1)] for k in range(ahead)])

    @jax.jit
    def roll(world: World, x: Array, actions: Array):
        def step(x, action):
            after, spread = world.dynamics.step(x, action)
            return after, (after, spread)

        return jax.lax.scan(step, x, actions)[1]

    rows, spread = roll(world, told.arrays["features"][row], actions)
    return jnp.moveaxis(rows, 0, 1), jnp.moveaxis(spread, 0, 1)


def _values(world: World, told, rng) -> dict[str, float]:
    steps = rng.choice(told.kept, min(STEPS, len(told.kept)), replace=False)
    row = told.arrays["row"][steps]
    x = told.arrays["features"]
    team = np.asarray(told.arrays["rewards"])[steps].mean(1)
    togo = np.asarray(told.togo(world.values.discount))[steps]

    @jax.jit
    def tell(world: World, before, action, after):
        reward, value = world.values.of_steps(before, action, after), world.values.ahead(before)
        return (reward.mean(-1), value.mean(-1)) if world.alone else (reward, value)

    reward, value = tell(world, x[row], told.arrays["actions"][steps], x[row + 1])
    return {"reward_r2": _r2(team, np.asarray(reward)), "value_r2": _r2(togo, np.asarray(value))}


def _r2(truth: np.ndarray, told: np.ndarray) -> float:
    return float(1 - ((truth - told) ** 2).mean() / max(truth.var(), 1e-12))


def _strange(world: World, told, level: float) -> float:
    """The conformal quantile, over held-out episodes, of how far apart the ensemble was at worst."""
    steps = told.kept[:STEPS]
    _, spread = _rolled(world, told, steps, 1)
    worst = np.asarray(spread)[:, 0].max(-1)
    episode = told.store.episode_of_step[steps]
    most = np.array([worst[episode == e].max() for e in np.unique(episode)])
    return conformal(most, level)


def conformal(values: np.ndarray, level: float) -> float:
    """The value that a new one stays below with that probability, whatever their distribution: the ⌈(n+1) level⌉-th
    smallest of n, the largest where there are too few."""
    n = len(values)
    return float(np.sort(values)[min(math.ceil((n + 1) * level), n) - 1])


def _barrier(
    world: World, told, rng, missed: float, least: float, unit: float | None = None
) -> tuple[dict[str, Any], float]:
    """(facts, margin): calibrated, at `least` so much, unless it is known."""
    barrier, x, row = world.barrier, told.arrays["features"], np.asarray(told.arrays["row"])
    unsafe = told.label if told.label.ndim == 1 else told.label.any(1)
    bad, fine = (told.kept[unsafe[told.kept] == v] for v in (True, False))
    if not len(bad) or not len(fine):
        said = "unsafe" if not len(bad) else "safe"
        return {"warning": f"no held-out step is {said}, so nothing is known of how well danger is told"}, 5.0
    steps = rng.choice(told.kept, min(STEPS, len(told.kept)), replace=False)
    steps = np.unique(np.concatenate([steps, rng.choice(bad, min(WINDOWS, len(bad)), replace=False)]))

    @jax.jit
    def score(barrier, before, after):
        return lowest(barrier.of_steps(before, after))

    @jax.jit
    def ahead(barrier, after):
        return lowest(barrier.ahead(after))

    parts = [steps[i : i + 20_000] for i in range(0, len(steps), 20_000)]
    h = np.concatenate([np.asarray(score(barrier, x[row[p]], x[row[p] + 1])) for p in parts])
    v = np.concatenate([np.asarray(ahead(barrier, x[row[p] + 1])) for p in parts])
    truth = unsafe[steps]
    share = unsafe[told.kept].mean()
    line = np.quantile(h[~truth], FALSE_ALARMS)
    # The margin: foreseen scores, from up to three steps before, of steps that entered danger. Those that were in it
    # already say little of where it begins: where a log is nearly all unsafe, most of them lie far beyond.
    first = np.asarray(told.arrays["first_row"])
    entered = bad[(row[bad] > first[bad]) & ~unsafe[np.maximum(bad - 1, 0)]]
    entered = entered if len(entered) >= ENTRIES else bad
    seen, ends = [], rng.choice(entered, min(WINDOWS, len(entered)), replace=False)
    for back in range(JUDGED):
        start = ends - back
        start = start[(start >= 0) & (row[ends] - back >= first[ends])]
        if len(start):
            rows, _ = _rolled(world, told, start, back + 1)
            before = x[row[start]] if back == 0 else rows[:, -2]
            seen.append(np.asarray(score(barrier, before, rows[:, -1])))
    foreseen = np.concatenate(seen)
    missed = max(missed, OUTLIERS / len(foreseen))
    unit = unit or max(least, conformal(foreseen, 1 - missed))
    table = [_of_margin(m, h, truth, foreseen, share) for m in sorted({0.0, 1.0, 2.0, 4.0, 8.0, round(unit, 2)})]
    facts = {
        "unsafe_share": float(share),
        "auroc": _auroc(h, truth),
        "recall": float((h[truth] < line).mean()),
        "false_alarms": FALSE_ALARMS,
        "false_safe": float((h[truth] >= 0).mean()),
        "false_unsafe": float((h[~truth] < 0).mean()),
        "foreseen_false_safe": float((foreseen >= 0).mean()),
        "margin": float(unit),
        "missed": missed,
        "calibration": table,
        "ahead_kept": float((v[~truth] >= unit).mean()),
        "avoidable": _avoidable(world, told, ends[:ENTERED]),
    }
    return facts, unit


def _avoidable(world: World, told, entered: np.ndarray) -> dict[str, Any]:
    """How many of the steps that entered danger other actions could have avoided from so many steps before, and any
    danger within the longest such time, as this World foresees it; `rows` is how far ahead a guard has to look to avoid
    nearly all that can be."""
    row, first, last = (np.asarray(told.arrays[k]) for k in ("row", "first_row", "last_row"))

    @jax.jit
    def avoided(world: World, x: Array, actions: Array) -> Array:
        def worst(actions: Array) -> Array:
            def step(before: Array, action: Array):
                after, _ = world.dynamics.step(before, action)
                h = lowest(world.barrier.of_steps(before, after))
                return after, h

            return jax.lax.scan(step, x, actions)[1].min(0)

        def correct(_, carry):
            actions, best = carry
            h, back = jax.vjp(worst, actions)
            slope = back(jnp.where(h < AIM, 1.0, 0.0))[0]
            size = jnp.maximum((slope**2).sum((0, 2, 3)), 1e-6)
            moved = actions - (jnp.minimum(h - AIM, 0.0) / size)[:, None, None] * slope
            return jnp.clip(moved, -1.0, 1.0), jnp.maximum(best, h)

        actions, best = jax.lax.fori_loop(0, ROUNDS, correct, (actions, jnp.full(len(x), -jnp.inf)))
        return jnp.maximum(best, worst(actions)) >= 0

    asked = {k: entered[row[entered] - (k - 1) >= first[entered]] for k in BEFORE}
    asked = {k: ends for k, ends in asked.items() if len(ends)}
    start = np.concatenate([ends - (k - 1) for k, ends in asked.items()])
    left = np.minimum(np.arange(max(BEFORE))[:, None], (last - row - 1)[start][None])
    found = np.asarray(avoided(world, told.arrays["features"][row[start]], told.arrays["actions"][start + left]))
    parts = np.split(found, np.cumsum([len(ends) for ends in asked.values()])[:-1])
    shares = {k: float(part.mean()) for k, part in zip(asked, parts)}
    reached = [k for k, share in shares.items() if share >= AVOIDED * max(shares.values())]
    return {"before": list(shares), "avoided": list(shares.values()), "rows": reached[0]}


def _of_margin(margin: float, h, truth, foreseen, share: float) -> dict[str, float]:
    """Of held-out steps with that margin: how many of 1000 are unsafe, weighed by how frequent the classes are."""
    passed, missed = float((h[~truth] >= margin).mean()), float((h[truth] >= margin).mean())
    both = share * missed + (1 - share) * passed
    return {
        "margin": float(margin),
        "unsafe_in_1000": float(1000 * share * missed / both) if both else 0.0,
        "unsafe_foreseen_above": float((foreseen >= margin).mean()),
        "safe_kept": passed,
    }


def _auroc(h: np.ndarray, unsafe: np.ndarray) -> float:
    order = np.argsort(np.argsort(h, kind="stable"), kind="stable") + 1.0
    n, m = int((~unsafe).sum()), int(unsafe.sum())
    return float((order[~unsafe].sum() - n * (n + 1) / 2) / (n * m))
