"""Who plays in somebody else's simulator: a trained run, or a function under guard."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np

from ringfence.datasets.task import Task
from ringfence.envs.episode import Shape
from ringfence.errors import UserError
from ringfence.evaluation import evaluate
from ringfence.faults import Faults
from ringfence.faults.policy import behind
from ringfence.guards.wrap import Callback
from ringfence.loading.resolve import Resolved, resolve
from ringfence.loading.spec import PolicySpec
from ringfence.problem import constraints
from ringfence.problem.constraints import BoundHazard
from ringfence.problem.features import FeatureMap
from ringfence.problem.homogeneous import local_features
from ringfence.proposals.options import DEFAULT
from ringfence.training.runs import Run
from ringfence.types import Key, Policy, PolicyStep, PyTree
from ringfence.utils.functions import memory_of
from ringfence.utils.precision import in_float32
from ringfence.world import World

NO_FAULTS = Faults()
Unsafe = Callable[[np.ndarray, np.ndarray | None], np.ndarray]


@runtime_checkable
class HasPolicy(Protocol):
    """A `Controller`: what acts, and has a policy to be played in whole batches."""

    policy: Policy

    def warm_up(self, observations: np.ndarray, state: np.ndarray | None = None) -> None: ...


@dataclass(frozen=True, eq=False)
class Player:
    """Who plays, and what is known of it."""

    name: str
    policy: Policy  # of the whole team
    task: Task
    shape: Shape
    episode_length: int  # of the longest logged one
    action_dim: int
    observation_names: tuple[str, ...]  # empty where nobody names them
    unsafe: Unsafe | None  # (B,) of observations and states, where a formula says what is unsafe
    about: dict[str, Any]  # what a result says of it
    limits: Mapping[str, float]  # per episode, of constraints that the data names


@dataclass(frozen=True, eq=False)
class RunPlayer(Player):
    """A run, whose folder can keep the result under the variant's name."""

    spec: PolicySpec
    run: Run
    variant: str


def player_of(
    policy: Run | str | HasPolicy, planner: str, split: str, options: dict[str, Any], faults: Faults = NO_FAULTS
) -> Player:
    """A run as planner and options say, or a function under guard, which takes neither; behind faults, if any."""
    if isinstance(policy, HasPolicy):
        callback = policy.policy
        if not isinstance(callback, Callback):
            raise UserError("This controller is of a run; play the run itself, with its options beside it.")
        if options or planner != DEFAULT:
            raise UserError(
                f"{[*options, 'planner'][0]} was said to ringfence.guard(), or not at all; leave it out here."
            )
        world = callback.guarded.guard.world
        spec = world.spec
        bound = constraints.bind_or_none(world.hazard, spec.feature_names, spec.n_agents)
        player = Player(
            name="a function under guard",
            policy=_OneByOne(callback),
            task=Task(spec.task, None, world.hazard, action_low=spec.action_low, action_high=spec.action_high),
            shape=shape_of(world, callback.agents),
            episode_length=spec.episode_length,
            action_dim=spec.action_dim,
            observation_names=(),
            unsafe=_unsafe_by_formula(bound, world.map, spec.homogeneous),
            about={"guard": "own"},
            limits=world.limits,
        )
        return _behind(player, faults)
    return player_of_run(resolve(PolicySpec.of(policy, planner=planner, **options)), split, faults)


def player_of_run(resolved: Resolved, split: str, faults: Faults = NO_FAULTS) -> Player:
    """What a spec named, behind faults, if any."""
    job = resolved.job
    observation, state = job.widths
    names = resolved.run.config["data"].get("observation_names") or getattr(job.task.env, "observation_names", ())
    player = RunPlayer(
        name=job.algorithm.name,
        policy=resolved.team,
        task=job.task,
        shape=Shape(job.team, observation, state or 0, job.task.homogeneous, job.origins, names=resolved.run.agents),
        episode_length=job.spec.episode_length,
        action_dim=job.spec.action_dim,
        observation_names=tuple(names) if len(names) == observation else (),
        unsafe=_unsafe_by_formula(job.hazard, job.feature_map, job.task.homogeneous),
        about={"step": resolved.step, "variant": resolved.variant(split)} | evaluate.about(resolved),
        limits=resolved.run.config["data"].get("constraints") or {},
        spec=resolved.spec,
        run=resolved.run,
        variant=resolved.variant(split),
    )
    return _behind(player, faults)


def _behind(player: Player, faults: Faults) -> Player:
    """The same behind faults; entries without names are all taken for measured."""
    if not faults.given:
        return player
    shape = player.shape
    if shape.agents is None or shape.observation is None or shape.state is None:
        raise UserError(
            "Faults need to know how wide observations and state are, and nothing tells; play a run of named logs."
        )
    names = player.observation_names or ("",) * shape.observation
    states = ("",) * shape.state
    bounds = (player.task.action_low, player.task.action_high)
    steps = player.episode_length
    policy = behind(player.policy, faults, shape.agents, player.action_dim, names, states, bounds, steps)
    return dataclasses.replace(player, policy=policy, about=player.about | {"faults": dataclasses.asdict(faults)})


def _unsafe_by_formula(hazard: BoundHazard | None, map: FeatureMap, homogeneous: bool) -> Unsafe | None:
    if hazard is None or not hazard.has_formula:
        return None

    @jax.jit
    def unsafe(observations, state):
        found, _ = hazard.labels(local_features(map, homogeneous, observations, state))
        return found.reshape(len(observations), -1).any(-1)

    return in_float32(lambda observations, state: np.asarray(unsafe(observations, state)))


def shape_of(world: World, agents: int) -> Shape:
    """What a simulator must show to a World. The function is shown the state that logs had, too, where there is one."""
    width, state_width = world.widths
    needed = world.map.reads_state
    return Shape(
        agents=agents,
        observation=width if "observations" in world.map.reads else None,
        state=state_width if needed else state_width or 0,
        homogeneous=world.spec.homogeneous,
        origins=world.origins,
        needs_state=needed,
        names=world.card.data.agents,
    )


class _OneByOne:
    """A function under guard that is asked for each simulator by itself; the guard filters all. One with `reset` has a
    memory: each simulator has its own."""

    def __init__(self, policy: Callback):
        self.policy = policy
        self.observe_cost = policy.observe_cost
        self.functions: list[Callable] = []

    def initial_state(self, batch: int) -> PyTree:
        self.functions = _of_each(self.policy.function, batch)
        return self.policy.initial_state(batch)

    def act(self, carry: PyTree, observations, state, key: Key) -> tuple[PyTree, PolicyStep]:
        # Copies: a function that writes into what it sees must not blind its guard.
        copies = ((x.copy(), None if state is None else state[k].copy()) for k, x in enumerate(observations))
        asked = zip(self.functions, copies, strict=True)
        wanted = [function(*self.policy.origins.measured(*seen)) for function, seen in asked]
        return self.policy.decided(carry, observations, state, wanted, key)


def _of_each(function: Callable, batch: int) -> list[Callable]:
    """What acts in each of so many simulators, at the beginning of an episode: whoever has `reset`, or a method of it,
    is copied."""
    owner = memory_of(function)
    if owner is None:
        return [function] * batch
    try:
        owners = [owner, *(copy.deepcopy(owner) for _ in range(batch - 1))]
    except Exception as error:
        raise UserError(
            f"{type(owner).__name__} has reset(), and so a memory, but cannot be copied for each of {batch} "
            f"simulators ({error}); pass num_envs=1."
        ) from None
    for one in owners:
        one.reset()
    return owners if owner is function else [getattr(one, function.__name__) for one in owners]
