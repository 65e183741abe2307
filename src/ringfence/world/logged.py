"""Logs as fits and validation read them: arrays on the device, labels of danger, and which episodes are held out."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData, returns_to_go
from ringfence.problem.constraints import BoundHazard
from ringfence.problem.features import FeatureMap
from ringfence.types import Array
from ringfence.utils.precision import on_device
from ringfence.world.dynamics import Dynamics
from ringfence.world.settings import Settings

HELD_OUT = 0.1  # of the episodes, whole ones
MOST_HELD_OUT = 0.3  # of the dangerous ones, where they are few
ENOUGH = 30  # dangerous episodes that say something
FEWEST = 5  # episodes that can be divided
CLOSE = 20  # steps before danger that its value is learned from most
AT_ONCE = 50_000  # steps whose ends are predicted at once
LABELLED = 100_000  # states that a formula labels at once


@dataclass(frozen=True, eq=False)
class Logged:
    """A data set: T steps of E episodes, M = T + E rows of states."""

    store: EpisodeStore
    map: FeatureMap
    held_out: np.ndarray  # (E,) bool
    labels: dict[str, np.ndarray]  # (T,) or (T, N) bool: unsafe, by constraint; "" where danger is one
    arrays: dict[str, Array]  # of WindowData

    @classmethod
    def of(cls, store: EpisodeStore, map: FeatureMap, held_out: np.ndarray, labels: dict[str, np.ndarray]) -> Logged:
        return cls(store, map, held_out, labels, WindowData(store, map).arrays)

    def by(self, name: str) -> Logged:
        """The same with the labels of one constraint."""
        return replace(self, labels={name: self.labels[name]})

    @property
    def several(self) -> bool:
        """Whether the logs name constraints."""
        return bool(self.labels) and "" not in self.labels

    @functools.cached_property
    def label(self) -> np.ndarray:
        """(T,) or (T, N) bool: unsafe by any constraint."""
        return np.logical_or.reduce(list(self.labels.values()))

    @functools.cached_property
    def unsafe(self) -> np.ndarray:
        """(T,) bool: unsafe for anybody."""
        return unsafe_of(self.labels)

    @functools.cached_property
    def fitted_steps(self) -> np.ndarray:
        """(F,) the steps that are learned from."""
        return np.flatnonzero(~self.held_out[self.store.episode_of_step])

    @functools.cached_property
    def held_steps(self) -> np.ndarray:
        """(T − F,) the others."""
        return np.flatnonzero(self.held_out[self.store.episode_of_step])

    @property
    def longest(self) -> int:
        """Rows of the longest episode."""
        return int(self.store.lengths.max()) + 1

    def picked(self, name: str, index: np.ndarray) -> np.ndarray:
        """Entries of an array, picked on the host: JAX compiles a program for every shape that it picks."""
        return np.asarray(self.arrays[name])[index]

    def before(self, steps: np.ndarray) -> np.ndarray:
        """(W, N, D) the states before steps."""
        return self.picked("features", self.picked("row", steps))

    def after(self, steps: np.ndarray) -> np.ndarray:
        """(W, N, D) the states after steps."""
        return self.picked("features", self.picked("row", steps) + 1)

    def predicted(self, dynamics: Dynamics, steps: np.ndarray | None = None) -> Array:
        """(W, N, D) where the actions of steps, of all by default, are predicted to lead."""
        parts = []
        steps = np.arange(self.store.steps) if steps is None else steps
        for start in range(0, len(steps), AT_ONCE):
            some = steps[start : start + AT_ONCE]
            parts.append(_after(dynamics, self.before(some), self.picked("actions", some)))
        return jnp.concatenate(parts)

    def close_to_danger(self) -> np.ndarray:
        """(T,) bool: within CLOSE steps before danger, or in it."""
        found = self.unsafe.copy()
        episode = self.store.episode_of_step
        for k in range(1, min(CLOSE, len(found))):
            found[:-k] |= self.unsafe[k:] & (episode[k:] == episode[:-k])
        return found

    def returns_to_go(self, discount: float, each: bool = False) -> Array:
        """(T,) return-to-go of the team, or (T, N) of each agent."""
        rewards = self.store.rewards if each else self.store.rewards.mean(1)
        return on_device(returns_to_go(rewards, self.store.lengths, discount), np.float32)


@jax.jit
def _after(dynamics: Dynamics, before: Array, action: Array) -> Array:
    return dynamics.step(before, action)[0]


def unsafe_of(labels: dict[str, np.ndarray]) -> np.ndarray:
    """(T,) bool: unsafe for anybody by any of the constraints."""
    each = [label if label.ndim == 1 else np.logical_or.reduce(label, 1) for label in labels.values()]
    return np.logical_or.reduce(each)


def held_out(store: EpisodeStore, seed: int, unsafe: np.ndarray | None = None) -> np.ndarray:
    """(E,) bool: the episodes that no part of a World of this seed learns from. Of those with danger, by the `unsafe`
    steps (T,), the same share, or more where they are few: what is known of danger is what these say."""
    if store.episodes < FEWEST:
        raise UserError(
            f"'{store.card.task}' has {store.episodes} episodes, too few to hold some out; a World needs {FEWEST} "
            "or more: cut long recordings into episodes."
        )
    team = store.card.team or 1  # agents of one team are held out together
    episodes = store.episodes // team
    out = np.zeros(episodes, bool)
    rng = np.random.default_rng([seed, 77])
    dangerous = np.zeros(episodes, bool) if unsafe is None else _dangerous(store, unsafe, team)
    for some, least in ((np.flatnonzero(~dangerous), 1), (np.flatnonzero(dangerous), ENOUGH)):
        if len(some):
            count = max(round(HELD_OUT * len(some)), min(least, round(MOST_HELD_OUT * len(some))))
            out[rng.choice(some, max(count, int(not dangerous.any())), replace=False)] = True
    if not out.any():
        out[rng.integers(episodes)] = True
    return np.tile(out, team)


def _dangerous(store: EpisodeStore, unsafe: np.ndarray, team: int) -> np.ndarray:
    """(E,) bool: the episodes in which anybody was in danger."""
    found = np.zeros(store.episodes, bool)
    found[store.episode_of_step[unsafe]] = True
    return np.logical_or.reduce(found.reshape(team, -1), 0)


def labels_of(
    store: EpisodeStore, map: FeatureMap, settings: Settings, hazard: BoundHazard | None
) -> dict[str, np.ndarray]:
    """(T,) or (T, N) bool: the steps that are unsafe, by each constraint that the store names, or under the name "" by
    costs or by the formula of the states that they lead to."""
    source = "the costs"
    if settings.labels == "formula":
        source = "the formula's labels"
        labels = {"": _by_formula(store, map, hazard)}
    elif store.limits:
        labels = {name: store.of_constraint(name) > 0 for name in store.limits}
    else:
        labels = {"": store.costs > 0}
    for name, unsafe in labels.items():
        _refuse_one_class(store.card.task, name, unsafe, source)
    return labels


def _by_formula(store: EpisodeStore, map: FeatureMap, hazard: BoundHazard | None) -> np.ndarray:
    if hazard is None or not hazard.has_formula:
        raise UserError(
            f"labels='formula' needs a formula of danger, which '{store.card.task}' has not; take labels='costs', "
            "or give its card a hazard."
        )
    after = np.arange(store.steps) + store.episode_of_step + 1
    x = map(store.observations, store.state)
    unsafe = jax.jit(lambda x: hazard.labels(x)[0])
    found = [np.asarray(unsafe(x[after[k : k + LABELLED]])) for k in range(0, len(after), LABELLED)]
    return np.concatenate(found)


def _refuse_one_class(task: str, name: str, unsafe: np.ndarray, source: str) -> None:
    """Labels of which all are alike teach nothing."""
    share = unsafe.mean()
    if 0 < share < 1:
        return
    of = f" by '{name}'" if name else ""
    lacking, kind = ("unsafe", "0") if share == 0 else ("safe", "above 0")
    remedy = "leave that constraint out." if name else "fit with barrier=False."
    raise UserError(
        f"No step of '{task}' is {lacking}{of}: {source} are {kind} everywhere, so nothing tells a barrier what danger "
        f"is; give costs that are 0 on safe steps and above 0 on unsafe ones, or {remedy}"
    )
