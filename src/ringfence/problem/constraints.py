"""What danger means: a signed clearance ℓ(s̃_i) in physical units, and the masks that follow from it.

A hazard is a small value that names the features it reads. `bind` resolves the names against a feature list once
and gives a `BoundHazard`, whose functions are differentiable and batched over any leading axes.

    ℓ < 0            unsafe (the task charges a cost)
    ℓ >= safe_margin  safe, with room to spare
    in between       neither: no label is given to a barrier there
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, SupportsFloat

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError, of_kind, one_of, unknown
from ringfence.problem.entries import Entries, axes_of
from ringfence.types import Array

Numbers = np.ndarray | Array


def _require_numbers(**given: Any) -> None:
    for name, value in given.items():
        of_kind(name, value, SupportsFloat, "give a number")


@dataclass(frozen=True)
class Separation:
    """Agents' centres must stay at least `radius` apart: ℓ_i = min_j ‖p_j − p_i‖ − radius (m)."""

    radius: float = 0.30  # m; two agents of radius 0.15 touch at 0.30
    safe_margin: float = 0.075  # m; 1.25 radii at 0.30, the ratio MACBF uses (Qin et al. 2021)

    def __post_init__(self):
        _require_numbers(radius=self.radius, safe_margin=self.safe_margin)


@dataclass(frozen=True)
class SpeedLimit:
    """Speed must stay below `limit`: ℓ = limit − ‖v‖ (m/s), v read from the named features."""

    limit: float
    features: tuple[str, ...] = ("torso.vx", "torso.vy")
    safe_margin: float | None = None  # m/s; None: a fifth of the limit

    def __post_init__(self):
        _require_numbers(limit=self.limit, **{"safe_margin": self.safe_margin} if self.safe_margin is not None else {})
        object.__setattr__(self, "features", tuple(self.features))


@dataclass(frozen=True)
class CostColumn:
    """Danger is what the logged cost says: a state reached with cost > 0 is unsafe. No formula, so no label can be
    given to states that are not in the data."""


@dataclass(frozen=True)
class All:
    """Every hazard at once: unsafe for any is unsafe, and safe is what every one calls safe by its own margin. The
    clearance is the smallest one, in the unit of the first: metres and m/s are compared by their safe margins."""

    hazards: tuple[Hazard, ...]

    def __post_init__(self):
        of_kind("hazards", self.hazards, Iterable, "give several hazards")
        object.__setattr__(self, "hazards", tuple(self.hazards))
        for one in self.hazards:
            of_kind("a hazard of All", one, Hazard, "give a Separation, SpeedLimit or CostColumn")


Hazard = Separation | SpeedLimit | CostColumn | All


@dataclass(frozen=True, eq=False)
class BoundHazard:
    """A hazard resolved against a list of features.

    `clearance` maps features (..., N, D) in physical units to ℓ (..., N); it is None where danger has no formula.
    """

    hazard: Hazard
    clearance: Callable[[Numbers], Array] | None
    safe_margin: float
    members: tuple[BoundHazard, ...] = ()  # of All: each has a margin of its own

    @property
    def has_formula(self) -> bool:
        return self.clearance is not None

    def labels(self, features: Numbers, costs: Numbers | None = None) -> tuple[Array, Array]:
        """(unsafe, safe), each (..., N) bool. `costs` (...) is the cost charged on arriving in the state, negative
        where nobody knows; it is read only where there is no formula."""
        if self.members:
            unsafe, safe = zip(*(member.labels(features) for member in self.members))
            return functools.reduce(jnp.logical_or, unsafe), functools.reduce(jnp.logical_and, safe)
        if self.clearance is not None:
            ell = self.clearance(features)
            return ell < 0, ell >= self.safe_margin
        if costs is None:
            raise UserError("CostColumn can label only states of the data; pass their costs or give a hazard formula.")
        costs = jnp.broadcast_to(costs[..., None], features.shape[:-1])
        return costs > 0, costs == 0


