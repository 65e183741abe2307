"""Fitting a World: per data set, settings and seed; parts are cached by content, so that data sets which differ in
their costs alone share what does not depend on them, and an interrupted fit goes on with the part that it was at."""

from __future__ import annotations

import copy
import dataclasses
import functools
import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import save_file

from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData, returns_to_go
from ringfence.problem import constraints, features
from ringfence.problem.normalise import varying
from ringfence.types import PyTree, Spec
from ringfence.utils.cache import cache_dir
from ringfence.utils.files import whole
from ringfence.utils.pytrees import load_named, named_arrays
from ringfence.world import barrier as cbf
from ringfence.world import dynamics, values
from ringfence.world import validate as cards
from ringfence.world.card import Card
from ringfence.world.model import World
from ringfence.world.settings import Settings
from ringfence.world.storage import _blank, _blank_barrier, load, save

FORMAT = 4  # of what is fitted: what is cached of another is made again
HELD_OUT = 0.1  # of the episodes, whole ones
FEWEST = 5  # episodes that can be divided
CLOSE = 20  # steps before danger that its value is learned from most
STRANGE = 0.95  # of held-out episodes stay below the ensemble's threshold throughout


PARTS = {
    "dynamics": ("members", "dynamics_updates", "dynamics_width"),
    "values": ("discount", "value_updates"),
    "label": ("labels", "loss", "penalty", "foreseen", "distances", "both_ends", "barrier_width", "barrier_updates"),
    "future": ("future_updates", "future_discount", "expectile"),
}
UPON = {"dynamics": (), "values": (), "label": ("dynamics",), "future": ("dynamics", "label")}  # what a part reads


def fit_view(
    store: EpisodeStore,
    map: features.FeatureMap,
    spec: Spec,
    settings: Settings,
    *,
    hazard: constraints.BoundHazard | None = None,
    seed: int = 0,
    cached: bool = True,
    quiet: bool = True,
) -> World:
    """The World of a store in the view `map` of `spec`; from the cache where it has been fitted before.

    `hazard`, bound to the view, labels states where `settings.labels` is "formula". A tenth of the episodes is held
    out of every part; the card tells what they say.
    """
    by = None if hazard is None or settings.labels != "formula" else constraints.to_dict(hazard.hazard)
    parts = _Parts(settings, seed, by, cached)
    about = [cards.VERSION, store.content, features.to_dict(map), settings.missed, settings.barrier]
    file = parts.file("world", list(PARTS), about + ([store.limits] if store.limits else []))
    if cached and (kept := _kept_world(file, map)) is not None:
        return kept
    world = _fitted(store, map, spec, hazard, parts, quiet)
    if cached:
        save(world, file)
    return world


def _fitted(
    store: EpisodeStore,
    map: features.FeatureMap,
    spec: Spec,
    hazard: constraints.BoundHazard | None,
    parts: _Parts,
    quiet: bool,
) -> World:
    begun, s, alone = time.perf_counter(), parts.settings, parts.settings.sight == "own"
    map = features.alone(map) if alone else map
    labels = labels_of(store, map, s, hazard) if s.barrier else {}
    told = _Told(store, map, held_out(store, parts.seed), labels)
    fitted, arrays, blank = told.fitted, told.arrays, _blank(map, spec, s)
    moved = store.digest("observations", "state", "actions", "episode_ends", "terminated")

    acts = parts.get(
        "dynamics",
        [moved],
        blank.dynamics,
        lambda key: dynamics.fit_dynamics(
            arrays["features"],
            arrays["actions"][fitted],
            arrays["row"][fitted],
            map,
            key,
            members=s.members,
            updates=s.dynamics_updates,
            width=s.dynamics_width,
            label="" if quiet else "forward dynamics, what actions do",
        ),
    )
    worth = parts.get(
        "values",
        [moved, store.digest("rewards")],
        blank.values,
        lambda key: values.fit_values(
            arrays | {"togo": told.togo(s.discount, alone)},
            jnp.asarray(fitted),
            map,
            key,
            discount=s.discount,
            updates=s.value_updates,
            period=told.longest,
            alone=alone,
            quiet=quiet,
        ),
    )
    each = [_barrier_of(told.of(name), moved, acts, parts, quiet) for name in labels]
    danger = (cbf.Worst(tuple(each), tuple(labels)) if told.several else each[0]) if each else None
    world = World(acts, worth, danger, jnp.ones(()), map, spec, alone, Card({}))
    judged, strange, danger = cards.judge(world, told, STRANGE, s.missed, s.loss)
    facts = {
        "format": FORMAT,
        "data": {
            "task": store.card["task"],
            "content": store.card.get("content", store.content),
            "episodes": store.episodes // store.card.get("team", 1),
            "hazard": store.card["hazard"],
            **({"constraints": store.limits} if told.several else {}),
        },
        "settings": dataclasses.asdict(s),
        "seed": parts.seed,
        "shape": _shape_in_words(danger),
        "seconds": {k: round(v, 1) for k, v in parts.seconds.items()}
        | {"in all": round(time.perf_counter() - begun, 1)},
        **judged,
    }
    return World(acts, worth, danger, jnp.asarray(strange, jnp.float32), map, spec, alone, Card(facts))


