"""The barrier: danger learned from labels alone, one signed score h_i(s̃_i) per agent, h ≥ 0 is safe.

    ℓ   what is dangerous now, of a step: fitted to labels, classes balanced
    V   what will be dangerous whatever one does: V = max over what the logs do of min(ℓ, V(s')), so that {V ≥ 0} is
        where logged behaviour can stay safe; h = V meets the paper's (3), sup_a h(f(s, a)) ≥ (1 − α) h(s)

A team's label is explained by its *worst* agent, min_i ℓ_i, so the data itself finds out who was in danger. An agent's
score is explained by its worst neighbour, ℓ_i = min(g_0(own), min_j g(own, other j)), one g for all pairs, wherever
names say which entries belong to whom. Without that, what few unsafe steps teach does not carry over to new ones.
Agents that share a body share its danger: all of them answer for it, and each reads all it sees.

Scores are log-odds of "safe" with both classes equally frequent: 0 is where either is as likely.

Sources: gradient penalty, LatentCBF (L4DC 2026), `_margin_gp_step`; in-sample backup with an upper expectile, FISOR
(Zheng et al. 2024) and V-OCBF (2025).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from ringfence.nets.layers import MLP
from ringfence.nets.optim import follow, regress
from ringfence.problem.constraints import lowest
from ringfence.problem.entries import Entries
from ringfence.problem.features import FeatureMap
from ringfence.types import Array, Key
from ringfence.utils.precision import on_device
from ringfence.world.cause_nets import Labelled, Score, blank, scores, worst
from ringfence.world.causes import Found
from ringfence.world.settings import Settings

Widening = tuple[float, ...]  # by row ahead, in margins
DANGEROUS = ("other", "obstacle", "wall")  # kinds of things that names may tell of, each with a pair network of its own
FARTHEST = 15.0  # scores end softly there: log-odds that no data can tell apart
BATCH = 128  # steps
RATE = 0.02  # at which the slow copy of V follows
UNSURE = 5.0  # score that g_0 begins with, so that pairs explain danger first


class Shape(eqx.Module):
    """Which entries are read together."""

    own: tuple[int, ...] = eqx.field(static=True)  # by g_0
    pairs: tuple[tuple[str, tuple[tuple[int, ...], ...]], ...] = eqx.field(static=True)  # kind -> entries of each pair
    # kind -> which of a pair's entries are the offset (dx, ...) and the relative velocity (dvx, ...)
    offsets: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = eqx.field(static=True)
    use_transition: bool = eqx.field(static=True)  # read the change of the step, too
    groups: int = eqx.field(static=True)  # 1: agents share weights
    joint: bool = eqx.field(static=True)  # a body: one look, everybody's score
    blame: Literal["worst", "all"] = eqx.field(static=True)  # who explains a team's label


class Barrier(eqx.Module):
    """ℓ and V of a team; every array in `mean` ... is (D,)."""

    label: dict[str, MLP]  # "own" and the kinds of pairs
    future: dict[str, MLP]
    mean: Array
    scale: Array
    step_mean: Array
    step_scale: Array
    unit: Array  # () the margin that calibration asks for
    shape: Shape
    causes: tuple[Score, ...] = ()  # ℓ by causes, where they were found; `label` is empty then

    @property
    def each(self) -> tuple[Barrier, ...]:
        """Itself, as of the one constraint."""
        return (self,)

    def of_steps(self, before: Array, after: Array) -> Array:
        """ℓ (..., N) of steps from features (..., N, D) to others."""
        if self.causes:
            return soft(worst(self.causes, after))
        return soft(_score(self.label, self.shape, self.standardised(before, after), after.shape[:-1]))

    def ahead(self, x: Array) -> Array:
        """V (..., N) of states (..., N, D)."""
        value = soft(_score(self.future, _still(self.shape), (x - self.mean) / self.scale, x.shape[:-1]))
        return jnp.minimum(value, soft(worst(self.causes, x))) if self.causes else value

    def parts(self, rows: Array, widening: Sequence[Widening] = ()) -> Array:
        """(..., K, N, M) the scores that ℓ is the least of along predicted rows (..., K+1, N, D), as `along` has them;
        `part_names` says of what."""
        after = rows[..., 1:, :, :]
        asked = [_by_row(one, after.shape[-3])[:, None, None] for one in widening]  # each (K, 1, 1)
        if not self.causes:
            z = self.standardised(rows[..., :-1, :, :], after)
            each = soft(_scores(self.label, self.shape, z, after.shape[:-1])) / self.unit
            return each - asked[0] if asked else each
        each = [scores(net, after) for net in self.causes]
        if not asked:
            return soft(jnp.concatenate(each, -1)) / self.unit
        each = [one - self.unit * more for one, more in zip(each, asked)]
        return _sloped(jnp.concatenate(each, -1)) / self.unit

    @property
    def part_names(self) -> tuple[tuple[str, str], ...]:
        """(what is dangerous, of which thing) of each of `parts`; "" where it is about the agent itself."""
        found: list[tuple[str, str]] = []
        for net in self.causes:
            cause = net.cause
            several = cause.things > 1
            found += [(cause.name, f"{cause.kind}{j}" if several else "") for j in range(cause.things)]
        if self.causes:
            return tuple(found)
        if "own" in self.label:
            found.append(("own entries", ""))
        for kind, entries in self.shape.pairs:
            found += [(f"entries of {kind}", f"{kind}{j}") for j in range(len(entries))]
        return tuple(found)

    def apart(self, before: Array, after: Array) -> Array:
        """ℓ (..., N, 1) in units of the margin, with an axis of constraints."""
        return (self.of_steps(before, after) / self.unit)[..., None]

    def along(self, rows: Array, widening: Sequence[Widening] = ()) -> Array:
        """ℓ (..., K, N, 1) of predicted rows (..., K+1, N, D), the present first, less what rows ahead ask for beyond
        the margin: by cause, or once."""
        after = rows[..., 1:, :, :]
        if not widening:
            return self.apart(rows[..., :-1, :, :], after)
        asked = [_by_row(one, after.shape[-3])[:, None] for one in widening]  # each (K, 1)
        if not self.causes:
            return self.apart(rows[..., :-1, :, :], after) - asked[0][..., None]
        each = [worst([net], after) - self.unit * more for net, more in zip(self.causes, asked)]
        return (_sloped(lowest(jnp.stack(each, -1))) / self.unit)[..., None]

    def ahead_apart(self, x: Array) -> Array:
        """V (..., N, 1) likewise."""
        return (self.ahead(x) / self.unit)[..., None]

    def standardised(self, before: Array, after: Array) -> Array:
        """What ℓ reads of steps: where they lead, and how they move where both ends are read."""
        x = (after - self.mean) / self.scale
        if not self.shape.use_transition:
            return x
        return jnp.concatenate([x, (after - before - self.step_mean) / self.step_scale], -1)


class MinBarrier(eqx.Module):
    """Barriers of several constraints, read as one, in units of their margins: the worst counts."""

    each: tuple[Barrier, ...]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def unit(self) -> float:
        return 1.0

    @property
    def shape(self) -> Shape:
        return self.each[0].shape

    def of_steps(self, before: Array, after: Array) -> Array:
        return lowest(self.apart(before, after))

    def ahead(self, x: Array) -> Array:
        return lowest(self.ahead_apart(x))

    def parts(self, rows: Array, widening: Sequence[Sequence[Widening]]) -> Array:
        """(..., K, N, M) of all constraints' barriers, each with its own widening."""
        return jnp.concatenate([b.parts(rows, w) for b, w in zip(self.each, widening)], -1)

    @property
    def part_names(self) -> tuple[tuple[str, str], ...]:
        """The same as a barrier's, each with the constraint's name in the logs."""
        named = zip(self.names, self.each)
        return tuple((f"{name}: {what}", thing) for name, b in named for what, thing in b.part_names)

    def apart(self, before: Array, after: Array) -> Array:
        """ℓ (..., N, C) of each constraint."""
        return jnp.concatenate([b.apart(before, after) for b in self.each], -1)

    def along(self, rows: Array, widening: Sequence[Sequence[Widening]]) -> Array:
        """ℓ (..., K, N, C) of predicted rows by each constraint, with its own widening."""
        return jnp.concatenate([b.along(rows, w) for b, w in zip(self.each, widening)], -1)

    def ahead_apart(self, x: Array) -> Array:
        """V (..., N, C) of each constraint."""
        return jnp.concatenate([b.ahead_apart(x) for b in self.each], -1)