@jax.custom_jvp
def lowest(x: Array) -> Array:
    """(...,) the least of the last axis, of agents or constraints. Its derivative is that of the first entry that is
    least; that of `min` asks which entries *equal* the result, and is 0/0 where a compiler rounds the two
    differently."""
    return x.min(-1)


@lowest.defjvp
def _slope_of_lowest(x: tuple[Array], moved: tuple[Array]) -> tuple[Array, Array]:
    first = x[0].argmin(-1, keepdims=True) == jnp.arange(x[0].shape[-1])
    return lowest(x[0]), jnp.where(first, moved[0], 0.0).sum(-1)


def bind(hazard: Hazard, names: tuple[str, ...], n_agents: int) -> BoundHazard:
    """Resolve a hazard's feature names; an absent one is refused with the nearest name."""
    return _bound(hazard, tuple(names), n_agents)


@functools.lru_cache(256)
def _bound(hazard: Hazard, names: tuple[str, ...], n_agents: int) -> BoundHazard:
    """The same value for the same hazard and names, so that what was compiled with it serves again."""
    if isinstance(hazard, CostColumn):
        return BoundHazard(hazard, None, 0.0)
    if isinstance(hazard, Separation):
        return _bind_separation(hazard, names, n_agents)
    if isinstance(hazard, SpeedLimit):
        return _bind_speed(hazard, names)
    return _bind_all(hazard, names, n_agents)


def _bind_all(hazard: All, names: tuple[str, ...], n_agents: int) -> BoundHazard:
    parts = tuple(bind(h, names, n_agents) for h in hazard.hazards)
    formulas = [part.clearance for part in parts if part.clearance is not None]
    if not parts or len(formulas) < len(parts):
        raise UserError("All(...) needs at least one hazard and a formula for each; leave CostColumn out of it.")
    unit = parts[0].safe_margin
    margins = [part.safe_margin for part in parts]
    if any(margin != unit for margin in margins) and not all(margin > 0 for margin in margins):
        raise UserError("All(...) compares its hazards by their safe margins; give each a safe_margin above 0.")
    scales = [1.0 if margin == unit else unit / margin for margin in margins]

    def clearance(x: Numbers) -> Array:
        return lowest(jnp.stack([scale * formula(x) for scale, formula in zip(scales, formulas, strict=True)], -1))

    return BoundHazard(hazard, clearance, unit, parts)


def bind_or_none(hazard: Hazard, names: tuple[str, ...], n_agents: int) -> BoundHazard | None:
    """The hazard bound to a view; None where that view cannot read its formula."""
    try:
        return bind(hazard, names, n_agents)
    except UserError:
        return None


def _bind_separation(hazard: Separation, names: tuple[str, ...], n_agents: int) -> BoundHazard:
    known = Entries.of(names)
    slots = len(list(itertools.takewhile(axes_of, known.others)))
    # An agent may see not all others, but those who come nearest; in a crowd somebody is always seen, and no entry
    # needs to say so.
    nearest_only = any("seen" in other for other in known.others) or (n_agents < 2 and slots > 0)
    if n_agents < 2 and not nearest_only:
        raise UserError(f"Separation needs at least 2 agents, the data has {n_agents}; use another hazard.")
    offsets = _offsets(names, n_agents, slots if nearest_only else n_agents - 1)

    def clearance(x: Numbers) -> Array:
        squared = (offsets(x) ** 2).sum(-1)
        distance = jnp.sqrt(jnp.maximum(squared, 1e-12))
        return lowest(distance) - hazard.radius

    return BoundHazard(hazard, clearance, hazard.safe_margin)


