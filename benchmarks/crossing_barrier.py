"""What a barrier is: danger now and danger to come around an agent of Crossing, at rest and at full speed.

python benchmarks/crossing_barrier.py        # fits the World if need be; writes docs/images/crossing-barrier.png
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.envs.crossing import PUSH, RADIUS, SIGHT
from ringfence.training import worlds

OUT = Path(__file__).resolve().parent.parent / "docs" / "images" / "crossing-barrier.png"
SPEEDS = (0.0, 0.5, 1.0)
REACH, FINE = 1.2, 121


def main() -> None:
    world = worlds.fit(make(registry.get("crossing-hasty"))[0], quiet=False)
    names, line = list(world.map.names), np.linspace(-REACH, REACH, FINE)
    x, y = np.meshgrid(line, line)
    figure, rows = plt.subplots(2, len(SPEEDS), figsize=(9, 6.2), sharex=True, sharey=True, layout="constrained")
    words = ("ℓ: touching now", "V: will touch, whatever one does")
    for axes, score, what in zip(rows, (lambda s: world.barrier.of_steps(s, s), world.barrier.ahead), words):
        for axis, speed in zip(axes, SPEEDS):
            seen = np.zeros((x.size, 1, len(names)), np.float32)
            for name, value in {
                **{f"other{j}.dx": SIGHT for j in range(6)},
                "other0.dx": x.ravel(),
                "other0.dy": y.ravel(),
                "other0.dvx": -speed,
                "other0.seen": 1.0,
                "own.vx": speed,
                "goal.dx": 2.0,
            }.items():
                seen[:, 0, names.index(name)] = value
            h = np.asarray(score(jnp.asarray(seen))).reshape(x.shape)
            picture = axis.pcolormesh(x, y, h, cmap="RdBu", vmin=-15, vmax=15, rasterized=True)
            axis.contour(x, y, h, [0.0], colors="black", linewidths=1.5)
            axis.add_patch(plt.Circle((0, 0), 2 * RADIUS, fill=False, ls="--", ec="white"))
            axis.plot(2 * RADIUS + speed**2 / (2 * PUSH), 0, "k|", ms=14, mew=2)
            axis.set(title=f"{what}\nat {speed:g} m/s to the right" if speed == SPEEDS[0] else f"at {speed:g} m/s")
            axis.set_aspect("equal")
            ahead = line[(h[FINE // 2] < 0)]
            print(f"{what}, {speed:g} m/s: unsafe up to {ahead.max() if len(ahead) else 0:.2f} m ahead")
    figure.colorbar(picture, ax=rows, label="log-odds of safe", shrink=0.7)
    figure.supxlabel("the other, at rest, m ahead")
    OUT.parent.mkdir(exist_ok=True)
    figure.savefig(OUT, dpi=80)
    print(OUT)


if __name__ == "__main__":
    main()
