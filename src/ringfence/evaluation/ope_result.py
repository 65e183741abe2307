"""What logs say of a policy, as typed values and as a person reads it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from ringfence.utils.text import percent


@dataclass(frozen=True)
class Mean:
    """A mean and its 95 % interval."""

    mean: float
    low: float
    high: float

    @classmethod
    def of_samples(cls, samples: np.ndarray) -> Mean:
        """By Student's t, of independent samples (M,)."""
        n = len(samples)
        half = float(student.ppf(0.975, n - 1) * samples.std(ddof=1) / np.sqrt(n)) if n > 1 else float("nan")
        return cls._around(samples, half)

    @classmethod
    def of_bootstrap(cls, estimates: np.ndarray) -> Mean:
        """By Student's t, of estimates (M,) on resampled data, whose deviation is that of one estimate."""
        return cls._around(estimates, float(student.ppf(0.975, len(estimates) - 1) * estimates.std(ddof=1)))

    @classmethod
    def _around(cls, values: np.ndarray, half: float) -> Mean:
        middle = float(values.mean())
        return cls(middle, middle - half, middle + half)

    @property
    def known(self) -> bool:
        return bool(np.isfinite(self.mean))

    def __str__(self) -> str:
        if not self.known:
            return "not known, since fitted Q evaluation diverged"
        return f"{self.mean:.4g} ({self.low:.4g} to {self.high:.4g})"


UNKNOWN = Mean(float("nan"), float("nan"), float("nan"))


@dataclass(frozen=True)
class LogsRead:
    episodes: int
    steps: int
    content: str  # digest of the store


@dataclass(frozen=True)
class Behaviour:
    """What a policy does in logged states. Rates of a guard are None without one."""

    intervention_rate: float | None  # of states in which its guard changes the action
    infeasible_rate: float | None  # in which the guard finds no action that is safe enough
    guard_ood_rate: float | None  # that are out of distribution for the guard's World
    ood_rate: float  # whose action leads out of the distribution of these logs
    action_rmse: float  # distance from the logged actions, in their standard deviations


@dataclass(frozen=True)
class Safety:
    """Where plans lead from logged states that are not unsafe yet, beside where the logs went on to.

    A violation is predicted where the smallest predicted margin is below 0; the calibrated margin is violated where it
    is below 1, and all but a share `miscoverage` of the entries into danger are below it.
    """

    predicted_violation_rate: float
    predicted_violation_rate_of_logs: float
    margin_violation_rate: float
    margin_violation_rate_of_logs: float
    miscoverage: float | None
    margin_violation_episodes: float  # share of the episodes asked about with such a state
    margin_violation_episodes_upper: float  # its bound with 95 % confidence
    margins: tuple[float, ...]  # quantiles of the smallest predicted margin, from 0 to 1
    margins_of_logs: tuple[float, ...]


@dataclass(frozen=True)
class Values:
    """Discounted sums from the logged starts, by fitted Q evaluation."""

    returns: Mean
    costs: Mean


@dataclass(frozen=True)
class ModelRollout:
    """What a policy earns and risks when it is played in the World of the logs, beside logged episodes that begin
    alike. Intervals are Student's over the ensemble: how far its members agree, not how far they are right."""

    episodes: int
    steps: int
    returns: Mean
    returns_of_logs: float
    unsafe_steps: Mean | None  # steps per episode that the World calls dangerous; None where it knows no danger
    unsafe_steps_of_logs: float | None
    violation_rate: float | None  # of episodes with such a step
    ood_rate: float  # of steps in which the members are further apart than in the logs


@dataclass(frozen=True)
class OPEResult:
    """What logs say of a policy. How far to believe each number: docs/ope.md."""

    task: str
    algorithm: str
    guard: str
    logs: LogsRead
    trained_on: bool  # whether the policy was trained on any of these episodes
    discount: float
    ahead: int  # predicted steps
    behaviour: Behaviour
    safety: Safety | None  # None where the World knows no danger
    rollout: ModelRollout | None  # None where it was not played
    values: Values
    values_of_logs: Values | None
    episodes_trained_on: int | None = None  # of these; None where a run of before does not tell

    def summary(self) -> list[str]:
        """Lines for a person."""
        lines = [self._headline()]
        for name in ("return", "cost"):
            line = f"{name}, discounted by {self.discount:g}: {getattr(self.values, name + 's')}"
            if self.values_of_logs is not None:
                line += f"; the logs {getattr(self.values_of_logs, name + 's')}"
            lines.append(line)
        if self.rollout is not None:
            played = self.rollout
            line = (
                f"played for {played.steps} steps in the World of these logs: return {played.returns.mean:.4g} "
                f"({played.returns.low:.4g} to {played.returns.high:.4g}; the logs {played.returns_of_logs:.4g})"
            )
            if (unsafe := played.unsafe_steps) is not None:
                line += f", {unsafe.mean:.3g} dangerous steps (the logs {played.unsafe_steps_of_logs:.3g})"
            lines.append(line + f"; it does not know {_percent(played.ood_rate)} of the way")
        if self.safety is not None:
            safety = self.safety
            lines.append(
                f"danger is predicted within {self.ahead} steps from {_percent(safety.predicted_violation_rate)} of "
                f"the safe states (the logs: {_percent(safety.predicted_violation_rate_of_logs)}); "
                f"{_percent(safety.margin_violation_rate)} do not keep the calibrated margin (the logs: "
                f"{_percent(safety.margin_violation_rate_of_logs)})"
            )
        done = self.behaviour
        if done.intervention_rate is not None:
            lines.append(
                f"the guard steps in in {_percent(done.intervention_rate)} of the states, and cannot do what it should "
                f"in {_percent(done.infeasible_rate)}"
            )
        lines.append(
            f"{_percent(done.ood_rate)} of its actions lead where these logs do not tell; they are "
            f"{done.action_rmse:.2g} deviations from the logged ones"
        )
        return lines

    def _headline(self) -> str:
        line = f"{self.algorithm} under guard={self.guard}, by {self.logs.episodes:,} logged episodes"
        if not self.trained_on:
            return line
        if self.episodes_trained_on in (None, self.logs.episodes):
            return line + " that it was trained on: the best case"
        return line + f", of which it was trained on {self.episodes_trained_on:,}: leave these out"


def _percent(share: float | None) -> str:
    return "–" if share is None else percent(share)
