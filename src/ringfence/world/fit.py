"""Fitting a World: per data set, settings and seed; parts are cached by content, so that data sets which differ in
their costs alone, and hold out the same episodes, share what does not depend on them, and an interrupted fit goes on
with the part that it was at."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from safetensors import SafetensorError, safe_open

from ringfence.errors import UserError
from ringfence.logs import late
from ringfence.logs.store import EpisodeStore, team
from ringfence.problem import constraints, features
from ringfence.problem.normalise import varying
from ringfence.types import Key, Spec
from ringfence.utils.files import cache_dir, whole
from ringfence.utils.precision import in_float32, on_device
from ringfence.utils.progress import Parts, beside
from ringfence.utils.pytrees import load_named, named_arrays, save_named
from ringfence.world import barrier as cbf
from ringfence.world import cause_search, dynamics, impacts, judging, margins, stops, values
from ringfence.world.card import Card, Data, Settings
from ringfence.world.cause_candidates import offsets
from ringfence.world.cause_nets import fit_causes
from ringfence.world.causes import Cells, Found
from ringfence.world.logged import Logged, held_out, labels_of, unsafe_of
from ringfence.world.model import World, blank_world

FORMAT = 22  # of what is fitted, found and told, and of the views of data: what is cached of another is made again
EXPLAINED = 0.3  # share of the unsafe steps that causes have to tell, or networks read all entries
ENOUGH = 0.9  # recall of causes, below which networks on all entries are tried, too
READ = 500_000  # steps, at most, that stops are looked for in
STATES = 20_000  # steps that a barrier's features are standardised by

# Parts of a World: the settings that each depends on, and the other parts that it reads.
PARTS = {
    "dynamics": ("num_ensemble", "dynamics_updates", "dynamics_width"),
    "values": ("discount", "value_updates"),
    "label": (
        "labels",
        "causes",
        "loss",
        "penalty",
        "predicted_share",
        "distances",
        "use_transition",
        "barrier_width",
        "barrier_updates",
    ),
    "future": ("future_updates", "future_discount", "expectile"),
}
UPON = {"dynamics": (), "values": (), "label": ("dynamics",), "future": ("dynamics", "label")}

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Fit:
    """A World to be fitted: the store's, in the view `map` of `spec`. `hazard`, bound to the view, labels states where
    `settings.labels` is "formula". Of the same data, settings and seed parts are taken from the cache."""

    store: EpisodeStore
    map: features.FeatureMap
    spec: Spec
    settings: Settings
    hazard: constraints.BoundHazard | None
    seed: int
    cached: bool
    bar: Parts

    def file(self, name: str, content: list[Any], of: Sequence[str]) -> Path:
        """Where what depends on `content` and on the settings of the parts `of` is kept."""
        read = {"view", "execution", *(field for part in of for field in PARTS[part])}
        settings = {field: value for field, value in dataclasses.asdict(self.settings).items() if field in read}
        by_formula = self.settings.labels == "formula" and "label" in of
        formula = constraints.to_dict(self.hazard.hazard) if self.hazard is not None and by_formula else None
        return cached_file(name, [content, settings, self.seed, formula])

    def found(self, name: str, content: list[Any], kind: type[T], make: Callable[[], T]) -> T:
        """What is found about a part before it is fitted; made, and then kept, where it is not there."""
        file = self.file(name, content, ["label"]).with_suffix(".json")
        if self.cached and file.exists():
            try:
                return msgspec.json.decode(file.read_bytes(), type=kind)
            except (OSError, msgspec.MsgspecError):
                pass
        with self.bar.part(name):
            made = make()
        if self.cached:
            with whole(file) as temporary:
                Path(temporary).write_bytes(msgspec.json.encode(made))
        return made

    def part(self, name: str, content: list[Any], template: T, make: Callable[[Key], T]) -> T:
        """The part of that name, likewise."""
        file = self.file(name, content, [*UPON[name], name])
        if self.cached and (kept := _read(file, template)) is not None:
            self.bar.skip(name)
            return kept
        with self.bar.part(name, several=2 if name == "values" else 1):  # the critic, and what steps are worth
            made = make(jax.random.fold_in(jax.random.key(self.seed), list(PARTS).index(name)))
        if self.cached:
            save_named(file, named_arrays(made), {"key": file.stem})
        return made


def cached_file(name: str, about: list[Any]) -> Path:
    """Where a part of a World, or the whole, is kept that follows from all that `about` tells."""
    written = msgspec.json.encode([FORMAT, name, *about], enc_hook=np.ndarray.tolist, order="deterministic")
    code = hashlib.sha256(written).hexdigest()[:16]
    return cache_dir() / "worlds" / f"{name}-{code}.safetensors"


def _read(file: Path, template: T) -> T | None:
    """A cached part; None where there is none, a damaged one, or another's."""
    if not file.exists():
        return None
    try:
        with safe_open(file, "numpy") as opened:
            key = (opened.metadata() or {}).get("key")
        return load_named(file, template) if key == file.stem else None
    except (SafetensorError, OSError, UserError):
        return None


