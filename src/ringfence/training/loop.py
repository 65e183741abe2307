"""The only training loop: compiled chunks of updates, several seeds, logs, checkpoints, exact resume.

Every update's randomness follows from (seed, step) alone, so a run that was killed and resumed equals one that was
not, and chunk lengths change nothing.
"""

from __future__ import annotations

import inspect
import json
import operator
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence import algos
from ringfence.datasets import registry
from ringfence.errors import CheckpointError, RunConflict, UserError, needs, of_kind, unknown, whole_number
from ringfence.logs.resolution import require_resolved
from ringfence.logs.schema import other_data
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData, draw
from ringfence.training import worlds
from ringfence.training.job import Job, make_job
from ringfence.training.runs import LOGS, Run, write_json
from ringfence.types import Array, Key, Metrics, PyTree
from ringfence.utils import interrupts
from ringfence.utils.compilation import keep_programs
from ringfence.utils.config import fields_of
from ringfence.utils.environment import environment
from ringfence.utils.files import owned, place, whole
from ringfence.utils.precision import in_float32
from ringfence.utils.progress import Progress
from ringfence.world import World
from ringfence.world import save as save_world

Arrays = dict[str, Array]


@in_float32
def train(
    algorithm: str,
    data: EpisodeStore,
    *,
    preset: str | None = None,
    seeds: tuple[int, ...] = (0,),
    out: str | Path = "runs",
    changes: dict | None = None,
    world: dict | None = None,
    vmap_seeds: bool = False,
    chunk: int | None = None,
    checkpoint_every: int | None = None,
    tensorboard: bool = False,
    quiet: bool = False,
    on_chunk: Callable[[int, dict], None] | None = None,
    on_finish: Callable[[Run], None] | None = None,
    folder: Callable[[int], Path] | None = None,
    **others: Any,
) -> list[Run]:
    """Train `algorithm` on `data` for every seed; returns one finished run folder per seed.

    A folder that exists is resumed from its last checkpoint if it holds the same job, and refused otherwise.
    `vmap_seeds` trains all seeds in one program (same results up to rounding; faster only where the networks are too
    small to fill the machine). `chunk` is the number of updates between log lines, a fortieth of all by default;
    `world` changes settings of the World that training reads (world/settings.py `Settings`), if it reads one.
    `on_chunk` and `on_finish` are called after each of them and with each finished run. `folder` names the run folder
    of a seed, for those who do not want `out`/<task>/<algorithm>/seed-<k>.
    """
    keep_programs()
    for name in others:
        if name in fields_of(algos.get(algorithm).Config):
            raise UserError(f"{name} is a setting of {algorithm}, not an argument; give changes={{'{name}': ...}}.")
        raise unknown("argument of train()", name, inspect.signature(train).parameters)
    _check_store(data)
    seeds = _seeds(seeds)
    of_kind("changes", changes, Mapping | None, "give a dictionary of settings")
    for name, value in (("chunk", chunk), ("checkpoint_every", checkpoint_every)):
        if value is not None:
            whole_number(name, value, 1)
    if tensorboard:
        _summary_writer()
    require_resolved(data)
    task = registry.from_store(data)
    job = make_job(algorithm, task, preset, changes or {}, logs := task.logs(data), world)
    folder = folder or (lambda seed: folder_of(out, job, seed))
    runs = [Run(folder(seed)) for seed in seeds]
    fresh = [run for run in runs if not run.path.exists()]
    card = worlds.card_of(data)
    with _undone(fresh):
        for run, seed in zip(runs, seeds):
            _prepare(run, job, seed, data, card)
    steps = job.config.num_updates
    for run in runs:
        run.drop_damaged()
    chunk = chunk or max(1, steps // 40)
    every = checkpoint_every or max(chunk, steps // 4)
    options = _Options(chunk, every, tensorboard, quiet, on_chunk, on_finish, vmap_seeds)
    _finish_all(job, _Lessons(job, data, logs, quiet), runs, seeds, fresh, options)
    return runs


def _finish_all(
    job: Job, lessons: _Lessons, runs: list[Run], seeds: Sequence[int], fresh: list[Run], options: _Options
) -> None:
    """Train the runs that are not finished, together or one after the other."""
    left = [run for run in runs if [step for step, _ in run.checkpoints()][-1:] != [job.config.num_updates]]
    if options.vmap_seeds and left:
        with _undone(fresh):
            _loop(job, lessons, left, [seed for run, seed in zip(runs, seeds) if run in left], options)
    program = None
    for run, seed in zip(runs, seeds):
        if run in left and not options.vmap_seeds:
            with _undone(fresh):
                program = _loop(job, lessons, [run], [seed], options, program)
        if options.on_finish:
            options.on_finish(run)


def _check_store(data: EpisodeStore) -> None:
    if not isinstance(data, EpisodeStore):
        raise UserError(
            f"train() got data of type {type(data).__name__}; pass an EpisodeStore, e.g. "
            "ringfence.datasets.make.make(ringfence.datasets.registry.get(NAME))[0]."
        )


@contextmanager
def _undone(fresh: list[Run]) -> Iterator[None]:
    """A start that fails leaves no folder in the way of the right one."""
    try:
        yield
    except Exception as error:
        for run in fresh:
            if not run.checkpoints():
                with suppress(UserError), owned(run.path, "another process trains there by now"):
                    shutil.rmtree(run.path, ignore_errors=True)
        message = str(error)
        if isinstance(error, MemoryError) or any(word in message for word in ("RESOURCE_EXHAUSTED", "Out of memory")):
            raise UserError(
                "This machine has not enough memory for that; lower batch, width, horizon or the number of seeds."
            ) from error
        raise


def _seeds(given: Iterable[int]) -> tuple[int, ...]:
    """The seeds as they were given, if each is a number that JAX takes and none comes twice."""
    seeds = tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else None
    if seeds is None:
        raise UserError(f"seeds={given!r} must be several whole numbers; give e.g. range(5), or (0, 1, 2).")
    whole_numbers = all(isinstance(s, int | np.integer) and not isinstance(s, bool) for s in seeds)
    if not seeds or not whole_numbers or min(seeds) < 0 or max(seeds) >= 2**31 or len(set(seeds)) < len(seeds):
        raise UserError(f"seeds={seeds} must be one or more whole numbers from 0 to 2³¹ − 1, each of them once.")
    return tuple(int(s) for s in seeds)


@dataclass
class _Lessons:
    """What a seed learns from: the World, if training reads one, and windows. Those of the last seed are kept, which is
    all seeds' where no World is read."""

    job: Job
    data: EpisodeStore
    logs: EpisodeStore  # of the data, as the task splits them
    quiet: bool
    last: tuple[int, World | None, WindowData] | None = None

    def of(self, seed: int) -> tuple[World | None, WindowData]:
        if self.last is None or (self.last[0] != seed and self.job.world is not None):
            self.last = None  # there may be no room for two
            world = None
            if self.job.world is not None:
                world = worlds.fit(self.data, seed=seed, quiet=self.quiet, **self.job.world)
            self.last = (seed, world, windows_of(self.job, self.logs, world))
        return self.last[1:]


def window_history(config: Any) -> int:
    """Rows of the past in the windows that training draws: an algorithm's own, or more where its config says so."""
    return getattr(config, "window_history", config.history)


def windows_of(job: Job, store: EpisodeStore, world: World | None = None) -> WindowData:
    """What a job draws its batches from."""
    if job.algorithm.make_windows is None:
        return WindowData(store, job.feature_map)
    return job.algorithm.make_windows(store, job.config, job.feature_map, world)


@dataclass(frozen=True)
class _Options:
    chunk: int
    checkpoint_every: int
    tensorboard: bool
    quiet: bool
    on_chunk: Callable[[int, dict], None] | None
    on_finish: Callable[[Run], None] | None
    vmap_seeds: bool


class Program(NamedTuple):
    """Compiled functions over a leading axis of seeds."""

    # (state, keys, arrays, scores, count) -> the state after `count` updates and their mean metrics; the count is
    # traced, so that one compilation serves every chunk length
    advance: Callable[..., tuple[PyTree, Metrics]]
    diagnose: Callable[..., Metrics]  # (state, keys, arrays, scores) -> metrics


def make_program(job: Job) -> Program:
    """What trains a job."""
    config = job.config
    update = job.algorithm.make_update(config, job.spec, job.feature_map, job.hazard)
    look = job.algorithm.make_diagnose(config, job.spec, job.feature_map, job.hazard)

    def one(state: PyTree, root: Key, arrays: Arrays, scores: Array) -> tuple[PyTree, Metrics]:
        arrays = arrays | {"scores": scores}
        draw_key, update_key = jax.random.split(jax.random.fold_in(root, state["step"]))
        batch = draw(arrays, draw_key, config.batch, config.horizon, window_history(config))
        return update(state, batch, update_key)

    def advance(state: PyTree, roots: Key, arrays: Arrays, scores: Array, count: int) -> tuple[PyTree, Metrics]:
        # No vmap of one seed: its matrix products would be batched ones, which are slower; and no axis of one within
        # the loop, for which the compiler would copy the whole state at every update.
        alone = roots.shape[0] == 1
        if alone:
            state = jax.tree.map(lambda x: x[0], state)
            roots = roots[0]
            scores = scores[0]
        several = one if alone else jax.vmap(one, in_axes=(0, 0, None, 0))
        shapes = jax.eval_shape(several, state, roots, arrays, scores)[1]
        zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, jnp.float32), shapes)

        def body(_: Array, carry: tuple[PyTree, Metrics]) -> tuple[PyTree, Metrics]:
            state, total = carry
            state, metrics = several(state, roots, arrays, scores)
            return state, jax.tree.map(jnp.add, total, metrics)

        state, total = jax.lax.fori_loop(0, count, body, (state, zeros))
        means = jax.tree.map(lambda x: x / jnp.maximum(count, 1), total)
        return jax.tree.map(lambda x: x[None], (state, means)) if alone else (state, means)

    def diagnose(state: PyTree, roots: Key, arrays: Arrays, scores: Array) -> Metrics:
        def of(state: PyTree, root: Key, scores: Array) -> Metrics:
            draw_key, key = jax.random.split(jax.random.fold_in(root, state["step"]))
            batch = draw(arrays | {"scores": scores}, draw_key, config.batch, config.horizon, window_history(config))
            return look(state, batch, key)

        return jax.vmap(of)(state, roots, scores)

    return Program(jax.jit(advance, donate_argnums=0), jax.jit(diagnose))


