"""How logs are replayed, as flags that two commands share."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro


@dataclass(frozen=True)
class Replaying:
    """Windows of logs in which one agent is driven; docs/replay.md says how."""

    kinematics: Literal["double_integrator", "holonomic", "unicycle", "bicycle", "world"] | None = None
    """how the driven agent moves; by default a double integrator where that explains the logs, else the World's."""
    wheelbase: float = 2.7
    """m, of a bicycle."""
    radius: float | None = None
    """m between two agents below which they touch; by default the task's formula, else as costs tell it, else the
    World's causes."""
    steps: int | None = None
    """of a window; 8 s by default."""
    every_episode: bool = False
    """replay the episodes that the World learned from, too."""

    def arguments(self) -> dict[str, Any]:
        """The same as arguments of `replay` and `certify`."""
        return dataclasses.asdict(self)


AS_LOGGED = Replaying()
Replayed = Annotated[tyro.conf.OmitArgPrefixes[Replaying], tyro.conf.arg(name="replays")]