def fitted(of: Fit) -> tuple[World, Logged, Logged]:
    """A World that nobody has judged, whose card says of what it is; and the logs that are to judge it, with a tenth of
    the episodes held out of every part: as they were learned from, cut at impacts, and as they are."""
    store, map, settings = of.store, of.map, of.settings
    if settings.alone:
        map = features.alone(map)
    labels = labels_of(store, map, settings, of.hazard) if settings.barrier else {}
    out = held_out(store, of.seed, unsafe_of(labels) if labels else None)
    logged = Logged.of(store, map, out, labels)
    arrays = store.digest("observations", "state", "actions", "episode_ends", "terminated")
    logs = [arrays, _digest(out), store.card.bounds, map.turns, _digest(map.plus), _digest(map.minus)]

    blank = blank_world(map, of.spec, settings)
    thrown = impacts.count(logged, of.seed) if labels and settings.labels == "costs" else 0
    searched = {} if thrown else _causes(logged, labels, logs, of)

    def apart() -> tuple[values.Values, list[Found]]:
        """What is read off the logs alone."""
        return _values(logged, logs, blank.values, of), [each.found for each in searched.values()]

    with beside(in_float32(apart)) as ahead:
        acts, moved = _moves(logged, thrown, logs, blank.dynamics, of)
    value, _ = ahead()
    landed = impacts.landed(logged, acts) if thrown else logged
    barrier, causes = _barrier(searched or _causes(landed, labels, moved, of), moved, acts, landed.several)
    card = Card(
        format=FORMAT,
        data=_data(store, landed, thrown, acts),
        settings=settings,
        seed=of.seed,
        shape=_shape_in_words(barrier),
        causes=causes,
    )
    world = World(acts, value, barrier, jnp.ones(()), map, of.spec, settings.alone, card)
    return world, landed, logged


def _data(store: EpisodeStore, logged: Logged, thrown: int, acts: dynamics.Dynamics) -> Data:
    """What the card says of the logs."""
    several = logged.several
    delays = late.lateness(store)
    return Data(
        task=store.card.task,
        content=store.card.content or store.content,
        episodes=store.episodes // (store.card.team or 1),
        hazard=store.card.hazard,
        constraints=store.limits if several else None,
        observation_width=store.observations.shape[2],
        state_width=None if store.state is None else store.state.shape[1],
        dt=store.card.dt,
        unsafe_costs={name: _unsafe_cost(store, name) for name in store.limits} if several else None,
        observation_origins=store.card.observation_origins,
        state_origins=store.card.state_origins,
        ranges=_ranges(logged),
        inferred_names=_inferred_names(store, logged.map) or None,
        impacts=thrown,
        action_delay=store.card.action_delay,
        late=delays.steps if delays.any else (),
        agents=_agents(store),
        partners=bool(acts.map.mirrored),
        stops=acts.stops,
    )


