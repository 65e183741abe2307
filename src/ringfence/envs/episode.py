"""One episode in anybody's simulator, through PettingZoo's parallel API; everything it tells is checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ringfence.errors import UserError

Cost = Callable[[dict[str, dict]], float | Mapping[str, float]]


@dataclass(frozen=True)
class Shape:
    """What a simulator must show; None is what nobody knows before it does."""

    agents: int | None = None
    observation: int | None = None
    state: int | None = 0  # entries of the global state, 0: it is not asked for
    alike: bool = False  # any number of agents could play


def check(env: Any, *names: str) -> None:
    """Refuse what is no PettingZoo `ParallelEnv`."""
    lacking = [name for name in ("possible_agents", "reset", "step", *names) if not hasattr(env, name)]
    if lacking:
        raise UserError(f"make_env() made a {type(env).__name__} without {lacking[0]}; give a PettingZoo ParallelEnv.")


class Episode:
    """An episode under way: what its agents see, and what they have earned and cost.

    `seen` (N, O) and `state` (S,) or None are of now, or of the step before if the end was not shown; `rewards` holds
    (N,) of every step, `costs` a float, or (N,) where each agent is told its own, and `constraints` a dictionary of
    these by the constraint's name, where the simulator tells costs by name.
    """

    def __init__(self, env: Any, shape: Shape, seed: int, longest: int):
        check(env)
        self.env, self.shape, self.agents, self.longest = env, shape, list(env.possible_agents), longest
        if not self.agents:
            raise UserError(f"{type(env).__name__} has no possible_agents; give at least one.")
        if len(set(map(str, self.agents))) < len(self.agents):
            raise UserError(f"{type(env).__name__} names an agent twice in possible_agents; give each its own name.")
        if shape.agents not in (None, len(self.agents)):
            remedy = f"; pass agents={len(self.agents)}" if shape.alike else ""
            raise UserError(
                f"{type(env).__name__} has {len(self.agents)} agents, the run was trained with {shape.agents}{remedy}."
            )
        if shape.state != 0 and not hasattr(env, "state"):
            raise UserError(
                f"The run reads a global state, which {type(env).__name__} lacks; give it a state() method."
            )
        self.rewards: list[np.ndarray] = []
        self.costs: list[float | np.ndarray] = []
        self.constraints: list[dict[str, float | np.ndarray]] = []
        self.terminated = self.unsafe_start = False
        self.running = self.showed_end = True
        begun = env.reset(seed=seed)
        if not isinstance(begun, tuple) or len(begun) != 2:
            raise UserError(
                f"reset() of {type(env).__name__} returned a {type(begun).__name__}; a ParallelEnv's returns two "
                "things, observations and infos."
            )
        self._look(begun[0])

    @property
    def owes(self) -> bool:
        """The last step told no cost."""
        return len(self.costs) < len(self.rewards)

    def charge(self, cost: float) -> None:
        """Set the cost of the last step, if nobody has."""
        if self.owes:
            self.costs.append(cost)

    def step(self, action: np.ndarray, cost: Cost | None = None) -> None:
        """Act (N, A) and take note of what came of it."""
        told, name = self.env.step(dict(zip(self.agents, action))), type(self.env).__name__
        if not isinstance(told, tuple | list) or len(told) not in (5, 6):
            count = len(told) if hasattr(told, "__len__") else 1
            raise UserError(f"step() of {name} returned {count} things; a ParallelEnv's are five.")
        if odd := [type(part).__name__ for part in told if not isinstance(part, Mapping)]:
            raise UserError(f"step() of {name} returned a {odd[0]}; each of its five is a dict by agent.")
        seen, rewards, *costs, terminations, truncations, infos = told
        self._all_in("rewards", rewards, len(self.rewards) + 1)
        ended = [bool(terminations.get(a) or truncations.get(a)) for a in self.agents]
        if any(ended) and not all(ended):
            gone = self.agents[ended.index(True)]
            raise UserError(f"{gone} ended at step {len(self.rewards) + 1} before its team; agents must end together.")
        self.rewards.append(np.array([_number(rewards[a], "reward", name) for a in self.agents]))
        self._cost(costs[0] if costs else None, infos, cost)
        if len(self.rewards) >= self.longest and not all(ended):
            raise UserError(
                f"An episode of {name} has not ended after {self.longest} steps; let truncations end it, or pass "
                "longest=."
            )
        if not np.isfinite(np.concatenate([self.rewards[-1], *(np.ravel(c) for c in self.costs[-1:])])).all():
            raise UserError(f"Step {len(self.rewards)} has a reward or cost that is not finite; repair the simulator.")
        self.running = not all(ended)
        self.terminated = all(bool(terminations.get(a)) for a in self.agents)
        if self.running or seen:
            self._look(seen)
        elif self.owes:  # costs that were told need no last state
            raise UserError(
                "step() tells neither a cost nor the state that an episode ends in; return the last observations."
            )
        self.showed_end = bool(seen)

    def _cost(self, apart: Mapping | None, infos: Mapping, cost: Cost | None) -> None:
        """The step's, if anything tells it: `cost`, what `step` tells beside rewards, or the infos."""
        name = type(self.env).__name__
        told_of = {a: i for a, i in infos.items() if isinstance(i, Mapping)}
        each = apart if apart is not None else {a: i["cost"] for a, i in told_of.items() if "cost" in i}
        told = cost(infos) if cost is not None else self._of_all(each)
        if told is None:
            return
        if isinstance(told, Mapping):
            self.constraints.append({str(k): self._charged(c, name) for k, c in told.items()})
            names, now = list(self.constraints[0]), list(self.constraints[-1])
            if not names or now != names or len(self.constraints) < len(self.rewards):
                raise UserError(
                    f"Step {len(self.rewards)} of {name} tells costs of {', '.join(now) or 'nothing'}, the first one "
                    f"of {', '.join(names) or 'nothing'}; name the same constraints at every step."
                )
            told = np.max(np.broadcast_arrays(*self.constraints[-1].values()), 0)
        elif self.constraints:
            raise UserError(f"Step {len(self.rewards)} of {name} tells one cost, those before several; name them all.")
        self.costs.append(self._charged(told, "cost=" if cost is not None else name))
        if self.costs and np.min(self.costs[-1]) < 0:
            raise UserError(
                f"Step {len(self.rewards)} has the cost {np.min(self.costs[-1]):g}; a cost is 0 or positive."
            )

    def _of_all(self, each: Mapping) -> Any:
        """What the agents' costs are together: each agent's own where all tell one, else the largest; by name where
        they are told by name."""
        if not each:
            return None
        if not any(isinstance(c, Mapping) for c in each.values()):
            told = [_number(c, "cost", type(self.env).__name__) for c in each.values()]
            if not all(a in each for a in self.agents):
                return max(told)
            return np.array([_number(each[a], "cost", type(self.env).__name__) for a in self.agents])
        if not all(isinstance(c, Mapping) for c in each.values()):
            raise UserError(
                f"Step {len(self.rewards)} of {type(self.env).__name__} tells some agents' costs by name and others' "
                "not; name them all."
            )
        names = list(dict.fromkeys(k for c in each.values() for k in c))
        return {k: self._of_all({a: c[k] for a, c in each.items() if k in c}) for k in names}

    def _charged(self, cost: Any, whose: str) -> float | np.ndarray:
        if isinstance(cost, np.ndarray) and cost.shape == (len(self.agents),):
            return cost
        return _number(cost, "cost", whose)

    def _all_in(self, what: str, told: dict, step: int) -> None:
        lacking = [str(a) for a in self.agents if a not in told]
        if lacking:
            raise UserError(
                f"{type(self.env).__name__} tells no {what} of {', '.join(lacking)} at step {step}; all "
                "of possible_agents must take part until the episode ends."
            )

    def _look(self, seen: dict) -> None:
        self._all_in("observations", seen, len(self.rewards))
        there = [seen[a] for a in self.agents]
        self.seen = given_as("observations", there, (len(self.agents), self.shape.observation))
        self.state = None
        if self.shape.state != 0:
            self.state = given_as("state", self.env.state(), (self.shape.state,))


def given_as(name: str, value: np.ndarray, expected: tuple[int | None, ...]) -> np.ndarray:
    """What a policy is given, as numbers of the expected shape; None stands for a width that nobody knows."""
    letters = "NO" if len(expected) == 2 else "S"
    wanted = f"({', '.join(letter if n is None else str(n) for letter, n in zip(letters, expected))})"
    try:
        array = np.asarray(value, np.float32)
    except (TypeError, ValueError):
        raise UserError(f"{name} is no array of numbers; pass one of shape {wanted}.") from None
    if array.ndim != len(expected) or any(n not in (None, m) for m, n in zip(array.shape, expected)):
        raise UserError(f"{name} has shape {array.shape}, this run takes {wanted}; pass what its data holds.")
    if not np.isfinite(array).all():
        where = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
        raise UserError(
            f"{name}{where} is {array[tuple(where)]}, but a policy takes finite numbers alone; repair that entry."
        )
    return array


def _number(value: Any, what: str, whose: str) -> float:
    try:
        return float(np.asarray(value, np.float64).reshape(()))
    except (TypeError, ValueError):
        raise UserError(f"{whose} tells the {what} {str(value)[:80]!r}, which is no number; give one.") from None
