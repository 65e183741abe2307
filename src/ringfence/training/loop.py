"""The only training loop: compiled chunks of updates, several seeds, logs, checkpoints, exact resume.

Every update's randomness follows from (seed, step) alone, so a run that was killed and resumed equals one that was
not, and chunk lengths change nothing.
"""

from __future__ import annotations

import json
import operator
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.datasets import registry
from ringfence.errors import CheckpointError, RunConflict, UserError
from ringfence.logs.provenance import other_data, regenerated
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData, draw
from ringfence.training import worlds
from ringfence.training.job import Job, make_job
from ringfence.training.runs import Run, write_json
from ringfence.types import PyTree
from ringfence.utils.compilation import keep_programs
from ringfence.utils.environment import environment
from ringfence.utils.files import owned, whole
from ringfence.utils.progress import Progress
from ringfence.world import World
from ringfence.world import save as save_world


def train(
    algorithm: str,
    data: EpisodeStore,
    *,
    preset: str | None = None,
    seeds: tuple[int, ...] = (0,),
    out: str | Path = "runs",
    changes: dict | None = None,
    world: dict | None = None,
    together: bool = False,
    chunk: int | None = None,
    checkpoint_every: int | None = None,
    tensorboard: bool = False,
    quiet: bool = False,
    on_chunk: Callable[[int, dict], None] | None = None,
    on_finish: Callable[[Run], None] | None = None,
    folder: Callable[[int], Path] | None = None,
) -> list[Run]:
    """Train `algorithm` on `data` for every seed; returns one finished run folder per seed.

    A folder that exists is resumed from its last checkpoint if it holds the same job, and refused otherwise.
    `together` trains all seeds in one program (same results up to rounding; faster only where the networks are too
    small to fill the machine). `chunk` is the number of updates between log lines, a fortieth of all by default;
    `world` changes settings of the World that training reads (world/fitting.py `Settings`), if it reads one.
    `on_chunk` and `on_finish` are called after each of them and with each finished run. `folder` names the run folder
    of a seed, for those who do not want `out`/<task>/<algorithm>/seed-<k>.
    """
    keep_programs()
    if not isinstance(data, EpisodeStore):
        raise UserError(
            f"train() got data of type {type(data).__name__}; pass an EpisodeStore, e.g. "
            "ringfence.datasets.make.make(ringfence.datasets.registry.get(NAME))[0]."
        )
    seeds = _seeds(seeds)
    for name, value in (("chunk", chunk), ("checkpoint_every", checkpoint_every)):
        if value is not None and value < 1:
            raise UserError(f"{name}={value} must be at least 1; it is a number of updates.")
    if tensorboard:
        _summary_writer()
    task = registry.from_store(data)
    job = make_job(algorithm, task, preset, changes or {}, logs := task.logs(data), world)
    lessons = _Lessons(job, logs, quiet)
    place = folder or (lambda seed: folder_of(out, job, seed))
    runs = [Run(place(seed)) for seed in seeds]
    fresh = [run for run in runs if not run.path.exists()]
    with _undone(fresh):
        for run, seed in zip(runs, seeds):
            _prepare(run, job, seed, data)
    steps = job.config.steps
    for run in runs:
        run.drop_damaged()
    left = [run for run in runs if [step for step, _ in run.checkpoints()][-1:] != [steps]]
    chunk = chunk or max(1, steps // 40)
    options = _Options(chunk, checkpoint_every or max(chunk, steps // 4), tensorboard, quiet, on_chunk)
    if together and left:
        with _undone(fresh):
            _loop(job, lessons, left, [seed for run, seed in zip(runs, seeds) if run in left], options)
    program = None
    for run, seed in zip(runs, seeds):
        if run in left and not together:
            with _undone(fresh):
                program = _loop(job, lessons, [run], [seed], options, program)
        if on_finish:
            on_finish(run)
    return runs


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
        told = str(error)
        if isinstance(error, MemoryError) or any(word in told for word in ("RESOURCE_EXHAUSTED", "Out of memory")):
            raise UserError(
                "This machine has not enough memory for that; lower batch, width, horizon or the number of seeds."
            ) from error
        raise


def _seeds(given: Iterable[int]) -> tuple[int, ...]:
    """The seeds as they were given, if each is a number that JAX takes and none comes twice."""
    seeds = tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else None
    if seeds is None:
        raise UserError(f"seeds={given!r} must be several numbers; for so many seeds pass range({given}).")
    whole_numbers = all(isinstance(s, int | np.integer) and not isinstance(s, bool) for s in seeds)
    if not seeds or not whole_numbers or min(seeds) < 0 or max(seeds) >= 2**31 or len(set(seeds)) < len(seeds):
        raise UserError(f"seeds={seeds} must be one or more whole numbers from 0 to 2³¹ − 1, each of them once.")
    return tuple(int(s) for s in seeds)


@dataclass
class _Lessons:
    """What a seed learns from: the World, if training reads one, and windows. Those of the last seed are kept, which is
    all seeds' where no World is read."""

    job: Job
    store: EpisodeStore
    quiet: bool
    last: tuple[int, World | None, WindowData] | None = None

    def of(self, seed: int) -> tuple[World | None, WindowData]:
        if self.last is None or (self.last[0] != seed and self.job.world is not None):
            self.last = None  # there may be no room for two
            world = None
            if self.job.world is not None:
                world = worlds.fit(self.store, task=self.job.task, seed=seed, quiet=self.quiet, **self.job.world)
            self.last = (seed, world, windows_of(self.job, self.store, world))
        return self.last[1:]


def windows_of(job: Job, store: EpisodeStore, world: World | None = None) -> WindowData:
    """What a job draws its batches from."""
    if job.algorithm.prepare is None:
        return WindowData(store, job.feature_map)
    return job.algorithm.prepare(store, job.config, job.feature_map, world)


@dataclass(frozen=True)
class _Options:
    chunk: int
    checkpoint_every: int
    tensorboard: bool
    quiet: bool
    on_chunk: Callable[[int, dict], None] | None


def make_program(job: Job):
    """(advance, diagnose): compiled functions over a leading axis of seeds.

    advance(state, keys, arrays, scores, count) makes `count` updates, a traced number, so that one compilation serves
    every chunk length; it returns the new state and the chunk's mean metrics.
    """
    config = job.config
    update = job.algorithm.make_update(config, job.spec, job.feature_map, job.hazard)
    look = job.algorithm.make_diagnose(config, job.spec, job.feature_map, job.hazard)

    def one(state: PyTree, root, arrays, scores):
        arrays = arrays | {"scores": scores}
        key = jax.random.fold_in(root, state["step"])
        kd, ku = jax.random.split(key)
        return update(state, draw(arrays, kd, config.batch, config.horizon, config.history), ku)

    def advance(state, roots, arrays, scores, count):
        # No vmap of one seed: its matrix products would be batched ones, which are slower; and no axis of one within
        # the loop, for which the compiler would copy the whole state at every update.
        alone = roots.shape[0] == 1
        several, known = (one, roots[0]) if alone else (jax.vmap(one, in_axes=(0, 0, None, 0)), roots)
        scores = scores[0] if alone else scores
        state = jax.tree.map(lambda x: x[0], state) if alone else state
        shapes = jax.eval_shape(several, state, known, arrays, scores)[1]
        zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, jnp.float32), shapes)

        def body(_, carry):
            state, total = carry
            state, metrics = several(state, known, arrays, scores)
            return state, jax.tree.map(jnp.add, total, metrics)

        state, total = jax.lax.fori_loop(0, count, body, (state, zeros))
        means = jax.tree.map(lambda x: x / jnp.maximum(count, 1), total)
        return jax.tree.map(lambda x: x[None], (state, means)) if alone else (state, means)

    def diagnose(state, roots, arrays, scores):
        def of(state, root, scores):
            kd, ku = jax.random.split(jax.random.fold_in(root, state["step"]))
            return look(state, draw(arrays | {"scores": scores}, kd, config.batch, config.horizon, config.history), ku)

        return jax.vmap(of)(state, roots, scores)

    return jax.jit(advance, donate_argnums=0), jax.jit(diagnose)


def _loop(job: Job, lessons: _Lessons, runs: list[Run], seeds, options: _Options, program=None):
    """Train runs that nobody else trains at this time, in one program."""
    with ExitStack() as locks:
        for run in runs:
            locks.enter_context(owned(run.path, f"Another process trains '{run.path}'; wait for it or stop it."))
        return _advance(job, lessons, runs, seeds, options, program)


def _advance(job: Job, lessons: _Lessons, runs: list[Run], seeds, options: _Options, program):
    program = program or make_program(job)
    advance, diagnose = program
    roots = jax.vmap(jax.random.key)(jnp.asarray(seeds))
    starts, states, conditions = [], [], []
    for run, seed, root in zip(runs, seeds, roots):
        world, windows = lessons.of(seed)
        told = {} if world is None else {"world": world}
        key = jax.random.fold_in(root, 2**31 - 1)
        state = job.algorithm.init(key, job.spec, job.config, windows, job.feature_map, job.hazard, **told)
        if world is not None and not (run.path / worlds.WORLD).exists():
            save_world(world, run.path / worlds.WORLD)
        if run.checkpoints():
            state = state | run.load_checkpoint(learned(state))[1]
        starts.append(int(state["step"]))
        states.append(state)
        conditions.append(windows.arrays["scores"])
    if len(set(starts)) > 1:
        raise CheckpointError(
            f"The runs stand at different steps ({sorted(set(starts))}), so they cannot go on in one program; "
            "resume them one by one."
        )
    step, steps = starts[0], job.config.steps
    state = jax.tree.map(lambda *x: jnp.stack(x), *states)
    # Conditions differ between seeds, whose Worlds do; all else of the data is theirs together.
    arrays = {k: v for k, v in windows.arrays.items() if k != "scores"}
    conditions = jnp.stack(conditions)
    for run in runs:
        _trim_metrics(run, step)
    writers = [_summary_writer()(str(run.path / "tensorboard")) for run in runs] if options.tensorboard else []
    label = f"{job.algorithm.name}/{job.preset} {job.task.name} " + (
        f"seed {seeds[0]}" if len(seeds) == 1 else f"{len(seeds)} seeds"
    )
    saved = step if starts[0] else -1
    with Progress(label, steps, step, options.quiet) as bar:
        try:
            while step < steps:
                count = min(options.chunk - step % options.chunk, steps - step)
                begun = time.perf_counter()
                state, metrics = advance(state, roots, arrays, conditions, count)
                step += count
                metrics = {**metrics, **diagnose(state, roots, arrays, conditions)}
                metrics = {k: np.asarray(v) for k, v in metrics.items()}
                seconds = time.perf_counter() - begun
                for i, run in enumerate(runs):
                    row = {"step": step, "seconds": seconds / len(runs), "updates": count}
                    row |= {k: float(v[i]) for k, v in metrics.items()}
                    with open(run.path / "metrics.jsonl", "a") as f:
                        f.write(json.dumps(row) + "\n")
                    if writers:
                        for k, v in row.items():
                            writers[i].add_scalar(k, v, step)
                means = {k: float(v.mean()) for k, v in metrics.items()}
                bad = [k for k, v in means.items() if not np.isfinite(v)]
                if bad:
                    raise UserError(f"Training diverged: {bad[0]} is not finite at step {step}; lower lr.")
                bar.advance(count, means)
                if options.on_chunk:
                    options.on_chunk(step, means)
                if step // options.checkpoint_every > (step - count) // options.checkpoint_every or step == steps:
                    _save(runs, step, state)
                    saved = step
        except KeyboardInterrupt:
            if saved < step and not _deleted(state):
                _save(runs, step, state)
            raise
    if saved < step:
        _save(runs, step, state)
    for w in writers:
        w.close()
    return program


def learned(state: PyTree) -> PyTree:
    """What a checkpoint holds: all but what is read of the World, which stands beside it."""
    return {k: v for k, v in state.items() if k != "world"}


def _deleted(state: PyTree) -> bool:
    """An interruption inside a compiled call leaves donated buffers behind; there is nothing to save then."""
    return any(x.is_deleted() for x in jax.tree.leaves(state))


def _save(runs: list[Run], step: int, state: PyTree) -> None:
    host = jax.device_get(learned(state))
    for i, run in enumerate(runs):
        run.save_checkpoint(step, jax.tree.map(operator.itemgetter(i), host))


def folder_of(out: str | Path, job: Job, seed: int) -> Path:
    """runs/simple_spread-medium/icbf-split/seed-0"""
    name = job.algorithm.name if job.preset == "default" else f"{job.algorithm.name}-{job.preset}"
    return Path(out) / job.task.name / name / f"seed-{seed}"


def _prepare(run: Run, job: Job, seed: int, data: EpisodeStore) -> None:
    card = data.card if regenerated(data.card) else data.card | {"content": data.content}
    mine = json.loads(json.dumps(job.describe(seed, card)))
    if (run.path / "config.json").exists():
        older = {"revision": 1, "world": None} | {k: mine[k] for k in ("widths", "team")}  # that older runs do not tell
        there = older | run.config
        there["spec"] = {"homogeneous": False} | there.get("spec", {})
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
        write_json(run.path / "config.json", mine)


def _trim_metrics(run: Run, step: int) -> None:
    """Drop log lines past the checkpoint that training resumes from."""
    rows = [r for r in run.metrics if r["step"] <= step]
    file = run.path / "metrics.jsonl"
    if file.exists():
        with whole(file) as temporary:
            temporary.write_text("".join(json.dumps(r) + "\n" for r in rows))


def _summary_writer():
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise UserError("TensorBoard logs need an extra package; run pip install 'ringfence[tensorboard]'.") from None
    return SummaryWriter
