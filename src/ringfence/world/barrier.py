"""The barrier: danger learned from labels alone, one signed score h_i(s̃_i) per agent, h ≥ 0 is safe.

    ℓ   what is dangerous now, of a step: fitted to the end, classes balanced, by held-out episodes
    V   what will be dangerous whatever one does: V = max over what the logs do of min(ℓ, V(s')), so that {V ≥ 0} is
        where logged behaviour can stay safe; h = V meets the paper's (3), sup_a h(f(s, a)) ≥ (1 − α) h(s)

A team's label is explained by its *worst* agent, min_i ℓ_i, so the data itself finds out who was in danger; and an
agent's score by its worst neighbour, ℓ_i = min(g_0(own), min_j g(own, other j)), one g for all pairs, wherever names
tell which entries belong to whom. Without that, what is learned of few unsafe steps does not carry over to new ones.
Agents that share a body share its danger: they are all to blame, and each looks at all it sees.

Scores are log-odds of "safe" with both classes equally frequent: 0 is where either is as likely.

Sources: gradient penalty, LatentCBF (L4DC 2026), `_margin_gp_step`; in-sample backup with an upper expectile, FISOR
(Zheng et al. 2024) and V-OCBF (2025).
"""

from __future__ import annotations

import re
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from ringfence.nets.mlp import MLP
from ringfence.nets.optim import regress
from ringfence.problem.constraints import least, lowest
from ringfence.problem.features import FeatureMap
from ringfence.types import Array, Key

Loss = Literal["cross-entropy", "hinges", "gradient-penalty"]
DANGEROUS = ("other", "obstacle", "wall")  # kinds of things that names may tell of, each with a pair network of its own
FARTHEST = 15.0  # scores end softly there: log-odds that no data can tell apart
UNSURE = 5.0  # score that g_0 begins with, so that pairs explain danger first


class Shape(eqx.Module):
    """Which entries are read together."""

    own: tuple[int, ...] = eqx.field(static=True)  # by g_0
    pairs: tuple[tuple[str, tuple[tuple[int, ...], ...]], ...] = eqx.field(static=True)  # kind -> entries of each pair
    # kind -> which of a pair's entries are the offset (dx, ...) and the relative velocity (dvx, ...)
    offsets: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = eqx.field(static=True)
    both_ends: bool = eqx.field(static=True)  # read the change of the step, too
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

    def of_steps(self, before: Array, after: Array) -> Array:
        """ℓ (..., N) of steps from features (..., N, D) to others."""
        return soft(_score(self.label, self.shape, self._seen(before, after), after.shape[:-1]))

    def ahead(self, x: Array) -> Array:
        """V (..., N) of states (..., N, D)."""
        return soft(_score(self.future, _still(self.shape), (x - self.mean) / self.scale, x.shape[:-1]))

    def apart(self, before: Array, after: Array) -> Array:
        """ℓ (..., N, 1) in units of the margin, with an axis of constraints."""
        return (self.of_steps(before, after) / self.unit)[..., None]

    def ahead_apart(self, x: Array) -> Array:
        """V (..., N, 1) likewise."""
        return (self.ahead(x) / self.unit)[..., None]

    def _seen(self, before: Array, after: Array) -> Array:
        x = (after - self.mean) / self.scale
        if not self.shape.both_ends:
            return x
        return jnp.concatenate([x, (after - before - self.step_mean) / self.step_scale], -1)


class Worst(eqx.Module):
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

    def apart(self, before: Array, after: Array) -> Array:
        """ℓ (..., N, C) of each constraint."""
        return jnp.concatenate([b.apart(before, after) for b in self.each], -1)

    def ahead_apart(self, x: Array) -> Array:
        """V (..., N, C) of each constraint."""
        return jnp.concatenate([b.ahead_apart(x) for b in self.each], -1)


def soft(score: Array) -> Array:
    """Scores bounded smoothly by ±FARTHEST, with slope 1 around 0: what is climbed never goes flat where it matters."""
    return FARTHEST * jnp.tanh(score / FARTHEST)


