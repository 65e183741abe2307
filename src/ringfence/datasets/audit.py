"""What is in a store, and what should worry its user."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ringfence.datasets import registry
from ringfence.datasets.task import Task
from ringfence.errors import SHOWN, UserError
from ringfence.logs.late import late_actions
from ringfence.logs.resolution import coarse
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.problem.entries import Entries, Entry
from ringfence.problem.features import FeatureMap
from ringfence.problem.homogeneous import local_features
from ringfence.types import has_entry

Formula = tuple[FeatureMap, constraints.BoundHazard]
DISAGREE = 0.2  # of the steps: a robot's mean speed over a step and that at its end differ on up to 13 %
NEAR = 0.75  # how alike two names are, of difflib's ratio: `othr0` and `other0` 0.91, `goal` and `own` 0.29
LONGEST = 60  # letters of a name that are
MOST = 200  # names that are compared: each with each
DIGITS = "0123456789"
FIELDS = 12  # names, and bodies, that a line lists
ROLES = {
    "place": "place",
    "velocity": "velocity",
    "offset": "from one's own place",
    "drift": "velocity less one's own",
    "number": "number",
}
TWINS = {"x": "y", "y": "x"}  # the last letter of what is told along each axis


class Audit(NamedTuple):
    facts: dict[str, str]
    warnings: list[str]
    notes: list[str]  # what the import found and lost

    def __str__(self) -> str:
        lines = [f"{name}: {value}" for name, value in self.facts.items()]
        return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings), *(f"note: {n}" for n in self.notes)])


def audit(store: EpisodeStore) -> Audit:
    """Sizes, returns, cost, share of episodes that start unsafe, and warnings in plain words."""
    facts = _sizes(store) | {"entries are read as": read_as(store.card.observation_names or ())}
    facts |= _outcomes(store) | _speeds(store)
    try:
        task = registry.from_store(store)
    except UserError as error:
        warnings = [f"Nothing can be trained on this: {error}"]
    else:
        danger, warnings = _danger(store, task)
        facts |= danger
    warnings += [
        *odd_costs(store),
        *odd_names(store),
        *odd_actions(store),
        *late_actions(store),
        *_odd_observations(store),
        *coarse(store),
        *_odd_ends(store),
    ]
    return Audit(facts, warnings, list(store.card.warnings))


def odd_danger(store: EpisodeStore, task: Task) -> list[str]:
    """What a World of these logs would not know of danger, before it is fitted: names that nobody reads, odd
    actions, a formula that cannot be read, no danger at all."""
    told = store.team_costs.any() or not isinstance(task.hazard, constraints.CostColumn)
    untold = [] if told else ["No step has a cost and the card has no formula: no guard can use this World."]
    return [*odd_names(store), *odd_actions(store), *late_actions(store), *_unread(store, task), *untold]


def odd_names(store: EpisodeStore) -> list[str]:
    """Warnings of names that look misspelt."""
    card = store.card
    return [*slips(card.observation_names or ()), *slips(card.state_names or ())]


def read_as(names: Sequence[str]) -> str:
    """What the names of observations' entries say: of whom each is, and in which role (docs/import.md)."""
    entries = Entries.of(names)
    bodies: dict[str, dict[str, list[Entry]]] = {}
    for entry in entries.each:
        fields = bodies.setdefault(entry.whose, {}).setdefault(entry.what, [])
        fields.append(entry)
    found = []
    for whose, fields in bodies.items():
        roles: dict[str, list[str]] = {}
        for what, of_each in fields.items():
            heading = whose == "own" and of_each[0].source in entries.direction
            roles.setdefault("heading" if heading else ROLES[of_each[0].role], []).append(what)
        count = len({entry.order for of_each in fields.values() for entry in of_each})
        who = {"own": "oneself"}.get(whose, whose) if count == 1 else f"each of {count} {whose}"
        found.append(f"{who}: " + ", ".join(f"{role} {' '.join(each[:FIELDS])}" for role, each in roles.items()))
    unread = len(names) - len(entries.each)
    if unread or not names:
        found.append(f"{unread} whose names say nothing" if names else "no names")
    return "; ".join(found[:FIELDS])


