"""Every choice of a guard, and the named sets of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from ringfence.errors import UserError

CONDITIONS = ("margin", "retain")


@dataclass(frozen=True)
class GuardOptions:
    """Every choice of a guard. Margins are in the unit of the danger's source (danger.py)."""

    plans: int = 1  # proposals that are asked for
    select: bool = False  # among them; else the first is followed
    refine: int = 0  # Adam steps that climb the value; 0: none
    starts: int = 1  # that are refined in all: the proposals, the last plan moved on, and noisy copies
    noise: float = 0.5  # deviation of noisy copies
    reach: float = 2.0  # how far refining may take an action from its proposal; 2: anywhere
    care: float = 10.0  # weight of danger in what is climbed, in deviations of value per margin
    shield: int = 0  # rounds of correction; 0: none
    bound: float = 2.0  # how far the shield may take an action from what it was; 2: anywhere
    rows: int = 3  # predicted rows that are judged
    condition: Literal["margin", "retain"] = "margin"  # retain: h(ŝ_{k+1}) ≥ (1 − α) h(ŝ_k)
    alpha: float = 0.5  # share of what is left of the distance that one step may use up
    margin: float = 0.6  # distance that is kept
    future: bool = False  # judge the last row by the value of danger, where it is learned
    adapt: float = 0.0  # step of the margin after a cost; 0: it stays
    rate: float = 0.0125  # share of steps with a cost at which an adapting margin settles

    def __post_init__(self):
        for name, least in (("plans", 1), ("starts", 1), ("rows", 1), ("refine", 0), ("shield", 0)):
            value = getattr(self, name)
            if value < least:
                raise UserError(f"{name}={value} must be at least {least}.")
        for name in ("noise", "care", "adapt"):
            value = getattr(self, name)
            if value < 0:
                raise UserError(f"{name}={value} must not be negative.")
        for name in ("reach", "bound"):
            value = getattr(self, name)
            if not 0 < value <= 2:
                raise UserError(f"{name}={value} must lie in (0, 2]: actions lie in [-1, 1].")
        if not 0 < self.rate < 1:
            raise UserError(f"rate={self.rate} must be a share of steps between 0 and 1.")
        if not 0 < self.alpha <= 1:
            raise UserError(f"alpha={self.alpha} must lie in (0, 1]: at 0 a barrier could never fall.")
        if self.condition not in CONDITIONS:
            raise UserError(f"condition='{self.condition}' is unknown; choose margin or retain.")
        if self.plans > 1 and not self.select and not self.refine:
            raise UserError(f"plans={self.plans} are drawn, but none is selected; set select=true, or plans=1.")
        if self.starts > 1 and not self.refine:
            raise UserError(f"starts={self.starts} is read by nothing without refine; set refine=30, or starts=1.")

    @property
    def judges(self) -> bool:
        """Whether it does anything at all."""
        return self.select or self.refine > 0 or self.shield > 0


_SHIELD = {"shield": 10}

# Named sets of choices; "none" follows the proposal.
GUARDS: dict[str, dict[str, Any]] = {
    "none": {},
    "select": {"plans": 8, "select": True},
    "shield": _SHIELD,
    "adapt": _SHIELD | {"adapt": 0.1},
    "refine": {"refine": 20, "starts": 8, "select": True, "rows": 7},
    "full": _SHIELD | {"plans": 4, "refine": 20, "starts": 8, "select": True, "rows": 7, "adapt": 0.1},
}