def _loop(
    job: Job,
    lessons: _Lessons,
    runs: list[Run],
    seeds: Sequence[int],
    options: _Options,
    program: Program | None = None,
) -> Program:
    """Train runs that nobody else trains at this time, in one program."""
    with ExitStack() as locks:
        for run in runs:
            locks.enter_context(owned(run.path, f"Another process trains '{run.path}'; wait for it or stop it."))
        program = program or make_program(job)
        _Training.begin(job, lessons, runs, seeds, options).finish(program)
    return program


@dataclass
class _Training:
    """Runs of several seeds under way."""

    job: Job
    runs: list[Run]
    options: _Options
    label: str
    roots: Key  # (seeds,)
    arrays: Arrays  # of the data, the same for all
    scores: Array  # (seeds, T): conditions differ between seeds, whose Worlds do
    state: PyTree
    step: int
    saved: int  # step of the last checkpoint; −1: none
    writers: list[Any]  # of TensorBoard

    @classmethod
    def begin(cls, job: Job, lessons: _Lessons, runs: list[Run], seeds: Sequence[int], options: _Options) -> _Training:
        """Fresh states, or those of the last checkpoints."""
        roots = jax.vmap(jax.random.key)(np.array(seeds))
        states: list[PyTree] = []
        scores: list[Array] = []
        arrays: Arrays = {}
        for run, seed, root in zip(runs, seeds, roots):
            world, windows = lessons.of(seed)
            # A seed's state: fresh, or that of its last checkpoint. The World that it reads is kept beside it.
            read = {} if world is None else {"world": world}
            key = jax.random.fold_in(root, 2**31 - 1)
            begun = job.algorithm.init(key, job.spec, job.config, windows, job.feature_map, job.hazard, **read)
            if world is not None and not (run.path / worlds.WORLD).exists():
                save_world(world, run.path / worlds.WORLD)
            if run.checkpoints():
                begun = begun | run.load_checkpoint(learned(begun))[1]
            states.append(begun)
            scores.append(windows.arrays["scores"])
            arrays = {name: array for name, array in windows.arrays.items() if name != "scores"}
        steps = sorted({int(state["step"]) for state in states})
        if len(steps) > 1:
            raise CheckpointError(
                f"The runs stand at different steps ({steps}), so they cannot go on in one program; resume them one "
                "by one."
            )
        for run in runs:
            # Drop log lines past the checkpoint that training resumes from.
            rows = [r for r in run.metrics if r["step"] <= steps[0]]
            file = run.path / "metrics.jsonl"
            if file.exists():
                with whole(file) as temporary:
                    temporary.write_text("".join(json.dumps(r) + "\n" for r in rows))
        whose = f"seed {seeds[0]}" if len(seeds) == 1 else f"{len(seeds)} seeds"
        tensorboard = [_summary_writer()(str(run.path / "tensorboard")) for run in runs if options.tensorboard]
        return cls(
            job=job,
            runs=runs,
            options=options,
            label=f"{job.algorithm.name}/{job.preset} {job.task.name} {whose}",
            roots=roots,
            arrays=arrays,
            scores=_stacked(*scores),
            state=_stacked(*states),
            step=steps[0],
            saved=steps[0] or -1,
            writers=tensorboard,
        )

    def finish(self, program: Program) -> None:
        """Train to the last step; an interruption keeps what is there."""
        steps = self.job.config.num_updates
        with Progress(self.label, steps, self.step, self.options.quiet) as bar:
            try:
                while self.step < steps:
                    count = min(self.options.chunk - self.step % self.options.chunk, steps - self.step)
                    with interrupts.held(self.saved < self.step):
                        means = self._advance(program, count)
                    bar.advance(count, means)
                    if self.options.on_chunk:
                        self.options.on_chunk(self.step, means)
                    every = self.options.checkpoint_every
                    if self.step // every > (self.step - count) // every or self.step == steps:
                        self._save()
            except KeyboardInterrupt:
                # Inside a compiled call it leaves donated buffers behind; there is nothing to save then.
                if self.saved < self.step and not any(x.is_deleted() for x in jax.tree.leaves(self.state)):
                    self._save()
                raise
        if self.saved < self.step:
            self._save()
        for writer in self.writers:
            writer.close()

    def _advance(self, program: Program, count: int) -> dict[str, float]:
        """One chunk of updates, logged; its metrics as means over the seeds."""
        begun = time.perf_counter()
        data = (self.roots, self.arrays, self.scores)
        self.state, metrics = program.advance(self.state, *data, count)
        self.step += count
        metrics = {**metrics, **program.diagnose(self.state, *data)}
        values = {name: np.asarray(value) for name, value in metrics.items()}
        if (counted := int(self.state["step"][0])) != self.step:  # so did JAX 0.5.3 with a program that it had kept
            raise UserError(
                f"After {self.step} updates the state counts {counted}: JAX {jax.__version__} plays programs wrongly "
                "that it kept; unset JAX_COMPILATION_CACHE_DIR, or update jax."
            )
        self._log(values, count, time.perf_counter() - begun)
        means = {name: float(value.mean()) for name, value in values.items()}
        diverged = [name for name, value in means.items() if not np.isfinite(value)]
        if diverged:
            raise UserError(f"Training diverged: {diverged[0]} is not finite at step {self.step}; lower lr.")
        return means

    def _log(self, values: dict[str, np.ndarray], count: int, seconds: float) -> None:
        """A line for every run."""
        for i, run in enumerate(self.runs):
            row = {"step": self.step, "seconds": seconds / len(self.runs), "updates": count}
            row |= {name: float(value[i]) for name, value in values.items()}
            with open(run.path / "metrics.jsonl", "a") as file:
                file.write(json.dumps(row) + "\n")
            if self.writers:
                for name, value in row.items():
                    self.writers[i].add_scalar(name, value, self.step)

    def _save(self) -> None:
        host = jax.device_get(learned(self.state))
        for i, run in enumerate(self.runs):
            run.save_checkpoint(self.step, jax.tree.map(operator.itemgetter(i), host))
        self.saved = self.step


