"""The World as a value: parameters, the view that they read, and the card."""

from __future__ import annotations

import equinox as eqx

from ringfence.problem.constraints import CostColumn, Hazard, from_dict
from ringfence.problem.features import FeatureMap
from ringfence.problem.origins import FIELDS as ORIGINS
from ringfence.problem.origins import Origins
from ringfence.types import Array, Spec
from ringfence.world.barrier import Barrier, MinBarrier
from ringfence.world.card import Card
from ringfence.world.dynamics import Dynamics
from ringfence.world.values import Values


class World(eqx.Module):
    """A learned model of a team: what actions do, what states are worth, what is dangerous. Features are s̃_i in the
    view of `map`; actions are in [−1, 1]."""

    dynamics: Dynamics
    values: Values
    barrier: Barrier | MinBarrier | None  # None: the logs have no labels of danger
    ood_threshold: Array  # () ensemble disagreement above which a state is out of distribution: a conformal quantile
    map: FeatureMap = eqx.field(static=True)
    spec: Spec = eqx.field(static=True)
    alone: bool = eqx.field(static=True)  # of each agent's own view, for decentralized execution
    card: Card = eqx.field(static=True)

    @property
    def hazard(self) -> Hazard:
        """What the logs' card says is dangerous; costs alone where an older World does not say."""
        told = self.card.data.hazard
        return from_dict(told) if told else CostColumn()

    @property
    def limits(self) -> dict[str, float]:
        """Limit per episode of each constraint that the logs name; empty where they name none."""
        return self.card.data.constraints or {}

    @property
    def widths(self) -> tuple[int | None, int | None]:
        """Entries of an observation and of the global state in the logs; None where an older World does not say."""
        return self.card.data.observation_width, self.card.data.state_width

    @property
    def origins(self) -> Origins:
        """What was taken from entries of the logs, and is taken from what is given at run time."""
        data = self.card.data
        return Origins.of({name: getattr(data, name) for name in ORIGINS})

    @property
    def unsafe_steps(self) -> dict[str, float]:
        """Unsafe steps of an episode that each limit allows, which is no question of the costs' units."""
        costs = self.card.data.unsafe_costs or {}
        return {name: limit / costs.get(name, 1.0) for name, limit in self.limits.items()}
