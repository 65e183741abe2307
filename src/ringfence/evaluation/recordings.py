"""What an evaluation keeps of its first episodes, `rollout-<variant>.npz` in the run's folder.

R episodes of L steps: states (R, L+1, S), costs and rewards (R, L); of planners also plans (R, L, P, H, N, D), the
features of P drawn plans of H steps, and chosen (R, L) or (R, L, N), which of them was followed.

Of a simulator of somebody's own there are no states, but places (R, L+1, N, 2), and K resting things (R, K, 2); and
agent_costs (R, L, N) where each agent has its own. Rewards and places are nan after an episode's end. Where agents
are there, names of entries tell (`Places`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.envs.base import Moment, Seen, Watch, nobody
from ringfence.envs.episode import Episode
from ringfence.errors import UserError
from ringfence.problem.entries import Names
from ringfence.utils.files import read_npz, whole, within

Recording = dict[str, np.ndarray]
EPISODES = 4  # that are kept
LONGEST = 2000  # steps that are kept of each


def write(folder: Path, variant: str, played: Recording, episodes: int) -> None:
    """Keep the first episodes, if any; what was recorded before, and its film, would show another evaluation."""
    for kind in ("npz", "gif"):
        (folder / f"rollout-{variant}.{kind}").unlink(missing_ok=True)
    if episodes:
        with whole(folder / f"rollout-{variant}.npz") as temporary, open(temporary, "wb") as file:
            first: dict[str, Any] = {name: array[:episodes] for name, array in played.items()}
            np.savez_compressed(file, **first)


def read(folder: Path, variant: str) -> Recording | None:
    """What was kept, or None if nothing was."""
    file = kept(folder, variant, "npz")
    if file is None:
        return None
    try:
        arrays = read_npz(within(folder, file))
        # Whoever shows a recording relies on its shapes.
        axes = {"costs": 2, "rewards": 2} | ({"places": 4, "resting": 3} if "places" in arrays else {"states": 3})
        axes |= {name: count for name, count in (("plans", 6), ("agent_costs", 3)) if name in arrays}
        for name, wanted in axes.items():
            if name not in arrays or arrays[name].ndim != wanted:
                raise ValueError(f"it holds no '{name}' of {wanted} axes")
        episodes, steps = arrays["costs"].shape
        if not episodes or not steps:
            raise ValueError("it holds no episode")
        wanted_sizes = {name: (episodes, steps) for name in axes}
        wanted_sizes |= {"states": (episodes, steps + 1), "places": (episodes, steps + 1), "resting": (episodes,)}
        if "chosen" in arrays:
            wanted_sizes["chosen"] = (episodes, steps)
        for name, sizes in wanted_sizes.items():
            if name in arrays and arrays[name].shape[: len(sizes)] != sizes:
                raise ValueError(f"'{name}' begins with {arrays[name].shape[: len(sizes)]}, not with {sizes}")
        if "places" in arrays:
            # Refuse places that are not of agents on a plane.
            places = arrays["places"]
            if not places.shape[2] or places.shape[3] != 2 or arrays["resting"].shape[2] != 2:
                raise ValueError("its places are not pairs of numbers")
            if "agent_costs" in arrays and arrays["agent_costs"].shape[2] != places.shape[2]:
                raise ValueError("it has costs of another number of agents than places")
            if not np.isfinite(places[:, 0]).all() or not np.isfinite(arrays["resting"]).all():
                raise ValueError("nobody knows where its episodes begin")
    except ValueError as error:
        raise UserError(f"'{file}' is damaged ({error}); evaluate the run again or delete the file.") from error
    return arrays


def kept(folder: Path, variant: str, kind: str) -> Path | None:
    """The recording (npz) or the film (gif) of a variant, if there is one."""
    file = folder / f"rollout-{variant}.{kind}"
    return file if file.exists() else None


class Places:
    """A `Watch` of the first of B episodes: where everybody is, seen from above."""

    def __init__(self, names: Names):
        self.names = names
        self.rows: list[np.ndarray] = []  # (R, N, 2) each, nan where nobody showed it
        self.resting = np.zeros((0, 0, 2))  # (R, K, 2) goals, landmarks: what does not move by itself

    def __call__(self, now: Moment) -> None:
        """Where a step led, if that was shown."""
        if not self.rows:
            before = self._of(now.before)
            self.rows.append(before)
            seen = now.before.observations[: len(before)]
            found = [before + seen[..., pair[:2]] for pair in self.names.resting]
            self.resting = np.concatenate([np.zeros((len(before), 0, 2)), *found], 1)
        if len(self.rows) <= LONGEST:
            place = self._of(now.after)
            self.rows.append(np.where(now.outcome.shown[: len(place), None, None], place, np.nan))

    def _of(self, seen: Seen) -> np.ndarray:
        """(R, N, 2)"""
        place = self.names.place(seen.observations[:EPISODES], None if seen.state is None else seen.state[:EPISODES])
        assert place is not None, "asked before"
        return np.asarray(place[..., :2], np.float64)


def watching(names: Names, count: int) -> tuple[list[Places], Callable[[], Watch]]:
    """Who watches the first tables of `count` episodes each, until enough are kept; nobody watches the others."""
    watches: list[Places] = []

    def watch() -> Watch:
        if len(watches) >= math.ceil(EPISODES / count) or names.place_is_unknown:
            return nobody
        watches.append(Places(names))
        return watches[-1]

    return watches, watch


def recording(watches: Sequence[Places], episodes: Sequence[Episode]) -> Recording:
    """What is kept of the first of these episodes; nothing where nobody watched."""
    seen = [(np.stack(w.rows, 1)[r], w.resting[r]) for w in watches for r in range(len(w.rows[0]))]
    kept = [(rows, resting, e) for (rows, resting), e in zip(seen, episodes) if e.over and not e.skipped][:EPISODES]
    if not kept:
        return {}
    steps = min(max(len(e.rewards) for *_, e in kept), LONGEST)
    arrays = {
        "places": np.stack([filled(rows, steps + 1, np.nan) for rows, *_ in kept]),
        "resting": np.stack([resting for _, resting, _ in kept]),
        "rewards": np.stack([filled(e.team_rewards, steps, np.nan) for *_, e in kept]),
        "costs": np.stack([filled(e.team_costs, steps, 0.0) for *_, e in kept]),
    }
    if all(np.ndim(cost) for *_, e in kept for cost in e.costs):
        arrays["agent_costs"] = np.stack([filled(np.stack(e.costs), steps, 0.0) for *_, e in kept])
    return arrays


def filled(rows: np.ndarray, length: int, nothing: float) -> np.ndarray:
    """So many rows: the first of these, or as many more of nothing."""
    rows = rows[:length]
    return np.concatenate([rows, np.full((length - len(rows), *rows.shape[1:]), nothing)])