def _offsets(names: tuple[str, ...], n_agents: int, others: int) -> Callable[[Numbers], Numbers]:
    """A function from features (..., N, D) to the places of others relative to an agent (..., N, others, 2), where
    features hold these or everybody's places."""
    first, second = Entries.of(names).axes[:2]
    relative = [(f"other{j}.d{first}", f"other{j}.d{second}") for j in range(others)]
    lacking = [name for pair in relative for name in pair if name not in names]
    if not lacking:
        index = np.array([[names.index(x), names.index(y)] for x, y in relative])  # (others, 2)
        return lambda x: x[..., index]

    absolute = [(f"agent{j}.{first}", f"agent{j}.{second}") for j in range(n_agents)]
    if any(name not in names for pair in absolute for name in pair):
        raise _missing("Separation", lacking[0], names)
    index = np.array([[names.index(x), names.index(y)] for x, y in absolute])  # (N, 2)
    agents = np.arange(n_agents)
    rows, columns = np.nonzero(~np.eye(n_agents, dtype=bool))

    def offsets(x: Numbers) -> Numbers:
        places = x[..., index]  # (..., N, N, 2): every agent's copy of all positions
        own = places[..., agents, agents, :]
        gap = places - own[..., None, :]
        return gap[..., rows, columns, :].reshape(*gap.shape[:-2], n_agents - 1, 2)

    return offsets


def _bind_speed(hazard: SpeedLimit, names: tuple[str, ...]) -> BoundHazard:
    for name in hazard.features:
        if name not in names:
            raise _missing("SpeedLimit", name, names)
    index = np.array([names.index(n) for n in hazard.features])

    def speed(x: Numbers) -> Array:
        return jnp.sqrt(jnp.maximum((x[..., index] ** 2).sum(-1), 1e-12))

    margin = 0.2 * hazard.limit if hazard.safe_margin is None else hazard.safe_margin
    return BoundHazard(hazard, lambda x: hazard.limit - speed(x), margin)


def reads(hazard: Hazard, n_agents: int, names: tuple[str, ...]) -> tuple[str, ...]:
    """Entries that a hazard reads by names that somebody gave, given what agents observe; Separation, where that tells
    no others, reads the state's."""
    if isinstance(hazard, All):
        return tuple(name for h in hazard.hazards for name in reads(h, n_agents, names))
    if isinstance(hazard, SpeedLimit):
        return hazard.features
    if isinstance(hazard, Separation) and "other0.dx" not in names:
        return tuple(f"agent{i}.{c}" for i in range(n_agents) for c in "xy")
    return ()


def _missing(kind: str, name: str, names: tuple[str, ...]) -> UserError:
    near = unknown("feature", name, names)
    return UserError(f"{kind} reads the feature '{name}', which this data does not have: name it in the card. {near}")


def to_dict(hazard: Hazard) -> dict[str, Any]:
    """JSON form of a hazard, equal to what is read back from a file: lists, no tuples."""
    if isinstance(hazard, All):
        return {"kind": "All", "hazards": [to_dict(h) for h in hazard.hazards]}
    fields = {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(hazard).items()}
    return {"kind": type(hazard).__name__, **fields}


def from_dict(data: Mapping[str, Any]) -> Hazard:
    """Inverse of `to_dict`; an unknown kind or field is refused."""
    kinds = {"Separation": Separation, "SpeedLimit": SpeedLimit, "CostColumn": CostColumn, "All": All}
    data = dict(data)  # a TypeError where it is no mapping
    kind = data.pop("kind", "")
    made = one_of("hazard", kind, kinds)
    if kind == "All":
        return All(tuple(from_dict(h) for h in data.get("hazards", ())))
    fields = {f.name: f for f in dataclasses.fields(made)}
    for name in data:
        one_of(f"field of hazard {kind}", name, fields)
    for name, field in fields.items():
        if name not in data and field.default is dataclasses.MISSING:
            raise UserError(f"Hazard {kind} needs a value of '{name}'; add it to the card.")
    for name in ("radius", "limit", "safe_margin"):
        value = data.get(name)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if value is not None and not (number and 0 <= value < float("inf")):
            raise UserError(f"Hazard {kind} has {name}={value!r}; it must be a number, 0 or more, and finite.")
    return kinds[kind](**{k: tuple(v) if isinstance(v, list) else v for k, v in data.items()})
