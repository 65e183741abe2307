"""Fitting a World: per data set, settings and seed; parts are cached by content, so that data sets which differ in
their costs alone, and hold out the same episodes, share what does not depend on them, and an interrupted fit goes on
with the part that it was at."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import time
from collections.abc import Callable, Sequence
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
from ringfence.utils.cache import cache_dir
from ringfence.utils.device import on_device
from ringfence.utils.files import whole
from ringfence.utils.progress import Parts
from ringfence.utils.pytrees import load_named, named_arrays, save_named
from ringfence.world import barrier as cbf
from ringfence.world import cause_search, dynamics, impacts, margins, validate, values
from ringfence.world.card import Card, Data
from ringfence.world.cause_candidates import offsets
from ringfence.world.cause_nets import fit_causes
from ringfence.world.causes import Found
from ringfence.world.cells import Cells
from ringfence.world.heading import AHEAD, Heading
from ringfence.world.logged import Logged, held_out, labels_of, unsafe_of
from ringfence.world.look import look_of
from ringfence.world.model import World
from ringfence.world.settings import Settings
from ringfence.world.storage import blank_barrier, blank_world
from ringfence.world.verdict import judge

FORMAT = 6  # of what is fitted, found and told, and of the views of data: what is cached of another is made again
EXPLAINED = 0.3  # share of the unsafe steps that causes have to tell, or networks read all entries
ENOUGH = 0.95  # recall of causes, below which networks on all entries are tried, too
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
Search = Callable[[World, Logged], float | None]  # share of what a guard's search calls safe, and the logs dangerous


def fit_view(
    store: EpisodeStore,
    map: features.FeatureMap,
    spec: Spec,
    settings: Settings,
    *,
    hazard: constraints.BoundHazard | None = None,
    seed: int = 0,
    cached: bool = True,
    bar: Parts | None = None,
    search: Search | None = None,
) -> World:
    """The World of a store in the view `map` of `spec`; its parts from the cache where they have been fitted before.

    `hazard`, bound to the view, labels states where `settings.labels` is "formula". A tenth of the episodes is held
    out of every part; the card says how good the World is on them, and by `search` what a guard would find in it.
    """
    begun = time.perf_counter()
    formula = None if hazard is None or settings.labels != "formula" else constraints.to_dict(hazard.hazard)
    parts = _Parts(settings, seed, formula, cached, bar or Parts("", (), quiet=True))
    if settings.execution == "decentralized":
        map = features.alone(map)
    labels = labels_of(store, map, settings, hazard) if settings.barrier else {}
    out = held_out(store, parts.seed, unsafe_of(labels) if labels else None)
    whole = logged = Logged.of(store, map, out, labels)
    arrays = store.digest("observations", "state", "actions", "episode_ends", "terminated")
    moved = [arrays, _digest(out), store.card.bounds, map.turns, _digest(map.plus), _digest(map.minus)]

    world = blank_world(map, spec, settings)
    value = _values(logged, moved, world.values, parts)
    thrown = impacts.count(logged, parts.seed) if labels and settings.labels == "costs" else 0
    steps = logged.fitted_steps
    if thrown:
        steps = steps[~logged.unsafe[steps]]
        moved.append(_digest(logged.unsafe))
    acts = _dynamics(logged, steps, moved, world.dynamics, parts)
    if map.mirrored:
        acts = _with_partners(acts, logged, steps, moved, parts)
        moved.append(acts.map.mirrored)
    if thrown:
        logged = impacts.landed(logged, acts)
    barrier, found_by = _barrier(logged, tuple(labels), moved, acts, parts)
    world = World(acts, value, barrier, jnp.ones(()), map, spec, settings.execution == "decentralized", Card())

    with parts.bar.part("card"):
        found = validate.validate(world, logged, whole, settings.miscoverage, settings.loss)
    seconds = parts.bar.seconds | {"in all": time.perf_counter() - begun}
    card = Card(
        format=FORMAT,
        data=_data(store, logged, thrown, bool(acts.map.mirrored)),
        settings=settings,
        seed=parts.seed,
        shape=_shape_in_words(barrier),
        causes=found_by,
        seconds={name: round(took, 1) for name, took in seconds.items()},
        held_out=found.held_out,
        prediction_error=found.prediction_error,
        values=found.values,
        ood=found.ood,
        barrier=found.scores,
        constraints=found.constraints,
    )
    threshold = jnp.asarray(found.ood.threshold, jnp.float32)
    acts = dataclasses.replace(acts, ahead=dynamics.slowest(map, card.data.ranges))
    world = dataclasses.replace(world, dynamics=acts, barrier=found.barrier, ood_threshold=threshold, card=card)
    with parts.bar.part("search"):
        wrong = None if search is None else search(world, logged)
    if wrong is not None and card.barrier is not None:
        card = msgspec.structs.replace(card, barrier=msgspec.structs.replace(card.barrier, searched=round(wrong, 4)))
    card = msgspec.structs.replace(card, verdict=judge(card), look=look_of(card))
    return dataclasses.replace(world, card=card)


def _data(store: EpisodeStore, logged: Logged, thrown: int, looked_up: bool) -> Data:
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
        partners=looked_up,
    )


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
    if (heading := Heading.of(names)) is not None:
        speed = heading.speed(x)
        found[AHEAD] = (float(speed.min()), float(speed.max()))
    return found


def _unsafe_cost(store: EpisodeStore, name: str) -> float:
    """What a step that a constraint charges for costs on average; 1 where none is charged."""
    cost = team(store.of_constraint(name))
    return float(cost[cost > 0].mean(dtype=np.float64)) if (cost > 0).any() else 1.0


def expected(settings: Settings, constraints: int) -> list[tuple[str, float]]:
    """The parts of a World, and about how many seconds each takes on two cores: a bar is to say what is left."""
    found = [("reading", 1.0), ("values", settings.value_updates * 3e-3)]
    found += [("dynamics", settings.dynamics_updates * settings.num_ensemble * 4e-4)]
    for _ in range(max(1, constraints) * settings.barrier):
        found += [("causes", 5.0)] * settings.causes
        found += [("label", settings.barrier_updates * 1.5e-3), ("future", settings.future_updates * 3e-3)]
    return [*found, ("card", 8.0), ("search", 4.0)]


# --- parts ---


def _dynamics(
    logged: Logged,
    steps: np.ndarray,
    moved: list[Any],
    blank: dynamics.Dynamics,
    parts: _Parts,
) -> dynamics.Dynamics:
    """Of these steps."""
    settings = parts.settings

    def fit(key: Key) -> dynamics.Dynamics:
        return dynamics.fit_dynamics(
            logged.arrays["features"],
            on_device(logged.picked("actions", steps)),
            on_device(logged.picked("row", steps)),
            blank.map,
            key,
            num_ensemble=settings.num_ensemble,
            updates=settings.dynamics_updates,
            width=settings.dynamics_width,
        )

    return parts.get("dynamics", moved, blank, fit)


def _with_partners(
    plain: dynamics.Dynamics, logged: Logged, steps: np.ndarray, moved: list[Any], parts: _Parts
) -> dynamics.Dynamics:
    """The dynamics that read what those do who are in lists of the nearest, if they predict held-out windows better
    than plain ones: in long lists they learn by heart who does what."""
    settings = parts.settings
    action = logged.arrays["actions"].shape[-1]
    blank = dynamics.blank_dynamics(logged.map, action, settings.num_ensemble, settings.dynamics_width)
    told = _dynamics(logged, steps, [*moved, logged.map.mirrored], blank, parts)
    errors = [validate.prediction_error(each, logged, np.random.default_rng(4)) for each in (told, plain)]
    ours, theirs = (np.mean(error.error_of_change) for error in errors)
    return told if ours < theirs else plain


def _values(logged: Logged, moved: list[Any], blank: values.Values, parts: _Parts) -> values.Values:
    settings = parts.settings
    alone = settings.execution == "decentralized"

    def fit(key: Key) -> values.Values:
        return values.fit_values(
            logged.arrays | {"returns_to_go": logged.returns_to_go(settings.discount, alone)},
            on_device(logged.fitted_steps),
            logged.map,
            key,
            discount=settings.discount,
            updates=settings.value_updates,
            period=logged.longest,
            alone=alone,
        )

    return parts.get("values", [*moved, logged.store.digest("rewards")], blank, fit)


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for the causes of one constraint's danger, made at most once."""

    logged: Logged
    seed: int

    @functools.cached_property
    def result(self) -> tuple[Found, list[Cells]]:
        """What is found, and the cells of each cause."""
        logged = self.logged
        steps = logged.fitted_steps
        x = logged.after(steps)
        episode = logged.store.episode_of_step[steps]
        return cause_search.find(x, logged.label[steps], episode, logged.map.names, self.seed)


