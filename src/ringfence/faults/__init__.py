"""What goes wrong between a policy and what it acts on: actions that come late, observations that are lost or noisy.

Here as one value; `policy.py` puts a policy behind it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from ringfence.errors import UserError
from ringfence.utils.config import NonNegative, Positive, build_config, check_bounds, fields_of

Delay = Annotated[int, Meta(ge=0, le=1000)]
Chance = Annotated[float, Meta(ge=0, lt=1, description="lie in [0, 1): at 1 nothing would ever arrive")]
Share = Annotated[float, Meta(ge=0, lt=1, description="lie in [0, 1): at 1 an action could have no effect")]

NO_FAULTS = "none"  # the name of none


@dataclass(frozen=True)
class Faults:
    """What goes wrong, at every step and for every agent by itself. Without any, nothing does."""

    delay: Delay = 0  # steps after which an action takes effect; none has been sent before an episode begins
    drop: Chance = 0.0  # probability that what an agent observes is lost; what it got last is held
    noise: NonNegative = 0.0  # standard deviation of what is observed, in the entries' own units
    gain: Positive = 1.0  # what becomes of an action, which is clipped to its bounds
    asynchrony: Chance = 0.0  # share of steps that an agent lets pass, each in its own rhythm: 0.5 every second one
    jitter: Delay = 0  # steps by which an action may be later still, drawn for each; an overtaken one is not done
    bias: NonNegative = 0.0  # standard deviation of what an entry is off by throughout an episode, in its own units
    spread: Share = 0.0  # by how much of `gain` agents differ, e.g. in mass: drawn in gain (1 ± spread) for an episode
    stop: Chance = 0.0  # probability that an agent stops acting, at each step, for the rest of an episode

    def __post_init__(self):
        check_bounds(self)

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Faults:
        """From names and values; unknown names and values of another type are refused."""
        return build_config(cls, given, "the faults")

    @classmethod
    def parse(cls, name: str) -> Faults:
        """The faults of that `name`."""
        if name == NO_FAULTS:
            return cls()
        given: dict[str, Any] = {}
        for part in name.split("+"):
            found = re.fullmatch(r"([a-z]+)(\d.*)", part)
            if found is None or found[1] not in fields_of(cls):
                raise UserError(f"'{part}' in '{name}' is no fault; write one as delay2, several as delay2+drop0.3.")
            given[found[1]] = found[2]
        return cls.of(given)

    @property
    def given(self) -> dict[str, Any]:
        """Those that there are."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if getattr(self, f.name) != f.default}

    @property
    def name(self) -> str:
        """All of them in one word, e.g. `delay2+drop0.3`; `none` without any."""
        return "+".join(f"{name}{value}" for name, value in self.given.items()) or NO_FAULTS