def shape_of(map: FeatureMap, both_ends: bool | None = None, distances: bool = True) -> Shape:
    """The shape that a view's names tell; without `distances` pairs do not read how far apart they are. A body's danger
    is of a step (a mean speed), so both its ends are read; of agents in a plane it is of the state that a step leads
    to, unless told otherwise."""
    names, n = map.names, map.plus.shape[0]
    found: dict[str, dict[int, dict[str, int]]] = {}
    for d, name in enumerate(names):
        match = re.fullmatch(r"([a-z]+)(\d+)\.(\w+)", name)
        if match and match[1] in DANGEROUS and not map.joint:
            found.setdefault(match[1], {}).setdefault(int(match[2]), {})[match[3]] = d
    found = {k: who for k, who in found.items() if len({tuple(sorted(e)) for e in who.values()}) == 1}
    if map.joint or not found:
        ends = map.body if both_ends is None else both_ends
        shared = 1 if map.joint else n
        return Shape(tuple(range(len(names))), (), (), ends, shared, map.joint, "all" if map.body else "worst")
    inside = {d for who in found.values() for entries in who.values() for d in entries.values()}
    # A pair is the same wherever it is: own entries but the place.
    moving = tuple(d for d, x in enumerate(names) if x.startswith("own.") and x.split(".")[1] not in ("x", "y", "z"))
    pairs = tuple(
        (kind, tuple(moving + tuple(entries[f] for f in sorted(entries)) for _, entries in sorted(who.items())))
        for kind, who in found.items()
    )
    offsets = []
    for kind, entries in pairs:
        fields = [names[d].split(".")[1] for d in entries[0]]
        is_of = [kind == re.sub(r"\d+\..*", "", names[d]) for d in entries[0]]
        place, speed = (
            tuple(k for k, f in enumerate(fields) if is_of[k] and re.fullmatch(word, f))
            for word in ("d[xyz]", "dv[xyz]")
        )
        offsets.append((place, speed if len(speed) == len(place) else ()) if distances else ((), ()))
    own = tuple(d for d in range(len(names)) if d not in inside)
    return Shape(own, pairs, tuple(offsets), bool(both_ends), 1, False, "worst")


def networks(key: Key, shape: Shape, width: int) -> dict[str, MLP]:
    """g_0 and one g for each kind of pair, 3 hidden layers each."""
    twice = 2 if shape.both_ends else 1
    keys = jax.random.split(key, 1 + len(shape.pairs))
    made = {}
    if shape.own:
        made["own"] = MLP(keys[0], (twice * len(shape.own), width, width, width, 1), groups=shape.groups)
        if shape.pairs:
            made["own"] = eqx.tree_at(lambda m: m.biases[-1], made["own"], made["own"].biases[-1] + UNSURE)
    for k, (kind, entries), (place, speed) in zip(keys[1:], shape.pairs, shape.offsets):
        made[kind] = MLP(k, (twice * len(entries[0]) + bool(place) + bool(speed), width, width, width, 1))
    return made


