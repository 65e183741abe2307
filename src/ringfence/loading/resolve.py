"""A spec is resolved once, to the policy that it names; who plays, evaluates or exports it is given the value."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from typing import Any

import jax

from ringfence import algos
from ringfence.datasets import registry
from ringfence.datasets.task import Task
from ringfence.errors import UserError, unknown
from ringfence.guards import Guard, Guarded
from ringfence.guards.policy import build
from ringfence.loading import oracle
from ringfence.loading.spec import PolicySpec
from ringfence.problem import constraints, features
from ringfence.problem.homogeneous import team_policy
from ringfence.problem.origins import Origins
from ringfence.proposals.guidance import DANGER, VALUES, TakesGuidance, guided, knows_ahead
from ringfence.proposals.options import PLANNERS, PlanOptions, TakesPlanOptions, plan_defaults
from ringfence.training import loop, worlds
from ringfence.training.job import Job, widths_of
from ringfence.training.runs import Run
from ringfence.types import Policy, PyTree, Spec
from ringfence.utils.config import build_config
from ringfence.utils.precision import in_float32
from ringfence.world import World
from ringfence.world.verdict import judge, require, require_values

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Resolved:
    """A spec, and the values that its names stand for."""

    spec: PolicySpec  # without the choices that nothing reads
    job: Job
    policy: Policy  # of homogeneous agents, that of each
    step: int  # of the checkpoint

    @property
    def run(self) -> Run:
        run = self.spec.run
        assert run is not None  # `resolve` refuses a spec without one
        return run

    @property
    def team(self) -> Policy:
        """The policy as the whole team plays it."""
        if self.spec.guarded and self.spec.barrier == oracle.ORACLE:
            return self.policy  # the whole team's already: an oracle knows everybody
        return team_policy(self.policy, self.job.team, self.job.task.homogeneous)

    @property
    def proposal(self) -> Any:
        """The policy without its guard."""
        return self.policy.proposal if isinstance(self.policy, Guarded) else self.policy

    @property
    def plan_options(self) -> PlanOptions | None:
        """How plans are drawn, by who draws some."""
        return self.proposal.options if isinstance(self.proposal, TakesPlanOptions) else None

    @property
    def guard(self) -> Guard | None:
        return self.policy.guard if isinstance(self.policy, Guarded) else None

    def variant(self, split: str = "test") -> str:
        """What a result of it is called."""
        return self.spec.variant(self.job.preset, split)


@in_float32
def load(run: Run | str, checkpoint: int | None = None, planner: str = "default", **options: Any) -> tuple[Job, Policy]:
    """(job, policy) of a finished run.

    `planner` is a named set of options of those who draw plans (proposals.options.PLANNERS), `guard` one of guards
    (guards.GUARDS), `barrier` what the guard knows danger by, `execution` whether it sees the whole team
    ("centralized") or every agent guards its own action by its own view ("decentralized", the only one of homogeneous
    agents), `world` the World it reads (default: that of the run's data and seed, which `fit_run` makes where there is
    none), `agents` how many play, where they are homogeneous. Other options are fields of PlanOptions and GuardOptions.
    The policy's `act` is a pure function: compile it with jax.jit, or use a `Controller`.
    """
    found = resolve(PolicySpec.of(run, checkpoint=checkpoint, planner=planner, **options))
    return found.job, found.team


@in_float32
def resolve(spec: PolicySpec) -> Resolved:
    """The policy that a spec names. This reads Worlds and makes none: `NoWorld` where there is none."""
    if spec.run is None:
        raise UserError("This spec names no run; give one that `ringfence train` made.")
    run = spec.run
    job = load_job(run, spec.agents)
    world = worlds.of_run(run) if job.reads_world else None
    read = {} if world is None else {"world": world}

    def blank() -> PyTree:
        state = job.algorithm.init(jax.random.key(0), job.spec, job.config, None, job.feature_map, job.hazard, **read)
        return loop.learned(state)

    step, state = run.load_checkpoint(jax.eval_shape(blank), spec.checkpoint)
    if world is not None and job.algorithm.from_world is not None:
        state |= {"world": job.algorithm.from_world(world, job.config)}
    policy = make_policy(job, state, {**PLANNERS[spec.planner], **dict(spec.plan_options)})
    plans = isinstance(policy, TakesPlanOptions)
    asked = dict(spec.plan_options)
    if not plans and "target_return" in asked:  # the other options of plans are passed over
        name = job.algorithm.name
        remedy = "set it when it is trained" if hasattr(job.config, "target_return") else "leave it out"
        raise UserError(
            f"target_return={asked['target_return']} asks for a return, and {name} is asked for none when it plays; "
            f"{remedy}."
        )
    if isinstance(policy, TakesGuidance):
        policy = _guided(policy, run, job, world, spec)
    if spec.guarded and spec.barrier == oracle.ORACLE:
        team = team_policy(policy, job.team, job.task.homogeneous)
        policy = oracle.guarded(team, job.task, spec.guard, dict(spec.guard_options))
    elif spec.guarded:
        world = worlds.for_guard(run, spec.execution, spec.world, read=world)
        _check_width(job, world.map, "The World")
        usual = None if job.task.guard_by_card else job.task.guard
        options = dict(spec.guard_options)
        if spec.agents:  # another team has other places to be than the logs' had
            options = {"within_logs": False} | options
        hazard = job.hazard.hazard
        if isinstance(hazard, constraints.CostColumn):
            hazard = world.hazard  # which the World may see, where the policy does not
        policy = build(policy, world, hazard, spec.guard, spec.barrier, usual, spec.anyway, **options)
    spec = spec if plans else spec.without_plans()
    # Homogeneous agents see for themselves anyway.
    spec = dataclasses.replace(spec, execution=None) if job.task.homogeneous else spec
    return Resolved(spec, job, policy, step)


def _guided(policy: Any, run: Run, job: Job, read: World | None, spec: PolicySpec) -> Any:
    """A policy whose sampling is guided by the World that its training read, or else would guard it: by values and
    danger as asked for, and by both where a method follows a World by itself and that World is fit to. A guard takes
    care of danger itself, and some of what is earned: what it does anyway, nobody does before it."""
    o = policy.options
    values, danger = o.value_guidance, o.barrier_guidance
    asked = bool(values or danger)
    alone = o.execution == "decentralized"  # a World sees the whole team
    by_itself = getattr(job.config, "guides", False) and not (spec.guard_decides or alone)
    if danger is None:
        danger = DANGER if by_itself or values else 0.0
    if values is None:
        values = VALUES if by_itself and danger else 0.0
    if not (values or danger):
        return policy
    world = worlds.for_guard(run, None, spec.world, read=read) if asked and (read is None or spec.world) else read
    if world is None or (world.barrier is None and not asked):
        return policy
    _check_width(job, world.map, "The World")
    card = world.card
    if not (asked or spec.anyway) and (card.verdict or judge(card)).word == "unfit":
        _log.warning(
            f"The World of '{run.path}' is unfit to guide by, so plans are drawn without it; insist with anyway=True, "
            "or set barrier_guidance=0."
        )
        return policy
    if world.barrier is None and o.barrier_guidance is None:
        danger = 0.0
    if danger:
        require(card, spec.anyway)
    misleads = card.values is not None and card.values.misleads and not spec.anyway
    if o.value_guidance is None and (misleads or not knows_ahead(world)):
        values = 0.0
    if values:
        require_values(card, spec.anyway)
    elif spec.guarded and not asked:
        return policy
    return guided(policy, world, values, danger)


def load_job(run: Run, agents: int | None = None) -> Job:
    """The job that a run folder holds, rebuilt from its config.json; played by another number of `agents` where they
    are homogeneous."""
    stored = run.config
    file = run.path / "config.json"
    for name in ("spec", "feature_map"):
        if name not in stored:
            raise UserError(f"'{file}' lacks '{name}', so nothing can be played; train it again.")
    needed = {f.name for f in dataclasses.fields(Spec) if f.default is dataclasses.MISSING}
    lacking = sorted(needed - set(stored["spec"]))
    if lacking:
        raise UserError(f"'{file}' has a spec without '{lacking[0]}'; train the run again.")
    algorithm = algos.get(stored["algorithm"])
    config = build_config(algorithm.Config, stored["config"], algorithm.name)
    spec = Spec.of(stored["spec"])
    hazard = constraints.from_dict(stored["hazard"])
    if stored["feature_map"] is None:
        # Danger is what the run's data said it is, as in training.
        task = registry.simulated(stored["task"], hazard)
        if task is None:
            raise unknown("task", stored["task"], registry.TASKS)
        feature_map = task.feature_map(config.view)
        team = task.simulator.n_agents
        widths = widths_of(task)
    else:
        # A task that exists only as data, as the run's card has it.
        card = stored["data"]
        low, high = stored.get("returns") or (0.0, 1.0)
        task = Task(
            stored["task"],
            None,
            hazard,
            return_min=low,
            return_max=high,
            cost_limit=float(card.get("cost_limit", 1.0)),
            action_low=spec.action_low,
            action_high=spec.action_high,
            homogeneous=spec.homogeneous,
        )
        feature_map = features.from_dict(stored["feature_map"])
        team = stored.get("team", spec.n_agents)
        widths = stored.get("widths") or (None, None)
    if agents is not None and agents != team:
        task = registry.of_team(task, agents)
        team = agents
    bound = constraints.bind(hazard, spec.feature_names, spec.n_agents)
    origins = Origins.of(stored["data"])
    found = Job(algorithm, stored["preset"], config, task, spec, feature_map, bound, widths, None, team, origins)
    _check_width(found, feature_map, f"'{run.path}'")
    return found


def _check_width(job: Job, map: features.FeatureMap, who: str) -> None:
    """Refuse a view that reads beyond the end of what there is: JAX would read the last entry in its place."""
    observation, state = job.widths
    beyond = map.beyond(observation, state or None)  # 0 where nobody reads it
    if beyond is not None:
        raise UserError(f"{who} reads {beyond}; it is of other data.")


def make_policy(job: Job, state: PyTree, options: Mapping[str, Any]) -> Policy:
    """The policy of a trained state with evaluation-time options (ignored by algorithms that do not plan)."""
    chosen = build_config(PlanOptions, {**plan_defaults(job.config), **options}, "the planner")
    return job.algorithm.make_policy(state, job.config, job.spec, job.feature_map, job.hazard, chosen)