def _by_row(widening: Widening, rows: int) -> np.ndarray:
    """(K,) of so many rows; the last number goes on."""
    return np.array(widening, np.float32)[np.minimum(np.arange(rows), len(widening) - 1)]


def soft(score: Array) -> Array:
    """Scores bounded smoothly by ±FARTHEST, with slope 1 around 0: what is climbed never goes flat where it matters."""
    return FARTHEST * jnp.tanh(score / FARTHEST)


def _sloped(score: Array) -> Array:
    """The same, but of what is dangerous: rows far ahead may lie deep in danger, and a search has to find out of it."""
    deep = -FARTHEST * jnp.log1p(jnp.maximum(-score, 0.0) / FARTHEST)
    return jnp.where(score < 0, deep, soft(score))


# --- what is read ---


def shape_of(map: FeatureMap, use_transition: bool | None = None, distances: bool = True) -> Shape:
    """The shape that a view's names tell; without `distances` pairs do not read how far apart they are. A body's danger
    is of a step (a mean speed), so both its ends are read; of agents in a plane it is of the state that a step leads
    to, by default."""
    names = map.names
    things = {} if map.joint else _things(names)
    if not things:
        return Shape(
            own=tuple(range(len(names))),
            pairs=(),
            offsets=(),
            use_transition=map.shared_body if use_transition is None else use_transition,
            groups=1 if map.joint else map.plus.shape[0],
            joint=map.joint,
            blame="all" if map.shared_body else "worst",
        )
    # A pair is the same wherever it is: own entries but the place.
    known = Entries.of(names)
    moving = tuple(e.source for e in known.each if (e.whose, e.order) == ("own", None) and e.role != "place")
    pairs = tuple((kind, tuple(moving + entries for entries in each)) for kind, each in things.items())
    inside = {d for each in things.values() for entries in each for d in entries}
    return Shape(
        own=tuple(d for d in range(len(names)) if d not in inside),
        pairs=pairs,
        offsets=tuple(_offsets(names, kind, each[0]) if distances else ((), ()) for kind, each in pairs),
        use_transition=bool(use_transition),
        groups=1,
        joint=False,
        blame="worst",
    )


