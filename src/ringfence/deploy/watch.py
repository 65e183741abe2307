"""What a controller does when the promise of its certificate turns out not to be kept."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ringfence.errors import UserError, known
from ringfence.evaluation.certificate import Certificate
from ringfence.evaluation.monitor import Monitor
from ringfence.guards.wrap import guarded_of, with_guarded
from ringfence.types import Spec
from ringfence.utils.functions import of_both
from ringfence.utils.given import given_as

ON_ALARM = ("report", "stop", "widen", "hand_over")
WIDER = 1.5  # times the margin

Fallback = Callable[[np.ndarray, np.ndarray | None], Any]  # observations (N, O), state (S,) or None -> actions (N, A)


class Watch:
    """A monitor of the certificate's bound, and what is done on its alarm."""

    def __init__(self, certificate: Certificate | None, on_alarm: str, fallback: Fallback | None):
        known("on_alarm", on_alarm, ON_ALARM)
        if certificate is None and on_alarm != "report":
            raise UserError(f"on_alarm='{on_alarm}' is read by nothing without a certificate; give certificate=.")
        if (on_alarm == "hand_over") != (fallback is not None):
            raise UserError("on_alarm='hand_over' and fallback=, who then acts, go together; give both or none.")
        self.on_alarm = on_alarm
        self.fallback = None if fallback is None else of_both(fallback)
        self._monitor = None
        if certificate is not None and certificate.bound < 1:
            self._monitor = Monitor(certificate.bound)

    @property
    def alarm(self) -> bool:
        """Whether the promise is known not to be kept."""
        return self._monitor is not None and self._monitor.alarm

    def finished(self, violated: bool) -> bool:
        """An episode has ended; whether the alarm is raised."""
        if self._monitor is None:
            raise UserError(
                "Nothing was promised that an episode could break; give a certificate with a bound below 1."
            )
        return self._monitor.observe(violated)

    def check(self) -> None:
        """Refuse to act, where that is what an alarm asks for."""
        if self.alarm and self.on_alarm == "stop":
            assert self._monitor is not None, "it raised the alarm"
            raise UserError(
                f"More episodes violate than the certificate allows ({self._monitor.rate:.3g} of them, after "
                f"{self._monitor.episodes}); find out what has changed, and certify again."
            )

    @property
    def hands_over(self) -> bool:
        """Whether the fallback acts now."""
        return self.fallback is not None and self.alarm

    def taken_over(self, observations: np.ndarray, state: np.ndarray | None, spec: Spec, agents: int) -> np.ndarray:
        """(N, A) the fallback's actions, within bounds; they are not guarded."""
        assert self.fallback is not None, "it acts now"
        wanted = self.fallback(observations.copy(), None if state is None else state.copy())
        shape = (agents, spec.action_dim)
        action = given_as("the fallback's result", wanted, shape, "the task", "return one action for each agent")
        low, high = (np.asarray(bound, np.float32) for bound in (spec.action_low, spec.action_high))
        return np.clip(action, low, high)


def widened(policy: Any) -> Any:
    """The policy, whose guard keeps a wider margin."""
    guarded = guarded_of(policy)
    assert guarded is not None, "a certificate is of a guard"
    options = dataclasses.replace(guarded.guard.options, margin=WIDER * guarded.guard.options.margin)
    guard = dataclasses.replace(guarded.guard, options=options)
    return with_guarded(policy, dataclasses.replace(guarded, guard=guard))
