"""s̃_i, the state of agent i that everything else works on, from the global state or the local observation.

Each entry is one number of the source, or the difference of two, and has a name; so a view is a table of indices,
exact, differentiable and linear in the number of entries. Three views exist, because the paper argues about them:

* `pruned` (default): the union of global state and own observation, without duplicates, seen from the agent;
* `centralized`: the global state, the same for every agent;
* `decentralized`: the agent's own observation alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError, unknown
from ringfence.types import Array

View = Literal["pruned", "centralized", "decentralized"]
VIEWS = ("pruned", "centralized", "decentralized")
OWN = (0, 1, 2, 3)  # own.vx, own.vy, own.x, own.y


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """Entry d of agent i is source[plus[i, d]] − source[minus[i, d]] (minus = −1: nothing is taken away)."""

    view: str
    names: tuple[str, ...]  # D
    source: Literal["state", "observations"]
    plus: np.ndarray  # (N, D) int
    minus: np.ndarray  # (N, D) int
    own: tuple[int, ...] | None = None  # entries that only the agent itself can change; the rest follows from them
    reconcile: Callable[[Array], Array] | None = None  # (..., H, N, D): rows after the first follow from own entries
    joint: bool = False  # the agents move one body: what comes next depends on everybody's action
    # D weights of the standardised entries that the critic reads; None: all alike
    critic_weight: tuple[float, ...] | None = None

    def __call__(self, observations: Array, state: Array | None) -> Array:
        """observations (..., N, O) and state (..., S) in, features (..., N, D) out; NumPy in gives NumPy out."""
        taken = self.minus >= 0
        if self.source == "state":
            if state is None:
                raise UserError(
                    f"View '{self.view}' needs the global state, which this data does not have; "
                    "store it or use view='decentralized'."
                )
            entries = state[..., self.plus]
            return entries - state[..., np.maximum(self.minus, 0)] * taken if taken.any() else entries
        rows = np.arange(self.plus.shape[0])[:, None]
        return observations[..., rows, self.plus]

    def agreed(self, plan: Array, history: int = 0) -> Array:
        """Plans (B, history + H, N, D) whose agents agree on where everybody will be, where the view knows how."""
        if self.reconcile is None:
            return plan
        return jnp.concatenate([plan[:, :history], self.reconcile(plan[:, history:])], 1)


def simple_spread(view: str, n_agents: int) -> FeatureMap:
    """The views of Simple Spread; state as in `SimpleSpread.global_state`, lengths in m, velocities in m/s."""
    n = n_agents
    if view == "decentralized":
        names = ["own.vx", "own.vy", "own.x", "own.y"]
        names += [f"landmark{j}.d{c}" for j in range(n) for c in "xy"]
        names += [f"other{j}.d{c}" for j in range(n - 1) for c in "xy"]  # the communication channel is always 0
        table = np.tile(np.arange(len(names)), (n, 1))
        agree = _reconcile_relative(tuple(names), n)
        return FeatureMap(
            view, tuple(names), "observations", table, np.full_like(table, -1), OWN, agree, critic_weight=_worth(names)
        )
    position = np.arange(2 * n).reshape(n, 2)
    velocity, landmark = position + 2 * n, position + 4 * n
    if view == "centralized":
        names = [f"agent{i}.{c}" for i in range(n) for c in "xy"] + [f"agent{i}.v{c}" for i in range(n) for c in "xy"]
        names += [f"landmark{i}.{c}" for i in range(n) for c in "xy"]
        table = np.tile(np.arange(6 * n), (n, 1))
        return FeatureMap(view, tuple(names), "state", table, np.full_like(table, -1), critic_weight=_worth(names))
    if view != "pruned":
        raise unknown("view", view, VIEWS)
    names, plus, minus = ["own.vx", "own.vy", "own.x", "own.y"], [], []
    names += [f"landmark{j}.d{c}" for j in range(n) for c in "xy"]
    names += [f"other{j}.d{c}" for j in range(n - 1) for c in "xy"]
    names += [f"other{j}.dv{c}" for j in range(n - 1) for c in "xy"]  # makes the hazard's dynamics Markov
    for i in range(n):
        others = [j for j in range(n) if j != i]
        p = [*velocity[i], *position[i], *landmark.ravel(), *position[others].ravel(), *velocity[others].ravel()]
        m = [-1] * 4 + list(position[i]) * n + list(position[i]) * (n - 1) + list(velocity[i]) * (n - 1)
        plus.append(p)
        minus.append(m)
    agree = _reconcile_relative(tuple(names), n)
    return FeatureMap(
        view, tuple(names), "state", np.array(plus), np.array(minus), OWN, agree, critic_weight=_worth(names)
    )


def _worth(names: list[str]) -> tuple[float, ...]:
    """A quarter for velocities. The reward is about positions, but a plan's velocities vary more than its positions
    do, in deviations: a critic that hears both alike steers plans to speeds that their positions do not follow."""
    return tuple(0.25 if name.split(".")[1].lstrip("d")[0] == "v" else 1.0 for name in names)


def robot(
    view: str, state_names: tuple[str, ...], joints: tuple[str, ...], own_joints: np.ndarray, observed: np.ndarray
) -> FeatureMap:
    """The views of one robot whose joints are shared out: torso, own joints, others' joints.

    own_joints (N, A) index `joints`; observed (N, O) are the entries of the state in everybody's observation.
    """
    n, a = own_joints.shape
    torso = [name for name in state_names if name.startswith("torso.")]
    if view == "centralized":
        table = np.tile(np.arange(len(state_names)), (n, 1))
        return FeatureMap(view, tuple(state_names), "state", table, np.full_like(table, -1), joint=True)
    if view == "decentralized":
        own = {f"{joints[k]}.{c}": f"own.joint{p}.{c}" for p, k in enumerate(own_joints[0]) for c in "qv"}
        seen = [state_names[k] for k in observed[0]]
        near = {name: f"near{m}.q" for m, name in enumerate(x for x in seen if x not in own and x not in torso)}
        table = np.tile(np.arange(len(seen)), (n, 1))
        names = tuple((own | near).get(x, x) for x in seen)
        return FeatureMap(view, names, "observations", table, np.full_like(table, -1), joint=True)
    if view != "pruned":
        raise unknown("view", view, VIEWS)
    at = {name: k for k, name in enumerate(state_names)}
    whose = ["own", *(f"other{j}" for j in range(n - 1))]
    names = [*torso, *(f"{w}.joint{k}.{c}" for w in whose for k in range(a) for c in "qv")]
    rows = []
    for i in range(n):
        order = [i, *(j for j in range(n) if j != i)]
        rows.append([at[f"{joints[k]}.{c}"] for j in order for k in own_joints[j] for c in "qv"])
    table = np.array([[at[t] for t in torso] + row for row in rows])
    own = tuple(range(len(torso) + 2 * a))
    agree = _reconcile_shared(len(torso), 2 * a, n)
    return FeatureMap(view, tuple(names), "state", table, np.full_like(table, -1), own, agree, joint=True)


def _reconcile_shared(torso: int, joints: int, n: int) -> Callable[[Array], Array]:
    """A function on plans (..., H, N, D), row 0 the present: everybody's torso is the mean of the planned ones, and
    others' joints are where their owners plan to have them."""
    others = np.array([[j for j in range(n) if j != i] for i in range(n)], int)

    def agree(x: Array) -> Array:
        start, later = x[..., :1, :, :], x[..., 1:, :, :]
        body = jnp.broadcast_to(later[..., :torso].mean(-2, keepdims=True), later[..., :torso].shape)
        own = later[..., torso : torso + joints]
        rest = own[..., others, :].reshape(*own.shape[:-1], (n - 1) * joints)
        return jnp.concatenate([start, jnp.concatenate([body, own, rest], -1)], -3)

    return agree


