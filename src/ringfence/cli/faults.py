"""Faults of a closed loop, as flags that several commands share."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated

import tyro

from ringfence.faults import Chance, Faults


@dataclass(frozen=True)
class FaultFlags(Faults):
    """What goes wrong; docs/certificates.md says what each does."""

    asynchrony: Annotated[Chance, tyro.conf.arg(name="async")] = 0.0
    """share of steps that an agent lets pass, each in its own rhythm."""

    def __post_init__(self):
        """Refuse nothing yet: a refusal in the parser would be no sentence."""

    def faults(self) -> Faults:
        """The same as a value; refused before any run is played."""
        return Faults.of(dataclasses.asdict(self))


NO_FAULTS = FaultFlags()
Wrong = Annotated[tyro.conf.OmitArgPrefixes[FaultFlags], tyro.conf.arg(name="faults")]
