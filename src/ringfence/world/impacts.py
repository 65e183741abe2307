"""Steps that end in an impact, where what was touched throws a body back.

The state that is logged after such a step is of a body that has come away: where it was before, say, with its velocity
reversed. Nothing can be read off it of where danger is, and dynamics that learn it predict half of a rebound for
whoever comes near. What was dangerous is where the body would have been. So where logs have impacts, dynamics are
learned from safe steps, and the logs are cut at unsafe ones: a piece ends where the dynamics say that the step would
have led, and the next begins where the log goes on. Of an unsafe step that is no impact the two are the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ringfence.logs.store import EpisodeStore
from ringfence.utils.precision import on_device
from ringfence.world.dynamics import Dynamics
from ringfence.world.logged import Logged
from ringfence.world.margins import entries

MOST = 60_000  # steps of agents that are looked at at once
USUAL = 0.999  # share of safe steps that change by no more than what is usual
BEYOND = 2.0  # times what is usual, from which on a change is an impact
SHARE = 0.15  # of the entries into danger that are impacts, or there are none: rough fits err at the ends of the logs
FEW = 10  # entries that are, likewise
LEAST = 100  # safe steps that tell what is usual
RIDGE = 1e-9  # of a mean square of 1: entries may say the same
SQUARES = 24  # numbers that products are read of, too


def count(logged: Logged, seed: int) -> int:
    """The unsafe steps in which somebody's own entries change as in no safe step from a like state by a like action; 0
    where they are no more of the entries into danger than chance makes."""
    unsafe = logged.unsafe
    if logged.map.joint or logged.map.shared_body or unsafe.all() or not unsafe.any():
        return 0
    rng = np.random.default_rng([seed, 11])
    at_once = max(MOST // logged.map.plus.shape[0], LEAST)
    safe = rng.permutation(np.flatnonzero(~unsafe))[:at_once]
    known, kept = np.split(safe, [len(safe) * 3 // 4])
    if len(kept) < LEAST:
        return 0
    usual = Usual.of(logged, known)
    most = np.quantile(usual.missed(logged, kept), USUAL, axis=0)  # (N, F)
    bad = np.flatnonzero(unsafe)
    jumps = np.zeros(len(unsafe), bool)
    for some in np.array_split(bad, -(-len(bad) // at_once)):
        beyond = usual.missed(logged, some) > BEYOND * most
        jumps[some] = (beyond & (most > 0)).any((1, 2))
    into = entries(logged, bad)
    return int(jumps.sum()) if jumps[into].sum() >= max(FEW, SHARE * len(into)) else 0


@dataclass(frozen=True, eq=False)
class Usual:
    """What own entries do in safe steps: a polynomial of own entries and action, for every agent."""

    own: np.ndarray  # (F,) entries
    mean: np.ndarray  # (N, F)
    scale: np.ndarray
    weights: np.ndarray  # (N, P, F)

    @classmethod
    def of(cls, logged: Logged, steps: np.ndarray) -> Usual:
        """By least squares over these steps."""
        own = np.arange(len(logged.map.names)) if logged.map.own is None else np.array(logged.map.own)
        before = logged.before(steps)[..., own].astype(np.float64)
        mean, scale = before.mean(0), before.std(0)
        blank = cls(own, mean, np.where(scale > 0, scale, 1.0), np.zeros(0))
        x, changed = blank._read(logged, steps)
        x, changed = np.moveaxis(x, 1, 0), np.moveaxis(changed, 1, 0)
        squares = np.swapaxes(x, 1, 2) @ x + RIDGE * len(steps) * np.eye(x.shape[-1])
        return replace(blank, weights=np.linalg.solve(squares, np.swapaxes(x, 1, 2) @ changed))

    def missed(self, logged: Logged, steps: np.ndarray) -> np.ndarray:
        """(W, N, F) by how much own entries change otherwise."""
        x, changed = self._read(logged, steps)
        return np.abs(changed - np.einsum("wnp,npf->wnf", x, self.weights))

    def _read(self, logged: Logged, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(W, N, P) what changes follow from, and (W, N, F) the changes."""
        whole = logged.before(steps).astype(np.float64)
        changed = logged.map.apart(logged.after(steps), whole)[..., self.own]
        before = whole[..., self.own]
        x = np.concatenate([(before - self.mean) / self.scale, logged.picked("actions", steps)], -1)
        parts = [np.ones((*x.shape[:2], 1)), x]
        if x.shape[-1] <= SQUARES:
            i, j = np.triu_indices(x.shape[-1])
            parts.append(x[..., i] * x[..., j])
        return np.concatenate(parts, -1), changed


def landed(logged: Logged, acts: Dynamics) -> Logged:
    """The same logs, cut at unsafe steps, where pieces end as the dynamics predict."""
    store = logged.store
    team = store.card.team or 1  # agents of one team are cut at once
    cut = np.tile(logged.unsafe.reshape(team, -1).any(0), team)
    pieces = _pieces(store, cut)
    parent = store.episode_of_step[pieces.episode_ends - 1]
    again = Logged.of(pieces, logged.map, logged.held_out[parent], logged.labels)
    steps = np.flatnonzero(cut)
    features = np.array(again.arrays["features"])
    features[again.picked("row", steps) + 1] = logged.predicted(acts, steps)
    return replace(again, arrays=again.arrays | {"features": on_device(features)})


def _pieces(store: EpisodeStore, cut: np.ndarray) -> EpisodeStore:
    """The episodes, which end after these steps (T,), too; the row after such a step is the first of what follows."""
    ends = np.union1d(store.episode_ends, np.flatnonzero(cut) + 1)
    inner = np.setdiff1d(ends, store.episode_ends) - 1  # steps
    row = inner + store.episode_of_step[inner] + 1
    order = np.sort(np.concatenate([np.arange(len(store.observations)), row]))
    truncated = store.truncated.copy()
    truncated[inner] = True
    return replace(
        store,
        observations=store.observations[order],
        state=None if store.state is None else store.state[order],
        truncated=truncated,
        episode_ends=ends,
    )
