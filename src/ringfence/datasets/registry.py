"""What there is to solve: a simulator, a definition of danger, a data tier, and the constants of its table."""

from __future__ import annotations

from dataclasses import replace
from typing import TypedDict

from ringfence.datasets.recipes import crossing, proving, robots, spread
from ringfence.datasets.task import Task
from ringfence.envs import Crossing, SafeMuJoCo, SimpleSpread, SpreadAlike, System
from ringfence.envs.base import NativeEnv, PureEnv
from ringfence.envs.crossing import Body
from ringfence.envs.mujoco import COST_LIMIT, Parts
from ringfence.envs.proving.system import DEVELOPMENT, TEST
from ringfence.errors import StoreError, UserError, one_of
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints


class Constants(TypedDict):
    """What a family of tasks is normalised by."""

    return_min: float
    return_max: float
    cost_limit: float


# OMAR's constants (Pan et al. 2022, as printed by MADIFF): a random and an expert policy's return.
_SPREAD_HAZARD = constraints.Separation(0.30)
_SPREAD: Constants = {"return_min": 159.8, "return_max": 516.8, "cost_limit": 1.0}


def _spread(tier: str, mean: float, deviation: float | None = None, transitions: int = 1_000_000) -> Task:
    level = tier.removesuffix(spread.POOLED)
    return Task(
        f"simple_spread-{tier}",
        SimpleSpread(),
        _SPREAD_HAZARD,
        tier=tier,
        presets=(level,) if tier == level else ("pooled", level),
        published_return=(mean, deviation),
        transitions=transitions,
        recipe=spread.RECIPE,
        **_SPREAD,
    )


def _spread_alike(tier: str) -> Task:
    """A million agent-steps, in the views of each agent."""
    return Task(
        f"spread_alike-{tier}",
        SpreadAlike(),
        _SPREAD_HAZARD,
        tier=tier,
        transitions=333_350,
        recipe=spread.ALIKE,
        homogeneous=True,
        **_SPREAD,
    )


# OG-MARL's constants (Formanek et al. 2023): a random and the best policy's return.
_ROBOTS: dict[Parts, Constants] = {
    "2x3": {"return_min": -280.18, "return_max": 9132.25, "cost_limit": COST_LIMIT},
    "2x4": {"return_min": -325.6, "return_max": 3362.44, "cost_limit": COST_LIMIT},
    "4x2": {"return_min": -325.6, "return_max": 3224.91, "cost_limit": COST_LIMIT},
}
# m/s: the 60th percentile of the step speed in a tier's own data, as regenerated in full with seed 0.
QUANTILE_LIMITS = {
    "halfcheetah_2x3-good": 7.903,
    "halfcheetah_2x3-medium": 2.197,
    "halfcheetah_2x3-poor": 1.026,
    "ant_2x4-good": 2.671,
    "ant_2x4-medium": 0.894,
    "ant_2x4-poor": 0.252,
    "ant_4x2-good": 4.044,
    "ant_4x2-medium": 2.253,
    "ant_4x2-poor": 0.528,
}


def _velocity(env: SafeMuJoCo) -> tuple[str, ...]:
    """The entries whose norm a robot's limit is about."""
    return ("torso.vx", "torso.vy") if env.ant else ("torso.vx",)


def _robot(parts: Parts, tier: str, mean: float, deviation: float | None = None, quantile: bool = False) -> Task:
    """`native`: safety-gymnasium's speed limit. `quantile`: one that the tier's data exceeds on 40 % of its steps."""
    name = f"{SafeMuJoCo(parts).name}-{tier}"
    env = SafeMuJoCo(parts, QUANTILE_LIMITS[name] if quantile else None)
    return Task(
        f"{name}-quantile" if quantile else name,
        env,
        constraints.SpeedLimit(env.limit, _velocity(env)),
        tier=tier,
        presets=("mujoco",),
        published_return=(mean, deviation),
        protocol="quantile" if quantile else "native",
        recipe=robots.RECIPE,
        **_ROBOTS[parts],
    )