def _stops(logged: Logged, steps: np.ndarray, predicted: np.ndarray) -> tuple[stops.Stop, ...]:
    if len(steps) > READ:
        steps = np.sort(np.random.default_rng(0).choice(steps, READ, replace=False))
    safe = ~logged.unsafe[steps] if logged.labels else np.ones(len(steps), bool)
    moves = logged.before(steps), logged.after(steps), logged.picked("actions", steps)
    return stops.found(logged.map, predicted, moves, safe, logged.store.card.homogeneous)


def _agents(store: EpisodeStore) -> list[str] | None:
    """Names of the store's agents, where these say more than their numbers do."""
    agents = store.card.agents
    numbers = [f"agent{i}" for i in range(store.n_agents)]
    return None if store.card.homogeneous or agents is None or agents == numbers else agents


def _inferred_names(store: EpisodeStore, map: features.FeatureMap) -> dict[str, str]:
    """Names that nobody gave, by what their entries are called."""
    given = features.given_names(map, store.entry_names, store.card.state_names)
    return {entry: name for entry, name in zip(given, map.names) if entry != name}


def _ranges(logged: Logged) -> dict[str, tuple[float, float]]:
    """What the logs show to be safe of every entry of an agent itself, or of all where names tell no things, and of how
    far things are away: danger that is too rare to have a cause is no place to go to, either."""
    names = logged.map.names
    x = np.asarray(logged.arrays["features"])
    if logged.labels and not logged.unsafe.all():
        x = logged.after(np.flatnonzero(~logged.unsafe))
    own = [d for d, name in enumerate(names) if name.startswith("own.")]
    found = {names[d]: (float(x[..., d].min()), float(x[..., d].max())) for d in own or range(len(names))}
    for cause in offsets(names):
        length = cause.of(x)
        found[cause.name] = (float(length.min()), float(length.max()))
    return found


def _unsafe_cost(store: EpisodeStore, name: str) -> float:
    """What a step that a constraint charges for costs on average; 1 where none is charged."""
    cost = team(store.of_constraint(name))
    return float(cost[cost > 0].mean(dtype=np.float64)) if (cost > 0).any() else 1.0


def expected(settings: Settings, constraints: int) -> list[tuple[str, float]]:
    """The parts of a World, and about how many seconds each takes on two cores: a bar is to say what is left."""
    found = [("reading", 1.0), ("values", settings.value_updates * 2e-3)]
    found += [("dynamics", settings.dynamics_updates * settings.num_ensemble * 3e-4)]
    for _ in range(max(1, constraints) * settings.barrier):
        found += [("causes", 5.0)] * settings.causes
        found += [("label", settings.barrier_updates * 1e-3), ("future", settings.future_updates * 2e-3)]
    return [*found, ("card", 8.0), ("search", 4.0)]


# --- parts ---


def _moves(
    logged: Logged, thrown: int, logs: list[Any], blank: dynamics.Dynamics, of: Fit
) -> tuple[dynamics.Dynamics, list[Any]]:
    """Stops and dynamics, of safe steps alone where unsafe ones end in an impact, and all that they follow from."""
    steps = logged.fitted_steps
    if thrown:
        steps = steps[~logged.unsafe[steps]]
        logs = [*logs, _digest(logged.unsafe)]
    known = _stops(logged, steps, blank.predicted)
    moved = [*logs, known]
    acts = _dynamics(logged, steps, moved, dataclasses.replace(blank, stops=known), of)
    if not logged.map.mirrored:
        return acts, moved
    acts = _with_partners(acts, logged, steps, moved, of)
    return acts, [*moved, acts.map.mirrored]


def _dynamics(
    logged: Logged, steps: np.ndarray, moved: list[Any], blank: dynamics.Dynamics, of: Fit
) -> dynamics.Dynamics:
    """Of these steps."""

    def fit(key: Key) -> dynamics.Dynamics:
        actions, row = (on_device(logged.picked(name, steps)) for name in ("actions", "row"))
        features = logged.arrays["features"]
        return dynamics.fit_dynamics(features, actions, row, blank.map, key, of.settings, blank.stops)

    return of.part("dynamics", moved, blank, fit)


