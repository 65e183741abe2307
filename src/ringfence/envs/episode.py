"""Episodes in anybody's simulators, through PettingZoo's parallel API; everything that these return is checked.

Simulators side by side are one `Env` (envs/base.py)."""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from ringfence.envs.base import Outcome, Seen
from ringfence.errors import UserError, of_kind
from ringfence.problem.origins import NOWHERE, Origins
from ringfence.utils import schemas
from ringfence.utils.given import NUMBERS, given_as, refuse_other_order

Cost = Callable[[dict[str, dict]], float | Mapping[str, float]]
Charge = Callable[[np.ndarray, np.ndarray | None], np.ndarray]
ByAgent = Mapping[Any, Any]
LARGEST = 1e30  # of rewards and costs: squares of their sums are numbers still
EARLY_ENDS = ("refuse", "cut", "skip")  # what becomes of an episode that one agent leaves before the others


class ParallelEnv(Protocol):
    """What is asked of a simulator, a part of PettingZoo's parallel API. One with a global state has `state()`, too."""

    @property
    def possible_agents(self) -> Sequence[Any]: ...

    def reset(self, seed: int | None = None) -> tuple[ByAgent, ByAgent]: ...

    def step(self, actions: dict[Any, Any]) -> tuple[ByAgent, ...]: ...


@dataclass(frozen=True)
class Shape:
    """What a simulator must show; None is what nobody knows before it does."""

    agents: int | None = None
    observation: int | None = None
    state: int | None = 0  # entries of the global state, 0: it is not asked for
    homogeneous: bool = False  # any number of agents could play
    origins: Origins = NOWHERE  # of what is shown, which is taken from it
    needs_state: bool = True  # a simulator without a state that is asked for is refused
    double: bool = False  # what is shown in double precision stays in it
    names: Sequence[str] | None = None  # of the logs' agents, in order


def check(env: Any, *names: str) -> None:
    """Refuse what is no PettingZoo `ParallelEnv`."""
    lacking = [name for name in ("possible_agents", "reset", "step", *names) if not hasattr(env, name)]
    if lacking:
        raise UserError(f"make_env() made a {type(env).__name__} without {lacking[0]}; give a PettingZoo ParallelEnv.")


def made(make_env: Callable[[], Any], *names: str) -> Any:
    """A simulator that has these besides; what makes none is refused."""
    check_maker(make_env)
    env = make_env()
    check(env, *names)
    return env


def check_maker(make_env: Any) -> None:
    """Refuse what makes no simulator: what cannot be called, or not without arguments."""
    kind = getattr(make_env, "__name__", type(make_env).__name__)
    if not callable(make_env):
        own = f"{kind}, or lambda: {kind}(...)"
        instead = own if hasattr(make_env, "step") else "the class, or a function, of a simulator"
        raise UserError(f"make_env is a {kind} and not what makes one; give {instead}.")
    try:
        inspect.signature(make_env).bind()
    except TypeError as error:
        raise UserError(
            f"{kind} makes no simulator by itself ({error}); give a function without arguments that makes one."
        ) from None
    except ValueError:  # of some that are written in C nobody knows
        pass


def is_vector(space: Any) -> bool:
    """Whether it is a Box of one axis."""
    return getattr(space, "low", None) is not None and len(space.shape) == 1


