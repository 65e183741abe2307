"""Replays: one agent driven by a policy, the others as logged; with and without guard, in the same windows."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.datasets import registry
from ringfence.datasets.task import Task
from ringfence.errors import LAST_SEED, UserError, above_zero, known, of_kind, whole_number
from ringfence.evaluation.compensation import compensated
from ringfence.evaluation.protocol import FORESEEN
from ringfence.evaluation.replay_scene import NOBODY, Motion, motion_of, names_of, require_replayable, windows_of
from ringfence.evaluation.replay_stage import DRIVERS, Driven, Stage, kinematics_of
from ringfence.evaluation.replay_stage import KINEMATICS as KINEMATICS
from ringfence.evaluation.statistics import clopper_pearson
from ringfence.faults import Faults
from ringfence.guards import GUARDS, Guard
from ringfence.guards.policy import Guarded, build
from ringfence.guards.wrap import Nothing
from ringfence.loading.resolve import resolve
from ringfence.loading.spec import PolicySpec
from ringfence.logs.late import Lateness
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.problem.entries import Names
from ringfence.problem.features import given_names
from ringfence.training.runs import Run
from ringfence.types import Policy
from ringfence.utils.compilation import keep_programs
from ringfence.utils.given import refuse_other_order
from ringfence.utils.precision import in_float32
from ringfence.utils.progress import Progress
from ringfence.world import World, load
from ringfence.world.causes import Found
from ringfence.world.logged import held_out, labels_of, unsafe_of

SECONDS = 8.0  # of a window, by default
LONG = 2.0  # s that the formula looks ahead
TELLS = 0.75  # balanced accuracy below which distances do not tell costs
SHOWN = 6  # names in a note
FILMS = 3


@in_float32
def replay(
    policy: Run | str | Path | None,
    store: EpisodeStore,
    *,
    world: World | str | Path | None = None,
    guard: str = "shield",
    barrier: str | None = None,
    drivers: Sequence[str] = tuple(DRIVERS),
    kinematics: str | None = None,
    wheelbase: float = 2.7,
    radius: float | None = None,
    steps: int | None = None,
    windows: int = 300,
    every_episode: bool = False,
    baselines: bool = True,
    anyway: bool = False,
    seed: int = 0,
    faults: Faults | Mapping[str, Any] | None = None,
    compensate: bool = False,
    quiet: bool = True,
    **options: Any,
) -> ReplayResult:
    """Contacts that a guard prevents and causes where one agent is driven and all others do what they did.

    policy: a run, or None for the bad `drivers` alone, which hold speed and course (straight), speed up (accelerate),
    go to the goal as fast as any did (hasty), or to the nearest (seek). `world` guards (default: the run's), and
    `options` are those of `load`. Windows of `steps` (8 s) do not overlap and lie in episodes that the World did
    not learn from, or in `every_episode`; each agent is driven in turn, in `windows` windows at most. Contact is being
    closer than `radius` m to another: by default the task's formula, else the distance that best tells the logged
    unsafe steps, else where distances become dangerous by the World's card. `kinematics` is a name of KINEMATICS.
    `baselines` adds a brake that takes everybody's velocity for constant, and a guard that knows the formula, along
    2 s.

    `faults` lie between the driven agent's policy or guard and its body, and `compensate` tells the guard of them,
    both as in `ringfence.stress`; a brake has none.

    Others do not react: what drives into a driven agent from behind counts as its contact, too. Without `quiet` each
    driver under each filter shows its progress.
    """
    keep_programs()
    of_kind("store", store, EpisodeStore, "give an EpisodeStore")
    _check(drivers, guard, windows, seed)
    how = Body(kinematics, wheelbase, radius, steps, every_episode)
    run = None if policy is None else Run.of(policy)
    logs = Logs.of(store, run)
    faults = faults if isinstance(faults, Faults) else Faults.of(faults or {})
    given: dict[str, Any] = {"barrier": barrier} if barrier else {}
    if world is not None:
        given["world"] = world if isinstance(world, World) else load(world)
    given |= options
    knowing = _knowing(run, logs.task, guard, given, anyway, faults) if compensate else given
    guarded = _guarded(run, logs.task, guard, knowing, anyway)
    known_world = given.get("world") if guarded is None else guarded.guard.world
    stage, source, left_out = logs.stage(known_world, how, windows, seed, faults)
    notes = _notes(logs, guarded, faults, compensate)
    filters = _filters(guard, guarded, known_world if baselines else None, stage, notes)
    own: dict[str, str | Policy] = {} if run is None else {run.config["algorithm"]: resolve(PolicySpec.of(run)).policy}
    shown = _played(stage, own | {name: name for name in drivers}, filters, baselines, quiet)
    about = {"task": logs.store.card.task, "radius_from": source, "begun_in_contact": left_out, "notes": tuple(notes)}
    return _result(stage, shown, guard, known_world, **about)


def _notes(logs: Logs, guarded: Guarded | None, faults: Faults, compensate: bool) -> list[str]:
    """What is to be known of the rows, a sentence or two each."""
    store, names = logs.store, logs.names
    notes: list[str] = []
    if faults.given:
        known_to = ", which the guard knows" if compensate else ""
        notes.append(f"Behind faults: {faults.name}{known_to}; a brake is not behind them.")
    if store.card.action_delay:
        notes.append(
            f"The driven agent's commands take effect {Lateness((store.card.action_delay,))}, as whoever was logged; a "
            "brake's do not."
        )
    if guarded is not None and store.n_agents > 1 and not guarded.guard.world.alone:
        notes.append(
            "This guard is of a team and decides for the driven agent alone. Of others it expects what they do now, or "
            "what the run would do in their place."
        )
    if names.as_logged:
        kept = ", ".join(names.as_logged[:SHOWN]) + (", ..." if len(names.as_logged) > SHOWN else "")
        notes.append(f"Of a driven agent {kept} stay as logged: no name says how they follow from its motion.")
    return notes


def _filters(
    guard: str, guarded: Guarded | None, world: World | None, stage: Stage, notes: list[str]
) -> dict[str, Guarded]:
    """What filters actions, by name: the guard, and a shield that knows the distance, along 2 s. Where the World's view
    does not hold places of others there is none of these, and a note says so."""
    filters = {} if guarded is None else {guard: Guarded(Nothing(), guarded.guard)}
    if world is None:
        return filters
    hazard = constraints.Separation(stage.radius, 0.25 * stage.radius)
    if constraints.bind_or_none(hazard, world.spec.feature_names, world.spec.n_agents) is None:
        notes.append("The World's view holds no places of others: no row by the formula.")
        return filters
    rows = int(np.clip(round(LONG / stage.windows.dt), 3, 20))
    return filters | {"formula": build(Nothing(), world, hazard, "shield", "analytic", {}, horizon=rows)}


def _result(stage: Stage, shown: list[Played], guard: str, world: World | None, **about: Any) -> ReplayResult:
    return ReplayResult(
        radius=stage.radius,
        kinematics=stage.kinematics.name,
        steps=stage.windows.steps,
        seconds=stage.windows.steps * stage.windows.dt,
        windows=stage.windows.count,
        guard=guard,
        verdict=None if world is None or world.card.verdict is None else world.card.verdict.word,
        rows=tuple(row for one in shown for row in rows_of(stage, one)),
        films=tuple(film for one in shown if guard in one.under for film in [_film(stage, one, guard)])[:FILMS],
        **about,
    )


@dataclass(frozen=True)
class Body:
    """How windows are cut, and how the driven agent moves in them; None: as the logs tell."""

    kinematics: str | None = None
    wheelbase: float = 2.7  # m
    radius: float | None = None  # m
    steps: int | None = None
    every_episode: bool = False

    def __post_init__(self):
        above_zero("wheelbase", self.wheelbase, "metres")
        if self.radius is not None:
            above_zero("radius", self.radius, "metres")
        if self.steps is not None:
            whole_number("steps", self.steps, 1)


@dataclass(frozen=True, eq=False)
class Logs:
    """What is replayed, and what its entries are called."""

    task: Task
    store: EpisodeStore
    names: Names

    @classmethod
    def of(cls, store: EpisodeStore, run: Run | None) -> Logs:
        """Logs that can be replayed, and are of the run's task; others are refused."""
        task = registry.from_store(store)
        store = task.logs(store)
        names = names_of(store)
        require_replayable(names, store.card.task)
        if run is not None and run.config["task"] != store.card.task:
            raise UserError(
                f"The run is of '{run.config['task']}', the logs are of '{store.card.task}'; replay its own."
            )
        return cls(task, store, names)

    def stage(self, world: World | None, how: Body, windows: int, seed: int, faults: Faults) -> tuple[Stage, str, int]:
        """(the stage, where its radius is from, how many windows begin in contact)."""
        if world is not None:
            check_view(world, self.store)
        motion = motion_of(self.store, self.names)
        radius, source = radius_of(self.store, motion, how.radius, {} if world is None else world.card.causes)
        card = self.store.card
        if card.dt is None:
            raise UserError(f"The card of '{card.task}' does not say how long a step takes; give it dt (s).")
        dt = float(card.dt)
        chosen = np.arange(self.store.episodes) if how.every_episode else _unlearned(world, self.store)
        longest = int(np.median(self.store.lengths[chosen]))
        if how.steps is None and round(SECONDS / dt) < 2:
            raise UserError(
                f"A step of '{card.task}' is {dt:g} s, and a window has {SECONDS:g} s; say how many steps it has "
                "(--steps, steps=)."
            )
        steps = how.steps or max(1, min(round(SECONDS / dt), longest))
        cut, left_out = windows_of(self.store, self.names, motion, chosen, steps, windows, radius, dt)
        body = kinematics_of(how.kinematics, self.store, motion, world, dt, how.wheelbase)
        late = dataclasses.replace(faults, delay=faults.delay + card.action_delay)  # as whoever was logged
        return Stage(cut, body, radius, seed, late), source, left_out


@dataclass(frozen=True, eq=False)
class Played:
    """A driver's windows without a filter, and under each."""

    name: str
    plain: Driven
    under: dict[str, Driven]


def _played(
    stage: Stage, players: Mapping[str, str | Policy], filters: Mapping[str, Guarded], brake: bool, quiet: bool = True
) -> list[Played]:
    """Each driver without a filter, and under each."""
    ways: dict[str, dict[str, Any]] = {"no guard": {}, **{name: {"guard": one} for name, one in filters.items()}}
    if brake:
        ways["brake"] = {"brake": True}
    total = len(players) * len(ways)
    shown = []
    for name, player in players.items():
        driven = {}
        for way, how in ways.items():
            label = f"{name}, {way} ({len(shown) * len(ways) + len(driven) + 1} of {total})"
            with Progress(label, stage.windows.steps, 0, quiet) as bar:
                driven[way] = stage.play(player, **how, bar=bar)
        shown.append(Played(name, driven.pop("no guard"), driven))
    return shown


def _knowing(
    run: Run | None, task: Task, guard: str, options: dict[str, Any], anyway: bool, faults: Faults
) -> dict[str, Any]:
    """The options, with those by which the guard makes good for faults that it knows of."""

    def guard_of(spec: PolicySpec) -> Guard:
        found = _guarded(run, task, guard, options, anyway)
        assert found is not None, "compensation without a guard is refused first"
        return found.guard

    choices = options | {"guard": guard, "anyway": anyway}
    found = compensated(run, faults, choices, guard_of)
    return options | {name: value for name, value in found.items() if name not in choices}


def _guarded(run: Run | None, task: Task, guard: str, options: dict[str, Any], anyway: bool) -> Guarded | None:
    """The run under guard, or a guard of whatever is proposed. None where nobody guards."""
    if guard == "none":
        return None
    if run is not None:
        policy = resolve(PolicySpec.of(run, guard=guard, anyway=anyway, **options)).policy
        assert isinstance(policy, Guarded), "a guard was named"
        return policy
    spec = PolicySpec.of(guard=guard, anyway=anyway, **options)
    if not isinstance(spec.world, World):
        raise UserError("Nothing says which World guards; give world=, e.g. ringfence.fit(store), or a run.")
    changes = dict(spec.guard_options)
    return build(Nothing(), spec.world, task.hazard, guard, spec.barrier, anyway=anyway, **changes)


def _check(drivers: Sequence[str], guard: str, windows: int, seed: int) -> None:
    of_kind("drivers", drivers, Sequence, "give a list of their names")
    for name in drivers:
        known("driver", name, DRIVERS)
    known("guard", guard, GUARDS)
    whole_number("windows", windows, 1)
    whole_number("seed", seed, 0, LAST_SEED)


def check_view(world: World, store: EpisodeStore) -> None:
    """Refuse a World of other agents, entries, bounds or time steps than these logs have."""
    width, state_width = world.widths
    there = 0 if store.state is None else store.state.shape[1]
    shape = (store.n_agents, store.observations.shape[2], store.actions.shape[2])
    wanted = (world.spec.n_agents, width or shape[1], world.spec.action_dim)
    if world.map.reads_state and there < (state_width or 1):
        raise UserError(
            f"The World reads a global state of {state_width or 'some'} entries, the logs hold {there or 'none'}; "
            "fit a World to these logs."
        )
    if shape != wanted:
        raise UserError(
            f"The World reads {wanted[0]} agents of {wanted[1]} entries and {wanted[2]} actions, the logs hold "
            f"{shape[0]} of {shape[1]} and {shape[2]}; fit a World to these logs."
        )
    if store.card.agents is not None and not store.card.homogeneous:
        refuse_other_order(store.card.agents, world.card.data.agents)
    if world.origins != store.card.origins:
        raise UserError("The logs were moved by other origins than those of the World; fit a World to these logs.")
    if world.card.data.action_delay != store.card.action_delay:
        raise UserError(
            f"The World is of logs that were undelayed by {world.card.data.action_delay} steps, these by "
            f"{store.card.action_delay}; undelay these likewise, or fit a World to them."
        )
    names = store.card.observation_names
    if names and not world.map.reads_state:
        called = {name: entry for entry, name in (world.card.data.inferred_names or {}).items()}
        for inferred, entry in zip(world.map.names, given_names(world.map, names)):
            if entry != (name := called.get(inferred, inferred)):
                raise UserError(f"The World reads '{name}' where these logs hold '{entry}'; fit a World to these logs.")
    mine = [np.asarray(bound, float) for bound in (world.spec.action_low, world.spec.action_high)]
    theirs = [np.asarray(bound, float) for bound in store.card.bounds]
    if not all(np.allclose(a, b, rtol=1e-4) for a, b in zip(mine, theirs)):
        raise UserError(
            f"The World's actions are within {mine[0].tolist()} and {mine[1].tolist()}, those of these logs within "
            f"{theirs[0].tolist()} and {theirs[1].tolist()}; fit a World to these logs."
        )
    if world.map.dt is not None and store.card.dt is not None and not np.isclose(world.map.dt, store.card.dt):
        raise UserError(
            f"The World steps by {world.map.dt:g} s, these logs by {store.card.dt:g} s; import them with that dt."
        )


def _unlearned(world: World | None, store: EpisodeStore) -> np.ndarray:
    """The episodes that a World did not learn from: those that it held out of these logs, or all of other logs."""
    if world is None or world.card.data.content != (store.card.content or store.content):
        return np.arange(store.episodes)
    settings = world.card.settings
    hazard = constraints.bind_or_none(store.hazard, world.spec.feature_names, world.spec.n_agents)
    labels = labels_of(store, world.map, settings, hazard) if settings.barrier else {}
    return np.flatnonzero(held_out(store, world.card.seed, unsafe_of(labels) if labels else None))


def radius_of(
    store: EpisodeStore, motion: Motion, given: float | None, causes: Mapping[str, Found] | None = None
) -> tuple[float, str]:
    """(m, where it is from): as given, the task's own, the distance that best tells the logged unsafe steps, or where
    danger of a distance begins among the causes of a World's card."""
    if given is not None:
        return above_zero("radius", given, "metres"), "given"
    hazard = store.hazard
    parts = hazard.hazards if isinstance(hazard, constraints.All) else (hazard,)
    radii = [part.radius for part in parts if isinstance(part, constraints.Separation)]
    if radii:
        return radii[0], "the task's formula"
    try:
        return _radius_of_costs(store, motion), "the logged costs"
    except UserError:
        found = _radius_of_causes(causes or {}, motion.offset.shape[-1])
        if found is None:
            raise
        return found


def _radius_of_costs(store: EpisodeStore, motion: Motion) -> float:
    """The distance (m) that best tells the logged unsafe steps; refused where none does."""
    row = np.arange(store.steps) + store.episode_of_step + 1
    distance = np.linalg.norm(motion.offset[row], axis=-1).min(-1)  # (T, N)
    unsafe = store.costs > 0
    if unsafe.ndim == 1:
        distance = distance.min(-1)
    distance = distance.ravel()
    unsafe = unsafe.ravel()
    if not unsafe.any() or unsafe.all():
        raise UserError(
            f"Nothing says how close is contact: the costs of '{store.card.task}' are alike; give radius= (--radius)."
        )
    order = np.argsort(distance, kind="stable")
    hit = unsafe[order]
    balance = (np.cumsum(hit) / hit.sum() + 1 - np.cumsum(~hit) / (~hit).sum()) / 2
    best = int(balance.argmax())
    if balance[best] < TELLS or distance[order[best]] >= NOBODY:
        raise UserError(
            f"No distance tells which steps of '{store.card.task}' are unsafe (the best is right in "
            f"{100 * balance[best]:.0f} %); give radius= (--radius)."
        )
    after = distance[order[min(best + 1, len(order) - 1)]]
    return float((distance[order[best]] + min(after, 2 * distance[order[best]])) / 2)


def _radius_of_causes(causes: Mapping[str, Found], axes: int) -> tuple[float, str] | None:
    """(m, where it is from): below what distance to any other the logs of a World have danger, where it found one."""
    offsets = [f"other.d{axis}" for axis in "xyz"[:axes]]
    likely = sorted(
        (share, edge.at, cause.name)
        for found in causes.values()
        for cause, share, edge in zip(found.causes, found.shares, found.edges)
        if not cause.who and edge.at is not None and edge.below
        if [entry.name for entry in cause.vector or ()] == offsets
    )
    if not likely:
        return None
    _, radius, name = likely[-1]
    return radius, f"the World's cause '{name}'; other dangers are not counted"


def rows_of(stage: Stage, played: Played) -> list[Row]:
    logged = int((stage.windows.nearest_logged[:, 1:] < stage.radius).any(-1).sum())
    plain = played.plain.contact
    driven = stage.windows.driven
    made = []
    for filter, found in {"none": played.plain, **played.under}.items():
        clearance = found.info.get("clearance")
        by_agent = []
        for agent in np.unique(driven):
            own = driven == agent
            info = {name: float(value[own].mean()) for name, value in found.info.items() if name != FORESEEN}
            by_agent.append({"agent": int(agent), "contacts": int(found.contact[own].sum()), **info})
        made.append(
            Row(
                policy=played.name,
                filter=filter,
                windows=stage.windows.count,
                logged=logged,
                alone=int(plain.sum()),
                contacts=int(found.contact.sum()),
                prevented=int((plain & ~found.contact).sum()),
                caused=int((~plain & found.contact).sum()),
                infeasible=_share(found, "infeasible"),
                ood=_share(found, "ood"),
                margin=None if clearance is None else float(np.median(clearance)),
                by_agent=tuple(by_agent),
            )
        )
    return made


def _share(found: Driven, name: str) -> float | None:
    return float(found.info[name].mean()) if name in found.info else None


def _film(stage: Stage, played: Played, guard: str) -> Film:
    """The first window that the guard changes for the better, else for the worse, else the first."""
    plain, guarded = played.plain, played.under[guard]
    better = np.flatnonzero(plain.contact & ~guarded.contact)
    worse = np.flatnonzero(~plain.contact & guarded.contact)
    k = int([*better[:1], *worse[:1], 0][0])
    what = "a contact prevented" if len(better) else "a contact caused" if len(worse) else "the first window"
    w = stage.windows
    return Film(
        title=f"{played.name} under {guard}: {what}",
        others=w.others_at[k],
        logged=w.place[k],
        alone=plain.place[k],
        guarded=guarded.place[k],
    )


@dataclass(frozen=True)
class Row:
    """A policy under one filter. Counts are of windows; intervals are exact, at 95 %."""

    policy: str
    filter: str  # none, brake, formula, or the guard's name
    windows: int
    logged: int  # with contact as logged
    alone: int  # with contact of the same policy without a filter
    contacts: int
    prevented: int
    caused: int
    infeasible: float | None = None  # share of steps in which the guard cannot do what it should
    ood: float | None = None  # and in which it is out of distribution
    margin: float | None = None  # median of the guard's margin
    by_agent: tuple[dict[str, Any], ...] = ()  # the same of each driven agent

    @property
    def contacts_interval(self) -> tuple[float, float]:
        low, high = clopper_pearson(self.contacts, self.windows)
        return low, high

    @property
    def caused_interval(self) -> tuple[float, float]:
        low, high = clopper_pearson(self.caused, self.windows)
        return low, high

    @property
    def prevented_interval(self) -> tuple[float, float] | None:
        """Of the contacts without a filter; None where there are none."""
        if not self.alone:
            return None
        low, high = clopper_pearson(self.prevented, self.alone)
        return low, high


@dataclass(frozen=True, eq=False)
class Film:
    """One window: places in metres."""

    title: str
    others: np.ndarray  # (L+1, K, X) along X axes
    logged: np.ndarray  # (L+1, X)
    alone: np.ndarray  # (L+1, X) the policy without guard
    guarded: np.ndarray  # (L+1, X)


@dataclass(frozen=True)
class ReplayResult:
    """Rows by policy and filter, all of the same windows."""

    task: str
    radius: float  # m
    radius_from: str
    kinematics: str
    steps: int
    seconds: float
    windows: int
    begun_in_contact: int  # windows left out
    guard: str
    verdict: str | None  # of the World
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    films: tuple[Film, ...] = field(default=(), repr=False)

    def to_json(self) -> dict[str, Any]:
        """All but the films, with intervals, as files hold it."""
        made = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("rows", "films")}
        intervals = ("contacts_interval", "prevented_interval", "caused_interval")
        made["rows"] = [asdict(row) | {name: getattr(row, name) for name in intervals} for row in self.rows]
        return made

    def row(self, policy: str, filter: str) -> Row:
        return next(row for row in self.rows if (row.policy, row.filter) == (policy, filter))

    def summary(self) -> list[str]:
        """Lines for a terminal."""
        first = self.rows[0]
        lines = [
            f"{self.task}: {self.windows} windows of {self.seconds:.3g} s, contact below {self.radius:.3g} m "
            f"({self.radius_from}), kinematics {self.kinematics}; as logged {first.logged} with contact",
            f"{'policy':12} {'filter':10} {'contacts':>8} {'prevented':>16} {'caused':>7}  of windows (95 %)",
        ]
        for row in self.rows:
            share = f"{row.prevented} of {row.alone}" if row.filter != "none" else "–"
            low, high = row.contacts_interval
            lines.append(
                f"{row.policy:12} {row.filter:10} {row.contacts:8} {share:>16} {row.caused:7}  "
                f"contacts {100 * row.contacts / row.windows:.1f} % ({100 * low:.1f} to {100 * high:.1f})"
            )
        return [*lines, *self.notes]