def _with_partners(
    plain: dynamics.Dynamics, logged: Logged, steps: np.ndarray, moved: list[Any], of: Fit
) -> dynamics.Dynamics:
    """The dynamics that read what those do who are in lists of the nearest, if they predict held-out windows better
    than plain ones: in long lists they learn by heart who does what."""
    action = logged.arrays["actions"].shape[-1]
    blank = dynamics.blank_dynamics(logged.map, action, of.settings.num_ensemble, of.settings.dynamics_width)
    blank = dataclasses.replace(blank, stops=plain.stops)
    told = _dynamics(logged, steps, [*moved, logged.map.mirrored], blank, of)
    asked = judging.JUDGING
    errors = [judging.prediction_error(each, logged, np.random.default_rng(4), asked) for each in (told, plain)]
    ours, theirs = (np.mean(error.error_of_change) for error in errors)
    return told if ours < theirs else plain


def _values(logged: Logged, moved: list[Any], blank: values.Values, of: Fit) -> values.Values:
    settings = of.settings

    def fit(key: Key) -> values.Values:
        arrays = logged.arrays | {"returns_to_go": logged.returns_to_go(settings.discount, settings.alone)}
        return values.fit_values(arrays, on_device(logged.fitted_steps), logged.map, key, settings, logged.longest)

    return of.part("values", [*moved, logged.store.digest("rewards")], blank, fit)


@dataclass(frozen=True, eq=False)
class _Causes:
    """Why steps are dangerous by one constraint."""

    logged: Logged
    moved: list[Any]  # what the logs are
    of: Fit

    @functools.cached_property
    def found(self) -> Found:
        """None where few entries do not explain it, or where it is of a whole body."""
        settings = self.of.settings
        plain = settings.causes and settings.loss == "cross-entropy" and not settings.use_transition
        if not plain or self.logged.map.shared_body or self.logged.map.joint:
            return Found()
        content = [*self.moved, _digest(self.logged.label), self.logged.map.names]
        found = self.of.found("causes", content, Found, lambda: self.search[0])
        return found if found.explained >= EXPLAINED else Found(searched=True)

    @functools.cached_property
    def search(self) -> tuple[Found, list[Cells]]:
        """What a search finds, and the cells of each; made at most once."""
        logged = self.logged
        steps = logged.fitted_steps
        episode = logged.store.episode_of_step[steps]
        about = logged.after(steps), logged.label[steps], episode, logged.map.names
        return cause_search.find(*about, self.of.seed, team=not self.of.settings.alone)


def _causes(logged: Logged, names: Iterable[str], moved: list[Any], of: Fit) -> dict[str, _Causes]:
    """Of each constraint."""
    return {name: _Causes(logged.by(name), moved, of) for name in names}


