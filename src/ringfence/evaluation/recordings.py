"""What an evaluation keeps of its first episodes, `rollout-<variant>.npz` in the run's folder.

R episodes of L steps: states (R, L+1, S), costs and rewards (R, L); of planners also plans (R, L, P, H, N, D), the
features of P drawn plans of H steps, and chosen (R, L) or (R, L, N), which of them was followed.

Of a simulator of somebody's own there are no states, but places (R, L+1, N, 2), and K resting things (R, K, 2); and
agent_costs (R, L, N) where each agent has its own. Rewards and places are nan after an episode's end.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ringfence.errors import UserError
from ringfence.utils.files import read_npz, whole, within

Recording = dict[str, np.ndarray]


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
        _check(arrays)
    except ValueError as error:
        raise UserError(f"'{file}' is damaged ({error}); evaluate the run again or delete the file.") from error
    return arrays


def kept(folder: Path, variant: str, kind: str) -> Path | None:
    """The recording (npz) or the film (gif) of a variant, if there is one."""
    file = folder / f"rollout-{variant}.{kind}"
    return file if file.exists() else None


def _check(arrays: Recording) -> None:
    """Whoever shows a recording relies on its shapes."""
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
        _check_places(arrays)


def _check_places(arrays: Recording) -> None:
    """Refuse places that are not of agents on a plane."""
    places = arrays["places"]
    if not places.shape[2] or places.shape[3] != 2 or arrays["resting"].shape[2] != 2:
        raise ValueError("its places are not pairs of numbers")
    if "agent_costs" in arrays and arrays["agent_costs"].shape[2] != places.shape[2]:
        raise ValueError("it has costs of another number of agents than places")
    if not np.isfinite(places[:, 0]).all() or not np.isfinite(arrays["resting"]).all():
        raise ValueError("nobody knows where its episodes begin")