def _things(names: tuple[str, ...]) -> dict[str, list[tuple[int, ...]]]:
    """Entries of each other, obstacle or wall, by kind, in the order of their fields' names; of kinds whose things all
    have the same fields."""
    kinds: dict[str, list[tuple[int, ...]]] = {}
    for kind, things in Entries.of(names).numbered.items():
        if kind in DANGEROUS and len({tuple(sorted(fields)) for fields in things}) == 1:
            kinds[kind] = [tuple(fields[f] for f in sorted(fields)) for fields in things]
    return kinds


def _offsets(names: tuple[str, ...], kind: str, pair: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Which of a pair's entries are the offset (dx, ...) and the relative velocity (dvx, ...)."""

    roles = {e.source: e.role for e in Entries.of(names).each if e.whose == kind}
    place, speed = (tuple(k for k, d in enumerate(pair) if roles.get(d) == role) for role in ("offset", "drift"))
    return place, speed if len(speed) == len(place) else ()


def networks(key: Key, shape: Shape, width: int) -> dict[str, MLP]:
    """g_0 and one g for each kind of pair, 3 hidden layers each."""
    twice = 2 if shape.use_transition else 1
    keys = jax.random.split(key, 1 + len(shape.pairs))
    made = {}
    if shape.own:
        own = MLP(keys[0], (twice * len(shape.own), width, width, width, 1), groups=shape.groups)
        if shape.pairs:
            own = eqx.tree_at(lambda m: m.biases[-1], own, own.biases[-1] + UNSURE)
        made["own"] = own
    for pair_key, (kind, entries), (place, speed) in zip(keys[1:], shape.pairs, shape.offsets):
        inputs = twice * len(entries[0]) + bool(place) + bool(speed)
        made[kind] = MLP(pair_key, (inputs, width, width, width, 1))
    return made


def isotropic(shape: Shape, mean: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Statistics (D,) under which offsets keep their directions: one scale for all axes and all of a kind, around 0."""
    mean = mean.copy()
    scale = scale.copy()
    for (_, entries), fields in zip(shape.pairs, shape.offsets):
        for some in fields:
            d = np.array([pair[k] for pair in entries for k in some], int)
            if len(d):
                scale[d] = np.sqrt((scale[d] ** 2 + mean[d] ** 2).mean())
                mean[d] = 0.0
    return mean, scale


def _still(shape: Shape) -> Shape:
    """The same of states instead of steps."""
    return replace(shape, use_transition=False)


def _score(nets: dict[str, MLP], shape: Shape, z: Array, agents: tuple[int, ...]) -> Array:
    """Scores (..., N) of standardised entries (..., N, D or 2D); `agents` is that shape."""
    return lowest(_scores(nets, shape, z, agents))


def _scores(nets: dict[str, MLP], shape: Shape, z: Array, agents: tuple[int, ...]) -> Array:
    """(..., N, J) what `_score` is the least of: own entries, and each thing."""
    half = z.shape[-1] // (2 if shape.use_transition else 1)
    if shape.joint:
        z = z[..., :1, :]

    def read(entries: np.ndarray) -> Array:
        index = np.concatenate([entries, entries + half], -1) if shape.use_transition else entries
        return z[..., index]

    parts = []
    if "own" in nets:
        parts.append(jnp.broadcast_to(nets["own"](read(np.array(shape.own))), (*agents, 1)))
    for (kind, entries), (place, speed) in zip(shape.pairs, shape.offsets):
        pair = _with_distance(read(np.array(entries)), place, speed)
        each = nets[kind](pair.reshape(*z.shape[:-2], -1, pair.shape[-1]))[..., 0]
        each = each.reshape(*z.shape[:-1], len(entries))
        parts.append(each)
    return jnp.concatenate(parts, -1)


def _with_distance(pair: Array, place: tuple[int, ...], speed: tuple[int, ...]) -> Array:
    """Pairs (..., N, J, F) with how far apart they are and how fast they part, where entries tell: what does not change
    when everything turns."""
    if not place:
        return pair
    offset = pair[..., np.array(place)]
    distance = jnp.sqrt((offset**2).sum(-1, keepdims=True) + 1e-9)
    if not speed:
        return jnp.concatenate([pair, distance], -1)
    parting = (offset * pair[..., np.array(speed)]).sum(-1, keepdims=True) / distance
    return jnp.concatenate([pair, distance, parting], -1)


# --- fitting ---


def fit_label(
    barrier: Barrier, data: Labelled, unsafe: np.ndarray, safe: np.ndarray, key: Key, settings: Settings
) -> Barrier:
    """ℓ fitted to labels; `unsafe` and `safe` index the steps to learn from. A quarter of every batch is unsafe.

    A `predicted_share` of the steps ends where it was *predicted* to end: that is what a barrier is asked about.
    Learned from what came to be alone, it may take the rebound after a contact for the contact, which none predicts.

    Hinges are the paper's with a margin of 1; `gradient-penalty` adds `penalty` · E(‖∇ℓ(ŝ)‖ − 1)² between the classes.
    """
    key_nets, key_fit = jax.random.split(key)
    shape = barrier.shape
    loss, share = settings.loss, settings.predicted_share
    few = BATCH // 4

    def objective(net: dict[str, MLP], data: tuple[Array, ...], pick: Array) -> Array:
        x, predicted, row, label, bad, fine = data
        step = jnp.concatenate([bad[pick[:few] % len(unsafe)], fine[pick[few:] % len(safe)]])
        before = x[row[step]]
        as_predicted = jnp.floor(jnp.arange(1, BATCH + 1) * share) > jnp.floor(jnp.arange(BATCH) * share)
        after = jnp.where(as_predicted[:, None, None], predicted[step], x[row[step] + 1])
        z = barrier.standardised(before, after)
        h = _score(net, shape, z, after.shape[:-1])
        truth = label[step]
        if truth.ndim == 1 and shape.blame == "worst":
            h = lowest(h)
        elif truth.ndim == 1:
            truth = jnp.broadcast_to(truth[:, None], h.shape)
        if loss == "cross-entropy":
            return optax.sigmoid_binary_cross_entropy(-h, truth.astype(jnp.float32)).mean()
        total = jnp.where(truth, jax.nn.relu(1.0 + h), jax.nn.relu(1.0 - h)).mean()
        if loss == "gradient-penalty":
            total = total + settings.penalty * _steepness(net, shape, z, few, after[:few].shape[:-1])
        return total

    rows = 2**31 - 1
    net = networks(key_nets, shape, settings.barrier_width)
    words = "barrier, what is dangerous now"
    given = (*data, on_device(unsafe), on_device(safe))
    updates = settings.barrier_updates
    found = regress(objective, net, given, rows, key_fit, updates, BATCH, 2e-3, words, decay=1e-4)
    return eqx.tree_at(lambda b: b.label, barrier, found)


def _steepness(net: dict[str, MLP], shape: Shape, z: Array, few: int, agents: tuple[int, ...]) -> Array:
    """E(‖∇ℓ‖ − 1)² between the unsafe steps, the first `few` of a batch, and as many safe ones (LatentCBF)."""
    part = jnp.linspace(0.0, 1.0, few)[:, None, None]
    between = part * z[:few] + (1 - part) * z[few : 2 * few]
    slope = jax.grad(lambda z: _score(net, shape, z, agents).sum())(between)
    return ((jnp.sqrt((slope**2).sum(-1) + 1e-9) - 1.0) ** 2).mean()


def fit_future(
    barrier: Barrier, arrays: dict[str, Array], picked: np.ndarray, close: np.ndarray, key: Key, settings: Settings
) -> Barrier:
    """V by in-sample backups y = (1 − γ) ℓ + γ min(ℓ, V̄(s')), y = ℓ where the task ended, with an upper expectile over
    what the logs did, V̄ a slow copy. It begins as ℓ, which it never exceeds; from fresh weights where ℓ reads both ends
    of steps, or causes. A quarter of every batch is of the steps `close` to danger; the rest is of all that are
    `picked`.
    """
    key_nets, key_fit = jax.random.split(key)
    shape = _still(barrier.shape)
    discount, expectile = settings.future_discount, settings.expectile
    few = BATCH // 4 if len(close) else 0
    net = barrier.label
    if barrier.causes or barrier.shape.use_transition:
        width = next(iter(barrier.future.values())).weights[0].shape[-1]
        net = networks(key_nets, shape, width)

    def objective(pair: tuple[dict[str, MLP], dict[str, MLP]], data: tuple[Array, ...], pick: Array) -> Array:
        net, slow = pair
        x, row, ended, near, all_of = data
        step = jnp.concatenate([near[pick[:few] % len(near)], all_of[pick[few:] % len(all_of)]])
        before = x[row[step]]
        after = x[row[step] + 1]
        now = barrier.of_steps(before, after)
        ahead = soft(_score(slow, shape, (after - barrier.mean) / barrier.scale, after.shape[:-1]))
        ahead = jnp.where(ended[step][:, None], now, ahead)
        goal = jax.lax.stop_gradient((1 - discount) * now + discount * jnp.minimum(now, ahead))
        value = soft(_score(net, shape, (before - barrier.mean) / barrier.scale, before.shape[:-1]))
        error = goal - value
        return (jnp.where(error > 0, expectile, 1 - expectile) * error**2).mean()

    def following(pair: tuple[dict[str, MLP], dict[str, MLP]]) -> tuple[dict[str, MLP], dict[str, MLP]]:
        net, slow = pair
        return net, follow(slow, net, RATE)

    near = on_device(close if len(close) else picked)
    data = arrays["features"], arrays["row"], arrays["terminated"], near, on_device(picked)
    words = "barrier, what will be dangerous"
    pair = net, net
    updates = settings.future_updates
    found = regress(objective, pair, data, 2**31 - 1, key_fit, updates, BATCH, 1e-3, words, after=following)
    return eqx.tree_at(lambda b: b.future, barrier, found[0])


def blank_barrier(map: FeatureMap, settings: Settings, found: Found | None = None) -> Barrier:
    """A barrier of the right shapes that says nothing."""
    width = settings.barrier_width
    shape = shape_of(map, settings.use_transition, settings.distances)
    one = jnp.ones(len(map.names))
    key = jax.random.key(0)
    return Barrier(
        label={} if found and found.causes else networks(key, shape, width),
        future=networks(key, _still(shape), width),
        mean=one,
        scale=one,
        step_mean=one,
        step_scale=one,
        unit=jnp.ones(()),
        shape=shape,
        causes=blank(found, width) if found else (),
    )
