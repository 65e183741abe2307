"""Faults of a closed loop, as flags that several commands share."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from ringfence.faults import Faults


@dataclass(frozen=True)
class FaultFlags:
    """What goes wrong; docs/stress.md says what each does."""

    delay: int = 0
    """steps after which an action takes effect."""
    jitter: int = 0
    """steps by which an action may be later than that, drawn for each."""
    drop: float = 0.0
    """probability that an agent's observation of a step is lost; what it got last is held."""
    noise: float = 0.0
    """standard deviation of what is observed, in the entries' own units."""
    bias: float = 0.0
    """standard deviation of what an entry is off by throughout an episode, in its own unit."""
    gain: float = 1.0
    """what becomes of an action, which is clipped to its bounds."""
    spread: float = 0.0
    """share by which agents differ in gain, e.g. in mass."""
    asynchrony: Annotated[float, tyro.conf.arg(name="async")] = 0.0
    """share of steps that an agent lets pass, each in its own rhythm."""
    stop: float = 0.0
    """probability that an agent stops acting, at each step, for the rest of an episode."""

    def faults(self) -> Faults:
        """The same as a value; refused before any run is played."""
        from ringfence.faults import Faults

        return Faults.of(dataclasses.asdict(self))


NO_FAULTS = FaultFlags()
Wrong = Annotated[tyro.conf.OmitArgPrefixes[FaultFlags], tyro.conf.arg(name="faults")]