class Episode:
    """An episode under way: what its agents see, and what they have earned and cost.

    `seen` (N, O) and `state` (S,) or None are of now, or of the step before if the end was not shown; `rewards` holds
    (N,) of every step, `costs` a float, or (N,) where each agent has its own, and `constraints` a dictionary of these
    by the constraint's name, where the simulator names costs.
    """

    def __init__(self, env: Any, shape: Shape, seed: int, max_steps: int, early_ends: str = "refuse"):
        check(env)
        self.seed = seed
        self.early_ends = early_ends
        self.was_cut = False  # one agent left before the others, and the episode ends there
        self.skipped = False  # one agent left before the others, and the episode counts for nothing
        self.env: ParallelEnv = env
        self.name = type(env).__name__
        self.shape = shape
        self.agents = list(env.possible_agents)
        self.max_steps = max_steps
        if not self.agents:
            raise UserError(f"{self.name} has no possible_agents; give at least one.")
        if len(set(map(str, self.agents))) < len(self.agents):
            raise UserError(f"{self.name} names an agent twice in possible_agents; give each its own name.")
        refuse_other_order(self.agents, self.shape.names, all_known=False)
        self._read_state: Callable[[], Any] | None = getattr(env, "state", None) if shape.state != 0 else None
        if shape.state != 0 and self._read_state is None:
            self._refuse_without_state()
        self.rewards: list[np.ndarray] = []
        self.costs: list[float | np.ndarray] = []
        self.constraints: list[dict[str, float | np.ndarray]] = []
        self.terminated = False
        self.unsafe_start = False
        self.told: set[str] = set()  # what infos tell that have no cost
        self.charged = False  # some step told its cost
        self.counts = Counter[str]()  # steps in which a guard failed, or did not know
        self.running = True
        self.showed_end = True
        begun = env.reset(seed=seed)
        if not isinstance(begun, tuple) or len(begun) != 2:
            raise UserError(
                f"reset() of {self.name} returned a {type(begun).__name__}; a ParallelEnv's returns two "
                "things, observations and infos."
            )
        self._check_count(begun[0])
        self._observe(begun[0])
        states = shape.state if self.state is None else len(self.state)
        self.shape = replace(shape, observation=self.seen.shape[1], state=states)  # of all that follows

    def _check_count(self, observations: ByAgent) -> None:
        """Refuse another number of agents; where they see something else, too, that is said first."""
        count, width = len(self.agents), self.shape.observation
        if self.shape.agents in (None, count):
            return
        self._check_all_in("observations", observations, 0)
        shapes = {np.asarray(observations[a], object).shape for a in self.agents}
        if width is not None and shapes != {(width,)}:
            self._rows(observations, self.shape.agents)
        other = f"give a simulator of {self.shape.agents}, or train on logs of {count}"
        remedy = f"pass agents={count} (--agents {count})" if self.shape.homogeneous else other
        raise UserError(f"{self.name} has {count} agents, the run was trained with {self.shape.agents}; {remedy}.")

    @property
    def lacks_cost(self) -> bool:
        """The last step has no cost yet."""
        return len(self.costs) < len(self.rewards)

    @property
    def over(self) -> bool:
        """It has ended, and nothing is missing of its last step."""
        return not self.running and (self.skipped or not self.lacks_cost)

    @property
    def team_rewards(self) -> np.ndarray:
        """(L,) the mean over agents."""
        return np.array([reward.mean() for reward in self.rewards])

    @property
    def team_costs(self) -> np.ndarray:
        """(L,) the largest of the agents' costs."""
        return np.array([np.max(cost) for cost in self.costs])

    def charge(self, cost: float) -> None:
        """Set the cost of the last step, if nothing has."""
        if self.lacks_cost:
            self.costs.append(cost)

    def step(self, action: np.ndarray, cost: Cost | None = None) -> None:
        """Act (N, A) and take note of what came of it."""
        own = [np.array(one) for one in action]  # a simulator may write into what it is given
        step = _checked(self.name, self.env.step(dict(zip(self.agents, own))))
        number = len(self.rewards) + 1
        # the first agent that ended, or is not there any more, while others go on; None where they stay together
        gone = [a for a in self.agents if a not in step.rewards or self._agent_ended(step, a)]
        together = len(gone) == len(self.agents) or not any([self._agent_ended(step, a) for a in gone])
        left = None if together else gone[0]
        if left is not None and self._is_over_without(left, step, number):
            return
        self._check_all_in("rewards", step.rewards, number)
        ended = left is not None or all(self._agent_ended(step, agent) for agent in self.agents)
        self.rewards.append(np.array([_number(step.rewards[a], "reward", self.name) for a in self.agents]))
        self._take_cost(step, cost)
        if number >= self.max_steps and not ended:
            raise UserError(
                f"An episode of {self.name} has not ended after {self.max_steps} steps; let truncations end it, or "
                "pass max_episode_steps=."
            )
        numbers = np.concatenate([self.rewards[-1], *(np.ravel(c) for c in self.costs[-1:])])
        if not (np.abs(numbers) <= LARGEST).all():
            raise UserError(
                f"Step {number} has a reward or cost that is not finite, or beyond {LARGEST:g}; repair the simulator."
            )
        self.running = not ended
        self.terminated = left is None and all(bool(step.terminations.get(a)) for a in self.agents)
        self.showed_end = bool(step.observations)
        if self.running or self.showed_end:
            self._observe(step.observations)
        elif self.lacks_cost:  # a step with a cost needs no last state
            raise UserError(
                "step() tells neither a cost nor the state that an episode ends in; return the last observations."
            )

    def _agent_ended(self, step: Step, agent: Any) -> bool:
        return _is_set(step.terminations, agent) or _is_set(step.truncations, agent)

    def _is_over_without(self, left: Any, step: Step, number: int) -> bool:
        """Whether the episode is over without the step in which an agent left its team: it is skipped, or nobody shows
        where that step led. Refused where nobody said what is to become of it."""
        if self.early_ends == "refuse":
            raise UserError(
                f"{left} ended at step {number} before its team, in the episode of {self.name} with the seed "
                f"{self.seed}; let agents end together, or pass early_ends='cut', which ends the episode there, or "
                "'skip', which leaves it out and counts it."
            )
        self.was_cut = self.early_ends == "cut"
        shown = all(a in step.rewards and a in step.observations for a in self.agents)
        if self.was_cut and shown:
            return False
        self.skipped = not self.was_cut or not self.rewards
        self.running = False
        return True

    def _take_cost(self, step: Step, cost: Cost | None) -> None:
        """The step's cost, if there is one: that of `cost`, what `step` gives beside rewards, or what infos hold."""
        charged = cost(dict(step.infos)) if cost is not None else self._team_cost(_costs_by_agent(step))
        if charged is None:
            self.told.update(str(key) for info in step.infos.values() if isinstance(info, Mapping) for key in info)
            return
        if isinstance(charged, Mapping):
            self._take_constraints(charged)
            charged = np.max(np.broadcast_arrays(*self.constraints[-1].values()), 0)
        elif self.constraints:
            raise UserError(
                f"Step {len(self.rewards)} of {self.name} tells one cost, those before several; name them all."
            )
        self.costs.append(self._of_agents(charged, "cost=" if cost is not None else self.name))
        self.charged = True

    def _take_constraints(self, costs: Mapping[Any, Any]) -> None:
        """The step's cost by each constraint's name."""
        try:
            schemas.check({str(name): 0.0 for name in costs}, schemas.Limits)
        except ValueError:
            raise UserError(
                f"Step {len(self.rewards)} of {self.name} tells costs of {str(list(costs))[:200]}; name at most 100, "
                "each without slashes, line breaks or a leading dot or dash, of at most 120 letters."
            ) from None
        self.constraints.append({str(k): self._of_agents(c, self.name) for k, c in costs.items()})
        names = list(self.constraints[0])
        now = list(self.constraints[-1])
        if not names or now != names or len(self.constraints) < len(self.rewards):
            raise UserError(
                f"Step {len(self.rewards)} of {self.name} tells costs of {', '.join(now) or 'nothing'}, the first one "
                f"of {', '.join(names) or 'nothing'}; name the same constraints at every step."
            )

    def _team_cost(self, by_agent: ByAgent) -> Any:
        """Agents' costs together: (N,) where all have one, else the largest; by constraint where they are named."""
        if not by_agent:
            return None
        named = [isinstance(c, Mapping) for c in by_agent.values()]
        if not any(named):
            costs = {a: _number(c, "cost", self.name) for a, c in by_agent.items()}
            everybody = all(a in costs for a in self.agents)
            return np.array([costs[a] for a in self.agents]) if everybody else max(costs.values())
        if not all(named):
            raise UserError(
                f"Step {len(self.rewards)} of {self.name} tells some agents' costs by name and others' "
                "not; name them all."
            )
        constraints = dict.fromkeys(k for costs in by_agent.values() for k in costs)
        return {k: self._team_cost({a: c[k] for a, c in by_agent.items() if k in c}) for k in constraints}

    def _of_agents(self, cost: Any, whose: str) -> float | np.ndarray:
        """A number, or one of each agent; 0 or more."""
        array = isinstance(cost, np.ndarray) and not isinstance(cost, np.ma.MaskedArray)
        each = array and cost.shape == (len(self.agents),) and cost.dtype.kind in NUMBERS
        found = np.array(cost, np.float64) if each else _number(cost, "cost", whose)
        if np.min(found) < 0:
            raise UserError(f"Step {len(self.rewards)} has the cost {np.min(found):g}; a cost is 0 or positive.")
        return found

    def _check_all_in(self, what: str, by_agent: ByAgent, step: int) -> None:
        lacking = [str(a) for a in self.agents if a not in by_agent]
        if lacking:
            raise UserError(
                f"{self.name} tells no {what} of {', '.join(lacking)} at step {step}; all "
                "of possible_agents must take part until the episode ends."
            )

    def _observe(self, observations: ByAgent) -> None:
        self._check_all_in("observations", observations, len(self.rewards))
        self.seen = self._rows(observations, len(self.agents))
        self.state = None
        if self._read_state is not None:
            try:
                state = self._read_state()
            except NotImplementedError:  # the method of PettingZoo's base class
                self._refuse_without_state()
                self._read_state = None
                return
            self.state = self._given("state", state, (self.shape.state,), self.shape.origins.state)

    def _given(
        self, name: str, value: Any, shape: tuple[int | None, ...], origins: tuple[float, ...] | None
    ) -> np.ndarray:
        begun = (f"{self.name}, as it began,", "show as many entries at every step") if self.rewards else ()
        return given_as(name, value, shape, *begun, origins=origins, double=self.shape.double)

    def _refuse_without_state(self) -> None:
        if self.shape.needs_state:
            raise UserError(f"The run reads a global state, which {self.name} lacks; give it a state() method.")

    def _rows(self, observations: ByAgent, agents: int | None) -> np.ndarray:
        """(N, O) in the order of the agents, or a refusal of what so many of them cannot have seen."""
        rows = [observations[a] for a in self.agents]
        shape = (agents, self.shape.observation)
        try:
            return self._given("observations", rows, shape, self.shape.origins.observations)
        except UserError as error:
            sizes = {np.size(row) for row in rows}
            if len(sizes) > 1:
                raise UserError(
                    f"Agents of {self.name} observe {min(sizes)} to {max(sizes)} entries, and all must have the same; "
                    "pass ringfence.padded(make_env), in which they have."
                ) from None
            where = f"{self.name}, step {len(self.rewards)} of the episode with the seed {self.seed}"
            raise UserError(f"{str(error).rstrip('.')} ({where}).") from None