def _barrier_of(told: _Told, moved: str, acts: dynamics.Dynamics, parts: _Parts, quiet: bool) -> cbf.Barrier:
    """ℓ and V of one constraint."""
    s, blank = parts.settings, eqx.filter_eval_shape(_blank_barrier, told.map, parts.settings)
    bad = [moved, hashlib.blake2b(told.label.tobytes(), digest_size=8).hexdigest()]
    now = parts.get("label", bad, blank, lambda key: _label(told, _blank_barrier(told.map, s), acts, s, key, quiet))
    return parts.get(
        "future",
        bad,
        blank,
        lambda key: cbf.fit_future(
            now,
            told.arrays,
            told.fitted,
            told.fitted[told.close[told.fitted]],
            key,
            discount=s.future_discount,
            expectile=s.expectile,
            updates=s.future_updates,
            quiet=quiet,
        ),
    )


@dataclass(eq=False)
class _Parts:
    """Parts of a World, from the cache where they have been made of the same data, settings and seed."""

    settings: Settings
    seed: int
    formula: dict | None  # the hazard that labels states
    cached: bool
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)  # that making took

    def file(self, name: str, of: list[str], content: list) -> Path:
        """Where what depends on the settings of the parts `of` and on `content` is kept."""
        s = self.settings
        fields = {f: getattr(s, f) for part in of for f in PARTS[part]}
        about = [FORMAT, name, content, s.view, s.sight, fields, self.seed]
        about += [self.formula] if self.formula and {"label", "future"} & set(of) else []
        code = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]
        return cache_dir() / "worlds" / f"{name}-{code}.safetensors"

    def get(self, name: str, content: list, template: PyTree, make: Callable[[jax.Array], PyTree]) -> PyTree:
        file = self.file(name, [*UPON[name], name], content)
        if self.cached and (kept := _read(file, template)) is not None:
            return kept
        begun = time.perf_counter()
        made = make(jax.random.fold_in(jax.random.key(self.seed), list(PARTS).index(name)))
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begun
        if self.cached:
            _write(file, made)
        return made


@dataclass(eq=False)
class _Told:
    """A data set as fits and judges read it."""

    store: EpisodeStore
    map: features.FeatureMap
    held: np.ndarray  # (E,) bool
    labels: dict[str, np.ndarray]  # (T,) or (T, N) bool: unsafe, by constraint; "" where danger is one

    def __post_init__(self):
        self.label = functools.reduce(np.logical_or, self.labels.values()) if self.labels else None
        self.arrays = WindowData(self.store, self.map).arrays
        out = self.held[self.store.episode_of_step]
        self.fitted, self.kept = np.flatnonzero(~out), np.flatnonzero(out)
        self.longest = int(self.store.lengths.max()) + 1

    @property
    def several(self) -> bool:
        """Whether constraints are told apart."""
        return bool(self.labels) and "" not in self.labels

    def of(self, name: str) -> _Told:
        """The same with the label of one constraint."""
        one = copy.copy(self)
        one.labels, one.label = {name: self.labels[name]}, self.labels[name]
        return one

    def foreseen(self, acts: dynamics.Dynamics) -> jax.Array:
        """(T, N, D) where every step's actions were foreseen to lead."""
        step = jax.jit(lambda acts, x, action: acts.step(x, action)[0])
        parts, size = [], 50_000
        for i in range(0, self.store.steps, size):
            before = self.arrays["features"][self.arrays["row"][i : i + size]]
            parts.append(step(acts, before, self.arrays["actions"][i : i + size]))
        return jnp.concatenate(parts)

    @property
    def close(self) -> np.ndarray:
        """(T,) bool: within CLOSE steps before danger, or in it."""
        unsafe = self.label if self.label.ndim == 1 else self.label.any(1)
        found, episode = unsafe.copy(), self.store.episode_of_step
        for k in range(1, min(CLOSE, len(unsafe))):
            found[:-k] |= unsafe[k:] & (episode[k:] == episode[:-k])
        return found

    def togo(self, discount: float, each: bool = False) -> jax.Array:
        """(T,) return-to-go of the team, or (T, N) of each agent."""
        rewards = self.store.rewards if each else self.store.rewards.mean(1)
        return jnp.asarray(returns_to_go(rewards, self.store.lengths, discount), jnp.float32)


def held_out(store: EpisodeStore, seed: int) -> np.ndarray:
    """(E,) bool: the episodes that no part of a World of this seed learns from."""
    if store.episodes < FEWEST:
        raise UserError(
            f"'{store.card['task']}' has {store.episodes} episodes, too few to hold some out; a World needs {FEWEST} "
            "or more: cut long recordings into episodes."
        )
    team = store.card.get("team", 1)  # who were together are held out together
    episodes = store.episodes // team
    out = np.zeros(episodes, bool)
    count = max(1, round(HELD_OUT * episodes))
    out[np.random.default_rng([seed, 77]).choice(episodes, count, replace=False)] = True
    return np.tile(out, team)