def _unread(store: EpisodeStore, task: Task) -> list[str]:
    """A warning where somebody's card has a formula of danger that cannot be read."""
    if task.env is not None or isinstance(task.hazard, constraints.CostColumn):  # its own formula, or none
        return []
    try:
        _bound(store, task)
    except UserError as error:
        return [f"The card's formula of danger is left aside, and costs alone say what is dangerous. {error}"]
    return []


def _sizes(store: EpisodeStore) -> dict[str, str]:
    card = store.card
    lengths = store.lengths
    return {
        "task": card.task,
        "provenance": str(card.provenance),
        "collected": str(card.extra.get("collected", "not said")),
        "episodes": f"{store.episodes:,}",
        "steps": f"{store.steps:,}",
        "episode length": f"{lengths.min()} to {lengths.max()}" if np.ptp(lengths) else str(lengths[0]),
        **({} if card.dt is None else {"step": f"{card.dt:g} s"}),
        "agents": str(store.n_agents),
        "observation, action": f"{store.observations.shape[2]}, {store.actions.shape[2]} per agent",
        "global state": "none" if store.state is None else f"{store.state.shape[1]} entries",
        "hazard": str(store.hazard),
    }


def _outcomes(store: EpisodeStore) -> dict[str, str]:
    """Returns, costs, actions and ends."""
    card = store.card
    returns = store.returns
    costs = store.episode_costs
    return {
        "return": f"{returns.mean():.2f} ± {returns.std():.2f}, from {returns.min():.2f} to {returns.max():.2f}",
        "cost per episode": f"{costs.mean():.3f} ± {costs.std():.3f}, at most {costs.max():g}",
        **{f"constraint {name}": _of_constraint(store, name) for name in store.limits},
        "steps with cost": f"{100 * _cost_rate(store):.2f} %",
        "episodes with cost": f"{100 * (costs > 0).mean():.2f} %",
        "actions": f"from {store.actions.min():.3f} to {store.actions.max():.3f}, bounds {card.bounds}",
        "ended by": f"{int(store.terminated.sum()):,} terminations, {int(store.truncated.sum()):,} truncations",
    }


def _speeds(store: EpisodeStore) -> dict[str, str]:
    """What a robot's card says of its speed limit."""
    robot = store.card.extra
    if "speed_quantiles" not in robot:
        return {}
    spread = ", ".join(f"{100 * float(q):g} %: {v:.2f}" for q, v in robot["speed_quantiles"].items())
    limit = f"{robot['speed_limit']:g} m/s" + (f" ({robot['protocol']})" if "protocol" in robot else "")
    return {
        "speed limit": f"{limit}; at most {store.card.cost_limit:g} steps of an episode may be above it",
        "speed, quantiles": f"{spread} m/s",
        "return ceiling": f"{robot['return_ceiling']:.0f} within the limit, unless faster than all this data",
    }


def _danger(store: EpisodeStore, task: Task) -> tuple[dict[str, str], list[str]]:
    """(facts, warnings) of what the hazard's formula says of the data; nothing where it has none."""
    formula = _formula(store, task)
    if formula is None:
        return {}, _unread(store, task)
    starts = _labels(store, task, formula, store.first_rows)
    share = _disagreement(store, task, formula)
    facts = {
        "episodes starting unsafe": f"{100 * starts.mean():.2f} %",
        "cost and hazard disagree": f"{100 * share:.2f} % of steps",
    }
    warnings = []
    if share > DISAGREE:
        warnings.append(
            f"Costs are not what the hazard says of {100 * share:.0f} % of the steps: barriers learn from the "
            "hazard, tables count costs; make one follow from the other."
        )
    if starts.any():
        warnings.append(
            f"{100 * starts.mean():.1f} % of episodes start unsafe: their first cost says nothing about a policy; "
            "read the avoidable cost."
        )
    return facts, warnings


