"""Is a promised rate still kept? A test that may be looked at after every episode.

Wealth starts at 1 and bets that violations come more often than was promised. While the promise holds it is a
supermartingale, so the chance that it ever reaches 1/δ is at most δ (Ville 1939), however often one looks. Bets of
several sizes are held side by side, since nobody knows how much worse things have become.
"""

from __future__ import annotations

import numpy as np

from ringfence.errors import UserError

BETS = 0.5 ** np.arange(1, 7)  # shares of the largest bet, at which one episode without violation would lose all


class Monitor:
    """Watches episodes against a promised rate of violations.

    monitor = Monitor(rate=0.03)               # the bound of a certificate
    alarm = monitor.observe(violated=False)    # after every episode
    """

    def __init__(self, rate: float, false_alarms: float = 0.01):
        for name, value in (("rate", rate), ("false_alarms", false_alarms)):
            if not 0 < value < 1:
                raise UserError(f"{name}={value} must lie between 0 and 1.")
        self.rate = rate
        self.false_alarms = false_alarms
        self.episodes = 0
        self.alarm = False  # once raised it stays
        self._log_wealth = np.zeros(len(BETS))

    @property
    def wealth(self) -> float:
        """Evidence against the promise; at most `false_alarms` of kept promises ever see it at 1 / `false_alarms`."""
        return float(np.exp(self._log_wealth).mean())

    def observe(self, violated: bool) -> bool:
        """Whether the alarm is raised, with this episode."""
        if not isinstance(violated, bool | np.bool_):
            raise UserError(f"violated={violated!r} must be true or false; say whether the episode violated.")
        self._log_wealth += np.log1p(BETS / self.rate * (bool(violated) - self.rate))
        self.episodes += 1
        self.alarm = self.alarm or self.wealth >= 1 / self.false_alarms
        return self.alarm