def _reconcile_relative(names: tuple[str, ...], n: int) -> Callable[[Array], Array]:
    """A function on plans (..., H, N, D), row 0 the present, that makes the agents agree: what agent i plans to see of
    landmarks and others is recomputed from where everybody plans to be. Own entries pass through unchanged.

    Agents execute their own part of a plan, so danger and value have to be judged on that, not on what they imagine
    of one another; and a gradient on the result moves bodies, not images of them.
    """
    at = {name: d for d, name in enumerate(names)}
    others = np.array([[j for j in range(n) if j != i] for i in range(n)], int).reshape(n, n - 1)
    own_p, own_v = [at["own.x"], at["own.y"]], [at["own.vx"], at["own.vy"]]
    moving = "other0.dvx" in at
    shown = 4 + 2 * n + 2 * (n - 1) + (2 * (n - 1) if moving else 0)
    assert shown == len(names), "own, landmarks, others, in this order"

    def agree(x: Array) -> Array:
        start, later = x[..., :1, :, :], x[..., 1:, :, :]
        moved, sped = later[..., own_p] - start[..., own_p], later[..., own_v] - start[..., own_v]
        parts = [later[..., :4], start[..., 4 : 4 + 2 * n] - jnp.tile(moved, n)]
        for change, first in ((moved, 4 + 2 * n), (sped, 4 + 2 * n + 2 * (n - 1)))[: 1 + moving]:
            apart = change[..., others, :] - change[..., :, None, :]
            parts.append(start[..., first : first + 2 * (n - 1)] + apart.reshape(*change.shape[:-1], -1))
        return jnp.concatenate([start, jnp.concatenate(parts, -1)], -3)

    return agree


