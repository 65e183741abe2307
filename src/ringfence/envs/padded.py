"""Simulators whose agents observe and act in different sizes, as ones in which all have the same entries."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ringfence.envs.episode import is_vector, made
from ringfence.errors import UserError, needs
from ringfence.problem.layout import Layout

if TYPE_CHECKING:
    from gymnasium.spaces import Box


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