def labels_of(
    store: EpisodeStore, map: features.FeatureMap, settings: Settings, hazard: constraints.BoundHazard | None
) -> dict[str, np.ndarray]:
    """(T,) or (T, N) bool: the steps that are unsafe, by each constraint that the store names, or under the name "" by
    costs or by the formula of the states that they lead to."""
    name = store.card["task"]
    if settings.labels == "formula":
        if hazard is None or not hazard.has_formula:
            raise UserError(
                f"labels='formula' needs a formula of danger, which '{name}' has not; take labels='costs', or give its "
                "card a hazard."
            )
        row = np.arange(store.steps) + store.episode_of_step + 1
        x = map(store.observations, store.state)
        judge = jax.jit(lambda x: hazard.labels(x)[0])
        found = [np.asarray(judge(x[row[i : i + 100_000]])) for i in range(0, len(row), 100_000)]
        unsafe, where = {"": np.concatenate(found)}, "the formula's labels"
    elif store.limits:
        unsafe, where = {k: store.of_constraint(k) > 0 for k in store.limits}, "the costs"
    else:
        unsafe, where = {"": store.costs > 0}, "the costs"
    for which, bad in unsafe.items():
        of = f" by '{which}'" if which else ""
        for empty, kind, none in ((0.0, "0", "unsafe"), (1.0, "above 0", "safe")):
            if bad.mean() == empty:
                raise UserError(
                    f"No step of '{name}' is {none}{of}: {where} are {kind} everywhere, so nothing tells a barrier "
                    "what danger is; give costs that are 0 on safe steps and above 0 on unsafe ones, or "
                    + ("leave that constraint out." if which else "fit with barrier=False.")
                )
    return unsafe


def _label(
    told: _Told, blank: cbf.Barrier, acts: dynamics.Dynamics, settings: Settings, key: jax.Array, quiet: bool
) -> cbf.Barrier:
    """ℓ of a data set, with the statistics that it reads by."""
    kd, kf = jax.random.split(key)
    row = told.arrays["row"][told.fitted]
    some = row[jax.random.randint(kd, (min(20_000, 4 * len(row)),), 0, len(row))]
    n, d = told.arrays["features"].shape[1:]
    before, after = (np.asarray(told.arrays["features"][k], np.float64) for k in (some, some + 1))
    moved, flat = (after - before).reshape(-1, d), after.reshape(-1, d)
    mean, scale = flat.mean(0), varying(flat.std(0), flat.mean(0))
    mean, scale = cbf.isotropic(blank.shape, mean, scale)
    step_scale = varying(moved.std(0), np.abs(mean) + scale)
    stats = [jnp.asarray(v, jnp.float32) for v in (mean, scale, moved.mean(0), step_scale)]
    start = eqx.tree_at(lambda b: (b.mean, b.scale, b.step_mean, b.step_scale), blank, stats)
    any_unsafe = told.label if told.label.ndim == 1 else told.label.any(1)
    bad, fine = (told.fitted[any_unsafe[told.fitted] == x] for x in (True, False))
    if not len(bad) or not len(fine):
        raise UserError(
            f"All unsafe steps of '{told.store.card['task']}' lie in the episodes that are held out; log more of them, "
            "or take another seed."
        )
    data = told.arrays["features"], told.foreseen(acts), told.arrays["row"], jnp.asarray(told.label)
    return cbf.fit_label(
        start,
        data,
        bad,
        fine,
        kf,
        loss=settings.loss,
        penalty=settings.penalty,
        share=settings.foreseen,
        updates=settings.barrier_updates,
        width=settings.barrier_width,
        quiet=quiet,
    )


def _shape_in_words(barrier: cbf.Barrier | cbf.Worst | None) -> str:
    if barrier is None:
        return "no barrier"
    shape = barrier.shape
    if shape.pairs:
        kinds = ", ".join(f"{len(entries)} x {kind}" for kind, entries in shape.pairs)
        return f"one network for all pairs ({kinds}), the worst one counts"
    if shape.joint or shape.blame == "all":
        return "one body: everybody answers for its danger"
    return (
        "one network per agent on all it sees; no names like other0.dx tell which entries belong to which other, so "
        "pairs could not be told apart"
    )


# --- files ---


def _write(file: Path, tree: PyTree) -> None:
    with whole(file) as temporary:
        save_file(named_arrays(tree), temporary)


def _read(file: Path, template: PyTree) -> PyTree | None:
    """A cached part; None where there is none, or a damaged one."""
    if not file.exists():
        return None
    try:
        return load_named(file, template)
    except (SafetensorError, OSError, UserError):
        return None


def _kept_world(file: Path, map: features.FeatureMap) -> World | None:
    """A cached World; None likewise."""
    if not file.exists():
        return None
    try:
        return load(file, lambda *_: map)
    except UserError:
        return None
