"""Policies at run time: NumPy in, NumPy out."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.deploy.watch import Evidence, Fallback, Stamps, Watch, explaining, widened
from ringfence.errors import LAST_SEED, UserError, whole_number
from ringfence.evaluation.certificate import Certificate
from ringfence.guards.policy import Guarded, Paid, acted, costs_of_one, no_safe_action
from ringfence.guards.wrap import Callback, guarded_of, under_guard, with_guarded
from ringfence.loading.resolve import load
from ringfence.problem.constraints import Hazard
from ringfence.problem.homogeneous import PerAgent, team_policy
from ringfence.proposals.options import DEFAULT
from ringfence.training.job import Job
from ringfence.training.runs import Run
from ringfence.types import Key, Policy, PolicyStep, PyTree, act_with, with_cost
from ringfence.utils.compilation import keep_programs
from ringfence.utils.given import given_as, refuse_other_order
from ringfence.utils.precision import in_float32
from ringfence.world import World
from ringfence.world import load as load_world

Seen = tuple[np.ndarray, np.ndarray | None]  # observations (N, O) and state (S,) of one environment
OneCost = np.ndarray | dict[str, np.ndarray]  # (1,), or that by constraint

CALIBRATED = ("margin", "others_acceleration")  # numbers that are read off a World; a certificate brings them along
LOOKS = ("horizon", "terminal_value")  # likewise, unless it is said otherwise how far the guard looks
UNGUARDED = "A certificate is of a guarded run; give one with guard=, or leave certificate= out."


class Controller:
    """A policy at run time: one environment, NumPy in, NumPy out.

    controller = Controller("runs/…/seed-0", guard="shield", barrier="learned")
    controller.warm_up(observations, state)        # compiles, which else the first action does
    controller.reset()                             # at the start of every episode
    action = controller.act(observations, state)   # (N, O), (S,) or None -> (N, A)

    run: a trained run, with options of `ringfence.load`; or any callable (observations (N, O), state (S,) or None) ->
    actions (N, A), with `world=` and options of `ringfence.guard`. `info` says of the last action what is known of it,
    e.g. `ood`: the World knows nothing there. `policy` is what simulators of whole batches play. Not for several
    threads at once.

    certificate: a file of `ringfence certify`, which must be of this run, World, guard and team. The margin and
    `others_acceleration` are taken from it. `info["covered"]` then says whether the guard kept its condition where its
    World knows its way: of other steps the certificate counts how they end, and says no more.

    `finished(violated)` after an episode watches whether the certificate's bound is kept. `on_alarm` says what is done
    when it is not: report (`info["alarm"]`), stop (refuse to act), widen (half as much margin again), or hand_over (to
    `fallback`, a callable like `run` may be, that nothing guards).

    driven: who acts by this controller, where a team's guard is that of one agent among others (or some): it decides
    for them alone, and expects of the others what is proposed for them. `info["agent_infeasible"]` is of them, too.

    log: a file, to which a record of every step is added before its action is returned: what was requested and what
    is executed, why, how old the observations were, whether it was covered (docs/certificates.md). Each record holds a
    digest of the one before; `evidence.last` is that of the last one. `close()` ends the log.
    """

    def __init__(
        self,
        run: Run | str | Path | Callable | Callback,
        planner: str = DEFAULT,
        seed: int = 0,
        certificate: str | Path | None = None,
        log: str | Path | None = None,
        on_alarm: str = "report",
        fallback: Fallback | None = None,
        clock: Callable[[], float] = time.monotonic,
        driven: int | Sequence[int] | None = None,
        **options: Any,
    ):
        keep_programs()
        promised = None if certificate is None else Certificate.load(certificate)
        if promised is not None:
            if str(options.get("guard", "none")) == "none":
                raise UserError(UNGUARDED)
            brought = CALIBRATED if {*LOOKS, "horizon_seconds"} & set(options) else CALIBRATED + LOOKS
            options = {name: promised.guard[name] for name in brought if name in promised.guard} | options
        self._watch = Watch(promised, on_alarm, fallback)
        self._stamps = Stamps(clock)
        self._seed = whole_number("seed", seed, 0, LAST_SEED)
        self._key = jax.random.key(self._seed)
        self._source = _source(run, planner, options)
        if driven is not None:
            self._source.policy = _deciding_for(driven, self._source)
        self.policy: Policy = self._source.policy
        self.certificate = promised
        if promised is not None:
            _require(promised, self._source)
        self.evidence: Evidence | None = None
        if log is not None:
            self._source.policy = self.policy = explaining(self.policy)
            self.evidence = Evidence(log, self.policy, self._source.agents, promised)
        self.info: dict[str, np.ndarray] = {}
        self.last_action: np.ndarray | None = None
        self.reset()

    @property
    def job(self) -> Job:
        """What the run was trained for; a callable has no job."""
        if isinstance(self._source, _Function):
            raise UserError("This controller is of a callable, which has no job; only one of a run has.")
        return self._source.job

    @property
    def agents(self) -> list[str] | None:
        """Whose row is whose, by the logs' names; None of those who are homogeneous, or whom nobody named."""
        return self._source.names

    @property
    def made_of(self) -> tuple[Policy, int]:
        """The policy and its seed, whatever it remembers: by these `collect` knows it again."""
        return self.policy, self._seed

    @in_float32
    def reset(self) -> None:
        """Begin an episode: plans in progress and histories are forgotten."""
        self._carry = self.policy.initial_state(1)
        self._stamps.reset()
        if self.evidence is not None:
            self.evidence.reset()

    def finished(self, violated: bool) -> bool:
        """An episode has ended, and violated or not. Whether the certificate's promise is known not to be kept: of
        promises that are kept at most 1 % ever raise this alarm."""
        before = self._watch.alarm
        alarm = self._watch.finished(violated)
        if self.evidence is not None:
            self.evidence.finished(bool(violated), alarm)
        if alarm and not before and self._watch.on_alarm == "widen":
            self._source.policy = self.policy = widened(self.policy)
        return alarm

    def close(self) -> None:
        """End the log, if there is one."""
        if self.evidence is not None:
            self.evidence.close()

    def warm_up(self, observations: np.ndarray, state: np.ndarray | None = None) -> None:
        """Compile what acts on such arrays, so that the first action of a control loop is not late. Whatever they hold
        is forgotten, and nothing is recorded; a callable is asked once."""
        source = self._source
        _, step = source.act(self._carry, source.seen(observations, state), None, self._key)
        jax.block_until_ready(step.action)

    def act(
        self,
        observations: np.ndarray,
        state: np.ndarray | None = None,
        cost: Paid | None = None,
        age: int | np.ndarray | None = None,
        observed_at: float | np.ndarray | None = None,
        agents: Sequence[Any] | None = None,
    ) -> np.ndarray:
        """(N, A) joint action within the task's bounds; a callable is asked with the same arrays. `cost` is what the
        last step cost, in all or by each constraint's name, which an adapting guard follows. Arrays of another shape
        than the run's or the World's are refused, and so is what is not finite: indices beyond an array's end would be
        clipped in silence, and noise would follow NaN. `age` is how many steps old the observations are, of all or of
        each agent, for a guard with `max_age`; `observed_at` is when they were made, in seconds by the controller's
        `clock`, from which the age follows, and to which what deciding took lately is added. `agents` are the names of
        whose rows these are, which must be `agents` of the logs, in their order.

        A refusal is a `NoSafeAction`, whose `last_action` is that of the step before."""
        source = self._source
        begun = time.perf_counter()
        with no_safe_action(self.last_action), self._recorded():
            self._watch.check()
            if agents is not None:
                refuse_other_order(agents, self.agents)
            seen = source.seen(observations, state)
            paid = None if cost is None else costs_of_one(cost, source.agents)
            if observed_at is not None:
                if age is not None:
                    raise UserError("age and observed_at both say how old observations are; give one of them.")
                guarded = guarded_of(self.policy)
                world = None if guarded is None else guarded.guard.world
                dt = None if world is None else world.map.dt or world.card.data.dt
                age = self._stamps.ages(observed_at, source.agents, dt)
            before = self._carry if age is None else self._aged(age)
            key, now = jax.random.split(self._key)
            carry, step = source.act(before, seen, paid, now)
            action, info = acted(step, source.name)
            if self.certificate is not None:
                info["covered"] = ~(info["infeasible"] | info["ood"]) & (not self._watch.alarm)
                info["alarm"] = np.array(self._watch.alarm)
            if self._watch.hands_over:
                measured = self.job.origins.measured(*seen)
                action = self._watch.taken_over(*measured, self.job.spec, source.agents)
            if self.evidence is not None:
                self.evidence.step(seen, age, action, info, 1e3 * (time.perf_counter() - begun))
        self._carry, self._key, self.info, self.last_action = carry, key, info, action.copy()
        if observed_at is not None:
            self._stamps.acted()
        return action

    @contextmanager
    def _recorded(self) -> Iterator[None]:
        """A refusal is recorded, too."""
        try:
            yield
        except UserError as error:
            if self.evidence is not None:
                self.evidence.refused(str(error))
            raise

    @in_float32
    def _aged(self, age: Any) -> PyTree:
        """The carry with how old the next observations are."""
        agents = self._source.agents
        steps = np.asarray(age)
        if steps.dtype.kind not in "iu" or steps.shape not in ((), (agents,)) or steps.min() < 0:
            raise UserError(f"age={str(age)[:60]} must be a whole number of steps, 0 or more, or one of each agent.")
        guarded = guarded_of(self.policy)
        if guarded is None or not guarded.guard.options.max_age:
            raise UserError(
                "age is read by nothing here; give a guard with max_age=, up to which it makes good for it."
            )
        if steps.max() > guarded.guard.options.max_age:
            raise UserError(
                f"age={steps.max()} is more than max_age={guarded.guard.options.max_age}; stop, or give a larger one."
            )
        team = team_policy(guarded, agents, guarded.guard.world.spec.homogeneous)
        return team.observe_age(self._carry, jnp.broadcast_to(jnp.asarray(steps, jnp.int32), (1, agents)))


