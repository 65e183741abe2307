"""The rows that every table needs: the behaviour data itself and its safe part, doing nothing, acting at random."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ringfence.datasets.task import Task
from ringfence.evaluation.protocol import PROTOCOL, complete, evaluate_policy, of_constraint, summarise, unsafe_starts
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.problem.homogeneous import PerAgent
from ringfence.proposals.base import Constant
from ringfence.training.runs import Run, write_json
from ringfence.types import Policy
from ringfence.utils import schemas

FILE = "reference.json"
LOGS = "behaviour data"
SAFE = "data within the limit"


def read(file: Path) -> dict[str, dict[str, Any]]:
    """The reference rows of a file by name."""
    damaged = "holds a damaged reference file; delete it and make it again"
    return {name: dict(row) for name, row in schemas.read(file, schemas.References, damaged).items()}


def of_data(store: EpisodeStore, task: Task, kept: np.ndarray | None = None) -> dict[str, Any]:
    """The protocol's numbers of the logged episodes themselves (their own resets, not the test resets), or of those
    that `kept` (E,) names."""
    if kept is None:
        kept = np.ones(store.episodes, bool)
    # Logged episodes as `rollout` gives played ones: rewards and costs (E, L), 0 after an episode's end.
    there = np.arange(int(store.lengths.max())) < store.lengths[:, None]
    rewards = np.zeros(there.shape)
    rewards[there] = store.rewards.mean(1)
    costs = np.zeros(there.shape)
    costs[there] = store.team_costs
    played = {"rewards": rewards, "costs": costs, "steps": store.lengths, "terminated": store.episode_terminated}
    unsafe = np.zeros(store.episodes, bool)
    if store.state is not None and task.env is not None:  # a simulator says which starts are unsafe
        first = np.concatenate([[0], store.episode_ends[:-1]]) + np.arange(store.episodes)
        unsafe = unsafe_starts(task, store.state[first])
    result = summarise({name: array[kept] for name, array in played.items()}, task, unsafe[kept])
    del result["per_episode"]  # up to 40 000 episodes: the summary is enough
    return result | {"protocol": PROTOCOL, "task": task.name, "split": "data"}


def of_run(run: Run, constants: dict[str, Any]) -> dict[str, Any] | None:
    """The same of the logs that a run was trained on, as it kept them; None where it did not."""
    logs = run.logs
    if logs is None:
        return None
    task = Task(run.config["task"], None, constraints.CostColumn(), **constants)
    played = {
        "rewards": np.array(logs["returns"])[:, None],
        "costs": np.array(logs["costs"])[:, None],
        "steps": np.array(logs["steps"]),
        "terminated": np.array(logs["terminated"]),
    }
    result = summarise(played, task, np.zeros(len(logs["returns"]), bool))
    del result["per_episode"]
    limits = run.config["data"].get("constraints") or {}
    if logs["constraints"]:
        result["constraints"] = {k: of_constraint(np.array(c), limits.get(k)) for k, c in logs["constraints"].items()}
    return result | {"split": "data"}


def there(task: Task, out: str | Path, episodes: int, transitions: int | None = None) -> bool:
    """Whether complete reference rows of a data set of that size under the task's danger are there, and of as many
    episodes."""
    file = Path(out) / task.name / FILE
    if not file.exists():
        return False
    rows = read(file)
    if not _are_complete(rows, task, episodes):
        return False
    card = rows.get(LOGS, {}).get("data", {})
    if card.get("hazard") != constraints.to_dict(task.hazard):
        return False
    wanted = task.transitions if transitions is None else transitions
    # A card without the size that was asked for tells that of its whole episodes.
    return card.get("size") == wanted or ("size" not in card and wanted <= card.get("transitions", 0) < 1.01 * wanted)


def _are_complete(rows: dict[str, dict[str, Any]], task: Task, episodes: int) -> bool:
    """Whether rows say all that the protocol asks for, and of as many episodes."""
    return rows.get("do-nothing", {}).get("episodes") == episodes and all(complete(r, task) for r in rows.values())


def make(
    task: Task, store: EpisodeStore, out: str | Path, episodes: int = 200, quiet: bool = True
) -> dict[str, dict[str, Any]]:
    """Reference rows of a task, kept in `out`/<task>/reference.json and reused for the same number of episodes.

    The data's safe part is made of the episodes within the cost limit that did not end early: one that falls over at
    once costs nothing, too. Where there is none, its row is missing.
    """
    file = Path(out) / task.name / FILE
    safe = (store.episode_costs <= task.cost_limit) & ~store.episode_terminated
    if file.exists():
        known = read(file)
        same = (SAFE in known) == safe.any() and _are_complete(known, task, episodes)
        if same and known[LOGS]["data"] == store.card.to_dict():
            return known
    rows = {LOGS: of_data(store, task) | {"data": store.card.to_dict()}}
    if safe.any():
        rows[SAFE] = of_data(store, task, safe)
    # Doing nothing, acting at random, and the references of the task's own recipe.
    spec = task.spec(task.feature_map("pruned"))
    policies: dict[str, Policy] = {"do-nothing": Constant(spec), "random actions": Constant(spec, random=True)}
    if task.homogeneous:
        policies = {name: PerAgent(policy, task.simulator.n_agents) for name, policy in policies.items()}
    if task.recipe is not None:
        policies |= task.recipe.references(task)
    for name, policy in policies.items():
        rows[name], _ = evaluate_policy(policy, task, episodes, label=name, quiet=quiet)
    write_json(file, rows)
    return rows