def isotropic(shape: Shape, mean: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Statistics (D,) under which offsets keep their directions: one scale for all axes and all of a kind, around 0."""
    mean, scale = mean.copy(), scale.copy()
    for (_, entries), which in zip(shape.pairs, shape.offsets):
        for some in which:
            d = np.array([pair[k] for pair in entries for k in some], int)
            if len(d):
                scale[d] = np.sqrt((scale[d] ** 2 + mean[d] ** 2).mean())
                mean[d] = 0.0
    return mean, scale


def _still(shape: Shape) -> Shape:
    return Shape(shape.own, shape.pairs, shape.offsets, False, shape.groups, shape.joint, shape.blame)


def _score(nets: dict[str, MLP], shape: Shape, z: Array, agents: tuple[int, ...]) -> Array:
    """Scores (..., N) of standardised entries (..., N, D or 2D); `agents` is that shape."""
    half = z.shape[-1] // (2 if shape.both_ends else 1)

    def read(entries: np.ndarray) -> Array:
        index = np.concatenate([entries, entries + half], -1) if shape.both_ends else entries
        return z[..., index]

    parts = []
    if shape.joint:
        z = z[..., :1, :]
    if "own" in nets:
        parts.append(jnp.broadcast_to(nets["own"](read(np.array(shape.own)))[..., 0], agents))
    for (kind, entries), (place, speed) in zip(shape.pairs, shape.offsets):
        pair = read(np.array(entries))  # (..., N, J, F)
        if place:  # how far, and how fast nearer: what does not change when everything turns
            offset = pair[..., np.array(place)]
            far = jnp.sqrt((offset**2).sum(-1, keepdims=True) + 1e-9)
            more = [far] + ([(offset * pair[..., np.array(speed)]).sum(-1, keepdims=True) / far] if speed else [])
            pair = jnp.concatenate([pair, *more], -1)
        each = nets[kind](pair.reshape(*z.shape[:-2], -1, pair.shape[-1]))[..., 0]
        each = each.reshape(*z.shape[:-1], len(entries))
        parts += [each[..., j] for j in range(len(entries))]
    return least(parts)


# --- fitting ---


def fit_label(
    barrier: Barrier,
    data: tuple[Array, Array, Array, Array],
    unsafe: np.ndarray,
    safe: np.ndarray,
    key: Key,
    *,
    loss: Loss,
    penalty: float = 1.0,
    share: float = 0.5,
    updates: int,
    width: int,
    batch: int = 512,
    quiet: bool = True,
) -> Barrier:
    """ℓ fitted to the end. data: features (M, N, D), foreseen (T, N, D), row (T,), label (T,) or (T, N) bool of steps;
    `unsafe` and `safe` index the steps to learn from. A quarter of every batch is unsafe.

    A `share` of the steps is read as it was *foreseen* to end: that is what a barrier is asked about. Learned from what
    came to be alone, it may take the rebound after a contact for the contact, which nobody foresees.

    Hinges are the paper's with a margin of 1; `gradient-penalty` adds `penalty` · E(‖∇ℓ(ŝ)‖ − 1)² between the classes.
    """
    kn, kf = jax.random.split(key)
    shape, some = barrier.shape, batch // 4
    bad, fine = jnp.asarray(unsafe), jnp.asarray(safe)

    def objective(net: dict[str, MLP], data, pick: Array) -> Array:
        x, foreseen, row, label, bad, fine = data
        step = jnp.concatenate([bad[pick[:some] % len(unsafe)], fine[pick[some:] % len(safe)]])
        before, came, told = x[row[step]], x[row[step] + 1], label[step]
        read = (jnp.floor(jnp.arange(1, batch + 1) * share) > jnp.floor(jnp.arange(batch) * share))[:, None, None]
        after = jnp.where(read, foreseen[step], came)
        z = barrier._seen(before, after)
        h = _score(net, shape, z, after.shape[:-1])
        if told.ndim == 1 and shape.blame == "worst":
            h = lowest(h)
        elif told.ndim == 1:
            told = jnp.broadcast_to(told[:, None], h.shape)
        if loss == "cross-entropy":
            return optax.sigmoid_binary_cross_entropy(-h, told.astype(jnp.float32)).mean()
        total = jnp.where(told, jax.nn.relu(1.0 + h), jax.nn.relu(1.0 - h)).mean()
        if loss == "gradient-penalty":
            part = jnp.linspace(0.0, 1.0, some)[:, None, None]
            between = part * z[:some] + (1 - part) * z[some : 2 * some]
            slope = jax.grad(lambda z: _score(net, shape, z, after[:some].shape[:-1]).sum())(between)
            total = total + penalty * ((jnp.sqrt((slope**2).sum(-1) + 1e-9) - 1.0) ** 2).mean()
        return total

    net = networks(kn, shape, width)
    words = "" if quiet else "barrier, what is dangerous now"
    rows = 2**31 - 1
    found = regress(objective, net, (*data, bad, fine), rows, kf, updates, batch, 2e-3, words, decay=1e-4)
    return eqx.tree_at(lambda b: b.label, barrier, found)


def fit_future(
    barrier: Barrier,
    arrays: dict[str, Array],
    picked: np.ndarray,
    close: np.ndarray,
    key: Key,
    *,
    discount: float,
    expectile: float,
    updates: int,
    batch: int = 512,
    rate: float = 0.02,
    quiet: bool = True,
) -> Barrier:
    """V by in-sample backups y = (1 − γ) ℓ + γ min(ℓ, V̄(s')), y = ℓ where the task ended, with an upper expectile over
    what the logs did, V̄ a slow copy. It begins as ℓ, which it never exceeds, where that reads states alone. A quarter
    of every batch is of the steps `close` to danger; the rest is of all that are `picked`.
    """
    kn, kf = jax.random.split(key)
    shape, some = _still(barrier.shape), batch // 4 if len(close) else 0
    width = next(iter(barrier.label.values())).weights[0].shape[-1]
    net = networks(kn, shape, width) if barrier.shape.both_ends else barrier.label
    near, all_of = (jnp.asarray(x if len(x) else picked) for x in (close, picked))

    def objective(pair, data, pick: Array) -> Array:
        net, slow = pair
        x, row, ended, near, all_of = data
        step = jnp.concatenate([near[pick[:some] % len(near)], all_of[pick[some:] % len(all_of)]])
        before, after = x[row[step]], x[row[step] + 1]
        now = barrier.of_steps(before, after)
        ahead = soft(_score(slow, shape, (after - barrier.mean) / barrier.scale, after.shape[:-1]))
        ahead = jnp.where(ended[step][:, None], now, ahead)
        goal = jax.lax.stop_gradient((1 - discount) * now + discount * jnp.minimum(now, ahead))
        value = soft(_score(net, shape, (before - barrier.mean) / barrier.scale, before.shape[:-1]))
        error = goal - value
        return (jnp.where(error > 0, expectile, 1 - expectile) * error**2).mean()

    def follow(pair):
        net, slow = pair
        return net, jax.tree.map(lambda s, n: s + rate * (n - s), slow, net)

    data = arrays["features"], arrays["row"], arrays["terminated"], near, all_of
    words = "" if quiet else "barrier, what will be dangerous"
    pair = net, jax.tree.map(jnp.copy, net)
    found = regress(objective, pair, data, 2**31 - 1, kf, updates, batch, 1e-3, words, after=follow)
    return eqx.tree_at(lambda b: b.future, barrier, found[0])


def blank_barrier(map: FeatureMap, width: int, both_ends: bool | None = None, distances: bool = True) -> Barrier:
    """A barrier of the right shapes that says nothing."""
    shape, one = shape_of(map, both_ends, distances), jnp.ones(len(map.names))
    nets = networks(jax.random.key(0), shape, width), networks(jax.random.key(0), _still(shape), width)
    return Barrier(*nets, one, one, one, one, jnp.ones(()), shape)
