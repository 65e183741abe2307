"""What an evaluation keeps of its first episodes, `rollout-<variant>.npz` in the run's folder.

R episodes of L steps: states (R, L+1, S), costs and rewards (R, L); of planners also plans (R, L, P, H, N, D), the
features of P drawn plans of H steps, and chosen (R, L) or (R, L, N), which of them was followed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ringfence.errors import UserError
from ringfence.utils import stored
from ringfence.utils.files import read_npz, whole, within

Recording = dict[str, np.ndarray]


def write(folder: Path, variant: str, played: Recording, episodes: int) -> None:
    """Keep the first episodes, if any; what was recorded before, and its film, would show another evaluation."""
    for kind in ("npz", "gif"):
        while file := kept(folder, variant, kind):
            file.unlink()
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
    """The recording (npz) or the film (gif) of a variant, which an older version wrote under the name of then."""
    file = folder / f"rollout-{variant}.{kind}"
    if file.exists():
        return file
    files = sorted(folder.glob(f"rollout-*.{kind}"))
    return next((f for f in files if stored.variant(f.stem.removeprefix("rollout-")) == variant), None)


def _check(arrays: Recording) -> None:
    """Whoever shows a recording relies on its shapes."""
    axes = {"states": 3, "costs": 2, "rewards": 2}
    if "plans" in arrays:
        axes["plans"] = 6
    for name, wanted in axes.items():
        if name not in arrays or arrays[name].ndim != wanted:
            raise ValueError(f"it holds no '{name}' of {wanted} axes")
    episodes, steps = arrays["costs"].shape
    if not episodes or not steps:
        raise ValueError("it holds no episode")
    wanted_sizes = {name: (episodes, steps) for name in axes} | {"states": (episodes, steps + 1)}
    if "chosen" in arrays:
        wanted_sizes["chosen"] = (episodes, steps)
    for name, sizes in wanted_sizes.items():
        if arrays[name].shape[:2] != sizes:
            raise ValueError(f"'{name}' begins with {arrays[name].shape[:2]}, not with {sizes}")
