"""Evaluation-time choices of how plans are drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from ringfence.proposals import diffusion
from ringfence.utils.config import AtLeastOne, Count, NonNegative, check_bounds


@dataclass(frozen=True)
class PlanOptions:
    """Evaluation-time choices of how plans are drawn."""

    sampling_steps: Count = 5  # of the sampler
    sampler: diffusion.Sampler = "ddim"
    cfg_scale: float = 1.2  # ω of classifier-free guidance; 1 switches it off
    target_return: float = 1.5  # return condition, as a normal score: 1.5 asks for the best 7 %; of the largest, if raw
    temperature: NonNegative = 1.0  # scale of the first noise
    spread: NonNegative = 1.0  # by which it is multiplied for the last of several plans that are drawn together
    # what guidance by a World weighs what is earned with, in deviations of the logs' returns, and danger, in calibrated
    # margins; 0: not at all. None: 1 and 10 of a method that follows a World (icbf), 0 of others and under guards that
    # decide what is earned; 10 where values are climbed.
    value_guidance: NonNegative | None = None
    barrier_guidance: NonNegative | None = None
    reconcile: bool = True  # make the agents of a joint plan agree on where everybody will be
    replan: AtLeastOne = 1  # steps that a plan is followed for
    execution: Literal["centralized", "decentralized"] = "centralized"  # decentralized: each agent plans for itself

    def __post_init__(self):
        check_bounds(self)

    def temperatures(self, count: int) -> np.ndarray:
        """(count,) of plans that are drawn together, to choose from or to refine: the first is as of one alone."""
        return (self.temperature * np.linspace(1.0, self.spread, count)).astype(np.float32)


@runtime_checkable
class TakesPlanOptions(Protocol):
    """A policy that draws plans or actions as these options say."""

    options: PlanOptions


# Plans around a learned mean are nearly one plan where the logs had one driver; wider apart, there is a choice.
WIDE = 3.0


def plan_defaults(config) -> dict:
    """Choices that follow from how a model was trained (its Config): who knew one agent alone plans alone, a flow needs
    few steps, of a raw return nine tenths of the largest are asked for at every step, as MADIFF does, and several plans
    around a learned mean are drawn ever wider apart."""
    chosen: dict = {"target_return": 0.9} if getattr(config, "condition", "none") == "raw" else {}
    chosen |= {"spread": WIDE} if getattr(config, "around", "nothing") == "mean" else {}
    if hasattr(config, "drivers") and not hasattr(config, "diffusion_steps"):
        return chosen | {"sampling_steps": 2}
    return chosen | ({"execution": "decentralized"} if getattr(config, "observe", "all") == "single" else {})


DEFAULT = "default"

# Named sets of evaluation-time choices, made on validation resets; docs/options.md.
PLANNERS: dict[str, dict] = {
    DEFAULT: {},
    # MADIFF at inference (Zhu et al. 2024), for runs whose condition is `raw`.
    "published": {"temperature": 0.5},
    # For robots. Samples begin with less noise, since every outlier of a thousand steps throws the robot off.
    "low_temperature": {"temperature": 0.3, "spread": 1.0},
}