# Means of OG-MARL's sets (Formanek et al. 2023); it tells no deviations of the Ant's.
_ROBOT_TIERS: tuple[tuple[Parts, str, float, float | None], ...] = (
    ("2x3", "good", 6924.11, 1270.0),
    ("2x3", "medium", 1485.0, 469.0),
    ("2x3", "poor", 400.45, 334.0),
    ("2x4", "good", 2621.5, None),
    ("2x4", "medium", 1099.98, None),
    ("2x4", "poor", 437.67, None),
    ("4x2", "good", 2769.29, None),
    ("4x2", "medium", 1546.05, None),
    ("4x2", "poor", 542.73, None),
)


# What the certificates earn at full speed.
_CERTIFIED: dict[Body, float] = {"disc": 4.2, "unicycle": 3.85}


def _crossing(tier: str, body: Body = "disc") -> Task:
    """A million agent-steps."""
    return Task(
        ("crossing-" if body == "disc" else f"crossing_{body}-") + tier,
        Crossing(body=body),
        constraints.Separation(0.30),
        tier=tier,
        return_max=_CERTIFIED[body],
        transitions=125_000,
        recipe=crossing.RECIPE,
        homogeneous=True,
    )


# What the expert driver of envs/proving/drivers.py earns in 200 episodes of each system.
_EXPERT: dict[str, float] = {
    "discs": 3.06,
    "posts": 2.57,
    "flock": 1.29,
    "hall": 3.70,
    "crowd": 3.27,
    "couriers": 4.00,
    "street": 2.80,
    "lane": 2.92,
    "drones": 1.89,
    "pillar": 2.29,
    "convoy": 3.50,
    "train": 1.31,
    "arms": 1.51,
    "bench": 1.12,
    "shafts": 6.40,
    "gears": 3.24,
    "dev-room": 2.17,
    "dev-path": 3.34,
    "dev-swing": 1.26,
    "dev-file": 4.69,
}


def _proving(name: str, system: System) -> Task:
    """3000 episodes of scripted drivers; costs alone say what is dangerous."""
    return Task(
        f"proving-{name}",
        system,
        constraints.CostColumn(),
        tier=system.drivers,
        return_max=_EXPERT[name],
        transitions=proving.EPISODES * system.episode_length,
        recipe=proving.RECIPE,
        homogeneous=system.homogeneous,
    )


TASKS = {
    t.name: t
    for t in (
        _spread("expert", 530.95, 71.41),
        _spread("medium", 273.39, 92.06),
        _spread("medium-replay", 203.74, 80.49, 97_500),
        _spread("random", 159.57, 60.46),
        # Means of the public sets' five seeds; nobody prints their deviations.
        _spread("expert-pooled", 516.76),
        _spread("medium-pooled", 259.85),
        _spread("medium-replay-pooled", 194.16, None, 97_500),
        _spread("random-pooled", 159.84),
        *(_robot(*facts) for facts in _ROBOT_TIERS),
        *(_robot(*facts, quantile=True) for facts in _ROBOT_TIERS),
        *(_crossing(tier, body) for body in _CERTIFIED for tier in crossing.TIERS),
        _crossing("pooled"),
        _spread_alike("expert"),
        _spread_alike("medium"),
        *(_proving(name, system) for name, system in TEST.items()),
        *(_proving(f"dev-{name}", system) for name, system in DEVELOPMENT.items()),
    )
}


def get(name: str) -> Task:
    """The task of that name; an unknown one is refused with the nearest name."""
    return one_of("task", name, TASKS)


def of_team(task: Task, agents: int) -> Task:
    """The task with another number of agents, at the same density; refused where they are heterogeneous."""
    if not task.homogeneous:
        raise UserError(
            f"'{task.name}' has agents of its own kinds, each with weights of its own, so agents={agents} cannot play; "
            "leave it out."
        )
    return task if task.env is None else replace(task, env=replace(task.env, n_agents=agents))


