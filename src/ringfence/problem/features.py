"""s̃_i, the state of agent i that everything else works on, from the global state or the local observation.

Each entry is one number of the source, or the difference of two, and has a name; so a view is a table of indices,
exact, differentiable and linear in the number of entries. Three views exist, because the paper argues about them:

* `pruned` (default): the union of global state and own observation, without duplicates, seen from the agent;
* `centralized`: the global state, the same for every agent;
* `decentralized`: the agent's own observation alone.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError, unknown
from ringfence.problem import motion, on_map, partners
from ringfence.problem.entries import Entries, axes_of
from ringfence.problem.motion import Turn, late_share
from ringfence.problem.partners import Mirrored, order_in, others
from ringfence.types import Array, X

View = Literal["pruned", "centralized", "decentralized"]
Source = Literal["state", "observations"]
VIEWS = ("pruned", "centralized", "decentralized")
LESS = " less "  # between what an entry is made of, one taken from another
_TABLES = ("plus", "minus", "origin", "order")  # fields of a map that are arrays
STEPS = 4000  # or rows, that are looked at
ROWS = 10_000  # of a column that are looked at together
FIRST = 1000  # rows by which columns are told apart before all of them are compared


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """Entry d of agent i is source[plus[i, d]] − source[minus[i, d]] (minus = −1: nothing is taken away).

    A map is compared by content, so that what was compiled for it serves another one that is the same.
    """

    view: str
    names: tuple[str, ...]  # D
    source: Source
    plus: np.ndarray  # (N, D) int
    minus: np.ndarray  # (N, D) int
    own: tuple[int, ...] | None = None  # entries that only the agent itself can change; the rest follows from them
    reconcile: Callable[[Array], Array] | None = None  # (..., H, N, D): rows after the first follow from own entries
    follows: tuple[int, ...] = ()  # the entries that do, where names tell how
    order: np.ndarray | None = None  # (N, J) who the others are that entries number; None: the team in order
    origin: np.ndarray | None = None  # (N, D) where each entry stands in the global state, if it is one of it as it is
    shared_body: bool = False  # the agents are limbs of one body: its danger is everybody's
    joint: bool = False  # what comes next depends on everybody's action, which is known
    decentralized: bool = False  # what follows does so from the agent's own movement alone
    models_others: bool = False  # what comes next depends on what others see and do, which has to be guessed
    dt: float | None = None  # s, of a decentralized map: the step that velocities are predicted by
    late: float = 1.0  # of a decentralized map: the share of that step that is gone with the next velocity
    turns: tuple[Turn, ...] = ()  # entries that are angles, which begin again after a whole turn
    # What agents see of each other in lists that do not say of whom; what comes next depends on what these do.
    mirrored: tuple[Mirrored, ...] = ()
    # D weights of the standardised entries that the critic reads; None: all the same
    critic_weight: tuple[float, ...] | None = None

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and isinstance(other, FeatureMap) and other._content == self._content

    def __hash__(self) -> int:
        return hash(self._content)

    @functools.cached_property
    def _content(self) -> tuple[Hashable, ...]:
        tables = [(table.shape, table.tobytes()) for table in map(self.__getattribute__, _TABLES) if table is not None]
        rest = (getattr(self, f.name) for f in fields(self) if f.name not in _TABLES)
        return (*tables, *rest)

    @property
    def reads(self) -> tuple[Source, ...]:
        """What its entries are of, in the order in which they are counted."""
        return (self.source,)

    @property
    def reads_state(self) -> bool:
        return "state" in self.reads

    @property
    def width(self) -> int:
        """Entries that what it reads must have at least."""
        return int(max(self.plus.max(initial=-1), self.minus.max(initial=-1))) + 1

    def beyond(self, observation: int | None, state: int | None) -> str | None:
        """In words, the last entry it reads, where an observation and the state of these widths have no such entry.
        None where they have it, or a width is not known."""
        known = {"observations": observation, "state": state}
        there = sum(known[source] or 0 for source in self.reads)
        if any(known[source] is None for source in self.reads) or self.width <= there:
            return None
        return f"entry {self.width - 1} of {' and '.join(self.reads)} with {there}"

    def __call__(self, observations: X | None, state: X | None) -> X:
        """observations (..., N, O) and state (..., S) in, features (..., N, D) out; NumPy in gives NumPy out. Only the
        `source` is read."""
        if self.source == "state":
            if state is None:
                raise UserError(
                    f"View '{self.view}' needs the global state, which this data does not have; "
                    "store it or use view='decentralized'."
                )
            return self._less(state[..., self.plus], lambda entries: state[..., entries])
        assert observations is not None, "a map of observations is given some"
        rows = np.arange(self.plus.shape[0])[:, None]
        return self._less(observations[..., rows, self.plus], lambda entries: observations[..., rows, entries])

    def _less(self, entries: X, source: Callable[[np.ndarray], X]) -> X:
        """(..., N, D) entries less those that are taken from them, which `source` gives."""
        taken = self.minus >= 0
        return entries - source(np.maximum(self.minus, 0)) * taken if taken.any() else entries

    def written(self, observations: Array, state: Array | None, features: Array) -> tuple[Array, Array | None]:
        """The source with entries that the view holds as they are taken from features (..., N, D); differences of two
        entries follow from these."""
        if self.source == "observations":
            rows, differ = np.nonzero(self.minus >= 0)
            wide = np.arange(self.plus.shape[0])[:, None]
            plain = observations.at[..., wide, self.plus].set(features)
            whole = plain[..., rows, self.minus[rows, differ]] + features[..., rows, differ]
            return plain.at[..., rows, self.plus[rows, differ]].set(whole), state
        assert state is not None, "a map of the state is given one"
        plain = self.minus < 0
        return observations, state.at[..., self.plus[plain]].set(features[..., plain])

    def apart(self, after: X, before: X) -> X:
        """(..., D) how far features are from others; of angles, the shorter way round."""
        return motion.apart(self.turns, after, before)

    def agreed(self, plan: Array, history: int = 0) -> Array:
        """Plans (B, history + H, N, D) whose agents agree on where everybody will be, where the view knows how."""
        if self.reconcile is None:
            return plan
        return jnp.concatenate([plan[:, :history], self.reconcile(plan[:, history:])], 1)


def derived(names: tuple[str, ...], n: int) -> dict[int, tuple[int, int]]:
    """Entries that follow from everybody's own ones, as names tell: entry -> (own entry whose change it follows, which
    of the others it is about, -1: a thing that stands still).

    `other1.dx` is the second other's x less the own one, so it changes as `own.x` of the two do; `goal.dx` or
    `landmark0.dx` as the own one alone does, and so does `goal.dangle` as `own.angle`; `other1.dvx` goes with `own.vx`,
    or with the product of `own.v` and `own.cos` (`headed`, numbered after all entries). Who the others are, a map's
    `order` says.
    """
    known = Entries.of(names)
    own = {f"v{axis}": len(names) + k for k, axis in enumerate(known.axes[: len(headed(names))])} | known.own
    found = {}
    for e in known.each:
        if e.whose == "own" or not e.what.startswith("d") or e.what[1:] not in own:
            continue
        if e.whose != "other":
            found[e.source] = (own[e.what[1:]], -1)
        elif e.order is not None and e.order < n - 1:
            found[e.source] = (own[e.what[1:]], e.order)
    return found


def given_names(map: FeatureMap, entries: Sequence[str], state: Sequence[str] | None = None) -> list[str]:
    """What the first agent's entries are called in the data that the map reads: `cart0_x less x` where it takes one
    from another."""
    given = [*(entries if "observations" in map.reads else ()), *(state or ())]
    if isinstance(map, _Team):
        given += [f"{entry} of agent {i}" for i in range(map.plus.shape[0]) for entry in entries]
    given += [f"state{d}" for d in range(len(state or ()), map.width)]
    both = zip(map.plus[0].tolist(), map.minus[0].tolist())
    return [given[one] if less < 0 else f"{given[one]}{LESS}{given[less]}" for one, less in both]


def others_offsets(names: Sequence[str]) -> np.ndarray:
    """(J, 2 or 3) entries that say where each of the others is (dx, dy, dz); (0, 2) where names tell no such thing."""
    things = Entries.of(names).others
    axes = axes_of(set.intersection(*map(set, things))) if things else ""
    return np.array([[thing[f"d{axis}"] for axis in axes] for thing in things], int).reshape(
        len(things), len(axes) or 2
    )


def headed(names: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """The velocity of an agent that tells its speed and heading: two products of entries, along x and y; none where
    it tells no such thing."""
    known = Entries.of(names)
    if known.speed is None or len(known.direction) < 2 or f"v{known.axes[0]}" in known.own:
        return ()
    return tuple((known.speed, looks) for looks in known.direction)


def translation(wanted: FeatureMap, given: FeatureMap) -> np.ndarray | None:
    """(N, D') where the `given` view holds the entries of the `wanted` one, so that what is predicted in it can be read
    in the other; None where it does not hold them all."""
    n = wanted.plus.shape[0]
    if wanted.origin is not None and given.origin is not None:
        rows = zip(wanted.origin.tolist(), given.origin.tolist(), strict=True)
        found = [_places(entries, within) for entries, within in rows]
        if any(row is None for row in found):
            return None
        return np.array(found)
    if "centralized" not in (wanted.view, given.view):
        places = _places(wanted.names, given.names)
        if places is not None:
            return np.tile(places, (n, 1))
    return np.tile(np.arange(len(given.names)), (n, 1)) if wanted.names == given.names else None


def _places(wanted: Sequence[Hashable], given: Sequence[Hashable]) -> list[int] | None:
    """Where each of the wanted entries stands among the given ones; None where one is missing."""
    at = {entry: d for d, entry in enumerate(given)}
    if any(entry not in at for entry in wanted):
        return None
    return [at[entry] for entry in wanted]


def following(map: FeatureMap, how: dict[int, tuple[int, int]]) -> FeatureMap:
    """A map whose entries in `how` follow from the rest (`derived`)."""
    if not how:
        return map
    own = tuple(d for d in range(len(map.names)) if d not in how)
    return replace(map, own=own, reconcile=_relative(how, map), follows=tuple(how))


def constant_velocity(map: FeatureMap, dt: float, late: float = 1.0) -> FeatureMap:
    """A map of agents who know where they are by their speed alone: everything named `goal.dx`, `obstacle0.dx` moves
    by `own.vx` in a step of `dt` seconds, for the share `late` of it by the next row's. `other0.dx`, `other0.dvx` move
    as if that other kept its velocity. So what is predicted of an agent is its own velocity, whoever the others are and
    however many; what else is known of things (`obstacle0.radius`) stays."""
    rules = motion_rules(map.names)
    if not rules:
        return map
    names = {name: d for d, name in enumerate(map.names)}
    moved = {place for place, _, _ in rules} | {speed for _, speed, _ in rules if speed >= 0}
    stays = {d for name, d in names.items() if d not in moved and not name.startswith("own.")}
    follows = tuple(sorted(moved | stays))
    own = tuple(d for d in range(len(map.names)) if d not in follows)
    return replace(
        map,
        own=own,
        follows=follows,
        decentralized=True,
        dt=dt,
        late=late,
        reconcile=_reconcile_constant_velocity(rules, tuple(sorted(stays)), dt, late),
    )


def motion_rules(names: Sequence[str]) -> tuple[tuple[int, int, int], ...]:
    """(entry of a place, entry of its relative velocity or −1, entry of the own velocity) of what is named so."""
    known = Entries.of(names)
    return tuple(
        (e.source, known.bodies[e.whose, e.order].get(f"dv{e.axis}", -1), known.own[f"v{e.axis}"])
        for e in known.each
        if e.role == "offset" and f"v{e.axis}" in known.own
    )


def decentralized(view: str, names: tuple[str, ...], dt: float) -> FeatureMap:
    """s̃ of an agent that has but its own observation, of these names: what it sees and no more, in every view."""
    if view not in VIEWS:
        raise unknown("view", view, VIEWS)
    table = np.arange(len(names))[None]  # of a team of one
    return constant_velocity(FeatureMap("decentralized", names, "observations", table, np.full_like(table, -1)), dt)


@functools.cache
def _reconcile_constant_velocity(
    rules: tuple[tuple[int, int, int], ...], stays: tuple[int, ...], dt: float, late: float
) -> Callable[[Array], Array]:
    """A function on plans (..., H, N, D), row 0 the present, that moves everything by the rows' own velocities; the
    same one for the same rules."""
    place, speed, mine = np.array(rules).T
    still = np.array(stays, int)
    relative = speed >= 0

    def agree(x: Array) -> Array:
        start = x[..., :1, :, :]
        later = x[..., 1:, :, :]
        steps = later.shape[-3]
        own = later[..., mine]
        theirs = jnp.where(relative, start[..., speed] + start[..., mine], 0.0)  # their velocity, which they keep
        gone = own
        if late < 1:
            gone = late * own + (1 - late) * jnp.concatenate([start[..., mine], own[..., :-1, :, :]], -3)
        count = jnp.arange(1, steps + 1, dtype=x.dtype)[:, None, None]
        later = later.at[..., still].set(start[..., still])
        later = later.at[..., place].set(start[..., place] + dt * (count * theirs - jnp.cumsum(gone, axis=-3)))
        if relative.any():
            later = later.at[..., speed[relative]].set((theirs - own)[..., relative])
        return jnp.concatenate([start, later], -3)

    return agree


def alone(map: FeatureMap) -> FeatureMap:
    """The map as one agent has it who hears of nobody: others' entries are predicted like its own, by what it takes
    the others to see and do, and only what stands still follows from its own movement. Bodies are moved by others,
    whose actions it does not know, and guessing them helps no guard there."""
    if map.decentralized:
        return map
    rules = derived(map.names, map.plus.shape[0])
    how = {d: rule for d, rule in rules.items() if d in map.follows and rule[1] < 0}  # what stands still
    models_others = map.plus.shape[0] > 1 and not map.shared_body
    blank = replace(map, own=None, reconcile=None, follows=(), joint=False, mirrored=(), models_others=models_others)
    return following(blank, how)


def _relative(how: dict[int, tuple[int, int]], map: FeatureMap) -> Callable[[Array], Array]:
    most = 1 + max((other for _, other in how.values()), default=-1)
    order = others(map.plus.shape[0], most) if map.order is None else map.order
    return _reconcile_relative(tuple(how.items()), headed(map.names), tuple(tuple(row) for row in order.tolist()))


@functools.cache
def _reconcile_relative(
    how: tuple[tuple[int, tuple[int, int]], ...],
    products: tuple[tuple[int, int], ...],
    order: tuple[tuple[int, ...], ...],
) -> Callable[[Array], Array]:
    """A function on plans (..., H, N, D), row 0 the present, that makes the agents agree: what agent i plans to see of
    landmarks and others is recomputed from where everybody plans to be. Own entries pass through unchanged. It is
    the same one for the same rules.

    Agents execute their own part of a plan, so danger and value have to be judged on that, not on what they imagine
    of one another; and a gradient on the result moves bodies, not images of them.
    """
    entries = np.array([entry for entry, _ in how])
    sources = np.array([own for _, (own, _) in how])
    about = np.array([other for _, (_, other) in how])
    moving = about >= 0
    whose = np.array(order)[:, about[moving]] if moving.any() else np.zeros((len(order), 0), int)  # (N, entries)

    def agree(x: Array) -> Array:
        start = x[..., :1, :, :]
        later = x[..., 1:, :, :]
        change = _with_products(later, products)[..., sources] - _with_products(start, products)[..., sources]
        follow = start[..., entries] - change
        if moving.any():
            theirs = change[..., whose, np.flatnonzero(moving)]
            follow = follow.at[..., np.flatnonzero(moving)].add(theirs)
        return jnp.concatenate([start, later.at[..., entries].set(follow)], -3)

    return agree


def _with_products(x: Array, products: tuple[tuple[int, int], ...]) -> Array:
    """Features (..., D) with products of entries after them."""
    if not products:
        return x
    return jnp.concatenate([x, *(x[..., one, None] * x[..., two, None] for one, two in products)], -1)


def from_data(
    view: str,
    observations: np.ndarray,
    state: np.ndarray | None,
    observation_names: tuple[str, ...],
    state_names: tuple[str, ...],
    first_rows: np.ndarray | None = None,
    keep: Collection[str] = (),
    homogeneous: bool = False,
    dt: float | None = None,
    team: bool = False,
) -> FeatureMap:
    """The views of anybody's data: entries that never vary, or repeat an earlier one for every agent, are pruned, and
    so are entries of the state that every agent's observation tells already, in other coordinates (but for those in
    `keep`). Where names tell how entries follow from others (`derived`) and the logged steps agree, they do. Entries
    without names have those that follow from logs (problem/inferred_names.py).

    observations (M, N, O), state (M, S) or None, of all rows: a log in the order of its sites or goals holds entries
    that vary only later on. `first_rows` (E,) are those that episodes begin with. `dt` is the seconds between rows, of
    agents who are `homogeneous`, where it is known; else it is what the rows tell. A pruned view of a `team` without a
    state has the others' places, of whom an agent sees none itself, from their observations.
    """
    if view not in VIEWS:
        raise unknown("view", view, VIEWS)
    if view == "centralized" and state is None:
        raise UserError("View 'centralized' needs the global state, which this data does not have; use view='pruned'.")
    plain = _pruned_map(view, observations, state, observation_names, state_names, first_rows, set(keep), team)
    steps = _Steps.of(plain, observations, state, first_rows)
    if steps is not None:
        plain = replace(plain, turns=motion.turns_in(steps.before, steps.after))
    if view == "centralized":
        return plain
    if homogeneous and not axes_of(Entries.of(plain.names).own, "{}"):
        dt = dt or _step_of(plain, steps)
        if dt is not None:
            return constant_velocity(plain, dt, _late(plain, steps, dt))
    if steps is not None:
        both = [jnp.asarray(x) for x in (steps.before, steps.after)]
        before, after = (np.asarray(_with_products(x, headed(plain.names))) for x in both)
        plain = replace(plain, order=order_in(after - before, derived(plain.names, plain.plus.shape[0])))
    how = _confirmed(plain, steps)
    if steps is not None and not any(other >= 0 for _, other in how.values()):
        plain = replace(plain, mirrored=partners.found_in(steps.before))
    return following(plain, how)


def _pruned_map(
    view: str,
    observations: np.ndarray,
    state: np.ndarray | None,
    observation_names: tuple[str, ...],
    state_names: tuple[str, ...],
    first_rows: np.ndarray | None,
    keep: set[str],
    team: bool,
) -> FeatureMap:
    """A map of the entries that tell something new."""
    m, n, width = observations.shape
    shared = [] if state is None else [np.broadcast_to(state[:, d : d + 1], (m, n)) for d in range(state.shape[1])]
    if view == "centralized":
        kept = _some(_telling(shared, set()))
        table = np.tile(np.array(kept), (n, 1))
        return FeatureMap(view, tuple(state_names[d] for d in kept), "state", table, np.full_like(table, -1))
    joined = None
    if view == "pruned" and state is not None:
        joined = state, state_names
    elif view == "pruned" and team:
        joined = as_state(observations), None
    seen = on_map.relative(observations, observation_names, joined, first_rows, keep)
    relative = seen.of(observations, joined[0] if joined else None)
    columns = [relative[..., c] for c in range(relative.shape[-1])]
    known: set[int] = set()
    if view == "pruned" and state is not None:
        known = {len(columns) + d for d in _observed_too(observations, state, keep, state_names) | seen.of_state}
        # One index table needs one source: of a pruned view, observations with the state appended to each of them.
        columns = columns + shared
        seen = seen.with_entries(range(width, width + len(shared)), state_names)
    kept = _some(_telling(columns, known))
    plus, minus = seen.plus[:, kept], seen.minus[:, kept]
    kind = FeatureMap
    if max(plus.max(), minus.max()) >= width:
        kind = _Team if state is None else _Joint
    return kind(view, tuple(seen.names[d] for d in kept), "observations", plus, minus)


def _some(kept: list[int]) -> list[int]:
    if not kept:
        raise UserError("Every observation entry is constant, so there is nothing to plan over; check the store.")
    return kept


def _telling(columns: list[np.ndarray], known: set[int]) -> list[int]:
    """The columns that vary, are not `known` and repeat no earlier one."""
    kept: list[int] = []
    alike: dict[bytes, list[np.ndarray]] = {}  # by their first rows: there may be thousands
    for d, column in enumerate(columns):
        # most vary at once, so the first rows are asked first
        if d in known or all(np.ptp(some, axis=0).max() < 1e-9 for some in (column[:ROWS], column)):
            continue
        earlier = alike.setdefault((column[:FIRST].astype(np.float64) + 0.0).tobytes(), [])  # -0 is 0
        pieces = [slice(k, k + ROWS) for k in range(0, len(column), ROWS)]  # most differ at once
        if not any(all(np.array_equal(column[piece], one[piece]) for piece in pieces) for one in earlier):
            earlier.append(column)
            kept.append(d)
    return kept


@dataclass(frozen=True, eq=False)
class _Steps:
    """Features (M, N, D) before and after some logged steps."""

    before: np.ndarray
    after: np.ndarray

    @classmethod
    def of(
        cls, map: FeatureMap, observations: np.ndarray, state: np.ndarray | None, first_rows: np.ndarray | None
    ) -> _Steps | None:
        """Evenly spread; None where there are too few."""
        if len(observations) < 3:
            return None
        before = np.unique(np.linspace(0, len(observations) - 2, STEPS).astype(int))
        if first_rows is not None:
            before = before[~np.isin(before + 1, first_rows)]
        return cls(*(map(observations[rows], None if state is None else state[rows]) for rows in (before, before + 1)))


def _confirmed(map: FeatureMap, steps: _Steps | None) -> dict[int, tuple[int, int]]:
    """Those of the `derived` entries that logged steps confirm."""
    how = derived(map.names, map.plus.shape[0])
    if not how or steps is None:
        return {}
    pair = np.stack([steps.before, steps.after], 1).astype(np.float32)
    predicted = np.asarray(jax.jit(_relative(how, map))(pair))[:, 1]
    error = predicted - steps.after
    change = steps.after - steps.before
    return {d: rule for d, rule in how.items() if _follows(error[..., d], change[..., d])}


def _follows(error: np.ndarray, change: np.ndarray) -> bool:
    """Whether nine in ten are predicted to a twentieth of their change."""
    return bool(np.quantile(np.abs(error), 0.9) <= 0.05 * np.quantile(np.abs(change), 0.9) + 1e-5)


def _step_of(map: FeatureMap, steps: _Steps | None) -> float | None:
    """s between rows, of agents who know velocities and not places: what stands still (`goal.dx`) moves by −dt of
    `own.vx`. None where no entry tells, or logged steps do not agree."""
    if steps is None:
        return None
    before = steps.before.astype(np.float64)
    after = steps.after.astype(np.float64)
    found = []
    for place, relative, mine in motion_rules(map.names):
        if relative >= 0:
            continue
        moved = (after - before)[..., place].ravel()
        speed = after[..., mine].ravel()
        fast = np.abs(speed) > np.quantile(np.abs(speed), 0.5)
        if not fast.any():
            continue
        dt = float(np.median(-moved[fast] / speed[fast]))
        if dt > 0 and _follows(moved + dt * speed, moved):
            found.append(dt)
    return float(np.round(np.median(found), 6)) if found else None


def _late(map: FeatureMap, steps: _Steps | None, dt: float) -> float:
    """The share of a step that is gone with the next velocity; all of it where the logged steps do not say."""
    rules = motion_rules(map.names)
    if steps is None or not rules:
        return 1.0
    place, speed, mine = np.array(rules).T
    before, after = (np.asarray(x, np.float64) for x in (steps.before, steps.after))
    was, became = (np.where(speed >= 0, x[..., speed], -x[..., mine]) for x in (before, after))
    share = late_share(after[..., place] - before[..., place], was, became, dt)
    return 1.0 if share is None else share


def _observed_too(observations: np.ndarray, state: np.ndarray, keep: set[str], names: tuple[str, ...]) -> set[int]:
    """Entries of the state (M, S) that are an affine function of the observation of each agent (M, N, O), but for those
    to `keep`."""
    some = np.unique(np.linspace(0, len(state) - 1, STEPS).astype(int))
    if len(some) < 4 * observations.shape[2]:
        return set()
    goal = np.asarray(state[some], np.float64)
    spread = goal.std(0)
    goal = goal - goal.mean(0)
    known = np.ones(state.shape[1], bool)
    for i in range(observations.shape[1]):
        seen = np.asarray(observations[some, i], np.float64)
        seen = seen - seen.mean(0)
        left = goal - seen @ np.linalg.lstsq(seen, goal, rcond=None)[0]
        known &= left.std(0) <= 1e-4 * spread
    entries = np.flatnonzero(known & (spread > 0)).tolist()
    return {d for d in entries if not (names and names[d] in keep)}


@dataclass(frozen=True, eq=False)
class _Joint(FeatureMap):
    """Features read from each agent's observation with the global state appended to it."""

    @property
    def reads(self) -> tuple[Source, ...]:
        return ("observations", "state")

    def __call__(self, observations: X | None, state: X | None) -> X:
        if state is None:
            raise UserError("This view was fitted with a global state; pass it when acting.")
        assert observations is not None, "a map of observations is given some"
        width = observations.shape[-1]
        rows = np.arange(self.plus.shape[0])[:, None]
        xp: Any = np if isinstance(observations, np.ndarray) else jnp

        def source(entries: np.ndarray) -> X:
            own = observations[..., rows, np.minimum(entries, width - 1)]
            return xp.where(entries < width, own, state[..., np.maximum(entries - width, 0)])

        return self._less(source(self.plus), source)

    def written(self, observations: Array, state: Array | None, features: Array) -> tuple[Array, Array | None]:
        observations, _ = super().written(observations, None, features)  # what is of the state is beyond its end
        assert state is not None, "a map of the state is given one"
        width = observations.shape[-1]
        of_state = self.plus >= width
        plain = of_state & (self.minus < 0)
        state = state.at[..., self.plus[plain] - width].set(features[..., plain])
        rows, differ = np.nonzero(of_state & (self.minus >= 0))
        shared = jnp.broadcast_to(state[..., None, :], (*observations.shape[:-1], state.shape[-1]))
        both = jnp.concatenate([observations, shared], -1)
        whole = both[..., rows, self.minus[rows, differ]] + features[..., rows, differ]
        return observations, state.at[..., self.plus[rows, differ] - width].set(whole)