class Step(NamedTuple):
    """What a simulator's `step` returned, each by agent; costs where there are six."""

    observations: ByAgent
    rewards: ByAgent
    costs: ByAgent | None
    terminations: ByAgent
    truncations: ByAgent
    infos: ByAgent


def _checked(name: str, returned: Any) -> Step:
    """What `step` of the simulator of that name returned, five dictionaries or six."""
    if not isinstance(returned, tuple | list) or len(returned) not in (5, 6):
        count = len(returned) if isinstance(returned, tuple | list | Mapping) else 1
        raise UserError(f"step() of {name} returned {count} things; a ParallelEnv's are five.")
    odd = [type(part).__name__ for part in returned if not isinstance(part, Mapping)]
    if odd:
        raise UserError(f"step() of {name} returned a {odd[0]}; each of its five is a dict by agent.")
    observations, rewards, *costs, terminations, truncations, infos = returned
    for agent, info in infos.items():
        if not isinstance(info, Mapping | None):
            raise UserError(
                f"step() of {name} gave {agent} the info {str(info)[:60]!r}; infos are a dict of each agent."
            )
    return Step(observations, rewards, costs[0] if costs else None, terminations, truncations, infos)


def _costs_by_agent(step: Step) -> ByAgent:
    """Costs that `step` gave beside rewards, else those of the infos; an agent without one is not there."""
    if step.costs is not None:
        return step.costs
    return {a: info["cost"] for a, info in step.infos.items() if isinstance(info, Mapping) and "cost" in info}