def paired(name: str) -> str | None:
    """The task with the same data under safety-gymnasium's limit, of a task with a limit of its own."""
    other = name.removesuffix("-quantile")
    return other if other != name else None


def siblings(name: str) -> list[str]:
    """The tasks whose data are the same steps with costs of another limit."""
    root = paired(name) or name
    return [t for t in TASKS if t != name and root in (t, paired(t))]


def simulated(name: str, hazard: constraints.Hazard) -> Task | None:
    """The task of that name with the danger that its data defines; None where there is no simulator that counts it.

    `halfcheetah_2x3-replay` and the like, tiers that are not of this package, are played by their robot with the
    data's speed limit. Data under the name of a task must mean the same danger; a bare cost column means the task's.
    """
    if name in TASKS:
        task = TASKS[name]
        if isinstance(hazard, constraints.CostColumn):
            return task
        if _danger(hazard) != _danger(task.hazard):
            raise UserError(
                f"The data is called '{name}', whose danger is {task.hazard}, but defines {hazard}; give it a name of "
                f"its own, e.g. '{name}-mine', or the task's hazard."
            )
        return replace(task, hazard=hazard)
    robot, _, tier = name.partition("-")
    for parts, constants in _ROBOTS.items():
        env = SafeMuJoCo(parts)
        if tier and robot == env.name:
            if not isinstance(hazard, constraints.SpeedLimit) or tuple(hazard.features) != _velocity(env):
                return None
            env = replace(env, speed_limit=hazard.limit)
            return Task(name, env, hazard, tier=tier, presets=("mujoco",), **constants)
    return None


def _danger(hazard: constraints.Hazard) -> constraints.Hazard:
    """What costs follow from: a hazard without its safe margin."""
    return hazard if isinstance(hazard, constraints.CostColumn | constraints.All) else replace(hazard, safe_margin=0.0)


def from_store(store: EpisodeStore) -> Task:
    """The task that a store belongs to, or a task made of the store alone for anybody's own data."""
    card = store.card
    name = card.task
    task = simulated(name, store.hazard)
    if task is not None:
        wrong = _misfit(store, task.simulator)
        if name in TASKS and wrong:
            raise StoreError(
                f"The data is called '{name}', but {wrong}; bring it into that layout, or give it a name of its own."
            )
        if name in TASKS or (not wrong and card.state_names):
            return task
    low = float(store.returns.min())
    high = float(store.returns.max())
    robot = any(name.startswith(f"{SafeMuJoCo(parts).name}-") for parts in _ROBOTS)
    return Task(
        name,
        None,
        store.hazard,
        return_min=low,
        return_max=high if high > low else low + 1.0,
        cost_limit=1.0 if card.cost_limit is None else float(card.cost_limit),
        transitions=store.steps,
        presets=("mujoco",) if robot else (),
        action_low=card.bounds.low,
        action_high=card.bounds.high,
        homogeneous=card.homogeneous,
    )


def _misfit(store: EpisodeStore, env: PureEnv | NativeEnv) -> str:
    """Where a store's arrays are not those of the simulator, in words; empty where they are."""
    sizes = (
        ("agents", store.n_agents, env.n_agents),
        ("action entries", store.actions.shape[2], env.action_dim),
        ("observation entries", store.observations.shape[2], env.observation_dim),
        ("state entries", 0 if store.state is None else store.state.shape[1], len(env.state_names)),
    )
    for what, here, there in sizes:
        if here != there:
            return f"has {here} {what}, its simulator {there}"
    if store.card.bounds != (-1.0, 1.0):
        return f"has actions from {store.card.bounds}, its simulator from -1 to 1"
    names = store.card.state_names
    if names and list(names) != list(env.state_names):
        k = next(k for k, (a, b) in enumerate(zip(names, env.state_names)) if a != b)
        return f"its state entry {k} is '{names[k]}', of its simulator '{env.state_names[k]}'"
    return ""