@in_float32
def guard(
    policy: Policy | Callable,
    world: World,
    *,
    guard: str = "shield",
    barrier: str = "learned",
    hazard: Hazard | None = None,
    seed: int = 0,
    agents: int | None = None,
    anyway: bool = False,
    **options: Any,
) -> Guarded | PerAgent | Controller:
    """Any policy under guard.

    policy: a policy of the library (with `initial_state` and `act`), which gives a `Guarded`; or any callable
    (observations (N, O), state (S,) or None) -> actions (N, A) within the task's bounds, or of observations alone, e.g.
    a PyTorch network, which gives a `Controller`, for a team of `agents` where the World is of homogeneous agents. A
    second parameter with a default is its own, and not the state, unless it is called `state`.
    `guard` is a name in GUARDS, `barrier` learned, analytic or both, `options` fields of GuardOptions; `hazard` defines
    the analytic one, where that is to be used. A World whose verdict is unfit is refused, unless `anyway`.
    """
    found = under_guard(
        policy, world, guard=guard, barrier=barrier, hazard=hazard, agents=agents, anyway=anyway, **options
    )
    return Controller(found, seed=seed) if isinstance(found, Callback) else found


class _TrainedRun:
    """A trained run, which says what arrays it takes."""

    name = "The run's policy"

    @in_float32
    def __init__(self, run: Run | str | Path, planner: str, options: dict[str, Any]):
        self.job, self.policy = load(cast("Run | str", run), planner=planner, **options)
        self.agents, self.names = self.job.team, Run.of(run).agents
        self._act = jax.jit(act_with)

    def seen(self, observations: Any, state: Any) -> Seen:
        """Copies of what one environment shows, of the widths of the run's data."""
        width, state_width = self.job.widths
        origins = self.job.origins
        seen = given_as("observations", observations, (self.job.team, width), origins=origins.observations)
        if self.job.task.homogeneous:
            state = None  # which agents who see for themselves do not read
        if state is not None and state_width == 0:
            raise UserError(
                "This run's data has no global state, but act() was given one; pass the observations alone."
            )
        view = self.job.feature_map
        if state is None and view.reads_state:
            raise UserError(
                f"act() got no state, but this run's view '{view.view}' reads it; pass the global state"
                + (f" ({state_width} entries)." if state_width else ".")
            )
        whole = None if state is None else given_as("state", state, (state_width,), origins=origins.state)
        if None in self.job.widths:
            # Refuse arrays too short for the entries that the run reads.
            beyond = self.job.feature_map.beyond(seen.shape[-1], None if whole is None else len(whole))
            if beyond is not None:
                raise UserError(f"This run reads {beyond}; pass what its data holds.")
        return seen, whole

    @in_float32
    def act(self, carry: PyTree, seen: Seen, cost: OneCost | None, key: Key) -> tuple[PyTree, PolicyStep]:
        if cost is not None:
            carry = with_cost(self.policy, carry, cost)
        return self._act(self.policy, carry, *_batch(seen), key)