def from_data(
    view: str,
    observations: np.ndarray,
    state: np.ndarray | None,
    observation_names: tuple[str, ...],
    state_names: tuple[str, ...],
) -> FeatureMap:
    """The views of anybody's data: entries that never vary, or repeat an earlier one for every agent, are pruned.

    observations (M, N, O), state (M, S) or None, of all rows: a log in the order of its sites or goals holds entries
    that vary only later on.
    """
    if view not in VIEWS:
        raise unknown("view", view, VIEWS)
    if view == "centralized" and state is None:
        raise UserError("View 'centralized' needs the global state, which this data does not have; use view='pruned'.")
    m, n, o = observations.shape
    own = [observations[:, :, d] for d in range(o)]
    shared = [] if state is None else [np.broadcast_to(state[:, d : d + 1], (m, n)) for d in range(state.shape[1])]
    if view == "decentralized" or state is None:
        columns, names = own, observation_names
    elif view == "centralized":
        columns, names = shared, state_names
    else:
        columns, names = own + shared, observation_names + state_names
    kept: list[int] = []
    for d, column in enumerate(columns):
        if not _constant(column) and not any(_same(column, columns[e]) for e in kept):
            kept.append(d)
    if not kept:
        raise UserError("Every observation entry is constant, so there is nothing to plan over; check the store.")
    if view == "pruned" and state is not None:
        # One index table needs one source: observations, then the state appended to each of them.
        table = np.tile(np.array(kept), (n, 1))
        return _Joint(view, tuple(names[d] for d in kept), "observations", table, np.full_like(table, -1))
    source = "state" if view == "centralized" else "observations"
    table = np.tile(np.array(kept), (n, 1))
    return FeatureMap(view, tuple(names[d] for d in kept), source, table, np.full_like(table, -1))


def _constant(column: np.ndarray, rows: int = 10_000) -> bool:
    """Whether a column (M, N) never varies for any agent. Most vary at once, so the first rows are asked first."""
    return all(np.ptp(some, axis=0).max() < 1e-9 for some in (column[:rows], column))


def _same(a: np.ndarray, b: np.ndarray, rows: int = 10_000) -> bool:
    """Whether two columns are equal; most differ at once, so they are compared piece by piece."""
    return all(np.array_equal(a[k : k + rows], b[k : k + rows]) for k in range(0, len(a), rows))


@dataclass(frozen=True, eq=False)
class _Joint(FeatureMap):
    """Features read from each agent's observation with the global state appended to it."""

    def __call__(self, observations: Array, state: Array | None) -> Array:
        if state is None:
            raise UserError("This view was fitted with a global state; pass it when acting.")
        o, index = observations.shape[-1], self.plus[0]
        own = observations[..., index[index < o]]
        shared = state[..., None, index[index >= o] - o]
        shape = (*own.shape[:-1], shared.shape[-1])
        xp = np if isinstance(own, np.ndarray) else jnp
        return xp.concatenate([own, xp.broadcast_to(shared, shape)], -1)


def from_dict(data: dict) -> FeatureMap:
    """The map that a run's config.json describes."""
    kind = _Joint if data["joint"] else FeatureMap
    return kind(data["view"], tuple(data["names"]), data["source"], np.array(data["plus"]), np.array(data["minus"]))


def to_dict(map: FeatureMap) -> dict:
    """JSON form of a map."""
    return {
        "view": map.view,
        "names": list(map.names),
        "source": map.source,
        "plus": map.plus.tolist(),
        "minus": map.minus.tolist(),
        "joint": isinstance(map, _Joint),
    }
