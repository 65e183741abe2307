"""The proving ground's data sets: scripted drivers, each agent of each episode with habits of its own."""

from __future__ import annotations

import dataclasses
from functools import partial

import equinox as eqx
import jax

from ringfence.datasets.behaviour import gather, logged
from ringfence.datasets.recipes import COLLECTION, RECIPES
from ringfence.datasets.task import Card, Recipe, Task
from ringfence.envs.proving import System, drivers
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.types import Array, Key, Policy, PolicyStep, PyTree

BATCH = 500  # episodes that are played at once
EPISODES = 3000  # of a full data set


def about(task: Task) -> Card:
    """The simulator, for the card: every size of the system, so that data of another one are made again."""
    system = _system(task)
    changed = {
        f.name: getattr(system, f.name)
        for f in dataclasses.fields(system)
        if getattr(system, f.name) != f.default or f.name in ("body", "danger", "drivers")
    }
    words = ", ".join(f"{name} {value}" for name, value in changed.items())
    return {"simulator": f"ringfence {RECIPES} proving ground, {words}", "dt": system.dt}


class Driven(eqx.Module):
    """A driver as a policy: it reads the state, which tells where everybody is."""

    system: System = eqx.field(static=True)
    habit: drivers.Habit = eqx.field(static=True)

    def initial_state(self, batch: int) -> PyTree:
        return {}

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        if state is None:
            raise UserError("The scripted drivers read the global state; pass it.")
        now = self.system.from_global_state(state)
        return carry, PolicyStep(drivers.drive(self.system, now, self.habit, key), {})


class Naive(eqx.Module):
    """Straight to the goal at full speed, by what an agent observes."""

    system: System = eqx.field(static=True)

    def initial_state(self, batch: int) -> PyTree:
        return {}

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        return carry, PolicyStep(drivers.naive(self.system, observations), {})


def references(task: Task) -> dict[str, Policy]:
    """Who shows that the task can be solved."""
    system = _system(task)
    return {"expert driver": Driven(system, drivers.EXPERT)}


def collect(task: Task, transitions: int, seed: int, card: Card) -> EpisodeStore:
    """The data set of a system."""
    system = _system(task)
    key = jax.random.fold_in(jax.random.key(COLLECTION), seed)

    def chunk(number: int) -> dict[str, Array]:
        return _played(system, jax.random.fold_in(key, number * BATCH), BATCH)

    episodes = gather(chunk, transitions // system.episode_length, BATCH)
    more = {
        "transitions": transitions,
        "collected": f"{system.drivers} scripted drivers",
        "observation_names": list(system.observation_names),
    }
    return EpisodeStore.from_episodes(
        **episodes,
        card=card | more,
    )


@partial(jax.jit, static_argnums=(0, 2))
def _played(system: System, key: Key, batch: int) -> dict[str, Array]:
    """Arrays (B, L, ...) of a batch of episodes."""
    return logged(system, *system.played(key, batch))


def _system(task: Task) -> System:
    assert isinstance(task.env, System), "only tasks of the proving ground name this recipe"
    return task.env


RECIPE = Recipe(about=about, collect=collect, references=references)
