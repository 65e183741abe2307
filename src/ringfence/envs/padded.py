"""Teams whose agents observe and act in different sizes, as ones in which all have the same entries: their arrays, and
their simulators."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ringfence.envs.episode import is_vector, made
from ringfence.errors import UserError, needs
from ringfence.problem.bounds import Bounds
from ringfence.types import has_entry

if TYPE_CHECKING:
    from gymnasium.spaces import Box

SPARE = (-1.0, 1.0)  # bounds of an action's entry that an agent has not; it stays at their middle


@dataclass(frozen=True)
class Layout:
    """Where each agent's entries stand in arrays (..., N, O) of observations and (..., N, A) of actions.

    `observations` has the names of every agent's entries, in their order. Entries of one name share a place, and an
    agent without such an entry has 0 there. A number instead says how many there are; agents of the same number then
    share their places, in order. `action_low` and `action_high` have the bounds of every agent's action entries: they
    stand first, and what an agent lacks stays at 0.

    layout = Layout({"battery": ["own.charge", "bus.load"], "diesel": ["own.fuel", "bus.load", "own.heat"]},
                    action_low={"battery": [-1], "diesel": [0, 0]}, action_high={"battery": [1], "diesel": [1, 1]})
    store = EpisodeStore.from_steps(layout.rows(seen), layout.joint(done), ..., card={**layout.card, "task": "grid"})
    """

    observations: Mapping[Any, Sequence[str] | int]
    action_low: Mapping[Any, Sequence[float]]
    action_high: Mapping[Any, Sequence[float]]

    def __post_init__(self):
        for what, by_agent in (("action_low", self.action_low), ("action_high", self.action_high)):
            if set(by_agent) != set(self.observations):
                odd = sorted(map(str, set(by_agent) ^ set(self.observations)))[0]
                raise UserError(f"Layout has observations and {what} of different agents ({odd}); give both of each.")
        for agent in self.agents:
            entries = self.observations[agent]
            named = not isinstance(entries, int)
            if named and (isinstance(entries, str) or len(set(entries)) < len(entries) or not entries):
                raise UserError(f"Layout has {entries!r} of {agent}; give a list of names, each once, or their number.")
            if len(self.action_low[agent]) != len(self.action_high[agent]):
                raise UserError(f"Layout bounds {agent}'s action by lists of two lengths; give both of each entry.")
        if len({isinstance(entries, int) for entries in self.observations.values()}) > 1:
            raise UserError("Layout names the entries of some agents alone; name those of all, or of none.")

    @property
    def agents(self) -> tuple[Any, ...]:
        return tuple(self.observations)

    @cached_property
    def entries(self) -> tuple[Any, ...]:
        """Of a row of observations: names, or (how many, which of them)."""
        return tuple(dict.fromkeys(entry for agent in self.agents for entry in self._of(agent)))

    @property
    def named(self) -> bool:
        return not isinstance(next(iter(self.observations.values())), int)

    @property
    def action_sizes(self) -> tuple[int, ...]:
        return tuple(len(self.action_low[agent]) for agent in self.agents)

    @property
    def bounds(self) -> Bounds:
        """Of actions (N, A)."""
        sides = (self.action_low, SPARE[0]), (self.action_high, SPARE[1])
        widest = max(self.action_sizes)
        return Bounds.of(
            *(
                [[*map(float, side[agent]), *[spare] * (widest - len(side[agent]))] for agent in self.agents]
                for side, spare in sides
            )
        )

    @cached_property
    def has_entry(self) -> np.ndarray:
        """(N, A) bool: which entries of an action agents have."""
        return has_entry(self.action_sizes, max(self.action_sizes))

    @property
    def card(self) -> dict[str, Any]:
        """Fields of a store's card."""
        bounds = self.bounds
        fields: dict[str, Any] = {
            "agents": [str(agent) for agent in self.agents],
            "action_low": bounds.low,
            "action_high": bounds.high,
        }
        if self.named:
            fields["observation_names"] = list(self.entries)
        if len(set(self.action_sizes)) > 1:
            fields["action_sizes"] = list(self.action_sizes)
        return fields

    def rows(self, observations: Mapping[Any, Any]) -> np.ndarray:
        """(..., N, O) of every agent's own (..., O_i)."""
        own = [self._given("observations", observations, agent, len(self._of(agent))) for agent in self.agents]
        rows = np.zeros((*own[0].shape[:-1], len(own), len(self.entries)), np.result_type(*own))
        for k, (places, one) in enumerate(zip(self._places, own)):
            rows[..., k, places] = one
        return rows

    def own(self, rows: np.ndarray) -> dict[Any, np.ndarray]:
        """Every agent's own (..., O_i) of (..., N, O): the inverse of `rows`."""
        rows = np.asarray(rows)
        return {agent: rows[..., k, places] for k, (agent, places) in enumerate(zip(self.agents, self._places))}

    def joint(self, actions: Mapping[Any, Any]) -> np.ndarray:
        """(..., N, A) of every agent's own (..., A_i)."""
        own = [self._given("actions", actions, agent, len(self.action_low[agent])) for agent in self.agents]
        joint = np.zeros((*own[0].shape[:-1], *self.has_entry.shape), np.result_type(*own, np.float32))
        for k, one in enumerate(own):
            joint[..., k, : one.shape[-1]] = one
        return joint

    def actions(self, joint: np.ndarray) -> dict[Any, np.ndarray]:
        """Every agent's own (..., A_i) of (..., N, A): the inverse of `joint`."""
        joint = np.asarray(joint)
        return {agent: joint[..., k, :size] for k, (agent, size) in enumerate(zip(self.agents, self.action_sizes))}

    def _of(self, agent: Any) -> list[Any]:
        entries = self.observations[agent]
        return [(entries, k) for k in range(entries)] if isinstance(entries, int) else list(entries)

    @cached_property
    def _places(self) -> list[list[int]]:
        """Where each agent's entries stand in a row."""
        place = {entry: k for k, entry in enumerate(self.entries)}
        return [[place[entry] for entry in self._of(agent)] for agent in self.agents]

    def _given(self, what: str, by_agent: Mapping[Any, Any], agent: Any, size: int) -> np.ndarray:
        """One agent's, checked."""
        if not isinstance(by_agent, Mapping) or agent not in by_agent:
            raise UserError(f"{what} has nothing of {agent}; give a dictionary with an array of every agent.")
        array = np.asarray(by_agent[agent])
        if array.dtype.kind not in "biuf" or array.shape[-1:] != (size,):
            raise UserError(f"{what} of {agent} has shape {array.shape}; its last axis must have its {size} entries.")
        first = np.shape(by_agent[self.agents[0]])[:-1]
        if array.shape[:-1] != first:
            raise UserError(f"{what} of {agent} has shape {array.shape}, the first agent's begins {first}; mend one.")
        return array