@jax.jit  # one program, and not one for each shape
def _stacked(*states: PyTree) -> PyTree:
    """States of several seeds as one, with a leading axis."""
    return jax.tree.map(lambda *x: jnp.stack(x), *states)


def learned(state: PyTree) -> PyTree:
    """What a checkpoint holds: all but what is read of the World, which stands beside it."""
    return {k: v for k, v in state.items() if k != "world"}


def folder_of(out: str | Path, job: Job, seed: int) -> Path:
    """runs/simple_spread-medium/icbf/seed-0"""
    name = job.algorithm.name if job.preset == "default" else f"{job.algorithm.name}-{job.preset}"
    return place(out) / job.task.name / name / f"seed-{seed}"


def _prepare(run: Run, job: Job, seed: int, data: EpisodeStore, card: dict[str, Any]) -> None:
    mine = json.loads(json.dumps(job.describe(seed, card)))
    if (run.path / "config.json").exists():
        there = run.config
        different = [k for k in mine if k != "data" and there.get(k) != mine[k]]
        different += [f"data's {name}" for name, *_ in other_data(there.get("data") or {}, mine["data"])]
        if different:
            what = different[0]
            if what == "config":
                here, then = mine["config"], there["config"]
                what = next(k for k in {**here, **then} if (k in here, here.get(k)) != (k in then, then.get(k)))
            raise RunConflict(
                f"'{run.path}' holds another run (its {what} differs); give another --out or delete that folder.",
                run.path,
            )
    else:  # the config last: a folder without one is begun anew
        write_json(run.path / "env.json", environment())
        write_json(run.path / "episodes.json", data.digests_of_episodes)
        if job.task.env is None:  # rows of a benchmark's data are made with its references
            write_json(run.path / LOGS, data.outcomes)
        write_json(run.path / "config.json", mine)


def _summary_writer():
    with needs("tensorboard", "TensorBoard logs"):
        from tensorboardX import SummaryWriter
    return SummaryWriter
