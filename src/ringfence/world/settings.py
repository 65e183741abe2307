"""What a World is fitted with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from ringfence.problem import features
from ringfence.utils.config import Count, NonNegative, Share, Width

Loss = Literal["cross-entropy", "hinges", "gradient-penalty"]


@dataclass(frozen=True)
class Settings:
    """Every choice of a World."""

    view: features.View = "pruned"  # what s̃_i is
    execution: Literal["centralized", "decentralized"] = "centralized"  # decentralized: each agent in its own view
    labels: Literal["costs", "formula"] = "costs"  # where labels of danger come from
    discount: Share = 0.9  # of values
    num_ensemble: Annotated[int, Meta(ge=1, le=20)] = 3  # of the ensemble of forward models
    dynamics_updates: Count = 20_000
    dynamics_width: Width = 128  # units of each of 2 hidden layers
    value_updates: Count = 8000  # of the critic, and again of rewards
    barrier: bool = True
    causes: bool = True  # find few entries that tell danger; where there are none, networks on all of them
    loss: Loss = "cross-entropy"  # of labels
    penalty: NonNegative = 1.0  # weight of the gradient's, where the loss has one
    predicted_share: Share = 0.5  # share of labelled steps that end where they were predicted to end
    distances: bool = True  # pairs read how far apart they are and how fast they close
    use_transition: bool | None = None  # danger is of a step, not of the state it leads to; None: of bodies
    barrier_width: Width = 64  # units of each of 3 hidden layers
    barrier_updates: Count = 6000  # of the labels
    future_updates: Count = 4000  # of the value of danger
    future_discount: Annotated[float, Meta(ge=0, le=0.999)] = 0.97  # how far ahead danger is seen: 1 / (1 − it) steps
    expectile: Annotated[float, Meta(ge=0.5, le=1)] = 0.7  # of what the logs did, how near to the best
    # share of unsafe steps that may be predicted at the default margin or above
    miscoverage: Annotated[float, Meta(ge=0, le=0.5)] = 0.001

    @property
    def alone(self) -> bool:
        """Whether every agent has a World of its own, of what it sees itself."""
        return self.execution == "decentralized"
