"""A margin is calibrated behind faults, and what it then promises is counted on fresh episodes.

The score of an episode is the most by which a state scored less than was predicted of it: over its steps, the least
score of the state that an action was predicted to lead to, less that of the state it led to. A guard whose margin
covers it keeps that state's score at 0 or above, wherever it could keep its margin. The quantile over episodes is
conformal (Vovk et al. 2005), but another margin makes other episodes. So it is raised until a fresh batch agrees, and
frozen. Then new episodes are played, and the bound is exact (Clopper and Pearson 1934), whatever the calibration was
worth.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.datasets.task import Task
from ringfence.envs.base import Moment, NativeEnv
from ringfence.envs.episode import Cost, Episode
from ringfence.errors import UserError, whole_number
from ringfence.evaluation.certificate import Certificate, Round, digest
from ringfence.evaluation.compensation import compensated
from ringfence.evaluation.play import name_of, play_all, simulators_of
from ringfence.evaluation.player import player_of_run
from ringfence.evaluation.protocol import FORESEEN, RESETS, Played, rollout
from ringfence.evaluation.replay import Body, Logs
from ringfence.evaluation.replay_stage import Stage
from ringfence.evaluation.statistics import upper_bound
from ringfence.evaluation.stress import check_simulator
from ringfence.faults import Faults
from ringfence.faults.policy import under_faults
from ringfence.guards import Guard
from ringfence.guards.policy import Guarded
from ringfence.guards.wrap import Nothing
from ringfence.loading.resolve import Resolved, resolve
from ringfence.loading.spec import PolicySpec
from ringfence.logs.store import EpisodeStore
from ringfence.problem.homogeneous import local_features
from ringfence.training.runs import Run
from ringfence.types import Array
from ringfence.utils.compilation import keep_programs
from ringfence.utils.precision import float32, in_float32
from ringfence.utils.progress import Progress
from ringfence.world import World

MAX_ROUNDS = 4  # of calibration
WIDEST = 6.0  # margin: at more a guard does little but stand
BOUND_ELSEWHERE = (
    "and certificates need something to play in: a simulator of your own (--env FILE.py:NAME), or logs that are "
    "replayed (--logs)."
)
SIDE_BY_SIDE = 16  # simulators of one's own
EVERY = 10**9  # windows: all that there are

Part = Literal["calibration", "test"]


@in_float32
def certify(
    run: Run | str,
    faults: Faults | Mapping[str, Any] | None = None,
    *,
    guard: str = "shield",
    confidence: float = 0.95,
    quantile: float = 0.95,
    calibration: int = 100,
    episodes: int = 300,
    compensate: bool = True,
    make_env: Callable[[], Any] | None = None,
    cost: Cost | None = None,
    logs: EpisodeStore | None = None,
    kinematics: str | None = None,
    wheelbase: float = Body.wheelbase,
    radius: float | None = None,
    steps: int | None = None,
    every_episode: bool = False,
    quiet: bool = True,
    **options: Any,
) -> Certificate:
    """The certificate of a guarded run behind faults.

    `calibration` episodes of each batch (validation resets) give the margin: the `quantile` of their shortfalls, where
    it is above the guard's own. `episodes` fresh ones (test resets) give the bound at the given `confidence`. Other
    options are as in `load` and `stress`.

    With `make_env` these are episodes of a simulator of one's own, and `cost` is of its infos, both as in `play`.

    With `logs` these are windows in which the run drives one agent and the others do what they did, at most so many:
    the margin is calibrated on the first half of the logs, and the second half gives the bound. `kinematics`,
    `wheelbase`, `radius`, `steps` and `every_episode` are as in `replay`.
    """
    faults = faults if isinstance(faults, Faults) else Faults.of(faults or {})
    least = _check(confidence, quantile, calibration, episodes)
    body = Body(kinematics, wheelbase, radius, steps, every_episode)
    options = {**options, "guard": guard}
    keep_programs()
    unread = [f.name for f in dataclasses.fields(body) if getattr(body, f.name) != f.default]
    if logs is None and unread:
        raise UserError(f"{unread[0]} is of replays; give logs=, the store that is replayed, or leave it out.")
    if logs is None and make_env is None:
        check_simulator(PolicySpec.of(run, **options), BOUND_ELSEWHERE)
    if logs is not None and make_env is not None:
        raise UserError("logs and make_env both say what is played; give one of them.")
    if cost is not None and make_env is None:
        raise UserError("cost is of the infos of a simulator of one's own; give make_env=, or leave cost out.")
    if compensate:
        options = compensated(run, faults, options)
    resolved = _resolved(run, options)
    counts: dict[Part, int] = {"calibration": calibration, "test": episodes}
    trials: Simulated | Windowed | Own = Simulated(faults, counts, quiet)
    if make_env is not None:
        trials = Own(make_env, faults, counts, cost, quiet)
    elif logs is not None:
        trials = Windowed.of(logs, resolved.run, _guard(resolved).world, body, faults, counts, least, quiet)
    resolved, rounds = _calibrated(run, options, resolved, trials, quantile)
    return _promised(resolved, faults, rounds, confidence, trials.play(resolved, "test", 1), trials.about)


def _calibrated(
    run: Run | str, options: Mapping[str, Any], resolved: Resolved, trials: Simulated | Windowed | Own, quantile: float
) -> tuple[Resolved, list[Round]]:
    """The run under the margin that a fresh batch agrees with, or under the last one that was tried."""
    rounds: list[Round] = []
    while True:
        margin = _guard(resolved).options.margin
        played = trials.play(resolved, "calibration", len(rounds))
        found = conformal(played.shortfall, quantile)
        rounds.append({"margin": margin, "quantile": found, "episodes": len(played.violated)})
        if found <= margin or len(rounds) == MAX_ROUNDS or margin >= WIDEST:
            return resolved, rounds
        resolved = _resolved(run, {**options, "margin": round(min(found, WIDEST), 3)})


def conformal(scores: np.ndarray, quantile: float) -> float:
    """The ⌈(n + 1) q⌉-th smallest of n scores: a fresh one is within it with probability q; infinite where n is too
    small to say."""
    rank = math.ceil((len(scores) + 1) * quantile)
    return float(np.sort(scores)[rank - 1]) if rank <= len(scores) else math.inf


@dataclass(frozen=True)
class Simulated:
    """Episodes of a run's own simulator: validation resets to calibrate on, test resets to count."""

    faults: Faults
    episodes: Mapping[Part, int]
    quiet: bool = True

    def play(self, resolved: Resolved, part: Part, batch: int) -> Trials:
        task = resolved.job.task
        policy = under_faults(resolved.team, self.faults, task)
        label = f"{task.name} behind {self.faults.name}, margin {_guard(resolved).options.margin:.3g}"
        split = "test" if part == "test" else "validation"
        seed = resolved.run.config["seed"]
        count = self.episodes[part]
        played = rollout(policy, task.simulator, count, split, seed, 0, label, self.quiet, batch, foreseen=True)
        violated = played["costs"].sum(1) > 0
        infeasible = float(played["infeasible"].sum() / played["steps"].sum())  # an episode may end early
        return Trials(violated, shortfalls(resolved, played), infeasible)

    @property
    def about(self) -> dict[str, Any]:
        """Nothing but episodes."""
        return {}


