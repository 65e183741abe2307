"""A picture of a margin that adapts: one robot's speed, its limit and what is kept of it, beside a constant margin.

ringfence train madiff halfcheetah_2x3-poor-quantile --out runs/margin
python benchmarks/margin.py runs/margin/*/*/*          # writes docs/images/margin.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from ringfence import evaluate

OUT = Path(__file__).resolve().parent.parent / "docs" / "images" / "margin.png"
TITLES = {"shielded": "shielded: a constant margin", "adaptive": "adaptive: a margin that moves"}


def margins(policy, states) -> np.ndarray:
    """(T + 1,) what the planner kept in hand at the states (T + 1, N, D) of an episode."""

    def move(margin, state):
        margin = policy.adapted(margin, state[None])
        return margin, margin[0]

    first = policy.start(1)["margin"]
    if not policy.options.adapt:
        return np.full(len(states), first[0])
    return np.append(first, jax.lax.scan(move, first, states[1:])[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    figure, panels = plt.subplots(2, 1, figsize=(9, 4.6), sharex=True, sharey=True, layout="constrained")
    for panel, (planner, title) in zip(panels, TITLES.items()):
        job, policy = evaluate.load(a.run, planner=planner)
        played = evaluate.rollout(policy, job.task.env, 1, "validation")
        present = policy.feature_map(jnp.zeros((*played["states"].shape[:2], job.spec.n_agents, 0)), played["states"])
        limit = job.task.hazard.limit
        speed = limit - np.asarray(policy.hazard.clearance(present)).min(-1)[0]
        margin = margins(policy, present[0])
        over = speed > limit
        steps = np.arange(len(speed))
        panel.plot(steps, speed, color="#0077BB", lw=0.6, label="speed")
        panel.plot(steps[over], speed[over], ".", color="#CC3311", ms=4, label="above the limit")
        panel.axhline(limit, color="black", lw=1, label="limit")
        panel.plot(steps, limit - margin, color="#EE7733", lw=1.5, label="limit less the margin")
        panel.set_title(f"{title}: {played['costs'].sum():.0f} steps above the limit", fontsize=10)
        panel.set_ylabel("m/s")
        panel.grid(alpha=0.25)
    panels[1].set_xlabel("step")
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8, frameon=False
    )
    figure.savefig(a.out, dpi=120)
    print(a.out)


if __name__ == "__main__":
    main()