@dataclass(frozen=True, eq=False)
class _Danger:
    """The danger of one constraint, of which a barrier is made."""

    causes: _Causes
    moved: list[Any]
    acts: dynamics.Dynamics

    @property
    def logged(self) -> Logged:
        return self.causes.logged

    @property
    def of(self) -> Fit:
        return self.causes.of

    def barrier(self) -> tuple[Found, cbf.Barrier]:
        """Its causes, and ℓ and V by them; no causes, and networks on all entries, where held-out steps say that
        these tell more."""
        found = self.causes.found
        label = self.label(found)
        if found.causes and (recall := self._recall(label)) < ENOUGH:
            none = Found(searched=True)
            plain = self.label(none)
            if self._recall(plain) > recall:
                found, label = none, plain
        return found, self.with_future(label, found)

    def _recall(self, label: cbf.Barrier) -> float:
        return judging.recall(label, self.logged, judging.JUDGING)

    def _content(self, found: Found) -> list[Any]:
        """What a barrier is made of, beside its settings."""
        return [*self.moved, _digest(self.logged.label), self.logged.map.names, found]

    def _blank(self, found: Found) -> cbf.Barrier:
        return eqx.filter_eval_shape(cbf.blank_barrier, self.logged.map, self.of.settings, found)

    def label(self, found: Found) -> cbf.Barrier:
        """ℓ, with the statistics that it reads by."""
        return self.of.part("label", self._content(found), self._blank(found), lambda key: self._label(found, key))

    def _label(self, found: Found, key: Key) -> cbf.Barrier:
        logged = self.logged
        settings = self.of.settings
        key_states, key_fit = jax.random.split(key)
        steps = logged.fitted_steps
        unsafe = logged.unsafe[steps]
        if unsafe.all() or not unsafe.any():
            raise UserError(
                f"All unsafe steps of '{logged.store.card.task}' lie in the episodes that are held out; log more of "
                "them, or take another seed."
            )
        arrays = logged.arrays
        data = arrays["features"], logged.predicted(self.acts), arrays["row"], on_device(logged.label)
        given = data, steps[unsafe], steps[~unsafe], key_fit, settings
        blank = _standardised(cbf.blank_barrier(logged.map, settings, found), logged, key_states)
        if not found.causes:
            return cbf.fit_label(blank, *given)
        nets = fit_causes(found, self.causes.search[1], *given)
        nets = margins.in_own_margins(nets, self.acts, logged, np.random.default_rng(0))
        return dataclasses.replace(blank, causes=nets)

    def with_future(self, label: cbf.Barrier, found: Found) -> cbf.Barrier:
        """V beside ℓ."""

        def fit(key: Key) -> cbf.Barrier:
            steps = self.logged.fitted_steps
            close = steps[self.logged.close_to_danger()[steps]]
            return cbf.fit_future(label, self.logged.arrays, steps, close, key, self.of.settings)

        return self.of.part("future", self._content(found), self._blank(found), fit)


def _digest(array: np.ndarray) -> str:
    return hashlib.blake2b(array.tobytes(), digest_size=8).hexdigest()


def _barrier(
    causes: dict[str, _Causes], moved: list[Any], acts: dynamics.Dynamics, several: bool
) -> tuple[cbf.Barrier | cbf.MinBarrier | None, dict[str, Found]]:
    """The barrier of all constraints, and the causes of the danger of each; None where there are none."""
    made = {name: _Danger(each, moved, acts).barrier() for name, each in causes.items()}
    found = {name: found for name, (found, _) in made.items()}
    each = tuple(barrier for _, barrier in made.values())
    if not each:
        return None, found
    return cbf.MinBarrier(each, tuple(made)) if several else each[0], found


def _standardised(barrier: cbf.Barrier, logged: Logged, key: Key) -> cbf.Barrier:
    """The barrier with mean and deviation of states and of steps, from some of the fitted ones."""
    steps = logged.fitted_steps
    drawn = jax.random.randint(key, (min(STATES, 4 * len(steps)),), 0, len(steps))
    some = steps[np.asarray(drawn)]
    before, after = (x.astype(np.float64) for x in (logged.before(some), logged.after(some)))
    width = before.shape[-1]
    moved = (after - before).reshape(-1, width)
    flat = after.reshape(-1, width)
    mean, scale = cbf.isotropic(barrier.shape, flat.mean(0), varying(flat.std(0), flat.mean(0)))
    step_scale = varying(moved.std(0), np.abs(mean) + scale)
    statistics = [on_device(x, np.float32) for x in (mean, scale, moved.mean(0), step_scale)]
    return eqx.tree_at(lambda b: (b.mean, b.scale, b.step_mean, b.step_scale), barrier, statistics)


def _shape_in_words(barrier: cbf.Barrier | cbf.MinBarrier | None) -> str:
    if barrier is None:
        return "no barrier"
    names = [net.cause.name for one in barrier.each for net in one.causes]
    if names:
        return f"a score for each cause ({'; '.join(names)}), the worst one counts"
    shape = barrier.shape
    if shape.pairs:
        kinds = ", ".join(f"{len(entries)} x {kind}" for kind, entries in shape.pairs)
        return f"one network for all pairs ({kinds}), the worst one counts"
    if shape.joint or shape.blame == "all":
        return "one body: everybody answers for its danger"
    return (
        "one network per agent on all it sees; no names like other0.dx tell which entries belong to which other, so "
        "pairs could not be distinguished"
    )
