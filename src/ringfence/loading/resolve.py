"""How a run is to be played, and the policy that does."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax

from ringfence import algos
from ringfence.datasets import registry
from ringfence.datasets.task import Task
from ringfence.errors import UserError, unknown, whole_number
from ringfence.guards import DANGERS, GUARDS, Guarded, GuardOptions
from ringfence.guards.policy import build
from ringfence.loading import run_worlds
from ringfence.problem import constraints, features
from ringfence.problem.constraints import BoundHazard
from ringfence.problem.homogeneous import Each
from ringfence.proposals.options import PLANNERS, PlanOptions, plan_defaults
from ringfence.proposals.planner import Planner
from ringfence.training import loop, worlds
from ringfence.training.job import Job, widths_of
from ringfence.training.runs import Run
from ringfence.types import Policy, Spec
from ringfence.utils.config import build_config
from ringfence.world import World


def load(run: Run | str, step: int | None = None, planner: str = "plain", **options):
    """(job, policy) of a finished run.

    `planner` is a named set of options of those who draw plans (policies.PLANNERS), `guard` one of guards
    (guard.GUARDS), `danger` what the guard knows danger by, `sight` whether it sees the whole team ("all") or every
    agent guards its own action by its own view ("own", the only one of agents who are alike), `world` the World it
    reads (default: that of the run's data and seed), `agents` how many play, where they are alike. Other options are
    fields of PlanOptions and GuardOptions. The policy's `act` is a pure function: compile it with jax.jit, or use a
    `Controller`.
    """
    job, policy, _ = loaded(run, step, asked(planner, **options))
    return job, of_team(job, policy)


def of_team(job: Job, policy: Policy) -> Policy:
    """A job's policy as its whole team plays it."""
    return Each(policy, job.team) if job.task.alike else policy


@dataclasses.dataclass(frozen=True)
class Asked:
    """How a run is to be played."""

    planner: str
    guard: str
    danger: str
    sight: str | None
    world: World | str | Path | None
    agents: int | None  # who play, where they are alike; None: as many as in the logs
    plan: dict  # options of the planner
    given: dict  # options of the guard

    @property
    def guarded(self) -> bool:
        return self.guard != "none" or bool(self.given)


def asked(
    planner: str = "plain",
    guard: str = "none",
    danger: str | None = None,
    sight: str | None = None,
    world: World | str | Path | None = None,
    agents: int | None = None,
    **options,
) -> Asked:
    """Names and options sorted to whom they belong; unknown ones are refused."""
    for kind, name, known in (
        ("planner", planner, PLANNERS),
        ("guard", guard, GUARDS),
        ("sight", sight or "all", ("all", "own")),
    ):
        if name not in known:
            raise unknown(kind, str(name), known)
    if danger is not None and danger not in DANGERS:
        raise unknown("danger", str(danger), DANGERS)
    fields = {f.name for f in dataclasses.fields(GuardOptions)}
    given = {k: v for k, v in options.items() if k in fields}
    plan = {k: v for k, v in options.items() if k not in fields}
    for name in plan:
        if name not in (names := {f.name for f in dataclasses.fields(PlanOptions)}):
            raise unknown("option of planner or guard", name, names | fields)
    if agents is not None:
        whole_number("agents", agents, 1, 100_000)
    found = Asked(planner, guard, danger or "learned", sight, world, agents, plan, given)
    if not found.guarded and (danger is not None or sight == "own" or world is not None):
        told = next(k for k, v in (("danger", danger), ("sight", sight == "own"), ("world", world)) if v)
        raise UserError(f"{told} is read by nothing without a guard; name one with guard=, e.g. shield.")
    return found


def loaded(run: Run | str, step: int | None, how: Asked) -> tuple[Job, Policy, int]:
    """(job, policy, step of the checkpoint); of agents who are alike, the policy of each."""
    run = Run.of(run)
    job = load_job(run, how.agents)
    world = run_worlds.of_run(run) if job.reads_world else None
    told = {} if world is None else {"world": world}

    def blank():
        state = job.algorithm.init(jax.random.key(0), job.spec, job.config, None, job.feature_map, job.hazard, **told)
        return loop.learned(state)

    at, state = run.load_checkpoint(jax.eval_shape(blank), step)
    if world is not None:
        state |= {"world": job.algorithm.of_world(world, job.config)}
    policy = make_policy(job, state, {**PLANNERS[how.planner], **how.plan})
    if how.guarded:
        sight = worlds.sight_of(job.task, how.sight)
        world = run_worlds.for_guard(run, sight, how.world, read=world, quiet=False)
        usual = None if job.task.env is None else job.task.guard  # own data is judged by what its card says
        policy = build(policy, world, job.hazard.hazard, how.guard, how.danger, usual, **how.given)
    return job, policy, at


def load_job(run: Run, agents: int | None = None) -> Job:
    """The job that a run folder holds, rebuilt from its config.json; played by another number of `agents` where they
    are alike."""
    told = run.config
    lacking = [name for name in ("spec", "feature_map") if name not in told]
    if lacking:
        raise UserError(f"'{run.path / 'config.json'}' lacks '{lacking[0]}', so nothing can be played; train it again.")
    algorithm = algos.get(told["algorithm"])
    config = build_config(algorithm.Config, told["config"], algorithm.name)
    fields = {f.name for f in dataclasses.fields(Spec) if f.default is dataclasses.MISSING}
    if lacking := sorted(fields - set(told["spec"])):
        raise UserError(f"'{run.path / 'config.json'}' has a spec without '{lacking[0]}'; train the run again.")
    spec = Spec.of(told["spec"])
    if told["feature_map"] is None:
        # Danger is what the run's data said it is, as in training.
        task = registry.simulated(told["task"], constraints.from_dict(told["hazard"]))
        if task is None:
            raise unknown("task", told["task"], registry.TASKS)
        feature_map, team = task.feature_map(config.view), task.env.n_agents
        widths = widths_of(task)
    else:
        card = told["data"]
        task = Task(
            told["task"],
            None,
            constraints.from_dict(told["hazard"]),
            cost_limit=float(card.get("cost_limit", 1.0)),
            action_low=card["action_low"],
            action_high=card["action_high"],
            alike=spec.alike,
        )
        feature_map, team = features.from_dict(told["feature_map"]), told.get("team", spec.n_agents)
        named = (card.get("observation_names"), card.get("state_names"))
        widths = tuple(told.get("widths") or (len(names) if names else None for names in named))
    if agents not in (None, team):
        task, team = registry.of_team(task, agents), agents
    hazard: BoundHazard = constraints.bind(constraints.from_dict(told["hazard"]), spec.feature_names, spec.n_agents)
    return Job(algorithm, told["preset"], config, task, spec, feature_map, hazard, widths, team=team)


def make_policy(job: Job, state, options: dict) -> Policy:
    """The policy of a trained state with evaluation-time options (ignored by algorithms that do not plan)."""
    chosen = build_config(PlanOptions, {**plan_defaults(job.config), **options}, "the planner")
    return job.algorithm.make_policy(state, job.config, job.spec, job.feature_map, job.hazard, chosen)


def variant_name(job: Job, policy: Policy, how: Asked, split: str) -> str:
    """Preset, named planner, guard with its danger and sight, and the values of the options given beside them, e.g.
    `split+climbing+shield-learned+rows7`. Neither their order nor how their values were spelled makes another name."""
    inner = policy.proposal if isinstance(policy, Guarded) else policy
    name, plans = job.preset, isinstance(inner, Planner)
    if plans and how.planner != "plain":
        name += f"+{how.planner}"
    if isinstance(policy, Guarded):
        own = how.sight == "own" and not job.task.alike
        name += f"+{how.guard}-{how.danger}" + ("-own" if own else "")
    for options, given in ((inner.options if plans else None, how.plan), (_guard_of(policy), how.given)):
        for field in dataclasses.fields(options) if options is not None else ():
            if field.name in given:
                value = getattr(options, field.name)
                name += f"+{field.name}{float(value) if isinstance(field.default, float) else value}"
    name += "" if how.agents is None else f"+agents{how.agents}"
    return name if split == "test" else f"{name}@{split}"


def _guard_of(policy: Policy) -> GuardOptions | None:
    return policy.guard.options if isinstance(policy, Guarded) else None
