"""One algorithm on one task: everything that defines a run but its seed."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from ringfence import algos
from ringfence.datasets.audit import DISAGREE, disagreement
from ringfence.datasets.task import Task
from ringfence.errors import UserError, one_of
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints, features
from ringfence.problem.origins import NOWHERE, Origins
from ringfence.training import worlds
from ringfence.types import Algorithm, Spec


@dataclass(frozen=True)
class Job:
    """One algorithm on one task: everything that defines a run but its seed."""

    algorithm: Algorithm
    preset: str
    config: Any
    task: Task
    spec: Spec
    feature_map: Any
    hazard: constraints.BoundHazard
    widths: tuple[int | None, int | None] = (None, None)  # entries of an observation and of the state, where known
    world: dict | None = None  # settings of the World that training reads, if it reads one
    team: int = 1  # agents who play; more than the spec's one where they are homogeneous
    origins: Origins = NOWHERE  # of the data, which are taken from what is given at run time

    @property
    def reads_world(self) -> bool:
        """Whether training reads a World."""
        return self.algorithm.world_settings(self.config) is not None

    def describe(self, seed: int, card: dict) -> dict:
        """What config.json holds."""
        return {
            "algorithm": self.algorithm.name,
            "revision": self.algorithm.revision,
            "preset": self.preset,
            "config": dataclasses.asdict(self.config),
            "task": self.task.name,
            "spec": self.spec.to_dict(),
            "hazard": constraints.to_dict(self.hazard.hazard),
            "feature_map": None if self.task.env is not None else features.to_dict(self.feature_map),
            "widths": None if self.task.env is not None else list(self.widths),
            # of the logs' episodes, by which returns of anybody's own data are normalised
            "returns": None if self.task.env is not None else [self.task.return_min, self.task.return_max],
            "world": self.world,
            "team": self.team,
            "seed": seed,
            "data": card,
        }


def make_job(
    algorithm: str,
    task: Task,
    preset: str | None,
    changes: dict,
    store: EpisodeStore | None = None,
    world: dict | None = None,
) -> Job:
    """Resolve names to values; every bad name or value is refused here, before work starts. Without a preset, that of
    the task's data tier is taken where there is one. `store`: the task's `logs`; `world`: changes to the settings of
    the World."""
    a = algos.get(algorithm)
    preset = preset or a.preset_for(task.presets)
    one_of(f"preset of {a.name}", preset, a.presets)
    limits: dict[str, float] = {}
    if task.env is None and store is not None and a.limit is not None and store.card.cost_limit is not None:
        limits[a.limit] = float(store.card.cost_limit)
    config = algos.configured(a, preset, {**limits, **changes})
    wanted = a.world_settings(config)
    feature_map = task.feature_map(config.view, store, team=wanted is not None)  # who reads a World, sees as it does
    spec = task.spec(feature_map, store)
    cost_source = a.cost_source(config)
    hazard = _bound(task, spec, cost_source, config.view, store)
    a.check(config, hazard)
    if store is not None and cost_source != "nothing" and not store.costs.any():
        _refuse_blank_costs(a.name, task, store, cost_source)
    settings = None
    if wanted is not None and store is not None:
        asked = {**wanted, **(world or {})}
        settings = dataclasses.asdict(worlds.settings_for(task, worlds.costs_tell(store), **asked))
    elif world:
        raise UserError(f"{a.name} reads no World in training; leave world= out.")
    team = spec.n_agents if store is None else store.card.team or store.n_agents
    team = team if task.env is None else task.env.n_agents
    origins = NOWHERE if store is None else store.card.origins
    return Job(a, preset, config, task, spec, feature_map, hazard, widths_of(task, store), settings, team, origins)


def widths_of(task: Task, store: EpisodeStore | None = None) -> tuple[int | None, int | None]:
    """How many entries an observation and the global state have (0: there is none, or nobody reads it): the
    simulator's, or the data's."""
    if task.env is not None:
        return task.env.observation_dim, 0 if task.homogeneous else len(task.env.state_names)
    if store is None:
        return None, None
    return store.observations.shape[2], 0 if store.state is None else store.state.shape[1]


def _bound(task: Task, spec: Spec, cost_source: str, view: str, store: EpisodeStore | None) -> constraints.BoundHazard:
    """The hazard as the algorithm's own view tells it. Where that view lacks what the formula is about (positions that
    only the global state holds), those who label no states train all the same, with the costs for danger."""
    try:
        return constraints.bind(task.hazard, spec.feature_names, spec.n_agents)
    except UserError:
        if cost_source not in ("labels", "world"):
            return constraints.bind(constraints.CostColumn(), spec.feature_names, spec.n_agents)
        if view != "pruned" and store is not None:
            names = task.feature_map("pruned", store).names
            if constraints.bind_or_none(task.hazard, names, store.n_agents) is not None:
                raise UserError(
                    f"The view '{view}' leaves out what the hazard {type(task.hazard).__name__} reads; set view=pruned."
                ) from None
        raise


def _refuse_blank_costs(algorithm: str, task: Task, store: EpisodeStore, cost_source: str) -> None:
    """Refuse costs that were never filled in to who would call every step safe: those who learn from them alone, and
    everybody where no formula says more."""
    if isinstance(task.hazard, constraints.CostColumn):
        raise UserError(
            f"{algorithm} has no danger to learn: the costs of '{task.name}' are 0 everywhere, and its card has no "
            "hazard with a formula; give EpisodeStore one of them, or train an algorithm that reads none."
        )
    if cost_source in ("labels", "world"):  # a World's barrier learns from the formula then
        return
    unsafe = disagreement(store, task) or 0.0  # with costs of 0, that is the share that the formula calls unsafe
    if unsafe > (DISAGREE if isinstance(task.hazard, constraints.SpeedLimit) else 0.0):
        raise UserError(
            f"{algorithm} knows danger by costs alone, which in '{task.name}' are 0 everywhere, but the hazard calls "
            f"{100 * unsafe:.3g} % of its states unsafe; give costs to EpisodeStore, e.g. 1 where the hazard's labels "
            "say unsafe."
        )
