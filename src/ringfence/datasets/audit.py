"""What is in a store, and what should worry its user."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ringfence.datasets import registry
from ringfence.datasets.task import Task
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.problem.homogeneous import look

APART = 0.2  # of the steps: a robot's mean speed over a step and that at its end differ on up to 13 %
COARSE = 0.01  # of an entry's deviation: the distance of neighbouring numbers above which it is told coarsely


class Audit(NamedTuple):
    facts: dict[str, str]
    warnings: list[str]
    notes: list[str]  # what the import found and lost

    def __str__(self) -> str:
        lines = [f"{name}: {value}" for name, value in self.facts.items()]
        return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings), *(f"note: {n}" for n in self.notes)])


def audit(store: EpisodeStore) -> Audit:
    """Sizes, returns, cost, share of episodes that start unsafe, and warnings in plain words."""
    s, card = store, store.card
    returns, costs, lengths = s.returns, s.episode_costs, s.lengths
    rate = float((s.team_costs > 0).mean())
    facts = {
        "task": str(card["task"]),
        "provenance": str(card["provenance"]),
        "collected": str(card.get("collected", "not said")),
        "episodes": f"{s.episodes:,}",
        "steps": f"{s.steps:,}",
        "episode length": f"{lengths.min()} to {lengths.max()}" if np.ptp(lengths) else str(lengths[0]),
        **({"step": f"{card['dt']:g} s"} if "dt" in card else {}),
        "agents": str(s.n_agents),
        "observation, action": f"{s.observations.shape[2]}, {s.actions.shape[2]} per agent",
        "global state": "none" if s.state is None else f"{s.state.shape[1]} entries",
        "hazard": str(s.hazard),
        "return": f"{returns.mean():.2f} ± {returns.std():.2f}, from {returns.min():.2f} to {returns.max():.2f}",
        "cost per episode": f"{costs.mean():.3f} ± {costs.std():.3f}, at most {costs.max():g}",
        **{f"constraint {name}": _of_constraint(s, name) for name in s.limits},
        "steps with cost": f"{100 * rate:.2f} %",
        "episodes with cost": f"{100 * (costs > 0).mean():.2f} %",
        "actions": f"from {s.actions.min():.3f} to {s.actions.max():.3f}, bounds {card['action_low']:g} to "
        f"{card['action_high']:g}",
        "ended by": f"{int(s.terminated.sum()):,} terminations, {int(s.truncated.sum()):,} truncations",
    }
    if "speed_quantiles" in card:
        spread = ", ".join(f"{100 * float(q):g} %: {v:.2f}" for q, v in card["speed_quantiles"].items())
        limit = f"{card['speed_limit']:g} m/s" + (f" ({card['protocol']})" if "protocol" in card else "")
        facts["speed limit"] = f"{limit}; at most {card['cost_limit']:g} steps of an episode may be above it"
        facts["speed, quantiles"] = f"{spread} m/s"
        facts["return ceiling"] = f"{card['return_ceiling']:.0f} within the limit, unless faster than all this data"
    warnings = []
    first = np.concatenate([[0], s.episode_ends[:-1]]) + np.arange(s.episodes)
    try:
        task = registry.from_store(s)
    except UserError as error:
        warnings.append(f"Nothing can be trained on this: {error}")
        task = None
    starts, apart = (None, None) if task is None else (_labels(s, task, first), disagreement(s, task))
    if starts is not None:
        facts["episodes starting unsafe"] = f"{100 * starts.mean():.2f} %"
        facts["cost and hazard disagree"] = f"{100 * apart:.2f} % of steps"
        if apart > APART:
            warnings.append(
                f"Costs are not what the hazard says of {100 * apart:.0f} % of the steps: barriers learn from the "
                "hazard, tables count costs; make one follow from the other."
            )
        if starts.any():
            warnings.append(
                f"{100 * starts.mean():.1f} % of episodes start unsafe: their first cost says nothing about a policy; "
                "read the avoidable cost."
            )
    if rate == 0:
        warnings.append("No step has a cost: a barrier can learn danger only from the hazard's formula.")
    elif rate < 0.01:
        warnings.append(f"Only {100 * rate:.2f} % of steps have a cost: labels of danger are scarce.")
    elif rate > 0.99:
        warnings.append(f"{100 * rate:.1f} % of steps have a cost: almost nothing in this data is safe.")
    flat = s.observations.reshape(-1, s.observations.shape[2])
    some = s.observations[:: max(1, len(s.observations) // 100_000)]
    constant = np.flatnonzero(np.ptp(some, axis=0).max(0) < 1e-9)  # for no agent
    if len(constant):
        warnings.append(f"Observation entries {', '.join(map(str, constant))} never vary; views leave them out.")
    spread, far = flat.std(0, dtype=np.float64), np.spacing(np.abs(flat).max(0).astype(np.float32))
    coarse = np.flatnonzero((spread > 0) & (far > COARSE * spread))
    if len(coarse):
        warnings.append(
            f"Observation entries {', '.join(map(str, coarse))} are so far from 0 that single precision tells their "
            "values apart poorly; subtract an origin before making the store."
        )
    if s.terminated.any() and not s.truncated.any() and np.ptp(lengths) == 0:
        warnings.append("All episodes terminate at the same length: these are probably time limits (truncated).")
    return Audit(facts, warnings, list(card.get("warnings", [])))


def _of_constraint(store: EpisodeStore, name: str) -> str:
    costs, limit = store.episode_costs_of(name), store.limits[name]
    within = f"{100 * (costs <= limit).mean():.1f} % of episodes are within {limit:g}"
    return f"{costs.mean():.3f} per episode, at most {costs.max():g}; {within}"


def _labels(store: EpisodeStore, task: Task, rows: np.ndarray) -> np.ndarray | None:
    """(K,) whether the hazard's formula calls these rows unsafe for anyone; None where it has none."""
    try:
        view = task.feature_map("pruned" if store.state is not None else "decentralized", store)
        bound = constraints.bind(task.hazard, view.names, view.plus.shape[0])
    except UserError:
        return None
    if not bound.has_formula:
        return None
    state, seen = None if store.state is None else store.state[rows], store.observations[rows]
    return np.asarray(bound.labels(look(view, task.alike, seen, state))[0]).reshape(len(rows), -1).any(-1)


def disagreement(store: EpisodeStore, task: Task) -> float | None:
    """Share of steps (at most a hundred thousand, evenly spread) whose cost is not what the formula says of the state
    that they end in."""
    steps = np.unique(np.linspace(0, store.steps - 1, 100_000).astype(int))
    episode = np.searchsorted(store.episode_ends, steps, side="right")
    labels = _labels(store, task, steps + episode + 1)
    return None if labels is None else float((labels != (store.team_costs[steps] > 0)).mean())
