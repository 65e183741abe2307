"""Windows of logs in the place of episodes, for a certificate: a run drives one agent, the others do what they did."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from ringfence.errors import UserError
from ringfence.evaluation.replay.judge import Body, Logs
from ringfence.evaluation.replay.stage import Stage
from ringfence.evaluation.rollout import FORESEEN
from ringfence.evaluation.trials import Part, Trials, shortfall
from ringfence.faults import Faults
from ringfence.guards.policy import Guarded
from ringfence.guards.wrap import Nothing
from ringfence.loading.resolve import Resolved
from ringfence.logs.store import EpisodeStore
from ringfence.training.runs import Run
from ringfence.utils.progress import Progress
from ringfence.world import World

EVERY = 10**9  # windows: all that there are


@dataclass(frozen=True, eq=False)
class Windowed:
    """Two parts of the windows: the margin is calibrated on the first half of the logs, what it promises is counted on
    the second."""

    calibration: Stage
    test: Stage
    content: str  # digest of the logs
    quiet: bool = True

    @classmethod
    def of(
        cls,
        store: EpisodeStore,
        run: Run,
        world: World,
        how: Body,
        faults: Faults,
        calibration: int,
        episodes: int,
        least: int,
        quiet: bool,
    ) -> Windowed:
        """At most so many windows of each part, drawn evenly; fewer than `least` to calibrate on are refused."""
        logs = Logs.of(store, run)
        stage, _, _ = logs.stage(world, how, EVERY, run.config["seed"], faults)
        w = stage.windows
        moment = w.episode * (1 + w.start.max()) + w.start
        first = moment < np.median(moment)  # everybody who is driven in the same moments is in the same half
        to_calibrate, to_test = _evenly(first, calibration), _evenly(~first, episodes)
        if len(to_calibrate) < least:
            raise UserError(
                f"The first half of these logs has {len(to_calibrate)} windows, and a margin is calibrated on {least} "
                "or more; give longer logs, shorter windows (steps=), or a smaller quantile=."
            )
        return cls(
            dataclasses.replace(stage, windows=w.only(to_calibrate)),
            dataclasses.replace(stage, windows=w.only(to_test)),
            logs.store.card.content or logs.store.content,
            quiet,
        )

    def play(self, resolved: Resolved, part: Part, batch: int) -> Trials:
        """The windows of a part under the run's guard; another `batch` draws other noise."""
        assert resolved.guard is not None, "refused before"
        guard = resolved.guard
        stage: Stage = getattr(self, part)
        stage = dataclasses.replace(stage, seed=stage.seed + batch)
        label = f"{part}, {stage.windows.count} windows, margin {guard.options.margin:.3g}"
        with Progress(label, stage.windows.steps, 0, self.quiet) as bar:
            driven = stage.play(resolved.proposal, Guarded(Nothing(), guard), bar=bar)
        lacking = shortfall(driven.info[FORESEEN], stage.scores(guard, driven), guard.options.delay)
        return Trials(driven.contact, lacking, float(driven.info["infeasible"].mean()))

    @property
    def about(self) -> dict[str, Any]:
        """What a certificate says of how it was made."""
        stage = self.test
        replayed = {
            "logs": self.content,
            "windows": [self.calibration.windows.count, stage.windows.count],
            "seconds": stage.windows.steps * stage.windows.dt,
            "kinematics": stage.kinematics.name,
            "radius": stage.radius,
        }
        return {"replayed": replayed}


def _evenly(chosen: np.ndarray, most: int) -> np.ndarray:
    """Where at most so many of the chosen (W,) are."""
    found = np.flatnonzero(chosen)
    return found if len(found) <= most else found[np.linspace(0, len(found) - 1, most).astype(int)]
