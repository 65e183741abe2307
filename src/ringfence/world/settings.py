"""What a World is fitted with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ringfence.problem import features
from ringfence.world import barrier as cbf


@dataclass(frozen=True)
class Settings:
    """Every choice of a World."""

    view: features.View = "pruned"  # what s̃_i is
    sight: Literal["all", "own"] = "all"  # own: decentralized execution, each agent in its own view
    labels: Literal["costs", "formula"] = "costs"  # where labels of danger come from
    discount: float = 0.9  # of values
    members: int = 3  # of the ensemble of forward models
    dynamics_updates: int = 20_000
    dynamics_width: int = 128  # units of each of 2 hidden layers
    value_updates: int = 8000  # of the critic, and again of rewards
    barrier: bool = True
    loss: cbf.Loss = "cross-entropy"  # of labels
    penalty: float = 1.0  # weight of the gradient's, where the loss has one
    foreseen: float = 0.5  # share of labelled steps that end where they were predicted to end
    distances: bool = True  # pairs read how far apart they are and how fast they close
    both_ends: bool | None = None  # danger is of a step, not of the state it leads to; None: of bodies
    barrier_width: int = 64  # units of each of 3 hidden layers
    barrier_updates: int = 6000  # of the labels
    future_updates: int = 4000  # of the value of danger
    future_discount: float = 0.97  # how far ahead danger is seen: 1 / (1 − it) steps
    expectile: float = 0.7  # of what the logs did, how near to the best
    missed: float = 0.001  # share of unsafe steps that may be predicted at the default margin or above