class _Function:
    """A callable under guard, which is asked in the precision of its own program."""

    name = "The guard"

    def __init__(self, policy: Callback):
        self.policy = policy
        self.agents, self.names = policy.agents, policy.guarded.guard.world.card.data.agents
        self.seen = policy.seen

    def act(self, carry: PyTree, seen: Seen, cost: OneCost | None, key: Key) -> tuple[PyTree, PolicyStep]:
        observations, state = seen
        # Copies: a function that writes into what it sees must not blind its guard.
        copies = observations.copy(), None if state is None else state.copy()
        wanted = self.policy.function(*self.policy.origins.measured(*copies))
        if cost is not None:
            carry = self.policy.observe_cost(carry, cost)
        return self.policy.decided(carry, *_batch(seen), [wanted], key)


def _source(run: Any, planner: str, options: dict[str, Any]) -> _TrainedRun | _Function:
    if isinstance(run, Callback):
        return _Function(run)
    if not callable(run):
        return _TrainedRun(run, planner, options)
    if planner != DEFAULT:
        raise UserError(f"planner='{planner}' is read by nothing of a callable; leave it out.")
    world = options.pop("world", None)
    if world is None:
        raise UserError("A callable acts under guard alone; give world=, the World that its guard reads.")
    found = in_float32(under_guard)(run, load_world(world) if isinstance(world, str | Path) else world, **options)
    assert isinstance(found, Callback)  # of whatever is no policy of the library
    return _Function(found)