def shortfalls(resolved: Resolved, played: Played) -> np.ndarray:
    """(E,) by how much the states that actions led to scored less than was foreseen, at worst; 0 where never."""
    guard = _guard(resolved)
    came = judged(guard, resolved.job.task, played["states"])
    return shortfall(played[FORESEEN], came, guard.options.delay)


def judged(guard: Guard, task: Task, states: np.ndarray) -> np.ndarray:
    """(E, L) the least score of each state after the first (E, L+1, S), as the guard's barrier has it."""
    env = task.simulator

    @jax.jit
    def of_episode(states: Array) -> Array:
        observations = None if isinstance(env, NativeEnv) else env.observe(env.from_global_state(states))
        x = features(guard, task.homogeneous, observations, states)
        return least_score(guard, x[:-1], x[1:])

    return np.stack([np.asarray(of_episode(jnp.asarray(one))) for one in states])


def _check(confidence: float, quantile: float, calibration: int, episodes: int) -> int:
    """The least number of episodes that tell the quantile."""
    for name, value in (("confidence", confidence), ("quantile", quantile)):
        if not 0 < value < 1:
            raise UserError(f"{name}={value} must lie between 0 and 1; 0.95 is usual.")
    whole_number("episodes", episodes, 1, 10**7)
    whole_number("calibration", calibration, 1, 10**7)
    least = math.ceil(quantile / (1 - quantile) - 1e-9)
    if calibration < least:
        raise UserError(f"calibration={calibration} episodes tell no quantile of {quantile:g}; give {least} or more.")
    return least


