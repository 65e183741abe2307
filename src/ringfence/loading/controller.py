"""A trained policy at run time: NumPy in, NumPy out."""

from __future__ import annotations

import jax
import numpy as np

from ringfence.errors import LAST_SEED, UserError, whole_number
from ringfence.guards.policy import Paid, acted, costs_of_one, no_safe_action
from ringfence.loading.resolve import load
from ringfence.proposals.base import act_with, with_cost
from ringfence.training.runs import Run
from ringfence.utils.compilation import keep_programs
from ringfence.utils.given import given_as
from ringfence.utils.precision import in_float32


class Controller:
    """A trained policy at run time: one environment, NumPy in, NumPy out, compiled at its first action.

    controller = Controller("runs/…/seed-0", guard="shield", barrier="learned")
    controller.reset()                             # at the start of every episode
    action = controller.act(observations, state)   # (N, O), (S,) or None -> (N, A)

    `info` says of the last action what the policy knows of it, e.g. `ood`: the World knows nothing there. Not for
    several threads at once.
    """

    @in_float32
    def __init__(self, run: Run | str, planner: str = "default", seed: int = 0, **options):
        keep_programs()
        self.job, self.policy = load(run, planner=planner, **options)
        self._key = jax.random.key(whole_number("seed", seed, 0, LAST_SEED))
        self._act = jax.jit(act_with)
        self.info: dict[str, np.ndarray] = {}
        self.last_action: np.ndarray | None = None
        self.reset()

    @in_float32
    def reset(self) -> None:
        """Begin an episode: plans in progress and histories are forgotten."""
        self._memory = self.policy.start(1)

    @in_float32
    def act(self, observations: np.ndarray, state: np.ndarray | None = None, cost: Paid | None = None) -> np.ndarray:
        """(N, A) joint action within the task's bounds; `cost` is what the last step cost, in all or by each
        constraint's name, which an adapting guard follows. Arrays of another shape than the run's are refused, and so
        is what is not finite: indices beyond an array's end would be clipped in silence, and noise would follow
        NaN.

        A refusal is a `NoSafeAction`, whose `last_action` is that of the step before."""
        with no_safe_action(self.last_action):
            seen, whole = self._seen(observations, state)
            memory = self._memory
            if cost is not None:
                memory = with_cost(self.policy, memory, costs_of_one(cost, self.job.team))
            key, now = jax.random.split(self._key)
            whole = None if whole is None else whole[None]
            memory, step = self._act(self.policy, memory, seen[None], whole, now)
            action, info = acted(step, "The run's policy")
        self._memory, self._key, self.info, self.last_action = memory, key, info, action.copy()
        return action

    def _seen(self, observations: np.ndarray, state: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        """Copies of what one environment shows, of the widths of the run's data."""
        width, state_width = self.job.widths
        seen = given_as("observations", observations, (self.job.team, width))
        if state is not None and state_width == 0:
            raise UserError(
                "This run's data has no global state, but act() was given one; pass the observations alone."
            )
        view = self.job.feature_map
        if state is None and view.source == "state":
            raise UserError(
                f"act() got no state, but this run's view '{view.view}' reads it; pass the global state"
                + (f" ({state_width} entries)." if state_width else ".")
            )
        whole = None if state is None else given_as("state", state, (state_width,))
        if None in self.job.widths:
            self._reaches(seen, whole)
        return seen, whole

    def _reaches(self, seen: np.ndarray, state: np.ndarray | None) -> None:
        """Refuse arrays too short for the entries that the run reads; older runs of own data say no widths."""
        view, last = self.job.feature_map, int(self.job.feature_map.plus.max())
        name, there = "observations", seen.shape[-1]
        if view.source == "state":
            name, there = "state", last + 1 if state is None else len(state)
        elif state is not None:
            name, there = "observations and state", there + len(state)
        if last >= there:
            raise UserError(f"{name} has {there} entries, this run reads entry {last}; pass what its data holds.")