def _is_set(flags: ByAgent, agent: Any) -> bool:
    """Whether an agent's flag is set; text is none, though "False" is true to Python."""
    flag = flags.get(agent, False)
    known = isinstance(flag, bool | int | float | np.bool_ | np.number | np.ndarray)
    if not known or np.ma.is_masked(flag) or np.size(flag) != 1 or not np.isin(flag, (0, 1)).all():
        raise UserError(f"{agent} has the flag {str(flag)[:60]!r}, which is neither true nor false; give a bool.")
    return bool(flag)


def _number(value: Any, what: str, whose: str) -> float:
    try:
        array = np.asarray(value)
        if isinstance(value, np.ma.MaskedArray) or array.dtype.kind not in NUMBERS:
            raise TypeError
        return float(array.reshape(()))
    except (TypeError, ValueError):
        raise UserError(f"{whose} tells the {what} {str(value)[:80]!r}, which is no number; give one.") from None


@dataclass(eq=False)
class SideBySide:
    """PettingZoo `ParallelEnv`s, whose `episodes` keep what came of each.

    A step's cost is `cost(infos)` if that is given, else what the simulator tells; else `charge` of the observations
    and states that it leads to, (B,). Where that is None, too, it is refused.
    """

    envs: Sequence[Any]
    shape: Shape
    max_steps: int
    early_ends: str = "refuse"
    cost: Cost | None = None
    charge: Charge | None = None
    episodes: list[Episode] = field(default_factory=list)

    def __post_init__(self):
        of_kind("cost", self.cost, Callable | None, "give a function of the infos of a step")

    @property
    def running(self) -> np.ndarray:
        return np.array([e.running for e in self.episodes])

    def reset(self, seeds: Sequence[int]) -> None:
        """Begin as many episodes as there are seeds, in the first simulators."""
        begun = zip(self.envs, seeds)
        self.episodes = [Episode(env, self.shape, seed, self.max_steps, self.early_ends) for env, seed in begun]

    def observe(self) -> Seen:
        states = [e.state for e in self.episodes if e.state is not None]
        return Seen(np.stack([e.seen for e in self.episodes]), np.stack(states) if states else None)

    def step(self, action: np.ndarray) -> Outcome:
        running = self.running
        for episode, own in zip(self.episodes, action):
            if episode.running:
                episode.step(own, self.cost)
        if any(e.lacks_cost for e in self.episodes if not e.skipped):
            if self.charge is None:
                raise UserError(
                    "step() tells no cost, and no formula says of what the policy sees whether it is unsafe; pass "
                    "cost=, a function of the agents' infos."
                )
            for episode, cost in zip(self.episodes, self.charge(*self.observe())):
                episode.charge(float(cost))
        nothing = np.zeros(action.shape[1])  # of an episode that was skipped at its first step
        return Outcome(
            reward=np.stack([e.rewards[-1] if e.rewards else nothing for e in self.episodes]),
            cost=self._last_costs(),
            terminated=running & np.array([e.terminated for e in self.episodes]),
            shown=running & np.array([e.running or e.showed_end for e in self.episodes]),
        )

    def _last_costs(self) -> np.ndarray | dict[str, np.ndarray]:
        """(B,) what the last step of each cost, or that by constraint."""
        named = [e.constraints[0] for e in self.episodes if e.constraints]
        if not named:
            return np.array([np.max(e.costs[-1]) if e.costs else 0.0 for e in self.episodes], np.float32)
        nothing = dict.fromkeys(named[0], 0.0)
        last = [e.constraints[-1] if e.constraints else nothing for e in self.episodes]
        return {name: np.array([np.max(costs[name]) for costs in last], np.float32) for name in nothing}