def _causes(search: _Search, moved: list[Any], parts: _Parts) -> Found:
    """The causes of one constraint's danger; none where few entries do not explain it, or is of a whole body."""
    settings = parts.settings
    logged = search.logged
    plain = settings.causes and settings.loss == "cross-entropy" and not settings.use_transition
    if not plain or logged.map.shared_body or logged.map.joint:
        return Found()
    content = [*moved, _digest(logged.label), logged.map.names]
    found = parts.json("causes", content, Found, lambda: search.result[0])
    return found if found.explained >= EXPLAINED else Found()


def _digest(array: np.ndarray) -> str:
    return hashlib.blake2b(array.tobytes(), digest_size=8).hexdigest()


def _barrier(
    logged: Logged, names: tuple[str, ...], moved: list[Any], acts: dynamics.Dynamics, parts: _Parts
) -> tuple[cbf.Barrier | cbf.MinBarrier | None, dict[str, Found]]:
    """The barrier of all constraints, and the causes of the danger of each; None where there are none."""
    searches = {name: _Search(logged.by(name), parts.seed) for name in names}
    labels = {name: _label_of(search, moved, acts, parts) for name, search in searches.items()}
    causes = {name: found for name, (found, _) in labels.items()}
    each = [_with_future(labels[name][1], search, moved, causes[name], parts) for name, search in searches.items()]
    if not each:
        return None, causes
    return cbf.MinBarrier(tuple(each), names) if logged.several else each[0], causes