@dataclass(frozen=True, eq=False)
class _Team(_Joint):
    """The same where there is no global state: everybody's observations, one after the other, are it."""

    @property
    def reads(self) -> tuple[Source, ...]:
        return ("observations",)

    @property
    def width(self) -> int:
        """Of an observation: the state has one of each agent."""
        return -(-super().width // (self.plus.shape[0] + 1))

    def __call__(self, observations: X | None, state: X | None) -> X:
        assert observations is not None, "a map of observations is given some"
        return super().__call__(observations, as_state(observations))

    def written(self, observations: Array, state: Array | None, features: Array) -> tuple[Array, Array | None]:
        """What others are seen by is theirs to write."""
        return FeatureMap.written(self, observations, None, features)[0], state


def as_state(observations: X) -> X:
    """(..., N O) of observations (..., N, O)."""
    return observations.reshape(*observations.shape[:-2], -1)


def from_dict(data: Mapping[str, Any]) -> FeatureMap:
    """The map that a run's config.json describes."""
    plus = data["plus"]
    minus = data["minus"]
    widths = {len(row) for row in (*plus, *minus)}
    if len(plus) != len(minus) or widths != {len(data["names"])}:
        raise UserError("The run's feature map is damaged: its rows are not of one length; train the run again.")
    if min((k for row in plus for k in row), default=0) < 0 or min((k for row in minus for k in row), default=0) < -1:
        raise UserError("The run's feature map is damaged: it reads entries before the first; train the run again.")
    if data.get("dt") is not None and not 0 < data["dt"] < math.inf:
        raise UserError(f"The run's feature map is damaged: steps of {data['dt']} s are none; train the run again.")
    if not 0 <= data.get("late", 1.0) <= 1:
        raise UserError(f"The run's feature map is damaged: {data['late']} is no share of a step; train the run again.")
    kind = _Team if data.get("team") else _Joint if data["joint"] else FeatureMap
    map = kind(data["view"], tuple(data["names"]), data["source"], np.array(plus), np.array(minus))
    map = replace(map, turns=_turns(data), mirrored=_mirrored(data), order=_order_of(data))
    if data.get("dt") is not None:
        return constant_velocity(map, data["dt"], data.get("late", 1.0))
    kept = set(data.get("follows", ()))
    rules = derived(map.names, map.plus.shape[0])
    return following(map, {d: rule for d, rule in rules.items() if d in kept})


def _order_of(data: Mapping[str, Any]) -> np.ndarray | None:
    if data.get("order") is None:
        return None
    agents = range(len(data["plus"]))
    rows = [row for agent, row in enumerate(data["order"]) if len({agent, *row}) == 1 + len(row) <= len(agents)]
    widths = {len(row) for row in rows}
    if len(rows) < len(agents) or len(widths) > 1 or not all(other in agents for row in rows for other in row):
        raise UserError("The run's feature map is damaged: its others are none of its agents; train the run again.")
    return np.array(rows)


def _turns(data: Mapping[str, Any]) -> tuple[Turn, ...]:
    found = tuple(Turn(int(entry), low, whole) for entry, low, whole in data.get("turns", ()))
    if any(not 0 <= turn.entry < len(data["names"]) or not 0 < turn.whole < math.inf for turn in found):
        raise UserError("The run's feature map is damaged: its angles are none of its entries; train the run again.")
    return found


def _mirrored(data: Mapping[str, Any]) -> tuple[Mirrored, ...]:
    found = tuple(Mirrored(tuple(entries), int(sign)) for entries, sign in data.get("mirrored", ()))
    every = [entry for part in found for entry in part.entries]
    alike = len({len(part.entries) for part in found}) <= 1 and all(part.entries for part in found)
    if not alike or not all(0 <= e < len(data["names"]) for e in every):
        raise UserError("The run's feature map is damaged: others are none of its entries; train the run again.")
    return found


def to_dict(map: FeatureMap) -> dict[str, Any]:
    """JSON form of a map."""
    return {
        "view": map.view,
        "names": list(map.names),
        "source": map.source,
        "plus": map.plus.tolist(),
        "minus": map.minus.tolist(),
        "joint": isinstance(map, _Joint),
        **({"team": True} if isinstance(map, _Team) else {}),
        "follows": list(map.follows),
        **({} if map.order is None else {"order": map.order.tolist()}),
        **({"turns": [list(turn) for turn in map.turns]} if map.turns else {}),
        **({"mirrored": [[list(entries), sign] for entries, sign in map.mirrored]} if map.mirrored else {}),
        **({} if map.dt is None else {"dt": map.dt}),
        **({} if map.late == 1 else {"late": map.late}),
    }
