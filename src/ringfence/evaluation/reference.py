"""The rows that every table needs: the behaviour data itself and its safe part, doing nothing, acting at random."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ringfence.datasets.task import Task
from ringfence.evaluation.protocol import PROTOCOL, complete, evaluate_policy, summarise, unsafe_starts
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.problem.homogeneous import Each
from ringfence.proposals.base import Constant
from ringfence.training.runs import write_json
from ringfence.utils import schemas, stored

FILE = "reference.json"
SAFE = "data within the limit"


def read(file: Path) -> dict[str, dict[str, Any]]:
    """The reference rows of a file by name, under today's names."""
    damaged = "holds a damaged reference file; delete it and make it again"
    return stored.results(schemas.read(file, schemas.References, damaged))


def of_data(store: EpisodeStore, task: Task, kept: np.ndarray | None = None) -> dict:
    """The protocol's numbers of the logged episodes themselves (their own resets, not the test resets), or of those
    that `kept` (E,) names."""
    length = int(store.lengths.max())
    pad = np.arange(length) < store.lengths[:, None]
    rewards, costs = np.zeros(pad.shape), np.zeros(pad.shape)
    rewards[pad], costs[pad] = store.rewards.mean(1), store.team_costs
    if store.state is not None and task.env is not None:
        first = np.concatenate([[0], store.episode_ends[:-1]]) + np.arange(store.episodes)
        starts = unsafe_starts(task, store.state[first])
    else:
        starts = np.zeros(store.episodes, bool)
    kept = np.ones(store.episodes, bool) if kept is None else kept
    told = {"rewards": rewards, "costs": costs, "steps": store.lengths, "terminated": store.episode_terminated}
    result = summarise({k: v[kept] for k, v in told.items()}, task, starts[kept])
    del result["per_episode"]  # up to 40 000 episodes: the summary is enough
    return result | {"protocol": PROTOCOL, "task": task.name, "split": "data"}


def there(task: Task, out: str | Path, episodes: int, transitions: int | None = None) -> bool:
    """Whether complete reference rows of a data set of that size under the task's danger are there, and of as many
    episodes."""
    file = Path(out) / task.name / FILE
    if not file.exists():
        return False
    known = read(file)
    if not all(complete(r, task) for r in known.values()):
        return False
    card = known.get("behaviour data", {}).get("data", {})
    if known.get("do-nothing", {}).get("episodes") != episodes or card.get("hazard") != constraints.to_dict(
        task.hazard
    ):
        return False
    wanted = task.transitions if transitions is None else transitions
    # A card without the size that was asked for tells that of its whole episodes.
    return card.get("size") == wanted or ("size" not in card and wanted <= card.get("transitions", 0) < 1.01 * wanted)


def make(task: Task, store: EpisodeStore, out: str | Path, episodes: int = 200, quiet: bool = True) -> dict[str, dict]:
    """Reference rows of a task, kept in `out`/<task>/reference.json and reused for the same number of episodes.

    The data's safe part is made of the episodes within the cost limit that did not end early: one that falls over at
    once costs nothing, too. Where there is none, its row is missing.
    """
    file = Path(out) / task.name / FILE
    safe = (store.episode_costs <= task.cost_limit) & ~store.episode_terminated
    if file.exists():
        known = read(file)
        same = known.get("do-nothing", {}).get("episodes") == episodes and (SAFE in known) == safe.any()
        if same and all(complete(r, task) for r in known.values()) and known["behaviour data"]["data"] == store.card:
            return known
    spec = task.spec(task.feature_map("pruned"))
    policies = {"do-nothing": Constant(spec), "random actions": Constant(spec, random=True)}
    if task.alike:
        policies = {name: Each(policy, task.env.n_agents) for name, policy in policies.items()}
    policies |= task.recipe.references(task) if task.recipe is not None else {}
    rows = {"behaviour data": of_data(store, task) | {"data": store.card}}
    if safe.any():
        rows[SAFE] = of_data(store, task, safe)
    for name, policy in policies.items():
        rows[name], _ = evaluate_policy(policy, task, episodes, label=name, quiet=quiet)
    write_json(file, rows)
    return rows