def _label_of(search: _Search, moved: list[Any], acts: dynamics.Dynamics, parts: _Parts) -> tuple[Found, cbf.Barrier]:
    """The causes of one constraint's danger, and ℓ by them; no causes, and ℓ by networks on all entries, where held-out
    steps say that these tell more."""
    found = _causes(search, moved, parts)
    label = _labelled(search, moved, acts, found, parts)
    if not found.causes:
        return found, label
    recall = validate.recall(label, search.logged)
    if not recall < ENOUGH:
        return found, label
    plain = _labelled(search, moved, acts, Found(), parts)
    if validate.recall(plain, search.logged) > recall:
        return Found(), plain
    return found, label


def _labelled(search: _Search, moved: list[Any], acts: dynamics.Dynamics, found: Found, parts: _Parts) -> cbf.Barrier:
    """ℓ of one constraint."""
    content = _about(search, moved, found)
    template = eqx.filter_eval_shape(blank_barrier, search.logged.map, parts.settings, found)
    return parts.get("label", content, template, lambda key: _label(search, acts, parts.settings, found, key))


def _about(search: _Search, moved: list[Any], found: Found) -> list[Any]:
    """What a barrier is made of, beside its settings."""
    return [*moved, _digest(search.logged.label), search.logged.map.names, found]