def _box() -> type[Box]:
    with needs("sim", "Spaces of padded simulators"):
        from gymnasium.spaces import Box
    return Box


class PaddedEnv:
    """A PettingZoo `ParallelEnv` behind its `layout`; what is not said here is the simulator's own."""

    def __init__(self, env: Any, layout: Layout):
        self.env = env
        self.layout = layout

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, seed: int | None = None, options: dict | None = None) -> Any:
        begun = self.env.reset(seed=seed) if options is None else self.env.reset(seed=seed, options=options)
        if not isinstance(begun, tuple) or len(begun) != 2:
            return begun  # which whoever plays refuses
        observations, infos = begun
        return self._rows(observations), infos

    def step(self, actions: Mapping[Any, np.ndarray]) -> Any:
        sizes = zip(self.layout.agents, self.layout.action_sizes)
        returned = self.env.step({agent: actions[agent][:size] for agent, size in sizes if agent in actions})
        if not isinstance(returned, tuple) or not returned or not isinstance(returned[0], Mapping):
            return returned
        return self._rows(returned[0]), *returned[1:]

    def observation_space(self, agent: Any) -> Box:
        return _box()(-np.inf, np.inf, (len(self.layout.entries),), np.float64)

    def action_space(self, agent: Any) -> Box:
        shape = self.layout.has_entry.shape
        low, high = (np.broadcast_to(one, shape)[self.layout.agents.index(agent)] for one in self.layout.bounds)
        return _box()(low, high, dtype=np.float64)

    def _rows(self, observations: Mapping[Any, Any]) -> Any:
        """By agent; a step that shows nobody, or not all, shows what it does."""
        if not isinstance(observations, Mapping) or any(agent not in observations for agent in self.layout.agents):
            return observations
        return dict(zip(self.layout.agents, self.layout.rows(observations)))


class Padded:
    """What makes simulators whose agents all have the same entries, and their `layout`."""

    def __init__(self, make_env: Callable[[], Any], layout: Layout, kind: type[PaddedEnv]):
        self.make_env = make_env
        self.layout = layout
        self.kind = kind

    def __call__(self) -> PaddedEnv:
        return self.kind(self.make_env(), self.layout)


def padded(make_env: Callable[[], Any], observation_names: Mapping[Any, Sequence[str]] | None = None) -> Padded:
    """A team of agents whose spaces differ, for `collect` and `play`: a PettingZoo `ParallelEnv` whose agents have
    boxes of one axis. `observation_names` has the names of every agent's entries; those of one name share a place.

    make = padded(Grid, {"battery": ["own.charge", "bus.load"], "diesel": ["own.fuel", "bus.load", "own.heat"]})
    store = collect(make, policy)               # of (N, O); make.layout.own gives each agent's own vector
    result = play(run, make)
    """
    env = made(make_env, "action_space", "observation_space")
    name = type(env).__name__
    agents = list(env.possible_agents)
    for what, space_of in (("action", env.action_space), ("observation", env.observation_space)):
        for agent in agents:
            space = space_of(agent)
            if not is_vector(space):
                raise UserError(f"{agent} of {name} has the {what} space {space}; agents need a Box of one axis.")
    sizes = {agent: env.observation_space(agent).shape[0] for agent in agents}
    named = sizes if observation_names is None else _named(name, sizes, observation_names)
    layout = Layout(
        named,
        action_low={agent: env.action_space(agent).low.tolist() for agent in agents},
        action_high={agent: env.action_space(agent).high.tolist() for agent in agents},
    )
    kind = type(name, (PaddedEnv,), {"__doc__": PaddedEnv.__doc__})  # messages and cards name the simulator
    return Padded(make_env, layout, kind)


def _named(name: str, sizes: dict[Any, int], given: Mapping[Any, Sequence[str]]) -> dict[Any, Sequence[str]]:
    """The names of every agent's entries, in the simulator's order of agents."""
    for agent, size in sizes.items():
        if agent not in given or len(given[agent]) != size:
            count = len(given[agent]) if agent in given else "no"
            raise UserError(f"observation_names has {count} names of {agent}, which observes {size} entries in {name}.")
    if foreign := [agent for agent in given if agent not in sizes]:
        raise UserError(f"observation_names has names of {foreign[0]}, who is not in {name}; leave them out.")
    return {agent: given[agent] for agent in sizes}