def odd_costs(store: EpisodeStore) -> list[str]:
    """Warnings of costs that teach little of danger."""
    rate = _cost_rate(store)
    if rate == 0:
        return ["No step has a cost: a barrier can learn danger only from the hazard's formula."]
    if rate < 0.01:
        return [f"Only {100 * rate:.2f} % of steps have a cost: labels of danger are scarce."]
    if rate > 0.99:
        return [f"{100 * rate:.1f} % of steps have a cost: almost nothing in this data is safe."]
    return []


def _odd_observations(store: EpisodeStore) -> list[str]:
    """Entries that never vary, or from agent to agent alone."""
    warnings = []
    some = store.observations[:: max(1, len(store.observations) // 100_000)]
    constant = np.flatnonzero(np.ptp(some, axis=0).max(0) < 1e-9)  # for no agent
    if len(constant):
        names = store.card.observation_names
        apart = np.ptp(some, axis=(0, 1))[constant] >= 1e-9
        for entries, how in ((constant[~apart], "never vary"), (constant[apart], "never vary but from agent to agent")):
            which = ", ".join(f"{d} ({names[d]})" if names else str(d) for d in entries)
            if which:
                warnings.append(f"Observation entries {which} {how}; views leave them out.")
    return warnings


def _odd_ends(store: EpisodeStore) -> list[str]:
    if store.terminated.any() and not store.truncated.any() and np.ptp(store.lengths) == 0:
        return ["All episodes terminate at the same length: these are probably time limits (truncated)."]
    longest = store.lengths == store.lengths.max()
    if not store.terminated.any() and not longest.all() and longest.mean() >= 0.5:
        return [
            f"{int((~longest).sum())} of {store.episodes} episodes end before the usual {store.lengths.max()} steps, "
            "and none is said to have ended by itself (terminated): values go on beyond such an end."
        ]
    return []


def odd_actions(store: EpisodeStore) -> list[str]:
    """Warnings of agents who never act in another way, of whom nobody learns what actions do, of entries that agents
    use and do not have, and of bounds that the logs use on one side alone: a guard would search where nobody acted."""
    still = np.flatnonzero((np.ptp(store.actions, 0) == 0).all(-1))
    who = ", ".join(map(str, still[:SHOWN])) + ", ..." * (len(still) > SHOWN)
    return [
        *([f"Actions of agent {who} never vary: no World can learn what they do."] if len(still) else []),
        *_spare(store),
        *_one_sided(store),
    ]


def _spare(store: EpisodeStore) -> list[str]:
    sizes, bounds = store.card.action_sizes, store.card.bounds
    if sizes is None:
        return []
    used = ~has_entry(sizes, store.actions.shape[2]) & (np.abs(store.actions - bounds.middle) > bounds.slack).any(0)
    return [
        f"Entry {entry} of agent {agent}'s action is used, and by action_sizes it has {sizes[agent]}: keep what it "
        "lacks at the middle of the bounds, as ringfence.Layout does."
        for agent, entry in np.argwhere(used).tolist()
    ]


def _one_sided(store: EpisodeStore) -> list[str]:
    low, high = (np.broadcast_to(bound, store.actions.shape[1:]) for bound in store.card.bounds)
    least, most = store.actions.min(0), store.actions.max(0)
    both = (low < 0) & (high > 0) & (most > least)
    return [
        f"Entry {entry} of the actions is never {word} 0, though bounded by {low[:, entry].min():g} and "
        f"{high[:, entry].max():g}: give the bounds that it has (action_low, action_high), since a guard searches "
        "within them."
        for word, one_side in (("below", both & (least >= 0)), ("above", both & (most <= 0)))
        for entry in np.flatnonzero(one_side.any(0))
    ]


def _cost_rate(store: EpisodeStore) -> float:
    """Share of the steps that cost."""
    return float((store.team_costs > 0).mean())


def _of_constraint(store: EpisodeStore, name: str) -> str:
    costs = store.episode_costs_of(name)
    limit = store.limits[name]
    within = f"{100 * (costs <= limit).mean():.1f} % of episodes are within {limit:g}"
    return f"{costs.mean():.3f} per episode, at most {costs.max():g}; {within}"


def _formula(store: EpisodeStore, task: Task) -> Formula | None:
    """The hazard's formula and what it reads; None where it has none."""
    try:
        view, bound = _bound(store, task)
    except UserError:
        return None
    return (view, bound) if bound.has_formula else None


def _labels(store: EpisodeStore, task: Task, formula: Formula, rows: np.ndarray) -> np.ndarray:
    """(K,) whether the hazard's formula calls these rows unsafe for anyone."""
    view, bound = formula
    state = None if store.state is None or task.homogeneous else store.state[rows]
    unsafe, _ = bound.labels(local_features(view, task.homogeneous, store.observations[rows], state))
    return np.any(np.asarray(unsafe).reshape(len(rows), -1), axis=-1)


def _bound(store: EpisodeStore, task: Task) -> Formula:
    """What the formula of danger reads, and the formula; refused where the logs have no such entries."""
    logs = task.logs(store) if task.env is None else store
    view = task.feature_map("pruned" if logs.state is not None else "decentralized", logs)
    return view, constraints.bind(task.hazard, view.names, view.plus.shape[0])


def disagreement(store: EpisodeStore, task: Task) -> float | None:
    """Share of steps (at most a hundred thousand, evenly spread) whose cost is not what the formula says of the state
    that they end in; None where there is no formula."""
    formula = _formula(store, task)
    return None if formula is None else _disagreement(store, task, formula)


def _disagreement(store: EpisodeStore, task: Task, formula: Formula) -> float:
    steps = np.unique(np.linspace(0, store.steps - 1, 100_000).astype(int))
    episode = np.searchsorted(store.episode_ends, steps, side="right")
    labels = _labels(store, task, formula, steps + episode + 1)
    return float((labels != (store.team_costs[steps] > 0)).mean())


def slips(names: Iterable[str]) -> list[str]:
    """A sentence for each pair of names that a letter or two keep apart, and that would leave an entry without the
    place that its name gives it. A name is `body.what`, and bodies tell alike things: who has a `dx` has a `dy`, and
    `other1` has what `other0` has."""
    bodies: dict[str, set[str]] = {}
    for name in itertools.islice(names, MOST):
        body, dot, what = name.partition(".")
        if dot:
            bodies.setdefault(body, set()).add(what)
    of_one_kind, of_others = [], []
    for one, other in itertools.combinations(bodies, 2):
        kind, left, others = one.rstrip(DIGITS), bodies[one] - bodies[other], bodies[other] - bodies[one]
        if kind == other.rstrip(DIGITS) != one:  # `other0.ddx` and `other1.dx`
            of_one_kind += [(f"{one}.{a}", f"{other}.{b}") for a in sorted(left) for b in others if _near(a, b)]
        elif kind != other.rstrip(DIGITS) and _near(one, other):  # `othr0.dx` and `other0.dy`
            twins = ((what, what[:-1] + TWINS.get(what[-1:], "")) for what in sorted(left))
            of_others += [(f"{one}.{what}", f"{other}.{twin}") for what, twin in twins if twin in others]
    return [
        f"'{one}' and '{other}' look like one kind of entry, spelt in two ways; name them alike."
        for one, other in of_others + of_one_kind
    ]


def _near(one: str, other: str) -> bool:
    return difflib.SequenceMatcher(None, one[:LONGEST], other[:LONGEST]).ratio() >= NEAR