def _deciding_for(driven: int | Sequence[int], source: _TrainedRun | _Function) -> Any:
    """The source's policy under a guard that decides for some of the agents alone."""
    guarded = guarded_of(source.policy)
    if guarded is None:
        raise UserError("driven says for whom a guard decides, and there is none; give guard=, or leave driven out.")
    if guarded.guard.world.alone:
        raise UserError("Here every agent guards itself, whoever acts; leave driven out, and act by its row alone.")
    try:
        who = np.atleast_1d(np.asarray(driven))
    except ValueError:  # lists of other lengths
        who = np.zeros(0)
    if who.dtype.kind not in "iu" or who.ndim > 1 or not len(who) or not ((who >= 0) & (who < source.agents)).all():
        raise UserError(f"driven={driven!r} must be agents, from 0 to {source.agents - 1}.")
    acts = jnp.asarray(np.isin(np.arange(source.agents), who))[None]
    return with_guarded(source.policy, dataclasses.replace(guarded, driven=acts))


def _require(certificate: Certificate, source: _TrainedRun | _Function) -> None:
    """Refuse a certificate of anybody else."""
    guarded = guarded_of(source.policy)
    if isinstance(source, _Function) or guarded is None:
        raise UserError(UNGUARDED)
    guard = guarded.guard
    options = dataclasses.asdict(guard.options)
    certificate.require(guarded.proposal, guard.world, source.agents, options, guard.barrier.source)
    deciding = source.agents if guarded.driven is None else int(guarded.driven.sum())
    promised = 1 if certificate.replayed and not guard.world.alone else source.agents
    if deciding != promised:
        raise UserError(
            f"This certificate is of a guard that decides for {promised} of {source.agents} agents, and this one "
            f"decides for {deciding}; say for whom with driven=, or certify what plays."
        )


def _batch(seen: Seen) -> Seen:
    """The same as a batch of one."""
    observations, state = seen
    return observations[None], None if state is None else state[None]