def _resolved(run: Run | str, options: Mapping[str, Any]) -> Resolved:
    resolved = resolve(PolicySpec.of(run, **options))
    if resolved.guard is None:
        raise UserError("A certificate is of a guarded run; name a guard with guard=, e.g. shield.")
    if resolved.guard.options.adapt:
        raise UserError("An adapting margin cannot be frozen; certify a guard whose margin stays, e.g. shield.")
    if resolved.guard.options.margin < 0:
        raise UserError(f"margin={resolved.guard.options.margin} keeps no distance; certify a guard with 0 or more.")
    return resolved


def _guard(resolved: Resolved) -> Guard:
    assert resolved.guard is not None, "refused before"
    return resolved.guard


def _promised(
    resolved: Resolved,
    faults: Faults,
    rounds: list[Round],
    confidence: float,
    tested: Trials,
    about: dict[str, Any],
) -> Certificate:
    guard = _guard(resolved)
    violations = int(tested.violated.sum())
    episodes = len(tested.violated)
    return Certificate(
        policy=digest(resolved.proposal),
        world=digest(guard.world),
        task=resolved.job.task.name,
        agents=resolved.job.team,
        guard=dataclasses.asdict(guard.options),
        barrier=resolved.spec.barrier,
        faults=dataclasses.asdict(faults),
        confidence=confidence,
        bound=upper_bound(violations, episodes, confidence),
        episodes=episodes,
        violations=violations,
        rounds=tuple(rounds),
        agreed=rounds[-1]["quantile"] <= rounds[-1]["margin"],
        held=float((tested.shortfall <= guard.options.margin).mean()),
        infeasible_rate=tested.infeasible,
        **about,
    )


class Trials(NamedTuple):
    """E episodes, or windows of logs."""

    violated: np.ndarray  # (E,) bool
    shortfall: np.ndarray  # (E,)
    infeasible: float  # share of steps in which the guard could not do what it should


def shortfall(foreseen: np.ndarray, came: np.ndarray, late: int) -> np.ndarray:
    """(E,) by how much what came scored less than what was foreseen, at worst; 0 where never. Scores (E, L) are of the
    states that actions lead to, which act so many steps late."""
    foreseen = foreseen[:, : foreseen.shape[1] - late]
    return np.maximum(foreseen - came[:, late:], 0.0).max(1)


def features(guard: Guard, homogeneous: bool, observations: Any, states: Any) -> Array:
    """(B, teams, N, D) what a guard's World sees of B moments; homogeneous agents are so many teams of one."""
    x = local_features(guard.world.map, homogeneous, observations, states)
    return x.reshape(len(states if observations is None else observations), -1, *x.shape[1:])


@jax.jit
def least_score(guard: Guard, before: Array, after: Array) -> Array:
    """(B,) of the steps between features (B, teams, N, D): of all agents and constraints."""
    scores = guard.barrier.now(before, after)
    return scores.reshape(len(scores), -1).min(-1)


class Foresight:
    """A `Watch` of B episodes: what a guard foresaw of every step, and how what came is scored, the least of all
    agents."""

    def __init__(self, guard: Guard, homogeneous: bool):
        self.guard = guard
        self.homogeneous = homogeneous
        self.foreseen: list[np.ndarray] = []
        self.came: list[np.ndarray] = []

    def __call__(self, now: Moment) -> None:
        """What came of a step, if it was shown."""
        with float32():
            before, after = (features(self.guard, self.homogeneous, *seen) for seen in (now.before, now.after))
            came = np.asarray(least_score(self.guard, before, after))
        self.foreseen.append(np.where(now.outcome.shown, np.asarray(now.decided.info[FORESEEN]), -np.inf))
        self.came.append(np.where(now.outcome.shown, came, np.inf))

    def shortfall(self) -> np.ndarray:
        """(B,) as a certificate counts it."""
        foreseen, came = np.stack(self.foreseen, 1), np.stack(self.came, 1)
        return shortfall(foreseen, came, self.guard.options.delay)


