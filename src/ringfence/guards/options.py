"""Every choice of a guard, and the named sets of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from msgspec import Meta

from ringfence.errors import UserError
from ringfence.proposals.guidance import DANGER
from ringfence.utils.config import NonNegative, check_bounds
from ringfence.world.card import JUDGED

Samples = Annotated[int, Meta(ge=1, le=10_000)]
Rounds = Annotated[int, Meta(ge=0, le=10**6)]
Fall = Annotated[float, Meta(gt=0, le=1, description="lie in (0, 1]: at 0 a barrier could never fall")]
Late = Annotated[int, Meta(ge=0, le=100)]
Held = Annotated[int, Meta(ge=1, le=100)]
Horizon = Annotated[float, Meta(ge=0, le=1e5)]
Few = Annotated[int, Meta(ge=0, le=100)]
CostRate = Annotated[float, Meta(gt=0, lt=1, description="be a share of steps between 0 and 1")]
Distance = Annotated[float, Meta(gt=0, le=2, description="lie in (0, 2]: actions lie in [-1, 1]")]


@dataclass(frozen=True)
class GuardOptions:
    """Every choice of a guard. Margins are in the unit of the danger's source (barrier.py)."""

    num_samples: Samples = 1  # proposals that are asked for
    select: bool = False  # among them; else the first is followed
    optimizer_steps: Rounds = 0  # Adam steps that climb the value; 0: none
    num_restarts: Samples = 1  # that are refined in all: the proposals, the last plan moved on, and noisy copies
    noise: NonNegative = 0.5  # deviation of noisy copies
    trust_radius: Distance = 2.0  # how far refining may take an action from its proposal; 2: anywhere
    safety_weight: NonNegative = DANGER  # weight of danger in what is climbed, in deviations of value per margin
    correction_steps: Rounds = 0  # rounds of correction; 0: none
    correction_restarts: Few = 0  # times that one which falls short is begun again from fixed plans
    max_correction: Distance = 2.0  # how far the shield may take an action from what it was; 2: anywhere
    horizon: Samples = JUDGED  # predicted rows that are judged
    horizon_seconds: Horizon = 0.0  # the same in seconds, where logs say how long a step is; 0: as many as `horizon`
    condition: Literal["margin", "retain"] = "margin"  # retain: h(ŝ_{k+1}) ≥ (1 − α) h(ŝ_k)
    alpha: Fall = 0.5  # share of what is left of the distance that one step may use up
    margin: float = 0.6  # distance that is kept
    # keep own entries in the range that the logs show, and others no nearer than they came; on for your own data
    within_logs: bool = False
    terminal_value: bool = False  # judge the last row by the value of danger, where it is learned
    adapt: NonNegative = 0.0  # step of the margin after a cost; 0: it stays
    rate: CostRate = 0.0125  # share of steps with a cost at which an adapting margin settles
    delay: Late = 0  # steps after which an action takes effect; the guard decides for that time
    max_age: Late = 0  # steps that observations may be old and still be moved to the present; 0: they are taken as new
    hold: Held = 1  # steps for which an action is held: agents that act every so many steps
    # m/s² that others may accelerate by while nobody sees them: late and old observations have them nearer by so much
    others_acceleration: NonNegative = 0.0
    proof: NonNegative = 0.0  # what every entry may be off by, while plans are still proved; 0: nothing is proved
    proof_rows: Samples = 10  # rows of the way out that is proved
    proof_residual: NonNegative = 0.0  # by which a predicted row of the own velocity may be off, in its own unit

    def __post_init__(self):
        check_bounds(self)
        if self.num_samples > 1 and not self.select and not self.optimizer_steps:
            raise UserError(
                f"num_samples={self.num_samples} are drawn, but none is selected; set select=true, or num_samples=1."
            )
        if self.num_restarts > 1 and not self.optimizer_steps:
            raise UserError(
                f"num_restarts={self.num_restarts} is read by nothing without optimizer_steps; "
                "set optimizer_steps=30, or num_restarts=1."
            )

    @property
    def judges(self) -> bool:
        """Whether it does anything at all."""
        return self.select or self.optimizer_steps > 0 or self.correction_steps > 0


def in_steps(options: GuardOptions, dt: float | None) -> GuardOptions:
    """The options with a horizon that was given in seconds in steps of so many."""
    seconds = options.horizon_seconds
    if not seconds:
        return options
    if dt is None:
        raise UserError(
            f"horizon_seconds={seconds:g} needs a World of logs whose card says how long a step is (dt), and this one "
            "does not; fit it again to such logs, or give horizon in steps."
        )
    return replace(options, horizon=max(1, round(seconds / dt)))


_SHIELD = {"correction_steps": 10, "correction_restarts": 1}

# Named sets of choices; "none" follows the proposal.
GUARDS: dict[str, dict[str, Any]] = {
    "none": {},
    "select": {"num_samples": 8, "select": True},
    "shield": _SHIELD,
    "adapt": _SHIELD | {"adapt": 0.1},
    "refine": {"optimizer_steps": 20, "num_restarts": 8, "select": True, "horizon": 7},
    "full": _SHIELD
    | {"num_samples": 4, "optimizer_steps": 20, "num_restarts": 8, "select": True, "horizon": 7, "adapt": 0.1},
}