def _with_future(label: cbf.Barrier, search: _Search, moved: list[Any], found: Found, parts: _Parts) -> cbf.Barrier:
    """ℓ and V of one constraint."""
    settings = parts.settings
    logged = search.logged
    steps = logged.fitted_steps

    def fit(key: Key) -> cbf.Barrier:
        return cbf.fit_future(
            label,
            logged.arrays,
            steps,
            steps[logged.close_to_danger()[steps]],
            key,
            discount=settings.future_discount,
            expectile=settings.expectile,
            updates=settings.future_updates,
        )

    template = eqx.filter_eval_shape(blank_barrier, logged.map, settings, found)
    return parts.get("future", _about(search, moved, found), template, fit)


def _label(search: _Search, acts: dynamics.Dynamics, settings: Settings, found: Found, key: Key) -> cbf.Barrier:
    """ℓ of a data set, with the statistics that it reads by."""
    logged = search.logged
    key_states, key_fit = jax.random.split(key)
    steps = logged.fitted_steps
    unsafe = logged.unsafe[steps]
    if unsafe.all() or not unsafe.any():
        raise UserError(
            f"All unsafe steps of '{logged.store.card.task}' lie in the episodes that are held out; log more of "
            "them, or take another seed."
        )
    data = logged.arrays["features"], logged.predicted(acts), logged.arrays["row"], on_device(logged.label)
    blank = _standardised(blank_barrier(logged.map, settings, found), logged, key_states)
    if found.causes:
        nets = fit_causes(
            found,
            search.result[1],
            data,
            steps[unsafe],
            steps[~unsafe],
            key_fit,
            share=settings.predicted_share,
            updates=settings.barrier_updates,
            width=settings.barrier_width,
        )
        nets = margins.in_own_margins(nets, acts, logged, np.random.default_rng(0))
        return dataclasses.replace(blank, causes=nets)
    return cbf.fit_label(
        blank,
        data,
        steps[unsafe],
        steps[~unsafe],
        key_fit,
        loss=settings.loss,
        penalty=settings.penalty,
        share=settings.predicted_share,
        updates=settings.barrier_updates,
        width=settings.barrier_width,
    )


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
    each = barrier.each if isinstance(barrier, cbf.MinBarrier) else (barrier,)
    names = [net.cause.name for one in each for net in one.causes]
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


# --- the cache ---


def cached_file(name: str, about: list[Any]) -> Path:
    """Where a part of a World, or the whole, is kept that follows from all that `about` tells."""
    written = msgspec.json.encode([FORMAT, name, *about], enc_hook=np.ndarray.tolist, order="deterministic")
    code = hashlib.sha256(written).hexdigest()[:16]
    return cache_dir() / "worlds" / f"{name}-{code}.safetensors"


@dataclass(eq=False)
class _Parts:
    """Parts of a World, from the cache where they have been made of the same data, settings and seed."""

    settings: Settings
    seed: int
    formula: dict[str, Any] | None  # the hazard that labels states
    cached: bool
    bar: Parts

    def file(self, name: str, content: list[Any], of: Sequence[str]) -> Path:
        """Where what depends on `content` and on the settings of the parts `of` is kept."""
        read = {"view", "execution", *(field for part in of for field in PARTS[part])}
        settings = {field: value for field, value in dataclasses.asdict(self.settings).items() if field in read}
        formula = self.formula if {"label", "future"} & set(of) else None
        return cached_file(name, [content, settings, self.seed, formula])

    def json(self, name: str, content: list[Any], kind: type[T], make: Callable[[], T]) -> T:
        """What is found about a part before it is fitted, likewise."""
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

    def get(self, name: str, content: list[Any], template: T, make: Callable[[Key], T]) -> T:
        """The part of that name; made, and then kept, where it is not there."""
        file = self.file(name, content, [*UPON[name], name])
        if self.cached and (kept := _read(file, template)) is not None:
            self.bar.skip(name)
            return kept
        with self.bar.part(name):
            made = make(jax.random.fold_in(jax.random.key(self.seed), list(PARTS).index(name)))
        if self.cached:
            save_named(file, named_arrays(made), {"key": file.stem})
        return made


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