@dataclass(frozen=True)
class Own:
    """Episodes in a simulator of one's own: validation resets to calibrate on, test resets to count."""

    make_env: Callable[[], Any]
    faults: Faults
    episodes: Mapping[Part, int]
    cost: Cost | None = None
    quiet: bool = True

    def play(self, resolved: Resolved, part: Part, batch: int) -> Trials:
        """Another `batch` has other resets."""
        assert resolved.guard is not None, "refused before"
        guard = resolved.guard
        split = "test" if part == "test" else "validation"
        player = player_of_run(resolved, split, self.faults)
        count = self.episodes[part]
        env = simulators_of(self.make_env, min(SIDE_BY_SIDE, count), player, self.cost)
        first = RESETS[split] + batch * count * (part == "calibration")
        label = f"{part} in {type(env.envs[0]).__name__} behind {self.faults.name}, margin {guard.options.margin:.3g}"
        episodes: list[Episode] = []
        watches: list[Foresight] = []

        def watch() -> Foresight:
            watches.append(Foresight(guard, resolved.job.task.homogeneous))
            return watches[-1]

        key = jax.random.key(resolved.run.config["seed"] + batch)
        with Progress(label, count, 0, self.quiet) as bar:
            play_all(player, env, range(first, first + count), key, bar, episodes, watch)
        steps = sum(len(episode.rewards) for episode in episodes)
        infeasible = sum(episode.counts["infeasible"] for episode in episodes)
        violated = np.array([episode.team_costs.any() for episode in episodes])
        return Trials(violated, np.concatenate([watch.shortfall() for watch in watches]), infeasible / max(steps, 1))

    @property
    def about(self) -> dict[str, Any]:
        """Which simulator it was."""
        return {"simulator": name_of(self.make_env)}


@dataclass(frozen=True, eq=False)
class Windowed:
    """Two parts of the windows: the margin is calibrated on the first half of the logs, what it promises is counted on
    the second."""

    calibration: Stage
    test: Stage
    content: str  # digest of the logs
    quiet: bool = True

    @classmethod
    def of(
        cls,
        store: EpisodeStore,
        run: Run,
        world: World,
        how: Body,
        faults: Faults,
        counts: Mapping[Part, int],
        least: int,
        quiet: bool,
    ) -> Windowed:
        """At most so many windows of each part, drawn evenly; fewer than `least` to calibrate on are refused."""
        logs = Logs.of(store, run)
        stage, _, _ = logs.stage(world, how, EVERY, run.config["seed"], faults)
        w = stage.windows
        moment = w.episode * (1 + w.start.max()) + w.start
        first = moment < np.median(moment)  # everybody who is driven in the same moments is in the same half
        to_calibrate, to_test = _evenly(first, counts["calibration"]), _evenly(~first, counts["test"])
        if len(to_calibrate) < least:
            raise UserError(
                f"The first half of these logs has {len(to_calibrate)} windows, and a margin is calibrated on {least} "
                "or more; give longer logs, shorter windows (steps=), or a smaller quantile=."
            )
        return cls(
            dataclasses.replace(stage, windows=w.only(to_calibrate)),
            dataclasses.replace(stage, windows=w.only(to_test)),
            logs.store.card.content or logs.store.content,
            quiet,
        )

    def play(self, resolved: Resolved, part: Part, batch: int) -> Trials:
        """The windows of a part under the run's guard; another `batch` draws other noise."""
        assert resolved.guard is not None, "refused before"
        guard = resolved.guard
        stage: Stage = getattr(self, part)
        stage = dataclasses.replace(stage, seed=stage.seed + batch)
        label = f"{part}, {stage.windows.count} windows, margin {guard.options.margin:.3g}"
        with Progress(label, stage.windows.steps, 0, self.quiet) as bar:
            driven = stage.play(resolved.proposal, Guarded(Nothing(), guard), bar=bar)
        lacking = shortfall(driven.info[FORESEEN], stage.scores(guard, driven), guard.options.delay)
        return Trials(driven.contact, lacking, float(driven.info["infeasible"].mean()))

    @property
    def about(self) -> dict[str, Any]:
        """What a certificate says of how it was made."""
        stage = self.test
        replayed = {
            "logs": self.content,
            "windows": [self.calibration.windows.count, stage.windows.count],
            "seconds": stage.windows.steps * stage.windows.dt,
            "kinematics": stage.kinematics.name,
            "radius": stage.radius,
        }
        return {"replayed": replayed}


def _evenly(chosen: np.ndarray, most: int) -> np.ndarray:
    """Where at most so many of the chosen (W,) are."""
    found = np.flatnonzero(chosen)
    return found if len(found) <= most else found[np.linspace(0, len(found) - 1, most).astype(int)]
